"""``slam calibrate``: what recordings say of their rig, in a table and in words."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from slam.commands.display import progress
from slam.config import SystemConfig
from slam.data import FrameResult
from slam.errors import ConfigurationError
from slam.files import noting_inputs
from slam.run.calibrating import Calibrated
from slam.run.calibrating import calibrate as run
from slam.sequences import Sequence as StereoSequence
from slam.sequences import open_sequence
from slam.settings import require_settable

_SIGN = (
    "Corrections are added to measured pixels, seen from the principal point: cx and f are positive where the\n"
    "calibration's principal point and focal length are too large."
)
_NARROW, _COLUMN = 42, 17  # characters of the table, and of each recording's column in it


def calibrate(
    texts: Sequence[str],
    out: Path,
    settings: Sequence[str],
    frames: tuple[int, int | None],
    format: str | None,
    quiet: bool,
    opencv: Path | None,
    overwrite: bool,
) -> None:
    """Run recordings of one rig; write and print what they say of it, see `slam.run.calibrating`."""

    def show(sequence: StereoSequence, count: int) -> AbstractContextManager[Callable[[FrameResult], None]]:
        return progress(count, f"…{sequence.name[-14:]}", quiet)

    twice = next((text for k, text in enumerate(texts) if text in texts[:k]), None)
    if twice is not None:
        raise ConfigurationError(f"{twice}: given twice; it would count as two recordings that agree")
    require_settable(settings, SystemConfig().to_json(), "surf")
    with noting_inputs() as inputs:
        opened = [open_sequence(text, format=format) for text in texts]
    done = run(opened, out, show, settings, frames, inputs, opencv, overwrite)
    if done.warning:
        logging.getLogger(__name__).warning("%s", done.warning)
    if not quiet:
        _print(done)
        if opencv:
            print(f"The corrected calibration holds the corrections to {done.off:.3f} px, and no uncertainty.")
        print(f"Use it: slam run SEQUENCE --calibration {out}" if done.worth else f"File: {out}")


def _print(done: Calibrated) -> None:
    """The table, and what it says."""
    console, joint, apart = Console(), done.kept.posterior, done.apart
    if not console.is_terminal:  # a file or a pipe is not 80 columns wide
        console = Console(width=_NARROW + _COLUMN * (1 + len(done.found)))
    fits = _NARROW + _COLUMN * len(done.found) <= console.width
    shown = done.found if fits and len(done.found) > 1 else ()  # of a single one, all is that
    table = Table(title="corrections: mean ± standard deviation", show_lines=False)
    table.add_column("parameter")
    table.add_column("unit")
    for name in ("all", *(f"({number})" for number in range(1, len(shown) + 1)), *([] if apart is None else ["apart"])):
        table.add_column(name, justify="right", no_wrap=True)
    for row, (name, (factor, unit)) in enumerate(zip(joint.names, done.units)):
        beliefs = [joint, *(one.posterior for one in shown)]
        cells = [f"{factor * p.mean[row]:.2f} ± {factor * p.sigma[row]:.2f}" for p in beliefs]
        if apart is not None:
            cells.append(f"{apart[row]:.1f} σ" if np.isfinite(apart[row]) else "–")
        table.add_row(name, unit, *cells)
    console.print(table)
    print(_SIGN)
    for number, one in enumerate(done.found, 1):
        tells = "" if one.evidence is not None else ": no motion that shows anything, left out"
        console.print(f"({number}) {one.name}: {one.frames} frames, {one.pairs} pairs of views{tells}", markup=False)
    for text in filter(None, (done.judgement, done.agreed)):
        console.print(text, markup=False, highlight=False)
