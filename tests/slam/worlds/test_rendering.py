"""The renderer gives the same bytes however it is asked."""

from __future__ import annotations

import cv2
import numpy as np

from slam.worlds import open_world


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
