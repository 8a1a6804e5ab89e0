"""The built-in filter with one thing changed: it is not given landmarks whose disparity is below a limit."""

from dataclasses import replace

import numpy as np

from backends.ekf import EkfBackend


class NearOnly(EkfBackend):
    def __init__(self, rig, models=None, least_disparity=2.0, **options):
        super().__init__(rig, **({} if models is None else {"models": models}), **options)
        self.least_disparity = least_disparity  # [px]

    def update(self, observations, guess=None):
        far = observations.uv_left[:, 0] - observations.uv_right[:, 0] < self.least_disparity  # no right pixel: not far
        report = super().update(observations.select(~far), guess)
        return replace(report, rejected=np.union1d(report.rejected, observations.ids[far]))
