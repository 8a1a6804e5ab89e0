from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

import slam
from slam.config import SystemConfig
from slam.errors import SlamError
from slam.object_data import MovingObject, ObjectEstimate
from slam.run.drawing import FramePictures, _clear_place, draw_objects, with_legend
from slam.run.style import body_colour
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


def test_a_video_of_one_frame_is_written(steps, tmp_path):
    system, ((frame, result), _) = steps
    with FramePictures(tmp_path / "one.mp4") as pictures:
        pictures.show(frame, result, system)
    assert int(cv2.VideoCapture(str(tmp_path / "one.mp4")).get(cv2.CAP_PROP_FRAME_COUNT)) == 1


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


@pytest.mark.parametrize("name", ["\udc80", "\udc80.mp4"])
def test_names_that_are_no_utf8(steps, tmp_path, name):
    """OpenCV ends the process where it is given one."""
    system, ((frame, result), _) = steps
    if name.endswith("mp4"):
        with pytest.raises(SlamError, match="the name is not in UTF-8"):
            FramePictures(tmp_path / name)
        return
    with FramePictures(tmp_path / name) as pictures:
        pictures.show(frame, result, system)
    assert len(list((tmp_path / name).iterdir())) == 1


def test_a_picture_is_whole_or_not_there(steps, tmp_path):
    system, ((frame, result), _) = steps
    with pytest.raises(SlamError, match=r"png: cannot be written: File too large"), disk_of(500):
        FramePictures(tmp_path / "out").show(frame, result, system)
    assert list((tmp_path / "out").iterdir()) == []


def test_labels_do_not_cover_each_other_and_stay_inside():
    labels: list[tuple[int, int, int, int]] = []
    for at in [(50, 40), (60, 45), (55, 38), (700, -20)]:
        _clear_place(at, "3  14.50 m/s", (240, 640, 3), labels)
    for i, a in enumerate(labels):
        assert a[0] >= 0 and a[1] >= 0 and a[2] <= 640
        assert not any(a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3] for b in labels[:i])


def test_a_body_that_is_not_seen_is_drawn_otherwise(steps):
    system, ((frame, result), _) = steps
    T, none = np.eye(4), np.zeros(0, np.int64)
    T[:3, 3] = 0, 0, 2
    estimate = ObjectEstimate(1, 0.0, T, np.eye(6), np.zeros(6), np.eye(6), True, none, none)
    body = MovingObject(1, none, estimate, T, T, np.array([[-0.3] * 3, [0.3] * 3]), False)
    gone = replace(body, estimate=replace(estimate, measured=False))
    empty, seen, unseen = (
        draw_objects(frame.left, replace(result, objects=things), system.rig) for things in ((), (body,), (gone,))
    )
    assert (seen != empty).any() and (unseen != empty).any()
    assert 0 < (unseen != empty).sum() < 0.7 * (seen != empty).sum()


def test_bodies_are_in_the_legend_in_their_colours():
    body = SimpleNamespace(id=2, estimate=SimpleNamespace(measured=True))
    bar = with_legend(np.zeros((9, 960, 3), np.uint8), [body])[9:]
    assert (bar == body_colour(2)).all(axis=2).any()
    assert not (with_legend(np.zeros((9, 960, 3), np.uint8))[9:] == body_colour(2)).all(axis=2).any()


def test_the_legend_stands_below_the_picture(steps):
    system, ((frame, result), _) = steps
    picture = draw_objects(frame.left, result, system.rig)
    whole = with_legend(picture)
    assert whole.shape[0] > picture.shape[0] and whole.shape[1:] == picture.shape[1:]
    np.testing.assert_array_equal(whole[: len(picture)], picture)
    bar = whole[len(picture) :]
    assert 0.01 < (bar != 255).any(axis=2).mean() < 0.5
    assert (with_legend(picture[:, :10])[len(picture) :] == 255).all()  # no room
