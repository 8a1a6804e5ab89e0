"""Systems in threads: each as if it were alone; one system used from two threads says so and is not broken."""

import pickle
import threading
from functools import cache

import pytest

from slam.errors import SlamError
from slam.system import StereoSlam
from tests.slam.digest import SEQUENCE, seen, state

FRAMES = 14


def run(backend: str) -> str:
    system = StereoSlam(SEQUENCE.rig, None, backend)
    for k in range(FRAMES):
        system.process_features(seen(k))
    return state(system)


alone = cache(run)


def in_threads(*works):
    """Results, or exceptions, of functions each in a thread of its own, begun together."""
    found, start = [None] * len(works), threading.Barrier(len(works))

    def begin(k):
        start.wait()
        try:
            found[k] = works[k]()
        except Exception as error:  # noqa: BLE001 it is compared
            found[k] = error

    threads = [threading.Thread(target=begin, args=(k,)) for k in range(len(works))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return found


@pytest.mark.parametrize("names", [("ekf", "ekf"), ("ekf", "smoother")])
def test_two_systems_in_two_threads_give_the_same_bytes_as_alone(names):
    assert in_threads(*(lambda name=name: run(name) for name in names)) == [alone(name) for name in names]


@pytest.mark.parametrize("backend", ["ekf", "smoother"])
def test_one_system_used_from_two_threads_says_so_and_goes_on(backend, monkeypatch):
    system = StereoSlam(SEQUENCE.rig, None, backend)
    system.process_features(seen(0))
    entered, go, predict = threading.Event(), threading.Event(), system.backend.predict

    def waiting(stamp):
        entered.set()
        assert go.wait(60)
        return predict(stamp)

    monkeypatch.setattr(system.backend, "predict", waiting)
    thread = threading.Thread(target=lambda: system.process_features(seen(1)))
    thread.start()
    assert entered.wait(60)
    calls = [
        lambda: system.process_features(seen(2)), system.estimate, system.snapshot,
        system.trajectory, lambda: pickle.dumps(system),
    ]  # fmt: skip
    try:
        for call in calls:
            with pytest.raises(SlamError, match=r"^this system is in use by another thread"):
                call()
    finally:
        go.set()
        thread.join()
    monkeypatch.undo()
    for k in range(2, FRAMES):
        system.process_features(seen(k))
    assert state(system) == alone(backend)
