"""The report of a comparison: one HTML file with everything in it, for a phone and for a wide screen."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from slam.compare import figures, wording
from slam.compare.plan import Plan
from slam.compare.statistics import FEWEST, LEVEL, Verdict
from slam.compare.sweep import SWEEP, Run
from slam.compare.tables import Group, count_tests, most_tests
from slam.files import read_object, write_text
from slam.run.schema import STAGE_NAMES

TEMPLATES = Path(__file__).parent / "templates"


def write_report(
    plan: Plan, every: Sequence[Group], runs: Sequence[Run], out: Path, workers: str, command: str = ""
) -> Path:
    """Write ``report.html`` into a comparison's folder, and return its path; it needs no network and no other file.

    `runs` are all of the plan's, also those that failed; `workers` says in words where trials ran, `command` is what
    was typed.
    """
    from jinja2 import Environment, FileSystemLoader

    timed = {stage for run in runs for stage in run.milliseconds}
    stages = {"total": "whole frame"} | {stage: name for stage, name in STAGE_NAMES.items() if stage in timed}
    environment = Environment(loader=FileSystemLoader(TEMPLATES), autoescape=True)
    text = environment.get_template("report.html.j2").render(
        title=f"{' against '.join(plan.backends)}: a paired comparison",
        plan=plan,
        runs=runs,
        groups=every,
        words=wording,
        caution=wording.caution(max(group.trials for group in every), most_tests(plan)),
        tests=count_tests(every),
        strengths={verdict.value: wording.STRENGTH[verdict] for verdict in (Verdict.CERTAIN, Verdict.LIKELY)},
        fewest=FEWEST,
        level=round(100 * LEVEL),
        sections=[_section(plan, every[at : at + len(plan.modes)]) for at in range(0, len(every), len(plan.modes))],
        workers=workers,
        stages=stages.values(),
        times=[_times(group, backend, stages) for group in every for backend in group.runs],
        command=command,
        versions=read_object(out / SWEEP)["versions"],
    )
    write_text(out / "report.html", text)
    return out / "report.html"


def _section(plan: Plan, modes: Sequence[Group]) -> dict[str, Any]:
    """A sequence and variant: its groups, whose tables are shown, and the pictures of the closed loop."""
    first = modes[0]
    pictures = [
        {"title": title, "caption": caption, "source": base64.b64encode(svg.encode()).decode()}
        for title, caption, svg in figures.pictures(first)
    ]
    return {
        "title": first.sequence + ("" if len(plan.variants) == 1 else f" · {first.variant.name}"),
        "modes": modes,
        "pictures": pictures,
        "given": wording.measurements(first.mode, plan.backends[0]),
    }


def _times(group: Group, backend: str, stages: dict[str, str]) -> tuple[str, ...]:
    """A row of medians."""
    own = group.runs[backend]
    values = ([run.milliseconds[stage] for run in own if stage in run.milliseconds] for stage in stages)
    cells = (f"{np.median(each):.2f}" if each else "–" for each in values)
    return (group.sequence, group.variant.name, group.mode, backend, *cells)
