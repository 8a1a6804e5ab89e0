from __future__ import annotations

import csv
import os
import re
import subprocess
import sys
from dataclasses import replace
from html import escape

import numpy as np
import pytest
from rich.console import Console

from slam.commands import display
from slam.compare.figures import colours, draw_errors, draw_nees, draw_pairs, pictures
from slam.compare.measure import BY_KEY
from slam.compare.paper import _letters, _table, differences_table, latex, means_table, write_paper
from slam.compare.plan import Plan
from slam.compare.report import conclusions, write_report
from slam.compare.statistics import Verdict
from slam.compare.tables import count_tests, groups, write_tables
from slam.compare.wording import replayed
from slam.run.style import backend_colours
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


@pytest.fixture(scope="module")
def paper(three):
    out, of, runs, _ = three
    write_paper(of, runs, out)
    return out


def test_the_headlines_name_what_is_certainly_worse_beside_what_is_better(three):
    found = conclusions(three[3])[0]
    lines = {(line.text.split(":")[0], line.direction, line.verdict): line.text for line in found.headlines}
    assert "ATE RMSE final" in lines["smoother", "better", Verdict.CERTAIN]
    assert "RPE RMSE over 1 s" in lines["smoother", "worse", Verdict.CERTAIN]
    assert "NEES / 6 over 10 m" in lines["batch", "worse", Verdict.CERTAIN]
    assert "frames tracked 100 → 90.0 %" in lines["batch", "worse", Verdict.CERTAIN]
    assert "1 of 12 of smoother" in found.failed
    assert any("batch: overconfident. NEES / 6 over 10 m of path is 58, expected 1" in line for line in found.honesty)


def test_better_and_worse_have_badges_of_their_own(text):
    assert '<span class="verdict better certain">better: certain</span>' in text
    assert '<span class="verdict worse certain">worse: certain</span>' in text
    better, worse = (re.search(rf"\.{word} {{ --full: (#\w+)", text)[1] for word in ("better", "worse"))
    assert better != worse


def test_the_report_says_the_usual_words(text, three):
    tests = count_tests(three[3])
    assert f"{tests} tests" in text
    for word in ("Holm", "sign-flip permutation test", "BCa", "± SD", "p, Holm", "p ≤ 0.05", "Replay: all back ends"):
        assert word in text
    assert "Closed loop: each back end steers its own data association.</figcaption>" in text
    assert "frames lost" in text
    assert "frames predicted" not in text  # there was none


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


def test_tables_for_latex(paper, three):
    tables = (paper / "tables.tex").read_text()
    assert tables.startswith("% Written by slam compare. Needs: \\usepackage{booktabs,graphicx}\n")
    captions = re.findall(r"\\caption\{(.*)\}\n", tables)
    assert len(captions) == 4
    assert sum("Closed loop: each back end steers" in caption for caption in captions) == 2
    assert sum("Replay: all back ends are given the measurements of ekf's" in caption for caption in captions) == 2
    assert tables.count("\\toprule") == tables.count("\\bottomrule") == 4
    for table in re.findall(r"\\begin\{tabular\}\{(\w+)\}(.*?)\\end\{tabular\}", tables, re.S):
        rows = [line for line in table[1].splitlines() if line.endswith("\\\\")]
        assert {row.count(" & ") for row in rows} == {len(table[0]) - 1}
    assert tables.isascii()
    assert "ATE RMSE, final [mm] & $3.0" in means_table(three[3][0])
    assert "Holm's method over 7 tests" in differences_table(three[3][0], 7)


@pytest.mark.parametrize(("trials", "columns", "kind"), [(1, "lrr", ""), (5, "lrr", "*"), (6, "lrlrl", "*")])
def test_tables_hold_what_so_many_trials_can_say(tmp_path, trials, columns, kind):
    of = plan(trials)
    group = groups(of, make(tmp_path, of))[0]
    means, differences = means_table(group), differences_table(group, 7)
    assert f"\\begin{{tabular}}{{{columns}}}" in means
    assert f"\\begin{{table{kind}}}" in means
    assert means.count("\\begin{table") == means.count("\\end{table") == 1
    assert ("one trial" in means, "standard deviation" in means) == (trials == 1, trials > 1)
    assert ("interval" in means) == (trials > 5)
    assert (differences == "") == (trials == 1)


def test_long_names_of_sequences_go_on_in_the_next_line(tmp_path):
    of = replace(plan(2), sequences=("synthetic:desk?frames=40&width=320",))
    means = means_table(groups(of, make(tmp_path, of))[0])
    assert "synthetic:\\allowbreak{}desk?\\allowbreak{}frames=\\allowbreak{}40\\&\\allowbreak{}width" in means


