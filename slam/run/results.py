"""What the figures of a run are: the one table by which terminal, pictures and comparisons read its ``summary.json``.

A row has the figure's name, unit, place in the summary, and which way is better. What is computed, and how, is in
`slam.evaluation`. Whether covariances hold is judged here, for one run and for several.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from slam.evaluation.consistency import EXACT
from slam.evaluation.metrics import chi_square_band


@dataclass(frozen=True)
class Metric:
    """One figure of merit.

    Attributes:
        key: column of the tables.
        label: for people.
        better: ``"lower"``, ``"higher"``, ``"one"`` (1 is honest; both ways off is worse), or ``""`` (neither).
        main: one of those that a summary speaks of.
        unit: in which people see it.
        scale: of that unit, by the unit of the key.
        place: keys of a run's summary one below the other; empty where the summary does not have it.
    """

    key: str
    label: str
    better: str = ""
    main: bool = False
    unit: str = ""
    scale: float = 1.0
    place: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        """Label with unit."""
        return f"{self.label} [{self.unit}]" if self.unit else self.label

    def show(self, value: float) -> str:
        """A value for people."""
        return number(self.scale * value)


def number(value: float) -> str:
    """Three digits, with a minus sign that is one; a dash where there is no number."""
    if not np.isfinite(value):
        return "–"
    return (f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}").replace("-", "−")


#: Share of the runs that came to their end: known of every run, also of those that have no other figure.
COMPLETED = Metric("completed", "runs completed", "higher", True, "%", 100)

_ONLINE, _FINAL, _HONEST = ("accuracy", "online"), ("accuracy", "final"), ("consistency",)
_MM, _PERCENT, _FRAMES = ("mm", 1e3), ("%", 100.0), ("frames", 1.0)

#: NEES by key, the best to judge by first (errors from the start add up): over what, place, whether it is a main one.
_NEES = {
    "nees_10m_per_dof": ("over 10 m", "NEES over 10 m", True),
    "nees_1m_per_dof": ("over 1 m", "NEES over 1 m", False),
    "nees_per_dof": ("from the start", "mean NEES", True),
    "nees_100m_per_dof": ("over 100 m", "NEES over 100 m", False),
}
_FEW = 0.5  # a NEES over less than this share of the stretches is no figure: they are hardly a fair choice

#: In the order of the tables. Times are apart: they differ from run to run.
METRICS = (
    Metric("ate_online_m", "ATE RMSE, online", "lower", True, *_MM, (*_ONLINE, "ATE RMSE [m]")),
    Metric("ate_final_m", "ATE RMSE, final", "lower", True, *_MM, (*_FINAL, "ATE RMSE [m]")),
    Metric("ate_without_loops_m", "ATE RMSE, online, loops left out", "lower", False, *_MM,
           ("accuracy", "online without loops", "ATE RMSE [m]")),
    Metric("loops_closed", "loops closed", place=("loops", "closed")),
    Metric("loops_refused", "loops refused", place=("loops", "refused")),
    Metric("rpe_1s_m", "RPE RMSE over 1 s", "lower", False, *_MM, (*_ONLINE, "RPE RMSE over 1 s [m]")),
    Metric("rpe_1s_deg", "RPE RMSE over 1 s, rotation", "lower", False, "deg", 1.0,
           (*_ONLINE, "RPE rotation RMSE over 1 s [deg]")),
    Metric("segment_percent", "RPE by distance", "lower", False, "%", 1.0, (*_ONLINE, "segment error [%]")),
    Metric("scale_error_percent", "scale error, absolute", "lower", False, "%", 1.0, (*_HONEST, "scale error [%]")),
    Metric("scale_sigma_percent", "scale sigma (claimed)", "", False, "%", 1.0, (*_HONEST, "scale sigma [%]")),
    *(Metric(key, f"NEES / 6 {over} (1 is right)", "one", main, place=(*_HONEST, name))
      for key, (over, name, main) in _NEES.items()),
    *(Metric(f"{key}_left_out", f"stretches {over} not judged", "", False, *_PERCENT,
             (*_HONEST, f"no covariance {over}")) for key, (over, _, _) in _NEES.items() if over != "from the start"),
    Metric("nis_per_dof", "NIS / dof (up to 1 is right)",
           place=(*_HONEST, "NIS per degree of freedom")),
    Metric("landmark_error_m", "landmark error, median", "lower", True, *_MM),
    Metric("landmark_error_90_m", "landmark error, 90 % below", "lower", False, *_MM),
    Metric("association_precision", "association precision", "higher", False, *_PERCENT),
    Metric("tracked", "frames tracked", "higher", True, *_PERCENT),
    Metric("frames_lost", "frames lost", "", False, *_PERCENT),
    Metric("frames_predicted", "frames predicted", "", False, *_PERCENT),
    Metric("frames_failed", "frames failed", "", False, *_PERCENT),
    Metric("map_size", "landmarks in the map, mean"),
    Metric("used_per_frame", "observations used per frame"),
)  # fmt: skip

BY_KEY = {metric.key: metric for metric in METRICS}

#: Frames whose pose was not measured: they are in no figure of accuracy, and counted here. The share tracked is tested.
UNTRACKED = ("frames_lost", "frames_predicted", "frames_failed")

#: What a run's own table says besides, without a better or worse: above the other figures, and below them.
_ABOVE = (
    Metric("landmarks", "landmarks at the end", place=("landmarks",)),
    Metric("path_m", "path length", unit="m", place=("path_length_m",)),
    Metric("speed", "speed, median", unit="m/s", place=("speed_m_per_s",)),
    Metric("sigma_m", "σ of the last position", "", False, *_MM, ("final_sigma_m",)),
    Metric("bodies", "moving bodies found", place=("bodies",)),
)
_BELOW = (
    Metric("dropped", "frames dropped", place=("live", "frames dropped")),
    Metric("behind", "behind, median", unit="ms", place=("live", "milliseconds behind", "median")),
    Metric("behind_most", "behind, most", unit="ms", place=("live", "milliseconds behind", "max")),
    Metric("milliseconds", "stages of a frame, median", unit="ms", place=("milliseconds", "median_total")),
    Metric("rate", "frames per second", place=("frames_per_second",)),
    Metric("compiling", "kernels compiled, apart", unit="s", place=("compile_seconds",)),
)
_COMPILED = 0.05  # compile times below this [s] are not worth a row

#: Figures of a comparison that a run's own table leaves out: shares of its status, which it shows in words.
_NOT_OF_ONE_RUN = ("tracked", *UNTRACKED, "scale_sigma_percent")

#: Of a moving body, what a run's own table says.
_OF_BODIES = ("coverage", "ME translation median [m]", "ME rotation median [deg]")

_BODY_NEES = "NEES / degree of freedom"
_SHARES = ("precision", "recall", "F1", "coverage", "counted right")
_UNITS = {"m": _MM, "deg": ("deg", 1.0), "frames": _FRAMES}


def rows(summaries: Sequence[Mapping[str, Any]]) -> Iterator[tuple[str, list[str]]]:
    """The table of some runs for people: label with unit, and a text per run; what no run has is left out."""
    yield "frames tracked", list(map(_tracked, summaries))
    found = [_placed((*_ABOVE, *_BELOW), s) | figures(s) for s in summaries]
    for one in found:
        if not one.get("compiling", 0.0) > _COMPILED:
            one.pop("compiling", None)
    bodies = dict.fromkeys(
        key for f in found for key in f if key.startswith("object bodies") and key.endswith(_OF_BODIES)
    )
    for metric in (*_ABOVE, *METRICS, *map(object_metric, bodies), *_BELOW):
        values = [one.get(metric.key, float("nan")) for one in found]
        if metric.key not in _NOT_OF_ONE_RUN and np.isfinite(values).any():
            yield metric.title, list(map(metric.show, values))


def facts(summary: Mapping[str, Any]) -> str:
    """What a run found, also where there is no truth, and whether its covariances hold, in one line for a picture."""
    found = _placed(_ABOVE, summary) | figures(summary)
    shown = (*_ABOVE[1:], BY_KEY["loops_closed"], BY_KEY["loops_refused"])
    words = [f"{m.label} {m.show(found[m.key])} {m.unit}".rstrip() for m in shown if found.get(m.key)]
    return "; ".join([*words, *filter(None, [verdict_of_run(summary)])])


def _tracked(summary: Mapping[str, Any]) -> str:
    """How many frames had a measured pose, and what became of the others; the first one starts the map."""
    others = [f"{n} {name}" for name, n in summary["status"].items() if name not in ("tracked", "started")]
    return ", ".join([f"{_measured(summary)} of {summary['frames']}", *others])


def _measured(summary: Mapping[str, Any]) -> int:
    status = summary.get("status", {})
    return int(status.get("tracked", 0) + status.get("started", 0))


def _placed(metrics: Sequence[Metric], summary: Mapping[str, Any]) -> dict[str, float]:
    """What a summary says of some figures that have a place in it, by key."""
    found = {}
    for metric in metrics:
        tree: Any = summary if metric.place else None
        for key in metric.place:
            tree = tree.get(key) if isinstance(tree, Mapping) else None
        if tree is not None:
            found[metric.key] = float(tree) / (6 if metric.key in _NEES else 1)
    return found


def figures(summary: Mapping[str, Any]) -> dict[str, float]:
    """What a run's summary says, by key of `METRICS`, and ``object …`` figures; what it does not say is left out."""
    found = _placed(METRICS, summary)
    for key in _NEES:
        if found.get(f"{key}_left_out", 0.0) > _FEW:
            found.pop(key, None)
    if "scale_error_percent" in found:
        found["scale_error_percent"] = abs(found["scale_error_percent"])
    if not found.get("loops_closed", 0) + found.get("loops_refused", 0):
        found = {key: value for key, value in found.items() if not key.startswith("loops")}
    if frames := summary.get("frames", 0):
        status = summary.get("status", {})
        found["tracked"] = _measured(summary) / frames
        found |= {key: status.get(key.removeprefix("frames_"), 0) / frames for key in UNTRACKED}
        found["used_per_frame"] = summary.get("observations", {}).get("used", 0) / frames
    return {**found, **object_figures(summary)}


