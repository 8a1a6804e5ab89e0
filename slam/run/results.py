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
    """One figure."""

    key: str  # column of the tables
    label: str  # for people
    unit: str = ""  # in which people see it
    scale: float = 1.0  # of that unit, by the unit of the key
    better: str = ""  # "lower", "higher", "one" (1 is honest; both ways off is worse), or "" (neither)
    place: tuple[str, ...] = ()  # keys of a summary one below the other; empty where it is not simply there
    main: bool = False  # one of those that a comparison's conclusions speak of

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


_MM, _PERCENT, _DEG = ("mm", 1e3), ("%", 100.0), ("deg", 1.0)
_ONLINE, _HONEST, _MOVING = ("accuracy", "online"), ("consistency",), ("objects", "features")

#: NEES by key, the best to judge by first (errors from the start add up): over what, name in a summary, main or not.
_NEES = {
    "nees_10m_per_dof": ("over 10 m", "NEES over 10 m", True),
    "nees_1m_per_dof": ("over 1 m", "NEES over 1 m", False),
    "nees_per_dof": ("from the start", "mean NEES", True),
    "nees_100m_per_dof": ("over 100 m", "NEES over 100 m", False),
}
_FEW = 0.5  # a NEES over less than this share of the stretches is no figure: they are hardly a fair choice

#: Share of the runs that came to their end: known of every run, also of those that have no other figure.
COMPLETED = Metric("completed", "runs completed", *_PERCENT, "higher", (), True)

#: In the order of a comparison's tables. Times are apart: they differ from run to run.
METRICS = (
    Metric("ate_online_m", "online path error (ATE)", *_MM, "lower", (*_ONLINE, "ATE RMSE [m]"), True),
    Metric("ate_final_m", "final path error (ATE)", *_MM, "lower", ("accuracy", "final", "ATE RMSE [m]"), True),
    Metric("ate_without_loops_m", "path error without loops (ATE)", *_MM, "lower",
           ("accuracy", "online without loops", "ATE RMSE [m]")),
    Metric("loops_closed", "loops closed", place=("loops", "closed")),
    Metric("loops_refused", "loops refused", place=("loops", "refused")),
    Metric("rpe_1s_m", "drift in 1 s (RPE)", *_MM, "lower", (*_ONLINE, "RPE RMSE over 1 s [m]")),
    Metric("rpe_1s_deg", "drift in 1 s, rotation (RPE)", *_DEG, "lower",
           (*_ONLINE, "RPE rotation RMSE over 1 s [deg]")),
    Metric("segment_percent", "drift by distance (RPE)", "%", 1.0, "lower", (*_ONLINE, "segment error [%]")),
    Metric("scale_error_percent", "scale error", "%", 1.0, "lower", (*_HONEST, "scale error [%]")),
    *(Metric(key, f"NEES / 6 {over} (1 is right)", "", 1.0, "one", (*_HONEST, name), main)
      for key, (over, name, main) in _NEES.items()),
    Metric("nis_per_dof", "NIS / dof (up to 1 is right)", place=(*_HONEST, "NIS per degree of freedom")),
    Metric("landmark_error_m", "median landmark error", *_MM, "lower", (), True),
    Metric("association_precision", "association precision", *_PERCENT, "higher"),
    Metric("tracked", "frames tracked", *_PERCENT, "higher", (), True),
    Metric("map_size", "landmarks in the map, mean"),
    Metric("moving_precision", "moving features, precision", *_PERCENT, "higher", (*_MOVING, "precision")),
    Metric("moving_recall", "moving features, recall", *_PERCENT, "higher", (*_MOVING, "recall")),
    Metric("body_coverage", "moving bodies, frames found", *_PERCENT, "higher"),
    Metric("body_error_m", "motion of a body, error", *_MM, "lower"),
    Metric("body_error_deg", "motion of a body, rotation error", *_DEG, "lower"),
    Metric("body_nees_per_dof", "NEES / 6 of bodies (1 is right)", "", 1.0, "one"),
)  # fmt: skip

BY_KEY = {metric.key: metric for metric in METRICS}

