from __future__ import annotations

import pytest

import slam
from slam.config import SystemConfig
from slam.errors import SlamError
from slam.run.drawing import FramePictures


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
