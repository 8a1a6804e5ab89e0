"""What is reported of bodies that are not measured."""

from __future__ import annotations

import numpy as np
import pytest

import slam
from slam.bodies import bodies

EVEN, GONE = 50, 100  # frames: the box moves from 60 on, and is covered from 100 on


@pytest.mark.slow
def test_a_body_out_of_view_is_reported_for_a_short_while_only(monkeypatch):
    monkeypatch.setattr(bodies, "UNMEASURED_SHARE", 0.1)
    sequence = slam.open_sequence("synthetic:box?density=300")
    system = slam.StereoSlam(sequence.rig, None, "ekf", kind=sequence.kind)
    rows = [thing for k in range(EVEN, GONE) for thing in system.process_features(sequence.observations(k)).objects]
    # It moves in 40 of these frames; two tests are sure of that, in two frames in succession, 18 to 27 frames later,
    # with another first frame each time.
    measured = sum(thing.estimate.measured for thing in rows)
    assert measured >= 13 and rows[-1].existence > 0.99
    assert rows[-1].measured_at == rows[-1].estimate.stamp
    after = []
    for k in range(GONE, GONE + 40):
        seen = sequence.simulate(k)
        things = system.process_features(seen.features.select(seen.objects == 0)).objects
        after += [thing for thing in things if thing.id == rows[-1].id]
    assert 1 <= len(after) <= 0.1 * 40  # it is measured before it is reported
    last = rows[-1].measured_at
    assert all(not thing.estimate.measured and thing.measured_at == last for thing in after)
    sure = [rows[-1].existence, *(thing.existence for thing in after)]
    assert (np.diff(sure) < 0).all() and sure[-1] > 0.5
