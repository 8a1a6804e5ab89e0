"""The report of a comparison: one HTML file with everything in it, for a phone and for a wide screen."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from slam.compare import figures
from slam.compare.measure import Metric
from slam.compare.plan import Plan
from slam.compare.statistics import Difference, Verdict, caution, sentence
from slam.compare.sweep import SWEEP, Run
from slam.compare.tables import RUN_COLUMNS, Group, groups

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
        caution=caution(plan.trials),
        comparisons=sum(len(g.metrics) * (len(plan.backends) - 1) for g in every),
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


def conclusions(every: Sequence[Group]) -> list[tuple[str, list[str]]]:
    """What can be said of each group in its main figures, and which runs failed, under the group's name."""
    return [(_name(group), _conclusions(group)) for group in every]


def _conclusions(group: Group) -> list[str]:
    first = next(iter(group.runs))
    failures = ", ".join(f"{n} of {group.trials} of {b}" for b in group.runs if (n := group.failures(b)))
    lines = []
    if failures:
        lines = [
            f"Runs failed, {failures}: a trial in which either failed has no difference; look at the failures first."
        ]
    for metric in [m for m in group.metrics if m.main]:
        lines += [sentence(d, first, b) for b, d in group.differences(metric).items()]
    return lines


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
        "trials": group.trials,
        "failures": [group.failures(b) for b in group.runs],
        "rows": [_row(group, metric, compared[metric]) for metric in group.metrics],
        "sentences": [
            sentence(d, first, b) for metric in group.metrics if metric.better for b, d in compared[metric].items()
        ],
        "reasons": sorted(reasons),
    }


def _row(group: Group, metric: Metric, differences: dict[str, Difference]) -> dict[str, Any]:
    means = []
    for backend in group.runs:
        values = group.values(backend, metric.key)
        means.append(metric.show(float(np.nanmean(values))) if np.isfinite(values).any() else "–")
    return {"label": metric.title, "means": means, "differences": [_cells(d) for d in differences.values()]}


def _cells(d: Difference) -> dict[str, str]:
    """A difference's three cells; the verdict names the better one where there is one."""
    show = (lambda x: f"{x:.3g}") if d.metric.better == "one" else d.metric.show
    interval = f"{show(d.low)} … {show(d.high)}" if np.isfinite(d.low) else "–"
    words = _WORDS[d.verdict]
    if d.better is not None and d.verdict in (Verdict.CERTAIN, Verdict.LIKELY, Verdict.HINT):
        words = f"{'better' if d.better else 'worse'}: {words}"
    return {"mean": show(d.mean), "interval": interval, "verdict": d.verdict.value, "words": words}


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
        text = f"Error of the position, seed {seed}, inside the ±3σ that each back end claims."
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
    return (*head, *(_figure(run.metrics.get(key, float("nan"))) for key in keys))


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


def _figure(value: float) -> str:
    if not np.isfinite(value):
        return "–"
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"
