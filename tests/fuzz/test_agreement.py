"""A case in which a first update was far from the slow estimator's."""

from __future__ import annotations

import numpy as np

import backends
from slam.models import EstimatorModels
from tests.fuzz import agreement
from tests.fuzz.reference import difference


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
