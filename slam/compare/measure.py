"""The figures of merit of a comparison: their names, the units in which people see them, and which way is better."""

from __future__ import annotations

import re
from collections.abc import Mapping
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
    """

    key: str
    label: str
    better: str = ""
    main: bool = False
    unit: str = ""
    scale: float = 1.0

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

#: In the order of the tables. Times are apart: they differ from run to run.
METRICS = (
    Metric("ate_online_m", "ATE RMSE, online", "lower", True, "mm", 1e3),
    Metric("ate_final_m", "ATE RMSE, final", "lower", True, "mm", 1e3),
    Metric("ate_without_loops_m", "ATE RMSE, online, loops left out", "lower", False, "mm", 1e3),
    Metric("loops_closed", "loops closed"),
    Metric("loops_refused", "loops refused"),
    Metric("rpe_1s_m", "RPE RMSE over 1 s", "lower", False, "mm", 1e3),
    Metric("rpe_1s_deg", "RPE RMSE over 1 s, rotation", "lower", False, "deg"),
    Metric("segment_percent", "RPE by distance (segment error)", "lower", False, "%"),
    Metric("gps_m", "GPS distance RMSE", "lower", True, "mm", 1e3),
    Metric("scale_error_percent", "scale error, absolute", "lower", False, "%"),
    Metric("scale_sigma_percent", "scale sigma (claimed)", "", False, "%"),
    Metric("nees_per_dof", "NEES / 6 from the start (expected 1)", "one", True),
    Metric("nees_1m_per_dof", "NEES / 6 over 1 m (expected 1)", "one"),
    Metric("nees_10m_per_dof", "NEES / 6 over 10 m (expected 1)", "one", True),
    Metric("nees_100m_per_dof", "NEES / 6 over 100 m (expected 1)", "one"),
    Metric("nis_per_dof", "NIS per degree of freedom (expected 1)", "one"),
    Metric("landmark_error_m", "landmark error, median", "lower", True, "mm", 1e3),
    Metric("landmark_error_90_m", "landmark error, 90 % below", "lower", False, "mm", 1e3),
    Metric("association_precision", "association precision", "higher", False, "%", 100),
    Metric("tracked", "frames tracked", "higher", True, "%", 100),
    Metric("frames_lost", "frames lost", "", False, "%", 100),
    Metric("frames_predicted", "frames predicted", "", False, "%", 100),
    Metric("frames_failed", "frames failed", "", False, "%", 100),
    Metric("map_size", "landmarks in the map, mean"),
    Metric("lifetime_frames", "lifetime of a landmark, median", "", False, "frames"),
    Metric("lifetime_mean_frames", "lifetime of a landmark, mean", "", False, "frames"),
    Metric("used_per_frame", "observations used per frame"),
)

#: Frames whose pose was not measured: they are in no figure of accuracy, and counted here. The share tracked is tested.
UNTRACKED = ("frames_lost", "frames_predicted", "frames_failed")

BY_KEY = {metric.key: metric for metric in METRICS}

_OBJECT = "object"
_NEES = "NEES / degree of freedom"
_SHARES = ("precision", "recall", "F1", "coverage", "counted right")
_UNITS = {"m": ("mm", 1e3), "deg": ("deg", 1.0), "frames": ("frames", 1.0)}


def object_metric(key: str) -> Metric:
    """A figure of moving objects by the key that `object_figures` gives it."""
    text = re.sub(r"^bodies (\d+) ", r"body \1: ", key.removeprefix(f"{_OBJECT} "))
    label = text if text.startswith("body") else f"objects: {text}"
    if key.endswith(_SHARES):
        return Metric(key, label, "higher", False, "%", 100)
    if key.endswith(_NEES):
        return Metric(key, label, "one")
    found = re.fullmatch(r"(.*) \[(\w+)\]", label)
    lower = "lower" if found or "false" in key else ""
    if found is None or found[2] not in _UNITS:
        return Metric(key, label, lower)
    return Metric(key, found[1], lower, False, *_UNITS[found[2]])


def object_figures(summary: Mapping[str, Any]) -> dict[str, float]:
    """Plain numbers that a run's summary has on moving objects, where something detects them.

    What is found of the moving features has no value where no body has moved.
    """
    objects = summary.get("objects")
    if not isinstance(objects, Mapping):
        return {}
    figures = dict(_leaves(_OBJECT, objects))
    for key in [key for key in figures if key.endswith(" mean NEES")]:
        name = key.removesuffix("mean NEES")
        figures[name + _NEES] = figures.pop(key) / figures.pop(name + "dof", 6.0)
    bodies = [figures[key] for key in figures if key.endswith(" frames in view")]
    if not any(bodies):
        figures = {key: value for key, value in figures.items() if not key.endswith(("precision", "recall", "F1"))}
    return figures


def _leaves(name: str, tree: Any) -> list[tuple[str, float]]:
    if isinstance(tree, Mapping):
        return [leaf for key in tree for leaf in _leaves(f"{name} {key}", tree[key])]
    if isinstance(tree, (int, float)) and not isinstance(tree, bool):
        return [(name, float(tree))]
    return []
