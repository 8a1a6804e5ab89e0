"""``slam demo``: the built-in bookshelf aisle with a moving box through three back ends, in a table and pictures."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from slam.commands.display import print_summary, progress
from slam.commands.run import require_no_recording
from slam.config import SystemConfig
from slam.data import FrameResult
from slam.files import write_png
from slam.outputs import Output, require_outputs
from slam.registry import ONLINE
from slam.run.drawing import draw_objects, with_legend
from slam.run.options import RunOptions
from slam.run.plots import PICTURE, plot
from slam.run.run_data import RunData
from slam.run.run_record import RunRecord
from slam.run.runner import run
from slam.run.schema import FILES
from slam.run.warm_up import compile_kernels
from slam.sequences import open_sequence

#: As real cameras differ from their calibration; with exact ones errors would be a third of what covariances claim.
_WORLD = "synthetic:aisle?frames={}&speed=2&box=1&focal_error=0.002&turn_error=0.7"
_FRAME = "frame.png"
_SECONDS = 0.07  # of a frame, about


def demo(out: Path, frames: int, quiet: bool = False, overwrite: bool = False) -> list[dict[str, Any]]:
    """Run the demo; returns the runs' summaries, which are also in ``summary.json`` of each run's folder.

    Leaves a folder per back end with the files of a run, and the pictures ``summary.png`` and ``frame.png`` (the last
    frame in which the box was measured, else the last). Raises SlamError where a file cannot be written, or is there
    already and may not be replaced.
    """
    require_no_recording(out)
    own = Output(out, "--out", [PICTURE, _FRAME])
    require_outputs([own, *(Output(out / backend, "--out", list(FILES)) for backend in ONLINE)], (), overwrite)
    summaries: list[dict[str, Any]] = []
    shown: dict[bool, FrameResult] = {}  # the last frame with a body, and without one
    sequence = open_sequence(_WORLD.format(frames))
    sequence.keep_images()  # type: ignore[attr-defined]
    if not quiet:
        seconds = _SECONDS * len(ONLINE) * frames
        print(f"{len(ONLINE)} runs of {frames} frames: {seconds:.0f} s on two idle cores, 40 s more the first time")
        print("tracked N/M: the camera is tracked by N of the M landmarks in the map")
    for backend in ONLINE:
        config = SystemConfig.for_kind(sequence.kind)
        record = RunRecord()  # its time of compiling begins here
        with progress(len(sequence), f"aisle · {backend}", quiet) as tell:
            compile_kernels(ONLINE[-1])

            def seen(result: FrameResult, tell: Callable[[FrameResult], None] = tell) -> None:
                tell(result)
                shown[any(thing.estimate.measured for thing in result.objects)] = result

            summaries.append(run(sequence, RunOptions(backend, "surf", config, out / backend), seen, record=record))
    plot([RunData.read(out / backend, backend) for backend in ONLINE], out / PICTURE)
    last = shown.get(True, shown.get(False))
    if last is not None:
        (frame,) = sequence.frames(last.index, last.index + 1)
        write_png(out / _FRAME, with_legend(draw_objects(frame.left, last, sequence.rig), last.objects))
    if not quiet:
        print_summary(summaries, [out])
        box = "the box in the image" if True in shown else "without the box: to find it takes more --frames"
        print(f"Open first: {out / PICTURE}; then {out / _FRAME}, {box}")
    return summaries
