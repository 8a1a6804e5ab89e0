"""Calibration errors on demand: the cameras that record are not quite those that the system is told of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from slam.geometry.rig import StereoRig
from slam.geometry.se3 import so3_exp

#: The options that say how wrong the calibration is.
NAMES = frozenset({"focal_error", "turn_error"})


def true_rig(told: StereoRig, values: Mapping[str, Any]) -> StereoRig:
    """The cameras that record, where the system is told another rig; that rig itself where no error is asked for."""
    share, turn = 1 / (1 + values["focal_error"]), 1e-3 * values["turn_error"]
    if share == 1 and turn == 0:
        return told
    left, right = (replace(camera, fu=share * camera.fu, fv=share * camera.fv) for camera in (told.left, told.right))
    return StereoRig(left, right, so3_exp(np.full(3, turn)) @ told.R, told.b)