def verdict(found: Mapping[str, float], runs: int = 1) -> str:
    """Whether covariances are as large as the errors, by which figure and which band; empty where no NEES is known.

    Args:
        found: `figures` of a run, or their means over several.
        runs: how many. The band is that of as many independent values: it holds even if all frames of a run are as good
            as one, which errors of the rig make them.
    """
    low, high = (bound / 6 for bound in chi_square_band(6, max(runs, 1)))
    known = {over: found[key] for key, (over, _, _) in _NEES.items() if np.isfinite(found.get(key, np.nan))}
    if not known:
        return ""
    said = {w: "are too small" if v > high else "are too large" if v < low else "hold" for w, v in known.items()}
    judged = next(iter(known))
    others = [f"{w} {number(known[w])}: they {said[w]}" for w in known if said[w] != said[judged]]
    word = "hold in part" if others and said[judged] == "hold" else said[judged]
    of = "runs" if runs == 1 else f"means of {runs} runs"
    text = (
        f"covariances {word}: NEES / 6 {judged} is {number(known[judged])} ({low:.2f} to {high:.2f} in 95 % of {of}); "
        f"errors are {np.sqrt(known[judged]):.2f} times what they claim"
    )
    return "; ".join([text, *others])


def verdict_of_run(summary: Mapping[str, Any]) -> str:
    """`verdict` on a run by its summary, with what it leaves out; empty where no NEES is known."""
    text = verdict(figures(summary))
    if not text:
        return ""
    if "are too large" in text and summary["consistency"].get(EXACT):
        text += "; they count errors of the calibration, and this world's cameras have none"
    if left_out := summary["frames"] - _measured(summary):
        text += f"; not judged: {left_out} of {summary['frames']} frames, whose pose was not measured"
    return text


