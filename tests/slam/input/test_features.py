"""Frames that are not as documented are refused with one plain error before anything changes."""

import math
from dataclasses import replace
from decimal import Decimal
from functools import partial

import numpy as np
import pytest

from slam.data import FrameStatus, StereoFeatures
from slam.errors import MeasurementError
from slam.system import StereoSlam
from tests.slam.scene import BACKENDS, CONFIG, RIG, Cloud, path

COLUMNS = ("uv_left", "uv_right", "scale", "angle", "response", "laplacian", "descriptors")


def with_value(name, value, rows=3):
    """A change that puts a value into some rows of a column."""

    def change(features):
        array = getattr(features, name).copy()
        array[:rows] = value
        return replace(features, **{name: array})

    return change


def as_other(name, function):
    """A change of a whole column."""
    return lambda features: replace(features, **{name: function(getattr(features, name))})


def at(stamp, features):
    return replace(features, stamp=stamp)


STAMPS = {
    f"stamp {text}": partial(at, value)
    for text, value in {
        "None": None, "text": "1.0", "NaN": math.nan, "inf": math.inf, "-inf": -math.inf, "earlier": 0.0,
        "array": np.array([9.0]), "complex": 9j, "true": True, "decimal": Decimal(9), "huge": 10**400,
        "nanoseconds": 17 * 10**17,
    }.items()
}  # fmt: skip
VALUES = {
    f"{value} in {name}": with_value(name, value)
    for name in ("uv_left", "scale", "angle", "response", "descriptors")
    for value in (math.nan, math.inf)
} | {f"{value} in uv_right": with_value("uv_right", value) for value in (math.inf, -math.inf, 1e30)}
SHAPES = {
    f"{name} {what}": as_other(name, function)
    for name in COLUMNS
    for what, function in {
        "of text": lambda a: a.astype(str),
        "of objects": lambda a: a.astype(object),
        "complex": lambda a: a.astype(complex),
        "of truth values": lambda a: a.astype(bool),
        "as a list": lambda a: a.tolist(),
        "with another dimension": lambda a: a[:, None],
    }.items()
} | {
    "uv_left of three columns": as_other("uv_left", lambda a: np.column_stack([a, a[:, 0]])),
    "uv_right of one column": as_other("uv_right", lambda a: a[:, :1]),
    "pixels of whole numbers": as_other("uv_left", lambda a: a.astype(int)),
    "laplacian of reals": as_other("laplacian", lambda a: a.astype(float)),
    "longer descriptors": as_other("descriptors", lambda a: np.hstack([a, a])),
    "shorter descriptors": as_other("descriptors", lambda a: a[:, :16]),
    "descriptors without numbers": as_other("descriptors", lambda a: a[:, :0]),
    "descriptors of another length": as_other("descriptors", lambda a: 3 * a),
    "columns exchanged": as_other("uv_left", lambda a: a[:, ::-1]),
    "descriptors too large for float32": as_other("descriptors", lambda a: a.astype(float) * 1e300),
    "pixels far outside": with_value("uv_left", 1e30),
    "a threshold of text": lambda features: replace(features, threshold="high"),
    "no features at all": lambda features: None,
    "a dictionary": vars,
}
HOSTILE = STAMPS | VALUES | SHAPES


def state(system):
    estimate = system.estimate()
    return [estimate.stamp, estimate.T_world_left, estimate.covariance, estimate.ids, estimate.positions] + [
        getattr(system.landmarks, name).copy() for name in ("ids", "seen", "in_view", "missed", "unseen", "last_seen")
    ]


@pytest.mark.parametrize("backend", BACKENDS)
def test_what_is_not_as_documented_is_refused_and_changes_nothing(backend):
    cloud, truth = Cloud(150), path(14)
    system = StereoSlam(RIG, None, backend, config=CONFIG)
    for k in range(10):
        system.process_features(cloud.features(truth[k], k / 30, 0.3)[0])
    before = state(system)
    for name, change in HOSTILE.items():
        with pytest.raises(MeasurementError) as caught:
            system.process_features(change(cloud.features(truth[10], 10 / 30, 0.3)[0]))
        assert "\n" not in str(caught.value), name
    for one, other in zip(state(system), before):
        np.testing.assert_array_equal(one, other)
    for k in range(10, 14):
        assert system.process_features(cloud.features(truth[k], k / 30, 0.3)[0]).status is FrameStatus.TRACKED


@pytest.mark.parametrize("backend", BACKENDS)
def test_other_widths_and_half_matches_are_taken(backend):
    changes = [
        as_other("uv_left", lambda a: a.astype(np.float32)),
        as_other("descriptors", lambda a: a.astype(np.float64)),
        as_other("laplacian", lambda a: 300 * a.astype(np.int64)),
        with_value("uv_right", math.nan),
        with_value("uv_right", (math.nan, 3.0)),
        lambda features: StereoFeatures.empty(features.stamp, 64),
        lambda features: replace(features, stamp=np.float32(features.stamp)),
    ]
    cloud, truth = Cloud(150), path(8 + 2 * len(changes))
    system = StereoSlam(RIG, None, backend, config=CONFIG)
    first = system.process_features(StereoFeatures.empty(-1 / 30, 7))
    assert first.status is FrameStatus.PREDICTED
    for k, T in enumerate(truth):
        features = cloud.features(T, k / 30, 0.3)[0]
        odd = k >= 8 and k % 2 == 0
        result = system.process_features(changes[(k - 8) // 2](features) if odd else features)
        assert result.features.uv_left.dtype == np.float64 and result.features.descriptors.dtype == np.float32
        if k and len(result.features):
            assert result.status is FrameStatus.TRACKED
