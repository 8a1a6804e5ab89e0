"""What every front end must keep, whoever registered it."""

from __future__ import annotations

import numpy as np
import pytest

import frontends
from slam.data import StereoFrame
from slam.errors import ConfigurationError, SequenceError
from slam.geometry.rig import StereoRig
from slam.interfaces import Frontend
from tests.frontends.scenes import stereo_pair

RIG = StereoRig.rectified_pair(260.0, 160.0, 120.0, 0.12, 320, 240)
LEFT, RIGHT = stereo_pair(12.0)
BLACK = np.zeros_like(LEFT)


@pytest.fixture(params=frontends.names())
def create(request):
    return lambda **options: frontends.create(request.param, RIG, **options)


def test_keeps_the_protocol(create):
    assert isinstance(create(), Frontend)


def test_rows_belong_together(create):
    features = create().extract(StereoFrame(0, 2.5, LEFT, RIGHT))
    n = len(features)
    assert n > 50
    assert features.stamp == 2.5
    assert features.uv_left.shape == features.uv_right.shape == (n, 2)
    assert features.descriptors.shape[0] == n
    assert np.isfinite(features.descriptors).all()
    assert RIG.left.in_image(features.uv_left).all()
    assert RIG.right.in_image(features.uv_right[features.has_stereo]).all()


def test_stereo_rows_triangulate_to_the_wall(create):
    features = create().extract(StereoFrame(0, 0.0, LEFT, RIGHT))
    points = RIG.triangulate(features.uv_left, features.uv_right)[features.has_stereo]
    assert len(points) > 30
    assert np.median(points[:, 2]) == pytest.approx(260 * 0.12 / 12.0, rel=0.02)


def test_same_images_same_bytes(create):
    runs = []
    for _ in range(2):
        frontend = create()
        runs.append([frontend.extract(StereoFrame(k, float(k), LEFT, RIGHT)) for k in range(2)])
    for a, b in zip(*runs):
        assert a.uv_left.tobytes() == b.uv_left.tobytes()
        assert a.uv_right.tobytes() == b.uv_right.tobytes()
        assert a.descriptors.tobytes() == b.descriptors.tobytes()


@pytest.mark.parametrize(("left", "right"), [(BLACK, BLACK), (BLACK, None), (BLACK, RIGHT)])
def test_nothing_to_see_is_no_error(create, left, right):
    features = create().extract(StereoFrame(0, 0.0, left, right))
    assert len(features) == 0
    assert features.descriptors.ndim == 2


def test_a_missing_right_image_leaves_single_features(create):
    features = create().extract(StereoFrame(0, 0.0, LEFT, None))
    assert len(features) > 50
    assert not features.has_stereo.any()


def test_unusable_images_name_the_frame(create):
    with pytest.raises(SequenceError, match="frame 3, left image"):
        create().extract(StereoFrame(3, 0.0, LEFT[:50], RIGHT))


def test_unknown_options_are_named(create):
    with pytest.raises(ConfigurationError, match="no_such_option"):
        create(no_such_option=1)
