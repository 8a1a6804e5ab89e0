from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure

from slam.config import SystemConfig
from slam.geometry.se3 import exp
from slam.geometry.trajectory import Trajectory, TruthNoise
from slam.run.options import RunOptions
from slam.run.plots import draw_paths
from slam.run.run_data import RunData, pose_errors
from slam.run.runner import run
from slam.sequences import open_sequence

WORLD = "synthetic:aisle?frames=8&width=160&height=120"


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """What a run has left."""
    folder, config = tmp_path_factory.mktemp("run"), SystemConfig.for_kind("handheld")
    run(open_sequence(WORLD), RunOptions("ekf", "surf", config, folder))
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
