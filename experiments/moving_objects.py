"""Moving objects: found without being told, and by the papers' Procedure 1, against known truth.

    [SLAM_DATA=/path/to/data] python experiments/moving_objects.py [--quick] [--only PART,…] [--out DIR]

Parts: table1 (paper B, Table 1: a box at four places), moving (the box under a moving camera, with and without it),
boxes, occlusion (the box's id after it was hidden), still (no false movers), people (cyclists, walkers), kitti (two
overtaking cars), cyclists (KITTI raw 0001, several starts). Prints Markdown tables, leaves them in DIR as JSON. Worlds
are rendered, and SURF runs on them.
"""

from __future__ import annotations

import json
import os
import sys
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import slam
from experiments.common import path_of, script_options
from experiments.labelled_cars import Car, Labels, hidden, labelled_speed, nearest_car, read_labels, read_tracklets
from experiments.object_runs import (
    body_row,
    camera_figures,
    places_together,
    plain_table,
    scored_run,
    seen_in,
    steps,
    system_for,
    worlds_together,
)  # fmt: skip
from experiments.tables import picture
from slam.data import FrameResult, StereoFeatures
from slam.evaluation.metrics import PathErrors, error_sizes
from slam.evaluation.objects import ObjectScore
from slam.evaluation.summary import evaluate
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, inverse, rotation_angle, so3_exp, so3_log
from slam.object_data import MovingObject
from slam.papers.procedure1 import ObjectDatabase

BACKENDS = ("ekf", "smoother", "window")
PARTS = ("table1", "moving", "boxes", "occlusion", "still", "people", "kitti", "cyclists")
# The box moves in frames 60 to 105: from which frame it is watched, when it vanishes, and for how many frames.
WATCHED_FROM, HIDDEN_AT, HIDDEN_FOR, WATCHED_AFTER = 50, 85, (15, 60), 15
PLACES_AT = (1.0, 5.0, 8.5, 12.0)  # when the box has stood at B0 to B3 for a while [s]
KITTI = "kitti_raw/2011_09_26/2011_09_26_drive_0013_sync"
MOVING_CARS = (0, 1, 5)  # two that overtake, and a van that comes towards the camera
CYCLISTS = "kitti_raw/2011_09_26/2011_09_26_drive_0001_sync"
STARTS = (0, 3, 5, 8)  # first frames of its runs: one run tells little of what has few features
NEAR = 25.0  # objects nearer than this are judged [m]
ONE_FOR_ALL = ("back end", "cyclist", f"frames within {NEAR:.0f} m")  # cells that are the same for all starts


# ------------------------------------------------------------------------------------------- the parts


def backends_of(quick: bool) -> tuple[str, ...]:
    """All back ends, or one: what a part does with them is the same."""
    return BACKENDS[: 1 if quick else None]


def body_alignment(estimated: Array, true: Array) -> Array:
    """The change D (4, 4) of body frame with ``T_true ≈ T_estimated D`` over all rows, in the mean."""
    D = inverse(estimated) @ true
    mean = D[0].copy()
    for _ in range(5):
        mean[:3, :3] = mean[:3, :3] @ so3_exp(so3_log(mean[:3, :3].T @ D[:, :3, :3]).mean(axis=0))
    mean[:3, 3] = D[:, :3, 3].mean(axis=0)
    return mean


def absolute_pose_errors(estimated: Array, true: Array) -> PathErrors:
    """Errors ``(T_estimated D)⁻¹ T_true`` of poses (N, 4, 4) after one change D of body frame for all."""
    return error_sizes(inverse(estimated @ body_alignment(estimated, true)) @ true)


def table1(quick: bool, out: Path) -> list[dict[str, Any]]:
    """The box at four places (paper B, Table 1): the largest errors while it rests."""
    name = "box?density=300&camera=still"
    sequence = slam.open_sequence(f"synthetic:{name}")
    frames = 40 if quick else len(sequence)
    true = np.array([sequence.objects(k)[0] for k in range(frames)])
    rows = []
    with TemporaryDirectory() as folder:
        database = Path(folder) / "box.npz"
        known_box(sequence, *seen_in(name, frames)[0]).save(database)
        known = [f"objects.database={database}", "objects.mode=procedure1"]
        systems = [
            (backend, mode, system_for(sequence, backend, settings))
            for backend in backends_of(quick)
            for mode, settings in (("detect", []), ("procedure1", known))
        ]
    for backend, mode, system in systems:
        poses: dict[int, dict[int, np.ndarray]] = {}
        world = None
        for k, result, _ in steps(name, system, frames):
            if world is None:
                world = inverse(result.estimate.T_world_left @ inverse(sequence.ground_truth.poses[0]))
            for thing in result.objects:
                poses.setdefault(thing.id, {})[k] = world @ thing.estimate.T_world_object
        longest = max(poses.values(), key=len, default={})
        rows += place_rows(sequence, true, longest, backend, mode)
    return rows


