"""Parts of `experiments/ablation.py`: the sequences, what is switched off, and the error of a path."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from experiments.common import path_of, recordings
from slam.config import SystemConfig
from slam.data import FrameResult
from slam.evaluation.joint_errors import JointErrors, with_newest
from slam.evaluation.summary import consistency, evaluate
from slam.geometry.trajectory import Trajectory
from slam.sequences import Sequence, open_sequence


@dataclass(frozen=True)
class Case:
    """A sequence."""

    name: str  # for the table
    path: str  # of a recording below SLAM_DATA, or text of a world
    frames: int  # how many of it, the first ones
    over: int = 1  # length of the stretches of which the NEES is given [m]
    trials: int = 100  # most runs of it
    settings: tuple[str, ...] = ()  # for all of its runs


_DAY = "kitti_raw/2011_09_26/2011_09_26_drive_"
CASES = (
    Case("KITTI 06", "kitti_odometry/sequences/06", 51, 10),
    Case("raw 0001", f"{_DAY}0001_sync", 60, 10),
    Case("raw 0013", f"{_DAY}0013_sync", 80, 10),
    Case("V1_01", "euroc/V1_01_keyframes_a", 20),
    Case("MH_01", "euroc/MH_01_part", 60),
    Case("aisle", "synthetic:aisle?frames=60", 60),
    Case("desk", "synthetic:desk?frames=60", 60),
    Case("box", "synthetic:box?frames=60", 60),
    Case("street", "synthetic:street?frames=45", 45, 10),
    # Back where it began: the drift, so without what recognises the place.
    Case("library", "handheld_library", 346, 1, 5, ("atlas.enabled=false", "map.forget_after=30")),
)
RECORDED = tuple(case for case in CASES if not case.path.startswith("synthetic:"))
#: Frames of the library that show one place, and how far apart they are [m], by the features of both alone.
CLOSINGS = ((5, 340, 0.07), (10, 345, 0.04), (5, 345, 0.52), (10, 340, 0.50))


def exact_rig() -> AbstractContextManager[object]:
    """The rig's uncertainty is added to nothing: no back end is asked to follow it."""
    return mock.patch("slam.calibration.estimator.ConsideringBackend", type("Nobody", (), {}))


def nothing_parts() -> AbstractContextManager[object]:
    """Landmarks measure the pose until the detector knows by their tracks that they may move."""
    name = "slam.bodies.detector.MovingObjectDetector.parting"
    return mock.patch(name, lambda *_: np.zeros(0, np.int64))


#: Settings with which every part that may be worth something is on, by kind of motion.
BASE = {
    "driving": (
        "association.align=true", "map.max_landmarks=200", "map.target_in_view=150", "backend.landmarks=euclidean",
    ),
    "handheld": (),
}  # fmt: skip


@dataclass(frozen=True)
class Variant:
    """What is switched off, or changed."""

    name: str  # for the table
    #: By kind of motion; those of both where it is one tuple. A back end that has none of them is left out.
    settings: tuple[str, ...] | dict[str, tuple[str, ...]] = ()
    patch: Callable[[], AbstractContextManager[object]] = nullcontext  # for what has no setting
    base: bool = True  # whether the settings are changes of `BASE`; else of the defaults

    def config(self, sequence: Sequence, case: Case, backend: str) -> SystemConfig:
        """All settings of a run."""
        own = self.settings if isinstance(self.settings, tuple) else self.settings[sequence.kind]
        both = (*(BASE[sequence.kind] if self.base else ()), *own)
        known = [s for s in both if not s.startswith("backend.") or backend == "ekf"]
        return SystemConfig.for_kind(sequence.kind).with_settings([*case.settings, *known])


ALL_ON = Variant("everything on")
USUAL = Variant("default settings", base=False)
#: In the order in which they are run; those of one tuple share the features of a trial.
GROUPS = (
    (
        ALL_ON,
        USUAL,
        Variant("no patch alignment", ("association.align=false",)),
        Variant("the other form of landmarks", {
            "driving": ("backend.landmarks=inverse_depth",), "handheld": ("backend.landmarks=euclidean",),
        }),
        Variant("no self-calibration", ("self_calibration.enabled=false",)),
        Variant("no detector of moving objects", ("objects.mode=off",)),
    ),
    (
        Variant("one iteration", ("backend.iterations=1",)),
        Variant("covariance not transported", ("backend.consistent=false",)),
        Variant("no uncertainty of the rig", (), exact_rig),
        Variant("no test of a frame's landmarks", (), nothing_parts),
        Variant("no atlas", ("atlas.enabled=false",)),
        Variant("left pixels alone", ("backend.measurement=left",)),
        Variant("pixel noise of the other kind", {
            "driving": ("models.pixel_sigma=0.3",), "handheld": ("models.pixel_sigma=0.7",),
        }),
    ),
)  # fmt: skip


def opened(case: Case, trial: int) -> Sequence | None:
    """A sequence, of a world with the trial's seed; None where the recording is not there."""
    if case.path.startswith("synthetic:"):
        return open_sequence(f"{case.path}&seed={trial}")
    found = recordings({case.name: case.path})
    return open_sequence(found[case.name]) if found else None


def closing_error(path: Trajectory, sequence: Sequence) -> float:
    """RMSE of the distances between frames of the library that show one place [m]."""
    stamps = np.asarray(sequence.stamps)
    at = {float(stamp): position for stamp, position in zip(path.stamps, path.positions)}
    pairs = [(at.get(float(stamps[a])), at.get(float(stamps[b])), d) for a, b, d in CLOSINGS if b < len(stamps)]
    off = [np.linalg.norm(b - a) - d for a, b, d in pairs if a is not None and b is not None]
    return float(np.sqrt(np.mean(np.square(off)))) if off else float("nan")


def error_of(path: Trajectory, sequence: Sequence) -> float:
    """ATE [m]; of the library, which has no truth, the closing error."""
    if sequence.ground_truth is None:
        return closing_error(path, sequence)
    return evaluate(path, sequence).get("ATE RMSE [m]", float("nan"))


def path_figures(results: list[FrameResult], case: Case, sequence: Sequence) -> list[float]:
    """Error of the online path [m], NEES, number of frames, and of those without a measured pose."""
    measured = [r for r in results if r.status.measured]
    path, P = path_of(measured), np.array([r.estimate.covariance for r in measured])
    blocks = [with_newest(r.recent, path.stamps[: k + 1].tolist()) for k, r in enumerate(measured)]
    joint = JointErrors.of(blocks, np.arange(len(measured)))
    found = consistency(path, P, sequence, [r.common for r in measured], joint)
    nees = found.get(f"NEES over {case.over} m", float("nan"))
    return [error_of(path, sequence), nees, len(results), len(results) - len(measured)]
