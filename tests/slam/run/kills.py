"""``python -m tests.slam.run.kills BACKEND FOLDER COUNT``: runs killed after more and more frames.

Each is a fork of a process that has loaded everything, so that many take no longer than one.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

from slam.config import SystemConfig
from slam.run.options import RunOptions
from slam.run.runner import run
from slam.sequences import open_sequence
from tests.fuzz.runs import Features, Numbered, Scripted

FRAMES = 25
_LAST_FILES = 0.15  # of the frames' time: kills are spread over so much more, in which the last files are written


class Seen(Scripted):
    """More frames without images."""

    def __init__(self) -> None:
        world = open_sequence(f"synthetic:desk?frames={FRAMES}&density=6")
        self.rig, self.features, self.warnings = world.rig, [world.observations(k) for k in range(FRAMES)], []

    def __len__(self) -> int:
        return FRAMES

    def frames(self, start=0, stop=None):
        yield from (Numbered.of(k, seen) for k, seen in enumerate(self.features))


def _rows(path: Path) -> int:
    """Lines of a file so far."""
    return path.read_bytes().count(b"\n") if path.exists() else 0


def main() -> None:
    backend, folder, count = sys.argv[1], Path(sys.argv[2]), int(sys.argv[3])
    sequence, ends = Seen(), []

    def work(out: Path) -> None:
        out.mkdir()
        options = RunOptions(backend, "none", SystemConfig(), out, record=out / "a.npz", save_map=out / "a.map")
        run(sequence, options, frontend=Features())

    work(folder / "whole")
    start = time.monotonic()
    work(folder / "timed")
    frame = (time.monotonic() - start) / FRAMES
    for k in range(count):
        child = os.fork()
        if not child:
            work(folder / str(k))
            os._exit(0)
        ended, after = 0, k / count * (1 + _LAST_FILES) * FRAMES
        while not ended and _rows(folder / str(k) / "trajectory.txt") < min(int(after), FRAMES):
            ended = os.waitpid(child, os.WNOHANG)[0]  # where this process was not given the processor in time
            time.sleep(frame / 10)
        if not ended:
            time.sleep(frame * (after - min(int(after), FRAMES)))
            os.kill(child, signal.SIGKILL)
            ends.append(os.WIFSIGNALED(os.waitpid(child, 0)[1]))
    print(sum(ends))


if __name__ == "__main__":
    main()
