from __future__ import annotations

import json
import logging
import shutil
import subprocess
import sys
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest

from slam.commands.plot import leave_picture, plot_runs
from slam.config import SystemConfig
from slam.errors import SlamError
from slam.geometry.trajectory import Trajectory
from slam.run.figures import draw_map, position_errors, stretch, well_known
from slam.run.plots import _SMALL_STYLE, _STYLE, KINDS, _in_one_world, _path_panel, plot, read_runs
from slam.run.run_data import RunData
from slam.run.runner import RunOptions, run
from slam.run.style import backend_colours
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


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("width", [88, 180])
def test_a_figure_is_as_wide_as_asked(runs, tmp_path, kind, width):
    ((file, _),) = plot_runs([runs / "a", runs / "b"], tmp_path / "a.png", kind, width)
    assert abs(read_picture(file).shape[1] - width / 25.4 * 300) <= 1


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


def test_runs_are_named_by_what_tells_them_apart(runs, tmp_path):
    assert [r.name for r in read_runs([runs / "a", runs / "b"])[0]] == ["ekf", "smoother"]
    assert [r.name for r in read_runs([runs / "a", runs / "later"])[0]] == ["a", "later"]
    shutil.copytree(runs / "a", tmp_path / "a")
    assert [r.name for r in read_runs([runs / "a", tmp_path / "a"])[0]] == ["a (1)", "a (2)"]


def test_a_run_of_later_frames_lies_where_it_was(runs):
    """Its world begins at its own first frame; in the picture it is in that of the first run."""
    (both,) = read_runs([runs / "a", runs / "later"])
    (whole, part), truth = _in_one_world(both)
    np.testing.assert_allclose(part.positions, whole.positions[3:], atol=0.01)
    np.testing.assert_allclose(truth.positions, whole.positions, atol=0.01)
    assert np.linalg.norm(both[1].online.positions[0]) < 1e-3


def test_the_true_path_begins_where_the_run_does(runs):
    """Also of a run that went wrong: a path that is fitted to it would hide by how much."""
    ((good, *_),) = read_runs([runs / "a"])
    poses = good.online.poses.copy()
    poses[4:, 0, 3] += 0.5
    bad = replace(good, online=Trajectory(good.online.stamps, poses), truth_is_exact=True)
    _, truth = _in_one_world([bad])
    np.testing.assert_allclose(truth.positions[0], bad.online.positions[0], atol=1e-9)
    _, error, _ = position_errors(bad, bad.truth)
    np.testing.assert_allclose(bad.online.positions - truth.positions, error, atol=1e-9)


def test_the_true_path_of_a_run_is_that_of_its_frames(runs):
    truth = open_sequence(WORLD).ground_truth
    kept = Trajectory.read_tum(runs / "later" / "truth.txt")
    np.testing.assert_allclose(kept.poses, truth.poses[3:], atol=1e-8)
    run_ = RunData.read(runs / "later", "later")
    time, error, sigma = position_errors(run_, run_.truth)
    assert len(time) == len(error) == len(sigma) == 5
    assert np.abs(error[0]).max() < 1e-9


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
        assert [label.partition(" [")[0] for label in labels] == ["σ right", "σ down", "σ forward"]


def test_frames_that_were_not_tracked_are_told_from_others(runs, tmp_path):
    from matplotlib.figure import Figure

    shutil.copytree(runs / "a", tmp_path / "a")
    frames = tmp_path / "a" / "frames.csv"
    head, first, *others = frames.read_text().splitlines()
    lost = [line.replace("tracked", "predicted") if k < 3 else line for k, line in enumerate(others)]
    frames.write_text("\n".join([head, first, *lost]) + "\n")
    data = RunData.read(tmp_path / "a", "a")
    assert data.measured.tolist() == [True, False, False, False, True, True, True, True]
    axis = Figure().subplots()
    draw_map(axis, data, None, "0.5")
    solid, dotted = (line.get_xdata() for line in axis.lines if str(line.get_label()).startswith("path"))
    assert np.isnan(solid).tolist() == (~data.measured).tolist()
    np.testing.assert_array_equal(dotted, data.online.positions[:, 0])
    plot_runs([tmp_path / "a", runs / "b"], tmp_path / "a.png", "summary")


