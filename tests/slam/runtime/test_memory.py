"""Memory that was freed stays with the process."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

#: Page faults while eight arrays of 1 MB are made and freed 20 times; each is 256 pages of 4 kB.
SCRIPT = """
import resource, sys
import numpy as np
from slam.runtime.memory import keep_freed_memory
print(len(sys.argv) > 1 and keep_freed_memory())
def step():
    arrays = [np.ones(2**17) for _ in range(8)]
step()
step()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    step()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def run(*arguments: str, **variables: str) -> tuple[str, int]:
    """What the script prints; memory is kept where it is called with an argument."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("MALLOC_", "GLIBC_"))}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, *arguments], env={**environment, **variables}, capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    kept, faults = done.stdout.split()
    return kept, int(faults)


@pytest.mark.skipif(sys.platform != "linux", reason="glibc only")
def test_freed_pages_are_used_again():
    kept, faults = run("kept")
    if kept == "False":
        pytest.skip("another C library than glibc")
    assert faults < 0.1 * run()[1]
