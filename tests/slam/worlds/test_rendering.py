"""The renderer, on a world with a board of known corners."""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from slam.worlds import WorldSequence, open_world
from slam.worlds.geometry import Parts, rectangle
from slam.worlds.observe import visible_landmarks
from slam.worlds.scenes import assemble
from slam.worlds.world import Scene


@dataclass(frozen=True)
class Checkers:
    """A chess board; its marks are the corners of its fields."""

    width: float
    height: float
    step: float

    def marks(self) -> np.ndarray:
        x = np.arange(self.step, self.width - 0.01, self.step)
        y = np.arange(self.step, self.height - 0.01, self.step)
        grid_x, grid_y = np.meshgrid(x, y)
        return np.stack([grid_x.ravel(), grid_y.ravel(), np.full(grid_x.size, self.step)], axis=1)

    def paint(self, density: float) -> np.ndarray:
        rows = self._wave(round(self.height * density), self.height)
        columns = self._wave(round(self.width * density), self.width)
        picture = np.rint(130 + 90 * rows[:, None] * columns).astype(np.uint8)
        return np.repeat(picture[..., None], 3, axis=2)

    def _wave(self, texels: int, length: float) -> np.ndarray:
        """A square wave averaged over each texel: a chess board is the product of two."""
        fine = (np.arange(texels * 256) + 0.5) / (texels * 256) * length
        return (1 - 2 * (np.floor(fine / self.step) % 2)).reshape(texels, 256).mean(axis=1)


@pytest.fixture(scope="session")
def board_world() -> Callable[..., WorldSequence]:
    """Makes recordings, along the aisle's path, of three walls painted with chess boards, one of them turned away."""

    def make(query: str, step: float) -> WorldSequence:
        base = open_world(f"aisle?{query}")
        board = Checkers(2.0, 2.0, step)
        walls = [
            rectangle(board, (-0.6, 1.1, 2.3), (1, 0, 0), (0, 0, -1)),
            rectangle(board, (1.4, 1.1, 2.3), (0.8, 0.6, 0), (0, 0, -1)),
            rectangle(board, (3.0, 2.3, 2.3), (1, -0.3, 0), (0, 0, -1)),
        ]
        w = base.world
        values = {**base.values, "density": 1e4}
        parts = Parts(w.stamps, w.T_world_left, walls)
        scene = Scene("boards", lambda _: parts, (0.3, 3.5), 640.0)
        return WorldSequence("board", assemble("board", scene, values), values)

    return make


def saddle(image: np.ndarray, start: np.ndarray) -> np.ndarray:
    """The saddle of grey levels near a pixel (2,): a quartic fitted to 9x9 pixels, moved until it is centred."""
    y, x = (g.ravel().astype(float) for g in np.mgrid[-4:5, -4:5])
    weight = np.exp(-(x * x + y * y) / 8)
    powers = [(2, 0), (1, 1), (0, 2), (1, 0), (0, 1), (0, 0)]
    powers += [(i, degree - i) for degree in (3, 4) for i in range(degree + 1)]
    solve = np.linalg.pinv(np.stack([x**i * y**j for i, j in powers], axis=1) * weight[:, None])
    place = start.copy()
    for _ in range(6):
        window = cv2.getRectSubPix(image, (9, 9), (float(place[0]), float(place[1]))).ravel()
        c = solve @ (window * weight)
        place += np.clip(-np.linalg.solve([[2 * c[0], c[1]], [c[1], 2 * c[2]]], c[3:5]), -1, 1)
    return place


def corner_errors(sequence, frames) -> np.ndarray:
    """Rendered minus projected corners (N, 2) [px], left and right, of fields at least 22 px wide seen from before."""
    errors = []
    world, rig = sequence.world, sequence.rig
    for k in frames:
        frame, seen = sequence.frame(k), visible_landmarks(sequence.world, k)
        offset = world.landmarks.positions[seen.ids] - world.T_world_left[k][:3, 3]
        facing = -(world.landmarks.normals[seen.ids] * offset).sum(axis=1) / np.linalg.norm(offset, axis=1)
        clear = (seen.size > 22) & (facing > 0.5)
        for image, uv, camera in ((frame.left, seen.uv_left, rig.left), (frame.right, seen.uv_right, rig.right)):
            smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 2.0)  # enough for `saddle`
            places = uv[clear & camera.in_image(uv, 12)]
            errors += [saddle(smooth, place) - place for place in places]
    return np.array(errors)


@pytest.mark.parametrize("rig", ["rectified", "toedin"])
@pytest.mark.parametrize("step", [0.1, 0.097])  # one falls on texels' and tiles' edges, the other does not
def test_corners_are_drawn_where_they_project_in_both_images(board_world, rig, step):
    sequence = board_world(f"rig={rig}&noise=0&vignetting=0", step)
    errors = corner_errors(sequence, range(3, 400, 44))  # in frame 47, corners lie on borders of blocks
    distance = np.linalg.norm(errors, axis=1)
    assert len(errors) > 80
    assert np.abs(errors.mean(axis=0)).max() < 0.01
    assert np.median(distance) < 0.02
    assert distance.max() < 0.05


def test_detail_finer_than_pixels_leaves_no_pattern(board_world):
    """Fields of 2 mm are less than half a pixel wide: they must turn grey, not into false patterns."""
    sequence = board_world("noise=0&vignetting=0&lens=0", 0.002)
    wall = sequence.object_ids(60) == 0
    depth = sequence.depth(60)
    image = sequence.frame(60).left.astype(float)
    inner = cv2.erode(((depth > 1.0) & (depth < 3.0) & wall).astype(np.uint8), np.ones((9, 9))) > 0
    assert inner.sum() > 5000
    assert abs(image[inner].mean() - 130) < 3
    assert image[inner].std() < 6  # of 90 grey levels in the texture


def test_rendering_twice_gives_the_same_bytes_whatever_the_order_and_the_threads():
    first, second = open_world("box?frames=40"), open_world("box?frames=40")
    threads = cv2.getNumThreads()
    in_sequence = list(first.frames(20, 23))
    try:
        cv2.setNumThreads(1)
        alone = second.frame(22)
        cv2.setNumThreads(4)
        again = second.frame(22)
    finally:
        cv2.setNumThreads(threads)
    for frame in (alone, again):
        assert np.array_equal(frame.left, in_sequence[2].left)
        assert np.array_equal(frame.right, in_sequence[2].right)
    assert (alone.index, alone.stamp) == (22, in_sequence[2].stamp)
    assert alone.left.dtype == np.uint8 and alone.left.shape == (240, 320)
