"""``slam warm-up``: a few frames of built-in scenes, so that every kernel is called, and compiled where it was not."""

from __future__ import annotations

from slam.runtime.compile_clock import compile_clock
from slam.sequences import open_sequence
from slam.system import StereoSlam

BACKENDS = ("ekf", "smoother")

#: Cars that move, and a pair that has to be rectified; bodies are found in the sixth frame.
SCENES = ("synthetic:street?frames=10", "synthetic:desk?frames=3&rig=toedin")


def warm_up() -> float:
    """Compile what is not compiled yet; returns the wall time that took [s]."""
    before = compile_clock.seconds()
    for scene in SCENES:
        for backend in BACKENDS:
            sequence = open_sequence(scene)
            system = StereoSlam(sequence.rig, backend=backend, kind=sequence.kind)
            for frame in sequence:
                system.process(frame)
    return compile_clock.seconds() - before
