"""The pictures of a comparison, for its report."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from slam.compare.plan import is_world
from slam.compare.sweep import Run
from slam.compare.tables import Group
from slam.run.panels import backend_colours
from slam.run.plots import drawn
from slam.run.results import BY_KEY
from slam.run.run_data import RunData

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MOST_TICKS = 15
_SHORT = 20  # letters of names that stand side by side
_WIDTH = 5.2  # [in] about that of a phone: text stays readable where the picture fills the screen


def pictures(group: Group) -> Iterator[tuple[str, str, str]]:
    """Title, caption and SVG of a group's pictures, as far as there is truth; none where every run failed."""
    shown = _example(group)
    if not shown:
        return
    runs = [RunData.read(run.folder, backend) for backend, run in shown.items()]
    trial = next(iter(shown.values())).trial
    of_seed = f", seed {trial.seed}" if is_world(trial.sequence) else ""
    known = {metric.key for metric in group.metrics}
    if "ate_online_m" in known and group.trials > 1:
        label = BY_KEY["ate_online_m"].label
        text = f"{label}, of every trial; lines join the back ends' runs on the same recording."
        yield label, text, _svg(_pairs(group))
    yield "Paths from above", f"Paths from above{of_seed}.", _svg(drawn(runs, "path"))
    if "nees_per_dof" in known:
        text = f"Error of the pose{of_seed} (solid), and the σ that each back end claims (dashed)."
        yield "Error over time", text, _svg(drawn(runs, "errors"))


def _example(group: Group) -> dict[str, Run]:
    """The first trial that every back end completed; else the first completed of each."""
    for runs in zip(*group.runs.values()):
        if all(run.completed for run in runs):
            return dict(zip(group.runs, runs))
    firsts = {backend: next((r for r in runs if r.completed), None) for backend, runs in group.runs.items()}
    return {backend: run for backend, run in firsts.items() if run is not None}


def _pairs(group: Group) -> Figure:
    """Each trial's errors, those of the back ends side by side and joined: whether differences are of one sign."""
    from matplotlib.figure import Figure

    metric = BY_KEY["ate_online_m"]
    figure = Figure((_WIDTH, 2.6), layout="constrained")
    axis = figure.subplots()
    values = np.array([metric.scale * group.values(name, metric.key) for name in group.runs])
    backends, trials = values.shape
    x = np.arange(trials) + (np.linspace(-0.25, 0.25, backends) if backends > 1 else np.zeros(1))[:, None]
    axis.plot(x, values, color="0.7", lw=1, zorder=1)
    for at, value, name, colour in zip(x, values, group.runs, backend_colours(list(group.runs))):
        axis.plot(at, value, "o", color=colour, ms=4, alpha=0.8, label=name)
    axis.set(xlim=(-0.5, trials - 0.5), xticks=range(0, trials, -(-trials // _MOST_TICKS)))
    axis.set(xlabel="seed", ylabel=metric.title)
    axis.spines[["top", "right"]].set_visible(False)
    low, high = float(np.nanmin(values, initial=np.inf)), float(np.nanmax(values, initial=1e-9))
    axis.set_ylim(0 if low < 0.5 * high else low - 0.1 * high, 1.1 * high)  # trifles are not blown up
    above = {"loc": "lower left", "bbox_to_anchor": (0, 1.0)}  # where it hides nothing
    axis.legend(frameon=False, fontsize=8, ncols=3 if max(map(len, group.runs)) < _SHORT else 2, **above)
    return figure


def _svg(figure: Figure) -> str:
    """A picture as SVG, the same for the same data."""
    from matplotlib import rc_context

    text = io.StringIO()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "slam"}):
        figure.savefig(text, format="svg", metadata={"Date": None})
    return text.getvalue()
