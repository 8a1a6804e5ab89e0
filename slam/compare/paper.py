"""A comparison for papers: tables and figures for LaTeX, the same bytes for the same runs."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from slam.compare.figures import as_pdf, pictures
from slam.compare.measure import Metric
from slam.compare.plan import Plan, folder_name, is_world, short_name
from slam.compare.report import TEMPLATES
from slam.compare.statistics import FEWEST, LEVEL, Difference
from slam.compare.sweep import Run
from slam.compare.tables import Group, count_tests, groups, mean_figures
from slam.compare.wording import measurements, shown_interval, shown_mean, shown_p, shown_spread
from slam.files import whole_file, write_text
from slam.naming import printable

FOLDER = "figures"

_WIDE = 5  # columns from which on a table goes over both columns of a page
_INTERVALS = 2  # back ends whose intervals a page has room for

#: What LaTeX reads otherwise, and what older engines lack.
_LATEX = str.maketrans(
    {
        **{c: f"\\{c}" for c in "_&%#${}"},
        "\\": "\\textbackslash{}", "~": "\\textasciitilde{}", "^": "\\textasciicircum{}",
        "<": "$<$", ">": "$>$", "−": "$-$", "×": "$\\times$", "±": "$\\pm$", "σ": "$\\sigma$", "≤": "$\\leq$",
        "–": "--", "…": "\\ldots{}", "·": "$\\cdot$", "²": "$^2$", "³": "$^3$", "ᴺ": "$^N$", "→": "$\\to$",
    }
)  # fmt: skip


def write_paper(plan: Plan, runs: Sequence[Run], out: Path) -> None:
    """Write ``tables.tex``, ``figures.tex`` and the pictures as ``figures/*.pdf``.

    Every caption says which measurements the back ends were given. Only ``figures/*_time.pdf`` depends on the machine.
    """
    from jinja2 import Environment, FileSystemLoader

    every = groups(plan, runs)
    tests = count_tests(every)
    made = [table for group in every for table in (means_table(group), differences_table(group, tests)) if table]
    (out / FOLDER).mkdir(exist_ok=True)
    shown = [figure for group in every for figure in _figures(group, out / FOLDER)]
    environment = Environment(
        loader=FileSystemLoader(TEMPLATES), trim_blocks=True, keep_trailing_newline=True, block_start_string="<%",
        block_end_string="%>", variable_start_string="<<", variable_end_string=">>",
    )  # fmt: skip
    for name, rows in (("tables", made), ("figures", shown)):
        write_text(out / f"{name}.tex", environment.get_template(f"{name}.tex.j2").render(**{name: rows}))


def means_table(group: Group) -> dict[str, Any]:
    """Mean, standard deviation and confidence interval of every figure of each back end; of one trial its figures.

    There are no intervals of fewer than `FEWEST` trials, nor of more than two back ends, for which a page has no room.
    """
    names = list(group.runs)
    intervals = group.trials >= FEWEST and len(names) <= _INTERVALS
    level = f"{round(100 * LEVEL)} % CI"
    head = [cell for name in names for cell in ([name, level] if intervals else [name])]
    rows = [[m.title, *(cell for b in names for cell in _mean_cells(group, b, m, intervals))] for m in group.shown]
    trials = f"{group.trials} trials"
    if any(map(group.failures, names)):
        trials = f"the completed of {trials}"
    says = "one trial" if group.trials == 1 else f"mean ± standard deviation over {trials}"
    if intervals:
        says += f", and the {level} of the mean (bootstrap, BCa)"
    return _table(group, "means", "r" * len(head), ["figure", *head], rows, says)


def differences_table(group: Group, tests: int) -> dict[str, Any] | None:
    """Effect, interval and p of every figure that has a better side, each other back end against the first.

    Figures that are the same in all pairs are left out. None where none is left, as with one pair.

    Args:
        group: the runs.
        tests: that p is adjusted for.
    """
    first, *others = group.runs
    rows = [
        [metric.title, other, *_difference_cells(d)]
        for metric in group.shown
        for other, d in group.differences(metric).items()
        if metric.better and d.varies
    ]
    if not rows:
        return None
    level = f"{round(100 * LEVEL)} %"
    head = ["figure", "back end", "difference", f"{level} CI", "p", "p, Holm", "pairs"]
    says = (
        f"mean paired difference, {' and '.join(others)} less {first} (for figures that should be 1, the ratio of the "
        f"factors by which the two are off), with its {level} bootstrap confidence interval (BCa); p of the two-sided "
        f"sign-flip permutation test, and adjusted by Holm's method over {tests} tests"
    )
    return _table(group, "differences", "lrlrrr", head, rows, says)


def latex(text: str) -> str:
    """Plain text for LaTeX."""
    return printable(text).translate(_LATEX)


def _table(
    group: Group, kind: str, columns: str, head: Sequence[str], rows: Sequence[Sequence[str]], says: str
) -> dict[str, Any]:
    """What the template needs; a wide table goes over both columns of a page that has two."""
    return {
        "kind": "table*" if len(head) >= _WIDE else "table",
        "caption": f"{_what(group)}: {latex(says)}. {_given(group)}.",
        "label": f"tab:{_label(group)}_{kind}",
        "columns": f"l{columns}",
        "head": list(map(latex, head)),
        "rows": [list(map(latex, row)) for row in rows],
    }


def _mean_cells(group: Group, backend: str, metric: Metric, intervals: bool) -> list[str]:
    mean, sd, low, high = mean_figures(group.finite(backend, metric.key))
    shown = " ".join(part for part in shown_spread(metric, mean, sd) if part)
    bounds = [shown_spread(metric, bound, float("nan"))[0] for bound in (low, high)]
    return [shown, f"[{', '.join(bounds)}]" if "–" not in bounds else "–"] if intervals else [shown]


def _difference_cells(d: Difference) -> list[str]:
    interval = shown_interval(d, ", ")
    return [
        shown_mean(d), interval if interval == "–" else f"[{interval}]", shown_p(d.p), shown_p(d.p_holm), str(d.pairs),
    ]  # fmt: skip


def _figures(group: Group, folder: Path) -> list[dict[str, str]]:
    """Write a group's pictures; what the template needs of each."""
    found = []
    for picture in pictures(group):
        name = f"{_label(group)}_{picture.name}"
        with whole_file(folder / f"{name}.pdf") as file:
            file.write(as_pdf(picture.draw(), f"{picture.title}: {group.sequence}, {group.mode}"))
        caption = f"{_what(group)}: {latex(picture.caption)} {_given(group)}."
        found.append({"name": name, "file": f"{FOLDER}/{name}", "caption": caption})
    return found


def _what(group: Group) -> str:
    """The sequence, which may go on in the next line behind a sign, and the variant."""
    variant = "" if group.variant.name == "surf" else f", {latex(group.variant.name)}"
    shown = group.sequence if is_world(group.sequence) else folder_name(group.sequence)
    name = re.sub(r"([:?/=_,-]|\\&|\\_)", r"\1\\allowbreak{}", latex(shown))
    return f"\\texttt{{{name}}}{variant}"


def _given(group: Group) -> str:
    return latex(measurements(group.mode, next(iter(group.runs))))


def _label(group: Group) -> str:
    return "_".join([short_name(group.sequence), short_name(group.variant.name), group.mode.replace(" ", "_")])
