"""Small sequences of every format in a temporary folder."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from tests import recordings


@pytest.fixture
def euroc(tmp_path: Path) -> Path:
    return recordings.write_euroc(tmp_path / "V0_01")


@pytest.fixture
def kitti(tmp_path: Path) -> Path:
    return recordings.write_kitti(tmp_path / "dataset")


@pytest.fixture
def raw(tmp_path: Path) -> Path:
    return recordings.write_raw(tmp_path / "2011_09_26")


@pytest.fixture
def two_folders(tmp_path: Path) -> Path:
    return recordings.write_two_folders(tmp_path / "mine")


@pytest.fixture
def build() -> SimpleNamespace:
    """The functions that tests change a sequence with."""
    return SimpleNamespace(
        **vars(recordings), size=(recordings.WIDTH, recordings.HEIGHT), T_body_camera=recordings.BODY_CAMERA
    )
