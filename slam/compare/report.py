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
from slam.compare.plan import Plan
from slam.compare.statistics import Difference, Verdict
from slam.compare.sweep import SWEEP, Run
from slam.compare.tables import RUN_COLUMNS, Group, groups
from slam.compare.wording import caution, failures, headline, sentence, shown_interval, shown_mean, worth_saying

_TEMPLATES = Path(__file__).parent / "templates"

_WORDS = {
    Verdict.CERTAIN: "certain",
    Verdict.LIKELY: "likely",
    Verdict.HINT: "a hint",
    Verdict.OPEN: "open",
    Verdict.EQUAL: "equal",
    Verdict.SINGLE: "one trial",
    Verdict.NONE: "none",
}


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
        caution=caution(most_trials(every)),
        comparisons=(len(plan.backends) - 1) * sum(bool(m.better) for g in every for m in g.metrics),
        sections=_sections(plan, every),
        workers=workers,
        **_times(every),
        run_columns=(*RUN_COLUMNS, *_run_keys(runs)),
        run_rows=[_run_row(run, _run_keys(runs)) for run in runs],
        command=_command(plan),
        versions=json.loads((out / SWEEP).read_text(encoding="utf-8"))["versions"],
        settings=_settings(every),
        script=_script(),
    )
    path = out / "report.html"
    part = path.with_suffix(".html.part")
    part.write_text(text, encoding="utf-8")
    part.replace(path)
    return path


@dataclass(frozen=True)
class Conclusions:
    """What can be said of a group in its main figures.

    Attributes:
        name: of the group.
        short: which runs failed, and a line on every other back end against the first.
        full: a sentence per figure.
    """

    name: str
    short: list[str]
    full: list[str]


def conclusions(every: Sequence[Group]) -> list[Conclusions]:
    """What can be said, group by group."""
    return [_conclusions(group) for group in every]


def most_trials(every: Sequence[Group]) -> int:
    """Trials of the group that has most: recorded sequences have one."""
    return max(group.trials for group in every)


def _conclusions(group: Group) -> Conclusions:
    first, *others = group.runs
    compared = [group.differences(metric) for metric in group.metrics]
    short, full = [failures({b: group.failures(b) for b in group.runs}, group.trials)], []
    for other in others:
        own = [differences[other] for differences in compared if worth_saying(differences[other])]
        short.append(headline(own, first, other))
        full += [sentence(d, first, other) for d in own]
    return Conclusions(_name(group), [line for line in short if line], full)


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
                "tables": [_table(group) for group in own],
                "pictures": _pictures(first),
                "map": figures.map_data(first) if figures.example(first) else None,
            }
        )
    return sections


def _table(group: Group) -> dict[str, Any]:
    words = {"closed loop": "each back end steers its own data association", "replay": "identical measurements"}
    first = next(iter(group.runs))
    compared = {metric: group.differences(metric) for metric in group.metrics}
    reasons = {f"{b}, seed {r.trial.seed}: {r.outcome}" for b, rs in group.runs.items() for r in rs if not r.completed}
    return {
        "title": f"{group.mode.capitalize()}: {words.get(group.mode, '')}",
        "rows": [_row(group, metric, compared[metric]) for metric in group.metrics],
        "sentences": [
            sentence(d, first, b) for metric in group.metrics if metric.better for b, d in compared[metric].items()
        ],
        "reasons": sorted(reasons),
    }


def _row(group: Group, metric: Metric, differences: dict[str, Difference]) -> dict[str, Any]:
    cells = [_cells(d) for d in differences.values()]
    if metric is COMPLETED:
        means = [f"{group.trials - group.failures(b)} of {group.trials}" for b in group.runs]
        return {"label": metric.label, "means": means, "failed": list(map(group.failures, group.runs)), "cells": cells}
    values = [group.values(backend, metric.key) for backend in group.runs]
    means = [metric.show(float(np.nanmean(v))) if np.isfinite(v).any() else "–" for v in values]
    return {"label": metric.title, "means": means, "failed": [0] * len(means), "cells": cells}


def _cells(d: Difference) -> dict[str, str]:
    """A difference's three cells; the verdict names the better one where there is one."""
    shown = {"mean": shown_mean(d), "interval": shown_interval(d)}
    words = _WORDS[d.verdict]
    if d.better is not None and d.verdict in (Verdict.CERTAIN, Verdict.LIKELY, Verdict.HINT):
        words = f"{'better' if d.better else 'worse'}: {words}"
    if not d.metric.better and d.verdict is not Verdict.EQUAL:
        return {**shown, "verdict": "none", "words": ""}
    return {**shown, "verdict": d.verdict.value, "words": words}


def _pictures(group: Group) -> list[dict[str, str]]:
    """Pictures of a group's closed loop, as far as there is truth."""
    if not figures.example(group):
        return []
    seed = next(iter(figures.example(group).values())).trial.seed
    known = {metric.key: metric for metric in group.metrics}
    main = known.get("ate_online_m") or known.get("gps_m")
    pictures = [(figures.draw_paths(group), "Paths from above", f"Paths from above, seed {seed}.")]
    if main is not None:
        text = f"{main.label} of every trial; lines join the back ends' runs on the same recording."
        pictures.insert(0, (figures.draw_pairs(group, main), main.label, text))
    if "nees_per_dof" in known:
        text = f"Error of the position, seed {seed}, and the ±3σ that each back end claims."
        pictures.append((figures.draw_errors(group), "Error over time", text))
        text = "NEES over time, mean of the trials, with the 95 % band in which an honest one lies."
        pictures.append((figures.draw_nees(group), "NEES over time", text))
    pictures.append((figures.draw_timing(group), "Time per stage", "Time per frame by stage, median."))
    return [{"source": _embedded(svg), "alt": alt, "caption": caption} for svg, alt, caption in pictures]


def _times(every: Sequence[Group]) -> dict[str, Any]:
    """Stages, and a row of medians per group and back end."""
    runs = [run for group in every for rs in group.runs.values() for run in rs]
    stages = [*dict.fromkeys(stage for run in runs for stage in run.milliseconds if stage != "total"), "total"]
    rows = []
    for group in every:
        for backend, own in group.runs.items():
            cells = []
            for stage in stages:
                values = [run.milliseconds[stage] for run in own if stage in run.milliseconds]
                cells.append(f"{np.median(values):.2f}" if values else "–")
            rows.append((group.sequence, group.variant.name, group.mode, backend, *cells))
    return {"stages": stages, "times": rows}


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
                shown[name] = json.loads(file.read_text(encoding="utf-8"))
    return json.dumps(shown, indent=1)


def _command(plan: Plan) -> str:
    return f"{plan.command()} --out DIR"


def _embedded(svg: str) -> str:
    return "data:image/svg+xml;base64," + base64.b64encode(svg.encode()).decode()


def _script() -> Any:
    from markupsafe import Markup

    return Markup((_TEMPLATES / "map3d.js").read_text(encoding="utf-8"))
