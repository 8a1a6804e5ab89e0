"""Back ends on known landmarks seen by a hand-moved stereo camera, mostly few at a time; skipped where they are not.

Real measurements of 20 landmarks: five in view on average, none in a tenth of the steps, with the noise that the
recording states, of which the most is shared by the landmarks of a step.
"""

from __future__ import annotations

import numpy as np
import pytest

import backends
from slam.data import Observations
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import inverse, log, pose, so3_exp
from slam.models import EstimatorModels


def load(folder):
    """Rig, pixel noise, stamps (K,), true T_world_left (K, 4, 4), and pixels (K, 20, 4), NaN where unseen."""
    raw = np.load(folder / "starry_night/steps_0_950.npz")
    f, u0, v0, b = (float(raw[name].item()) for name in ("fu", "cu", "cv", "b"))
    pixels = raw["y_k_j"].transpose(1, 2, 0).copy()
    pixels[(pixels < 0).any(axis=2)] = np.nan
    bodies = pose(so3_exp(raw["theta_vk_i"].T), raw["r_i_vk_i"].T)
    true = bodies @ pose(raw["C_c_v"].T, raw["rho_v_c_v"][:, 0])
    sigma = float(np.sqrt(raw["y_var"].mean()))
    return StereoRig.rectified_pair(f, u0, v0, b, 640, 480), sigma, raw["t"][0], true, pixels


@pytest.mark.parametrize(
    ("name", "options"), [("ekf", {}), ("iekf", {}), ("smoother", {}), ("smoother", {"poses": "seen"}), ("window", {})]
)
def test_a_camera_that_often_sees_less_than_three_landmarks_knows_where_it_is(slam_data, name, options):
    start = 150  # before, hardly anything was in view
    rig, sigma, stamps, true, pixels = load(slam_data)
    backend = backends.create(name, rig, models=EstimatorModels(pixel_sigma=sigma), **options)
    known, found, rejected = [], [], 0
    for k in range(start, len(stamps)):
        ids = np.flatnonzero(np.isfinite(pixels[k, :, 0]))
        seen = Observations(ids, pixels[k, ids, :2], pixels[k, ids, 2:])
        backend.predict(float(stamps[k]))
        rejected += len(backend.update(seen.select(np.isin(ids, known))).rejected)
        deep = np.isfinite(rig.triangulate(seen.uv_left, seen.uv_right)).all(axis=1)
        new = seen.select(deep & ~np.isin(ids, known))
        backend.add(new)
        known += new.ids.tolist()
        found.append(backend.estimate(landmarks=False))
    moved = inverse(true[start]) @ true[start:]
    errors = log(inverse(np.array([one.T_world_left for one in found])) @ moved)
    sigmas = np.sqrt([np.diag(one.covariance) for one in found])
    assert np.sqrt(np.square(errors[:, 3:]).sum(axis=1).mean()) < 0.15
    assert (np.abs(errors) < 3 * sigmas).mean() > 0.99
    assert rejected <= 3
