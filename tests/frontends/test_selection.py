"""The adaptive D_threshold and the spreading over the image."""

from __future__ import annotations

import numpy as np

from frontends.surf.keypoints import adapted_threshold, spread


def test_limits_hold():
    assert adapted_threshold(10, 0, 100, 5, 1000) == 5
    assert adapted_threshold(900, 10_000, 100, 5, 1000) == 1000
    assert adapted_threshold(0.0, 10_000, 100, 0, 1000) > 0
    assert [adapted_threshold(300, count, 1000, 5, 1000) for count in (1100, 900)] == [300, 300]


def test_no_cell_takes_all():
    rng = np.random.default_rng(0)
    poster = rng.uniform((0, 0), (40, 40), (500, 2))  # the strongest 500 lie in one corner
    rest = rng.uniform((0, 0), (320, 240), (500, 2))
    uv = np.concatenate([poster, rest])
    kept = np.flatnonzero(spread(uv, 200, (8, 6), (320, 240)))
    assert len(kept) == 200
    assert (kept < 500).mean() < 0.15
    cells = set(map(tuple, (uv[kept] // 40).astype(int)))
    assert len(cells) == 48


def test_what_poor_cells_leave_goes_to_the_strongest():
    rng = np.random.default_rng(0)
    uv = rng.uniform((0, 0), (40, 40), (500, 2))
    assert np.array_equal(spread(uv, 200, (8, 6), (320, 240)), np.arange(500) < 200)
    assert spread(uv[:50] - 1, 50, (8, 6), (320, 240)).all()