def known_box(sequence: Any, features: StereoFeatures, labels: Any) -> ObjectDatabase:
    """What the papers' detector knows: the box's features in the first frame, in which the camera is the world."""
    corner = inverse(sequence.ground_truth.poses[0]) @ sequence.objects(0)[0]
    return ObjectDatabase.of(features, labels == 1, sequence.rig, np.eye(4), corner[:3, 3])


def place_rows(sequence: Any, true: Any, poses: dict[int, Any], backend: str, mode: str) -> list[dict[str, Any]]:
    """A row per place: median errors over half a second at rest, after one change of body frame for the whole run."""
    if not poses:
        return []
    frames = np.array(sorted(poses))
    own = np.array([poses[k] for k in frames])
    own = own @ body_alignment(own, true[frames])
    rows = []
    for place, at in enumerate(PLACES_AT):
        here = np.flatnonzero(np.abs(sequence.stamps[frames] - sequence.stamps[0] - at) < 0.25)
        E = inverse(own[here]) @ true[frames[here]]
        off = np.linalg.norm(E[:, :3, 3], axis=1)
        rows.append({
            "back end": backend, "mode": mode, "place": f"B{place}", "frames": len(here),
            "rotation error [deg]": float(np.median(np.degrees(rotation_angle(E[:, :3, :3])))) if len(here) else None,
            "translation error [mm]": 1e3 * float(np.median(off)) if len(here) else None,
        })  # fmt: skip
    return rows


def moving(quick: bool, out: Path) -> list[dict[str, Any]]:
    """The box under a moving camera: with, and without the box's features."""
    name, frames = "box?density=300&camera=moving&seed=0", 80 if quick else 10**6
    rows, scores = [], {}
    for backend in backends_of(quick):
        row, scores[backend] = scored_run(name, backend, frames)
        sequence = slam.open_sequence(f"synthetic:{name}")
        system = system_for(sequence, backend, ["objects.mode=off"])
        bare = [result for _, result, _ in steps(name, system, frames, without=True)]
        row["ATE without the box [mm]"] = camera_figures(sequence, bare)["ATE [mm]"]
        rows.append(row)
    draw_errors(scores, out / "box.png")
    return rows


def draw_errors(scores: dict[str, ObjectScore], path: Path) -> None:
    """How far the box's pose is from the truth over the run, by back end, after one change of body frame each."""
    with picture(path, 7, 4.5, 2, 1, sharex=True) as (turned, moved):
        for (backend, score), colour in zip(scores.items(), ("tab:blue", "tab:orange", "tab:green")):
            frames, own, true = score.poses_of(1)
            if len(frames):
                errors = absolute_pose_errors(own, true)
                turned.plot(score.stamps[frames], errors.rotation, ".", ms=3, color=colour, label=backend)
                moved.plot(score.stamps[frames], 1e3 * errors.translation, ".", ms=3, color=colour)
        turned.set(ylabel="rotation error [deg]", ylim=(0, None))
        moved.set(ylabel="translation error [mm]", xlabel="time [s]", ylim=(0, None))
        if turned.lines:
            turned.legend(fontsize=8)


def boxes(quick: bool, out: Path) -> list[dict[str, Any]]:
    """Four boxes: three, and one with a lid on a hinge; three rooms."""
    frames, seeds = (20, 1) if quick else (300, 3)
    worlds = [f"boxes?density=300&seed={seed}&layout={seed}" for seed in range(seeds)]
    return [scored_run(world, backend, frames)[0] for world in worlds for backend in backends_of(quick)]


def occlusion(quick: bool, out: Path) -> list[dict[str, Any]]:
    """The box is hidden: how often it keeps its id, of ten runs."""
    found: dict[tuple[str, int], list[tuple[set[int], set[int], int]]] = {}
    hidden_for = HIDDEN_FOR[: 1 if quick else None]
    for seed, frames, backend in product(range(1 if quick else 10), hidden_for, backends_of(quick)):
        found.setdefault((backend, frames), []).append(ids_about(seed, backend, frames, max(hidden_for)))
    return [
        {
            "back end": backend, "hidden [s]": frames / 30, "runs": len(runs),
            "one id": sum(before == after and len(before) == 1 for before, after, _ in runs),
            "other ids": sum(len(after - before) for before, after, _ in runs),
            "frames until measured again, median": float(np.median([delay for *_, delay in runs])),
        }
        for (backend, frames), runs in found.items()
    ]  # fmt: skip


