"""Back ends on recorded stereo tracks of a drive: real outliers, no images, the association given.

    SLAM_DATA=/path/to/data python experiments/recorded_tracks.py [--quick] [--backend NAME ...] [--frames A:B]
        [--wrong FRACTION ...] [--seeds N] [--moved PX ...] [--set section.key=value ...] [--out DIR]

1000 frames and 1142 m of KITTI as Kanade-Lucas-Tomasi tracks. A landmark is a track without gaps; it joins when it
is seen with depth and fewer than ``map.target_in_view`` are, as in the whole system, and leaves when its track
ends. The settings are those of driving. Each update gets the pose on which most observations agree as its guess, as
in the whole system; no observation is held back. ``--wrong`` gives a share of the observations in every frame the
pixels of another track, others with each seed. ``--moved`` moves the right pixels, for a rig whose calibration is
off: by −0.19 px is what the self-calibration finds on the images of this drive, KITTI odometry 06. Printed are the
ATE, the translation error over segments of 100 to 800 m, how much too long the path is, the CPU time of the back
end's own calls, and how often a smoother was rebuilt: medians over the seeds, of the error over segments with the
smallest and the largest.
"""

from __future__ import annotations

import itertools
import os
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import backends
from experiments.common import script_options, span
from experiments.tables import picture, show
from slam.config import SystemConfig
from slam.data import Observations
from slam.evaluation.metrics import absolute_errors, segment_errors
from slam.geometry.pnp import find_consensus, measurement_rows
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, inverse
from slam.geometry.trajectory import Trajectory
from slam.interfaces import Backend
from slam.registry import ONLINE

FILE = "kitti_raw_tracks/2011_09_30_drive_0020"
SIZE = (1226, 370)  # of the rectified images [px]
_WARM_UP = 15  # frames of a replay before the timed one: compiled loops are loaded
HEADER = (
    "right pixels moved [px]", "wrong", "back end", "seeds", "ATE online [m]", "segment error online [%]",
    "path too long [%]", "rejected [%]", "updates failed", "rebuilds", "CPU ms, median", "CPU ms, max",
)  # fmt: skip


@dataclass(frozen=True)
class Tracks:
    """The recording.

    Attributes:
        rig: the cameras.
        stamps: (K,) [s].
        poses: true T_world_left (K, 4, 4), from GPS and inertial measurements; the first is the identity.
        pixels: (K, J, 4) = (uL, vL, uR, vR) of each track; NaN where it is not seen.
    """

    rig: StereoRig
    stamps: Array
    poses: Array
    pixels: Array

    def between(self, start: int, stop: int) -> Tracks:
        """Some of the frames; the world is the camera's frame at the first of them."""
        poses = inverse(self.poses[start]) @ self.poses[start:stop]
        return Tracks(self.rig, self.stamps[start:stop], poses, self.pixels[start:stop])

    def moved(self, right: float) -> Tracks:
        """The same with the right pixels moved to the right [px]."""
        return replace(self, pixels=self.pixels + np.array([0, 0, right, 0]))

    def seen(self, k: int, wrong: float = 0.0, seed: int = 1) -> Observations:
        """What was measured in frame k, a share of it with the pixels of other tracks; the id is the track's number."""
        ids = np.flatnonzero(np.isfinite(self.pixels[k, :, 0]))
        pixels = self.pixels[k, ids]
        chosen = np.random.default_rng([k, seed]).permutation(len(ids))[: round(wrong * len(ids))]
        pixels[chosen] = pixels[np.roll(chosen, 1)]
        return Observations(ids, pixels[:, :2], pixels[:, 2:])


