"""The report of a comparison: one HTML file with everything in it, for a phone and for a wide screen."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slam.compare import figures, wording
from slam.compare.plan import Plan
from slam.compare.statistics import FEWEST, LEVEL, Difference, Verdict
from slam.compare.sweep import SWEEP, Run
from slam.compare.tables import RUN_COLUMNS, Group, count_tests, groups, mean_figures, run_head
from slam.files import read_object, write_text
from slam.run.results import COMPLETED, Metric, number
from slam.run.schema import STAGE_NAMES

TEMPLATES = Path(__file__).parent / "templates"

_TESTED = (Verdict.CERTAIN, Verdict.LIKELY, Verdict.HINT)


@dataclass(frozen=True)
class Conclusions:
    """What can be said of a group in its main figures, in the report and on the terminal.

    Attributes:
        name: of the group.
        verdict: which back end is better in what, a sentence for each but the reference.
        failed: which runs failed; empty where none did.
        headlines: what is certain, likely and a hint, in both directions, and which main figures are open.
        honesty: one per back end, on its covariances.
    """

    name: str
    verdict: list[str]
    failed: str
    headlines: list[wording.Line]
    honesty: list[str]


def conclusions(every: Sequence[Group]) -> list[Conclusions]:
    """What can be said, group by group."""
    found = []
    for group in every:
        first, *others = group.runs
        own = {other: [group.differences(metric)[other] for metric in group.metrics] for other in others}
        nees = {
            metric.key: {b: mean_figures(group.finite(b, metric.key))[0] for b in group.runs}
            for metric in group.metrics
            if metric.key.startswith("nees")
        }
        variant = "" if group.variant.name == "surf" else f", {group.variant.name}"
        found.append(
            Conclusions(
                f"{group.sequence}{variant}, {group.mode}",
                [wording.in_short(differences, first, other) for other, differences in own.items()],
                wording.failures({b: group.failures(b) for b in group.runs}, group.trials),
                [line for other, differences in own.items() for line in wording.headline(differences, other)],
                wording.honesty(nees, group.trials),
            )
        )
    return found


def cautions(every: Sequence[Group]) -> str:
    """What the trials of the group that has most can show at best; empty where they are enough."""
    return wording.caution(max(group.trials for group in every), count_tests(every))


def write_report(plan: Plan, runs: Sequence[Run], out: Path, workers: str) -> Path:
    """Write ``report.html``; it needs no network and no other file.

    Args:
        plan: what was run.
        runs: all of them, also those that failed.
        out: folder of the comparison.
        workers: where trials ran, in words.

    Returns:
        the file.
    """
    from jinja2 import Environment, FileSystemLoader
    from markupsafe import Markup

    every = groups(plan, runs)
    keys = list(dict.fromkeys(key for run in runs for key in run.metrics))
    environment = Environment(loader=FileSystemLoader(TEMPLATES), autoescape=True)
    text = environment.get_template("report.html.j2").render(
        title=f"{' against '.join(plan.backends)}: a paired comparison",
        plan=plan,
        runs=runs,
        failed=sum(not run.completed for run in runs),
        short=conclusions(every),
        caution=cautions(every),
        tests=count_tests(every),
        strengths=[(verdict.value, wording.WORDS[verdict], wording.STRENGTH[verdict]) for verdict in _TESTED],
        fewest=FEWEST,
        level=round(100 * LEVEL),
        sections=_sections(plan, every),
        workers=workers,
        **_times(every),
        run_columns=(*RUN_COLUMNS, *keys),
        run_rows=[(*run_head(r), *(number(r.metrics.get(key, float("nan"))) for key in keys)) for r in runs],
        command=f"{plan.command()} --out DIR",
        versions=read_object(out / SWEEP)["versions"],
        settings=_settings(every),
        script=Markup((TEMPLATES / "map3d.js").read_text(encoding="utf-8")),
    )
    write_text(out / "report.html", text)
    return out / "report.html"


def _sections(plan: Plan, every: Sequence[Group]) -> list[dict[str, Any]]:
    """A section per sequence and variant: a table per mode, the pictures of the closed loop."""
    sections = []
    for at in range(0, len(every), len(plan.modes)):
        first = every[at]
        given = wording.measurements(first.mode, plan.backends[0])
        sections.append(
            {
                "title": first.sequence + ("" if len(plan.variants) == 1 else f" · {first.variant.name}"),
                "tables": [_table(group) for group in every[at : at + len(plan.modes)]],
                "pictures": [
                    {"source": _embedded(figures.as_svg(p.draw())), "alt": p.title, "caption": f"{p.caption} {given}."}
                    for p in figures.pictures(first)
                ],
                "given": given,
                "map": figures.map_data(first) if figures.example(first) else None,
            }
        )
    return sections


def _table(group: Group) -> dict[str, Any]:
    reasons = {
        f"{backend}, seed {run.trial.seed}: {run.outcome.removeprefix('failed: ')}"
        for backend, runs in group.runs.items()
        for run in runs
        if not run.completed
    }
    return {
        "title": wording.measurements(group.mode, next(iter(group.runs))),
        "rows": [_row(group, metric) for metric in group.shown],
        "reasons": sorted(reasons),
    }


def _row(group: Group, metric: Metric) -> dict[str, Any]:
    failed, label = [0] * len(group.runs), metric.title
    means = [wording.shown_spread(metric, *mean_figures(group.finite(b, metric.key))[:2]) for b in group.runs]
    if metric is COMPLETED:
        failed, label = list(map(group.failures, group.runs)), metric.label
        means = [(f"{group.trials - count} of {group.trials}", "") for count in failed]
    cells = [_cells(d) for d in group.differences(metric).values()]
    return {"label": label, "means": means, "failed": failed, "cells": cells}


def _cells(d: Difference) -> dict[str, str]:
    """A difference's cells; the badge's colour is the direction, its strength the verdict."""
    return {
        "verdict": d.verdict.value,
        "direction": wording.direction(d),
        "words": wording.badge(d.verdict, wording.direction(d)),
        "mean": wording.shown_mean(d),
        "interval": wording.shown_interval(d),
        "p": wording.shown_p(d.p) if d.varies else "–",
        "p_holm": wording.shown_p(d.p_holm) if d.varies else "–",
    }


def _times(every: Sequence[Group]) -> dict[str, Any]:
    """What the stages do, and a row of medians per group and back end."""
    runs = [run for group in every for rs in group.runs.values() for run in rs]
    timed = {stage for run in runs for stage in run.milliseconds}
    known = ["total", *(stage for stage in STAGE_NAMES if stage in timed)]
    rows = []
    for group in every:
        for backend, own in group.runs.items():
            values = ([run.milliseconds[stage] for run in own if stage in run.milliseconds] for stage in known)
            cells = (f"{np.median(each):.2f}" if each else "–" for each in values)
            rows.append((group.sequence, group.variant.name, group.mode, backend, *cells))
    return {"stages": ["whole frame", *map(STAGE_NAMES.get, known[1:])], "times": rows}


def _settings(every: Sequence[Group]) -> str:
    """``config.json`` of the first completed run of each variant and back end."""
    shown: dict[str, Any] = {}
    for group in every:
        for backend, runs in group.runs.items():
            file = next((r.folder / "config.json" for r in runs if (r.folder / "config.json").exists()), None)
            name = f"{group.variant.name} · {backend}"
            if file is not None and name not in shown:
                shown[name] = read_object(file)
    return json.dumps(shown, indent=1)


def _embedded(svg: str) -> str:
    return "data:image/svg+xml;base64," + base64.b64encode(svg.encode()).decode()
