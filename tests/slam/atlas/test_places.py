"""A place seen again is the most similar one."""

from __future__ import annotations

import numpy as np

from slam.atlas.places import PlaceIndex


def places(count: int, seed: int = 0) -> np.ndarray:
    """Descriptors (count, 200, 16) of unit length."""
    found = np.random.default_rng(seed).normal(size=(count, 200, 16)).astype(np.float32)
    return found / np.linalg.norm(found, axis=2, keepdims=True)


def noisy(descriptors: np.ndarray, seed: int) -> np.ndarray:
    """Half of a place's descriptors as seen again, and as many others."""
    rng = np.random.default_rng(seed)
    seen = descriptors[::2] + 0.05 * rng.normal(size=descriptors[::2].shape)
    both = np.concatenate([seen, rng.normal(size=(100, 16))]).astype(np.float32)
    return both / np.linalg.norm(both, axis=1, keepdims=True)


def test_finds_the_place():
    every, index = places(100), PlaceIndex()
    for some in every:
        index = index.with_new(some)
    assert index.count == 100
    right = [int(np.argmax(index.similarity(noisy(some, k)))) == k for k, some in enumerate(every)]
    assert np.mean(right) > 0.95


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
