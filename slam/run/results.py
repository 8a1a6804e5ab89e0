"""What the figures of a run are: the one table that terminal, pictures and comparisons read its ``summary.json`` by.

A row has the figure's name, unit, place in the summary, and which way is better. What is computed, and how, is in
`slam.evaluation` and `slam.evaluation.objects`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np


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
        share_of: what its number there is divided by: a number, or the name of another one beside it.
    """

    key: str
    label: str
    better: str = ""
    main: bool = False
    unit: str = ""
    scale: float = 1.0
    place: tuple[str, ...] = ()
    share_of: float | str = 1.0

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
    Metric("segment_percent", "RPE by distance (segment error)", "lower", False, "%", 1.0,
           (*_ONLINE, "segment error [%]")),
    Metric("gps_m", "GPS distance RMSE", "lower", True, *_MM, (*_ONLINE, "GPS distance RMSE [m]")),
    Metric("scale_error_percent", "scale error, absolute", "lower", False, "%", 1.0, (*_HONEST, "scale error [%]")),
    Metric("scale_sigma_percent", "scale sigma (claimed)", "", False, "%", 1.0, (*_HONEST, "scale sigma [%]")),
    Metric("nees_per_dof", "NEES / 6 from the start (expected 1)", "one", True, place=(*_HONEST, "mean NEES"),
           share_of="dof"),
    Metric("nees_1m_per_dof", "NEES / 6 over 1 m (expected 1)", "one", place=(*_HONEST, "NEES over 1 m"),
           share_of="dof"),
    Metric("nees_10m_per_dof", "NEES / 6 over 10 m (expected 1)", "one", True, place=(*_HONEST, "NEES over 10 m"),
           share_of="dof"),
    Metric("nees_100m_per_dof", "NEES / 6 over 100 m (expected 1)", "one", place=(*_HONEST, "NEES over 100 m"),
           share_of="dof"),
    Metric("nis_per_dof", "NIS per degree of freedom (expected 1)", "one",
           place=(*_HONEST, "NIS per degree of freedom")),
    Metric("landmark_error_m", "landmark error, median", "lower", True, *_MM),
    Metric("landmark_error_90_m", "landmark error, 90 % below", "lower", False, *_MM),
    Metric("association_precision", "association precision", "higher", False, *_PERCENT),
    Metric("tracked", "frames tracked", "higher", True, *_PERCENT),
    Metric("frames_lost", "frames lost", "", False, *_PERCENT),
    Metric("frames_predicted", "frames predicted", "", False, *_PERCENT),
    Metric("frames_failed", "frames failed", "", False, *_PERCENT),
    Metric("map_size", "landmarks in the map, mean"),
    Metric("lifetime_frames", "lifetime of a landmark, median", "", False, *_FRAMES),
    Metric("lifetime_mean_frames", "lifetime of a landmark, mean", "", False, *_FRAMES),
    Metric("used_per_frame", "observations used per frame"),
)  # fmt: skip

#: What a run's own table says besides, without a better or worse.
OF_A_RUN = (
    Metric("landmarks", "landmarks at the end", place=("landmarks",)),
    Metric("path_m", "path length", unit="m", place=("path_length_m",)),
    Metric("speed", "speed, median", unit="m/s", place=("speed_m_per_s",)),
    Metric("sigma_m", "sigma of the last position", "", False, *_MM, ("final_sigma_m",)),
    Metric("bodies", "moving bodies found", place=("bodies",)),
    Metric("dropped", "frames dropped", place=("live", "frames dropped")),
    Metric("behind", "behind, median", unit="ms", place=("live", "milliseconds behind", "median")),
    Metric("behind_most", "behind, most", unit="ms", place=("live", "milliseconds behind", "max")),
    Metric("milliseconds", "stages of a frame, median", unit="ms", place=("milliseconds", "median_total")),
    Metric("rate", "frames per second", place=("frames_per_second",)),
    Metric("compiling", "kernels compiled, beside these times", unit="s", place=("compile_seconds",)),
)  # fmt: skip

#: Figures of a comparison that a run's own table leaves out: shares of its status, which it shows in words.
_NOT_OF_ONE_RUN = ("tracked", "frames_lost", "frames_predicted", "frames_failed", "scale_sigma_percent")

#: Of a moving body, what a run's own table says.
_OF_BODIES = ("coverage", "ME translation median [m]", "ME rotation median [deg]")

_COMPILED = 0.05  # compile times below this [s] are not worth a row

#: Frames whose pose was not measured: they are in no figure of accuracy, and counted here. The share tracked is tested.
UNTRACKED = ("frames_lost", "frames_predicted", "frames_failed")

BY_KEY = {metric.key: metric for metric in METRICS}

_OBJECT = "object"
_NEES = "NEES / degree of freedom"
_SHARES = ("precision", "recall", "F1", "coverage", "counted right")
_UNITS = {"m": _MM, "deg": ("deg", 1.0), "frames": _FRAMES}