#: The rows of a run's own table, below "frames tracked"; those of `METRICS` by their keys.
_OF_RUN = (
    Metric("path_m", "path length", "m", place=("path_length_m",)),
    Metric("speed", "speed, median", "m/s", place=("speed_m_per_s",)),
    Metric("landmarks", "landmarks in the map at the end", place=("landmarks",)),
    Metric("bodies", "moving bodies found", place=("bodies",)),
    *(BY_KEY[key] for key in ("body_coverage", "body_error_m", "loops_closed", "ate_online_m", "ate_final_m",
                              "rpe_1s_m", "segment_percent")),
    Metric("sigma_m", "claimed σ of the last position", *_MM, place=("final_sigma_m",)),
    Metric("ratio", "errors over claimed σ (1 is right)"),
    Metric("dropped", "frames dropped", place=("live", "frames dropped")),
    Metric("behind", "behind, median", "ms", place=("live", "milliseconds behind", "median")),
    Metric("behind_most", "behind, most", "ms", place=("live", "milliseconds behind", "max")),
    Metric("milliseconds", "time of a frame, median", "ms", place=("milliseconds", "median_total")),
    Metric("compiling", "compiling, once", "s", place=("compile_seconds",)),
)  # fmt: skip
_COMPILED = 0.05  # compile times below this [s] are not worth a row
_IN_PICTURE = ("path_m", "speed", "bodies", "loops_closed", "ate_online_m", "sigma_m")

#: Figures of moving bodies, which are means over these, by their place in what is said of one.
_OF_BODIES = {
    "body_coverage": ("coverage",),
    "body_error_m": ("ME", "translation median [m]"),
    "body_error_deg": ("ME", "rotation median [deg]"),
    "body_nees_per_dof": ("mean NEES",),
}


#: Why no NEES is known: in the map of an earlier run, and elsewhere.
_IN_MAP = (
    "covariances are not judged in a prior map: all poses share its errors, which the truth of this run does not tell"
)
_NOT_JUDGED = (
    "covariances cannot be judged: they leave none for the motion between two poses, as where a back end claims the "
    "same one for every frame"
)
_DOUBTFUL = "covariances cannot be judged: the true path is doubtful, as where it was interpolated over a gap"


def rows(summaries: Sequence[Mapping[str, Any]]) -> Iterator[tuple[str, list[str]]]:
    """The table of some runs for people: label with unit, and a text per run; what no run has is left out."""
    yield "frames tracked", list(map(_tracked, summaries))
    found = list(map(_of_run, summaries))
    for metric in _OF_RUN:
        if any(metric.key in one for one in found):
            yield metric.title, [metric.show(one.get(metric.key, np.nan)) for one in found]


def facts(summary: Mapping[str, Any]) -> str:
    """What a run found, also where there is no truth, and whether its covariances hold, for the head of a picture."""
    found = _of_run(summary) if summary else {}
    shown = [m for m in _OF_RUN if m.key in _IN_PICTURE and found.get(m.key)]
    words = [f"{m.label} {_length(found[m.key], m)}".rstrip() for m in shown]
    return "; ".join([*words, *filter(None, [re.sub(r" \([^)]*\)", "", verdict_of_run(summary))])])


def _length(value: float, metric: Metric) -> str:
    """A figure with its unit; lengths and speeds below a tenth of a metre in millimetres."""
    small = metric.unit.startswith("m") and metric.scale == 1.0 and value < 0.1
    return f"{number(1e3 * value)} m{metric.unit}" if small else f"{metric.show(value)} {metric.unit}"


def _of_run(summary: Mapping[str, Any]) -> dict[str, float]:
    """The figures of a run's own table, by key."""
    found = _placed(_OF_RUN, summary) | figures(summary)
    ratios = _ratios(found)
    left_out = [key for key, least in (("compiling", _COMPILED), ("loops_closed", 0)) if not found.get(key, 0) > least]
    found |= {"ratio": next(iter(ratios.values()))} if ratios else {}
    return {key: value for key, value in found.items() if key not in left_out}


def _tracked(summary: Mapping[str, Any]) -> str:
    """How many frames had a measured pose, and what became of the others; the first one starts the map."""
    others = [f"{n} {name}" for name, n in summary["status"].items() if name not in ("tracked", "started")]
    return ", ".join([f"{_measured(summary)} of {summary['frames']}", *others])


def _measured(summary: Mapping[str, Any]) -> int:
    status = summary.get("status", {})
    return int(status.get("tracked", 0) + status.get("started", 0))


