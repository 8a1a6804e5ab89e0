from __future__ import annotations

import cv2
import numpy as np
import pytest

import slam
from slam.config import SystemConfig
from slam.errors import SlamError
from slam.run.drawing import FramePictures, draw_objects
from tests.fuzz.runs import disk_of


@pytest.fixture(scope="module")
def steps():
    sequence = slam.open_sequence("synthetic:desk?frames=2")
    system = slam.StereoSlam(sequence.rig, config=SystemConfig.for_kind("handheld", "surf", "ekf"))
    return system, [(frame, system.process(frame)) for frame in sequence]


def test_landmarks_are_drawn_and_the_rest_is_the_image(steps):
    system, ((frame, result), _) = steps
    picture = draw_objects(frame.left, result, system.rig)
    scale = picture.shape[1] // frame.left.shape[1]
    plain = cv2.resize(
        cv2.cvtColor(frame.left, cv2.COLOR_GRAY2BGR), None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC
    )
    drawn = (picture != plain).any(axis=2)
    uv = scale * (result.features.uv_left[result.added_features] + 0.5)
    rows, columns = np.nonzero(drawn)
    gap = np.hypot(rows[:, None] - uv[:, 1], columns[:, None] - uv[:, 0]).min(axis=1)
    assert len(result.added_features) > 10
    assert drawn.any() and gap.max() < 3 * scale  # circles of radius 2, one wide and smoothed


@pytest.mark.parametrize("name", ["pictures", "frames.mp4"])
def test_pictures_and_video(steps, tmp_path, name):
    system, frames = steps
    with FramePictures(tmp_path / name) as pictures:
        for frame, result in frames:
            pictures.show(frame, result, system)
    if name == "pictures":
        assert sorted(p.name for p in (tmp_path / name).iterdir()) == ["000000.png", "000001.png"]
        return
    video = cv2.VideoCapture(str(tmp_path / name))
    assert int(video.get(cv2.CAP_PROP_FRAME_COUNT)) == 2
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(1 / (frames[1][0].stamp - frames[0][0].stamp), rel=0.01)


def test_the_growing_map_stands_beside_the_frame(steps, tmp_path):
    system, ((frame, result), _) = steps
    with FramePictures(tmp_path / "out", with_map=True) as pictures:
        pictures.show(frame, result, system)
    picture = cv2.imread(str(next((tmp_path / "out").iterdir())))
    height = picture.shape[0] - 24
    alone = draw_objects(frame.left, result, system.rig)
    assert picture.shape[1] == alone.shape[1] + height
    beside = picture[:height, alone.shape[1] :]
    assert (beside == 255).all(axis=2).mean() > 0.5  # paper
    assert np.ptp(beside, axis=2).max() > 60  # landmarks and the path, in colour


def test_places_that_cannot_be_written_are_said(steps, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(SlamError, match="file/below: cannot be written"):
        FramePictures(tmp_path / "file" / "below")
    with pytest.raises(SlamError, match=r"a folder, or to a video FILE\.mp4"):
        FramePictures(tmp_path / "frames.avi")
    (tmp_path / "folder.mp4").mkdir()
    system, ((frame, result), _) = steps
    with pytest.raises(SlamError, match=r"folder\.mp4: cannot be written"), FramePictures(tmp_path / "folder.mp4") as p:
        p.show(frame, result, system)


def test_a_picture_is_whole_or_not_there(steps, tmp_path):
    system, ((frame, result), _) = steps
    with pytest.raises(SlamError, match=r"png: cannot be written: File too large"), disk_of(500):
        FramePictures(tmp_path / "out").show(frame, result, system)
    assert list((tmp_path / "out").iterdir()) == []
