"""The same bytes with any number of threads, in any thread, with any hash seed, with kernels compiled or loaded."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.slam.digest import BACKENDS

ROOT = Path(__file__).parents[2]
VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")

pytestmark = pytest.mark.slow


def digests(compiled: Path, threads: int, where: str, seed: int) -> dict:
    """What a new process says that keeps compiled kernels in a folder."""
    variables = {**os.environ, **dict.fromkeys(VARIABLES, str(threads))}
    variables |= {"PYTHONHASHSEED": str(seed), "NUMBA_CACHE_DIR": str(compiled)}
    command = [sys.executable, "-m", "tests.slam.digest", str(threads), where]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=variables, timeout=900)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_threads_hash_seeds_and_whether_kernels_are_compiled_or_loaded_change_no_byte(tmp_path):
    """The last as helpers are inlined: else one that compiled them calls other copies than one that loads them."""
    found = digests(tmp_path, 1, "main", 0)
    assert list(tmp_path.rglob("*.nbc"))
    assert set(found) == set(BACKENDS)
    assert all(int(each["count"]) > 0 for each in found.values())
    assert len({digest for each in found.values() for digest in each.values() if len(digest) == 64}) == 6
    assert digests(tmp_path, 2, "elsewhere", 12345) == found
