"""A step that an interrupt ends at any line did not happen: map and back end agree, and the next frames are tracked."""

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest

import slam
from slam.data import FrameStatus
from slam.runtime.threads import one_blas_thread
from slam.system import StereoSlam
from tests.slam.scene import BACKENDS, CONFIG, RIG, Cloud, path

HERE = tuple(str(Path(slam.__file__).parents[1] / package) for package in ("slam", "backends"))


class Lines:
    """Counts the lines of the system and of its back end that are run, and raises in the n-th."""

    def __init__(self, stop: int | None = None) -> None:
        self.count = 0
        self.stop = stop

    @contextmanager
    def watched(self) -> Iterator[None]:
        before = sys.gettrace()
        sys.settrace(self._called)
        try:
            yield
        finally:
            sys.settrace(before)

    def _called(self, frame: FrameType, event: str, argument: Any) -> Any:
        if not frame.f_code.co_filename.startswith(HERE):
            return None
        return self._line

    def _line(self, frame: FrameType, event: str, argument: Any) -> Any:
        if event == "line":
            self.count += 1
            if self.count == self.stop:
                raise KeyboardInterrupt
        return self._line


def interrupted(system: StereoSlam, features: Any, line: int) -> bool:
    """Whether the step was interrupted before it ended."""
    try:
        with Lines(line).watched():
            system.process_features(features)
    except KeyboardInterrupt:
        return True
    return False


def assert_agree(system: StereoSlam) -> None:
    estimate = system.estimate()
    np.testing.assert_array_equal(np.sort(estimate.ids), system.landmarks.ids)
    np.testing.assert_array_equal(system.backend.positions(system.landmarks.ids).shape, (len(estimate.ids), 3))


def interrupt_often(system: StereoSlam, frames: Iterator[Any], points: int) -> None:
    """Every third frame is interrupted, each time later in the step; the two frames after it must be tracked."""
    counts, hits = [], 0
    for _ in range(3):
        counter = Lines()
        with counter.watched():
            index = system.process_features(next(frames)).index
        counts.append(counter.count)
    for k in range(points):  # in a step that calibrates, or makes a keyframe, more lines are run than in most
        hits += interrupted(system, next(frames), 1 + k * min(counts) // points)
        if k % 4 == 0:
            assert_agree(system)
        results = [system.process_features(next(frames)) for _ in range(2)]
        assert [r.status for r in results] == [FrameStatus.TRACKED] * 2, k
        index = index + 2 if results[-1].index == index + 2 else index + 3  # the last lines may not be reached
        assert results[-1].index == index
        assert results[-1].map_size == len(system.landmarks)
    assert hits >= 0.6 * points  # steps have more and fewer lines than the one that was counted
    assert_agree(system)


@pytest.mark.parametrize("backend", BACKENDS)
def test_interrupted_at_any_line_the_next_frames_are_tracked(backend):
    cloud, points = Cloud(150), 12
    system, truth = StereoSlam(RIG, None, backend, config=CONFIG), path(3 * points + 13)
    frames = (cloud.features(T, k / 30, 0.3)[0] for k, T in enumerate(truth))
    for _ in range(8):
        system.process_features(next(frames))
    interrupt_often(system, frames, points)
    trajectory = system.trajectory()
    true = np.array([truth[round(30 * s)][:3, 3] for s in trajectory.stamps])
    assert np.linalg.norm(trajectory.positions - true, axis=1).max() < 0.03


@pytest.mark.parametrize("case", [*BACKENDS, "in a map"])
def test_the_step_that_starts_or_finds_the_camera_in_a_map_may_be_interrupted(case):
    cloud, counter, hits = Cloud(150), Lines(), 0
    options = {"backend": "ekf" if case == "in a map" else case, "config": CONFIG}
    first = StereoSlam(RIG, None, **options)
    for k, T in enumerate(path(8)):
        first.process_features(cloud.features(T, k / 30, 0.3)[0])
    if case == "in a map":
        options["prior_map"] = first.snapshot()
    features = [cloud.features(T, k / 30, 0.3)[0] for k, T in enumerate(path(4))]
    with counter.watched():
        StereoSlam(RIG, None, **options).process_features(features[0])
    for line in range(1, counter.count, max(1, counter.count // 8)):
        system = StereoSlam(RIG, None, **options)
        hits += interrupted(system, features[0], line)  # some lines are run once in a process
        results = [system.process_features(f) for f in features[1:]]
        assert [r.status for r in results[1:]] == [FrameStatus.TRACKED] * 2, line
        assert_agree(system)
    assert hits > 4


def test_a_call_with_one_blas_thread_that_is_interrupted_at_any_line_leaves_its_lock():
    """Else every other thread that comes to it waits for ever."""
    limited, counter = one_blas_thread(lambda: None), Lines()
    limited()  # looks the libraries up
    with counter.watched():
        limited()
    assert counter.count >= 8
    for line in range(1, counter.count + 1):
        with pytest.raises(KeyboardInterrupt), Lines(line).watched():
            limited()
        done = threading.Event()
        threading.Thread(target=lambda done=done: (limited(), done.set()), daemon=True).start()
        assert done.wait(10.0), line
