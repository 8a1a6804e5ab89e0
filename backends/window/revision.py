"""A window whose measurements are mended."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from backends.window.state import WindowState
from slam.geometry.se3 import Array
from slam.window import chart_kernels
from slam.window.stereo import RectifiedStereo


def revised(s: WindowState, stereo: RectifiedStereo, correct: Callable[[Array], Array]) -> WindowState:
    """A state whose measurements are corrected, and whose landmarks are where the newest camera sees them corrected.

    What they move by is none of their error: the last of the rig's.
    """
    T, marks = s.poses[-1], s.landmarks
    local = (marks.position - T[:3, 3]) @ T[:3, :3]
    z, _ = stereo.project(local)
    seen = np.isfinite(z).all(axis=1) & stereo.rectified_rig.rig.left.in_image(z[:, :2])
    seen &= marks.information[:, 0, 0] == 0  # what is known in the world stays
    there = local.copy()
    there[seen] = stereo.triangulate(stereo.corrected("window", z[seen], correct))
    there = np.where(np.isfinite(there), there, local)
    position = there @ T[:3, :3].T + T[:3, 3]
    prior, members = s.prior, s.prior.points
    if len(members):
        axes = np.ascontiguousarray(np.broadcast_to(np.eye(3), (len(members), 3, 3)))
        before, after = (
            chart_kernels.chart_changes(s.poses[0], p[members], prior.basis, axes)[0]
            for p in (marks.position, position)
        )
        change = np.nan_to_num(after - before)  # NaN: behind its chart
        by_rig = prior.by_rig.copy()
        by_rig[:, -1:] -= (prior.information[:, : change.size] @ change.ravel())[:, None]
        prior = replace(prior, origin=prior.origin + change, by_rig=by_rig)
    rows = replace(s.rows, z=stereo.corrected("window", s.rows.z, correct))
    past = s.past.displaced(marks.serial, position - marks.position) if len(marks) else s.past
    by_rig = marks.by_rig.copy()
    by_rig[:, :, -1:] -= (position - marks.position)[:, :, None]
    return replace(s, rows=rows, landmarks=replace(marks, position=position, by_rig=by_rig), prior=prior, past=past)