def object_metric(key: str) -> Metric:
    """A figure of moving objects by the key that `object_figures` gives it."""
    text = key.removeprefix("object ")
    label = f"objects: {text}"
    if body := re.match(r"bodies (\d+) (ME (\w+))?", text):
        label = f"body {body[1]}: {f'{body[3]} error,' if body[2] else ''}{text[body.end() :]}"
    if key.endswith(_SHARES):
        return Metric(key, label, "higher", False, *_PERCENT)
    if key.endswith(_BODY_NEES):
        return Metric(key, label, "one")
    name, bracket, unit = label.removesuffix("]").rpartition(" [")
    lower = "lower" if bracket or "false" in key else ""
    return Metric(key, name, lower, False, *_UNITS[unit]) if unit in _UNITS else Metric(key, label, lower)


def object_figures(summary: Mapping[str, Any]) -> dict[str, float]:
    """Plain numbers that a run's summary has on moving objects, where something detects them.

    What is found of the moving features has no value where no body has moved.
    """
    found = dict(_leaves("object", summary.get("objects")))
    for key in [key for key in found if key.endswith(" mean NEES")]:
        name = key.removesuffix("mean NEES")
        found[name + _BODY_NEES] = found.pop(key) / found.pop(name + "dof", 6.0)
    if not any(value for key, value in found.items() if key.endswith(" frames in view")):
        found = {key: value for key, value in found.items() if not key.endswith(("precision", "recall", "F1"))}
    return found


def _leaves(name: str, tree: Any) -> Iterator[tuple[str, float]]:
    """Numbers of a tree, named by the keys on the way to them."""
    if isinstance(tree, Mapping):
        for key, value in tree.items():
            yield from _leaves(f"{name} {key}", value)
    elif isinstance(tree, (int, float)) and not isinstance(tree, bool):
        yield name, float(tree)
