"""Way of one frame through the code: files entered, calls from one file to another, and Python calls in all.

Calls inside the back end and the window solver are left out; the front end has done its work before.
"""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path
from types import FrameType
from typing import Any

from slam.sequences import Sequence
from slam.system import StereoSlam

ROOT = Path(__file__).resolve().parents[1]
_LEFT_OUT = tuple(str(ROOT / folder) for folder in ("backends", "slam/window", "slam/kernels"))
_CORE = str(ROOT / "slam")


class Way:
    """Counts calls of Python functions while it watches, as a profiler."""

    def __init__(self) -> None:
        self.calls: Counter[tuple[str, str]] = Counter()  # by calling and called file

    def __call__(self, frame: FrameType, event: str, argument: Any) -> None:
        """Note a call, unless a file that is left out is among its callers."""
        if event != "call":
            return
        at: FrameType | None = frame.f_back
        while at is not None:
            if at.f_code.co_filename.startswith(_LEFT_OUT):
                return
            at = at.f_back
        caller = "" if frame.f_back is None else frame.f_back.f_code.co_filename
        self.calls[caller, frame.f_code.co_filename] += 1

    def summary(self) -> tuple[int, int, int]:
        """Files of the core that were entered, calls from one of them to another, calls in all."""
        ours = {pair: n for pair, n in self.calls.items() if pair[1].startswith(_CORE)}
        ours = {pair: n for pair, n in ours.items() if not pair[1].startswith(_LEFT_OUT)}
        across = sum(n for (caller, called), n in ours.items() if caller != called and caller.startswith(_CORE))
        return len({called for _, called in ours}), across, sum(self.calls.values())


def ways_of(sequence: Sequence, backend: str, first: int, last: int) -> list[Way]:
    """The ways of the frames from `first` to before `last`."""
    system, ways = StereoSlam(sequence.rig, "surf", backend, kind=sequence.kind), []
    for frame in sequence.frames(0, last):
        features, way = system.frontend.extract(frame), Way()  # type: ignore[union-attr]
        sys.setprofile(way if frame.index >= first else None)
        system.process_features(features)
        sys.setprofile(None)
        ways.append(way)
    return ways[first:]
