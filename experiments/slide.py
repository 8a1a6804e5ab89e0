"""How far features slide over surfaces as the viewpoint changes: where `slam.models.SlideModel` has its numbers from.

    SLAM_DATA=/path/to/data python experiments/slide.py [--quick] [--out DIR]

Of every two measurements of a landmark, the distance of the later left pixel from the epipolar line of the earlier one,
on the final path of `window`. It depends on no depth. Prints standard deviations, by the median of absolute values,
for classes of the angle between the two lines of sight; and q, the growth of their squares with the angle.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from itertools import pairwise
from pathlib import Path
from unittest import mock

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from backends.window import WindowBackend
from experiments.ablation_parts import CASES
from experiments.common import recordings, script_options
from experiments.tables import show
from slam.data import Observations, UpdateReport
from slam.geometry.se3 import Array, inverse
from slam.sequences import Sequence, open_sequence
from slam.system import StereoSlam
from slam.window.stereo import RectifiedStereo

NAMES = ("KITTI 06", "raw 0001", "MH_01")
FRAMES = 51
EDGES = (0.002, 0.005, 0.01, 0.02, 0.04, 0.08, 0.16)  # of the classes [rad]
HEADER = ("recording", "pairs", *(f"{a:g} to {b:g} rad" for a, b in pairwise(EDGES)), "q [px²/rad]")
_DEVIATION = 1.4826  # of a normal distribution, in its median absolute values


def measured(sequence: Sequence, frames: int) -> tuple[list[Array], Array, RectifiedStereo]:
    """By landmark, rows (frame, u, v) of all that was used of it; the path (F, 4, 4), and the projection."""
    found: dict[int, list[tuple[float, ...]]] = defaultdict(list)
    update, add = WindowBackend.update, WindowBackend.add
    stamps: list[float] = []

    def keep(seen: Observations) -> None:
        for i, uv in zip(seen.ids.tolist(), seen.uv_left.tolist()):
            found[i].append((len(stamps), *uv))

    def updated(self: WindowBackend, seen: Observations, guess: Array | None = None) -> UpdateReport:
        report = update(self, seen, guess)
        keep(seen.select(np.isin(seen.ids, report.used)))
        return report

    def added(self: WindowBackend, seen: Observations) -> None:
        add(self, seen)
        keep(seen)

    system, stereo = (
        StereoSlam(sequence.rig, backend="window", kind=sequence.kind),
        RectifiedStereo.of(sequence.rig.rectified.rig),
    )
    with mock.patch.object(WindowBackend, "update", updated), mock.patch.object(WindowBackend, "add", added):
        for one in sequence.frames(0, frames):
            system.process(one)
            stamps.append(one.stamp)
    return [np.array(rows) for rows in found.values()], system.backend.trajectory().poses, stereo


def distances(rows: Array, poses: Array, stereo: RectifiedStereo) -> Array:
    """Angles [rad] and distances [px] (P, 2) of all pairs of a landmark's measurements."""
    a, b = np.triu_indices(len(rows), 1)
    T = poses[rows[:, 0].astype(int)]
    rays = np.column_stack([(rows[:, 1:] - (stereo.u0, stereo.v0)) / stereo.f, np.ones(len(rows))])
    turned = (inverse(T[b]) @ T[a])[:, :3]
    first = np.einsum("nij,nj->ni", turned[:, :, :3], rays[a])
    line = np.cross(turned[:, :, 3], first)
    cosine = (first * rays[b]).sum(axis=1) / np.linalg.norm(first, axis=1) / np.linalg.norm(rays[b], axis=1)
    off = stereo.f * (line * rays[b]).sum(axis=1) / np.maximum(np.linalg.norm(line[:, :2], axis=1), 1e-12)
    return np.column_stack([np.arccos(np.clip(cosine, -1.0, 1.0)), off])


def row(name: str, path: Path, frames: int) -> list[object]:
    """Of the table."""
    landmarks, poses, stereo = measured(open_sequence(path), frames)
    pairs = np.concatenate([distances(rows, poses, stereo) for rows in landmarks])
    classes = [pairs[(low <= pairs[:, 0]) & (pairs[:, 0] < high)] for low, high in pairwise(EDGES)]
    sigmas = np.array([_DEVIATION * np.median(np.abs(c[:, 1])) if len(c) else np.nan for c in classes])
    angles = np.array([np.mean(c[:, 0]) if len(c) else np.nan for c in classes])
    known = np.isfinite(sigmas)
    q = np.polyfit(angles[known], sigmas[known] ** 2, 1)[0] if known.sum() > 1 else np.nan
    return [name, len(pairs), *sigmas.tolist(), float(q)]


def main() -> int:
    arguments = script_options(__file__, __doc__, "ten frames of one recording").parse_args()
    paths = recordings({case.name: case.path for case in CASES if case.name in NAMES})
    if not paths:
        print("slide: set SLAM_DATA to the folder that holds the recordings; nothing was run")
        return 0
    if arguments.quick:
        paths = dict(list(paths.items())[:1])
    rows = [row(name, path, 10 if arguments.quick else FRAMES) for name, path in paths.items()]
    show(arguments.out / "slide.json", HEADER, rows, 2)
    return 0


if __name__ == "__main__":
    sys.exit(main())
