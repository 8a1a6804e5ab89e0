from __future__ import annotations

import pytest


@pytest.mark.slow
def test_the_command_leaves_report_and_tables_and_says_what_follows(slam_command, tmp_path):
    done = slam_command(
        "compare", "synthetic:aisle?frames=6", "--backends", "ekf,smoother", "--frontends", "simulated", "--no-replay",
        "--workers", 1, "--quick", "--out", tmp_path / "out",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("4 runs, 24 frames in all, 1 at a time on this machine: about ")
    assert "ATE RMSE" in done.stdout
    assert "With 2 trials nothing can be certain" in done.stdout
    assert "4 runs, 0 failed" in done.stdout
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {
        "report.html", "runs.csv", "means.csv", "differences.csv", "timings.csv", "sweep.json", "runs",
    }  # fmt: skip
