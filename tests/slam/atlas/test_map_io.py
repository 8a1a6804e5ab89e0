"""Maps in files, and starting in a map that is known."""

from dataclasses import fields, replace
from functools import cache

import numpy as np
import pytest

from slam.atlas.keyframes import Keyframe, Loop
from slam.atlas.map_io import SavedMap, decode, encode, load_map, map_arrays, map_of, save_map
from slam.checks import definite, require_known
from slam.config import SystemConfig
from slam.data import FrameStatus, StereoFeatures
from slam.errors import MeasurementError, SlamError
from slam.geometry import se3
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import exp
from slam.models import EstimatorModels
from slam.system import StereoSlam
from tests.slam.scene import BACKENDS, RIG, Cloud, path

CONFIG = SystemConfig(models=EstimatorModels(pixel_sigma=0.5))


def some_map(count=20, dimensions=16):
    rng = np.random.default_rng(1)
    d = rng.standard_normal((count, dimensions))
    return SavedMap(
        np.arange(count) * 2, rng.standard_normal((count, 3)), np.tile(0.01 * np.eye(3), (count, 1, 1)),
        (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32), np.ones(count, np.int8),
        np.arange(count), np.arange(count) + 1, "surf",
    )  # fmt: skip


@cache
def first_map(backend: str) -> SavedMap:
    """The map of a first run."""
    system, cloud = StereoSlam(RIG, None, backend, config=CONFIG), Cloud(150)
    for k, T in enumerate(path(25)):
        system.process_features(cloud.features(T, k / 30, 0.3)[0])
    return system.snapshot()


# --- the file ---


def test_any_altered_byte_is_found():
    data = encode(some_map())
    rng = np.random.default_rng(0)
    places = [*range(120), *rng.integers(0, len(data), 300).tolist()]
    for i in places:
        altered = bytearray(data)
        altered[i] ^= 1 << int(rng.integers(8))
        with pytest.raises(SlamError, match=r"a\.map") as error:
            decode(bytes(altered), "a.map")
        assert "\n" not in str(error.value)
    old = data.replace(b"map 7\n", b"map 6\n", 1)
    with pytest.raises(SlamError, match=r"version '6'.*version 7"):
        decode(old, "a.map")
    for other in (*(data[:n] for n in (0, 5, 22, 60, 90, 500, len(data) - 1)), data + b"\0"):
        with pytest.raises(SlamError, match=r"a\.map"):
            decode(other, "a.map")


def test_a_landmark_that_is_hardly_known_can_be_kept():
    """Of a point that is nearly at infinity rounding leaves no variance across, as of one in a recording."""
    R = se3.so3_exp(np.array([0.3, -0.5, 0.2]))
    P = np.stack([R @ np.diag([-48.6, 1.6e5, 5.9e17]) @ R.T, 1e-4 * np.eye(3)])
    with pytest.raises(MeasurementError, match="not symmetric and positive definite"):
        require_known("a map", np.arange(2), np.ones((2, 3)), P)
    require_known("a map", np.arange(2), np.ones((2, 3)), definite(P))
    np.testing.assert_array_equal(definite(P)[1], P[1])


# --- keyframes and loops in it ---


def keyframe(seed: int) -> Keyframe:
    rng = np.random.default_rng(seed)
    count = 5 + seed
    points = np.column_stack([rng.normal(size=(count, 2)), rng.uniform(2, 9, count)])
    P = np.diag(rng.uniform(1e-4, 1e-2, 6))
    return Keyframe(
        -1, float(seed), exp(rng.normal(size=6)), P, 0.1 * P, rng.normal(size=(6, 3)), 2.0 * seed,
        float(np.median(points[:, 2])), points.astype(np.float32), rng.normal(size=(count, 16)).astype(np.float16),
        np.sign(rng.normal(size=count)).astype(np.int8), np.arange(-1, count - 1),
    )  # fmt: skip


KEYFRAMES = tuple(keyframe(seed) for seed in range(4))
POSES = np.array([exp(0.1 * np.full(6, k)) for k in range(4)])
LOOPS = (Loop(0, 2, exp(np.arange(6) / 9), np.eye(6), 20), Loop(1, 3, exp(np.arange(6) / 7), 2 * np.eye(6), 30))


def saved(keyframes: tuple[Keyframe, ...]) -> SavedMap:
    once = np.ones(1, np.int64)
    return SavedMap(
        0 * once, np.zeros((1, 3)), np.eye(3)[None], np.zeros((1, 16), np.float32), once.astype(np.int8), once, once,
        keyframes=keyframes, keyframe_poses=POSES[: len(keyframes)], loops=LOOPS if keyframes else (),
    )  # fmt: skip


@pytest.mark.parametrize("before", [some_map(), saved(KEYFRAMES), saved(())])
def test_everything_comes_back(before: SavedMap, tmp_path):
    save_map(tmp_path / "a.map", before)
    after = load_map(tmp_path / "a.map")
    assert encode(after) == (tmp_path / "a.map").read_bytes()  # byte for byte
    assert [f.name for f in tmp_path.iterdir()] == ["a.map"]  # nothing temporary is left
    assert after.source == str(tmp_path / "a.map") and all(k.correction is None for k in after.keyframes)
    pairs = [(before, after), *zip(before.keyframes, after.keyframes, strict=True), *zip(before.loops, after.loops)]
    for one, other in pairs:
        for field in fields(one):
            if field.name not in ("source", "keyframes", "loops", "correction"):
                value = getattr(other, field.name)
                np.testing.assert_array_equal(value, getattr(one, field.name))
                assert np.asarray(value).dtype == np.asarray(getattr(one, field.name)).dtype
    assert len(after.loops) == len(before.loops)


