"""Small sequences of every format in a temporary folder."""

from collections.abc import Callable
from pathlib import Path

import pytest

from tests import recordings


def _written(name: str, folder: str) -> Callable[[Path], Path]:
    """A fixture: a sequence that `recordings` writes."""
    return pytest.fixture(name=name)(lambda tmp_path: getattr(recordings, f"write_{name}")(tmp_path / folder))


euroc, kitti = _written("euroc", "V0_01"), _written("kitti", "dataset")
raw, two_folders = _written("raw", "2011_09_26"), _written("two_folders", "mine")
