"""Jobs on the cores of this machine, or on a Dask cluster; a worker that dies loses nothing but its present job."""

from __future__ import annotations

import importlib
import multiprocessing
import multiprocessing.connection
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

from slam.errors import SlamError

#: Read by the libraries when they are loaded, which is before a worker's first job.
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


class WorkerDiedError(SlamError):
    """A job has ended its worker process even where it ran alone."""


@dataclass(frozen=True)
class Job:
    """A call to be made in some process.

    Attributes:
        name: for messages.
        function: importable, so that it can be sent.
        arguments: gives the call's arguments when it is made; they are sent, too.
    """

    name: str
    function: Callable[..., Any]
    arguments: Callable[[], tuple[Any, ...]] = tuple


#: Is told of each job that has ended: what came back, or the exception that it raised.
Deliver = Callable[[Job, Any, BaseException | None], None]


class Scheduler(Protocol):
    """Where jobs run."""

    def run(self, jobs: Iterable[Job], deliver: Deliver) -> None:
        """Run all jobs, in any order; `deliver` is called here, once for each, as they end."""
        ...


@dataclass(frozen=True)
class LocalScheduler:
    """Worker processes on this machine, each with one thread for linear algebra.

    When a worker dies (killed, out of memory) the jobs that were running run again, each alone, and then the others.

    Attributes:
        workers: number of processes.
    """

    workers: int

    def run(self, jobs: Iterable[Job], deliver: Deliver) -> None:
        """See `Scheduler`."""
        waiting = deque(jobs)
        while waiting:
            with _pool(self.workers) as pool:
                lost = _spread(pool, waiting, self.workers, deliver)
            for one in lost:  # alone, so that no other is to blame
                with _pool(1) as pool:
                    for job in _spread(pool, deque([one]), 1, deliver):
                        deliver(job, None, WorkerDiedError("its worker process died, also where it ran alone"))


def _spread(pool: Executor, waiting: deque[Job], most: int, deliver: Deliver) -> list[Job]:
    """Run jobs until none is waiting or a worker is lost; the jobs that were running then come back.

    No more jobs are submitted than `most`, the number of workers: so those submitted are those that were running.
    """
    running: dict[Future[Any], Job] = {}
    lost: list[Job] = []
    while (waiting and not lost) or running:
        try:
            while waiting and not lost and len(running) < most:
                running[pool.submit(waiting[0].function, *waiting[0].arguments())] = waiting[0]
                waiting.popleft()
        except BrokenProcessPool:  # between two jobs
            if not running:
                break
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            job = running.pop(future)
            error = CancelledError() if future.cancelled() else future.exception()
            if isinstance(error, (BrokenProcessPool, CancelledError)):
                lost.append(job)
            else:
                deliver(job, None if error else future.result(), error)
    return lost


@contextmanager
def _pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """A pool whose processes begin with one thread each, and end with this block however it ends."""
    before = set(multiprocessing.active_children())
    kept = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _begin_worker)
    try:
        yield pool
    except BaseException:
        for process in set(multiprocessing.active_children()) - before:
            process.terminate()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        for name, value in kept.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


def _begin_worker() -> None:
    """Leave interrupts to the parent, and end when it is gone, however it went."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()


def _end_with(sentinel: int) -> None:
    multiprocessing.connection.wait([sentinel])
    os._exit(1)


@dataclass(frozen=True)
class DaskScheduler:
    """The workers of an existing Dask cluster. They need this package in the same version, and recorded sequences under
    the same paths; files come back over the network, no shared folder is needed.

    Attributes:
        address: of the scheduler, such as ``"tcp://10.0.0.1:8786"``.
        patience: how long to wait for its first answer [s].
    """

    address: str
    patience: float = 10.0

    def run(self, jobs: Iterable[Job], deliver: Deliver) -> None:
        """See `Scheduler`. Raises SlamError where dask.distributed is missing, or nobody answers, or no longer."""
        try:
            distributed = importlib.import_module("distributed")
        except ImportError as error:
            raise SlamError("--scheduler needs dask.distributed: pip install 'surf-stereo-slam[cluster]'") from error
        try:
            client = distributed.Client(self.address, timeout=self.patience)
        except (OSError, ValueError) as error:
            raise SlamError(f"no Dask scheduler answers at {self.address}: {error}") from error
        gone = f"the Dask scheduler at {self.address} has gone; with a new one the same command goes on"
        with client:
            try:  # not pure: Dask must not take calls with equal arguments for one
                pool, most = client.get_executor(pure=False), max(1, 2 * sum(client.ncores().values()))
                lost = _spread(pool, deque(jobs), most, deliver)
            except (OSError, TimeoutError) as error:
                raise SlamError(gone) from error
        if lost:
            raise SlamError(gone)
