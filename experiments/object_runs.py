"""Runs of worlds whose bodies are known: features and labels once a world, and what every back end makes of them."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import Any

import numpy as np

import slam
from experiments.common import path_of
from experiments.tables import markdown
from slam import registry
from slam.config import SystemConfig
from slam.data import FrameResult, StereoFeatures
from slam.evaluation.objects import ObjectScore, labels_in_images, score_for
from slam.evaluation.summary import evaluate


@lru_cache(maxsize=2)
def seen_in(name: str, frames: int, first: int = 0) -> list[tuple[StereoFeatures, Any]]:
    """Features in a synthetic world's frames `first` up to, but without, `frames`, and the body of each feature."""
    sequence = slam.open_sequence(f"synthetic:{name}")
    numbers = range(first, min(frames, len(sequence)))
    options = SystemConfig.for_kind(sequence.kind).frontend
    frontend = registry.create("frontends", "surf", sequence.rig, **options)
    found = [frontend.extract(sequence.frame(k)) for k in numbers]
    return [(features, labels_in_images(sequence, k, features)) for k, features in zip(numbers, found)]


def system_for(sequence: Any, backend: str, settings: list[str]) -> slam.StereoSlam:
    config = SystemConfig.for_kind(sequence.kind).with_settings(settings)
    return slam.StereoSlam(sequence.rig, "surf", backend, config=config)


def steps(
    name: str, system: slam.StereoSlam, frames: int, without: bool = False
) -> Iterator[tuple[int, FrameResult, Any]]:
    """Every frame's number, result and labels; `without` leaves out the features on moving bodies."""
    for k, (features, labels) in enumerate(seen_in(name, frames)):
        if without:
            features, labels = features.select(labels == 0), labels[labels == 0]  # those on its outline move with it
        yield k, system.process_features(features), labels


def camera_figures(sequence: Any, results: list[FrameResult]) -> dict[str, float]:
    path = path_of(results)
    return {"ATE [mm]": 1e3 * evaluate(path, sequence)["ATE RMSE [m]"]}


def scored_run(name: str, backend: str, frames: int, *settings: str) -> tuple[dict[str, Any], ObjectScore]:
    """One run of a world: the score's figures and the camera's; and the score."""
    sequence = slam.open_sequence(f"synthetic:{name}")
    score = score_for(sequence) or ObjectScore(
        np.zeros((0, len(sequence), 4, 4)), sequence.stamps, sequence.ground_truth.poses, sequence.rig.left.fu
    )
    system = system_for(sequence, backend, list(settings))
    results = []
    for k, result, labels in steps(name, system, frames):
        score.add(k, result, labels)
        results.append(result)
    summary = score.summary()
    figures = {
        "world": name.rstrip("?"),
        "back end": backend,
        **camera_figures(sequence, results),
        "F1": summary["features"]["F1"],
        "counted right": summary["counted right"],
        "false objects [frames]": summary["false objects"],
        "bodies": summary["bodies"],
    }
    return figures, score


def body_row(world: str, backend: str, number: str, body: dict[str, Any]) -> dict[str, Any]:
    """A table's row of one body's figures."""
    found = {"rotation median [deg]": None, "translation median [m]": None}
    me = body.get("ME") or found
    return {
        "world": world, "back end": backend, "body": number,
        "coverage": body["coverage"],
        "ids": len(body["ids"]), "delay [frames]": body.get("delay [frames]"),
        "ME [deg]": me["rotation median [deg]"], "ME [mm]": millimetres(me["translation median [m]"]),
        "NEES": body.get("mean NEES"),
    }  # fmt: skip


def millimetres(metres: float | None) -> float | None:
    return None if metres is None else 1e3 * metres


def places_together(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A row for each back end and mode: at how many of the four places the box is known, and the largest errors."""
    runs: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in rows:
        runs.setdefault((row["back end"], row["mode"]), []).append(row)
    errors = ("rotation error [deg]", "translation error [mm]")
    return [
        {
            "back end": backend, "mode": mode, "places": sum(row["frames"] > 0 for row in own),
            **{e: max((row[e] for row in own if row[e] is not None), default=None) for e in errors},
        }
        for (backend, mode), own in runs.items()
    ]  # fmt: skip


def worlds_together(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A row for each world: medians over the seeds, and all objects that are none."""
    found: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        found.setdefault(row["world"].partition("seed=")[0].rstrip("?&"), []).append(row)
    medians = ("ATE [mm]", "counted right")
    return [
        {
            "world": world, "seeds": len(runs), **{c: float(np.median([run[c] for run in runs])) for c in medians},
            "false objects": sum(len(run["false objects [frames]"]) for run in runs),
        }
        for world, runs in found.items()
    ]  # fmt: skip


def plain_table(rows: list[dict[str, Any]]) -> str:
    columns = [key for key, value in rows[0].items() if not isinstance(value, dict)]
    return markdown(columns, [[text(row.get(c)) for c in columns] for row in rows], len(columns))


def text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    if isinstance(value, list):
        value = ", ".join(map(str, value)) or None
    return "–" if value is None else str(value)
