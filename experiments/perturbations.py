"""Real drives many times over, each time a little different; and with images that are spoilt.

    SLAM_DATA=/path/to/data python experiments/perturbations.py [--quick] [--trials N] [--frames N] [--out DIR]

As single figures of SLAM say little, each drive is run several times, with another first frame, pixel noise of half
a grey level, and up to 20 % more or fewer features; both back ends get the same features. The drives are also run
in a mirror and backwards, which are drives that nobody has chosen a number on. Two of them are run with spoilt
images: unequal exposure, noise, flicker, half the frame rate, a vertical error of the right camera. Prints Markdown
tables: medians and quartiles of the online ATE of the first frames of a drive, and frames without a measured pose,
all trials together. The rows are written as they come. A trial of everything takes some six minutes of processor
time, of which half is the front end's.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from experiments.common import path_of, recordings, script_options
from experiments.tables import show
from frontends import create
from slam.config import SystemConfig
from slam.data import StereoFeatures, StereoFrame
from slam.evaluation.summary import evaluate
from slam.geometry.rig import StereoRig
from slam.geometry.trajectory import Trajectory
from slam.registry import ONLINE
from slam.sequences import Sequence, open_sequence
from slam.system import StereoSlam

_DAY = "kitti_raw/2011_09_26/2011_09_26_drive_"
DRIVES = {"KITTI 06": "kitti_odometry/sequences/06", "raw 0001": f"{_DAY}0001_sync", "raw 0013": f"{_DAY}0013_sync"}
SPOILT = ("KITTI 06", "raw 0001")  # drives that are run with spoilt images
HEADER = ("images", "drive", *(f"ATE {name} [m]" for name in ONLINE))

_FIRST = 5  # frames that may be left out at the beginning
_FEATURES = 0.2  # by how much the number of features may differ

Image = np.ndarray
#: Spoils the two images of a frame.
Spoil = Callable[[Image, Image, np.random.Generator], tuple[Image, Image]]


def noisy(left: Image, right: Image, rng: np.random.Generator) -> tuple[Image, Image]:
    """Sensor noise of 10 grey levels."""
    return left + rng.normal(0, 10.0, left.shape), right + rng.normal(0, 10.0, right.shape)


def flickering(left: Image, right: Image, rng: np.random.Generator) -> tuple[Image, Image]:
    """Both images up to 30 % brighter or darker, differently in each frame."""
    gain = rng.uniform(0.7, 1.3)
    return gain * left, gain * right


@dataclass(frozen=True)
class Fault:
    """What is wrong with a recording."""

    name: str  # for the table
    spoil: Spoil  # of the images
    every: int = 1  # so many frames are one of the recording


NONE = Fault("none", lambda left, right, _: (left, right))
FAULTS = (
    Fault("right image 1.3 times as bright", lambda left, right, _: (left, 1.3 * right)),
    Fault("noise of 10 grey levels", noisy),
    Fault("flicker of 30 %", flickering),
    Fault("5 frames a second", NONE.spoil, 2),
    Fault("right image 1 px lower", lambda left, right, _: (left, np.vstack([right[:1], right[:-1]]))),
)


@dataclass(frozen=True)
class Drive:
    """What a drive is for a run."""

    kind: str  # of motion
    rig: StereoRig
    ground_truth: Trajectory | None  # true path of the left camera; None where it is not known
    frames: Callable[[int, int], Iterator[StereoFrame]]  # from a number up to, but without, another


def mirrored(drive: Sequence) -> Drive:
    """A rectified drive in a mirror: the right camera is the left one, and what was right is left."""
    rig, truth = drive.rig, drive.ground_truth
    u0 = rig.width - 1 - rig.right.u0
    mirror, right = np.diag([-1.0, 1.0, 1.0, 1.0]), np.eye(4)
    right[0, 3] = rig.baseline

    def frames(start: int, stop: int) -> Iterator[StereoFrame]:
        for frame in drive.frames(start, stop):
            if frame.right is not None:
                yield replace(frame, left=frame.right[:, ::-1], right=frame.left[:, ::-1])

    return Drive(
        drive.kind,
        StereoRig.rectified_pair(rig.left.fu, u0, rig.left.v0, rig.baseline, rig.width, rig.height),
        None if truth is None else replace(truth, poses=mirror @ truth.poses @ right @ mirror),
        frames,
    )


def backwards(drive: Sequence, last: int) -> Drive:
    """A drive in reverse gear, from the frame before `last`, or its own last one, to the first."""
    end, truth = min(last, len(drive)), drive.ground_truth

    def frames(start: int, stop: int) -> Iterator[StereoFrame]:
        for index in range(start, min(stop, end)):
            (frame,) = drive.frames(end - 1 - index, end - index)
            yield replace(frame, index=index, stamp=-frame.stamp)

    turned = None if truth is None else replace(truth, stamps=-truth.stamps[::-1], poses=truth.poses[::-1])
    return Drive(drive.kind, drive.rig, turned, frames)


def frames_of(sequence: Drive | Sequence, fault: Fault, last: int, trial: int) -> Iterator[StereoFrame]:
    """The frames of one trial; no frame depends on which others are taken."""
    first = np.random.default_rng(trial).integers(_FIRST)
    for frame in sequence.frames(int(first), last):
        if (frame.index - first) % fault.every or frame.left is None or frame.right is None:
            continue
        rng = np.random.default_rng([trial, frame.index])
        images = fault.spoil(frame.left.astype(float), frame.right.astype(float), rng)
        left, right = (np.clip(np.rint(x + rng.normal(0, 0.5, x.shape)), 0, 255).astype(np.uint8) for x in images)
        yield replace(frame, left=left, right=right)


def features_of(sequence: Drive | Sequence, trial: int) -> int:
    """How many features the front end is asked for in one trial."""
    usual = create("surf", sequence.rig, **SystemConfig.for_kind(sequence.kind).frontend).config.features
    return round(np.random.default_rng([trial, 1]).uniform(1 - _FEATURES, 1 + _FEATURES) * usual)


def extracted(sequence: Drive | Sequence, fault: Fault, last: int, trial: int) -> list[StereoFeatures]:
    """Features of one trial, for all back ends."""
    options = {**SystemConfig.for_kind(sequence.kind).frontend, "features": features_of(sequence, trial)}
    frontend = create("surf", sequence.rig, **options)
    return [frontend.extract(frame) for frame in frames_of(sequence, fault, last, trial)]


def run(sequence: Drive | Sequence, features: list[StereoFeatures], backend: str) -> float:
    """One back end on one trial: error of the path [m]."""
    system = StereoSlam(sequence.rig, None, backend, config=SystemConfig.for_kind(sequence.kind))
    path = path_of(map(system.process_features, features), measured=True)
    return float(evaluate(path, sequence).get("ATE RMSE [m]", np.nan)) if len(path) > 2 else float("nan")


def figures(fault: Fault, sequence: Drive | Sequence, last: int, trials: int) -> list[object]:
    """The figures of a row, behind image and drive, in the order of `HEADER`."""
    features = (extracted(sequence, fault, last, trial) for trial in range(trials))
    ates = [[run(sequence, of_trial, backend) for backend in ONLINE] for of_trial in features]
    return [quartiles(list(of_backend)) for of_backend in zip(*ates)]


def quartiles(values: list[float]) -> str:
    """The median and, of several values, the quartiles; those without a figure are left out, and said."""
    known = [value for value in values if np.isfinite(value)]
    if not known:
        return "–"
    low, middle, high = np.percentile(known, [25, 50, 75])
    missing = f", {len(values) - len(known)} without" if len(known) < len(values) else ""
    return f"{middle:.3f}{missing}" if len(values) == 1 else f"{middle:.3f} ({low:.3f}–{high:.3f}){missing}"


def rows_of(
    faults: tuple[Fault, ...],
    places: dict[str, Path],
    last: int,
    trials: int,
    opened: Callable[[Path], Drive | Sequence] = open_sequence,
) -> list[list[object]]:
    """Rows of `HEADER`: all faults on all drives."""
    rows: list[list[object]] = []
    for fault in faults:
        for name, folder in places.items():
            rows.append([fault.name, name, *figures(fault, opened(folder), last, trials)])
            print(rows[-1], file=sys.stderr, flush=True)
    return rows


def main() -> int:
    parser = script_options(__file__, __doc__, "two faults, one trial, ten frames of one drive")
    parser.add_argument("--trials", type=int, default=10, help="runs of each row")
    parser.add_argument("--frames", type=int, default=60, help="of each drive, at most")
    arguments = parser.parse_args()
    found = recordings(DRIVES)
    if not found:
        print("perturbations: set SLAM_DATA to the folder that holds the drives; nothing was run")
        return 0
    faults, trials, frames = FAULTS, arguments.trials, arguments.frames
    if arguments.quick:
        faults, trials, frames = (FAULTS[0], FAULTS[4]), 1, 10
        found = dict(list(found.items())[:1])
    ways: dict[str, Callable[[Path], Drive | Sequence]] = {
        "as they are": open_sequence,
        "in a mirror": lambda folder: mirrored(open_sequence(folder)),
        "backwards": lambda folder: backwards(open_sequence(folder), frames),
    }
    whole = [rows_of((replace(NONE, name=way),), found, frames, trials, opened) for way, opened in ways.items()]
    print(f"Medians and quartiles of {trials} runs of the first {frames} frames:\n")
    show(arguments.out / "drives.json", HEADER, [row for rows in whole for row in rows], 2)
    spoilt_drives = {name: folder for name, folder in found.items() if name in SPOILT}
    print("\nThe drives as they are, with spoilt images:\n")
    show(arguments.out / "spoilt.json", HEADER, rows_of(faults, spoilt_drives, frames, trials), 2)
    return 0


if __name__ == "__main__":
    sys.exit(main())