def rows(summaries: Sequence[Mapping[str, Any]]) -> Iterator[tuple[str, list[str]]]:
    """The table of some runs for people: label with unit, and a text per run; what no run has is left out."""
    yield "frames tracked", list(map(_tracked, summaries))
    found = [_placed(OF_A_RUN, s) | figures(s) for s in summaries]
    objects = [object_metric(key) for key in dict.fromkeys(key for one in found for key in one) if _is_of_body(key)]
    left_out = [m.key for m in OF_A_RUN[-1:] if not any(one.get(m.key, 0.0) > _COMPILED for one in found)]
    for metric in (*OF_A_RUN[:5], *METRICS, *objects, *OF_A_RUN[5:]):
        values = [one.get(metric.key, float("nan")) for one in found]
        if metric.key not in (*_NOT_OF_ONE_RUN, *left_out) and np.isfinite(values).any():
            yield metric.title, list(map(metric.show, values))


def _tracked(summary: Mapping[str, Any]) -> str:
    """How many frames had a measured pose, and what became of the others; the first one starts the map."""
    status = summary["status"]
    own = status.get("tracked", 0) + status.get("started", 0)
    others = [f"{n} {name}" for name, n in status.items() if name not in ("tracked", "started")]
    return ", ".join([f"{own} of {summary['frames']}", *others])


def _is_of_body(key: str) -> bool:
    return key.startswith(f"{_OBJECT} bodies") and key.endswith(_OF_BODIES)


def _placed(metrics: Sequence[Metric], summary: Mapping[str, Any]) -> dict[str, float]:
    """What a summary says of some figures that have a place in it, by key."""
    found = {}
    for metric in metrics:
        tree: Any = summary
        for key in metric.place[:-1]:
            tree = tree.get(key, {}) if isinstance(tree, Mapping) else {}
        if metric.place and isinstance(tree, Mapping) and tree.get(metric.place[-1]) is not None:
            divisor = tree[metric.share_of] if isinstance(metric.share_of, str) else metric.share_of
            found[metric.key] = float(tree[metric.place[-1]]) / divisor
    return found


def figures(summary: Mapping[str, Any]) -> dict[str, float]:
    """What a run's summary says, by key of `METRICS`, and ``object …`` figures; what it does not say is left out."""
    found = _placed(METRICS, summary)
    if "scale_error_percent" in found:
        found["scale_error_percent"] = abs(found["scale_error_percent"])
    if not found.get("loops_closed", 0) + found.get("loops_refused", 0):
        found = {key: value for key, value in found.items() if not key.startswith("loops")}
    frames, status = summary.get("frames", 0), summary.get("status", {})
    if frames:
        started = status.get("started", 0)  # its pose is that of the world
        found["tracked"] = (status.get("tracked", 0) + started) / frames
        found |= {key: status.get(key.removeprefix("frames_"), 0) / frames for key in UNTRACKED}
        found["used_per_frame"] = summary.get("observations", {}).get("used", 0) / frames
    return {**found, **object_figures(summary)}


def object_metric(key: str) -> Metric:
    """A figure of moving objects by the key that `object_figures` gives it."""
    text = re.sub(r"^bodies (\d+) (ME )?", _named_body, key.removeprefix(f"{_OBJECT} "))
    label = text if text.startswith("body") else f"objects: {text}"
    if key.endswith(_SHARES):
        return Metric(key, label, "higher", False, *_PERCENT)
    if key.endswith(_NEES):
        return Metric(key, label, "one")
    found = re.fullmatch(r"(.*) \[(\w+)\]", label)
    lower = "lower" if found or "false" in key else ""
    if found is None or found[2] not in _UNITS:
        return Metric(key, label, lower)
    return Metric(key, found[1], lower, False, *_UNITS[found[2]])


def _named_body(found: re.Match[str]) -> str:
    return f"body {found[1]}: {'motion error, ' if found[2] else ''}"


def object_figures(summary: Mapping[str, Any]) -> dict[str, float]:
    """Plain numbers that a run's summary has on moving objects, where something detects them.

    What is found of the moving features has no value where no body has moved.
    """
    objects = summary.get("objects")
    if not isinstance(objects, Mapping):
        return {}
    found = dict(_leaves(_OBJECT, objects))
    for key in [key for key in found if key.endswith(" mean NEES")]:
        name = key.removesuffix("mean NEES")
        found[name + _NEES] = found.pop(key) / found.pop(name + "dof", 6.0)
    bodies = [found[key] for key in found if key.endswith(" frames in view")]
    if not any(bodies):
        found = {key: value for key, value in found.items() if not key.endswith(("precision", "recall", "F1"))}
    return found


def _leaves(name: str, tree: Any) -> list[tuple[str, float]]:
    if isinstance(tree, Mapping):
        return [leaf for key in tree for leaf in _leaves(f"{name} {key}", tree[key])]
    if isinstance(tree, (int, float)) and not isinstance(tree, bool):
        return [(name, float(tree))]
    return []