def ids_about(seed: int, backend: str, frames: int, longest: int) -> tuple[set[int], set[int], int]:
    """Ids measured before the box is hidden for so many frames, and soon after; frames until it is found.

    Features are found once for all that are hidden for up to `longest` frames.
    """
    name, back = f"box?density=300&camera=moving&seed={seed}", HIDDEN_AT + frames
    sequence = slam.open_sequence(f"synthetic:{name}")
    system = system_for(sequence, backend, [])
    before, after, delay = set(), set(), WATCHED_AFTER
    seen = seen_in(name, HIDDEN_AT + longest + WATCHED_AFTER, WATCHED_FROM)
    for k, (features, labels) in enumerate(seen[: back + WATCHED_AFTER - WATCHED_FROM], WATCHED_FROM):
        shown = features.select(labels == 0) if HIDDEN_AT <= k < back else features
        ids = {thing.id for thing in system.process_features(shown).objects if thing.estimate.measured}
        if k < HIDDEN_AT:
            before |= ids
        elif k >= back and ids:
            after, delay = after | ids, min(delay, k - back)
    return before, after, delay


def still(quick: bool, out: Path) -> list[dict[str, Any]]:
    """Nothing moves: whatever is found is wrong. Medians over ten seeds."""
    seeds, frames = (1, 8) if quick else (10, 100)
    worlds = ("aisle?speed=2&", "desk?density=200&", "street?cars=0&")
    return [scored_run(f"{w}seed={seed}", "ekf", frames)[0] for w in worlds for seed in range(seeds)]


def people(quick: bool, out: Path) -> list[dict[str, Any]]:
    """Cyclists and walkers: nothing in the detector was chosen on this world."""
    return [scored_run("people?", backend, 8 if quick else 10**6)[0] for backend in backends_of(quick)]


def kitti(quick: bool, out: Path) -> list[dict[str, Any]]:
    """Cars of KITTI raw 0013: two overtake; parked ones must not be made objects."""
    folder = recording(KITTI)
    if folder is None:
        return []
    labels = read_labels(folder / "label_02_0003.txt")
    sequence = slam.open_sequence(folder)
    frames = 12 if quick else len(sequence)
    system = system_for(sequence, "ekf", [])
    features = [system.frontend.extract(frame) for frame in sequence.frames(0, frames)]
    clear = [f.select(~hidden(f, labels.get(k, {}), MOVING_CARS)) for k, f in enumerate(features)]
    rows = []
    for backend in backends_of(quick):
        results = drive(sequence, backend, features)
        rows += car_rows(backend, results, labels)
        paths = {
            "ATE [m]": results,
            "without the detector": drive(sequence, backend, features, "objects.mode=off"),
            "moving cars masked out": drive(sequence, backend, clear, "objects.mode=off"),
        }
        ates = {name: evaluate(path_of(run), sequence)["ATE RMSE [m]"] for name, run in paths.items()}
        rows.append({"back end": backend, **ates})
    return rows


def recording(name: str) -> Path | None:
    """Folder of a recording; None, with a message, where it is not there."""
    data = os.environ.get("SLAM_DATA")
    folder = Path(data or "") / name
    if data and folder.is_dir():
        return folder
    print(f"{name}: set SLAM_DATA to the folder that holds it; left out", file=sys.stderr)
    return None


def cyclists(quick: bool, out: Path) -> list[dict[str, Any]]:
    """Cyclists of KITTI raw 0001: what is reported besides is wrong. Four first frames."""
    folder = recording(CYCLISTS)
    if folder is None:
        return []
    labels = read_tracklets(folder / "tracklet_labels.xml", folder.parent)
    sequence = slam.open_sequence(folder)
    system = system_for(sequence, "ekf", [])
    features = [system.frontend.extract(frame) for frame in sequence.frames(0, 12 if quick else len(sequence))]
    rows = []
    for backend in backends_of(quick):
        runs = [
            cyclist_rows(backend, drive(sequence, backend, features[first:]), first, labels, sequence.rig)
            for first in STARTS[: 1 if quick else None]
        ]
        for by_start in zip(*runs):  # one cyclist
            own, *_ = by_start
            several = {key: ", ".join(str(row[key]) for row in by_start) for key in own if key not in ONE_FOR_ALL}
            rows.append({key: own[key] for key in ONE_FOR_ALL} | several)
    return rows


