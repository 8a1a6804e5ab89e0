"""The second process that compiles kernels while this one compiles others."""

from __future__ import annotations

import subprocess

import pytest

from slam.run import warm_up


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
