"""Where nothing is compiled yet, a second process compiles the kernels of moving objects beside the first frames.

Numba compiles one function at a time in a process. The first frame waits for the front end's kernels anyway; meanwhile
those that are needed last are made, by a few frames of a world with simulated features, and put into Numba's cache. The
run loads them from there; what is not there in time it compiles itself. Results do not depend on it.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_SCENE = "synthetic:street?frames=8"  # bodies are found in the sixth frame
_PATIENCE = 5.0  # for the end of the second process [s]


@contextmanager
def compiled_beside(backend: str) -> Iterator[None]:
    """The second process, where it is of use: it ends at the end of the block at the latest."""
    if _processors() < 2 or not _cold():
        yield
        return
    command = [sys.executable, "-P", "-m", __name__, backend]  # -P: no module of the working folder
    modules = {"PYTHONPATH": os.pathsep.join(folder for folder in sys.path if folder)}
    quiet = subprocess.DEVNULL
    process = subprocess.Popen(
        command, stdin=quiet, stdout=quiet, stderr=quiet, start_new_session=True, env={**os.environ, **modules}
    )
    try:
        yield
    finally:
        process.terminate()
        try:
            process.wait(_PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def compile_objects(backend: str) -> None:
    """Call every kernel but those of front ends once."""
    from slam.sequences import open_sequence
    from slam.system import StereoSlam

    sequence = open_sequence(_SCENE)
    system = StereoSlam(sequence.rig, None, backend, kind=sequence.kind)
    for k in range(len(sequence)):
        system.process_features(sequence.observations(k))  # type: ignore[attr-defined]


def _processors() -> int:
    """How many of them this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _cold() -> bool:
    """Whether Numba's cache lacks the kernel of moving objects that takes longest to compile."""
    from slam.objects.scene_kernels import window_tests

    folder = window_tests.stats.cache_path
    return folder is not None and not any(Path(folder).glob("scene_kernels.window_tests-*.nbi"))


if __name__ == "__main__":
    compile_objects(sys.argv[1])
