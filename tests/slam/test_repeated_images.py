"""Images that come again are no measurement: the pose is predicted, and frame and run say so."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import slam
from slam.data import FrameStatus, StereoFrame
from slam.input.warnings import REPEATED

SEQUENCE = slam.open_sequence("synthetic:desk?frames=20")
FROZEN = [*range(12), *[11] * 7, *range(12, 20)]


@cache
def frames() -> list[StereoFrame]:
    return list(SEQUENCE)


def shown(order: list[int], given: list[StereoFrame] | None = None) -> list[StereoFrame]:
    """These frames, one after the other."""
    return [replace((given or frames())[k], index=j, stamp=j / 30) for j, k in enumerate(order)]


def system() -> slam.StereoSlam:
    return slam.StereoSlam(SEQUENCE.rig, "surf", "ekf")


def repeats(results) -> list[int]:
    return [result.index for result in results if REPEATED in result.reason]


def test_frozen_images_are_predicted_and_said(caplog):
    s = system()
    results = [s.process(frame) for frame in shown(FROZEN)]
    assert repeats(results) == list(range(12, 19))
    before, frozen, after = results[11], results[12:19], results[19:]
    assert {r.status for r in frozen} <= {FrameStatus.PREDICTED, FrameStatus.LOST}
    assert all(len(r.features) == len(r.matched) == len(r.added) == len(r.erased) == 0 for r in frozen)
    grown = [np.trace(r.estimate.covariance) for r in (before, *frozen)]
    assert grown == sorted(grown)
    assert {r.status for r in after} == {FrameStatus.TRACKED}
    truth = SEQUENCE.ground_truth.poses
    apart = np.linalg.norm((after[-1].estimate.T_world_left - np.linalg.inv(truth[0]) @ truth[-1])[:3, 3])
    assert apart < 0.02
    (line,) = s.warnings
    assert line.startswith(f"frame 12: {REPEATED}") and [r.message for r in caplog.records].count(line) == 1


def noisy(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.clip(image + np.rint(rng.normal(0, 1, image.shape)), 0, 255).astype(np.uint8)


@pytest.mark.slow
def test_frames_that_a_video_doubles_are_no_stop():
    """They are compressed anew, so bytes differ; a car at 8 m/s does not stop, and go on, from frame to frame."""
    street, rng = slam.open_sequence("synthetic:street?frames=14"), np.random.default_rng(0)
    frames = list(street)
    for k in (6, 9, 10):
        frames[k] = replace(frames[k], left=noisy(frames[k - 1].left, rng), right=noisy(frames[k - 1].right, rng))
    s = slam.StereoSlam(street.rig, "surf", "ekf", kind=street.kind)
    results = [s.process(frame) for frame in frames]
    assert repeats(results) == [6, 9, 10]
    assert all(r.status.measured for r in results[1:] if r.index not in (6, 9, 10))
    steps = np.linalg.norm(np.diff([r.estimate.T_world_left[:3, 3] for r in results], axis=0), axis=1)
    true = np.linalg.norm(np.diff(street.ground_truth.poses[:14, :3, 3], axis=0), axis=1)
    assert np.abs(steps / true - 1).max() < 0.05


def test_a_camera_that_stands_still_is_tracked_by_its_noise():
    rng, last = np.random.default_rng(0), frames()[5]
    still = [StereoFrame(0, 0.0, noisy(last.left, rng), noisy(last.right, rng)) for _ in range(6)]
    s = system()
    results = [s.process(frame) for frame in shown(list(range(12)), [*frames()[:6], *still])]
    assert {r.status for r in results[1:]} == {FrameStatus.TRACKED} and s.warnings == []
