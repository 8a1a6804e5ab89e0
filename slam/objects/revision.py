"""What tracks measured before a change of the rig's correction, corrected as what is measured from then on.

Without it a change of all disparities looks as if all that is far away had moved along the line of sight.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.objects.bodies import Body
from slam.objects.fits import times_vectors
from slam.tracks.table import Tracks

CorrectRows = Callable[[Array], Array]


def revise_tracks(
    tracks: Tracks, bodies: Mapping[int, Body], poses: Array, slot: int, rig: StereoRig, correct: CorrectRows
) -> None:
    """Move the points of all tracks to where their pixels say that they are, corrected again; in place.

    Args:
        tracks: the tracks.
        bodies: the bodies by id; their members' points move in them.
        poses: T_world_left (W, 4, 4) in the frames of the window's slots.
        slot: of the newest frame.
        rig: the cameras.
        correct: corrects rectified rows (uL, vL, uR) (N, 3) [px] again, as of `slam.calibration.model.Revision`.
    """
    rows, slots = np.nonzero(tracks.dof)
    points = tracks.anchor[rows] + tracks.p[rows, slots]
    tracks.p[rows, slots] += _shifts(points, poses[slots], rig, correct)
    alive = np.flatnonzero(tracks.number >= 0)
    shift = _shifts(tracks.position[alive], np.broadcast_to(poses[slot], (len(alive), 4, 4)), rig, correct)
    tracks.position[alive] += shift
    tracks.older_b[alive] += times_vectors(tracks.older_A[alive], shift)
    for body in bodies.values():
        mine = tracks.body[alive] == body.id
        tracks.local[alive[mine]] += shift[mine] @ body.T[:3, :3]


def _shifts(points: Array, T_world_left: Array, rig: StereoRig, correct: CorrectRows) -> Array:
    """By what points (N, 3) seen from poses (N, 4, 4) move, in world coordinates (N, 3); not at all out of view."""
    R = T_world_left[:, :3, :3]
    z, J = rig.project_stereo(times_vectors(np.swapaxes(R, 1, 2), points - T_world_left[:, :3, 3]))
    shifts = np.zeros_like(points)
    seen = np.isfinite(z).all(axis=1) & rig.left.in_image(z[:, :2])
    good = np.flatnonzero(seen & (np.abs(z[:, 0] - z[:, 2]) < rig.width))
    change = correct(z[good]) - z[good]
    finite = np.isfinite(change).all(axis=1)
    good, change = good[finite], change[finite]
    shifts[good] = times_vectors(R[good], np.linalg.solve(J[good], change[..., None])[..., 0])
    return shifts
