"""A comparison for papers: tables and figures for LaTeX, the same bytes for the same runs."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from slam.compare.figures import as_pdf, pictures
from slam.compare.measure import Metric
from slam.compare.plan import Plan, folder_name, is_world, short_name
from slam.compare.statistics import FEWEST, LEVEL, Difference
from slam.compare.sweep import Run
from slam.compare.tables import Group, count_tests, groups, mean_figures
from slam.compare.wording import decimals, measurements, shown_interval, shown_mean, shown_p
from slam.files import whole_file, write_text
from slam.naming import printable

TABLES, FIGURES, FOLDER = "tables.tex", "figures.tex", "figures"

_HEAD = "% Written by slam compare. Needs: \\usepackage{{{}}}\n"

_COLUMN = 237.0  # [pt] of a page that has two, in usual classes
_TEXT = {"\\small": 4.3, "\\footnotesize": 3.95}  # [pt] mean width of a letter, measured
_GAP = 8.0  # [pt] between columns
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
    """Write ``tables.tex`` (booktabs, graphicx), ``figures.tex`` (graphicx) and the pictures as ``figures/*.pdf``.

    Every caption says which measurements the back ends were given. Only ``figures/*_time.pdf`` depends on the machine.
    """
    every = groups(plan, runs)
    tests = count_tests(every)
    tables = [table for group in every for table in (means_table(group), differences_table(group, tests)) if table]
    write_text(out / TABLES, _HEAD.format("booktabs,graphicx") + "\n" + "\n".join(tables))
    (out / FOLDER).mkdir(exist_ok=True)
    shown = [text for group in every for text in _figures(group, out / FOLDER)]
    write_text(out / FIGURES, _HEAD.format("graphicx") + "\n" + "\n".join(shown))


def means_table(group: Group) -> str:
    """Mean, standard deviation and confidence interval of every figure of each back end; of one trial its figures.

    There are no intervals of fewer than `FEWEST` trials, nor of more than two back ends, for which a page has no room.
    """
    names, label = list(group.runs), f"tab:{_label(group)}_means"
    if group.trials == 1:
        rows = [[latex(m.title), *(_value_cell(group, name, m) for name in names)] for m in group.shown]
        caption = f"{_what(group)}: one trial. {_given(group)}."
        return _table("l" + "r" * len(names), ["figure", *map(latex, names)], rows, caption, label)
    rows = [[latex(m.title), *(_mean_cells(group, name, m) for name in names)] for m in group.shown]
    spread = f"{_what(group)}: mean $\\pm$ standard deviation over {_trials(group)}"
    if not _has_intervals(group):
        head, caption = ["figure", *map(latex, names)], f"{spread}. {_given(group)}."
        return _table("l" + "r" * len(names), head, rows, caption, label)
    level = f"{round(100 * LEVEL)} \\%"
    head = ["figure", *(f"{latex(name)} & {level} CI" for name in names)]
    caption = f"{spread}, and the {level} bootstrap confidence interval (BCa) of the mean. {_given(group)}."
    return _table("l" + "rl" * len(names), head, rows, caption, label)


def differences_table(group: Group, tests: int) -> str:
    """Effect, interval and p of every figure that has a better side, each other back end against the first.

    Figures that are the same in all pairs are left out. Empty where none is left, as with one pair.

    Args:
        group: the runs.
        tests: that p is adjusted for.
    """
    first, *others = group.runs
    rows = []
    for metric in group.shown:
        for other, d in group.differences(metric).items():
            if metric.better and d.varies:
                rows.append([latex(metric.title), *([latex(other)] if len(others) > 1 else []), *_difference_cells(d)])
    if not rows:
        return ""
    head = ["figure", *(["back end"] if len(others) > 1 else []), "difference", f"{round(100 * LEVEL)} \\% CI"]
    head += ["$p$", "$p_\\mathrm{Holm}$", "pairs"]
    caption = (
        f"{_what(group)}: mean paired difference, {' and '.join(map(latex, others)) or 'other'} less {latex(first)} "
        "(for figures that should be 1, the ratio of the factors by which the two are off), with its "
        f"{round(100 * LEVEL)} \\% bootstrap confidence interval (BCa). $p$: two-sided sign-flip permutation test, and "
        f"adjusted by Holm's method over {tests} tests. {_given(group)}."
    )
    columns = "ll" if len(others) > 1 else "l"
    return _table(columns + "rlrrr", head, rows, caption, f"tab:{_label(group)}_differences")


def latex(text: str) -> str:
    """Plain text for LaTeX."""
    return printable(text).translate(_LATEX)


def _figures(group: Group, folder: Path) -> Iterable[str]:
    """Write a group's pictures; a figure environment for each."""
    for picture in pictures(group):
        name = f"{_label(group)}_{picture.name}"
        caption = f"{_what(group)}: {_lower(latex(picture.caption))} {_given(group)}."
        with whole_file(folder / f"{name}.pdf") as file:
            file.write(as_pdf(picture.draw(), f"{picture.title}: {group.sequence}, {group.mode}"))
        yield (
            "\\begin{figure}\n  \\centering\n"
            f"  \\includegraphics[width=\\linewidth]{{{FOLDER}/{name}}}\n"
            f"  \\caption{{{caption}}}\n  \\label{{fig:{name}}}\n\\end{{figure}}\n"
        )


def _table(columns: str, head: Sequence[str], rows: Sequence[Sequence[str]], caption: str, label: str) -> str:
    """A table as large as its column has room for; a wide one goes over both columns of a page that has two.

    Where even a page is narrower, the table is made smaller.
    """
    cells = [" & ".join(row).split(" & ") for row in (head, *rows)]
    letters = sum(max(map(_letters, column)) for column in zip(*cells))
    fits = [size for size, letter in _TEXT.items() if letter * letters + _GAP * len(columns) < _COLUMN]
    kind, size = ("table", fits[0]) if fits else ("table*", "\\footnotesize")
    lines = [" & ".join(row) + " \\\\" for row in rows]
    return "\n    ".join(
        [
            f"\\begin{{{kind}}}\n  \\centering\n  {size}\n  \\setlength{{\\tabcolsep}}{{4pt}}\n"
            f"  \\caption{{{caption}}}\n  \\label{{{label}}}\n  \\smallskip\n"
            f"  \\resizebox{{\\ifdim\\width>\\linewidth\\linewidth\\else\\width\\fi}}{{!}}{{%\n"
            f"  \\begin{{tabular}}{{{columns}}}",
            "\\toprule",
            " & ".join(head) + " \\\\",
            "\\midrule",
            *lines,
            f"\\bottomrule\n  \\end{{tabular}}}}\n\\end{{{kind}}}\n",
        ]
    )


def _letters(cell: str) -> int:
    """How many letters wide a cell is, about."""
    return len(re.sub(r"\\[a-z]+(\{\})?|[\\${}]", lambda found: "" if found[0] in "\\${}" else "+", cell))


def _value_cell(group: Group, backend: str, metric: Metric) -> str:
    """The figure of the one trial."""
    value = metric.scale * mean_figures(group.finite(backend, metric.key))[0]
    return f"${value:.{decimals(value)}f}$" if np.isfinite(value) else "--"


def _has_intervals(group: Group) -> bool:
    return group.trials >= FEWEST and len(group.runs) <= _INTERVALS


def _trials(group: Group) -> str:
    """How many trials, and whether each back end completed all."""
    most = max(group.failures(backend) for backend in group.runs)
    return f"{group.trials} trials" if not most else f"the completed of {group.trials} trials"


def _mean_cells(group: Group, backend: str, metric: Metric) -> str:
    mean, sd, low, high = (metric.scale * x for x in mean_figures(group.finite(backend, metric.key)))
    if not np.isfinite(mean):
        return "-- & --" if _has_intervals(group) else "--"
    digits = decimals(mean)
    shown = [f"${x:.{digits}f}$" if np.isfinite(x) else "--" for x in (mean, sd, low, high)]
    spread = f"{shown[0]} $\\pm$ {shown[1]}" if np.isfinite(sd) else shown[0]
    if not _has_intervals(group):
        return spread
    return f"{spread} & [{shown[2]}, {shown[3]}]" if np.isfinite(low) else f"{spread} & --"


def _difference_cells(d: Difference) -> list[str]:
    interval = shown_interval(d, ", ")
    bounds = latex(interval if interval == "–" else f"[{interval}]")
    return [
        latex(shown_mean(d)),
        bounds,
        *(latex(shown_p(p)) if d.varies else "--" for p in (d.p, d.p_holm)),
        str(d.pairs),
    ]


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


def _lower(text: str) -> str:
    """A sentence that goes on after a colon; abbreviations stay."""
    return text if text[1:2].isupper() else text[0].lower() + text[1:]
