"""The second process that compiles kernels of moving objects."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib import import_module

import pytest

from slam.commands import background_compilation


@pytest.fixture
def started(monkeypatch):
    """Processes that are started."""
    processes: list[subprocess.Popen] = []

    def start(*arguments, **options):
        processes.append(subprocess_popen(*arguments, **options))
        return processes[-1]

    subprocess_popen = subprocess.Popen
    monkeypatch.setattr(background_compilation.subprocess, "Popen", start)
    return processes


@pytest.mark.parametrize(("cold", "processors", "count"), [(True, 2, 1), (True, 1, 0), (False, 2, 0)])
def test_runs_where_it_is_of_use_and_ends_with_the_block(started, monkeypatch, cold, processors, count):
    monkeypatch.setattr(background_compilation, "_cold", lambda: cold)
    monkeypatch.setattr(background_compilation, "available_cores", lambda: processors)
    with pytest.raises(KeyboardInterrupt), background_compilation.compiled_in_background("ekf"):
        assert len(started) == count
        raise KeyboardInterrupt
    assert all(process.poll() is not None for process in started)


def test_ends_when_its_parent_is_killed():
    """Its standard input ends then."""
    command = [sys.executable, "-P", "-m", background_compilation.__name__, "ekf"]
    modules = {"PYTHONPATH": os.pathsep.join(folder for folder in sys.path if folder)}
    with subprocess.Popen(command, stdin=subprocess.PIPE, env={**os.environ, **modules}) as process:
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(0.1)
        process.stdin.close()
        assert process.wait(20) == 1


def compiled():
    """How often each kernel of moving objects has been compiled or loaded in this process."""
    modules = [import_module(f"slam.objects.{name}_kernels") for name in ("pixel", "scene", "track")]
    kernels = [
        k for m in modules for k in vars(m).values() if hasattr(k, "py_func") and k.py_func.__module__ == m.__name__
    ]
    return {k.py_func.__name__: len(k.signatures) for k in kernels if k.targetoptions.get("nogil")}


@pytest.mark.slow
def test_compiles_all_that_a_run_needs_of_moving_objects():
    import slam

    background_compilation.compile_objects("ekf")
    assert not background_compilation._cold()
    before = compiled()
    assert before["members_ahead"]  # a body was found
    sequence = slam.open_sequence("synthetic:street?frames=8")
    system = slam.StereoSlam(sequence.rig, kind=sequence.kind)
    for frame in sequence:
        system.process(frame)
    more = {name for name, count in compiled().items() if count > before[name]}
    assert more <= {"squares"}  # six lines, which only tracks that have lasted need
