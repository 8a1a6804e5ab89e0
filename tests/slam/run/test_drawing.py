from __future__ import annotations

import cv2
import numpy as np
import pytest

import slam
from slam.config import SystemConfig
from slam.errors import SlamError
from slam.run.drawing import FramePictures
from slam.run.schema import body_colour


@pytest.fixture(scope="module")
def steps():
    sequence = slam.open_sequence("synthetic:desk?frames=2")
    system = slam.StereoSlam(sequence.rig, config=SystemConfig.for_kind("handheld"))
    return system, [(frame, system.process(frame)) for frame in sequence]


def test_fifteen_bodies_have_colours_of_their_own():
    assert len({body_colour(body) for body in range(1, 16)}) == 15


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


@pytest.mark.parametrize("name", ["frames", "run.mp4"])
def test_frames_are_drawn_with_the_map_that_grows_beside_them(steps, tmp_path, name):
    system, both = steps
    with FramePictures(tmp_path / name) as pictures:
        for frame, result in both:
            pictures.show(frame, result, system)
    if name == "frames":
        drawn = [cv2.imread(str(tmp_path / name / f"{k:06d}.png")) for k in range(2)]
    else:
        film = cv2.VideoCapture(str(tmp_path / name))
        drawn = [film.read()[1] for _ in range(2)]
        assert film.get(cv2.CAP_PROP_FPS) == pytest.approx(30.0)
    high, wide = 3 * 240, 3 * 320  # of the image, enlarged
    assert all(picture.shape == (high + 24, wide + high, 3) for picture in drawn)  # a legend below both, the map beside
    blue, _, red = np.moveaxis(drawn[1][:high, wide:].astype(int), 2, 0)
    assert (blue - red > 100).sum() > 50 and (red - blue > 100).any()  # landmarks, and the path
    assert (drawn[0][high:] < 100).any()
