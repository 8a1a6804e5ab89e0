from __future__ import annotations

import csv
from html import escape

import pytest
from rich.console import Console

from slam.commands import display
from slam.compare.report import conclusions, write_report
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


@pytest.fixture(scope="module")
def text(three):
    out, of, runs, _ = three
    return write_report(of, runs, out, "here").read_text()


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


def test_one_trial_and_nothing_that_completed(tmp_path):
    of = plan(1)
    runs = make(tmp_path, of, failed=(("ekf", 0), ("smoother", 0)))
    write_tables(of, runs, tmp_path)
    text = write_report(of, runs, tmp_path, "here").read_text()
    assert "4 of 4 runs failed" in text


def test_one_trial_says_that_it_proves_nothing(tmp_path):
    of = plan(1)
    runs = make(tmp_path, of)
    every = groups(of, runs)
    found = conclusions(every)[0]
    assert {line.verdict for line in found.headlines} <= {Verdict.SINGLE, Verdict.OPEN, Verdict.EQUAL}
    assert {line.badge for line in found.headlines} <= {"better: one trial", "worse: one trial", "open", "equal"}
    assert count_tests(every) > 0  # as many as more trials would have
    text = write_report(of, runs, tmp_path, "here").read_text()
    assert "One trial cannot tell a difference from chance" in text


def test_the_terminal_says_the_same_as_the_report(three, text, capsys, monkeypatch):
    monkeypatch.setattr(display, "_console", Console(width=2000))
    found = conclusions(three[3])
    display.print_conclusions(found, "few trials", "ekf")
    said = capsys.readouterr().out
    for line in found[0].headlines:
        assert line.badge in said
        assert line.text in said
        assert f">{line.badge}</span><span>{escape(line.text)}</span>" in text
    assert "Better or worse than ekf: certain (Holm-adjusted p ≤ 0.05)" in said
    assert "few trials" in said
