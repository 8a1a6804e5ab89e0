"""The report of a comparison: one HTML file with everything in it, for a phone and for a wide screen."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slam.compare import figures
from slam.compare.measure import COMPLETED, Metric, number
from slam.compare.plan import CLOSED_LOOP, REPLAY, Plan
from slam.compare.statistics import FEWEST, LEVEL, Difference, Verdict
from slam.compare.sweep import SWEEP, Run
from slam.compare.tables import RUN_COLUMNS, Group, count_tests, groups, mean_figures
from slam.compare.wording import (
    STRENGTH,
    WORDS,
    Line,
    badge,
    caution,
    direction,
    failures,
    headline,
    honesty,
    in_short,
    innovations,
    measurements,
    replayed,
    sentence,
    shown_interval,
    shown_mean,
    shown_p,
    shown_spread,
    worth_saying,
)
from slam.files import read_object, write_text
from slam.run.style import stage_name, stages

_TEMPLATES = Path(__file__).parent / "templates"

_TESTED = (Verdict.CERTAIN, Verdict.LIKELY, Verdict.HINT)


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

    every = groups(plan, runs)
    environment = Environment(loader=FileSystemLoader(_TEMPLATES), autoescape=True)
    text = environment.get_template("report.html.j2").render(
        title=f"{' against '.join(plan.backends)}: a paired comparison",
        plan=plan,
        runs=runs,
        failed=sum(not run.completed for run in runs),
        short=conclusions(every),
        caution=caution(most_trials(every), count_tests(every)),
        tests=count_tests(every),
        strengths=[(verdict.value, WORDS[verdict], STRENGTH[verdict]) for verdict in _TESTED],
        fewest=FEWEST,
        level=round(100 * LEVEL),
        sections=_sections(plan, every),
        workers=workers,
        **_times(every),
        run_columns=(*RUN_COLUMNS, *_run_keys(runs)),
        run_rows=[_run_row(run, _run_keys(runs)) for run in runs],
        command=_command(plan),
        versions=read_object(out / SWEEP)["versions"],
        settings=_settings(every),
        script=_script(),
    )
    path = out / "report.html"
    write_text(path, text)
    return path


@dataclass(frozen=True)
class Conclusions:
    """What can be said of a group in its main figures.

    Attributes:
        name: of the group.
        verdict: which back end is better in what, a sentence for each but the reference.
        failed: which runs failed; empty where none did.
        headlines: what is certain, likely and a hint, in both directions, and which main figures are open.
        sentences: one per main figure.
        honesty: one per back end, on its covariances.
    """

    name: str
    verdict: list[str]
    failed: str
    headlines: list[Line]
    sentences: list[str]
    honesty: list[str]


def conclusions(every: Sequence[Group]) -> list[Conclusions]:
    """What can be said, group by group."""
    return [_conclusions(group, every) for group in every]


def most_trials(every: Sequence[Group]) -> int:
    """Trials of the group that has most: recorded sequences have one."""
    return max(group.trials for group in every)


def _conclusions(group: Group, every: Sequence[Group]) -> Conclusions:
    first, *others = group.runs
    compared = [group.differences(metric) for metric in group.metrics]
    headlines: list[Line] = []
    sentences: list[str] = []
    verdict: list[str] = []
    for other in others:
        own = [differences[other] for differences in compared]
        verdict.append(in_short(own, first, other))
        headlines += headline(own, other)
        sentences += [sentence(d, first, other) for d in own if worth_saying(d)]
    failed = failures({b: group.failures(b) for b in group.runs}, group.trials)
    return Conclusions(_name(group), verdict, failed, headlines, sentences, _honesty(group, every))


def _honesty(group: Group, every: Sequence[Group]) -> list[str]:
    """Whether each back end's covariances hold, and what the figures that say so mean."""
    means = {
        metric.key: {b: mean_figures(group.finite(b, metric.key))[0] for b in group.runs} for metric in group.metrics
    }
    lines = honesty({key: values for key, values in means.items() if key.startswith("nees")}, group.trials)
    return lines + _why_replays_differ(group, every) + innovations(means.get("nis_per_dof", {}))


def _why_replays_differ(group: Group, every: Sequence[Group]) -> list[str]:
    """A sentence where a replay's covariances are smaller than those of the closed loop that it replays."""
    own = (group.sequence, group.variant, CLOSED_LOOP)
    before = next((other for other in every if (other.sequence, other.variant, other.mode) == own), None)
    if group.mode != REPLAY or before is None:
        return []
    first = next(iter(group.runs))
    nees = [{m.key: mean_figures(g.finite(first, m.key))[0] for m in g.metrics} for g in (before, group)]
    return [text for text in [replayed(first, *nees)] if text]