def test_tables_of_more_than_two_back_ends_have_no_intervals_of_means(paper, three):
    means, differences = means_table(three[3][0]), differences_table(three[3][0], 7)
    assert "\\begin{tabular}{lrrr}" in means
    assert "confidence interval" not in means
    assert "confidence interval" in differences


def test_a_table_is_as_large_as_there_is_room_for(tmp_path):
    """Sizes of letters as LaTeX sets them: a table of 53 letters in three columns is 229 pt wide in footnotesize."""
    made = {n: _table("lrr", ["a" * (n - 2), "b", "c"], [["a", "1", "$2$"]], "", "") for n in (40, 53, 60)}
    found = {
        n: (re.findall(r"begin.(table\*?)", text)[0], re.findall(r"\\(\w+)\n", text)[1]) for n, text in made.items()
    }
    assert found == {40: ("table", "small"), 53: ("table", "footnotesize"), 60: ("table*", "footnotesize")}
    assert all("\\ifdim\\width>\\linewidth" in text for text in made.values())  # in other classes


@pytest.mark.parametrize(
    ("cell", "letters"), [("$100$", 3), ("$0.22$ $\\pm$ $0.01$", 11), ("body\\_1 5 \\%", 10), ("$p_\\mathrm{Holm}$", 7)]
)
def test_letters_of_a_cell_are_those_that_are_seen(cell, letters):
    assert _letters(cell) == letters


def test_replays_say_why_their_covariances_are_smaller(tmp_path):
    of = plan(6)
    runs = [
        replace(run, metrics=run.metrics | {"nees_10m_per_dof": {"replay": 1.5}.get(run.trial.mode, 0.5)})
        for run in make(tmp_path, of)
    ]
    closed_loop, replay = conclusions(groups(of, runs))
    assert not [line for line in closed_loop.honesty if "its closed loop" in line]
    (why,) = (line for line in replay.honesty if "its closed loop" in line)
    assert why.startswith("NEES / 6 of ekf is 1.50, and 0.50 in its closed loop: covariances of a replay are")
    assert (
        "NEES / 6 of ekf is 1.50, and 0.50 in its closed loop" in write_report(of, runs, tmp_path, "here").read_text()
    )


def test_replays_whose_covariances_are_as_large_need_no_reason():
    assert replayed("ekf", {"nees_10m_per_dof": 1.0}, {"nees_10m_per_dof": 1.005}) == ""
    assert replayed("ekf", {"nees_10m_per_dof": float("nan")}, {"nees_10m_per_dof": 1.0}) == ""
    assert "0.22 in its closed loop" in replayed("ekf", {"nees_per_dof": 0.22}, {"nees_per_dof": 0.3})


def test_the_report_says_what_stages_do(text):
    assert re.search(r"<th[^>]*>whole frame</th><th[^>]*>features</th><th[^>]*>update</th>", text)


def test_trials_are_named_by_their_seeds(three):
    group = three[3][0]
    (axis,) = draw_pairs(group, BY_KEY["ate_online_m"]).axes
    assert axis.get_xticks().tolist() == list(range(12))
    assert axis.get_xlabel() == "seed"
    low, high = axis.get_ylim()
    points = [line for line in axis.lines if line.get_label() in group.runs]
    assert [line.get_color() for line in points] == backend_colours(list(group.runs))
    for line, backend in zip(points, group.runs):
        values = line.get_ydata()
        assert np.round(line.get_xdata()).tolist() == list(range(12))
        np.testing.assert_array_equal(values, 1e3 * group.values(backend, "ate_online_m"))
        assert low < np.nanmin(values) <= np.nanmax(values) < high
    assert high - low > 0.1 * high  # equal values are not blown up


def test_of_one_trial_there_is_no_figure_of_trials(tmp_path):
    of = plan(1)
    assert "trials" not in {picture.name for picture in pictures(groups(of, make(tmp_path, of))[0])}


def test_bands_have_the_colour_and_an_outline_of_their_back_end(three):
    from matplotlib.colors import to_hex

    group = three[3][0]
    for axis in draw_errors(group).axes:
        fills = [band for band in axis.collections if band.get_alpha() and band.get_alpha() < 0.2]
        assert [to_hex(band.get_facecolor()[0]) for band in fills] == list(colours(group).values())
        for colour in colours(group).values():
            outline = [line for line in axis.lines if line.get_color() == colour and not line.get_label().isalpha()]
            assert len(outline) == 2


def test_the_band_of_the_nees_says_of_what_it_is(three):
    (axis,) = draw_nees(three[3][0]).axes
    assert "95 % band if consistent, mean of 11 trials" in axis.get_legend_handles_labels()[1]