def load(folder: Path) -> Tracks:
    """Read the recording from the data folder."""
    from scipy.io import loadmat

    raw = loadmat(folder / f"{FILE}_sync_KLT.mat")
    poses = np.tile(np.eye(4), (raw["t"].shape[1], 1, 1))
    poses[:, :3] = np.loadtxt(folder / f"{FILE}_poses_cam0_oxts.txt").reshape(-1, 3, 4)[: len(poses)]
    f, u0, v0, b = (float(raw[name].item()) for name in ("fu", "cu", "cv", "b"))
    pixels = raw["y_k_j"].transpose(1, 2, 0).copy()
    pixels[(pixels < 0).any(axis=2)] = np.nan
    return Tracks(StereoRig.rectified_pair(f, u0, v0, b, *SIZE), raw["t"][0], poses, pixels)


@dataclass(frozen=True)
class Step:
    """One frame of a replay: the pose T_world_left (4, 4), what the update did, and CPU time [ms]."""

    T_world_left: Array
    used: int
    rejected: int
    status: str
    milliseconds: float


def replay(tracks: Tracks, backend: Backend, config: SystemConfig, wrong: float = 0.0, seed: int = 1) -> Iterator[Step]:
    """Take a back end through the frames."""
    known: set[int] = set()
    for k, stamp in enumerate(tracks.stamps.tolist()):
        seen = tracks.seen(k, wrong, seed)
        old = np.array([i in known for i in seen.ids.tolist()], bool)
        deep = ~old & np.isfinite(tracks.rig.triangulate(seen.uv_left, seen.uv_right)).all(axis=1)
        new = seen.select(np.flatnonzero(deep)[: max(0, config.map.target_in_view - int(old.sum()))])
        ended = sorted(known - set(seen.ids.tolist()))
        began = time.process_time()
        prediction = backend.predict(stamp)
        spent = time.process_time() - began
        guess = agreement(tracks.rig, backend, seen.select(old), prediction.T_world_left, config, k)
        began = time.process_time()
        report = backend.update(seen.select(old), guess)
        backend.add(new)
        backend.remove(ended)
        estimate = backend.estimate(landmarks=False)
        spent += time.process_time() - began
        known = (known | set(new.ids.tolist())) - set(ended)
        yield Step(estimate.T_world_left, len(report.used), len(report.rejected), report.status.value, 1e3 * spent)


def agreement(
    rig: StereoRig, backend: Backend, seen: Observations, expected: Array, config: SystemConfig, seed: int
) -> Array | None:
    """The pose (4, 4) on which most observations agree; None without any."""
    if not len(seen):
        return None
    z = measurement_rows(seen.uv_left, seen.uv_right)
    threshold = config.association.consistency_sigmas * config.models.pixel_sigma
    points, hypotheses = backend.positions(seen.ids), config.association.hypotheses
    return find_consensus(rig, points, z, expected, threshold, hypotheses, seed).T_world_left


@dataclass(frozen=True)
class Run:
    """A replay that has ended.

    Attributes:
        online: the path as said frame by frame; truth: the true one.
        ate: of the online path [m].
        segments: its translation error over segments [%].
        too_long: by how much its length is more than the true one [%].
        rejected: share of the observations [%].
        failed: number of updates.
        rebuilds: of a smoother; None for others.
        milliseconds: CPU time of each frame.
    """

    online: Trajectory
    truth: Trajectory
    ate: float
    segments: float
    too_long: float
    rejected: float
    failed: int
    rebuilds: int | None
    milliseconds: Array


def run(tracks: Tracks, name: str, settings: Sequence[str], wrong: float, seed: int) -> Run:
    """One back end over all frames."""
    config = SystemConfig.for_kind("driving", None, name).with_settings(list(settings))
    warm_up = backends.create(name, tracks.rig, models=config.models, **config.backend)
    for _ in zip(range(_WARM_UP), replay(tracks, warm_up, config)):
        pass
    backend = backends.create(name, tracks.rig, models=config.models, **config.backend)
    steps = list(replay(tracks, backend, config, wrong, seed))
    online, truth = (Trajectory(tracks.stamps, p) for p in (np.array([s.T_world_left for s in steps]), tracks.poses))
    rejected = sum(s.rejected for s in steps)
    offered = rejected + sum(s.used for s in steps)
    found = Run(
        online,
        truth,
        absolute_errors(online, truth).translation_statistics.rmse,
        segment_errors(online, truth).mean_translation,
        100 * (online.length / truth.length - 1),
        100 * rejected / max(1, offered),
        sum(s.status == "failed" for s in steps),
        getattr(backend, "rebuilds", None),
        np.array([s.milliseconds for s in steps]),
    )
    print(f"{name}, {100 * wrong:.0f} % wrong, seed {seed}: {found.segments:.2f} %", file=sys.stderr, flush=True)
    return found


