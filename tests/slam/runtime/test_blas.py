"""One BLAS thread, in whatever thread of Python's."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

from threadpoolctl import ThreadpoolController, threadpool_limits

from slam.runtime.threads import one_blas_thread


def numbers() -> list[int]:
    return [library.num_threads for library in ThreadpoolController().lib_controllers if library.user_api == "blas"]


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
