"""What the figures of a run are: the one table by which terminal, pictures and comparisons read its ``summary.json``.

A row has the figure's name, unit, place in the summary, which way is better, and where it is shown. What is computed,
and how, is in `slam.evaluation`. Whether covariances hold is judged here, for one run and for several.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from slam.evaluation.consistency import BEFORE, EXACT, PIXELS_ALONE
from slam.evaluation.metrics import chi_square_band
from slam.naming import count
from slam.sequences import formats

_SCALES = {"mm": 1e3, "%": 100.0}  # units in which people see metres and shares


@dataclass(frozen=True)
class Metric:
    """One figure."""

    key: str  # column of the tables; its end says the unit of the values, if that is another one than `unit`
    label: str  # for people
    unit: str = ""  # in which people see it
    place: str = ""  # keys of a summary one below the other; "*": the mean over bodies in view; empty: computed
    better: str = ""  # "lower", "higher", "one" (1 is honest; both ways off is worse), or "" (neither)
    #: Where: some of "compared", "main" (in a comparison's conclusions), "run", "picture", "brief" (in that of several)
    shown: str = "compared"

    @property
    def scale(self) -> float:
        """What a value is multiplied by for people."""
        return 1.0 if self.key.endswith("percent") else _SCALES.get(self.unit, 1.0)

    @property
    def title(self) -> str:
        """Label with unit."""
        return f"{self.label} [{self.unit}]" if self.unit else self.label

    def show(self, value: float, like: float | None = None) -> str:
        """A value for people, see `number`."""
        return number(self.scale * value, None if like is None else self.scale * like)


def number(value: float, like: float | None = None) -> str:
    """Three digits, or as many behind the point as show three of `like`, six at most; a dash for no number."""
    if not np.isfinite(value):
        return "–"
    if not like:
        text = f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    else:
        text = f"{value:.{min(6, max(0, 2 - int(np.floor(np.log10(abs(like))))))}f}"
    return text.replace("-", "−")


#: Whether a run's path cannot be trusted, or no frame after the first was tracked.
DOUBTED = "doubted"

#: In the order of all tables. Times are not compared: they differ from run to run.
METRICS = (
    Metric("completed", "runs completed", "%", "", "higher", "compared main"),
    Metric("tracked", "frames tracked", "%", "", "higher", "compared main"),
    Metric(DOUBTED, "runs not to be trusted", "%", "", "lower", "compared main"),
    Metric("path_m", "path length", "m", "path_length_m", shown="compared main run picture"),
    Metric("speed", "speed, median", "m/s", "speed_m_per_s", shown="run picture"),
    Metric("landmarks", "landmarks in the map at the end", "", "landmarks", shown="run"),
    Metric("bodies", "moving bodies found", "", "bodies", shown="run picture"),
    Metric("moving_precision", "moving features, precision", "%", "objects/features/precision", "higher"),
    Metric("moving_recall", "moving features, recall", "%", "objects/features/recall", "higher"),
    Metric("body_coverage", "moving bodies, frames found", "%", "objects/bodies/*/coverage", "higher", "compared run"),
    Metric("body_error_m", "motion of a body, error", "mm", "objects/bodies/*/ME/translation median [m]", "lower",
           "compared run"),
    Metric("body_error_deg", "motion of a body, rotation error", "deg", "objects/bodies/*/ME/rotation median [deg]",
           "lower"),
    Metric("body_ratio", "errors / claimed σ of bodies (1 is right)", "", "objects/bodies/*/mean NEES", "one"),
    Metric("loops_closed", "loops closed", "", "loops/closed", shown="compared run picture"),
    Metric("loops_refused", "loops refused", "", "loops/refused"),
    Metric("ate_online_m", "online path error (ATE, aligned)", "mm", "accuracy/online/ATE RMSE [m]", "lower",
           "compared main run picture brief"),
    Metric("ate_final_m", "final path error (ATE, aligned)", "mm", "accuracy/final/ATE RMSE [m]", "lower",
           "compared main run brief"),
    Metric("rpe_1s_m", "online drift in 1 s (RPE)", "mm", "accuracy/online/RPE RMSE over 1 s [m]", "lower",
           "compared run"),
    Metric("rpe_1s_deg", "online drift of rotation in 1 s (RPE)", "deg",
           "accuracy/online/RPE rotation RMSE over 1 s [deg]", "lower"),
    Metric("segment_percent", "online drift by distance (RPE)", "%", "accuracy/online/segment error [%]", "lower",
           "compared run"),
    Metric("sigma_m", "claimed σ of the last position", "mm", "final_sigma_m", shown="run picture brief"),
    Metric("ratio_10m", "errors / claimed σ over 10 m (1 is right)", "", "consistency/NEES over 10 m", "one",
           "compared main"),
    Metric("ratio_1m", "errors / claimed σ over 1 m (1 is right)", "", "consistency/NEES over 1 m", "one"),
    Metric("ratio_start", "errors / claimed σ from the start (1 is right)", "", "consistency/mean NEES", "one",
           "compared main"),
    Metric("ratio_100m", "errors / claimed σ over 100 m (1 is right)", "", "consistency/NEES over 100 m", "one"),
    *(Metric(f"truth {over}", f"share of the true path's errors in what is expected {over}", "",
             f"consistency/share of truth {over}", shown="")
      for over in ("from the start", "over 1 m", "over 10 m", "over 100 m")),
    Metric("exact_calibration", "cameras without errors, of which covariances may count some", "",
           f"consistency/{EXACT}", shown=""),
    Metric("pixels_alone", "covariances of pixel noise alone", "", f"consistency/{PIXELS_ALONE}", shown=""),
    Metric("nis_per_dof", "NIS / dof (up to 1 is right)", "", "consistency/NIS per degree of freedom"),
    Metric("map_size", "landmarks in the map, mean"),
    Metric("landmark_error_m", "median landmark error", "mm", "", "lower", "compared main"),
    Metric("association_precision", "association precision", "%", "", "higher"),
    Metric("dropped", "frames dropped", "", "live/frames dropped", shown="run"),
    Metric("behind", "behind, median", "ms", "live/milliseconds behind/median", shown="run"),
    Metric("behind_most", "behind, most", "ms", "live/milliseconds behind/max", shown="run"),
    Metric("milliseconds", "time of a frame, median", "ms", "milliseconds/median_total", shown="run"),
    Metric("compiling", "compiling, once, by the first run", "s", "compile_seconds", shown="run"),
)  # fmt: skip

BY_KEY = {metric.key: metric for metric in METRICS}
COMPARED = tuple(metric for metric in METRICS if "compared" in metric.shown)

_LEAST = {"compiling": 0.05, "loops_closed": 0.0}  # up to which a figure is not worth a row

#: Errors over claimed σ by key, with what they are over; the best to judge by first: errors from the start add up.
RATIOS = {
    "ratio_10m": "over 10 m",
    "ratio_1m": "over 1 m",
    "ratio_start": "from the start",
    "ratio_100m": "over 100 m",
}
_SHORT = 0.1  # [m] below which the length of a path is told in millimetres
_MOSTLY = 0.5  # share of the truth's errors in those expected, from which it is said
_OF_A_PATH = {"loops_closed", "path_m", "speed", "sigma_m"}


def figures(summary: Mapping[str, Any]) -> dict[str, float]:
    """What a run's summary says, by key of `METRICS`; what it does not say is left out."""
    bodies = [body for body in _at(summary, "objects/bodies", {}).values() if body["frames in view"]]
    found: dict[str, float] = {}
    for m in METRICS:
        before, each, own = m.place.partition("/*/")
        values = [_at(body, own) for body in bodies] if each else [_at(summary, before)] if before else []
        known = [float(value) for value in values if value is not None]
        if known and (bodies or "moving" not in m.key):  # what is found of nothing is no figure
            mean = float(np.mean(known))
            found[m.key] = float(np.sqrt(mean / 6)) if m.better == "one" else mean  # of NEES, where 6 is right
    if frames := summary.get("frames", 0):
        found["tracked"] = _measured(summary) / frames
    followed = bool((summary.get("status") or {}).get("tracked"))
    found[DOUBTED] = float(bool(summary.get("doubt")) or (frames > 1 and not followed))
    if not followed:  # poses that are the motion model's have no loops, path or σ
        found = {key: value for key, value in found.items() if key not in _OF_A_PATH}
    if not found.get("loops_closed") and not found.get("loops_refused"):
        found = {key: value for key, value in found.items() if not key.startswith("loops")}
    return found