def row(moved: float, wrong: float, name: str, runs: Sequence[Run]) -> list[str | float | int | None]:
    """The figures of several seeds, in the order of the header."""

    def median(values: Iterable[float]) -> float:
        return float(np.median(list(values)))

    segments = [one.segments for one in runs]
    spread = f" ({min(segments):.2f} to {max(segments):.2f})" if len(runs) > 1 else ""
    rebuilds = [one.rebuilds for one in runs if one.rebuilds is not None]
    return [
        f"{moved:g}", f"{100 * wrong:.0f} %", name, len(runs), median(one.ate for one in runs),
        f"{median(segments):.2f}{spread}", median(one.too_long for one in runs), median(one.rejected for one in runs),
        sum(one.failed for one in runs), max(rebuilds) if rebuilds else None,
        median(float(np.median(one.milliseconds)) for one in runs), max(float(one.milliseconds.max()) for one in runs),
    ]  # fmt: skip


def draw(found: dict[str, Run], path: Path) -> None:
    """Online paths by label, from above, with the true one."""
    with picture(path, 5, 7) as (axis,):
        axis.plot(*next(iter(found.values())).truth.positions[:, [0, 2]].T, "k--", lw=1, label="truth")
        for label, one in found.items():
            axis.plot(*one.online.positions[:, [0, 2]].T, lw=1, label=label)
        axis.set(xlabel="right [m]", ylabel="forward [m]")
        axis.axis("equal")
        axis.legend(frameon=False, fontsize=7)


def main() -> int:
    parser = script_options(__file__, __doc__, "forty frames")
    parser.add_argument("--backend", nargs="*", default=ONLINE, metavar="NAME", help="back ends")
    parser.add_argument("--frames", type=span, default=(0, 1000), metavar="A:B", help="from A to before B")
    parser.add_argument("--wrong", type=float, nargs="*", default=[0.0], metavar="FRACTION", help="of wrong matches")
    parser.add_argument("--seeds", type=int, default=1, metavar="N", help="of the wrong matches")
    parser.add_argument(
        "--moved", type=float, nargs="*", default=[0.0], metavar="PX", help="right pixels, to the right"
    )
    parser.add_argument("--set", nargs="*", default=[], metavar="section.key=value", help="settings, as in slam run")
    given = parser.parse_args()
    folder = Path(os.environ.get("SLAM_DATA", "."))
    if not (folder / f"{FILE}_sync_KLT.mat").is_file():
        print(f"recorded tracks: set SLAM_DATA to the folder that holds {FILE}*; nothing was run")
        return 0
    start, stop = (0, 40) if given.quick else given.frames
    tracks = load(folder).between(start, stop)
    rows, drawn = [], {}
    for moved, wrong, name in itertools.product(given.moved, given.wrong, given.backend):
        seeds = range(1, 1 + (given.seeds if wrong else 1))  # without wrong matches all are the same
        runs = [run(tracks.moved(moved), name, given.set, wrong, seed) for seed in seeds]
        rows.append(row(moved, wrong, name, runs))
        drawn.setdefault(f"{name}, moved by {moved:g} px" if moved else name, runs[0])
    print(f"Frames {start} to {stop}.\n")
    show(given.out / "table.json", HEADER, rows, 3)
    draw(drawn, given.out / "recorded_tracks.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
