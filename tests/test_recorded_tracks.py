"""Both back ends on recorded stereo tracks of a drive, with its real outliers; skipped where they are not there."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import backends
from slam.config import SystemConfig
from slam.data import Observations
from slam.geometry.rig import StereoRig, measurement_rows
from slam.geometry.se3 import Array, inverse
from slam.interfaces import Backend
from slam.window.consensus import find_consensus

FILE = "kitti_raw_tracks/2011_09_30_drive_0020"
SIZE = (1226, 370)  # of the rectified images [px]


@dataclass(frozen=True)
class Tracks:
    """1142 m of KITTI as Kanade-Lucas-Tomasi tracks: real outliers, no images, the association given."""

    rig: StereoRig
    stamps: Array  # (K,) [s]
    poses: Array  # true T_world_left (K, 4, 4), from GPS and inertial measurements; the first is the identity
    pixels: Array  # (K, J, 4) = (uL, vL, uR, vR) of each track; NaN where it is not seen

    def between(self, start: int, stop: int) -> Tracks:
        """Some of the frames; the world is the camera's frame at the first of them."""
        poses = inverse(self.poses[start]) @ self.poses[start:stop]
        return Tracks(self.rig, self.stamps[start:stop], poses, self.pixels[start:stop])

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
    """One frame of a replay: the pose T_world_left (4, 4), and what the update did."""

    T_world_left: Array
    used: int
    rejected: int
    status: str


def replay(tracks: Tracks, backend: Backend, config: SystemConfig, wrong: float = 0.0, seed: int = 1) -> Iterator[Step]:
    """Take a back end through the frames."""
    known: set[int] = set()
    for k, stamp in enumerate(tracks.stamps.tolist()):
        seen = tracks.seen(k, wrong, seed)
        old = np.array([i in known for i in seen.ids.tolist()], bool)
        deep = ~old & np.isfinite(tracks.rig.triangulate(seen.uv_left, seen.uv_right)).all(axis=1)
        new = seen.select(np.flatnonzero(deep)[: max(0, config.map.target_in_view - int(old.sum()))])
        ended = sorted(known - set(seen.ids.tolist()))
        prediction = backend.predict(stamp)
        guess = agreement(tracks.rig, backend, seen.select(old), prediction.T_world_left, config, k)
        report = backend.update(seen.select(old), guess)
        backend.add(new)
        backend.remove(ended)
        estimate = backend.estimate(landmarks=False)
        known = (known | set(new.ids.tolist())) - set(ended)
        yield Step(estimate.T_world_left, len(report.used), len(report.rejected), report.status.value)


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


def replayed(folder, name, start, stop, wrong=0.0):
    """The steps of a replay, the back end, and how far it is off over the whole stretch [m]."""
    tracks = load(folder).between(start, stop)
    config = SystemConfig.for_kind("driving", None)
    backend = backends.create(name, tracks.rig, models=config.models, **config.backend)
    steps = list(replay(tracks, backend, config, wrong))
    moved = inverse(steps[0].T_world_left) @ steps[-1].T_world_left
    off = np.linalg.norm(moved[:3, 3] - (inverse(tracks.poses[0]) @ tracks.poses[-1])[:3, 3])
    return steps, backend, off


@pytest.mark.parametrize("name", ["ekf", "smoother", "window"])
def test_the_first_frames_are_not_rejected(slam_data, name):
    """At 11 m/s, of which nothing is known at first. The truth of these frames is off by 1.4 m itself.

    Disparities of frame 0 are half of those of frame 1, so its landmarks are rejected rightly.
    """
    steps, _, off = replayed(slam_data, name, 2, 27)
    assert all(step.status == "ok" and step.used > step.rejected for step in steps[1:])
    assert off < 3


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [0.0, 0.2])
@pytest.mark.parametrize("name", ["ekf", "smoother", "window"])
def test_far_tracks_alone_do_not_make_it_run_away(slam_data, name, wrong):
    """Where all tracks were 80 m away, each frame was solved again from frame 435 on, and was off by up to 16 m."""
    steps, backend, off = replayed(slam_data, name, 370, 450, wrong)
    assert {step.status for step in steps[1:]} == {"ok"}
    assert getattr(backend, "rebuilds", 0) == 0
    assert off < 8
    assert np.median([step.used / (step.used + step.rejected) for step in steps[1:]]) > 0.9 - 2 * wrong
