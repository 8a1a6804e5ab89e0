"""Make the animated picture at the top of the README: ``python docs/make_animation.py``.

The system drives through the built-in street. On the left what its camera sees, with landmarks and boxed cars; on the
right the map that grows from it, seen from above.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from PIL import Image

import slam
from slam.data import Estimate, FrameResult
from slam.geometry.se3 import Array
from slam.run.drawing import draw_objects

FILE = Path(__file__).parent / "images" / "street.webp"
WORLD = "synthetic:street?colour=1&width=640&height=320"
FRAMES = (0, 188)
SHOWN = 68  #: the first frame of the picture: by then there is a map behind the camera
EVERY = 2  #: frames of the drive to one of the picture
PACE = 110  #: time that each is shown [ms]
MOST = 3_000_000  #: bytes

SIDE = 320  #: of the map [px]
METRES = 76.0  #: that it shows
AHEAD = 0.3  #: of the map behind the camera
PAPER, OLD, NOW, PATH = (255, 255, 255), (200, 200, 200), (200, 130, 30), (0, 110, 240)  # BGR
CARS = ((230, 90, 40), (40, 140, 255), (160, 60, 200), (60, 180, 60), (60, 60, 230))  #: as their boxes in the image


def main() -> None:
    """Run the system and write the file."""
    sequence = slam.open_sequence(WORLD)
    system = slam.StereoSlam(sequence.rig, backend="ekf", kind=sequence.kind)
    seen: dict[int, Array] = {}
    path: list[Array] = []
    pictures = []
    for k, frame in enumerate(sequence.frames(*FRAMES)):
        result = system.process(frame)
        estimate = system.estimate()
        seen.update(zip(estimate.ids.tolist(), estimate.positions))
        path.append(estimate.T_world_left[:3, 3])
        if k >= SHOWN and k % EVERY == 0:
            view = draw_objects(frame.left, result, sequence.rig, frame.left.shape[1])
            pictures.append(np.hstack([view, top_view(seen, np.array(path), estimate, result)]))
    write(pictures)


def top_view(seen: dict[int, Array], path: Array, estimate: Estimate, result: FrameResult) -> np.ndarray:
    """The map from above, the camera's first direction upwards: old landmarks, those in the map, path and cars."""
    picture = np.full((SIDE, SIDE, 3), PAPER, np.uint8)
    scale = SIDE / METRES
    place = path[-1]

    def pixel(point: Array) -> tuple[int, int]:
        right, ahead = scale * (point[[0, 2]] - place[[0, 2]])
        return round(SIDE / 2 + right), round(SIDE * (1 - AHEAD) - ahead)

    for point in seen.values():
        cv2.circle(picture, pixel(point), 1, OLD, -1)
    for point in estimate.positions:
        cv2.circle(picture, pixel(point), 2, NOW, -1, cv2.LINE_AA)
    cv2.polylines(picture, [np.array([pixel(point) for point in path])], False, PATH, 2, cv2.LINE_AA)
    cv2.circle(picture, pixel(place), 5, PATH, -1, cv2.LINE_AA)
    for body in result.objects:
        T = body.estimate.T_world_object
        corners = [[body.extent[i, 0], 0, body.extent[j, 2]] for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))]
        outline = np.array([pixel(T[:3, :3] @ corner + T[:3, 3]) for corner in np.array(corners)])
        colour = CARS[(body.id - 1) % len(CARS)]
        cv2.polylines(picture, [outline], True, colour, 2, cv2.LINE_AA)
        ahead = pixel(T[:3, 3] + body.estimate.velocity[3:])  # where it is in a second
        cv2.arrowedLine(picture, pixel(T[:3, 3]), ahead, colour, 2, cv2.LINE_AA, tipLength=0.25)
    cv2.line(picture, (SIDE - 20 - round(10 * scale), SIDE - 14), (SIDE - 20, SIDE - 14), (90, 90, 90), 2)
    cv2.putText(picture, "10 m", (SIDE - 62, SIDE - 20), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (90, 90, 90), 1, cv2.LINE_AA)
    return picture


def write(pictures: list[np.ndarray]) -> None:
    """Write them as one animation that repeats, of at most `MOST` bytes."""
    first, *others = [Image.fromarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)) for picture in pictures]
    for quality in (70, 60, 50, 40, 30):
        first.save(FILE, save_all=True, append_images=others, duration=PACE, loop=0, quality=quality, method=4)
        if FILE.stat().st_size <= MOST:
            break
    print(f"{FILE.name}: {len(pictures)} pictures, {FILE.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