def rows(summaries: Sequence[Mapping[str, Any]]) -> Iterator[tuple[str, list[str]]]:
    """The table of some runs for people: label with unit, and a text per run; what no run has is left out."""
    tracked = []  # how many frames had a measured pose, and what became of the others; the first one starts the map
    for summary in summaries:
        others = [f"{n} {name}" for name, n in summary["status"].items() if name not in ("tracked", "started")]
        tracked.append(", ".join([f"{_measured(summary)} of {summary['frames']}", *others]))
    yield "frames tracked", tracked
    if any(truths := [errors_of_truth(summary) for summary in summaries]):
        yield "errors of the true path itself", [text or "–" for text in truths]
    found = list(map(figures, summaries))
    judged = {key for one in found for key in list(_ratios(one))[:1]}
    for metric in METRICS:
        if "run" in metric.shown or metric.key in judged:
            values = [one.get(metric.key, np.nan) for one in found]
            if any(value > _LEAST.get(metric.key, -1.0) for value in values):
                yield metric.title, list(map(metric.show, values))


def facts(summary: Mapping[str, Any], brief: bool = False) -> str:
    """What a run found, also where there is no truth, and whether its covariances hold, for the head of a picture.

    A `brief` one leaves out what runs of one sequence hardly differ in.
    """
    if not summary:
        return ""
    found = figures(summary)
    shown = [m for m in METRICS if ("brief" if brief else "picture") in m.shown and found.get(m.key)]
    shown = [replace(m, unit="mm") if m.unit == "m" and found[m.key] < _SHORT else m for m in shown]
    words = [f"{m.label} {m.show(found[m.key])} {m.unit}".rstrip() for m in shown]
    doubt = "do not trust this path, see the run's warnings" if summary.get("doubt") else ""
    covariances = verdict_of_run(summary).partition(":" if brief else " (")[0]
    truth = errors_of_truth(summary) and f"errors of the true path itself: {errors_of_truth(summary)}"
    return "; ".join(filter(None, [doubt, *words, covariances, truth]))


