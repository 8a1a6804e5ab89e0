from __future__ import annotations

import cv2
import pytest

import slam
from slam.config import SystemConfig
from slam.errors import SlamError
from slam.run.drawing import _IN_MAP, _LEGEND, FramePictures
from tests.fuzz.runs import disk_of


@pytest.fixture(scope="module")
def steps():
    sequence = slam.open_sequence("synthetic:desk?frames=2")
    system = slam.StereoSlam(sequence.rig, config=SystemConfig.for_kind("handheld"))
    return system, [(frame, system.process(frame)) for frame in sequence]


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


def test_the_map_beside_a_frame_says_what_its_marks_are(steps, tmp_path):
    """Below the map there was white paper: its colours were to be guessed."""
    system, ((frame, result), _) = steps
    with FramePictures(tmp_path / "out", with_map=True) as pictures:
        pictures.show(frame, result, system)
    picture = cv2.imread(str(tmp_path / "out" / "000000.png"))
    side = len(picture) - _LEGEND
    bar = picture[side:, -side:].reshape(-1, 3)
    assert all((bar == colour).all(axis=1).any() for colour, _, _ in _IN_MAP)


def test_a_picture_is_whole_or_not_there(steps, tmp_path):
    system, ((frame, result), _) = steps
    with pytest.raises(SlamError, match=r"cannot write to .*png: File too large"), disk_of(500):
        FramePictures(tmp_path / "out").show(frame, result, system)
    assert list((tmp_path / "out").iterdir()) == []
