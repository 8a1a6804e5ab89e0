"""Pairing by nearest stamp, and the fewest rows dropped that make time increase."""

from itertools import combinations, pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from slam.geometry.stamps import increasing, pair

STAMPS = st.lists(st.integers(0, 40), max_size=9)
KEYS = st.lists(st.integers(0, 60), unique=True, max_size=12).map(sorted)


@given(STAMPS)
def test_increasing_drops_as_few_rows_as_any_choice_could(stamps: list[int]) -> None:
    rows = increasing(stamps)
    kept = np.array(stamps, int)[rows]
    assert (np.diff(rows) > 0).all()
    assert (np.diff(kept) > 0).all()
    longest = max(
        size
        for size in range(len(stamps) + 1)
        if size == 0 or any(all(a < c for a, c in pairwise(s)) for s in combinations(stamps, size))
    )
    assert len(rows) == longest


@given(KEYS, KEYS, st.integers(0, 10))
def test_pairs_are_near_and_unique_and_none_is_forgotten(left: list[int], right: list[int], tolerance: int) -> None:
    a, c = np.array(left, int), np.array(right, int)
    partner = pair(a, c, tolerance)
    used = partner[partner >= 0]
    assert len(partner) == len(a)
    assert len(np.unique(used)) == len(used)
    assert (np.abs(a[partner >= 0] - c[used]) <= tolerance).all()
    assert (np.diff(used) > 0).all()  # order is kept
    for row in np.flatnonzero(partner < 0):  # its nearest partner is too far away, or as near or nearer to another row
        distance = np.abs(c - a[row])
        for nearest in np.flatnonzero(distance == distance.min(initial=99)):
            taken_by = a[partner == nearest]
            near = len(taken_by) and abs(int(taken_by[0]) - int(c[nearest])) <= distance[nearest]
            if distance[nearest] > tolerance or near:
                break
        else:
            assert not len(c)
