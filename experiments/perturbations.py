"""Spoilt recordings: unequal exposure, noise, flicker, half the frame rate, a vertical error of the right camera.

    SLAM_DATA=/path/to/data python experiments/perturbations.py [--quick] [--trials N] [--out DIR]

Each fault is put into the images of two real drives. As single figures of SLAM say little, each is run several times,
with another first frame, pixel noise of half a grey level, and up to 20 % more or fewer features. Prints a Markdown
table: medians of the online ATE, and frames without a measured pose, all runs together. A run of all faults takes some
six minutes of processor time.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from experiments.tables import markdown, write_json
from frontends import create
from slam.config import SystemConfig
from slam.data import FrameStatus, StereoFeatures, StereoFrame
from slam.evaluation.summary import evaluate
from slam.geometry.trajectory import Trajectory
from slam.sequences import Sequence, open_sequence
from slam.system import StereoSlam

DRIVES = {
    "KITTI 06": ("kitti_odometry/sequences/06", 51),
    "raw 0001": ("kitti_raw/2011_09_26/2011_09_26_drive_0001_sync", 108),
}
BACKENDS = ("ekf", "smoother")
HEADER = ("fault", "drive", "ATE ekf [m]", "ATE smoother [m]", "frames", "lost ekf", "lost smoother")

_FIRST = 5  # frames that may be left out at the beginning
_FEATURES = 0.2  # by how much the number of features may differ
_MEASURED = (FrameStatus.STARTED, FrameStatus.TRACKED)

Image = np.ndarray
#: Spoils the two images of a frame.
Spoil = Callable[[Image, Image, np.random.Generator], tuple[Image, Image]]


def unspoilt(left: Image, right: Image, _: np.random.Generator) -> tuple[Image, Image]:
    return left, right


def exposed(left: Image, right: Image, _: np.random.Generator) -> tuple[Image, Image]:
    """The right image 1.3 times as bright."""
    return left, 1.3 * right


def noisy(sigma: float) -> Spoil:
    """Sensor noise [grey levels]."""

    def spoil(left: Image, right: Image, rng: np.random.Generator) -> tuple[Image, Image]:
        return left + rng.normal(0, sigma, left.shape), right + rng.normal(0, sigma, right.shape)

    return spoil


def flickering(left: Image, right: Image, rng: np.random.Generator) -> tuple[Image, Image]:
    """Both images up to 30 % brighter or darker, anew in each frame."""
    gain = rng.uniform(0.7, 1.3)
    return gain * left, gain * right


def shifted(rows: float) -> Spoil:
    """The right image lower by so many rows."""

    def spoil(left: Image, right: Image, _: np.random.Generator) -> tuple[Image, Image]:
        by = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, rows]])
        size = right.shape[1], right.shape[0]
        return left, cv2.warpAffine(right, by, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)

    return spoil


@dataclass(frozen=True)
class Fault:
    """What is wrong with a recording.

    Attributes:
        name: for the table.
        spoil: of the images.
        every: so many frames are one of the recording.
    """

    name: str
    spoil: Spoil
    every: int = 1


FAULTS = (
    Fault("none", unspoilt),
    Fault("right image 1.3 times as bright", exposed),
    Fault("noise of 5 grey levels", noisy(5.0)),
    Fault("noise of 10 grey levels", noisy(10.0)),
    Fault("flicker of 30 %", flickering),
    Fault("5 frames a second", unspoilt, 2),
    Fault("right image 0.5 px lower", shifted(0.5)),
    Fault("right image 1 px lower", shifted(1.0)),
)


@dataclass(frozen=True)
class Outcome:
    """Of one run.

    Attributes:
        ate: of the poses that were measured [m].
        frames: number of frames.
        lost: frames without a measured pose.
    """

    ate: float
    frames: int
    lost: int


def spoilt(sequence: Sequence, fault: Fault, last: int, trial: int) -> Iterator[StereoFrame]:
    """The frames of one trial; no frame depends on which others are taken."""
    first = np.random.default_rng(trial).integers(_FIRST)
    for frame in sequence.frames(int(first), last):
        if (frame.index - first) % fault.every or frame.left is None or frame.right is None:
            continue
        rng = np.random.default_rng([trial, frame.index])
        images = fault.spoil(frame.left.astype(float), frame.right.astype(float), rng)
        left, right = (np.clip(np.rint(x + rng.normal(0, 0.5, x.shape)), 0, 255).astype(np.uint8) for x in images)
        yield replace(frame, left=left, right=right)


def extracted(sequence: Sequence, fault: Fault, last: int, trial: int) -> list[StereoFeatures]:
    """Features of one trial, for all back ends."""
    options = SystemConfig.for_kind(sequence.kind).frontend
    plain = create("surf", sequence.rig, **options)
    more = np.random.default_rng([trial, 1]).uniform(1 - _FEATURES, 1 + _FEATURES)
    frontend = create("surf", sequence.rig, **{**options, "features": round(more * plain.config.features)})
    return [frontend.extract(frame) for frame in spoilt(sequence, fault, last, trial)]


def run(sequence: Sequence, features: list[StereoFeatures], backend: str) -> Outcome:
    """One back end on one trial."""
    system = StereoSlam(sequence.rig, None, backend, config=SystemConfig.for_kind(sequence.kind, "surf", backend))
    results = [system.process_features(one) for one in features]
    measured = [r.estimate for r in results if r.status in _MEASURED]
    path = Trajectory(np.array([e.stamp for e in measured]), np.array([e.T_world_left for e in measured]))
    ate = evaluate(path, sequence).get("ATE RMSE [m]") if len(measured) > 2 else None
    return Outcome(float("nan") if ate is None else float(ate), len(results), len(results) - len(measured))


def row(fault: Fault, name: str, sequence: Sequence, last: int, trials: int) -> list[object]:
    """A row of the table."""
    outcomes: dict[str, list[Outcome]] = {backend: [] for backend in BACKENDS}
    for trial in range(trials):
        features = extracted(sequence, fault, last, trial)
        for backend in BACKENDS:
            outcomes[backend].append(run(sequence, features, backend))
    ates = [f"{np.median([o.ate for o in outcomes[backend]]):.3f}" for backend in BACKENDS]
    lost = [sum(o.lost for o in outcomes[backend]) for backend in BACKENDS]
    return [fault.name, name, *ates, sum(o.frames for o in outcomes[BACKENDS[0]]), *lost]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="two faults, one trial, ten frames of one drive")
    parser.add_argument("--trials", type=int, default=5, help="runs of each fault")
    parser.add_argument("--out", type=Path, default=Path("results/perturbations"))
    arguments = parser.parse_args()
    data = os.environ.get("SLAM_DATA")
    if not data:
        print("perturbations: set SLAM_DATA to the folder that holds the drives; nothing was run")
        return 0
    found = {name: (Path(data) / folder, last) for name, (folder, last) in DRIVES.items()}
    found = {name: place for name, place in found.items() if place[0].is_dir()}
    faults, trials = FAULTS, arguments.trials
    if arguments.quick:
        faults, trials = (FAULTS[1], FAULTS[5]), 1
        found = {name: (folder, 15) for name, (folder, _) in list(found.items())[:1]}
    rows = []
    for fault in faults:
        for name, (folder, last) in found.items():
            rows.append(row(fault, name, open_sequence(folder), last, trials))
            print(rows[-1], file=sys.stderr, flush=True)
    print(f"Medians of {trials} runs.\n")
    print(markdown(HEADER, rows, 2))
    write_json(arguments.out / "table.json", HEADER, rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
