"""Keyframes whose features are in a file are the same keyframes."""

from __future__ import annotations

import copy
import pickle
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from slam.errors import SlamError
from slam.mapping.atlas.feature_file import FeatureFile
from slam.mapping.atlas.keyframes import Keyframe
from tests.slam.mapping.atlas.test_saved import KEYFRAMES


def same(one: Keyframe, other: Keyframe) -> bool:
    return all(np.array_equal(getattr(one, f.name), getattr(other, f.name)) for f in fields(Keyframe))


def test_features_are_the_same_and_in_the_file():
    file = FeatureFile()
    put = [file.put(keyframe) for keyframe in KEYFRAMES]
    for keyframe, kept in zip(KEYFRAMES, put):
        assert same(keyframe, kept)
        assert isinstance(kept.points, np.memmap) and isinstance(kept.descriptors, np.memmap)
        assert kept.points.dtype == keyframe.points.dtype and kept.landmarks.flags.aligned


def test_copies_of_the_keyframes_and_of_the_shelf_go_on_apart():
    file = FeatureFile()
    put = file.put(KEYFRAMES[0])
    for other, kept in (copy.deepcopy((file, put)), pickle.loads(pickle.dumps((file, put)))):
        assert same(kept, KEYFRAMES[0])
        assert same(other.put(KEYFRAMES[1]), KEYFRAMES[1])
    assert same(put, KEYFRAMES[0])


def test_a_disk_that_takes_nothing_is_one_clear_line(monkeypatch: pytest.MonkeyPatch):
    def full(**_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("tempfile.TemporaryFile", full)
    with pytest.raises(SlamError, match=r"^atlas\.on_disk: No space left on device$"):
        FeatureFile().put(KEYFRAMES[0])


def test_many_keyframes_take_few_file_descriptors():
    file, before = FeatureFile(), len(list(Path("/proc/self/fd").iterdir()))
    kept = [file.put(KEYFRAMES[k % len(KEYFRAMES)]) for k in range(300)]
    assert len(list(Path("/proc/self/fd").iterdir())) - before <= 2
    assert all(same(keyframe, KEYFRAMES[k % len(KEYFRAMES)]) for k, keyframe in enumerate(kept))
