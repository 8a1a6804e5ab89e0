from __future__ import annotations

import multiprocessing
import os
import time

import pytest

from slam.compare.scheduler import DaskScheduler, Job, LocalScheduler, WorkerDiedError
from slam.errors import SlamError
from tests.slam.compare import jobs

pytestmark = pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")


def run(scheduler, work):
    """What is delivered, by job."""
    ended = {}

    def deliver(job, value, error):
        assert job.name not in ended
        ended[job.name] = value if error is None else error

    scheduler.run(work, deliver)
    return ended


def job(name, function, *arguments):
    return Job(name, function, lambda: arguments)


def test_every_job_ends_once_and_errors_are_delivered():
    work = [job(f"{i}", jobs.double, i) for i in range(5)]
    ended = run(LocalScheduler(2), [*work, job("bad", jobs.fail, 3), job("threads", jobs.threads)])
    assert [ended[f"{i}"] for i in range(5)] == [0, 2, 4, 6, 8]
    assert isinstance(ended["bad"], ValueError)
    assert ended["threads"] == ("1", "1")
    deadline = time.monotonic() + 10  # the pool's own thread may be about to note the end of a worker
    while multiprocessing.active_children() and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not multiprocessing.active_children()


def test_a_killed_worker_loses_nothing(tmp_path):
    work = [job(f"{i}", jobs.double, i) for i in range(4)]
    ended = run(LocalScheduler(2), [job("dies", jobs.die_once, str(tmp_path / "marker"), 7), *work])
    assert ended["dies"] == 7
    assert [ended[f"{i}"] for i in range(4)] == [0, 2, 4, 6]


def test_a_job_that_always_kills_its_worker_fails_alone():
    ended = run(LocalScheduler(2), [job("dies", jobs.die, 0), *(job(f"{i}", jobs.double, i) for i in range(4))])
    assert isinstance(ended["dies"], WorkerDiedError)
    assert [ended[f"{i}"] for i in range(4)] == [0, 2, 4, 6]


def test_an_interrupt_ends_the_workers():
    def deliver(*_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        LocalScheduler(2).run([job(f"{i}", jobs.double, i) for i in range(50)], deliver)
    deadline = time.monotonic() + 10  # the pool's own thread may be about to note the end of a worker
    while multiprocessing.active_children() and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not multiprocessing.active_children()


def test_nobody_answers():
    pytest.importorskip("distributed")
    with pytest.raises(SlamError, match=r"127\.0\.0\.1:1"):
        DaskScheduler("tcp://127.0.0.1:1", 0.5).run([job("a", jobs.double, 1)], lambda *_: None)
