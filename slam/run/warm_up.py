"""``slam.warm_up``: a few frames of built-in scenes call every kernel, which loads it, or compiles it where it must."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

from slam.config import SystemConfig
from slam.data import FrameResult
from slam.registry import ONLINE, create, resolve
from slam.runtime.compilation import compile_clock
from slam.runtime.threads import available_cores
from slam.sequences import open_sequence
from slam.system import StereoSlam

#: Pairs of images, from rectified cameras and from others.
_IMAGES = "synthetic:desk?frames=3&width=160&height=120"
_SCENES = (_IMAGES, f"{_IMAGES}&rig=toedin")

#: Features asked for: fewer than there are, so that some are chosen, as in larger images.
_FEATURES = 40

#: Cars that move, as features without images: long enough that a body is found, and frames leave its window.
_BODIES = "synthetic:street?frames=12&density=5"

_POLL = 0.2  # cost: between two looks at what the other process has compiled [s]


def warm_up(*backends: str, until: threading.Event | None = None) -> float:
    """Load all kernels, and compile those that are not compiled yet.

    This takes some seconds, or a minute where kernels have to be compiled. Otherwise the first frames take that time,
    and a live run drops frames meanwhile. `slam run` does it before it takes the first frame of a camera.

    Args:
        backends: names of the back ends that will be used; default: all of this package.
        until: ends it early when it is set, after the frame that it is at.

    Returns:
        The wall time in which kernels were compiled [s]; 0 where all were loaded.

    Raises:
        UnknownNameError: no back end of this name.

    Examples:
        >>> import slam
        >>> seconds = slam.warm_up("ekf")
    """
    before = compile_clock.seconds()
    for _ in chain.from_iterable(chain(_with_images(name), _with_bodies(name)) for name in backends or ONLINE):
        if until is not None and until.is_set():
            break
    return compile_clock.seconds() - before


def _with_images(backend: str) -> Iterator[FrameResult]:
    for scene in _SCENES:
        sequence = open_sequence(scene)
        config = SystemConfig.for_kind(sequence.kind).with_settings({"frontend.features": _FEATURES})
        yield from (result for _, result in StereoSlam(sequence.rig, backend=backend, config=config).run(sequence))


def _with_bodies(backend: str) -> Iterator[FrameResult]:
    world = open_sequence(_BODIES)
    system = StereoSlam(world.rig, None, backend, kind=world.kind)
    yield from (system.process_features(world.observations(k)) for k in range(len(world)))  # type: ignore[attr-defined]
    system.estimate()


def compile_kernels(backend: str, frontend: str = "surf") -> None:
    """Where nothing is compiled yet, compile what a run needs in two processes: Numba compiles one function at a time.

    This one takes the front end's kernels, which `surf` alone has, another one those of the back end and of moving
    objects, about twice as long, which are then loaded from Numba's cache. No kernel is compiled by both.
    """
    from slam.bodies.scene_kernels import groups_apart

    folder = groups_apart.stats.cache_path if hasattr(groups_apart, "stats") else None  # without Numba's compiler
    cold = folder is not None and not any(Path(folder).glob("scene_kernels.groups_apart-*.nbi"))
    if available_cores() < 2 or not cold:
        return
    resolve("backends", backend)  # its kernels count from here on
    command = [sys.executable, "-P", "-m", __name__, backend]  # -P: no module of the working folder
    paths, nowhere = os.pathsep.join(filter(None, sys.path)), subprocess.DEVNULL
    environment = {**os.environ, "PYTHONPATH": paths}
    process = subprocess.Popen(command, stdin=nowhere, stdout=nowhere, stderr=nowhere, env=environment)
    compile_clock.change(1)
    try:
        if frontend == "surf":
            images = open_sequence(_IMAGES)
            create("frontends", frontend, images.rig).extract(next(iter(images)))
        while process.poll() is None:
            compile_clock.tell()
            time.sleep(_POLL)
    finally:
        compile_clock.change(-1)
        process.kill()
        process.wait()


if __name__ == "__main__":
    for _ in _with_bodies(sys.argv[1]):
        pass
