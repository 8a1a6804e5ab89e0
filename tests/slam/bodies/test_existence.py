from __future__ import annotations

import pytest

from slam.bodies.belief import EVEN, when_measured, when_missed


def test_a_body_that_moves_clearly_is_soon_certain():
    assert when_measured(EVEN, gain=8.0) > 0.98
    assert when_measured(EVEN, gain=0.0) < 0.7  # at rest it shows little
    assert when_measured(0.999999, gain=1e6) < 1.0  # and never so certain that it could not be forgotten


def test_one_that_is_not_seen_fades_the_faster_the_surer_it_was_seen_before():
    steady = flickering = 0.99
    for k in range(4):
        steady, flickering = when_missed(steady, 50, 50 + k), when_missed(flickering, 5, 15 + k)
    assert steady < 0.01 < 0.5 < flickering


def test_bayes_in_one_frame():
    # of 100 bodies 90 exist; where there is one it is seen in 8 of 10 frames: 18 of 28 unseen ones exist
    assert when_missed(0.9, seen=7, age=8) == pytest.approx(18 / 28)
