from __future__ import annotations

import time

import pytest

from slam.commands import demo
from slam.commands.display import progress
from slam.errors import SlamError
from slam.runtime.compilation import compile_clock


def test_kernels_that_are_compiled_are_counted_within_80_columns(capsys, monkeypatch):
    """A first run was silent for minutes; then it had two bars."""
    monkeypatch.setenv("COLUMNS", "80")
    for shown in (progress(50, "…mera_people · smoother"), progress(None, "kernels")):
        with shown:
            compile_clock.watch(23, 60)
        (line,) = capsys.readouterr().err.splitlines()
        assert "compiling 23/60, once" in line and len(line) <= 80
    assert compile_clock.watch is None
    with progress(50, "quiet", quiet=True):
        compile_clock.watch(23, 60)
    assert capsys.readouterr().err == ""


def test_the_demo_counts_what_is_compiled_before_its_first_frame(monkeypatch, tmp_path):
    """Its row of compile time left out the kernels that two processes compile beforehand: most of them."""

    def compiling(backend):
        compile_clock.change(1)
        time.sleep(0.05)
        compile_clock.change(-1)

    def seen(*arguments, record):
        assert compile_clock.seconds() - record.compiled_before >= 0.05
        raise SlamError("seen")

    monkeypatch.setattr(demo, "compile_kernels", compiling)
    monkeypatch.setattr(demo, "run", seen)
    with pytest.raises(SlamError, match="seen"):
        demo.demo(tmp_path / "out", 10, quiet=True)
