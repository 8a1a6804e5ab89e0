"""A back end for the detector's tests: any back end, with objects estimated by nothing but their rigid fit."""

from __future__ import annotations

import numpy as np

from slam.geometry.se3 import so3_log
from slam.object_data import ObjectEstimate


class FitBackend:
    """Delegates to a back end; `update_objects` takes the guess as the estimate and its change as the velocity.

    As the real ones do, it has a frame of its own for every body: at the first sight the axes are the world's.
    """

    def __init__(self, backend):
        self.backend = backend
        self.stamp = None
        self.objects = {}

    def __getattr__(self, name):
        return getattr(self.backend, name)

    def predict(self, stamp):
        self.before, self.stamp = self.stamp, stamp
        return self.backend.predict(stamp)

    def update_objects(self, observations):
        seen = {o.id: o for o in observations}
        dt = self.stamp - self.before if self.before is not None else 1.0
        none = np.zeros(0, np.int64)
        for id in sorted(set(self.objects) | set(seen)):
            last = self.objects.get(id)
            if id not in seen:
                T, velocity = last.T_world_object.copy(), last.velocity
                T[:3, 3] += dt * velocity[3:]
            else:
                T, velocity = seen[id].T_world_object.copy(), np.zeros(6)
                if last is None:
                    T[:3, :3] = np.eye(3)
                    T[:3, 3] += 0.05
                else:
                    turn = so3_log(T[:3, :3] @ last.T_world_object[:3, :3].T)
                    shift = T[:3, 3] - last.T_world_object[:3, 3]
                    velocity = 0.7 * last.velocity + 0.3 * np.concatenate([turn, shift]) / dt
            self.objects[id] = ObjectEstimate(
                id, self.stamp, T, 1e-4 * np.eye(6), velocity, 1e-3 * np.eye(6), id in seen,
                seen[id].points if id in seen else none, none,
            )  # fmt: skip
        return [self.objects[id] for id in sorted(self.objects)]

    def remove_objects(self, ids):
        for id in ids:
            del self.objects[int(id)]
