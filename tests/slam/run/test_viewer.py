from __future__ import annotations

import pytest

from slam.config import SystemConfig
from slam.run.options import RunOptions
from slam.run.runner import run
from slam.run.viewer import Viewer, view_run
from slam.sequences import open_sequence


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # Rerun's own
def test_a_run_is_kept_for_rerun(tmp_path):
    pytest.importorskip("rerun")
    sequence = open_sequence("synthetic:aisle?frames=3")
    live, after = tmp_path / "live.rrd", tmp_path / "after.rrd"
    options = RunOptions("ekf", "surf", SystemConfig.for_kind("handheld"), tmp_path / "run")
    with Viewer(str(live), sequence.rig, sequence.ground_truth) as viewer:
        run(sequence, options, watches=[viewer.show])
    view_run(tmp_path / "run", str(after))
    assert after.stat().st_size > 1000
    assert live.stat().st_size > 3 * 3000  # three images, compressed, are in it
