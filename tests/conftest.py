"""Fixtures for all tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def slam_data() -> Path:
    """Folder with the real sequences; skips where the environment variable SLAM_DATA is not set."""
    folder = os.environ.get("SLAM_DATA")
    if not folder or not Path(folder).is_dir():
        pytest.skip("real sequences: set SLAM_DATA to the folder that holds them")
    return Path(folder)
