"""Whether the comparison with the slow estimator would notice a back end that is wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import backends
from slam.data import Observations
from slam.models import EstimatorModels
from tests.fuzz import agreement
from tests.fuzz.harness import Broken
from tests.fuzz.reference import difference


class Wrong:
    """A filter with one fault."""

    def __init__(self, fault: str) -> None:
        self.right, self.fault = backends.create("ekf", agreement.RIG, models=agreement.MODELS), fault

    def __getattr__(self, name):
        return getattr(self.right, name)

    def estimate(self, *arguments):
        estimate = self.right.estimate(*arguments)
        return replace(estimate, covariance=estimate.covariance / 2) if self.fault == "confident" else estimate

    def update(self, observations):
        if self.fault == "late":
            shifted = observations.uv_left + 0.5
            return self.right.update(Observations(observations.ids, shifted, observations.uv_right + 0.5))
        return self.right.update(observations)


@pytest.mark.parametrize("fault", ["confident", "late"])
def test_a_back_end_with_a_fault_is_noticed(fault):
    with pytest.raises(Broken):
        agreement.agree(np.random.default_rng(3), Wrong(fault), agreement.TOLERANCES["ekf"])


def test_the_same_without_the_fault_is_not():
    agreement.agree(np.random.default_rng(3), Wrong("none"), agreement.TOLERANCES["ekf"])


def test_the_first_update_finds_the_most_likely_pose_where_the_velocity_is_hardly_known(monkeypatch):
    monkeypatch.setattr(agreement, "MODELS", EstimatorModels())  # 1 m/s, 1 rad/s and 1 px
    backend = backends.create("ekf", agreement.RIG, models=agreement.MODELS)
    play = agreement.Play(np.random.default_rng([22, 6]), backend)
    play.predict()
    play.add(least=10)
    play.predict()
    play.update()
    T, P, _, _ = play.reference.solve()
    off = difference(T, backend.estimate().T_world_left)
    assert off @ np.linalg.solve(P, off) < 6 * 0.3**2  # 0.6 with errors of one sign that each measurement permits
