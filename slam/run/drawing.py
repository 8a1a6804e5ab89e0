"""Frames with landmarks and objects drawn in: landmarks yellow, new ones green, object features black, boxes and axes.

The colours are those of paper B, Fig. 10. Beside a frame, `GrowingMap` draws the map as it is so far.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from slam.data import Estimate, FrameResult, StereoFrame
from slam.errors import SlamError
from slam.files import require_utf8, write_png
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, inverse, transform
from slam.object_data import MovingObject
from slam.outputs import Output
from slam.run.run_files import naming_folder
from slam.run.schema import body_colour

_BEACON, _NEW, _MOVING, _RING = (0, 230, 255), (80, 200, 80), (0, 0, 0), (255, 255, 255)  # BGR, as all colours here
_AXES = ((40, 40, 230), (60, 180, 60), (230, 90, 40))  # x red, y green, z blue
_OLD, _NOW, _PATH, _INK = (200, 200, 200), (200, 130, 30), (0, 110, 240), (90, 90, 90)  # of the map
#: What is drawn into images, and into the map beside them: colour, name and shape.
_IN_IMAGES = ((_BEACON, "landmark", "ring"), (_NEW, "new landmark", "ring"), (_MOVING, "feature that may move", "ring"))
_IN_MAP = ((_PATH, "path", "line"), (_NOW, "landmark now", "dot"), (_OLD, "earlier one", "dot"))
_EDGES = [(i, i ^ bit) for i in range(8) for bit in (1, 2, 4) if i < i ^ bit]
_FONT, _TEXT = 0, 0.5  # OpenCV's plain font, and its size
_LEAST_RADIUS = 4  # of a feature's circle [px]
_LEGEND = 24  # height of the bar with the legend [px]
_FILM, _DIGITS = ".mp4", 6  # a video's suffix; of a picture's name, at least
_SHOWN = 1 / 0.9  # of an extent from the 5th to the 95th percentile of points: all of it where they lie evenly
_PARTS = 12  # pieces of an edge, each drawn on its own where the camera sees it
_AHEAD = 0.3  # of the map behind the camera
_REACH = 2.5  # widths of the map in distances of the first landmarks


def _bgr(body: int) -> tuple[int, int, int]:
    red, green, blue = body_colour(body)
    return blue, green, red


def _extent(body: MovingObject) -> Array:
    """Corners (2, 3) of a body's box as drawn, body coordinates."""
    middle = body.extent.mean(axis=0)
    return np.asarray(middle + _SHOWN * (body.extent - middle))


def draw_objects(image: np.ndarray, result: FrameResult, rig: StereoRig, width: int = 960) -> np.ndarray:
    """The left image of a step (BGR uint8), enlarged to about `width` [px], with landmarks, boxes and axes."""
    import cv2

    picture = image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    scale = max(1, round(width / picture.shape[1]))
    picture = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    corners = [_draw_object(picture, thing, result, rig, scale) for thing in result.objects]
    beacons = result.matched_features[~np.isin(result.matched_features, result.moving_features)]
    radius, moving = max(2 * scale, _LEAST_RADIUS), np.unique(result.moving_features)
    for rows, size, colour, thickness in (
        (beacons, radius, _BEACON, 1),
        (result.added_features, radius, _NEW, 1),
        (moving, radius + 1, _RING, 1),
        (moving, radius, _MOVING, 2),
    ):
        for u, v in result.features.uv_left[rows]:
            cv2.circle(picture, _pixel(u, v, scale), size, colour, thickness, cv2.LINE_AA)
    for thing, pixels in zip(result.objects, corners):  # over all else
        _draw_label(picture, thing, pixels, scale)
    return picture


def with_legend(picture: np.ndarray, bodies: Sequence[MovingObject] = ()) -> np.ndarray:
    """A picture of `draw_objects` with a bar below it that says what is drawn, as far as there is room for it.

    Bodies are named by their numbers, in their colours; where there are none, what one would look like is said.
    """
    own = [(_bgr(body.id), f"body {body.id}", "box") for body in bodies] or [(_bgr(1), "body", "box")]
    return _above(picture, [*_IN_IMAGES, *own, (own[-1][0], "body, not seen", "dashes")])


