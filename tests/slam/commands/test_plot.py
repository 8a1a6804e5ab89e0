from __future__ import annotations

import logging
import shutil

import numpy as np
import pytest

from slam.commands.plot import leave_picture, plot_runs
from slam.config import SystemConfig
from slam.errors import SlamError
from slam.geometry.trajectory import Trajectory
from slam.run.figures import pose_errors
from slam.run.options import RunOptions
from slam.run.panels import in_one_world
from slam.run.plots import _STYLE, KINDS, read_runs
from slam.run.run_data import RunData
from slam.run.runner import run
from slam.sequences import open_sequence

WORLD = "synthetic:aisle?frames=8&width=160&height=120"


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Folders of three runs of one world: two back ends, and some frames only; and of a run of another world."""
    root = tmp_path_factory.mktemp("runs")
    config = SystemConfig.for_kind("handheld")
    for name, backend, start in (("a", "ekf", 0), ("b", "smoother", 0), ("later", "ekf", 3)):
        run(open_sequence(WORLD), RunOptions(backend, "surf", config, root / name, start))
    run(open_sequence("synthetic:desk?frames=3&width=160&height=120"), RunOptions("ekf", "surf", config, root / "desk"))
    return root


def read_picture(path):
    import cv2

    return cv2.imread(str(path))


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_figures_of_two_runs(runs, tmp_path, kind):
    ((file, caption),) = plot_runs([runs / "a", runs / "b"], tmp_path / f"{kind}.png", kind)
    assert caption.startswith("aisle")
    picture = read_picture(file)
    assert min(picture.shape[:2]) > 200
    assert np.ptp(picture, axis=2).max() > 60  # there is colour in it


@pytest.mark.parametrize(("suffix", "start"), [("pdf", b"%PDF"), ("svg", b"<?xml"), ("png", b"\x89PNG")])
def test_formats_and_the_same_bytes_twice(runs, tmp_path, suffix, start):
    files = [tmp_path / f"{name}.{suffix}" for name in ("one", "other")]
    for file in files:
        plot_runs([runs / "a"], file, "errors")
    assert files[0].read_bytes().startswith(start)
    assert files[0].read_bytes() == files[1].read_bytes()


def test_runs_of_one_sequence_go_into_one_picture(runs):
    files = [file for file, _ in plot_runs([runs / "a", runs / "desk", runs / "b"], None, "path")]
    assert files == [runs / "a" / "path.png", runs / "desk" / "path.png"]
    with pytest.raises(SlamError, match="runs of 2 sequences"):
        plot_runs([runs / "a", runs / "desk"], runs / "all.png", "path")


def test_a_run_of_later_frames_lies_where_it_was(runs):
    """Its world begins at its own first frame; in the picture it is in that of the first run."""
    (both,) = read_runs([runs / "a", runs / "later"])
    (whole, part), truth = in_one_world(both)
    np.testing.assert_allclose(part.positions, whole.positions[3:], atol=0.01)
    np.testing.assert_allclose(truth.positions, whole.positions, atol=0.01)
    assert np.linalg.norm(both[1].online.positions[0]) < 1e-3


def test_the_true_path_of_a_run_is_that_of_its_frames(runs):
    truth = open_sequence(WORLD).ground_truth
    kept = Trajectory.read_tum(runs / "later" / "truth.txt")
    np.testing.assert_allclose(kept.poses, truth.poses[3:], atol=1e-8)
    run_ = RunData.read(runs / "later", "later")
    time, error, sigma = pose_errors(run_)
    assert len(time) == len(error) == len(sigma) == 5
    assert np.abs(error[0]).max() < 1e-6


def test_the_error_of_the_rotation_is_drawn_beside_that_of_the_position(runs):
    """What the headline says of the covariances counts both."""
    run_ = RunData.read(runs / "a", "a")
    _, error, sigma = pose_errors(run_)
    summary = run_.summary["accuracy"]["online"]
    assert np.sqrt(np.mean(error[:, 3] ** 2)) == pytest.approx(summary["rotation RMSE from start [deg]"], rel=1e-3)
    assert (error[1:, 3] < 5 * sigma[1:, 3]).all() and (sigma[1:, 3] > 0).all()


@pytest.mark.parametrize("kind", KINDS)
def test_a_run_without_truth_or_objects_is_drawn(runs, tmp_path, kind):
    shutil.copytree(runs / "a", tmp_path / "a")
    (tmp_path / "a" / "truth.txt").unlink()
    plot_runs([tmp_path / "a"], tmp_path / "a.png", kind)
    assert (tmp_path / "a.png").stat().st_size > 1000
    if kind == "errors":
        from matplotlib import rc_context

        with rc_context(_STYLE):
            labels = [axis.get_ylabel() for axis in KINDS[kind]([RunData.read(tmp_path / "a", "a")], None).axes]
        assert [label.partition(" [")[0] for label in labels] == ["σ right", "σ down", "σ forward", "σ rotation"]


def test_frames_without_a_pose_have_no_deviation(runs, tmp_path):
    shutil.copytree(runs / "a", tmp_path / "a")
    lines = (tmp_path / "a" / "frames.csv").read_text().splitlines()
    columns = lines[0].split(",")
    cells = lines[1].split(",")
    for name in ("sd_x", "sd_y", "sd_z", "sd_rotation"):
        cells[columns.index(name)] = ""
    (tmp_path / "a" / "frames.csv").write_text("\n".join([lines[0], ",".join(cells), *lines[2:]]) + "\n")
    path = (tmp_path / "a" / "trajectory.txt").read_text().splitlines(keepends=True)
    (tmp_path / "a" / "trajectory.txt").write_text("".join(path[1:]))
    data = RunData.read(tmp_path / "a", "a")
    assert len(data.deviations) == len(data.online) == 7
    assert len(data.status) == 8
    plot_runs([tmp_path / "a"], tmp_path / "a.png", "summary")


def test_bad_input_is_one_line(runs, tmp_path):
    with pytest.raises(SlamError, match="not the folder of a finished run"):
        plot_runs([tmp_path], None, "summary")
    with pytest.raises(SlamError, match=r"a picture is a file \.png, \.pdf or \.svg"):
        plot_runs([runs / "a"], tmp_path / "a.jpg", "summary")
    with pytest.raises(SlamError, match=r"is 50 to 1000 mm, got 8\.8"):
        plot_runs([runs / "a"], tmp_path / "a.png", "path", 8.8)
    with pytest.raises(SlamError, match=r"unknown figure 'eror'.*did you mean 'errors'"):
        plot_runs([runs / "a"], tmp_path / "a.png", "eror")
    (tmp_path / "file").write_text("")
    with pytest.raises(SlamError, match="cannot be written"):
        plot_runs([runs / "a"], tmp_path / "file" / "a.png", "path")


def test_a_run_without_a_map_is_no_error_after_a_run(tmp_path, caplog):
    with caplog.at_level(logging.WARNING):
        leave_picture(tmp_path)
    assert "no picture: " in caplog.text


def test_a_picture_that_is_there_is_not_replaced(runs, tmp_path):
    (tmp_path / "paper.pdf").write_text("mine")
    with pytest.raises(SlamError, match="is there already"):
        plot_runs([runs / "a"], tmp_path / "paper.pdf", "path")
    assert (tmp_path / "paper.pdf").read_text() == "mine"
