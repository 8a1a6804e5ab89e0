"""The contract of moving bodies over the back ends that have them."""

from __future__ import annotations

import pytest

from slam import registry
from slam.testing.objects import OBJECT_CHECKS, check_object_backend
from tests.backends.fixed_map import FixedMapBackend


@pytest.mark.parametrize("check", OBJECT_CHECKS, ids=lambda check: check.__name__)
@pytest.mark.parametrize("name", ["ekf", "smoother"])
def test_contract(name, check):
    check(registry.resolve("backends", name))


def test_the_suite_refuses_a_back_end_without_bodies():
    with pytest.raises(AssertionError):
        check_object_backend(FixedMapBackend)


def test_the_suite_finds_what_is_broken():
    ekf = registry.resolve("backends", "ekf")

    class Boastful(ekf):
        def update_objects(self, observations):
            found = super().update_objects(observations)
            for e in found:
                e.covariance[:] *= 1e-4
            return found

    class Confused(ekf):
        def update_objects(self, observations):
            return super().update_objects(observations)[::-1]

    for broken in (Boastful, Confused):
        with pytest.raises(AssertionError):
            check_object_backend(broken)
