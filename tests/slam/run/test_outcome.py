"""A run in which most frames were not tracked says so, with the first step that gave too little as the likely cause."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer

from slam.commands.run import finish
from slam.config import SystemConfig
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import exp
from slam.models import MotionModel
from slam.outputs import Output
from slam.run.options import RunOptions
from slam.run.outcome import motion_doubt, outcome, scale_doubt
from slam.run.run_record import RunRecord
from tests.slam.numeric import chained

OPTIONS = RunOptions("ekf", "surf", SystemConfig())
RIG = StereoRig.rectified_pair(300.0, 160.0, 120.0, 0.12, 320, 240)


def record(tracked: int, frames: int = 21, features: tuple[int, int] = (200, 150)) -> RunRecord:
    statuses = ["started", *["tracked"] * tracked, *["lost"] * (frames - 1 - tracked)]
    return RunRecord(statuses=statuses, features=[features] * frames)


@pytest.mark.parametrize(
    ("features", "baseline", "more", "words"),
    [
        ((8, 8), 0.12, {}, "the images show hardly anything to follow"),
        ((200, 3), 0.12, {}, "in the median of these frames 3 of 200 features are found in the right image"),
        ((200, 150), 120.0, {}, "the cameras are 120 m apart"),
        ((200, 150), 0.12, {"dropped": 40}, "40 frames were dropped"),
        ((200, 150), 0.12, {"backend": "a:B"}, "the back end a:B (`python -m slam.testing a:B` checks it)"),
        ((200, 0), 0.12, {"prior_map": Path("a")}, "the camera is not where the map was made"),
        ((200, 3), 0.12, {"warnings": ["left and right look swapped", "more"]}, "left and right look swapped"),
    ],
)
def test_the_first_step_that_gave_too_little_is_the_cause(features, baseline, more, words):
    rig = StereoRig.rectified_pair(300.0, 160.0, 120.0, baseline, 320, 240)
    options = replace(OPTIONS, **{name: more.pop(name) for name in ("backend", "prior_map") if name in more})
    said = outcome(record(0, features=features), rig, options, **more)
    assert said.startswith(f"no frame after the first was tracked; likely cause: {words}")


def test_a_few_frames_that_were_not_tracked_are_no_bad_run():
    assert not outcome(record(18), RIG, OPTIONS)
    assert outcome(record(17), RIG, OPTIONS).startswith("3 of 21")
    late = [*["predicted"] * 5, "started", *["tracked"] * 15]
    assert outcome(RunRecord(statuses=late, features=[(8, 8)] * 21), RIG, OPTIONS).startswith("5 of 21")


def moving(times_too_short: float, frames: int = 40) -> RunRecord:
    """A camera in a hand: its velocity changes as the motion model says, its stamps may be wrong."""
    rng = np.random.default_rng(0)
    interval = 0.05
    velocities = np.cumsum(rng.normal(size=(frames, 6)) * np.sqrt(interval), axis=0)
    poses = list(chained(exp(velocities[1:] * interval)))
    stamps = (np.arange(frames) * interval / times_too_short).tolist()
    return RunRecord(stamps=stamps, poses=poses, measured=[True] * frames)


def test_times_that_are_too_short_are_doubted():
    for times_too_short in (1.0, 0.1):  # of times that are too long nothing is torn
        assert motion_doubt(moving(times_too_short), MotionModel()) == ""
    said = motion_doubt(moving(10.0), MotionModel())
    factor = int(said.partition("changes ")[2].split()[0])
    assert factor == pytest.approx(10**1.5, rel=0.3)
    assert "fps=…" in said


def along(step, times=30, **more):
    """A camera that goes on by the same step [m] every tenth of a second."""
    poses = [exp(np.array([0, 0.002 * k, 0, *(k * np.array(step))])) for k in range(times)]
    return RunRecord(stamps=(0.1 * np.arange(times)).tolist(), poses=poses, measured=[True] * times, **more)


@pytest.mark.parametrize(
    ("step", "depth", "driving", "baseline", "words"),
    [
        (3.0, 200.0, False, 0.2, "30 m/s and saw things 200 m away in the median, which no camera in a hand does"),
        (3.0, 20.0, True, 0.2, ""),
        (0.01, 0.2, True, 0.2, "0.1 m/s and saw things 0.2 m away in the median, which no vehicle does"),
        (0.01, 0.2, False, 0.2, ""),
        (30.0, 2000.0, True, 0.2, "by the calibration the cameras are 0.2 m apart; is that in metres?"),
        (0.02, 3.0, False, 12.0, "by the calibration the cameras are 12 m apart"),  # without blaming the motion
    ],
)
def test_a_baseline_in_another_unit_is_known_by_speed_and_distance(step, depth, driving, baseline, words):
    run = along((0, 0, step), depths=[depth] * 30)
    rig = StereoRig.rectified_pair(300.0, 160.0, 120.0, baseline, 320, 240)
    said = scale_doubt(run, rig, driving)
    assert words in said and bool(words) == bool(said)
    assert scale_doubt(replace(run, depths=[np.nan] * 30), rig, driving) == ""


def test_a_vehicle_that_goes_sideways_is_doubted():
    """A truck before a standing car took the camera along."""
    said = motion_doubt(along((0.3, 0, 0.05)), MotionModel(), driving=True)
    assert said.startswith("in 29 frames the camera moved sideways, at 3 m/s in the median, which no vehicle does")
    for step in ((0.05, 0, 1.0), (0.01, 0, 0.0)):
        assert motion_doubt(along(step), MotionModel(), driving=True) == ""
    assert motion_doubt(along((0.3, 0, 0.05)), MotionModel()) == ""


@pytest.mark.parametrize(
    ("closed", "lost", "words"), [([], [], "changes by 20 m/s"), ([], [15, 16], "changes by 6.7 m/s"), ([15], [], "")]
)
def test_a_camera_that_jumps_is_doubted_but_not_where_a_loop_moves_the_path(closed, lost, words):
    run = along((0, 0, 0.4), closed=closed)
    for k in lost:  # until landmarks are believed again
        run.measured[k] = False
    assert motion_doubt(run, MotionModel()) == ""
    for k in range(15, 30):  # as by images that are missing
        run.poses[k] = exp(np.array([0, 0, 0, 0, 0, 2.0])) @ run.poses[k]
    said = motion_doubt(run, MotionModel())
    assert words in said and bool(words) == bool(said)


@pytest.mark.parametrize(("doubt", "status"), [("", 0), ("rows do not agree", 1)])
def test_a_path_that_cannot_be_trusted_does_not_look_like_one_that_can(doubt, status, tmp_path, capsys):
    summary = {"frames": 9, "status": {"tracked": 8}, "tracking": "", "doubt": doubt, "path_length_m": 1.0}
    try:
        finish(summary, [Output(tmp_path, "--out", [])], picture=False, quiet=True)
        code = 0
    except typer.Exit as end:
        code = end.exit_code
    assert code == status
    assert capsys.readouterr().err == f"slam: do not trust this path: {doubt}\n" * bool(doubt)