def test_bodies_old_landmarks_and_the_final_path_are_in_the_map(runs):
    from matplotlib.figure import Figure

    data = RunData.read(runs / "a", "a")
    shifted = Trajectory(data.final.stamps, data.final.poses + np.eye(4, k=3))
    data = replace(data, final=shifted, bodies={"1": np.zeros((2, 3)), "2": np.ones((2, 3))}, old=np.ones((4, 3)))
    axis = Figure().subplots()
    draw_map(axis, data, None, "0.5")
    labels = [line.get_label() for line in axis.lines]
    for label in ("path, final", "moving bodies", "landmarks before"):
        assert labels.count(label) == 1
    marks = {line.get_marker() for line in axis.lines if str(line.get_label()).startswith("landmarks ")}
    assert {"^", "."} <= marks  # told apart without colour


def test_a_bar_ends_where_its_label_says_and_the_title_says_what_was_found(runs):
    from matplotlib import rc_context

    data = read_runs([runs / "a"])[0]
    with rc_context(_STYLE):
        (axis,) = KINDS["time"](data, None).axes
        title = KINDS["summary"](data, None).get_suptitle()
    (label,) = axis.texts
    end = max(bar.get_x() + bar.get_width() for bar in axis.patches)
    assert float(label.get_text().split()[0]) == pytest.approx(end, rel=0.01)
    for words in ("m/s", "σ of the last position", "loops closed 0", "moving bodies"):
        assert words in " ".join(title.split())


def test_ellipses_are_inside_of_the_map(runs):
    from matplotlib.figure import Figure

    data = RunData.read(runs / "a", "a")
    known = well_known(data)
    right = known[np.argmax(data.positions[known, 0])]
    data.covariances[right] = np.diag([0.19**2, 1e-6, 1e-6])
    assert right in well_known(data)
    axis = Figure().subplots()
    draw_map(axis, data, None, "0.5")
    assert axis.get_xlim()[1] > data.positions[right, 0] + 2 * np.sqrt(data.covariances[right, 0, 0])


def test_a_pdf_is_named_after_its_sequence(runs, tmp_path):
    plot_runs([runs / "a"], tmp_path / "a.pdf", "path")
    assert b"/Title (aisle" in (tmp_path / "a.pdf").read_bytes()


@pytest.mark.parametrize(("kind", "kept"), [("path", []), ("errors", []), ("time", []), ("map", ["ekf", "smoother"])])
def test_a_figure_for_a_paper_has_its_titles_in_the_caption(runs, tmp_path, kind, kept):
    own = read_runs([runs / "a", runs / "b"])[0]
    caption = plot(own, tmp_path / "a.svg", kind)
    assert caption == plot(own, tmp_path / "a.png", kind)
    drawn = (tmp_path / "a.svg").read_text()
    titles = [title.rstrip(".") for title in caption.split(". ")]
    assert len(titles) > 1
    assert not [title for title in titles if f"<!-- {title} -->" in drawn]
    assert all(f"<!-- {name} -->" in drawn for name in kept)


@pytest.mark.parametrize("across", [0, 1])
def test_a_straight_path_has_a_scale_of_its_own_across(across):
    from matplotlib.figure import Figure

    axis = Figure().subplots()
    points = np.zeros((30, 2))
    points[:, 1 - across] = np.arange(30)
    assert not stretch(axis, 0 * points)
    assert stretch(axis, points)
    assert np.ptp((axis.get_xlim, axis.get_ylim)[across]()) == pytest.approx(0.01 * 29 * 1.2)
    assert (axis.get_xlabel, axis.get_ylabel)[across]().endswith("a scale of its own")
    points[:, across] = 3 * np.sin(np.arange(30))
    assert not stretch(axis, points)