def _above(picture: np.ndarray, marks: Sequence[tuple[tuple[int, int, int], str, str]]) -> np.ndarray:
    """A picture above a bar of marks, each with its colour, its name and its shape, as many as there is room for."""
    import cv2

    bar = np.full((_LEGEND, picture.shape[1], 3), 255, np.uint8)
    at, y = 12, _LEGEND // 2
    for colour, text, shape in marks:
        (room, height), _ = cv2.getTextSize(text, _FONT, 0.8 * _TEXT, 1)
        if at + 12 + room > bar.shape[1]:
            break
        if shape in ("dot", "ring"):
            cv2.circle(bar, (at, y), 5 if shape == "ring" else 3, colour, 2 if shape == "ring" else -1, cv2.LINE_AA)
        else:
            lines = {"line": [(-6, 6, 0)], "box": [(-6, 6, -5), (-6, 6, 5)]}
            for left, right, down in lines.get(shape, [(x, x + 5, z) for x in (-6, 2) for z in (-5, 5)]):
                cv2.line(bar, (at + left, y + down), (at + right, y + down), colour, 1 if shape == "dashes" else 2)
        cv2.putText(bar, text, (at + 12, y + height // 2), _FONT, 0.8 * _TEXT, _MOVING, 1, cv2.LINE_AA)
        at += room + 30
    return np.concatenate([picture, bar])


def _draw_object(picture: np.ndarray, thing: MovingObject, result: FrameResult, rig: StereoRig, scale: int) -> Array:
    """Box and axes of one body, a dashed box alone where it is not measured; returns the box's corners (8, 2) [px]."""
    import cv2

    T_left_object = inverse(result.estimate.T_world_left) @ thing.estimate.T_world_object
    lower, upper = _extent(thing)
    corners = np.array([[(lower, upper)[i >> k & 1][k] for k in range(3)] for i in range(8)])
    measured, length = thing.estimate.measured, 0.6 * max(float((upper - lower).max()), 1e-3)
    lines = [(corners[a], corners[b], _bgr(thing.id), 1 + measured) for a, b in _EDGES]
    lines += [(np.zeros(3), length * axis, colour, 4) for axis, colour in zip(np.eye(3), _AXES if measured else ())]
    for begin, end, colour, thickness in lines:
        uv = rig.left.project(transform(T_left_object, np.linspace(begin, end, _PARTS)))
        seen = np.asarray((np.abs(np.nan_to_num(uv, nan=np.inf)) < 20 * rig.width).all(axis=1))  # not behind it
        for i in range(0, _PARTS - 1, 1 if measured else 2):
            if seen[i] and seen[i + 1]:
                a, b = (_pixel(uv[j, 0], uv[j, 1], scale) for j in (i, i + 1))
                cv2.line(picture, a, b, colour, thickness, cv2.LINE_AA)
    return rig.left.project(transform(T_left_object, corners))


def _draw_label(picture: np.ndarray, thing: MovingObject, corners: Array, scale: int) -> None:
    """Number and speed of a body above its box, inside the picture."""
    import cv2

    if not np.isfinite(corners).all():
        return
    speed = float(np.linalg.norm(thing.estimate.velocity[3:]))
    state = "not seen" if not thing.estimate.measured else f"{speed:.2f} m/s" if thing.moving else "at rest"
    text = f"{thing.id}: {state}"
    (width, height), base = cv2.getTextSize(text, _FONT, _TEXT, 1)
    u, v = corners.min(axis=0)
    left, top = _pixel(u, v - 3, scale)
    x = min(max(left, 0), max(picture.shape[1] - width, 0))
    y = min(max(top, height), picture.shape[0] - base)
    cv2.rectangle(picture, (x, y - height), (x + width, y + base), _RING, cv2.FILLED)
    cv2.putText(picture, text, (x, y), _FONT, _TEXT, _bgr(thing.id), 1, cv2.LINE_AA)


def _pixel(u: float, v: float, scale: int) -> tuple[int, int]:
    return round(scale * (u + 0.5)), round(scale * (v + 0.5))


class GrowingMap:
    """Draws the map from above, frame by frame: old landmarks, those in the map, the path, and moving bodies.

    The camera's first direction is upwards. As many metres are shown as suit the distance of the first landmarks.
    """

    def __init__(self) -> None:
        self._metres: float | None = None
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
        picture = np.full((side, side, 3), 255, np.uint8)

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
            colour, extent = _bgr(body.id), _extent(body)
            corners = np.array([[extent[i, 0], 0, extent[j, 2]] for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))])
            outline = pixels(transform(body.estimate.T_world_object, corners))
            cv2.polylines(picture, [outline], True, colour, 2, cv2.LINE_AA)
            place = body.estimate.T_world_object[:3, 3]
            here, later = pixels(np.array([place, place + body.estimate.velocity[3:]])).tolist()  # in a second
            cv2.arrowedLine(picture, here, later, colour, 2, cv2.LINE_AA, tipLength=0.25)
        most = side / 5 / scale  # a bar of 1, 2 or 5 times a power of ten of metres
        power = 10.0 ** np.floor(np.log10(most))
        metres = power * max(factor for factor in (1, 2, 5) if factor * power <= most)
        left = side - 12 - round(metres * scale)
        cv2.line(picture, (left, side - 14), (side - 12, side - 14), _INK, 2)
        cv2.putText(picture, f"{metres:g} m", (left, side - 20), _FONT, 0.8 * _TEXT, _INK, 1, cv2.LINE_AA)
        return picture


