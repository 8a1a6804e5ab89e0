"""How errors of pixels are correlated from frame to frame: residuals of landmarks on real recordings.

    SLAM_DATA=/path/to/data python experiments/residuals.py [--quick] [--out DIR]

Each landmark is triangulated from all its measurements, with the smoother's final poses, and its reprojection errors
are looked at along its life. White noise changes as much from one frame to the next as over ten frames. What grows with
the time between is an error that lasts: the patch slides over the surface as the view changes, or the surface is not
flat. Poses have an error too, which all landmarks of a frame share; over ten frames it is small. Prints a Markdown
table.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from experiments.common import recordings, script_options
from experiments.real_sequences import SEQUENCES
from experiments.tables import markdown, write_json
from slam.config import SystemConfig
from slam.data import FrameStatus
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, inverse, transform
from slam.sequences import open_sequence
from slam.system import StereoSlam

RECORDINGS = {name: path for name, path in SEQUENCES.items() if name.startswith("KITTI")}
RECORDINGS["library, by hand"] = "handheld_library"
LAGS = (1, 2, 5, 10, 20)

_SHORTEST = 4  # measurements of a landmark
_ROUNDS = 8  # of Gauss-Newton
_WRONG = 4.0  # error of a pixel beyond which the landmark has a wrong match [px]
_MEDIAN = 0.6745  # median of the absolute value of a Gaussian number of unit variance
_FEWEST = 50  # pairs that a figure is made of


@dataclass(frozen=True)
class Run:
    """What a run measured.

    Attributes:
        rig: the rectified rig.
        poses: of its left camera in each frame, final (F, 4, 4).
        tracks: frame and measurement (uL, vL, uR) [px] of each landmark, by its id.
        pixel_sigma: of the models [px].
        nis: per degree of freedom, median of the frames.
    """

    rig: StereoRig
    poses: Array
    tracks: Mapping[int, list[tuple[int, Array]]]
    pixel_sigma: float
    nis: float


def run(folder: Path, frames: int | None) -> Run:
    """Run the smoother."""
    sequence = open_sequence(folder)
    config = SystemConfig.for_kind(sequence.kind, "surf", "smoother")
    system, rectified = StereoSlam(sequence.rig, backend="smoother", config=config), sequence.rig.rectified
    tracks, nis = defaultdict(list), []
    for frame in islice(sequence, frames):
        result = system.process(frame)
        if result.status is not FrameStatus.TRACKED:
            continue
        nis.append(result.report.nis / max(result.report.dof, 1))
        f, rows = result.features, result.matched_features
        good = f.has_stereo[rows] & np.isin(result.matched, result.report.used)
        left, right = rectified.rectify_left(f.uv_left[rows[good]]), rectified.rectify_right(f.uv_right[rows[good]])
        for i, z in zip(result.matched[good].tolist(), np.column_stack([left, right[:, 0]])):
            tracks[i].append((frame.index, z))
    poses = system.trajectory().poses @ rectified.T_left_rectified
    return Run(rectified.rig, poses, tracks, config.models.pixel_sigma, float(np.median(nis)))


def residuals(rig: StereoRig, poses: Array, z: Array) -> Array | None:
    """Reprojection errors (N, 3) [px] of a landmark triangulated from all its measurements; None if that fails."""
    X, back = transform(poses[0], rig.triangulate(z[:1, :2], z[:1, [2, 1]]))[0], inverse(poses)
    for _ in range(_ROUNDS):
        local = back[:, :3, :3] @ X + back[:, :3, 3]
        predicted, J = rig.project_stereo(local)
        r = z - predicted
        if not np.isfinite(r).all():
            return None
        X = X + np.linalg.lstsq((J @ back[:, :3, :3]).reshape(-1, 3), r.ravel(), rcond=None)[0]
    return r if np.abs(r).max() < _WRONG else None


def row(name: str, folder: Path, frames: int | None) -> list[str]:
    """A row of the table."""
    done = run(folder, frames)
    changes: dict[int, list[float]] = {lag: [] for lag in LAGS}
    squares, lengths = [], []
    for track in done.tracks.values():
        numbers = [k for k, _ in track]
        r = (
            residuals(done.rig, done.poses[numbers], np.array([z for _, z in track]))
            if len(track) >= _SHORTEST
            else None
        )
        if r is None:
            continue
        squares.append(np.square(r).sum(axis=0) / (len(r) - 1))
        lengths.append(len(r))
        at = dict(zip(numbers, r[:, 0].tolist()))
        for lag in LAGS:
            changes[lag] += [at[k + lag] - at[k] for k in at if k + lag in at]
    each = [
        f"{np.median(np.abs(c)) / _MEDIAN / np.sqrt(2):.2f}" if len(c) >= _FEWEST else "–" for c in changes.values()
    ]
    rms = f"{np.sqrt(np.mean(squares)):.2f}" if squares else "–"
    life = f"{np.median(lengths):.0f}" if lengths else "–"
    return [name, str(len(lengths)), life, *each, rms, f"{done.pixel_sigma:.1f}", f"{done.nis:.2f}"]


def main() -> int:
    parser = script_options(__file__, __doc__, "twelve frames of each recording")
    arguments = parser.parse_args()
    found = recordings(RECORDINGS)
    if not found:
        print("residuals: set SLAM_DATA to the folder that holds the recordings; nothing was run")
        return 0
    header = ("recording", "landmarks", "life, median [frames]", *(f"after {lag}" for lag in LAGS), "residual [px]",
              "pixel_sigma [px]", "NIS/dof")  # fmt: skip
    rows = [row(name, folder, 12 if arguments.quick else None) for name, folder in found.items()]
    print(markdown(header, rows))
    write_json(arguments.out / "table.json", header, rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
