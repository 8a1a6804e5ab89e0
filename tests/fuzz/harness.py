"""What a class of inputs is, and the run of one case under limits of time and memory."""

import os
import resource
import shutil
import signal
import tempfile
import time
import traceback
import warnings
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

import slam
from slam.data import StereoFeatures
from slam.errors import SlamError
from slam.geometry.rig import StereoRig
from slam.system import StereoSlam

SECONDS = 10.0  # of processor time for any case
BLOCKED = 120.0  # of wall time: a case that takes longer waits for something
GIGABYTES = 3  # that a case may ask for, besides what the process has
LONGEST_LINE = 700

Case = Callable[[np.random.Generator, Path], None]


class Broken(AssertionError):  # noqa: N818 it says what it is
    """A promise that a case found broken."""


class TimedOut(BaseException):
    """Out of time; no handler of errors catches it."""


class Subject(NamedTuple):
    """A class of inputs."""

    name: str
    case: Case  # makes one of a random generator, in an empty folder, and gives it to the program
    quiet: bool = True  # whether Python's warnings count as broken promises
    runs: bool = True  # whether kernels are called
    short: int = 60  # number of cases in the tests


def run_case(subject: Subject, number: int) -> str:
    """The traceback of a case in which something promised was not kept; empty for others."""
    rng = np.random.default_rng([0, zlib.crc32(subject.name.encode()), number])
    folder = Path(tempfile.mkdtemp(prefix="fuzz_", dir="/dev/shm" if os.access("/dev/shm", os.W_OK) else None))
    started = time.process_time()
    try:
        with limits(), nothing_printed(), warnings.catch_warnings():
            warnings.simplefilter("error" if subject.quiet else "ignore")
            try:
                subject.case(rng, folder)
            except SlamError as error:
                require_line(error)
        if time.process_time() - started > SECONDS:
            raise Broken(f"took more than {SECONDS:g} s")
    except (Exception, TimedOut) as error:  # noqa: BLE001 every kind is counted
        return "".join(traceback.format_exception(error))
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return ""


@cache
def warm_up() -> None:
    """Have the kernels compiled, which takes longer than any case may: a short run of both back ends, once."""
    world = slam.open_sequence("synthetic:box?frames=90&density=300")
    for backend in ("ekf", "smoother"):
        observed, shown = StereoSlam(world.rig, None, backend), StereoSlam(world.rig, "surf", backend)
        for k in range(58, 84):  # the box moves, and is found
            observed.process_features(world.observations(k))
        for frame in world.frames(60, 63):
            shown.process(frame)


@cache
def scene() -> tuple[StereoRig, tuple[StereoFeatures, ...]]:
    """A rig and what it sees of a small world, frame by frame."""
    world = slam.open_sequence("synthetic:desk?frames=5&density=6&seed=1")
    return world.rig, tuple(world.observations(k) for k in range(5))


def require_line(error: SlamError) -> None:
    """Raise where the message of an error is not one line."""
    text = str(error)
    if not text or "\n" in text or "\r" in text or len(text) > LONGEST_LINE:
        raise Broken(f"{type(error).__name__} is no line of bounded length: {text[:80]!r}")


@contextmanager
def limits() -> Iterator[None]:
    """Stop what takes too long or waits for ever, and refuse memory beyond a bound."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    statm = Path("/proc/self/statm")
    handlers = {n: signal.signal(n, _out_of_time) for n in (signal.SIGALRM, signal.SIGPROF)}
    if statm.exists():
        used = int(statm.read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + GIGABYTES * 2**30, hard))
    signal.setitimer(signal.ITIMER_PROF, 1.2 * SECONDS)
    signal.setitimer(signal.ITIMER_REAL, BLOCKED)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.setitimer(signal.ITIMER_REAL, 0)
        for n, handler in handlers.items():
            signal.signal(n, handler)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def _out_of_time(number: int, frame: object) -> None:
    raise TimedOut("waits for ever" if number == signal.SIGALRM else f"took more than {SECONDS:g} s")


@contextmanager
def nothing_printed() -> Iterator[None]:
    """Raise where anything was written to descriptor 2, by whatever library."""
    with tempfile.TemporaryFile() as aside:
        kept = os.dup(2)
        os.dup2(aside.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
        aside.seek(0)
        printed = aside.read(200)
    if printed:
        raise Broken(f"printed on standard error: {printed!r}")
