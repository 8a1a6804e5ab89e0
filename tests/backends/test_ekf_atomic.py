"""Calls of the filter happen or do not: interrupted anywhere and made again, they give what they would have given."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from backends.ekf import EkfBackend
from slam.data import Observations
from slam.models import EstimatorModels, MotionModel
from tests.backends.scenes import RIG, cloud, observe, path

MODELS = EstimatorModels(MotionModel(0.3, 0.3), pixel_sigma=0.5)


class Interrupted:
    """Makes a call of the filter again and again until it comes to its end, each time interrupted at a later line."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.count = 0

    def __call__(self, call, *args):
        line = int(self.rng.integers(1, 40))
        while True:
            left = [line]

            def trace(frame, event, argument, left=left):
                if (
                    "backends/ekf" not in frame.f_code.co_filename.replace("\\", "/")
                    or frame.f_code.co_name == "restore"
                ):
                    return None
                if event == "line":
                    left[0] -= 1
                    if left[0] == 0:
                        raise KeyboardInterrupt
                return trace

            before = sys.gettrace()
            sys.settrace(trace)
            try:
                return call(*args)
            except KeyboardInterrupt:
                self.count += 1
            finally:
                sys.settrace(before)
            line += int(self.rng.integers(1, 80))


def walk(call) -> EkfBackend:
    """Landmarks come and go, the local part is stored; the camera turns through the singularity."""
    rng = np.random.default_rng(0)
    poses = path(16, 0.1, np.array([0, 0, 1.0]), np.array([0, 0.3, 1.5]))
    points = cloud(poses, 600, rng)
    backend, known = EkfBackend(RIG, MODELS), set()
    for k, T in enumerate(poses):
        call(backend.predict, 0.1 * k)
        seen = observe(T, points, 0.5, rng, 60)
        seen = seen.select(rng.permutation(len(seen))[:40])
        if k == 12:  # the filter is to recover
            call(backend.predict, 0.1 * k + 0.05)
            seen = Observations(seen.ids, seen.uv_left + np.array([80.0, 0]), seen.uv_right + np.array([80.0, 0]))
        old = np.array([i in known for i in seen.ids.tolist()], bool)
        call(backend.update, seen.select(old))
        new = seen.select(~old & np.isfinite(RIG.triangulate(seen.uv_left, seen.uv_right)).all(axis=1))
        call(backend.add, new)
        known.update(new.ids.tolist())
        gone = rng.permutation(sorted(known))[: len(known) // 5]
        call(backend.remove, gone)
        known.difference_update(gone.tolist())
    return backend


@pytest.mark.parametrize("seed", range(2))
def test_an_interrupted_call_did_not_happen(seed):
    expected, interrupted = walk(lambda call, *args: call(*args)), Interrupted(seed)
    found = walk(interrupted)
    assert interrupted.count > 100
    np.testing.assert_array_equal(found.trajectory().poses, expected.trajectory().poses)
    np.testing.assert_array_equal(found.trajectory().stamps, expected.trajectory().stamps)
    np.testing.assert_array_equal(found._state.covariance.full(), expected._state.covariance.full())
    np.testing.assert_array_equal(found.estimate().positions, expected.estimate().positions)