def output(path: Path) -> Output:
    """What `FramePictures` writes: a video, or pictures in a folder."""
    film = path.suffix.lower() == _FILM
    return Output(path, "--draw", None if film else ["[0-9]" * _DIGITS + "*.png"])


class FramePictures(ExitStack):
    """Writes pictures of frames to a folder of PNG files, or to a video where the path ends in ``.mp4``.

    Beside each frame is the map so far, as wide as the frame is high. The video's rate is that of the first two frames;
    a single picture is shown for a second. Raises SlamError where a video cannot be written.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path, self._film = path, path.suffix.lower() == _FILM
        self._map = GrowingMap()
        self._first: tuple[float, np.ndarray] | None = None  # stamp and picture that wait for the video's rate
        self._video: Any = None
        if path.suffix and not self._film:
            raise SlamError(f"{path}: pictures go to a folder, or to a video FILE.mp4")
        if self._film:
            require_utf8(path)
            self.callback(self._end)
        with naming_folder(path):
            (path.parent if self._film else path).mkdir(parents=True, exist_ok=True)

    def show(self, frame: StereoFrame, result: FrameResult, system: Any) -> None:
        """Append a step's picture; a `slam.run.runner.Watch`."""
        image = draw_objects(frame.left, result, system.rig)
        estimate = system.estimate()
        self._map.add(estimate)
        growing = _above(self._map.draw(estimate, result, len(image)), _IN_MAP)
        picture = np.hstack([with_legend(image, result.objects), growing])
        if not self._film:
            file = self.path / f"{frame.index:0{_DIGITS}d}.png"
            with naming_folder(file):
                write_png(file, picture)
        elif self._first is None:
            self._first = frame.stamp, picture
        else:
            if self._video is None:
                self._open(1.0 / (frame.stamp - self._first[0]))
            self._video.write(picture)

    def _open(self, rate: float) -> None:
        import cv2

        assert self._first is not None
        height, width = self._first[1].shape[:2]
        self._video = cv2.VideoWriter(str(self.path), cv2.VideoWriter.fourcc(*"mp4v"), rate, (width, height))
        if not self._video.isOpened():
            raise SlamError(f"{self.path}: cannot be written")
        self._video.write(self._first[1])

    def _end(self) -> None:
        if self._video is None and self._first is not None:
            self._open(1.0)
        if self._video is not None:
            self._video.release()
