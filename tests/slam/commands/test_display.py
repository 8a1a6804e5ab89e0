from __future__ import annotations

from slam.commands.display import progress
from slam.runtime.compilation import compile_clock


def test_kernels_that_are_compiled_are_counted_within_80_columns(capsys, monkeypatch):
    """A first run was silent for minutes."""
    monkeypatch.setenv("COLUMNS", "80")
    for shown in (progress(50, "…mera_people · smoother"), progress(None, "")):
        with shown:
            compile_clock.watch(23, 60)
        lines = capsys.readouterr().err.splitlines()
        assert any("compiling" in line and "23/60" in line for line in lines)
        assert max(map(len, lines)) <= 80
    assert compile_clock.watch is None
    with progress(50, "quiet", quiet=True):
        compile_clock.watch(23, 60)
    assert capsys.readouterr().err == ""
