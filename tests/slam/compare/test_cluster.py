"""A comparison on a Dask cluster as its page starts one: a scheduler at another address, workers that are lost."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time

import pytest

from slam.compare.plan import CLOSED_LOOP, Plan, Variant
from slam.compare.scheduler import DaskScheduler, Job, LocalScheduler
from slam.compare.sweep import sweep
from slam.compare.tables import write_tables
from slam.errors import SlamError
from tests.slam.compare import jobs

pytest.importorskip("distributed")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="127.0.0.2, and signals of POSIX"),
    pytest.mark.filterwarnings("default"),  # Dask's own
]

HOST = "127.0.0.2"  # of the loopback network, and not the address that anything would be bound to by default
PLAN = Plan(("synthetic:aisle?frames=4",), ("ekf", "smoother"), (Variant("simulated", "simulated"),), 2, replay=False)


def dask(*words):
    """A process group of Dask's, a worker with its nanny."""
    environment = {**os.environ, "DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "5s"}
    return subprocess.Popen(
        [sys.executable, "-m", "dask", *words], env=environment, start_new_session=True,
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip


def end(process):
    """All of its group, for good."""
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


@pytest.fixture
def cluster():
    """Address of a scheduler, itself, and two workers."""
    with socket.socket() as free:
        free.bind((HOST, 0))
        port = free.getsockname()[1]
    address = f"tcp://{HOST}:{port}"
    started = [dask("scheduler", "--host", HOST, "--port", str(port), "--no-dashboard")]
    try:
        wait_for(port, started[0])
        started += [dask("worker", address, "--nthreads", "1", "--no-dashboard") for _ in range(2)]
        yield address, *started
    finally:
        for process in started:
            end(process)


def wait_for(port, process):
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and process.poll() is None:
        with socket.socket() as probe:
            if probe.connect_ex((HOST, port)) == 0:
                return
        time.sleep(0.1)
    raise AssertionError("the scheduler did not start")


def tables(plan, runs, out):
    write_tables(plan, runs, out)
    return {name: (out / name).read_bytes() for name in ("runs.csv", "means.csv", "differences.csv")}


def test_a_worker_is_lost_and_an_interrupted_sweep_goes_on(cluster, tmp_path):
    address, _, first, _ = cluster
    ended = []

    def lose_a_worker_then_stop(trial):
        ended.append(trial)
        if len(ended) == 1:
            end(first)
        if len(ended) == 3:
            raise KeyboardInterrupt

    scheduler = DaskScheduler(address, 60.0)
    with pytest.raises(KeyboardInterrupt):
        sweep(PLAN, tmp_path / "cluster", scheduler, lose_a_worker_then_stop)
    again = []
    runs = sweep(PLAN, tmp_path / "cluster", scheduler, again.append)
    assert all(run.completed for run in runs)
    assert sorted(t.folder for t in again) == sorted(t.folder for t in PLAN.trials_of(CLOSED_LOOP))
    here = sweep(PLAN, tmp_path / "here", LocalScheduler(1))
    assert tables(PLAN, runs, tmp_path / "cluster") == tables(PLAN, here, tmp_path / "here")


def test_a_scheduler_that_goes_away_is_one_line(cluster):
    address, scheduler, *_ = cluster
    work = [Job(f"{i}", jobs.slowly, lambda: (1.0,)) for i in range(6)]
    with pytest.raises(SlamError, match=rf"{address}.* the same command goes on"):
        DaskScheduler(address, 20.0).run(work, lambda *_: end(scheduler))
