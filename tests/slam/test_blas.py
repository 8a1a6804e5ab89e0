"""One BLAS thread, in whatever thread of Python's."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from threadpoolctl import ThreadpoolController, threadpool_limits

import backends
from slam.models import EstimatorModels, MotionModel
from slam.runtime.threads import one_blas_thread
from tests.backends.scenes import RIG, path, run, scene

DATA = scene(path(8, 0.1, np.array([0, 0, 1.5]), np.array([0, 0.3, 0])), points=600, limit=80)


def numbers() -> list[int]:
    return [library.num_threads for library in ThreadpoolController().lib_controllers if library.user_api == "blas"]


def outcome(name: str) -> bytes:
    backend = backends.create(name, RIG, models=EstimatorModels(MotionModel(0.3, 0.3), pixel_sigma=0.5))
    run(backend, DATA)
    found = backend.estimate()
    return found.T_world_left.tobytes() + found.covariances.tobytes()


def test_every_thread_computes_the_same_bytes():
    with threadpool_limits(2, user_api="blas"):
        expected = outcome("ekf")
        with ThreadPoolExecutor(1) as other:
            assert other.submit(outcome, "ekf").result() == expected
        with ThreadPoolExecutor(3) as others:
            assert set(others.map(outcome, ["ekf"] * 3)) == {expected}


def test_the_number_of_threads_is_one_inside_and_set_back_after_the_last():
    inside, may_leave = threading.Event(), threading.Event()

    @one_blas_thread
    def wait():
        inside.set()
        may_leave.wait(10)
        return numbers()

    with threadpool_limits(2, user_api="blas"):
        before = numbers()
        with ThreadPoolExecutor(1) as other:
            running = other.submit(wait)
            assert inside.wait(10)
            assert set(one_blas_thread(numbers)()) == {1}
            assert set(numbers()) == {1}  # the other one needs it still
            may_leave.set()
            assert set(running.result()) == {1}
        assert numbers() == before
