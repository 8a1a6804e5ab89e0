"""The second process that compiles kernels of moving objects."""

from __future__ import annotations

import subprocess

import pytest

from slam.commands import compile_beside
from slam.runtime.compile_clock import compile_clock


@pytest.fixture
def started(monkeypatch):
    """Processes that are started."""
    processes: list[subprocess.Popen] = []

    def start(*arguments, **options):
        processes.append(subprocess_popen(*arguments, **options))
        return processes[-1]

    subprocess_popen = subprocess.Popen
    monkeypatch.setattr(compile_beside.subprocess, "Popen", start)
    return processes


@pytest.mark.parametrize(("cold", "processors", "count"), [(True, 2, 1), (True, 1, 0), (False, 2, 0)])
def test_runs_where_it_is_of_use_and_ends_with_the_block(started, monkeypatch, cold, processors, count):
    monkeypatch.setattr(compile_beside, "_cold", lambda: cold)
    monkeypatch.setattr(compile_beside, "_processors", lambda: processors)
    with pytest.raises(KeyboardInterrupt), compile_beside.compiled_beside("ekf"):
        assert len(started) == count
        raise KeyboardInterrupt
    assert all(process.poll() is not None for process in started)


def test_modules_are_those_of_this_process_and_not_of_the_working_folder(started, monkeypatch, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "slam.py").write_text("open('executed', 'w').close()")
    (tmp_path / "besides").mkdir()
    (tmp_path / "besides" / "found_here.py").write_text("open('found', 'w').close()")
    monkeypatch.chdir(tmp_path / "run")
    monkeypatch.setattr(compile_beside, "_cold", lambda: True)
    monkeypatch.setattr(compile_beside, "_processors", lambda: 2)
    monkeypatch.syspath_prepend(tmp_path / "besides")
    monkeypatch.setattr(compile_beside, "__name__", "found_here")
    with compile_beside.compiled_beside("ekf"):
        assert started[0].wait(60) == 0
    monkeypatch.setattr(compile_beside, "__name__", "slam.commands")  # a package without a main module
    with compile_beside.compiled_beside("ekf"):
        started[1].wait(60)
    assert [file.name for file in (tmp_path / "run").iterdir() if file.name != "slam.py"] == ["found"]


@pytest.mark.slow
def test_compiles_all_that_a_run_needs_of_moving_objects(monkeypatch):
    import slam

    compile_beside.compile_objects("ekf")
    assert not compile_beside._cold()
    sequence = slam.open_sequence("synthetic:street?frames=8")
    frontend = slam.StereoSlam(sequence.rig, kind=sequence.kind).frontend
    features = [frontend.extract(frame) for frame in sequence]
    before = compile_clock.seconds()
    system = slam.StereoSlam(sequence.rig, None, "ekf", kind=sequence.kind)
    for seen in features:
        system.process_features(seen)
    assert compile_clock.seconds() == before
