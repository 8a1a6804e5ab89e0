from __future__ import annotations

from slam.commands.display import progress
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
