"""A car's drive through points on both sides of a street, seen by a rig with known errors."""

import numpy as np

from slam.calibration import RigCorrection, RigModel, SelfCalibration, SelfCalibrationConfig
from slam.calibration.model import RESIDUAL
from slam.calibration.posterior import field_variance
from slam.geometry import se3
from slam.geometry.rig import StereoRig
from tests.slam.scene import features_at

CAR = StereoRig.rectified_pair(720, 610, 173, 0.54, 1242, 375)


def residual_fields(rng):
    """Coefficients of fields as large as the estimator takes them to be."""
    return np.sqrt(field_variance()) * rng.standard_normal(4 * len(RESIDUAL))


class Street:
    """Points beside the road with unit descriptors."""

    def __init__(self, seed=0, rig=CAR, count=3000, length=150, scale=1.0):
        self.rng = rng = np.random.default_rng(seed)
        self.rig, self.model, self.scale = rig, RigModel(rig), scale
        x = rng.uniform(3, 25, count) * rng.choice([-1, 1], count)
        self.points = np.column_stack([x, rng.uniform(-6, 1.6, count), rng.uniform(2, length, count)])
        d = rng.standard_normal((count, 32))
        self.descriptors = (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)

    def features(self, stamp, T_world_left, parameters=None, noise=0.15, most=400, residual=None):
        """What a rig sees, rectified, that `parameters` (n,) would make ideal; `residual` fields (m,) come on top."""
        rng, rig, model = self.rng, self.rig, self.model
        local = self.scale * se3.transform(se3.inverse(T_world_left), self.points)
        left, right = rig.project(local)
        near = (local[:, 2] > 4 * self.scale) & (local[:, 2] < 80 * self.scale)
        ids = np.flatnonzero(rig.left.in_image(left) & rig.right.in_image(right) & near)
        ids = rng.permutation(ids)[:most]
        n = len(ids)
        rectified_rig = rig.rectified
        z = np.column_stack([rectified_rig.rectify_left(left[ids]), rectified_rig.rectify_right(right[ids])[:, 0]])
        theta = np.zeros(len(model.names)) if parameters is None else parameters
        z = RigCorrection(model, theta).undone(z)
        points = model.points(z)
        vertical = -model.field(points)[:, 3] @ theta
        if residual is not None:
            z = model.rows(points - model.residual_field(points)[:, :3] @ residual)
            vertical -= model.residual_field(points)[:, 3] @ residual
        left, right = z[:, :2], np.column_stack([z[:, 2], z[:, 1] + vertical])
        left = left + noise * rng.standard_normal((n, 2))
        right = right + noise * rng.standard_normal((n, 2))
        return features_at(left, right, self.descriptors[ids], stamp)


def pose(k, step=1.2):
    """The car's k-th pose (4, 4)."""
    return se3.exp(np.array([0.003 * np.sin(k), 0.02 * np.sin(k / 9), 0, 0, 0, step * k]))


def drive(parameters=None, seed=0, frames=30, step=1.2, rig=CAR, scale=1.0, **seen):
    """A self-calibration after a drive."""
    street = Street(seed, rig, scale=scale)
    calibration = SelfCalibration(rig, SelfCalibrationConfig())
    for k in range(frames):
        T = pose(k, step)
        features = street.features(0.1 * k, T, parameters, **seen)
        guess = T.copy()
        guess[:3, 3] *= scale
        calibration.observe(features, guess @ rig.rectified.T_left_rectified)
    return calibration


def parameters(**values):
    """Parameters (n,) by name; the others are zero."""
    theta = np.zeros(len(RigModel.names))
    for name, value in values.items():
        theta[RigModel.names.index(name)] = value
    return theta


def disparity_error(calibration, theta):
    """Root mean square over the image of what is left of the disparity's error of far points [px]."""
    field = calibration.model.field(calibration.model.far())[:, 2]
    return float(np.sqrt(np.mean((field @ (calibration.posterior.mean - theta)) ** 2)))