@pytest.mark.parametrize(("name", "value"), [
    ("ids", np.zeros(2, np.int64)),
    ("positions", np.full((1, 3), 1e300)),
    ("covariances", np.zeros((1, 3, 3))),
    ("descriptors", np.full((1, 16), np.inf, np.float32)),
    ("keyframe_stamps", np.zeros(3)),
    ("keyframe_poses", np.tile(2 * np.eye(4), (4, 1, 1))),
    ("keyframe_covariances", np.tile(-np.eye(6), (4, 1, 1))),
    ("keyframe_steps", np.tile(np.triu(np.ones((6, 6))), (4, 1, 1))),
    ("keyframe_features", np.array([-5, 16, 7, 8])),
    ("place_points", np.full((26, 3), np.inf, np.float32)),
    ("place_descriptors", np.zeros((26, 8), np.float16)),
    ("loop_pairs", np.array([[0, 2], [1, 4]])),
    ("loop_pairs", np.array([[0, 2], [3, 3]])),
    ("loop_motions", np.zeros((2, 4, 4))),
])  # fmt: skip
def test_what_cannot_be_is_refused(name: str, value: np.ndarray):
    arrays = map_arrays(saved(KEYFRAMES))
    assert len(map_of(arrays, "", "a.map").keyframes) == 4
    with pytest.raises(SlamError, match=r"^a\.map: ") as error:
        map_of(arrays | {name: value.astype(arrays[name].dtype)}, "", "a.map")
    assert "\n" not in str(error.value)


# --- starting in it ---


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_second_run_elsewhere_in_the_map_is_in_the_maps_world(backend):
    cloud, known = Cloud(150), first_map(backend)
    start = se3.exp(np.array([0.02, -0.15, 0.05, -0.3, 0.1, 0.4]))
    system = StereoSlam(RIG, None, backend, config=CONFIG, prior_map=known)
    assert system.snapshot() is known
    dark = system.process_features(StereoFeatures.empty(0.0, 32))
    assert dark.status is FrameStatus.LOST and not dark.located and dark.map_size == len(known)
    errors = []
    for k, T in enumerate(path(30), start=1):
        truth = start @ T
        result = system.process_features(cloud.features(truth, k / 30, 0.3)[0])
        assert result.status is FrameStatus.TRACKED and result.located
        assert "of 0 landmarks" not in repr(result)  # where the camera is found, nothing was predicted
        errors.append(np.linalg.norm(result.estimate.T_world_left[:3, 3] - truth[:3, 3]))
    assert max(errors) < 0.02  # of points 2 to 6 m away, 0.3 px
    assert len(system.trajectory()) == 30  # the frame before the camera was found has no pose
    assert system.estimate().ids.max() > known.ids.max()  # new landmarks have numbers of their own


@pytest.mark.parametrize("backend", BACKENDS)
def test_where_nothing_is_known_the_camera_stays_lost_and_the_map_as_it_is(backend):
    known = first_map(backend)
    system, elsewhere = StereoSlam(RIG, None, backend, config=CONFIG, prior_map=known), Cloud(150, seed=9)
    for k, T in enumerate(path(8)):
        result = system.process_features(elsewhere.features(T, k / 30, 0.3)[0])
        assert result.status is FrameStatus.LOST and not len(result.added)
    assert encode(system.snapshot()) == encode(known)
    assert len(system.trajectory()) == 0


def test_there_is_no_map_before_the_first_frame_and_an_empty_one_is_refused():
    with pytest.raises(SlamError, match="no map yet"):
        StereoSlam(RIG, None, "ekf").snapshot()
    with pytest.raises(SlamError, match="holds no landmarks"):
        StereoSlam(RIG, None, "ekf", prior_map=some_map(0))


def test_descriptors_of_another_kind_are_refused():
    known = first_map("ekf")
    system = StereoSlam(RIG, None, "ekf", config=CONFIG, prior_map=known)
    assert system.process_features(StereoFeatures.empty(0.0, 64)).status is FrameStatus.LOST  # nothing to see
    features, _ = Cloud(60, dimensions=64).features(np.eye(4), 1.0)
    with pytest.raises(SlamError, match="descriptors have 64 numbers, those of earlier frames 32"):
        system.process_features(features)
    with pytest.raises(SlamError, match="front end 'orb'"):
        StereoSlam(RIG, "surf", "ekf", prior_map=replace(known, frontend="orb"))


@pytest.mark.parametrize(
    ("focal", "baseline", "width", "said"),
    [
        (1.01, 0.995, 1, ""),  # calibrated anew
        (1.0, 1.2, 1, "baseline 0.12 there, 0.144 here"),
        (0.5, 1.0, 1, "focal"),
        (1.0, 1.0, 2, "width"),
    ],
)
def test_a_map_of_another_rig_is_refused(focal, baseline, width, said):
    known = decode(encode(first_map("ekf")), "a.map")
    K = RIG.left.K * [[focal], [focal], [1]]
    size = RIG.width * width, RIG.height
    rig = StereoRig.from_pinhole(K, baseline=RIG.baseline * baseline, size=size)
    if not said:
        StereoSlam(rig, None, "ekf", config=CONFIG, prior_map=known)
        return
    with pytest.raises(SlamError, match=r"a\.map: the map is of another rig: " + said):
        StereoSlam(rig, None, "ekf", config=CONFIG, prior_map=known)


def test_a_prior_map_that_is_larger_than_the_limit_is_kept():
    known = first_map("ekf")
    small = replace(CONFIG, map=replace(CONFIG.map, target_in_view=10, max_landmarks=10))
    system = StereoSlam(RIG, None, "ekf", config=small, prior_map=known)
    assert system.config.map.max_landmarks == len(known) > 10
