"""Where nothing is compiled yet, a second process compiles kernels beside the first frames.

Numba compiles one function at a time in a process. The first frame waits for the front end's kernels anyway; meanwhile
those that are needed after them are made, by a few frames of a world with simulated features, and put into Numba's
cache. The run loads them from there; what is not there in time it compiles itself. Results do not depend on it.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from slam.runtime.cores import available_cores

_SCENE = "synthetic:street?frames=8&density=5"  # a body is found in the seventh frame
_PATIENCE = 5.0  # for the end of the second process [s]


@contextmanager
def compiled_in_background(backend: str) -> Iterator[None]:
    """The second process, where it is of use: it ends with the block, or when this process is killed."""
    if available_cores() < 2 or not _cold():
        yield
        return
    command = [sys.executable, "-P", "-m", __name__, backend]  # -P: no module of the working folder
    modules = {"PYTHONPATH": os.pathsep.join(folder for folder in sys.path if folder)}
    quiet = subprocess.DEVNULL
    process = subprocess.Popen(  # its standard input ends with this process, however that ends
        command, stdin=subprocess.PIPE, stdout=quiet, stderr=quiet, start_new_session=True,
        env={**os.environ, **modules},
    )  # fmt: skip
    try:
        yield
    finally:
        process.terminate()
        try:
            process.wait(_PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if process.stdin is not None:
            process.stdin.close()


def compile_objects(backend: str) -> None:
    """Call every kernel that frames need after their features once, those of moving objects last."""
    from slam.sequences import open_sequence
    from slam.system import StereoSlam

    sequence = open_sequence(_SCENE)
    system = StereoSlam(sequence.rig, None, backend, kind=sequence.kind)
    for k in range(len(sequence)):
        system.process_features(sequence.observations(k))  # type: ignore[attr-defined]


def _cold() -> bool:
    """Whether Numba's cache lacks the kernel of moving objects that takes longest to compile."""
    from slam.objects.scene_kernels import window_tests

    folder = window_tests.stats.cache_path
    return folder is not None and not any(Path(folder).glob("scene_kernels.window_tests-*.nbi"))


def _end_with_parent() -> None:
    """End this process as soon as nobody holds the other end of its standard input."""
    os.read(0, 1)
    os._exit(1)


if __name__ == "__main__":
    threading.Thread(target=_end_with_parent, daemon=True).start()
    compile_objects(sys.argv[1])
