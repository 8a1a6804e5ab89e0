import numpy as np
import pytest

from slam.calibration.model import RigModel
from slam.calibration.posterior import (
    Accumulator,
    Evidence,
    Prior,
    RigEvidence,
    factory_prior,
    field_variance,
    residual_likelihoods,
    row_evidence,
    solve,
)
from tests.slam.calibration.drives import CAR, parameters, residual_fields

NONE = np.zeros(1)


def evidence(value, sigma):
    return Evidence(np.array([[sigma**-2]]), np.array([value / sigma**2]), np.zeros((1, 1)))


def test_the_posterior_is_that_of_the_whole_mixture():
    """Against the integral: where the data cannot say which scale is true, the means by scale lie apart."""
    sigmas, theta = np.array([0.05, 0.4]), np.linspace(-2, 2, 400_001)
    likelihood = np.exp(-0.5 * ((theta - 0.25) / 0.15) ** 2)
    p = likelihood * sum(np.exp(-0.5 * (theta / sigma) ** 2) / sigma for sigma in sigmas)
    p /= p.sum()
    mean, found = p @ theta, solve(Prior(NONE, sigmas[:, None, None] ** 2), evidence(0.25, 0.15))
    assert found.mean[0] == pytest.approx(mean, rel=1e-6)
    assert found.covariance[0, 0] == pytest.approx(p @ (theta - mean) ** 2, rel=1e-6)


@pytest.mark.parametrize("scale", [0.1, 0.3, 1.0])
def test_how_large_the_residual_fields_are_is_seen_in_the_rows(scale):
    model, rng = RigModel(CAR), np.random.default_rng(3)
    fields, theta, rows = scale * residual_fields(rng), parameters(pitch=5e-4, yaw=3e-4), None
    for _ in range(10):
        xyz = [[-0.7, -0.2, 0.01], [0.7, 0.2, 0.05]]
        points = model.focal * rng.uniform(*xyz, (300, 3))
        vertical = -model.field(points)[:, 3] @ theta - model.residual_field(points)[:, 3] @ fields
        found = row_evidence(model, points, vertical + 0.1 * rng.standard_normal(300), theta)[1]
        rows = found if rows is None else rows + found
    said, nothing = (
        np.sqrt(RigEvidence(rows, rows, residual_likelihoods(factory_prior(model), part)).fields / field_variance())
        for part in (rows, rows.scaled(1e-9))
    )
    assert said == pytest.approx(scale, rel=0.4)
    assert nothing > 0.4  # where they say nothing


@pytest.mark.parametrize("length", [1, 4, 10])
def test_errors_that_last_are_counted_as_such(length):
    """Each error is shared by so many neighbours: the variance of the mean is so many times as large."""
    rng = np.random.default_rng(0)
    z = []
    for _ in range(60):
        errors = np.repeat(rng.standard_normal(400 // length), length)
        sums = Accumulator(1.0, 4)
        for x in errors:
            sums.add(evidence(x, 1.0))
        for _ in range(5):
            solution = solve(Prior(NONE, np.full((1, 1, 1), 1e6)), sums.total())
            sums.update_inflation(solution.mean, solution.covariance)
        z.append(solution.mean[0] / np.sqrt(solution.covariance[0, 0]))
    # Half a block and less is counted in full; the prior on the inflation holds a part back.
    assert 0.75 < np.sqrt(np.mean(np.square(z))) < 1.9


def test_a_prior_that_contradicts_all_blocks_is_no_scatter():
    """Else the information is divided by the square of the contradiction, and the prior keeps the parameter."""
    rng, sums = np.random.default_rng(0), Accumulator(3.0, 4)
    narrow, mean = Prior(NONE, np.full((1, 1, 1), 0.01)), NONE
    for x in 5.0 + rng.standard_normal(400):
        sums.add(evidence(x, 1.0))
        sums.update_inflation(mean, np.full((1, 1), 0.01))
        mean = solve(narrow, sums.total()).mean
    assert sums.inflation < 2.0
    assert mean[0] > 2.5  # of 5, by 400 measurements against a prior worth 100


def test_directions_of_which_next_to_nothing_is_known_spoil_no_others():
    """Of information from 1 to 1e12: its square, which has no digits left for the least, is not formed."""
    rng, known, V = np.random.default_rng(0), np.logspace(0, 12, 13), 1e-7
    Q = np.linalg.qr(rng.standard_normal((13, 13)))[0]
    left = Evidence((Q * known) @ Q.T, np.zeros(13), np.zeros((13, 1))).with_error(np.full(13, V))
    np.testing.assert_allclose(np.diag(Q.T @ left.S @ Q), known / (1.0 + V * known), rtol=1e-2)
    nothing = Evidence(np.zeros((2, 2)), np.zeros(2), np.zeros((2, 1))).with_error(np.ones(2), 1.0)
    assert not nothing.S.any() and not nothing.e.any()


def test_rows_weigh_the_inverse_of_their_variance_and_outliers_next_to_nothing():
    model, rng = RigModel(CAR), np.random.default_rng(3)
    points = model.focal * rng.uniform([-0.7, -0.2, 0.01], [0.7, 0.2, 0.05], (2000, 3))
    vertical, theta = 0.2 * rng.standard_normal(2000), np.zeros(len(model.names))
    A = model.field(points)[:, 3]
    clean = row_evidence(model, points, vertical, theta)[0]
    assert np.trace(clean.S) == pytest.approx(np.trace(A.T @ A) / 0.2**2, rel=0.1)
    wrong = vertical + 40.0 * (np.arange(2000) == 0)
    pull = row_evidence(model, points, wrong, theta)[0].e - clean.e
    assert np.linalg.norm(pull) < 0.01 * np.linalg.norm(40.0 * A[0] / 0.2**2)
