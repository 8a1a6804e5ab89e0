from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

import slam
from slam.config import SystemConfig
from slam.errors import SlamError
from slam.geometry.se3 import pose
from slam.object_data import MovingObject, ObjectEstimate
from slam.run.drawing import FramePictures, draw_objects


@pytest.fixture(scope="module")
def steps():
    sequence = slam.open_sequence("synthetic:desk?frames=2")
    system = slam.StereoSlam(sequence.rig, config=SystemConfig.for_kind("handheld"))
    return system, [(frame, system.process(frame)) for frame in sequence]


@pytest.mark.parametrize("measured", [True, False])
def test_a_body_is_drawn_where_it_is_and_nowhere_else(steps, measured):
    """A box of half a metre, two metres ahead and to the left, within a frame of 320 x 240 pixels drawn threefold."""
    system, (_, (frame, result)) = steps
    place = result.estimate.T_world_left @ pose(np.eye(3), np.array([-0.4, 0.2, 2.0]))
    none, half = np.zeros(0, np.int64), 0.25 * 0.9  # of points whose 5th to 95th percentile this is
    e = ObjectEstimate(2, 0.0, place, np.eye(6), np.zeros(6), np.eye(6), measured, none, none)
    body = MovingObject(2, none, e, np.eye(4), np.eye(4), half * np.array([[-1.0] * 3, [1.0] * 3]), True)
    before, after = (draw_objects(frame.left, replace(result, objects=o), system.rig) for o in ((), (body,)))
    v, u = np.nonzero((before != after).any(axis=2))
    corners = np.array([-0.4, 0.2, 2.0]) + 0.25 * np.array(list(product([-1, 1], repeat=3)))
    low, high = (f(3 * (system.rig.left.project(corners) + 0.5), axis=0) for f in (np.min, np.max))
    assert u.min() == pytest.approx(low[0], abs=3)
    assert (u.max(), v.max()) == pytest.approx(high, abs=20 if measured else 3)  # the axes stand out by 5 cm
    assert low[1] - 25 < v.min() < low[1]  # the number and the speed stand above it
    drawn = (before != after).any(axis=2)[round(low[1]) + 4 :]
    assert (drawn.mean() > 0.011) == measured  # dashes otherwise, and no axes


def test_places_that_cannot_be_written_are_said(steps, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(SlamError, match=r"cannot write to .*file/below: "):
        FramePictures(tmp_path / "file" / "below")
    with pytest.raises(SlamError, match=r"a folder, or to a video FILE\.mp4"):
        FramePictures(tmp_path / "frames.avi")
    (tmp_path / "folder.mp4").mkdir()
    system, ((frame, result), _) = steps
    with pytest.raises(SlamError, match=r"folder\.mp4: cannot be written"), FramePictures(tmp_path / "folder.mp4") as p:
        p.show(frame, result, system)
