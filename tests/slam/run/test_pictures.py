"""Pictures of frames and of runs: what is drawn where, and what errors they show."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from matplotlib.figure import Figure

import slam
from slam.config import SystemConfig
from slam.errors import SlamError
from slam.geometry.se3 import exp, pose
from slam.geometry.trajectory import Trajectory, TruthNoise
from slam.object_data import MovingObject, ObjectEstimate
from slam.run.drawing import FramePictures, draw_objects
from slam.run.options import RunOptions
from slam.run.plots import draw_errors, draw_paths
from slam.run.run_data import RunData, pose_errors
from slam.run.runner import run

WORLD = "synthetic:aisle?frames=8&width=160&height=120"


@pytest.fixture(scope="module")
def steps():
    sequence = slam.open_sequence("synthetic:desk?frames=2")
    system = slam.StereoSlam(sequence.rig, config=SystemConfig.for_kind("handheld"))
    return system, [(frame, system.process(frame)) for frame in sequence]


@pytest.mark.parametrize("measured", [True, False])
def test_a_body_is_drawn_where_it_is_and_nowhere_else(steps, measured):
    """A box of half a metre, two metres ahead and to the left, within a frame of 320 x 240 pixels drawn threefold."""
    system, (_, (frame, result)) = steps
    place = result.estimate.T_world_left @ pose(np.eye(3), np.array([-0.4, 0.2, 2.0]))
    none, half = np.zeros(0, np.int64), 0.25 * 0.9  # of points whose 5th to 95th percentile this is
    e = ObjectEstimate(2, 0.0, place, np.eye(6), np.zeros(6), np.eye(6), measured, none, none)
    body = MovingObject(2, none, e, np.eye(4), np.eye(4), half * np.array([[-1.0] * 3, [1.0] * 3]), True)
    before, after = (draw_objects(frame.left, replace(result, objects=o), system.rig) for o in ((), (body,)))
    v, u = np.nonzero((before != after).any(axis=2))
    corners = np.array([-0.4, 0.2, 2.0]) + 0.25 * np.array(list(product([-1, 1], repeat=3)))
    low, high = (f(3 * (system.rig.left.project(corners) + 0.5), axis=0) for f in (np.min, np.max))
    assert u.min() == pytest.approx(low[0], abs=3)
    assert (u.max(), v.max()) == pytest.approx(high, abs=20 if measured else 3)  # the axes stand out by 5 cm
    assert low[1] - 25 < v.min() < low[1]  # the number and the speed stand above it
    drawn = (before != after).any(axis=2)[round(low[1]) + 4 :]
    assert (drawn.mean() > 0.011) == measured  # dashes otherwise, and no axes


def test_places_that_cannot_be_written_are_said(steps, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(SlamError, match=r"cannot write to .*file/below: "):
        FramePictures(tmp_path / "file" / "below")
    with pytest.raises(SlamError, match=r"a folder, or to a video FILE\.mp4"):
        FramePictures(tmp_path / "frames.avi")
    (tmp_path / "folder.mp4").mkdir()
    system, ((frame, result), _) = steps
    with pytest.raises(SlamError, match=r"folder\.mp4: cannot be written"), FramePictures(tmp_path / "folder.mp4") as p:
        p.show(frame, result, system)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """What a run has left."""
    folder, config = tmp_path_factory.mktemp("run"), SystemConfig.for_kind("handheld")
    run(slam.open_sequence(WORLD), RunOptions("ekf", "surf", config, folder))
    return RunData.read(folder, "a")


def test_a_true_path_is_drawn_where_all_runs_have_the_same(finished):
    truth = finished.truth
    elsewhere = replace(finished, truth=Trajectory(truth.stamps, truth.poses @ exp(np.ones(6))))
    later = {name: Trajectory(truth.stamps + 9, getattr(finished, name).poses) for name in ("online", "truth")}
    part = replace(finished, truth=truth.select(np.arange(3)))
    for other, same in ((finished, True), (part, True), (elsewhere, False), (replace(finished, **later), False)):
        axis = Figure().subplots()
        draw_paths(axis, [finished, other])
        labels = [text.get_text() for text in axis.get_legend().get_texts()]
        assert ("true path" in labels) == same == ("true paths differ" not in axis.get_title())


def test_the_error_of_the_rotation_is_drawn_beside_that_of_the_position(finished):
    """What the headline says of the covariances counts both."""
    _, error, sigma, expected = pose_errors(finished)
    summary = finished.summary["accuracy"]["online"]
    assert np.sqrt(np.mean(error[:, 1] ** 2)) == pytest.approx(summary["rotation RMSE from start [deg]"], rel=1e-3)
    assert (error[1:, 1] < 5 * sigma[1:, 1]).all() and (sigma[1:, 1] > 0).all()
    np.testing.assert_allclose(expected, sigma)  # of a world, whose truth is exact
    np.testing.assert_array_equal(sigma, finished.deviations)


def test_where_the_truth_s_sensor_is_and_its_clock_are_part_of_the_expected_error_and_its_turn_of_none(finished):
    """A turn of 1° made σ a metre on a drive of 60 m, beside errors of a centimetre: these are without it."""
    noises = {"mounting": 0.1}, {"lever": 0.1}, {"clock": 0.1}
    exact = pose_errors(finished)[3]
    turned, moved, late = (pose_errors(replace(finished, truth_noise=TruthNoise(**noise)))[3] for noise in noises)
    np.testing.assert_allclose(turned, exact)
    assert (moved[1:, 0] > exact[1:, 0]).all()
    rates = np.diff(finished.truth.positions, axis=0) / np.diff(finished.truth.stamps)[:, None]
    expected = 0.1 * np.linalg.norm(rates[-1] - rates[0])
    assert np.sqrt(late[-1, 0] ** 2 - exact[-1, 0] ** 2) == pytest.approx(expected, rel=0.05)


def test_the_title_says_since_when_errors_count_where_the_first_true_poses_are_not_known(finished):
    """Errors began anew where the truth did, beside a σ since the start: they looked far smaller than claimed."""
    begun = replace(finished, truth=finished.truth.select(np.arange(3, len(finished.truth))))
    time, error, sigma, _ = pose_errors(begun)
    assert time[0] == pytest.approx(0.1) and error[0, 0] < 1e-9 and sigma[0, 0] > 1e-3
    for runs, since in (([finished], "the start"), ([begun], "0.1 s"), ([finished, begun], "0.1 s")):
        axes = Figure().subplots(2)
        draw_errors(axes, runs)
        title = axes[0].get_title()
        assert f"Online error since {since} (solid)" in title
        for words in ("only where σ is far above its first value", "grey: no sure truth"):
            assert (words in title) == (begun in runs)
