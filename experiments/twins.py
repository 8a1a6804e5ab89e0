"""Two back ends behind one: both are given the same measurements, and the first one's belief drives the system."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from slam.data import Estimate, FrameResult, IdArray, Observations, Prediction, UpdateReport
from slam.geometry.se3 import Array
from slam.geometry.trajectory import Trajectory
from slam.interfaces import Backend
from slam.object_data import ObjectEstimate, ObjectObservations


class Twins:
    """A back end that hands every call on to two; answers are the first one's.

    Args:
        leader: decides, by what it believes, what is associated, added, removed, and which bodies there are.
        follower: is given the same.
    """

    def __init__(self, leader: Backend, follower: Backend) -> None:
        self.leader, self.follower = leader, follower
        self.followed: dict[int, ObjectEstimate] = {}

    def predict(self, stamp: float) -> Prediction:
        """See `slam.interfaces.Backend`."""
        self.follower.predict(stamp)
        return self.leader.predict(stamp)

    def update(self, observations: Observations, guess: Array | None = None) -> UpdateReport:
        """See `slam.interfaces.Backend`."""
        self.follower.update(observations, guess)
        return self.leader.update(observations, guess)

    def add(self, observations: Observations) -> None:
        """See `slam.interfaces.Backend`."""
        self.follower.add(observations)
        self.leader.add(observations)

    def remove(self, ids: IdArray | Sequence[int]) -> None:
        """See `slam.interfaces.Backend`."""
        self.follower.remove(ids)
        self.leader.remove(ids)

    def estimate(self, landmarks: bool = True) -> Estimate:
        """See `slam.interfaces.Backend`."""
        return self.leader.estimate(landmarks)

    def positions(self, ids: IdArray) -> Array:
        """See `slam.interfaces.Backend`."""
        return self.leader.positions(ids)

    def trajectory(self) -> Trajectory:
        """See `slam.interfaces.Backend`."""
        return self.leader.trajectory()

    def update_objects(self, observations: Sequence[ObjectObservations]) -> list[ObjectEstimate]:
        """See `slam.interfaces.ObjectBackend`."""
        estimates = self.follower.update_objects(observations)  # type: ignore[attr-defined]
        self.followed = {e.id: e for e in estimates}
        return list(self.leader.update_objects(observations))  # type: ignore[attr-defined]

    def remove_objects(self, ids: IdArray | Sequence[int]) -> None:
        """See `slam.interfaces.ObjectBackend`."""
        self.follower.remove_objects(ids)  # type: ignore[attr-defined]
        self.leader.remove_objects(ids)  # type: ignore[attr-defined]

    def seen_by_follower(self, result: FrameResult) -> FrameResult:
        """The step as it would be reported had the follower estimated."""
        objects = tuple(replace(o, estimate=self.followed[o.id]) for o in result.objects)
        return replace(result, estimate=self.follower.estimate(landmarks=False), objects=objects)
