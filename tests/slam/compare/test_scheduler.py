from __future__ import annotations

import multiprocessing
import os
import time

import pytest

from slam.compare.scheduler import DaskScheduler, Job, LocalScheduler, WorkerDiedError
from slam.errors import SlamError
from tests.slam.compare import jobs

pytestmark = pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")


def run(scheduler, *work):
    """What is delivered, by job; beside the work, numbers are doubled."""
    ended = {}

    def deliver(job, value, error):
        assert job.name not in ended
        ended[job.name] = value if error is None else error

    scheduler.run([*work, *(job(f"{i}", jobs.double, i) for i in range(5))], deliver)
    assert [ended.pop(f"{i}") for i in range(5)] == [0, 2, 4, 6, 8]
    return ended


def job(name, function, *arguments):
    return Job(name, function, lambda: arguments)


def require_no_worker_left():
    deadline = time.monotonic() + 10  # the pool's own thread may be about to note the end of a worker
    while multiprocessing.active_children() and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not multiprocessing.active_children()


def test_every_job_ends_once_and_errors_are_delivered():
    ended = run(LocalScheduler(2), job("bad", jobs.fail, 3), job("threads", jobs.threads))
    assert isinstance(ended["bad"], ValueError)
    assert ended["threads"] == ("1", "1")
    require_no_worker_left()


def test_a_killed_worker_loses_nothing_and_a_job_that_always_kills_it_fails_alone(tmp_path):
    ended = run(LocalScheduler(2), job("once", jobs.die_once, str(tmp_path / "marker"), 7), job("dies", jobs.die, 0))
    assert ended["once"] == 7
    assert isinstance(ended["dies"], WorkerDiedError)


def test_an_interrupt_ends_the_workers():
    def deliver(*_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        LocalScheduler(2).run([job(f"{i}", jobs.double, i) for i in range(50)], deliver)
    require_no_worker_left()


def test_nobody_answers():
    pytest.importorskip("distributed")
    with pytest.raises(SlamError, match=r"127\.0\.0\.1:1"):
        DaskScheduler("tcp://127.0.0.1:1", 0.5).run([job("a", jobs.double, 1)], lambda *_: None)