def _at(tree: Any, place: Sequence[str]) -> float | None:
    """The number at a place of a summary; None where there is none."""
    for key in place:
        tree = tree.get(key) if isinstance(tree, Mapping) else None
    return None if tree is None or isinstance(tree, Mapping) else float(tree)


def _placed(metrics: Sequence[Metric], summary: Mapping[str, Any]) -> dict[str, float]:
    """What a summary says of some figures that have a place in it, by key."""
    values = ((metric.key, _at(summary, metric.place)) for metric in metrics if metric.place)
    return {key: value / (6 if key in _NEES else 1) for key, value in values if value is not None}


def figures(summary: Mapping[str, Any]) -> dict[str, float]:
    """What a run's summary says, by key of `METRICS`; what it does not say is left out."""
    found = _placed(METRICS, summary)
    for key, (over, _, _) in _NEES.items():
        if (_at(summary, (*_HONEST, f"no covariance {over}")) or 0.0) > _FEW:
            found.pop(key, None)
    if "scale_error_percent" in found:
        found["scale_error_percent"] = abs(found["scale_error_percent"])
    if not found.get("loops_closed", 0) + found.get("loops_refused", 0):
        found = {key: value for key, value in found.items() if not key.startswith("loops")}
    if frames := summary.get("frames", 0):
        found["tracked"] = _measured(summary) / frames
    moved = [body for body in summary.get("objects", {}).get("bodies", {}).values() if body["frames in view"]]
    if not moved:  # what is found of nothing is no figure
        return {key: value for key, value in found.items() if not key.startswith("moving_")}
    for key, place in _OF_BODIES.items():
        values = [value for body in moved if (value := _at(body, place)) is not None]
        if values:
            found[key] = float(np.mean(values)) / (6 if key.startswith("body_nees") else 1)
    return found


def _ratios(found: Mapping[str, float]) -> dict[str, float]:
    """How many times as large as claimed errors are, and over what; the one to judge by first."""
    known = ((over, found.get(key, np.nan)) for key, (over, _, _) in _NEES.items())
    return {over: float(np.sqrt(nees)) for over, nees in known if np.isfinite(nees)}


def verdict(found: Mapping[str, float], runs: int = 1) -> str:
    """Whether covariances are as large as the errors, by which figure and which band; empty where no NEES is known.

    Args:
        found: `figures` of a run, or their means over several.
        runs: how many. The band is that of as many independent values: it holds even if all frames of a run are as good
            as one, which errors of the rig make them.
    """
    low, high = (np.sqrt(bound / 6) for bound in chi_square_band(6, max(runs, 1)))
    ratios = _ratios(found)
    if not ratios:
        return ""
    said = {over: "too small" if r > high else "too large" if r < low else "right" for over, r in ratios.items()}
    judged, ratio = next(iter(ratios.items()))
    others = [f"{over} {number(ratios[over])} times: {word}" for over, word in said.items() if word != said[judged]]
    word = f"are {said[judged]}" if said[judged] != "right" else "hold in part" if others else "hold"
    of = "runs" if runs == 1 else f"means of {runs} runs"
    times = f"{judged} errors of the pose are {number(ratio)} times what they claim"
    band = f"({low:.2f} to {high:.2f} in 95 % of {of})"
    return "; ".join([f"covariances {word}: {times} {band}", *others])


def verdict_of_run(summary: Mapping[str, Any]) -> str:
    """`verdict` on a run by its summary, with what it leaves out; empty where no true path is known."""
    text, honest = verdict(figures(summary)), summary.get("consistency") or {}
    doubtful = {over: honest.get(f"doubtful truth {over}", 0.0) for over, _, _ in _NEES.values()}
    doubtful = {over: share for over, share in doubtful.items() if share}
    if not text:
        known = bool(_at(summary, ("loops", "known")))
        return "" if not honest.get("dof") else _IN_MAP if known else _DOUBTFUL if doubtful else _NOT_JUDGED
    if "are too large" in text and honest.get(EXACT):
        text += "; they count errors of the calibration, and this world's cameras have none"
    if doubtful:
        over, share = next(iter(doubtful.items()))
        text += f"; not judged: {100 * share:.0f} % of the stretches {over}, where the true path is doubtful"
    if left_out := summary["frames"] - _measured(summary):
        text += f"; not judged: {left_out} of {summary['frames']} frames, whose pose was not measured"
    return text
