"""The second process that compiles kernels while this one compiles others."""

from __future__ import annotations

import subprocess

import pytest

from slam.run import warm_up
from slam.sequences import open_sequence


@pytest.mark.parametrize(("cold", "cores", "count"), [(True, 2, 1), (True, 1, 0), (False, 2, 0)])
def test_it_runs_where_it_is_of_use_and_ends_with_an_interrupt(monkeypatch, tmp_path, cold, cores, count):
    def interrupted(*_):
        raise KeyboardInterrupt

    started, popen = [], subprocess.Popen
    monkeypatch.setattr(subprocess, "Popen", lambda *a, **b: started.append(popen(*a, **b)) or started[-1])
    monkeypatch.setattr(warm_up, "available_cores", lambda: cores)
    monkeypatch.setattr(warm_up.Path, "glob", lambda *_: iter(() if cold else [tmp_path]))
    monkeypatch.setattr(warm_up, "create", interrupted)
    if count:
        with pytest.raises(KeyboardInterrupt):
            warm_up.compile_kernels("ekf")
    else:
        warm_up.compile_kernels("ekf")
    assert len(started) == count and all(process.poll() is not None for process in started)


@pytest.mark.parametrize(("frontend", "opened"), [("surf", 1), ("simulated", 0)])
def test_surf_s_kernels_are_compiled_for_surf_alone(monkeypatch, frontend, opened):
    class Ended(subprocess.Popen):
        def __init__(self, *_, **__):
            self.pid, self.returncode = 0, 0

        def poll(self):
            return 0

        kill = wait = __del__ = poll

    scenes = []
    monkeypatch.setattr(subprocess, "Popen", Ended)
    monkeypatch.setattr(warm_up, "available_cores", lambda: 2)
    monkeypatch.setattr(warm_up.Path, "glob", lambda *_: iter(()))
    monkeypatch.setattr(warm_up, "open_sequence", lambda name: scenes.append(name) or open_sequence(name))
    warm_up.compile_kernels("ekf", frontend)
    assert len(scenes) == opened