def test_the_whole_true_path_is_in_the_picture(runs):
    """It is also where it leaves a path that is nearly a line, which has a scale of its own across."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    data = read_runs([runs / "a"])[0][0]
    poses = np.tile(np.eye(4), (8, 1, 1))
    poses[:, 2, 3] = 10 * np.arange(8)
    true = poses.copy()
    true[:, 0, 3] = (2, 0, 0, 0, 0, 0, 0, 0)
    stamps = data.online.stamps
    data = replace(data, online=Trajectory(stamps, poses), truth=Trajectory(stamps, true))
    axis = Figure().subplots()
    with rc_context(_STYLE):
        _path_panel(axis, [data])
    (drawn,) = (line for line in axis.lines if line.get_label() == "true path")
    low, high = axis.get_xlim()
    assert low < np.min(drawn.get_xdata())
    assert np.max(drawn.get_xdata()) < high


@pytest.mark.parametrize(("kind", "width"), [("time", None), ("time", 88), ("errors", 88), ("summary", None)])
def test_legends_below_panels_are_inside_of_the_picture(runs, kind, width):
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    own = read_runs([runs / "a", runs / "b"])[0]
    with rc_context(_STYLE | ({} if width is None else _SMALL_STYLE)):
        figure = KINDS[kind](own, None if width is None else width / 25.4)
        FigureCanvasAgg(figure).draw()
        legends = [one for part in (figure, *_parts(figure)) for one in part.legends]
        assert legends
        for legend in legends:
            box = legend.get_window_extent()
            assert figure.bbox.x0 <= box.x0
            assert box.x1 <= figure.bbox.x1
            assert figure.bbox.y0 <= box.y0


def _parts(figure):
    return [part for sub in figure.subfigs for part in (sub, *_parts(sub))]


def test_a_back_end_has_its_colour_in_all_panels_of_a_run(runs):
    from matplotlib import rc_context
    from matplotlib.colors import to_hex

    own = read_runs([runs / "b"])[0]
    for kind in ("path", "map", "errors"):
        with rc_context(_STYLE):
            figure = KINDS[kind](own, None)
        lines = [line for axis in figure.axes for line in axis.lines]
        drawn = {to_hex(line.get_color()) for line in lines if "smoother" in str(line.get_label())}
        assert drawn == set(backend_colours(["smoother"]))


def test_ellipses_of_landmarks_that_are_hardly_known_are_left_out(runs):
    """A lost camera's landmarks: all are far for a path so short, and a few cover the others."""
    data = RunData.read(runs / "a", "a")
    data = replace(data, positions=30 * data.positions, covariances=data.covariances.copy())
    data.covariances[:3] = 100 * np.eye(3)
    known = well_known(data)
    assert len(known) > len(data.positions) // 2
    assert not np.isin([0, 1, 2], known).any()


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


@pytest.mark.slow
def test_matplotlib_is_loaded_by_pictures_alone(tmp_path):
    words = ["run", "synthetic:desk?frames=2&width=64&height=48", "-q", "--overwrite", "-o", str(tmp_path)]
    code = f"""
import sys
from slam.commands.cli import app
app({[*words, "--no-picture"]!r}, standalone_mode=False)
assert "matplotlib" not in sys.modules
app({words!r}, standalone_mode=False)
assert "matplotlib" in sys.modules and "matplotlib.pyplot" not in sys.modules
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "summary.png").exists()


def test_a_row_of_frames_that_lost_its_end_has_no_loop(runs, tmp_path):
    folder = shutil.copytree(runs / "a", tmp_path / "cut")
    rows = [line.split(",") for line in (folder / "frames.csv").read_text(encoding="utf-8").splitlines()]
    loop = rows[0].index("loop")
    moved = [row[:loop] + row[loop + 1 :] + row[loop : loop + 1] for row in rows]  # the last column, so that it can go
    moved[1].pop()
    (folder / "frames.csv").write_text("\n".join(map(",".join, moved)) + "\n", encoding="utf-8")
    assert len(RunData.read(folder, "cut").loops) == 0


@pytest.mark.parametrize("name", ["x^$", r"\frac{$", "a\x1b\x01b", "$a$"])
def test_any_name_of_a_folder_can_be_drawn(runs, tmp_path, name):
    folder = tmp_path / name
    shutil.copytree(runs / "a", folder)
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps({**config, "sequence": name, "backend": name}))
    plot_runs([folder], tmp_path / "a.svg", "summary")
    ElementTree.fromstring((tmp_path / "a.svg").read_bytes())


def test_a_picture_that_is_there_is_not_replaced(runs, tmp_path):
    (tmp_path / "paper.pdf").write_text("mine")
    with pytest.raises(SlamError, match="is there already"):
        plot_runs([runs / "a"], tmp_path / "paper.pdf", "path")
    assert (tmp_path / "paper.pdf").read_text() == "mine"
