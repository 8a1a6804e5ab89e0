"""Small sequences of every format in a temporary folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests import recordings


def _written(name: str, folder: str) -> Callable[[Path], Path]:
    """A fixture: a sequence that `recordings` writes."""
    return pytest.fixture(name=name)(lambda tmp_path: getattr(recordings, f"write_{name}")(tmp_path / folder))


euroc, kitti = _written("euroc", "V0_01"), _written("kitti", "dataset")
raw, two_folders = _written("raw", "2011_09_26"), _written("two_folders", "mine")


@pytest.fixture
def build() -> SimpleNamespace:
    """The functions that tests change a sequence with."""
    return SimpleNamespace(
        **vars(recordings), size=(recordings.WIDTH, recordings.HEIGHT), T_body_camera=recordings.BODY_CAMERA
    )