def test_latex_has_no_character_that_it_reads_otherwise():
    assert latex("a_b & 5 % #1 ~ ^ \\ {x} −3 × ≤") == (
        "a\\_b \\& 5 \\% \\#1 \\textasciitilde{} \\textasciicircum{} \\textbackslash{} \\{x\\} $-$3 $\\times$ $\\leq$"
    )


def test_figures_for_papers(paper):
    figures = (paper / "figures.tex").read_text()
    names = re.findall(r"\\includegraphics\[width=\\linewidth\]\{(.*)\}", figures)
    assert sorted(f"{name}.pdf" for name in names) == sorted(
        path.relative_to(paper).as_posix() for path in (paper / "figures").iterdir()
    )
    assert {name.rsplit("_", 1)[1] for name in names} == {"trials", "paths", "errors", "nees", "time"}
    captions = re.findall(r"\\caption\{(.*)\}\n", figures)
    assert len(captions) == len(names) == 10
    assert all("Closed loop: " in caption or "Replay: " in caption for caption in captions)
    assert figures.isascii()
    for name in names:
        content = (paper / f"{name}.pdf").read_bytes()
        assert content.startswith(b"%PDF")
        assert b"CreationDate" not in content
        assert b"/Type3" not in content  # fonts that many publishers refuse


def test_captions_name_a_recording_by_its_folder(tmp_path):
    """Where it lies on one's disk is nothing for a paper, and it has no seed."""
    of = Plan(("/home/me/data/2011_09_26/drive_0013?kind=driving",), ("ekf", "smoother"), replay=False)
    runs = make(tmp_path, of)
    (caption,) = re.findall(r"\\caption\{(.*)\}\n", means_table(groups(of, runs)[0]))
    assert "drive" in caption and "home" not in caption and "kind" not in caption
    captions = {picture.name: picture.caption for picture in pictures(groups(of, runs)[0])}
    assert captions["paths"] == "Paths from above."
    assert "does not count what is not known of the recorded truth" in captions["errors"]


WRITE = """
import sys
from pathlib import Path
from tests.slam.compare.test_report import write_small
write_small(Path(sys.argv[1]))
"""


def write_small(out):
    """Tables and figures of two trials in closed loop; their bytes by name."""
    out.mkdir()
    of = replace(plan(2), replay=False)
    write_paper(of, make(out, of), out)
    files = [out / "tables.tex", out / "figures.tex", *sorted((out / "figures").iterdir())]
    return {path.name: path.read_bytes() for path in files}


@pytest.mark.slow
def test_tables_and_figures_have_the_same_bytes_in_any_process(tmp_path):
    here = write_small(tmp_path / "here")
    environment = {**os.environ, "PYTHONHASHSEED": "7"}
    there = tmp_path / "there"
    subprocess.run([sys.executable, "-c", WRITE, str(there)], check=True, env=environment, timeout=120)
    files = [there / "tables.tex", there / "figures.tex", *sorted((there / "figures").iterdir())]
    assert {path.name: path.read_bytes() for path in files} == here


def test_one_trial_and_nothing_that_completed(tmp_path):
    of = plan(1)
    runs = make(tmp_path, of, failed=(("ekf", 0), ("smoother", 0)))
    write_tables(of, runs, tmp_path)
    write_paper(of, runs, tmp_path)
    text = write_report(of, runs, tmp_path, "here").read_text()
    assert "4 of 4 runs failed" in text
    assert not list((tmp_path / "figures").iterdir())


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


def test_frames_of_all_runs_are_counted_once():
    bar = display.SweepProgress([10, 10, 10], quiet=True)
    task = bar._bar.tasks[0]
    bar.kept(10)
    bar.frames(4)
    assert (task.completed, task.fields["runs"]) == (14, "1/3")
    bar.frames(9)
    bar.ended(10)  # the last look was before its last frame
    assert (task.completed, task.fields["runs"]) == (20, "2/3")
    bar.frames(3)  # the next call of the scheduler
    assert task.completed == 22
    bar.frames(30)  # a worker died, and its frames were done twice
    assert task.completed == 30


def test_the_rate_of_a_comparison_that_goes_on_is_that_of_its_own_frames(monkeypatch):
    clock = iter([100.0, 101.0, 102.0])
    monkeypatch.setattr(display.time, "monotonic", lambda: next(clock))
    bar = display.SweepProgress([1000, 1000], quiet=True)
    bar.kept(1000)
    fields = bar._bar.tasks[0].fields
    assert (fields["rate"], fields["left"]) == ("", "")
    bar.frames(40)
    assert (fields["rate"], fields["left"]) == ("40.0 Hz", "0:00:24")
