"""What the front end does on real stereo pairs; skipped without them."""

from __future__ import annotations

import cv2
import numpy as np

from frontends.surf import SurfFrontend
from slam.data import StereoFrame
from slam.geometry.rig import StereoRig


def test_middlebury_disparities(slam_data):
    folder = slam_data / "middlebury_motorcycle"
    left, right = (cv2.imread(str(folder / f"motorcycle_{side}.png")) for side in ("left", "right"))
    with np.load(folder / "motorcycle_disp.npz") as file:
        truth = file[file.files[0]]
    height, width = truth.shape
    rig = StereoRig.rectified_pair(994.978, 311.193, 254.877, 0.193001, width, height, doffs=31.086)
    features = SurfFrontend(rig).extract(StereoFrame(0, 0.0, left, right))
    assert len(features) >= 700
    assert features.has_stereo.mean() > 0.6
    u, v = np.rint(features.uv_left).astype(int).T
    errors = (features.uv_left - features.uv_right)[:, 0] - truth[v.clip(0, height - 1), u.clip(0, width - 1)]
    errors = errors[np.isfinite(errors)]
    assert len(errors) > 400
    assert (np.abs(errors) < 1).mean() > 0.8
    assert np.median(np.abs(errors)) < 0.28  # 1.5 times the median over noise and numbers of features
