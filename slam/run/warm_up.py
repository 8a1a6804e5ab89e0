"""``slam.warm_up``: a few frames of built-in scenes call every kernel, which loads it, or compiles it where it must."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from itertools import chain

from slam.data import FrameResult
from slam.registry import ONLINE
from slam.runtime.compile_clock import compile_clock
from slam.sequences import open_sequence
from slam.system import StereoSlam

#: Pairs of images, from rectified cameras and from others.
_IMAGES = "synthetic:desk?frames=3&width=160&height=120"
_SCENES = (_IMAGES, f"{_IMAGES}&rig=toedin")

#: Cars that move, as features without images; a body is found in the seventh frame.
_BODIES = "synthetic:street?frames=9&density=5"


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
    for _ in chain.from_iterable(_frames(backend) for backend in backends or ONLINE):
        if until is not None and until.is_set():
            break
    return compile_clock.seconds() - before


def _frames(backend: str) -> Iterator[FrameResult]:
    """All frames of the scenes, processed."""
    for scene in _SCENES:
        sequence = open_sequence(scene)
        yield from (result for _, result in StereoSlam(sequence.rig, backend=backend).run(sequence))
    world = open_sequence(_BODIES)
    system = StereoSlam(world.rig, None, backend, kind=world.kind)
    yield from (system.process_features(seen.features) for seen in world.observe())  # type: ignore[attr-defined]
