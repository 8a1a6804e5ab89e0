from __future__ import annotations

import numpy as np
import pytest

from slam import worlds
from slam.errors import SlamError


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("isle", r"unknown world 'isle' \(did you mean 'aisle'\?\); known: aisle, box, boxes"),
        ("aisle?sead=3", r"world aisle: unknown option 'sead' \(did you mean 'seed'\?\); known: baseline, .*seed"),
        ("aisle?frames=many", "frames must be a whole number from 1 to 1000000, got 'many'"),
        ("aisle?sigma=nan", "sigma must be a number from 0 to 100, got 'nan'"),
        ("aisle?seed=1&seed=2", "'seed' is given twice"),
        ("aisle?black=often", "black must be frames"),
        ("aisle?drop=0:2000", "no frame is left"),
    ],
)
def test_what_is_asked_for_wrongly_is_refused_in_one_line(text, message):
    with pytest.raises(SlamError, match=message) as caught:
        worlds.open_world(text)
    assert "\n" not in str(caught.value)


def test_faults_by_number_range_and_chance():
    sequence = worlds.open_world("box?frames=200&black=3,10:12&dropright=0.1&drop=20:30")
    faults = sequence.faults
    assert np.flatnonzero(faults["black"]).tolist() == [3, 10, 11]
    assert 5 < faults["dropright"].sum() < 40  # 20 expected of 200, far beyond five deviations either way
    assert len(sequence) == 190
    gaps = np.full(189, 1 / 30)
    gaps[19] += 10 / 30
    assert np.allclose(np.diff(sequence.stamps), gaps)
