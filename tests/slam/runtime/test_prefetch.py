"""Items made ahead: the same ones in the same order, exceptions in their place, no thread left behind."""

import subprocess
import sys
import threading

import pytest

from slam.runtime.threads import prefetch


def threads() -> set[threading.Thread]:
    return {thread for thread in threading.enumerate() if thread.name.startswith("prefetch")}


def test_items_are_made_while_the_one_before_is_used_and_no_more_than_asked_for():
    before, made, third = threads(), [], threading.Event()

    def items():
        for k in range(50):
            made.append(k)
            if k == 2:
                third.set()
            yield k

    work = prefetch(items(), depth=2)
    assert next(work) == 0 and third.wait(10) and len(made) <= 5
    work.close()
    assert threads() <= before


def test_an_exception_comes_where_its_item_would():
    before = threads()
    work = prefetch(1 // k for k in (1, 0))
    assert next(work) == 1
    with pytest.raises(ZeroDivisionError):
        next(work)
    assert threads() <= before


@pytest.mark.parametrize("source", ["prefetch(endless())", "LiveFrames(endless(), paced=False)"])
def test_the_thread_ends_before_the_program_does(source):
    """Where an exception has left the work half done: a thread that runs on while Python is taken down may hang it."""
    program = f"""
import atexit, sys, threading
from types import SimpleNamespace
from slam.runtime.threads import free_cores, prefetch
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
