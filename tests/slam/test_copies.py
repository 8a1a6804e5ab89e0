"""Systems that are copied go on to the same bytes, or say why they cannot be."""

import copy
import pickle

import numpy as np
import pytest

from slam.config import SystemConfig
from slam.errors import CopyError, SlamError
from slam.system import StereoSlam
from tests.slam.digest import SEQUENCE, seen, state

COPIES = {"deepcopy": copy.deepcopy, "pickle": lambda system: pickle.loads(pickle.dumps(system))}


def go_on(system: StereoSlam, first: int, last: int) -> str:
    """Digest after the frames from `first` up to, but without, `last`."""
    for k in range(first, last):
        system.process_features(seen(k))
    return state(system)


@pytest.mark.parametrize("backend", ["ekf", "window"])
@pytest.mark.parametrize(
    ("after", "setting"), [(0, ""), (1, ""), (20, ""), pytest.param(20, "map.monocular=true", marks=pytest.mark.slow)]
)
def test_copies_without_gtsam_go_on_to_the_same_bytes(backend, after, setting):
    config = SystemConfig().with_settings([setting] if setting else [])
    system = StereoSlam(SEQUENCE.rig, None, backend, config=config)
    for k in range(after):
        system.process_features(seen(k))
    others = [copied(system) for copied in COPIES.values()]
    whole = go_on(system, after, after + 6)  # the one does not notice the others
    assert [go_on(other, after, after + 6) for other in others] == [whole, whole]
    if backend == "window":  # what it goes through again
        for each in (system, *others):
            each.backend.revise(lambda z: z + np.array([0.1, 0.0, 0.0]))
        assert all(whole != state(system) == state(other) for other in others)


@pytest.mark.parametrize("copied", COPIES.values(), ids=COPIES)
def test_a_copy_has_a_front_end_of_its_own(copied):
    system = StereoSlam(SEQUENCE.rig, "surf", "ekf")
    for frame in SEQUENCE.frames(0, 2):
        system.process(frame)  # its threads have been started
    other = copied(system)
    for each in (system, other):
        for frame in SEQUENCE.frames(2, 4):
            each.process(frame)
    assert state(system) == state(other)


@pytest.mark.parametrize("copied", [*COPIES.values(), copy.copy], ids=[*COPIES, "copy"])
@pytest.mark.parametrize("backend", ["smoother", "batch"])
@pytest.mark.parametrize("after", [0, 3])
def test_what_holds_gtsam_says_that_it_cannot_be_copied(copied, backend, after):
    system = StereoSlam(SEQUENCE.rig, None, backend)
    for k in range(after):
        system.process_features(seen(k))
    whole = system if copied is not copy.copy else getattr(system.backend, "_smoother", system.backend)
    with pytest.raises(CopyError, match=r"save the map .* or record the run") as caught:
        copied(whole)
    assert isinstance(caught.value, SlamError) and isinstance(caught.value, TypeError)
    assert system.process_features(seen(after)).located
