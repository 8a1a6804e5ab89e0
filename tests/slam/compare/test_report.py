from __future__ import annotations

import csv

import pytest

from slam.compare.report import conclusions
from slam.compare.statistics import Verdict
from slam.compare.tables import count_tests, groups, write_tables
from tests.slam.compare.made_up import make, plan


@pytest.fixture(scope="module")
def three(tmp_path_factory):
    """Twelve trials of three back ends, the last one with covariances that do not hold, and a run that failed."""
    out = tmp_path_factory.mktemp("three")
    of = plan(12, ("ekf", "smoother", "batch"))
    runs = make(out, of, "batch", (("smoother", 3),))
    write_tables(of, runs, out)
    return out, of, runs, groups(of, runs)


def test_the_headlines_name_what_is_certainly_worse_beside_what_is_better(three):
    found = conclusions(three[3])[0]
    lines = {(line.text.split(":")[0], line.direction, line.verdict): line.text for line in found.headlines}
    assert "ATE RMSE final" in lines["smoother", "better", Verdict.CERTAIN]
    assert "RPE RMSE over 1 s" in lines["smoother", "worse", Verdict.CERTAIN]
    assert "NEES / 6 over 10 m" in lines["batch", "worse", Verdict.CERTAIN]
    assert "frames tracked 100 → 90.0 %" in lines["batch", "worse", Verdict.CERTAIN]
    assert "1 of 12 of smoother" in found.failed
    assert any("batch: overconfident. NEES / 6 over 10 m of path is 58, expected 1" in line for line in found.honesty)


def test_p_is_adjusted_over_all_groups_of_the_report(three):
    out, _, _, every = three
    with (out / "differences.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["p"] and row["verdict"] != "equal"]
    assert len(rows) == count_tests(every)
    smallest = min(float(row["p"]) for row in rows)
    assert min(float(row["p_holm"]) for row in rows) == pytest.approx(min(1, len(rows) * smallest))
    with (out / "means.csv").open() as file:
        means = [row for row in csv.DictReader(file) if row["figure"] == "ate_final_m"]
    assert all(float(row["low"]) < float(row["mean"]) < float(row["high"]) for row in means)
