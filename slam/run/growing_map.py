"""The map that grows, seen from above beside a frame: old landmarks, those in the map, the path, and moving bodies."""

from __future__ import annotations

import numpy as np

from slam.data import Estimate, FrameResult
from slam.geometry.se3 import Array, transform

_AHEAD = 0.3  # of the map behind the camera
_PAPER, _OLD, _NOW, _PATH, _INK = (255, 255, 255), (200, 200, 200), (200, 130, 30), (0, 110, 240), (90, 90, 90)  # BGR
_REACH = 2.5  # widths of the map in distances of the first landmarks
_FONT = 0  # OpenCV's plain one
_BODIES = ((230, 90, 40), (40, 140, 255), (160, 60, 200), (60, 180, 60), (60, 60, 230))  # BGR


def body_colour(number: int) -> tuple[int, int, int]:
    """The colour (BGR) of a moving body in images, by its number."""
    return _BODIES[(number - 1) % len(_BODIES)]


class GrowingMap:
    """Draws the map frame by frame; the camera's first direction is upwards.

    Args:
        metres: that are shown; None for as many as suit the distance of the first landmarks.
    """

    def __init__(self, metres: float | None = None) -> None:
        self._metres = metres
        self._seen: dict[int, Array] = {}
        self._path: list[Array] = []

    def add(self, estimate: Estimate) -> None:
        """Take in what is known after a frame, landmarks included."""
        self._seen.update(zip(estimate.ids.tolist(), estimate.positions))
        self._path.append(estimate.T_world_left[:3, 3])

    def draw(self, estimate: Estimate, result: FrameResult, side: int) -> np.ndarray:
        """A square picture (side, side, 3), BGR uint8, around the camera."""
        import cv2

        if self._metres is None and len(estimate.positions):
            distances = np.linalg.norm(estimate.positions - self._path[-1], axis=1)
            self._metres = _REACH * float(np.percentile(distances, 90))
        scale = side / (self._metres or 1.0)
        picture = np.full((side, side, 3), _PAPER, np.uint8)

        def pixels(points: Array) -> np.ndarray:
            across = scale * (np.reshape(points, (-1, 3)) - self._path[-1])[:, [0, 2]]
            at = np.round([side / 2, side * (1 - _AHEAD)] + across * [1, -1])
            return np.clip(at, -(10**6), 10**6).astype(np.int32)

        for points, radius, colour in ((list(self._seen.values()), 1, _OLD), (estimate.positions, 2, _NOW)):
            for at in pixels(np.array(points)).tolist():
                cv2.circle(picture, at, radius, colour, -1, cv2.LINE_AA)
        path = pixels(np.array(self._path))
        cv2.polylines(picture, [path], False, _PATH, 2, cv2.LINE_AA)
        cv2.circle(picture, path[-1].tolist(), 5, _PATH, -1, cv2.LINE_AA)
        for body in result.objects:
            colour, extent = body_colour(body.id), body.extent
            corners = np.array([[extent[i, 0], 0, extent[j, 2]] for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))])
            outline = pixels(transform(body.estimate.T_world_object, corners))
            cv2.polylines(picture, [outline], True, colour, 2, cv2.LINE_AA)
            place = body.estimate.T_world_object[:3, 3]
            here, later = pixels(np.array([place, place + body.estimate.velocity[3:]])).tolist()  # in a second
            cv2.arrowedLine(picture, here, later, colour, 2, cv2.LINE_AA, tipLength=0.25)
        _draw_bar(picture, scale)
        return picture


def _draw_bar(picture: np.ndarray, scale: float) -> None:
    """A bar of 1, 2 or 5 times a power of ten of metres in the lower right corner; `scale` is in pixels per metre."""
    import cv2

    side = len(picture)
    most = side / 5 / scale
    power = 10.0 ** np.floor(np.log10(most))
    metres = power * max(factor for factor in (1, 2, 5) if factor * power <= most)
    left, text = side - 12 - round(metres * scale), f"{metres:g} m"
    cv2.line(picture, (left, side - 14), (side - 12, side - 14), _INK, 2)
    cv2.putText(picture, text, (left, side - 20), _FONT, 0.4, _INK, 1, cv2.LINE_AA)