def cyclist_rows(
    backend: str, results: list[FrameResult], first: int, labels: Labels, rig: StereoRig
) -> list[dict[str, Any]]:
    """A row per cyclist that comes near: in how many frames it is measured there, and what is none."""
    near = {
        number: [k for k in range(first, first + len(results)) if is_near_cyclist(labels.get(k, {}).get(number), rig)]
        for number in sorted({number for cars in labels.values() for number in cars})
    }
    measured, ids, false = {number: set[int]() for number in near}, {number: set[int]() for number in near}, set[int]()
    for k, result in enumerate(results, first):
        for thing in result.objects:
            if thing.estimate.measured:
                number = nearest_car(labels.get(k, {}), seen_centre(result, thing))
                if number < 0 or labels[k][number].kind not in ("Cyclist", "Tram"):
                    false.add(k)
                else:
                    ids[number].add(thing.id)
                    measured[number] |= {k} & set(near[number])
    return [
        {
            "back end": backend, "cyclist": number, f"frames within {NEAR:.0f} m": len(frames),
            "measured": len(measured[number]), "ids": len(ids[number]), "false objects [frames]": len(false),
        }
        for number, frames in near.items() if frames
    ]  # fmt: skip


def is_near_cyclist(label: Car | None, rig: StereoRig) -> bool:
    """Whether a label is that of a cyclist nearer than `NEAR` and in the image."""
    near = label is not None and label.kind == "Cyclist" and label.place[2] < NEAR
    return bool(near and label is not None and rig.left.in_view(label.place[None])[0])


def seen_centre(result: FrameResult, thing: MovingObject) -> np.ndarray:
    """Middle (3,) of an object's extent in left-camera coordinates [m]."""
    place = inverse(result.estimate.T_world_left) @ thing.estimate.T_world_object
    return place[:3, :3] @ thing.extent.mean(axis=0) + place[:3, 3]


def drive(sequence: Any, backend: str, features: list[StereoFeatures], *settings: str) -> list[FrameResult]:
    """A run on features that are extracted already."""
    system = system_for(sequence, backend, list(settings))
    return [system.process_features(f) for f in features]


def car_rows(backend: str, results: list[FrameResult], labels: Labels) -> list[dict[str, Any]]:
    """A row per object: where and which car it was, its speed and that of the labels while it is nearer than 25 m."""
    poses, stamps = path_of(results).poses, path_of(results).stamps
    seen: dict[int, list[tuple[int, int, float, float]]] = {}
    for k, result in enumerate(results):
        for thing in result.objects:
            if thing.estimate.measured:
                centre = seen_centre(result, thing)
                speed = float(np.linalg.norm(thing.estimate.velocity[3:]))
                car = nearest_car(labels.get(k, {}), centre)
                seen.setdefault(thing.id, []).append((k, car, speed, float(centre[2])))
    rows = []
    for id, history in seen.items():
        cars = [car for _, car, _, _ in history]
        car = max(set(cars), key=cars.count)
        near = [(k, speed) for k, _, speed, depth in history if depth < NEAR]
        own = np.median([speed for _, speed in near]) if near else np.nan
        true = np.nanmedian([labelled_speed(labels, poses, stamps, car, k) for k, _ in near] or [np.nan])
        rows.append({
            "back end": backend, "object": id, "car": car, "frames": f"{history[0][0]}-{history[-1][0]}",
            "measured": len(history), "speed within 25 m [m/s]": float(own),
            "error [%]": float(100 * abs(own / true - 1)),
        })  # fmt: skip
    return rows


# ------------------------------------------------------------------------------------------- output


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown tables of the rows' plain values, one for each kind of rows; bodies follow."""
    if not rows:
        return "(nothing)"
    bodies = [
        body_row(row["world"], row["back end"], number, body)
        for row in rows
        for number, body in row.get("bodies", {}).items()
        if body["frames in view"] and row["world"].startswith("box?")  # of many bodies a table is too long
    ]
    kinds: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for row in (*rows, *bodies):
        kinds.setdefault(tuple(row), []).append(row)
    return "\n\n".join(map(plain_table, kinds.values()))


def main() -> int:
    parser = script_options(__file__, __doc__, "a few frames of each part")
    parser.add_argument("--only", default=",".join(PARTS), help="parts, joined by commas")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name in arguments.only.split(","):
        rows = globals()[name](arguments.quick, arguments.out)
        shown = {"still": worlds_together, "table1": places_together}.get(name, list)(rows)
        title, _, said = globals()[name].__doc__.partition(": ")
        print(f"\n# {title}\n\n{said and said[0].upper() + said[1:]}\n\n{table(shown)}", flush=True)
        (arguments.out / f"{name}.json").write_text(json.dumps(rows, indent=2, default=str) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
