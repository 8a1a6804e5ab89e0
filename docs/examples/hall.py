"""A world of one's own: ``slam run "synthetic:hall:HALL?frames=30&high=4"`` in the folder of this file."""

import numpy as np

from slam.worlds.geometry import DOWN, RIGHT, Parts, rectangle
from slam.worlds.options import Option
from slam.worlds.paths import camera_poses, clock
from slam.worlds.surfaces import Material
from slam.worlds.world import Scene


def build(values):
    """A wall 8 m ahead with things on it, and a camera that sways before it and comes nearer; z is up."""
    stamps, t = clock(values, 8.0)  # times of the frames [s], and where on the path: it takes 8 s
    positions = np.stack([np.sin(t), 0.5 * t, 1.5 + 0 * t], axis=1)  # [m]
    yaw = pitch = roll = np.zeros(len(t))
    high = values["high"]
    wall = Material(20.0, high, "board", values["layout"], density=40, sizes=(0.05, 0.2))
    corner = (-10.0, 8.0, high)  # its upper left one
    return Parts(stamps, camera_poses(positions, yaw, pitch, roll), [rectangle(wall, corner, RIGHT, DOWN)])


#: What it is, its function, nearest and farthest distance of features [m], texels of the images a metre, its options.
HALL = Scene("a wall in a hall", build, (0.5, 15.0), 200.0, options=(Option("high", 5.0, "of the wall [m]", 1, 20),))