def errors_of_truth(summary: Mapping[str, Any]) -> str:
    """The errors that the true path is counted with, in words; empty for that of a world, and where none is known."""
    truth = summary.get("truth")
    if truth is None or summary.get("format") == "synthetic":
        return ""
    if not any(truth.values()):
        return "none, it is taken as exact"
    text = f"σ {number(1e3 * truth['translation'])} mm, {number(float(np.degrees(truth['rotation'])))}°"
    if truth.get("mounting") or truth.get("lever"):
        text += f", mounting {number(1e3 * truth['lever'])} mm, {number(float(np.degrees(truth['mounting'])))}°"
    return text + (f", clock {number(1e3 * truth['clock'])} ms" if truth.get("clock") else "")


def _measured(summary: Mapping[str, Any]) -> int:
    status = summary.get("status", {})
    return int(status.get("tracked", 0) + status.get("started", 0))


def _at(tree: Any, place: str, default: Any = None) -> Any:
    for key in place.split("/"):
        tree = tree.get(key) if isinstance(tree, Mapping) else None
    return default if tree is None else tree


def _ratios(found: Mapping[str, float]) -> dict[str, float]:
    """How many times as large as claimed errors are, by key; the one to judge by first."""
    return {key: found[key] for key in RATIOS if np.isfinite(found.get(key, np.nan))}


