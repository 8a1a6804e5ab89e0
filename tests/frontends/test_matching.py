"""Matching against a plain search over all pairs."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from frontends.surf.matching import match
from slam.errors import MeasurementError


def random_set(rng, count, dimensions):
    d = rng.standard_normal((count, dimensions)).astype(np.float32)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    return d, rng.uniform(0, 100, (count, 2)), rng.choice([-1, 1], count).astype(np.int8)


def plain_match(a, b, window, d_match, ratio, mutual):
    """The same by brute force."""
    (d, uv, sign), (d2, uv2, sign2) = a, b
    distance = np.linalg.norm(d[:, None] - d2[None], axis=2)
    far = np.abs(uv[:, None] - uv2[None]).max(axis=2) > np.broadcast_to(window, len(d))[:, None]
    distance[far | (sign[:, None] != sign2[None])] = np.inf
    pairs = []
    for i, row in enumerate(distance):
        order = np.argsort(row)
        if not len(order) or not np.isfinite(row[order[0]]):
            continue
        j = order[0]
        rival = row[order[1]] if len(order) > 1 else np.inf
        if row[j] > d_match or row[j] > ratio * rival or (mutual and distance[:, j].argmin() != i):
            continue
        pairs.append((i, j))
    return pairs


@settings(max_examples=40)
@given(
    seed=st.integers(0, 10_000), n=st.integers(0, 30), n2=st.integers(0, 30), dimensions=st.sampled_from([16, 64]),
    window=st.sampled_from([np.inf, 40.0, 5.0]), d_match=st.sampled_from([np.inf, 1.0]),
    ratio=st.sampled_from([1.0, 0.9, 0.7]), mutual=st.booleans(),
)  # fmt: skip
def test_against_all_pairs(seed, n, n2, dimensions, window, d_match, ratio, mutual):
    rng = np.random.default_rng(seed)
    a, b = random_set(rng, n, dimensions), random_set(rng, n2, dimensions)
    if n and np.isfinite(window):
        window = window * rng.uniform(0.5, 1.5, n)
    found = match(
        a[0], b[0], signs=(a[2], b[2]), places=(a[1], b[1]), window=window, d_match=d_match, ratio=ratio, mutual=mutual
    )
    assert list(zip(found.first, found.second)) == plain_match(a, b, window, d_match, ratio, mutual)
    np.testing.assert_allclose(
        found.distance, np.linalg.norm(a[0][found.first] - b[0][found.second], axis=1), atol=1e-5
    )


def test_all_pairs_without_places_or_signs():
    rng = np.random.default_rng(0)
    d, _, _ = random_set(rng, 50, 64)
    order = rng.permutation(50)
    found = match(d, d[order])
    assert np.array_equal(order[found.second], np.arange(50))
    assert found.distance.max() < 1e-3


def test_shapes_must_fit():
    with pytest.raises(MeasurementError, match="differ in length"):
        match(np.zeros((3, 64), np.float32), np.zeros((3, 16), np.float32))
    with pytest.raises(MeasurementError, match="3 and 2 rows"):
        match(np.zeros((3, 16), np.float32), np.zeros((2, 16), np.float32), places=(np.zeros((2, 2)), np.zeros((2, 2))))
