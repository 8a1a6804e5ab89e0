"""Parts of a body that move on their own."""

from __future__ import annotations

import numpy as np
import pytest

from slam.geometry.se3 import transform
from slam.objects.parts import parts_of
from tests.slam.objects.test_membership import SIGMA, SLOT, TIMES, WINDOW, body_along, path, seen_from, table

BODY = np.array([0.0, 0.5, 0.0, 0.2, 0.0, 0.0])  # [rad/s], [m/s]
FORWARD = np.array([0.0, 0.0, 1.0])
AGES = (SLOT - np.arange(WINDOW)) % WINDOW


@pytest.mark.parametrize(("speed", "count"), [(0.15, 1), (0.0, 0)])
def test_a_drawer_is_found_only_while_it_is_pulled_out(speed: float, count: int) -> None:
    rng = np.random.default_rng(3)
    chest = rng.uniform((-0.15, -0.1, -0.1), (0.15, 0.15, 0.1), (24, 3))
    drawer = rng.uniform((-0.06, -0.05, -0.12), (0.06, 0.05, -0.1), (6, 3))
    poses = path(BODY)
    pulled = np.stack([transform(T, drawer - speed * t * FORWARD) for T, t in zip(poses, TIMES)], axis=1)
    pulled += SIGMA * rng.standard_normal(pulled.shape)
    tracks = table(np.concatenate([seen_from(poses, chest, 1), pulled]))
    rows = np.arange(30)
    body = body_along(poses, rows, tracks)
    place = np.column_stack([tracks.position[rows, :2], np.log(tracks.position[rows, 2])])
    groups = parts_of(body, tracks, rows, AGES, place, 20.0, 4)
    assert [group.members.tolist() for group in groups] == [list(range(24, 30))][:count]


def test_few_tracks_have_no_parts() -> None:
    tracks = table(seen_from(path(BODY), np.random.default_rng(1).uniform(-0.1, 0.1, (6, 3)), 1))
    body = body_along(path(BODY), np.arange(6), tracks)
    assert parts_of(body, tracks, np.arange(6), AGES, np.zeros((6, 3)), 20.0, 4) == []
