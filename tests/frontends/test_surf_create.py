"""SURF made as OpenCV's is: arguments, defaults, getters and setters."""

from __future__ import annotations

import inspect

import numpy as np
import pytest

import frontends.surf
from slam.errors import ConfigurationError


def image() -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.kron(rng.integers(0, 255, (20, 30)), np.ones((12, 12))).astype(np.uint8)


def test_the_arguments_and_defaults_are_opencv_s() -> None:
    parameters = inspect.signature(frontends.surf.create).parameters
    expected = {"hessianThreshold": 100.0, "nOctaves": 4, "nOctaveLayers": 3, "extended": False, "upright": False}
    assert {name: p.default for name, p in parameters.items()} == expected
    surf = frontends.surf.create(400, 3, 2, False, True)
    got = surf.getHessianThreshold(), surf.getNOctaves(), surf.getNOctaveLayers(), surf.getExtended(), surf.getUpright()
    assert got == (400.0, 3, 2, False, True)
    assert isinstance(surf, frontends.surf.Surf) and surf.descriptorSize() == 64


def test_setters_change_what_is_found() -> None:
    surf = frontends.surf.create()
    many = len(surf.detect(image()))
    surf.setHessianThreshold(5000)
    surf.setNOctaves(2)
    surf.setNOctaveLayers(2)
    surf.setUpright(True)
    keypoints, descriptors = surf.detectAndCompute(image())
    other, same = frontends.surf.Surf(5000, 2, 2).detectAndCompute(image())
    assert 0 < len(keypoints) < many
    assert len(other) == len(keypoints) and np.array_equal(descriptors, same)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("HessianThreshold", -1, "threshold: must be"),
        ("NOctaves", 5, "octaves: must be 1 to 4"),
        ("NOctaveLayers", 4, "layers: must be 2 or 3"),
        ("Extended", True, "no descriptors of 128 numbers"),
    ],
)
def test_what_this_surf_does_not_have_is_refused(name: str, value: float, words: str) -> None:
    surf = frontends.surf.create()
    with pytest.raises(ConfigurationError, match=words):
        getattr(surf, f"set{name}")(value)
    assert getattr(surf, f"get{name}")() == getattr(frontends.surf.create(), f"get{name}")()
