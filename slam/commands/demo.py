"""``slam demo``: the built-in bookshelf aisle with a moving box through both back ends, in a table and pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from slam.commands.background_compilation import compiled_in_background
from slam.commands.display import Progress, print_summary
from slam.config import SystemConfig
from slam.files import write_png
from slam.outputs import Output, require_outputs
from slam.registry import ONLINE
from slam.run.drawing import draw_objects, with_legend
from slam.run.figures import RunData, draw_map_3d, draw_top_view
from slam.run.outputs import NAMES, write_json
from slam.run.plots import plot
from slam.run.runner import RunOptions, run
from slam.sequences import open_sequence

_PICTURES = ("top_view.png", "map_3d.png", "errors.png", "frame.png")


def demo(out: Path, frames: int, quiet: bool = False, overwrite: bool = False) -> list[dict[str, Any]]:
    """Run the demo; returns the runs' summaries, which are also in ``summary.json`` of each run's folder.

    Leaves a folder per back end with the files of a run, ``comparison.json``, and the pictures ``top_view.png``,
    ``map_3d.png``, ``errors.png`` and ``frame.png``.

    Args:
        out: folder for everything.
        frames: number of frames.
        quiet: show nothing.
        overwrite: whether files that are there may be replaced.

    Raises:
        SlamError: a file cannot be written, or is there already.
    """
    import matplotlib

    own = Output(out, "--out", ["comparison.json", *_PICTURES])
    require_outputs([own, *(Output(out / backend, "--out", NAMES) for backend in ONLINE)], (), overwrite)

    matplotlib.use("Agg")
    world = f"synthetic:aisle?frames={frames}&speed=2&box=1"
    summaries: list[dict[str, Any]] = []
    last = None
    with compiled_in_background(ONLINE[-1]):
        sequence = open_sequence(world)
        sequence.keep_images()  # type: ignore[attr-defined]
        for backend in ONLINE:
            config = SystemConfig.for_kind(sequence.kind, "surf", backend)
            with Progress(len(sequence), f"{sequence.name} · {backend}", quiet) as progress:
                summaries.append(run(sequence, RunOptions(backend, "surf", config, out / backend), progress.frame))
                last = progress.last
    write_json(out / "comparison.json", {"runs": summaries})
    runs = [RunData.read(out / backend, backend) for backend in ONLINE]
    draw_top_view(runs, sequence.ground_truth, out / "top_view.png")
    draw_map_3d(runs, out / "map_3d.png")
    plot(runs, out / "errors.png", "errors")
    if last is not None:
        frame = next(iter(sequence.frames(frames - 1)))
        write_png(out / "frame.png", with_legend(draw_objects(frame.left, last, sequence.rig)))
    if not quiet:
        print_summary(summaries, out)
    return summaries
