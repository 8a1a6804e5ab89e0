"""Items made ahead leave no thread behind."""

from __future__ import annotations

import subprocess
import sys

import pytest


@pytest.mark.parametrize("source", ["prefetch(endless())", "LiveFrames(endless(), paced=False)"])
def test_the_thread_ends_before_the_program_does(source):
    """Where an exception has left the work half done: a thread that runs on while Python is taken down may hang it."""
    program = f"""
import atexit, sys, threading
from types import SimpleNamespace
from slam.runtime.threads import prefetch
from slam.sequences.live import LiveFrames

def endless():
    k = 0
    while True:
        yield SimpleNamespace(index=k, stamp=0.1 * k)
        k += 1

atexit.register(lambda: print([thread.name for thread in threading.enumerate()]))  # is called last
work = iter({source})
next(work)
sys.exit(7)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (7, "['MainThread']\n"), done.stderr
