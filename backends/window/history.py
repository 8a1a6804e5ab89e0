"""The calls of the last frames, so that they can be gone through again with corrected measurements."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from backends.window.state import WindowState, settle
from backends.window.steps import Steps
from slam.data import IdArray
from slam.geometry.se3 import Array
from slam.window import chart_kernels
from slam.window.stereo import RectifiedStereo

_EVERY = 25  # cost: frames between two states from which the calls can be repeated


@dataclass(frozen=True, eq=False)
class Call:
    """A call that changed the state: a method of `Steps`, and its arguments."""

    step: str
    arguments: tuple[Any, ...]

    @property
    def measured(self) -> Array:
        """The call's measurements (M, 3); most calls have none."""
        return np.asarray(self.arguments[1]) if self.step in ("updated", "added") else np.zeros((0, 3))

    def with_measured(self, z: Array) -> Call:
        """With corrected measurements (M, 3)."""
        if not len(z):
            return self
        ids, before, *rest = self.arguments
        if self.step == "added":  # what has no depth any more was placed as it was
            z = np.where((z[:, 0] > z[:, 2])[:, None], z, before)
        return Call(self.step, (ids, z, *rest))


@dataclass(frozen=True, eq=False)
class Part:
    """Some successive calls, and the state before them."""

    state: WindowState
    calls: tuple[Call, ...] = ()


@dataclass(frozen=True, eq=False)
class History:
    """The calls since a state, in parts."""

    parts: tuple[Part, ...]  # at least one
    anchored: bool = False  # whether landmarks were ever known in the world: then the path may not be moved in it

    @classmethod
    def of(cls, s: WindowState) -> History:
        """From a state on."""
        return cls((Part(s),))

    @property
    def start(self) -> WindowState:
        """The state before the first call."""
        return self.parts[0].state

    @property
    def begins(self) -> int:
        """Number of the newest frame before the first call, −1 for none."""
        return int(self.start.frames[-1]) if len(self.start.frames) else -1

    def then(self, call: Call, after: WindowState, lag: int) -> History:
        """With one more call, after which the state is `after`; without calls that are more than `lag` frames old."""
        last, parts = self.parts[-1], self.parts[:-1]
        parts = (*parts, replace(last, calls=(*last.calls, call)))
        begun = last.state.frames[-1] if len(last.state.frames) else -1
        if call.step == "predicted" and after.frames[-1] >= begun + _EVERY:
            parts = (*parts, Part(after))
            while len(parts) > 2 and after.frames[-1] - parts[1].state.frames[-1] >= lag:
                parts = parts[1:]
        return History(parts, self.anchored or call.step == "inserted")

    def corrected(self, stereo: RectifiedStereo, correct: Callable[[Array], Array]) -> History:
        """With corrected measurements; landmarks of the state before them move to where they are seen at from now on.

        Raises:
            MeasurementError: a corrected measurement is not finite.
        """
        measured = [call.measured for part in self.parts for call in part.calls]
        ends = np.cumsum([len(z) for z in measured])[:-1]
        rows = iter(np.split(stereo.corrected("window", np.concatenate(measured), correct), ends) if measured else ())
        return replace(self, parts=tuple(
            Part(state_corrected(part.state, stereo, correct), tuple(c.with_measured(next(rows)) for c in part.calls))
            for part in self.parts
        ))  # fmt: skip

    def repeated(self, steps: Steps, final: Sequence[Array]) -> tuple[WindowState, list[Array]]:
        """The state after all calls, and all frames' final poses."""
        s, final = self.start, list(final)
        for part in self.parts:
            for call in part.calls:
                before, s = s, getattr(steps, call.step)(s, *call.arguments)
                s = s[0] if isinstance(s, tuple) else s
                s, settled = settle(before, s, steps.config.lag)
                for frame, T in settled.items():
                    final[frame] = T
        return s, final


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
        prior = replace(prior, origin=prior.origin + change, by_rig=by_rig)
    rows = replace(s.rows, z=stereo.corrected("window", s.rows.z, correct))
    displacement = position - marks.position

    def shift(own: IdArray) -> Array:
        """By how much landmarks (S,) of these serial numbers are displaced, those that are no more by nothing."""
        at = np.searchsorted(marks.serial, own).clip(0, len(marks) - 1)
        return np.where((marks.serial[at] == own)[:, None], displacement[at], 0.0)

    past = s.past
    if len(marks):  # as if they had stood there before
        past = tuple(
            replace(one, points=one.points + shift(one.serials), positions=one.positions + shift(one.stayed))
            for one in past
        )
    by_rig = marks.by_rig.copy()
    if not whole:
        by_rig[:, :, -1:] -= displacement[:, :, None]
    return replace(s, rows=rows, landmarks=replace(marks, position=position, by_rig=by_rig), prior=prior, past=past)
