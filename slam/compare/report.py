"""The report of a comparison: one HTML file with everything in it, for a phone and for a wide screen."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from slam.compare import tables
from slam.compare.plan import Plan, is_world
from slam.compare.statistics import LEVEL
from slam.compare.tables import Group
from slam.compare.trial import Run
from slam.files import write_text
from slam.run.options import versions
from slam.run.plots import drawn
from slam.run.run_data import RunData

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TEMPLATES = Path(__file__).parent / "templates"


def write_report(
    plan: Plan, every: Sequence[Group], runs: Sequence[Run], out: Path, caution: str = "", command: str = ""
) -> Path:
    """Write ``report.html`` into a comparison's folder, and return its path; it needs no network and no other file.

    `runs` are all of the plan's, also those that failed; `caution` is what so many trials can show, `command` what was
    typed.
    """
    from jinja2 import Environment, FileSystemLoader

    environment = Environment(loader=FileSystemLoader(TEMPLATES), autoescape=True)
    modes = [every[at : at + len(plan.modes)] for at in range(0, len(every), len(plan.modes))]  # of a section
    text = environment.get_template("report.html.j2").render(
        title=f"{' against '.join(plan.backends)}: a paired comparison",
        plan=plan,
        runs=runs,
        groups=every,
        words=tables,
        caution=caution,
        level=round(100 * LEVEL),
        sections=[(own, list(_pictures(own[0]))) for own in modes],
        times=[(group.name, *map(_time, group.runs.values())) for group in every],
        command=command,
        versions=versions(),
    )
    write_text(out / "report.html", text)
    return out / "report.html"


def _time(runs: Sequence[Run]) -> str:
    known = [run.milliseconds["total"] for run in runs if run.milliseconds]
    return f"{np.median(known):.1f}" if known else "–"


def _pictures(group: Group) -> Iterator[tuple[str, str]]:
    """Caption and SVG of a group's pictures, as far as there is truth; none where every run failed.

    Shown is the first trial that every back end completed; else the first completed of each.
    """
    together = (runs for runs in zip(*group.runs.values()) if all(run.completed for run in runs))
    firsts = [next((run for run in runs if run.completed), None) for runs in group.runs.values()]
    shown = next(together, [run for run in firsts if run is not None])
    if not shown:
        return
    trial, known = shown[0].trial, {metric.key for metric in group.metrics}
    runs = [RunData.read(run.folder, run.trial.backend) for run in shown]
    of_seed = f", seed {trial.seed}" if is_world(trial.sequence) else ""
    yield f"Paths{of_seed}.", _svg(drawn(runs, "path"))
    if "ratio_start" in known:
        text = f"Error of the pose{of_seed} (solid), and the σ that each back end claims (dashed)."
        yield text, _svg(drawn(runs, "errors"))


def _svg(figure: Figure) -> str:
    """A picture as SVG, the same for the same data, as text for a link."""
    from matplotlib import rc_context

    text = io.BytesIO()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "slam"}):
        figure.savefig(text, format="svg", metadata={"Date": None})
    return base64.b64encode(text.getvalue()).decode()
