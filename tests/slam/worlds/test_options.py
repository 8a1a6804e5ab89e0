from __future__ import annotations

import numpy as np
import pytest

from slam import worlds
from slam.errors import ConfigurationError, SequenceError, UnknownNameError


def test_an_unknown_world_is_answered_with_the_known_ones():
    with pytest.raises(
        UnknownNameError, match=r"unknown world 'isle' \(did you mean 'aisle'\?\); known: aisle, box, boxes"
    ):
        worlds.open_world("isle")
    with pytest.raises(UnknownNameError, match="known: aisle"):
        worlds.describe("")


def test_an_unknown_key_is_answered_with_the_known_ones():
    with pytest.raises(
        ConfigurationError,
        match=r"world 'aisle' has no option 'sead' \(did you mean 'seed'\?\); known: baseline, .*seed",
    ):
        worlds.open_world("aisle?sead=3")


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ("frames=many", "frames must be a whole number, got 'many'"),
        ("frames=2.5", "frames must be a whole number"),
        ("frames=-1", r"frames must lie in 0\.\."),
        ("sigma=nan", "sigma must lie in"),
        ("detect=1.5", r"detect must lie in 0\.\.1, got 1\.5"),
        ("rig=crooked", "rig must be one of rectified, toedin, got 'crooked'"),
        ("seed=1&seed=2", "'seed' is given twice"),
        ("black=often", "black must be frames"),
        ("black=1.5", r"a chance must lie in 0\.\.1"),
        ("jump=5", "jump must be FRAME:SECONDS"),
        ("jump=5:-1", "jump must be from frame 1 on and ahead"),
        ("drop=0:2000", "no frame is left"),
    ],
)
def test_impossible_values_are_refused_in_one_line(query, message):
    with pytest.raises(ConfigurationError, match=message) as caught:
        worlds.open_world(f"aisle?{query}")
    assert "\n" not in str(caught.value)


def test_frames_outside_the_recording_are_refused():
    sequence = worlds.open_world("box?frames=5")
    with pytest.raises(SequenceError, match="there is no frame 5; it has 5"):
        sequence.observations(5)
    with pytest.raises(SequenceError, match="frames 5: asked for"):
        sequence.frames(5)


def test_faults_by_number_range_and_chance():
    sequence = worlds.open_world("box?frames=200&black=3,10:12&blur=0.1&drop=20:30&jump=50:2.0")
    faults = sequence.faults
    assert np.flatnonzero(faults.frames["black"]).tolist() == [3, 10, 11]
    assert 5 < faults.frames["blur"].sum() < 40  # 20 expected of 200, far beyond five deviations either way
    assert len(sequence) == 190
    gaps = np.diff(sequence.stamps)
    assert np.isclose(gaps[19], 11 / 30)
    assert np.isclose(gaps[39], 2.0 + 1 / 30)
    assert np.allclose(np.delete(gaps, [19, 39]), 1 / 30)
