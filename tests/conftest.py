"""Fixtures for all tests."""

import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# Before NumPy is loaded: its threads would wait in turn for the cores on which the tests run side by side.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# OpenCV reads this once, at the first video of a process, which a test may write before the program reads one.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

# The same examples in every run, and no limit on the time of one: the first compiles the kernels that it needs.
settings.register_profile("repeatable", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("repeatable")


#: What takes minutes comes first: at the end one process would wait for the other.
LONGEST = ("test_real_sequences.py", "test_docs_commands.py", "test_same_bytes.py")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the longest tests first; the others stay in their order."""
    items.sort(key=lambda item: item.path.name not in LONGEST)


@pytest.fixture(scope="session")
def slam_data() -> Path:
    """Folder with the real sequences; skips where the environment variable SLAM_DATA is not set."""
    folder = os.environ.get("SLAM_DATA")
    if not folder or not Path(folder).is_dir():
        pytest.skip("real sequences: set SLAM_DATA to the folder that holds them")
    return Path(folder)
