"""The report of a comparison: one HTML file with everything in it, for a phone and for a wide screen."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from slam.compare import figures, wording
from slam.compare.plan import Plan
from slam.compare.statistics import FEWEST, LEVEL, Verdict
from slam.compare.sweep import SWEEP, Run
from slam.compare.tables import RUN_COLUMNS, Group, count_tests, groups, mean_and_sd, most_tests, run_rows
from slam.files import read_object, write_text
from slam.run.results import COMPLETED, UNTRACKED, Metric, number
from slam.run.schema import STAGE_NAMES

TEMPLATES = Path(__file__).parent / "templates"


def write_report(plan: Plan, runs: Sequence[Run], out: Path, workers: str) -> Path:
    """Write ``report.html`` into a comparison's folder, and return its path; it needs no network and no other file.

    `runs` are all of the plan's, also those that failed; `workers` says in words where trials ran.
    """
    from jinja2 import Environment, FileSystemLoader
    from markupsafe import Markup

    every = groups(plan, runs)
    keys = list(dict.fromkeys(key for run in runs for key in run.metrics))
    timed = {stage for run in runs for stage in run.milliseconds}
    stages = ["total", *(stage for stage in STAGE_NAMES if stage in timed)]
    environment = Environment(loader=FileSystemLoader(TEMPLATES), autoescape=True)
    text = environment.get_template("report.html.j2").render(
        title=f"{' against '.join(plan.backends)}: a paired comparison",
        plan=plan,
        runs=runs,
        failed=sum(not run.completed for run in runs),
        short=list(map(wording.conclusions, every)),
        caution=wording.caution(max(group.trials for group in every), most_tests(plan)),
        tests=count_tests(every),
        strengths=[
            (verdict.value, wording.badge(verdict, ""), wording.STRENGTH[verdict])
            for verdict in (Verdict.CERTAIN, Verdict.LIKELY)
        ],
        fewest=FEWEST,
        level=round(100 * LEVEL),
        sections=[_section(plan, every[at : at + len(plan.modes)]) for at in range(0, len(every), len(plan.modes))],
        workers=workers,
        stages=["whole frame", *map(STAGE_NAMES.get, stages[1:])],
        times=[_times(group, backend, stages) for group in every for backend in group.runs],
        run_columns=(*RUN_COLUMNS, *keys),
        run_rows=run_rows(runs, keys, number),
        command=f"{plan.command()} --out DIR",
        versions=read_object(out / SWEEP)["versions"],
        settings=_settings(runs),
        script=Markup((TEMPLATES / "map3d.js").read_text(encoding="utf-8")),
    )
    write_text(out / "report.html", text)
    return out / "report.html"


def _section(plan: Plan, modes: Sequence[Group]) -> dict[str, Any]:
    """A sequence and variant: a table per mode, the pictures of the closed loop."""
    first = modes[0]
    pictures = [
        {"title": title, "caption": caption, "source": base64.b64encode(figures.as_svg(figure).encode()).decode()}
        for title, caption, figure in figures.pictures(first)
    ]
    return {
        "title": first.sequence + ("" if len(plan.variants) == 1 else f" · {first.variant.name}"),
        "tables": list(map(_table, modes)),
        "pictures": pictures,
        "given": wording.measurements(first.mode, plan.backends[0]),
        "map": figures.map_data(first) if pictures else None,
    }


def _table(group: Group) -> dict[str, Any]:
    reasons = {
        f"{backend}, seed {run.trial.seed}: {run.outcome.removeprefix('failed: ')}"
        for backend, runs in group.runs.items()
        for run in runs
        if not run.completed
    }
    never = [key for key in UNTRACKED if not any(group.finite(backend, key).any() for backend in group.runs)]
    return {
        "title": wording.measurements(group.mode, next(iter(group.runs))),
        "rows": [_row(group, metric) for metric in group.metrics if metric.key not in never],
        "reasons": sorted(reasons),
    }


def _row(group: Group, metric: Metric) -> dict[str, Any]:
    """The figure of each back end, and its differences from the first one's; a badge's colour is the direction."""
    means, failed, label = [], [0] * len(group.runs), metric.title
    for backend in group.runs:
        mean, sd = (metric.scale * value for value in mean_and_sd(group.finite(backend, metric.key)))
        means.append((wording.shown(mean), f"± {wording.shown(sd, mean)}" if np.isfinite(mean + sd) else ""))
    if metric is COMPLETED:
        failed, label = list(map(group.failures, group.runs)), metric.label
        means = [(f"{group.trials - count} of {group.trials}", "") for count in failed]
    cells = []
    for d in group.differences(metric).values():
        way = wording.direction(d)
        cell = {"verdict": d.verdict.value, "direction": way, "words": wording.badge(d.verdict, way)}
        cell["mean"], cell["interval"] = wording.shown_difference(d)
        cell["p"], cell["p_holm"] = (wording.shown_p(p) if d.varies else "–" for p in (d.p, d.p_holm))
        cells.append(cell)
    return {"label": label, "means": means, "failed": failed, "cells": cells}


def _times(group: Group, backend: str, stages: Sequence[str]) -> tuple[str, ...]:
    """A row of medians."""
    own = group.runs[backend]
    values = ([run.milliseconds[stage] for run in own if stage in run.milliseconds] for stage in stages)
    cells = (f"{np.median(each):.2f}" if each else "–" for each in values)
    return (group.sequence, group.variant.name, group.mode, backend, *cells)


def _settings(runs: Sequence[Run]) -> str:
    """``config.json`` of the first run of each variant and back end that has one."""
    shown: dict[str, Any] = {}
    for run in runs:
        name = f"{run.trial.variant.name} · {run.trial.backend}"
        if name not in shown and (run.folder / "config.json").exists():
            shown[name] = read_object(run.folder / "config.json")
    return json.dumps(shown, indent=1)
