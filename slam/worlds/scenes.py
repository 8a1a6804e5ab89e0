"""The built-in worlds by name, and how a world is put together from what a scene describes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from slam.geometry.camera import PinholeCamera
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import so3_exp
from slam.worlds import indoors, streets, traffic
from slam.worlds.geometry import place_landmarks
from slam.worlds.options import Option
from slam.worlds.paths import CAMERAS
from slam.worlds.world import Scene, World

_TOE_IN = 0.06  # each camera of the toed-in rig turns this far inwards [rad]
#: Focal length [px] and the image width that it is meant for, by kind of motion; that of driving is KITTI's.
_FOCAL = {"handheld": (260.0, 320), "driving": (718.856, 1241)}
_DRIVING = {"rate": 10.0, "width": 1241, "height": 376, "baseline": 0.54, "density": 0.6, "lens": 0.6}
_TOWN = {
    **_DRIVING, "density": 1.2, "detect": 0.75, "change": 0.5, "clutter": 0.3,
    "descriptor": 16, "descriptor_noise": 0.1, "descriptor_drift": 2.2,
}  # fmt: skip


def _camera(default: str) -> tuple[Option, ...]:
    return (Option("camera", default, "how the camera moves", choices=CAMERAS),)


SCENES = {
    "aisle": Scene(
        "a library aisle with bookshelves, walked through by hand (paper A, section V)", indoors.aisle,
        (0.3, 5.0), 640.0,
        options=(Option("box", 0, "1 for a box that moves along the shelves, stops, and moves on", 0, 1),),
    ),
    "box": Scene(
        "a box at the four places of Table 1, stop and go, with beacons around it (paper B, section 4.4)", indoors.box,
        (0.3, 5.0), 700.0, options=_camera("sway"), defaults={"density": 40.0},
    ),
    "boxes": Scene(
        "three boxes with different velocities, and one of two parts joined by a hinge, before a room's corner",
        indoors.boxes, (0.3, 5.0), 700.0, options=_camera("moving"), defaults={"density": 40.0},
    ),
    "desk": Scene(
        "a desk seen from all sides of one chair: a small volume, landmarks seen again and again", indoors.desk,
        (0.25, 4.0), 1000.0, defaults={"density": 70.0},
    ),
    "drive": Scene(
        "a drive through a town along the path of a file, at KITTI's scale and rate", streets.drive,
        (4.0, 60.0), 64.0, "driving",
        (Option("path", "", "file of the path: poses in the form of KITTI (at 10 Hz) or TUM"),), _TOWN, True,
    ),
    "people": Scene(
        "a slow drive past parked cars, among cyclists and walkers whose legs swing", traffic.people,
        (4.0, 60.0), 64.0, "driving", defaults=_DRIVING,
    ),
    "startup": Scene(
        "a board of features with known positions, the camera at [3, -70, 2.7] cm (paper B, section 4.2)",
        indoors.startup, (0.2, 3.0), 1000.0,
        defaults={"density": 200.0},
    ),
    "street": Scene(
        "a drive through a town at KITTI's scale and rate, with parked and moving cars and a turn to the left",
        traffic.street, (4.0, 60.0), 64.0, "driving", (Option("cars", 3, "moving cars", 0, 3),), _DRIVING,
    ),
    "town": Scene(
        "a drive around the blocks of a town at KITTI's scale, back to its streets after 550 m, and the other way",
        streets.town, (4.0, 60.0), 64.0, "driving", defaults=_TOWN, alike=True,
    ),
}  # fmt: skip


def assemble(name: str, scene: Scene, values: Mapping[str, Any]) -> World:
    """A world from a scene's parts, with its landmarks chosen."""
    parts, rng = scene.build(values), np.random.default_rng([values["layout"], 31])
    landmarks = place_landmarks(parts.rectangles, values["density"], rng, scene.alike)
    objects = np.zeros((0, len(parts.stamps), 4, 4)) if parts.objects is None else parts.objects
    focal, usual = _FOCAL[scene.kind]
    width, height, baseline = values["width"], values["height"], values["baseline"]
    focal = focal * width / usual
    if values["rig"] == "rectified":
        rig = StereoRig.rectified_pair(focal, (width - 1) / 2, (height - 1) / 2, baseline, width, height)
    else:
        rig = toed_in_rig(focal, width, height, baseline)
    return World(
        name, scene.kind, rig, parts.stamps, parts.poses, tuple(parts.rectangles), landmarks, objects, scene.reach,
        scene.texels,
    )  # fmt: skip


def toed_in_rig(f: float, width: int, height: int, baseline: float) -> StereoRig:
    """A pair as built by hand: axes crossing, slightly rolled, unequal cameras with lens distortion."""
    s = width / 320
    left = PinholeCamera(
        f, f * 1.004, (width - 1) / 2 + 2.3 * s, (height - 1) / 2 - 1.7 * s, width, height,
        "radtan", (-0.16, 0.05, 0.0006, -0.0004),
    )  # fmt: skip
    right = PinholeCamera(
        f * 1.012, f * 1.009, (width - 1) / 2 - 1.9 * s, (height - 1) / 2 + 2.6 * s, width, height,
        "radtan", (-0.15, 0.04, -0.0005, 0.0007),
    )  # fmt: skip
    R = so3_exp(np.array([0.008, 2 * _TOE_IN, 0.012]))
    direction = np.array([-np.cos(_TOE_IN), 0.01, -np.sin(_TOE_IN)])
    return StereoRig(left, right, R, baseline * direction / np.linalg.norm(direction))
