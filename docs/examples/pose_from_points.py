"""The camera's pose from points that are known (PnP), and its covariance."""

import numpy as np

from slam.geometry import se3
from slam.geometry.rig import StereoRig
from slam.window.problem import Rows, Window
from slam.window.solver import solve
from slam.window.stereo import RectifiedStereo

SIGMA = 0.5  # noise [px]
rig = StereoRig.rectified_pair(f=400.0, u0=320.0, v0=240.0, baseline=0.3, width=641, height=481)
stereo, rng = RectifiedStereo.of(rig), np.random.default_rng(0)
points = rng.uniform((-2.0, -1.0, 4.0), (2.0, 1.0, 9.0), (30, 3))  # in the world [m]
T_true = se3.exp(np.array([0.02, -0.05, 0.01, 0.1, 0.0, 0.3]))
pixels = stereo.project(se3.transform(se3.inverse(T_true), points))[0] + SIGMA * rng.standard_normal((30, 3))

rows = Rows.of(0, np.arange(30), pixels, SIGMA)  # all from the first pose
solution = solve(Window(stereo, np.eye(4)[None], points, rows, known=np.ones(30, bool)))

print("T_world_left", solution.window.poses[0])
print("standard deviations [rad, m]", np.sqrt(np.diag(solution.pose_covariance)))
print("squared residuals [σ²]", solution.cost, "of", pixels.size, "measurements")
