"""A place seen again is the most similar one."""

from __future__ import annotations

import numpy as np

from slam.atlas.places import PlaceIndex


def similar_places(count: int) -> np.ndarray:
    """Places (count, 200, 16) like shelves of books: all show the same few kinds of features, in other variations."""
    rng = np.random.default_rng(5)
    kinds = rng.normal(size=(4, 16))
    variations = kinds[rng.integers(0, 4, (count, 200))] + 0.8 * rng.normal(size=(count, 200, 16))
    return (variations / np.linalg.norm(variations, axis=2, keepdims=True)).astype(np.float32)


def test_the_first_places_are_found_as_well_as_later_ones():
    """From elsewhere: 30 of a place's 200 descriptors, somewhat changed, and as many more of another place."""
    every, index = similar_places(90), PlaceIndex()
    for some in every[:70]:
        index = index.with_new(some)
    ranks = []
    for k in range(70):
        rng = np.random.default_rng(k)
        same = every[k][rng.choice(200, 30, replace=False)] + 0.1 * rng.normal(size=(30, 16))
        seen = np.concatenate([same, every[70 + k % 20, :170]]).astype(np.float32)
        order = np.argsort(-index.similarity(seen), kind="stable")
        ranks.append(int(np.flatnonzero(order == k)[0]))
    compared = np.array(ranks) < 8  # as many are compared in detail
    assert compared[:16].mean() > 0.75  # 0.94; of words from the first keyframes alone 0.56
    assert compared.mean() > 0.75
