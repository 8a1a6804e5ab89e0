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


def digests(threads: int = 1, where: str = "main", seed: int = 0, cold: Path | None = None) -> dict:
    """What a new process says."""
    variables = {**os.environ, **dict.fromkeys(VARIABLES, str(threads)), "PYTHONHASHSEED": str(seed)}
    if cold is not None:
        variables["NUMBA_CACHE_DIR"] = str(cold)
    command = [sys.executable, "-m", "tests.slam.digest", str(threads), where]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=variables, timeout=900)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_threads_and_hash_seeds_change_no_byte():
    found = digests()
    assert set(found) == set(BACKENDS)
    assert all(int(each["count"]) > 0 for each in found.values())
    assert len({digest for each in found.values() for digest in each.values() if len(digest) == 64}) == 6
    assert digests(threads=2, where="elsewhere", seed=12345) == found


def test_kernels_just_compiled_and_loaded_give_the_same_bytes(tmp_path):
    """Only as helpers are inlined: else a process that compiled them calls other copies than one that loads them."""
    compiled = digests(cold=tmp_path)
    assert list(tmp_path.rglob("*.nbc"))
    assert digests(cold=tmp_path) == compiled
