"""The same bytes with any number of threads, in any thread, with any hash seed, with kernels compiled or loaded."""

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


def digests(*words: object, **variables: str) -> dict:
    """What a new process says."""
    command = [sys.executable, "-m", "tests.slam.digest", *map(str, words)]
    environment = {**os.environ, **variables}
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=environment, timeout=900)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_threads_and_hash_seeds_change_no_byte():
    one, two = ({**dict.fromkeys(VARIABLES, str(n)), "PYTHONHASHSEED": str(12345 * n)} for n in (1, 2))
    found = digests(1, "main", **one)
    assert set(found) == set(BACKENDS)
    assert all(int(each["count"]) > 0 for each in found.values())
    assert len({digest for each in found.values() for digest in each.values() if len(digest) == 64}) == 6
    assert digests(2, "elsewhere", **two) == found


def test_whether_kernels_are_compiled_or_loaded_changes_no_byte(tmp_path):
    """As helpers are inlined: else a process that compiled them calls other copies than one that loads them."""
    compiled = digests("parts", NUMBA_CACHE_DIR=str(tmp_path))
    assert list(tmp_path.rglob("*.nbc"))
    assert digests("parts", NUMBA_CACHE_DIR=str(tmp_path)) == compiled