def verdict(found: Mapping[str, float], runs: int = 1) -> str:
    """Whether covariances are as large as the errors, by which figure and which band; empty where no NEES is known.

    `found` are `figures` of a run, or their means over `runs`. The band is that of as many independent values: it holds
    even if all frames of a run are as good as one, which errors of the rig make them.
    """
    low, high = (np.sqrt(bound / 6) for bound in chi_square_band(6, max(runs, 1)))
    ratios = {RATIOS[key]: ratio for key, ratio in _ratios(found).items()}
    if not ratios:
        return ""
    said = {over: "too small" if r > high else "too large" if r < low else "right" for over, r in ratios.items()}
    judged, ratio = next(iter(ratios.items()))
    others = [f"{over} {number(ratios[over])} times: {word}" for over, word in said.items() if word != said[judged]]
    pixels_alone = found.get("pixels_alone")
    exact = said[judged] == "too large" and found.get("exact_calibration") and not pixels_alone
    word = "hold in part" if others else "hold"
    if said[judged] != "right":
        word = "are on the safe side" if exact else f"are {said[judged]}"
    of = "runs" if runs == 1 else f"means of {runs} runs"
    times = "as large as" if number(ratio) == "1" else f"{number(ratio)} times what"
    times = f"{judged} errors of the pose are {times} they claim"
    parts = [f"{times} ({low:.2f} to {high:.2f} in 95 % of {of})"]
    if (share := found.get(f"truth {judged}", 0.0)) > _MOSTLY:
        own = f"{100 * share:.0f} % of the error that is expected {judged} is the true path's own"
        if said[judged] == "too small":  # whoever has them, errors are larger than both together explain
            parts.append(own)
        else:
            word, parts = "can hardly be judged", [own, *parts]
    if exact:
        others.append("they count errors of the calibration, and this world's cameras have none")
    if pixels_alone:
        others.append("they count pixel noise alone, and no errors of the calibration")
    return f"covariances {word}: {'; '.join([*parts, *others])}"


def verdict_of_run(summary: Mapping[str, Any]) -> str:
    """`verdict` on a run by its summary, with what it leaves out; empty where no true path is known."""
    text, honest = verdict(figures(summary)), summary.get("consistency") or {}
    if not text and summary.get("truth_doubt"):
        return "covariances are not judged: the true path and the estimated one do not fit, see the run's warnings"
    doubtful = {over: share for over in RATIOS.values() if (share := honest.get(f"doubtful truth {over}"))}
    if not text and not honest.get("dof"):
        return ""
    if not text and _at(summary, "loops/known"):
        return (
            "covariances are not judged in a prior map: all poses share its errors, which the truth of this run does "
            "not tell"
        )
    if not text:
        why = (
            "they are singular" if honest.get("singular covariances")
            else "the true path is doubtful, as where it was interpolated over a gap" if doubtful
            else f"the true path begins {count(int(honest[BEFORE]), 'frame')} after the first, so that only the motion "
            "since then is known, for which the covariances at its ends leave none" if honest.get(BEFORE)
            else "they leave none for the motion between two poses, as where a back end claims the same one for every "
            "frame"
        )  # fmt: skip
        return f"covariances cannot be judged: {why}"
    if truth := errors_of_truth(summary):
        text += f"; errors of the true path itself that are counted: {truth}"
        if not any(summary["truth"].values()) and summary["format"] in formats():  # then it is by truth=
            text += " (truth_sigma= gives it some)"
    if doubtful:
        over, share = next(iter(doubtful.items()))
        text += f"; not judged: {100 * share:.0f} % of the stretches {over}, where the true path is doubtful"
    if left_out := summary["frames"] - _measured(summary):
        text += f"; not judged: {left_out} of {summary['frames']} frames, whose pose was not measured"
    return text
