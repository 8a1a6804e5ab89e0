"""Errors of the poses of a run that is done, and what was claimed of them."""

from dataclasses import replace

import numpy as np
import pytest

import slam
from slam.config import SystemConfig
from slam.geometry.trajectory import TruthNoise
from slam.run.options import RunOptions
from slam.run.run_data import RunData, pose_errors
from slam.run.runner import run

WORLD = "synthetic:aisle?frames=8&width=160&height=120"


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """What a run has left."""
    folder, config = tmp_path_factory.mktemp("run"), SystemConfig.for_kind("handheld")
    run(slam.open_sequence(WORLD), RunOptions("ekf", "surf", config, folder))
    return RunData.read(folder, "a")


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


def test_errors_and_claims_count_from_the_first_true_pose_on(finished):
    """Errors began anew where the truth did, beside a σ since the start: they looked far smaller than claimed."""
    begun = replace(finished, truth=finished.truth.select(np.arange(3, len(finished.truth))))
    time, error, sigma, _ = pose_errors(begun)
    assert time[0] == pytest.approx(0.1) and error[0, 0] < 1e-9 and sigma[0, 0] > 1e-3
