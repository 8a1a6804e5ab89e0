"""Cameras, played by video files and by a class that stops giving frames, and frames at their own rate."""

import threading
import time
from pathlib import Path

import numpy as np
import pytest

import slam
from slam.data import StereoFrame
from slam.errors import SequenceError
from slam.sequences import camera, is_live
from slam.sequences.live import LiveFrames
from tests.recordings import write_opencv

WIDTH, HEIGHT = 160, 120


@pytest.fixture
def rig_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> slam.StereoRig:
    """The calibration of the scene in the working folder."""
    rig = slam.open_sequence(f"synthetic:desk?frames=4&width={WIDTH}&height={HEIGHT}").rig
    write_opencv(tmp_path / "calibration.yaml", rig)
    monkeypatch.chdir(tmp_path)
    return rig


class Played:
    """A camera that gives images in turn; None stands for a failure, after which it must be opened again."""

    opened = 0

    def __init__(self, images: list[np.ndarray | None]) -> None:
        self.images, self.now, self.released = images, None, False
        Played.opened += 1

    def grab(self) -> bool:
        self.now = self.images.pop(0) if self.images else None
        return self.now is not None

    def retrieve(self) -> tuple[bool, np.ndarray | None]:
        return self.now is not None, self.now

    def release(self) -> None:
        self.released = True


@pytest.fixture
def played(monkeypatch: pytest.MonkeyPatch):
    """Puts cameras in place of the machine's: a list of images by address, shared by all that open it."""
    monkeypatch.setattr(camera, "_AGAIN", 0.01)
    Played.opened = 0

    def put(images: dict[str, list[np.ndarray | None]]) -> None:
        def open_device(address, *_):
            if address not in images:
                raise SequenceError(f"camera:{address}: cannot be opened")
            return Played(images[address])

        monkeypatch.setattr(camera, "open_device", open_device)

    return put


def grey(value: int, width: int = WIDTH) -> np.ndarray:
    return np.full((HEIGHT, width), value, np.uint8)


def both(values) -> list[np.ndarray]:
    """Images that hold a left and a right one, side by side."""
    return [np.hstack([grey(10 * k), grey(10 * k + 5)]) for k in values]


def test_two_devices_and_one_with_both_images_give_the_same(rig_here, played):
    left, right = [grey(10 * k) for k in range(1, 5)], [grey(10 * k + 5) for k in range(1, 5)]
    for text, images in (("camera:0,1", {"0": left, "1": right}), ("camera:2", {"2": both(range(1, 5))})):
        played(images)
        sequence = slam.open_sequence(text)
        assert is_live(sequence) and sequence.rig.b == pytest.approx(rig_here.b)
        assert (sequence.format, sequence.kind, sequence.name) == ("camera", "handheld", text)
        frames = list(sequence.frames(0, 3))
        found = [(f.index, int(f.left[0, 0]), int(f.right[0, 0])) for f in frames]
        assert found == [(k - 2, 10 * k, 10 * k + 5) for k in (2, 3, 4)]  # the first pair told the size
        assert (np.diff([f.stamp for f in frames]) > 0).all() and abs(frames[0].stamp - time.time()) < 60


def test_a_camera_that_stops_and_comes_back_is_waited_for(rig_here, played, caplog):
    pairs = both(range(6))
    played({"0": [*pairs[:3], None, None, None, *pairs[3:]]})
    sequence = slam.open_sequence("camera:0")
    frames = list(sequence.frames(0, 5))
    assert [int(f.left[0, 0]) for f in frames] == [10, 20, 30, 40, 50]
    assert (np.diff([f.stamp for f in frames]) > 0).all()
    assert Played.opened == 5  # for the size, for the frames, and after each of the failures
    assert len(sequence.warnings) == 2
    assert "no more frames; they are waited for 10 s" in caplog.text and "frames again after 0." in caplog.text


def test_a_camera_that_stays_silent_ends_the_run_with_one_line(rig_here, played):
    played({"0": both([1]) * 3})
    frames = slam.open_sequence("camera:0?wait=0.05").frames()
    assert [next(frames).index, next(frames).index] == [0, 1]
    with pytest.raises(SequenceError, match=r"camera:0: no frames for 0.05 s"):
        next(frames)


def test_a_device_that_is_not_there_is_said_to_be_missing():
    with pytest.raises(SequenceError, match=r"camera:none\.mp4: cannot be opened: there is no such file or device"):
        slam.open_sequence("camera:none.mp4")


IMAGE = np.zeros((4, 4), np.uint8)


def frames(count, period=0.01):
    return [StereoFrame(k, 5.0 + period * k, IMAGE, IMAGE) for k in range(count)]


def threads():
    return [thread for thread in threading.enumerate() if thread.name == "live frames"]


def test_whoever_is_fast_enough_gets_every_frame_at_its_time():
    live, began = LiveFrames(frames(4, 0.25)), time.monotonic()
    taken = [(frame.index, time.monotonic() - began) for frame in live]
    assert [index for index, _ in taken] == list(range(4))
    assert all(when >= 0.25 * index for index, when in taken)
    assert live.dropped == 0 and not threads()


def test_whoever_is_too_slow_gets_the_newest_and_what_is_left_out_is_counted():
    live, indices = LiveFrames(frames(100, 0.005)), []
    for frame in live:
        indices.append(frame.index)
        time.sleep(0.05)
        assert live.age(frame) >= 0.05
    assert indices == sorted(indices) and indices[-1] == 99 and 3 < len(indices) < 50
    assert live.dropped == 100 - len(indices)


def test_it_ends_while_no_frame_comes_although_the_driver_is_stuck(monkeypatch):
    monkeypatch.setattr("slam.sequences.live._PARTING", 0.05)
    stuck, until = threading.Event(), threading.Event()

    def camera():
        yield frames(1)[0]
        stuck.wait(20)

    live = LiveFrames(camera(), paced=False, until=until)
    taking = iter(live)
    next(taking)
    threading.Timer(0.1, until.set).start()
    began = time.monotonic()
    assert list(taking) == []
    assert time.monotonic() - began < 10
    stuck.set()


def test_an_error_of_the_source_is_raised_and_the_source_is_closed():
    closed = threading.Event()

    def camera():
        try:
            yield frames(1)[0]
            raise ValueError("broken")
        finally:
            closed.set()

    with pytest.raises(ValueError, match="broken"):
        list(LiveFrames(camera(), paced=False))
    assert closed.is_set()
    for _ in LiveFrames(frames(1000, 0.01)):
        break
    assert not threads()
