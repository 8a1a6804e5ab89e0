"""The calls of the last frames, so that they can be gone through again with corrected measurements."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from backends.window.slide import problem
from backends.window.state import WindowState, settle
from backends.window.steps import Steps
from slam.data import IdArray
from slam.geometry.arrays import changed
from slam.geometry.se3 import Array, inverse
from slam.window import chart_kernels
from slam.window.solver import solve
from slam.window.stereo import RectifiedStereo

_EVERY = 25  # cost: frames between two states from which the calls can be repeated

#: A method of `Steps`, and its arguments; those of measurements begin with ids and measurements (M, 3).
Call = tuple[str, tuple[Any, ...]]


@dataclass(frozen=True, eq=False)
class History:
    """The calls since a state, in parts, each with the state before it."""

    parts: tuple[tuple[WindowState, tuple[Call, ...]], ...]  # at least one
    anchored: bool = False  # whether landmarks were ever known in the world: then the path may not be moved in it

    @property
    def begins(self) -> int:
        """Number of the newest frame before the first call, −1 for none."""
        return _newest(self.parts[0][0])

    def then(self, call: Call, after: WindowState, lag: int) -> History:
        """With one more call, after which the state is `after`; without calls that are more than `lag` frames old."""
        *parts, (state, calls) = self.parts
        parts.append((state, (*calls, call)))
        if call[0] == "predicted" and _newest(after) >= _newest(state) + _EVERY:
            parts.append((after, ()))
            while len(parts) > 2 and _newest(after) - _newest(parts[1][0]) >= lag:
                del parts[0]
        return History(tuple(parts), self.anchored or call[0] == "inserted")

    def corrected(self, stereo: RectifiedStereo, correct: Callable[[Array], Array]) -> History:
        """With corrected measurements; landmarks of the state before them move to where they are seen at from now on.

        Raises MeasurementError if a corrected measurement is not finite.
        """
        measured = [call[1][1] for _, calls in self.parts for call in calls if call[0] in ("updated", "added")]
        z = stereo.corrected("window", np.concatenate([np.zeros((0, 3)), *measured]), correct)
        rows = iter(np.split(z, np.cumsum([len(before) for before in measured])))

        def again(call: Call) -> Call:
            if call[0] not in ("updated", "added"):
                return call
            (ids, before, *rest), z = call[1], next(rows)
            if call[0] == "added":  # what has no depth any more was placed as it was
                z = np.where((z[:, 0] > z[:, 2])[:, None], z, before)
            return call[0], (ids, z, *rest)

        return changed(self, parts=tuple(
            (state_corrected(state, stereo, correct), tuple(map(again, calls))) for state, calls in self.parts
        ))  # fmt: skip

    def repeated(self, steps: Steps, final: Sequence[Array]) -> tuple[WindowState, list[Array]]:
        """The state after all calls, and all frames' final poses."""
        s, final = self.parts[0][0], list(final)
        for name, arguments in (call for _, calls in self.parts for call in calls):
            before, s = s, getattr(steps, name)(s, *arguments)
            s, settled = settle(before, s[0] if isinstance(s, tuple) else s, steps.config.lag)
            for frame, T in settled.items():
                final[frame] = T
        return s, final


def newest_kept(s: WindowState, stereo: RectifiedStereo) -> WindowState:
    """A state with corrected measurements, whose newest pose stays where it is when they are solved for.

    The first pose holds what is known of the place in the world: it and the whole path with it move instead.
    """
    try:
        solution = solve(problem(s, stereo))
    except np.linalg.LinAlgError:
        return s
    M = s.poses[-1] @ inverse(solution.window.poses[-1])
    return changed(s, prior=changed(s.prior, T=M @ s.prior.T), cost=solution.cost)


def _newest(s: WindowState) -> int:
    """Number of the newest frame, −1 for none."""
    return int(s.frames[-1]) if len(s.frames) else -1


def state_corrected(
    s: WindowState, stereo: RectifiedStereo, correct: Callable[[Array], Array], whole: bool = True
) -> WindowState:
    """A state whose measurements are corrected, and whose landmarks are where the newest camera sees them corrected.

    Where the rest of the path is not, what the landmarks move by is none of their error: the last of the rig's.
    """
    if not len(s.frames):
        return s
    T, marks = s.poses[-1], s.landmarks
    local = (marks.position - T[:3, 3]) @ T[:3, :3]
    z, _ = stereo.project(local)
    seen = np.isfinite(z).all(axis=1) & stereo.rig.left.in_image(z[:, :2])
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
        if not whole:
            by_rig[:, -1:] -= (prior.information[:, : change.size] @ change.ravel())[:, None]
        prior = changed(prior, origin=prior.origin + change, by_rig=by_rig)
    rows = changed(s.rows, z=stereo.corrected("window", s.rows.z, correct))
    displacement = position - marks.position

    def shift(own: IdArray) -> Array:
        """By how much landmarks (S,) of these serial numbers are displaced, those that are no more by nothing."""
        at = np.searchsorted(marks.serial, own).clip(0, len(marks) - 1)
        return np.where((marks.serial[at] == own)[:, None], displacement[at], 0.0)

    past = s.past
    if len(marks):  # as if they had stood there before
        past = tuple(
            changed(
                one,
                points=one.points + shift(one.serials),
                stayed_points=one.stayed_points + shift(one.stayed_serials),
            )
            for one in past
        )
    by_rig = marks.by_rig.copy()
    if not whole:
        by_rig[:, :, -1:] -= displacement[:, :, None]
    return changed(s, rows=rows, landmarks=changed(marks, position=position, by_rig=by_rig), prior=prior, past=past)
