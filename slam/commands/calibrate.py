"""``slam calibrate``: what recordings say of their rig, in a table and in words."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import typer
from rich.console import Console

from slam.commands.display import empty_table, progress
from slam.commands.run import frame_count
from slam.config import SystemConfig
from slam.errors import ConfigurationError
from slam.files import noting_inputs
from slam.naming import count as count_of
from slam.run.calibrating import calibrate as run
from slam.sequences import is_live, open_sequence
from slam.settings import require_settable

_SIGN = (
    "Corrections are added to measured pixels, seen from the principal point: cx and f are positive where the "
    "calibration's are too large. Usual is how far good calibrations are off; several parameters may cancel"
)
_SHOWN = {"rad": (1e3, "mrad"), "1": (1e3, "10⁻³")}  # what a parameter is multiplied by, and its unit then
_SHARES = "f", "aspect", "down", "forward"  # shown in per cent


def calibrate(
    texts: Sequence[str],
    out: Path,
    settings: Sequence[str],
    frames: tuple[int, int | None],
    format: str | None,
    quiet: bool,
    overwrite: bool,
) -> None:
    """Run recordings of one rig; write and print what they say of it, see `slam.run.calibrating`.

    The exit status is 1 where a warning says why the result cannot be trusted.
    """
    twice = next((text for k, text in enumerate(texts) if text in texts[:k]), None)
    if twice is not None:
        raise ConfigurationError(f"{twice}: given twice; it would count as two recordings that agree")
    require_settable(settings, SystemConfig().to_json(), "surf")
    with noting_inputs() as inputs:
        opened = [open_sequence(text, format=format) for text in texts]
    count = sum(frame_count(sequence, *frames) or 0 for sequence in opened)
    if not (quiet or any(map(is_live, opened))):  # a camera is refused
        print(f"{count_of(len(opened), 'recording')}, {count} frames: each is run once, then what they say is added up")
    with progress(count, "calibrate", quiet) as tell:
        found = run(opened, out, settings, frames, inputs, overwrite, tell)
    for warning in found["warnings"]:
        logging.getLogger(__name__).warning("%s", warning)
    if not quiet:
        _print(found)
        print(f"Use it: slam run SEQUENCE --calibration {out}" if found["worth_correcting"] else f"File: {out}")
    if found["warnings"]:
        raise typer.Exit(1)


def unit_of(row: dict[str, Any], focal: float) -> tuple[float, str]:
    """What a parameter is multiplied by for people, and its unit then; `row` is its row of the file."""
    share = row["name"].removeprefix("left_").removeprefix("right_") in _SHARES
    return (100.0, "%") if share else _SHOWN.get(row["unit"], (focal, "px"))


def _print(found: dict[str, Any]) -> None:
    console, apart = Console(emoji=False), found["apart"]
    table = empty_table(
        "corrections: mean ± standard deviation", ["unit", "correction", *(["apart"] if apart else []), "usual"]
    )
    for k, row in enumerate(found["parameters"]):
        factor, unit = unit_of(row, found["rig"]["focal"])
        cells = [f"{factor * row['mean']:.2f} ± {factor * row['sigma']:.2f}"]
        if apart:  # by how much the recordings differ
            cells.append(f"{apart[k]:.1f} σ" if np.isfinite(apart[k]) else "–")
        table.add_row(row["name"], unit, *cells, f"± {factor * found['usual'][k]:.2g}")
    for text in filter(None, (found["judgement"], found["agreement"])):
        console.print(text, markup=False, highlight=False)
    console.print(table)
    much = ", so the pixels above say whether it is much" if found["judgement"] else ""
    console.print(f"{_SIGN}{much}.", highlight=False)
    for one in found["recordings"]:
        pairs, unsolved = one["pairs"], one["unsolved_pairs"]
        tells = f"{pairs} pairs of views" if pairs else "no pair of views far enough apart"
        tells += ": left out" if one["left_out"] else ""
        if unsolved:
            tells += f"; in {count_of(unsolved, 'other')} too few features agree on one motion of the camera"
        console.print(f"{one['sequence']}: {one['frames']} frames, {tells}", markup=False)
