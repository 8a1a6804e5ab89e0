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
from slam.run.drawing import GrowingMap, draw_objects

FILE = Path(__file__).parent / "images" / "street.webp"
WORLD = "synthetic:street?colour=1&width=640&height=320"
FRAMES = (0, 188)
SHOWN = 68  #: the first frame of the picture: by then there is a map behind the camera
EVERY = 2  #: frames of the drive to one of the picture
PACE = 110  #: time that each is shown [ms]
MOST = 3_000_000  #: bytes

SIDE = 320  #: of the map [px]


def main() -> None:
    """Run the system and write the file."""
    sequence = slam.open_sequence(WORLD)
    system = slam.StereoSlam(sequence.rig, backend="ekf", kind=sequence.kind)
    growing = GrowingMap()
    pictures = []
    for k, frame in enumerate(sequence.frames(*FRAMES)):
        result = system.process(frame)
        estimate = system.estimate()
        growing.add(estimate)
        if k >= SHOWN and k % EVERY == 0:
            view = draw_objects(frame.left, result, sequence.rig, frame.left.shape[1])
            pictures.append(np.hstack([view, growing.draw(estimate, result, SIDE)]))
    write(pictures)


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
