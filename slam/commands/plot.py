"""``slam plot``, and the picture that ``slam run`` leaves."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

from slam.errors import ConfigurationError, SlamError
from slam.files import noting_inputs
from slam.outputs import Output, require_outputs
from slam.run.plots import PICTURE, plot, read_runs


def plot_runs(
    folders: Sequence[Path], out: Path | None, kind: str, width: float | None = None, overwrite: bool = False
) -> list[tuple[Path, str]]:
    """Draw runs, those of one sequence in one picture; returns files and captions.

    Args:
        folders: of finished runs.
        out: PNG, PDF or SVG; None for a PNG in the first folder of each sequence.
        kind: name of the figure, see `slam.run.plots.KINDS`.
        width: of the pictures [mm]; None for what suits a screen.
        overwrite: whether files that are there may be replaced.

    Raises:
        SlamError: a folder is none of a finished run, or a file cannot be written.
    """
    with noting_inputs() as inputs:
        groups = read_runs(folders)
    if out is not None and len(groups) > 1:
        names = ", ".join(runs[0].sequence for runs in groups)
        raise ConfigurationError(f"runs of {len(groups)} sequences ({names}) do not go into one file: leave out --out")
    files = [out or runs[0].folder / (PICTURE if kind == "summary" else f"{kind}.png") for runs in groups]
    require_outputs([Output(file, "--out", makes_folder=True) for file in files], inputs, overwrite)
    return [(file, plot(runs, file, kind, width)) for runs, file in zip(groups, files)]


def leave_picture(folder: Path) -> None:
    """The picture of a run that has just ended; where there is nothing to draw a warning says so."""
    try:
        plot(read_runs([folder])[0], folder / PICTURE)
    except SlamError as error:
        logging.getLogger(__name__).warning("no picture: %s", error)
