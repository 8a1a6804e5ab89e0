"""Render the pictures of docs/worlds.md into docs/images/worlds: ``python docs/make_world_pictures.py``."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from slam.worlds import WorldSequence, open_world

FOLDER = Path(__file__).parent / "images" / "worlds"

#: World, options of its picture, and the frames shown.
PICTURES = {
    "aisle": ("box=1", (0, 420, 830)),
    "desk": ("", (0, 180, 520)),
    "startup": ("", (0, 75, 149)),
    "box": ("", (10, 120, 220, 360)),
    "boxes": ("", (60, 200, 330)),
    "people": ("", (5, 45, 85)),
    "street": ("", (10, 125, 190)),
    "town": ("", (150, 870, 1200)),
}
WIDE = ("people", "street", "town")  #: worlds whose images are wide
HEIGHT = 300  #: of a frame in a picture [px]


def main() -> None:
    """Render all pictures."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name, (query, frames) in PICTURES.items():
        save(name, [shown(large(name, query).frame(k).left) for k in frames])
    rigs = [large("aisle", query).frame(300) for query in ("box=1", "box=1&rig=toedin")]
    save("rigs", [shown(image) for frame in rigs for image in (frame.left, frame.right)])
    sequence = large("boxes", "")
    save("truth", [shown(sequence.frame(200).left), depth_picture(sequence, 200), object_picture(sequence, 200)])


def large(name: str, query: str) -> WorldSequence:
    """A world in colour, larger than it is by default where that is small."""
    size = "" if name in WIDE else "&width=640&height=480"
    return open_world(f"{name}?colour=1{size}" + (f"&{query}" if query else ""))


def shown(image: np.ndarray | None, height: int = HEIGHT) -> np.ndarray:
    """An image at the height of pictures."""
    assert image is not None
    width = round(image.shape[1] * height / image.shape[0])
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


def depth_picture(sequence: WorldSequence, frame: int) -> np.ndarray:
    """The true depth: near is bright."""
    depth = sequence.depth(frame)
    near = np.where(depth > 0, depth[depth > 0].min() / np.maximum(depth, 1e-6), 0)
    return shown(cv2.applyColorMap((255 * near).astype(np.uint8), cv2.COLORMAP_VIRIDIS))


def object_picture(sequence: WorldSequence, frame: int) -> np.ndarray:
    """The true objects: a colour each on a dim image."""
    ids = sequence.object_ids(frame)
    colours = np.array([(0, 0, 0), (60, 60, 220), (60, 200, 60), (220, 120, 40), (40, 200, 230), (200, 60, 200)])
    image = sequence.frame(frame).left // 3
    return shown(np.where((ids > 0)[..., None], image + colours[ids] * 2 // 3, image).astype(np.uint8))


def save(name: str, images: list[np.ndarray]) -> None:
    """Write images side by side, three in a row at most where there are more than four."""
    rows = [images[:3], images[3:]] if len(images) > 4 else [images]
    if name in WIDE:
        rows = [[image] for image in images]
    gap = 6
    lines = [np.hstack([np.pad(i, ((0, gap), (0, gap), (0, 0)), constant_values=255) for i in row]) for row in rows]
    picture = np.vstack(lines)[:-gap, :-gap]
    path = FOLDER / f"{name}.jpg"
    for quality in range(88, 40, -6):
        cv2.imwrite(str(path), picture, [cv2.IMWRITE_JPEG_QUALITY, quality])
        if path.stat().st_size < 145_000:
            break
    print(f"{path}: {picture.shape[1]}x{picture.shape[0]}, {path.stat().st_size // 1000} kB")


if __name__ == "__main__":
    main()