def _name(group: Group) -> str:
    variant = "" if group.variant.name == "surf" else f", {group.variant.name}"
    return f"{group.sequence}{variant}, {group.mode}"


def _sections(plan: Plan, every: Sequence[Group]) -> list[dict[str, Any]]:
    """A section per sequence and variant: a table per mode, the pictures of the closed loop."""
    sections = []
    for at in range(0, len(every), len(plan.modes)):
        own = every[at : at + len(plan.modes)]
        first = own[0]
        variant = "" if len(plan.variants) == 1 else f" · {first.variant.name}"
        sections.append(
            {
                "title": f"{first.sequence}{variant}",
                "tables": [_table(group, own) for group in own],
                "pictures": _pictures(first),
                "given": measurements(first.mode, plan.backends[0]),
                "map": figures.map_data(first) if figures.example(first) else None,
            }
        )
    return sections


def _table(group: Group, every: Sequence[Group]) -> dict[str, Any]:
    first = next(iter(group.runs))
    reasons = {
        f"{b}, seed {r.trial.seed}: {r.outcome.removeprefix('failed: ')}"
        for b, rs in group.runs.items()
        for r in rs
        if not r.completed
    }
    return {
        "title": f"{measurements(group.mode, first)}",
        "rows": [_row(group, metric, group.differences(metric)) for metric in group.shown],
        "honesty": _honesty(group, every),
        "sentences": [sentence(d, first, b) for m in group.shown if m.better for b, d in group.differences(m).items()],
        "reasons": sorted(reasons),
    }


def _row(group: Group, metric: Metric, differences: dict[str, Difference]) -> dict[str, Any]:
    cells = [_cells(d) for d in differences.values()]
    if metric is COMPLETED:
        means = [(f"{group.trials - group.failures(b)} of {group.trials}", "") for b in group.runs]
        return {"label": metric.label, "means": means, "failed": list(map(group.failures, group.runs)), "cells": cells}
    means = []
    for backend in group.runs:
        mean, sd, _, _ = mean_figures(group.finite(backend, metric.key))
        means.append(shown_spread(metric, mean, sd))
    return {"label": metric.title, "means": means, "failed": [0] * len(means), "cells": cells}


def _cells(d: Difference) -> dict[str, str]:
    """A difference's cells; the badge's colour is the direction, its strength the verdict."""
    return {
        "verdict": d.verdict.value,
        "direction": direction(d),
        "words": badge(d.verdict, direction(d)),
        "mean": shown_mean(d),
        "interval": shown_interval(d),
        "p": shown_p(d.p) if d.varies else "–",
        "p_holm": shown_p(d.p_holm) if d.varies else "–",
    }


def _pictures(group: Group) -> list[dict[str, str]]:
    """Pictures of a group, embedded; each caption says which measurements."""
    given = measurements(group.mode, next(iter(group.runs)))
    return [
        {"source": _embedded(figures.as_svg(p.draw())), "alt": p.title, "caption": f"{p.caption} {given}."}
        for p in figures.pictures(group)
    ]


def _times(every: Sequence[Group]) -> dict[str, Any]:
    """What the stages do, and a row of medians per group and back end."""
    runs = [run for group in every for rs in group.runs.values() for run in rs]
    known = ["total", *stages(stage for run in runs for stage in run.milliseconds)]
    rows = []
    for group in every:
        for backend, own in group.runs.items():
            cells = []
            for stage in known:
                values = [run.milliseconds[stage] for run in own if stage in run.milliseconds]
                cells.append(f"{np.median(values):.2f}" if values else "–")
            rows.append((group.sequence, group.variant.name, group.mode, backend, *cells))
    return {"stages": ["whole frame", *map(stage_name, known[1:])], "times": rows}


def _run_keys(runs: Sequence[Run]) -> list[str]:
    return list(dict.fromkeys(key for run in runs for key in run.metrics))


def _run_row(run: Run, keys: Sequence[str]) -> tuple[str, ...]:
    t = run.trial
    head = (t.sequence, t.variant.name, t.variant.frontend, t.mode, str(t.seed), t.backend, run.outcome)
    return (*head, *(number(run.metrics.get(key, float("nan"))) for key in keys))


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


def _command(plan: Plan) -> str:
    return f"{plan.command()} --out DIR"


def _embedded(svg: str) -> str:
    return "data:image/svg+xml;base64," + base64.b64encode(svg.encode()).decode()


def _script() -> Any:
    from markupsafe import Markup

    return Markup((_TEMPLATES / "map3d.js").read_text(encoding="utf-8"))
