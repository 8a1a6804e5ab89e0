"""Times of the stages of a step."""

from __future__ import annotations

import pytest

from slam.runtime import compilation


def test_a_stage_that_is_entered_again_adds_its_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """A step whose past is revised predicts twice, and one that begins anew does all stages twice."""
    clock = iter([0.0, 0.05, 1.0, 1.02])
    monkeypatch.setattr(compilation, "working_time", lambda: next(clock))
    stages = compilation.Stages()
    for _ in range(2):
        with stages.stage("predict"):
            pass
    assert stages.milliseconds["predict"] == pytest.approx(70.0)
