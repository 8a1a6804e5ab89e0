"""The contract suite over every registered back end, and over a third-party one that comes by an entry point."""

from __future__ import annotations

import numpy as np
import pytest

import backends
from slam import registry
from slam.errors import MeasurementError
from slam.interfaces import Backend
from slam.testing import BACKEND_CHECKS, RIG, check_backend
from tests.backends.fixed_map import FixedMapBackend


def by_name(check):
    return check.__name__


@pytest.mark.parametrize("check", BACKEND_CHECKS, ids=by_name)
@pytest.mark.parametrize("name", backends.names())
def test_contract(name, check):
    check(registry.resolve("backends", name))


@pytest.fixture
def third_party(tmp_path, monkeypatch):
    """An installed distribution with an entry point to a back end of its own."""
    info = tmp_path / "third_party-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: third-party\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[slam.backends]\n"
        "fixed_map = tests.backends.fixed_map:FixedMapBackend\n"
        "ekf = tests.backends.fixed_map:FixedMapBackend\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    registry._table.cache_clear()
    yield "fixed_map"
    monkeypatch.undo()
    registry._table.cache_clear()


@pytest.mark.parametrize("check", BACKEND_CHECKS, ids=by_name)
def test_third_party_contract(third_party, check):
    check(registry.resolve("backends", third_party))


def test_third_party_back_end_is_found_by_name(third_party):
    assert third_party in backends.names()
    backend = backends.create(third_party, RIG)
    assert isinstance(backend, FixedMapBackend) and isinstance(backend, Backend)


def test_third_party_cannot_take_a_built_in_name(third_party):
    assert registry.resolve("backends", "ekf") is not FixedMapBackend


class Forgetful(FixedMapBackend):
    def add(self, observations):
        super().add(observations.select(np.arange(len(observations)) > 0))


class Careless(FixedMapBackend):
    def predict(self, stamp):
        try:
            return super().predict(stamp)
        except MeasurementError:
            return super().predict(self.stamps[-1] + 0.1)


class Boastful(FixedMapBackend):
    def estimate(self, landmarks=True):
        self.covariance = 1e-6 * self.covariance
        return super().estimate(landmarks)


@pytest.mark.parametrize("broken", [Forgetful, Careless, Boastful])
def test_the_suite_finds_what_is_broken(broken):
    with pytest.raises(AssertionError):
        check_backend(broken)
