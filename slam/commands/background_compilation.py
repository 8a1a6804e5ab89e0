"""Where nothing is compiled yet, a second process compiles the kernels of moving objects beside the first frames.

Numba compiles one function at a time in a process. The first frame waits for the front end's kernels anyway; meanwhile
those that are needed last are made, by a few frames of a world with simulated features, and put into Numba's cache. The
run loads them from there; what is not there in time it compiles itself. Results do not depend on it.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from slam.runtime.cores import available_cores

_SCENE = "synthetic:street?frames=8&density=5"  # a body is found in the seventh frame
_NEW = 50  # landmarks added in a frame at most
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
    """Call every kernel of moving objects once.

    Landmarks are measured by their true names: the search for them needs kernels that the run itself compiles
    meanwhile, and two processes that compile the same ones gain nothing.
    """
    from slam import registry
    from slam.config import SystemConfig
    from slam.data import Observations
    from slam.objects.modes import detector_for
    from slam.sequences import open_sequence

    sequence = open_sequence(_SCENE)
    config = SystemConfig.for_kind(sequence.kind, None, backend)
    estimator = registry.create("backends", backend, sequence.rig, models=config.models, **config.backend)
    detector = detector_for(sequence.rig, config.objects, config.models)
    known = np.zeros(0, np.int64)
    for seen in sequence.observe():  # type: ignore[attr-defined]
        features, ids = seen.features, seen.ids
        still = np.flatnonzero((ids >= 0) & (seen.objects == 0) & features.has_stereo & ~seen.false_stereo)
        still = still[np.argsort(ids[still])]
        old = np.isin(ids[still], known)
        measured, new = (
            Observations(ids[rows], features.uv_left[rows], features.uv_right[rows])
            for rows in (still[old], still[~old][:_NEW])
        )
        estimator.predict(features.stamp)
        estimator.update(measured)
        landmark = np.where(np.isin(np.arange(len(features)), still[old]), ids, -1)
        detector.step(estimator, features, estimator.estimate(landmarks=False), landmark)
        estimator.add(new)
        known = np.union1d(known, new.ids)


def _cold() -> bool:
    """Whether Numba's cache lacks the kernel of moving objects that takes longest to compile."""
    from slam.objects.scene_kernels import groups_apart

    folder = groups_apart.stats.cache_path
    return folder is not None and not any(Path(folder).glob("scene_kernels.groups_apart-*.nbi"))


def _end_with_parent() -> None:
    """End this process as soon as nobody holds the other end of its standard input."""
    os.read(0, 1)
    os._exit(1)


if __name__ == "__main__":
    threading.Thread(target=_end_with_parent, daemon=True).start()
    compile_objects(sys.argv[1])
