from __future__ import annotations

import numpy as np

from slam import worlds


def test_faults_by_number_range_and_chance():
    sequence = worlds.open_world("box?frames=200&black=3,10:12&dropright=0.1&drop=20:30")
    faults = sequence.faults
    assert np.flatnonzero(faults["black"]).tolist() == [3, 10, 11]
    assert 5 < faults["dropright"].sum() < 40  # 20 expected of 200, far beyond five deviations either way
    assert len(sequence) == 190
    gaps = np.full(189, 1 / 30)
    gaps[19] += 10 / 30
    assert np.allclose(np.diff(sequence.stamps), gaps)
