import numpy as np
import pytest

from slam.errors import SlamError
from slam.worlds import open_world
from slam.worlds.observe import visible_landmarks

CLEAN = "detect=1&stereo=1&outliers=0&confusion=0"


def residuals(query: str, frames: int = 38) -> tuple[np.ndarray, np.ndarray]:
    """Errors of uL, vL, uR (N, 3) [px], and how far vR lies off the epipolar line (N,) [px]."""
    sequence = open_world(f"aisle?{query}&{CLEAN}")
    errors, off = [], []
    for k in range(0, 40 * frames, 40):
        seen, truth = sequence.simulate(k), visible_landmarks(sequence.world, k)
        rows = np.searchsorted(truth.ids, seen.ids)
        stereo = seen.features.has_stereo & np.isfinite(truth.uv_right[rows, 0])
        f, rows = seen.features, rows[stereo]
        left, right = f.uv_left[stereo], f.uv_right[stereo]
        errors.append(np.column_stack([left - truth.uv_left[rows], right[:, 0] - truth.uv_right[rows, 0]]))
        point = sequence.rig.triangulate(left, right)
        off.append(sequence.rig.project(point)[1][:, 1] - right[:, 1])
    return np.concatenate(errors), np.concatenate(off)


@pytest.mark.parametrize("rig", ["rectified", "toedin"])
def test_noise_is_isotropic_and_keeps_to_the_epipolar_geometry(rig):
    errors, off = residuals(f"rig={rig}&sigma=0.5")
    assert len(errors) > 2000
    covariance = np.cov(errors.T)
    # The estimate's own deviation is √2 · 0.25 / √2000 = 0.008.
    assert np.allclose(covariance, 0.25 * np.eye(3), atol=0.04)
    assert np.abs(errors.mean(axis=0)).max() < 0.05
    assert np.abs(off).max() < 1e-6


def test_frames_are_the_same_in_any_order_and_differ_by_seed():
    a, b, c = (open_world(f"desk?seed={seed}") for seed in (1, 1, 2))
    for k in (33, 30, 31):
        f, g, h = a.simulate(k).features, b.observations(k), c.observations(k)
        assert np.array_equal(f.uv_left, g.uv_left)
        assert np.array_equal(f.uv_right, g.uv_right, equal_nan=True)
        assert np.array_equal(f.descriptors, g.descriptors)
        assert f.uv_left.shape != h.uv_left.shape or not np.array_equal(f.uv_left, h.uv_left)
        assert f.stamp == a.stamps[k]


def test_only_what_the_camera_sees_is_visible():
    """Visibility from geometry against the rendered depth: a second way to the same truth."""
    sequence = open_world("boxes?camera=moving&density=200")
    for k in (60, 200, 330):
        truth = visible_landmarks(sequence.world, k)
        depth, objects = sequence.depth(k), sequence.object_ids(k)
        u, v = np.rint(truth.uv_left).astype(int).T
        near = np.abs(depth[v, u] - truth.points[:, 2]) < 0.02 + 0.01 * truth.points[:, 2]
        assert near.mean() > 0.97, "but for pixels on edges, the landmark is what the pixel shows"
        same = objects[v, u] == sequence.landmarks.object[truth.ids]
        assert same.mean() > 0.97
        on_objects = sequence.landmarks.object[truth.ids] > 0
        assert 10 < on_objects.sum() < len(truth.ids)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("isle", r"unknown world 'isle' \(did you mean 'aisle'\?\)"),
        ("aisle?sead=3", "world aisle: unknown option 'sead'"),
        ("aisle?frames=0", "frames must be a whole number from 1 to 1000000, got '0'"),
        ("aisle?sigma=nan", "sigma must be a number from 0 to 100, got 'nan'"),
        ("aisle?seed=1&seed=2", "'seed' is given twice"),
        ("aisle?drop=0:2000", "no frame is left"),
    ],
)
def test_what_is_asked_for_wrongly_is_refused(text, message):
    with pytest.raises(SlamError, match=message):
        open_world(text)


def test_faults_by_number_range_and_chance():
    sequence = open_world("box?frames=200&black=3,10:12&dropright=0.1&drop=20:30")
    faults = sequence.faults
    assert np.flatnonzero(faults["black"]).tolist() == [3, 10, 11]
    assert 5 < faults["dropright"].sum() < 40  # 20 expected of 200, far beyond five deviations either way
    assert len(sequence) == 190
    gaps = np.full(189, 1 / 30)
    gaps[19] += 10 / 30
    assert np.allclose(np.diff(sequence.stamps), gaps)
