"""Frames at their own rate: the newest is given, the others are counted, and it can be ended while it waits."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from slam.data import StereoFrame
from slam.sequences.live import LiveFrames

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
