"""A finished comparison that nobody ran: figures as a test wants them, and the files that reports and tables read."""

from __future__ import annotations

import json
import shutil
import tempfile
from functools import cache
from pathlib import Path

import numpy as np

from slam.compare.collect import SERIES_COLUMNS
from slam.compare.plan import Plan, Trial, Variant
from slam.compare.simulated import SimulatedFrontend, WithoutImages
from slam.compare.sweep import RUNS, SWEEP, Run
from slam.compare.trial import COMPLETED, SERIES
from slam.config import SystemConfig
from slam.run.options import RunOptions
from slam.run.runner import run
from slam.sequences import open_sequence

WORLD = "synthetic:aisle?frames=12"


def plan(trials: int, backends: tuple[str, ...] = ("ekf", "smoother")) -> Plan:
    """Of one short world, closed loop and replay."""
    return Plan((WORLD,), backends, (Variant("simulated", "simulated"),), trials)


def metrics(trial: Trial, worst: str | None = None) -> dict[str, float]:
    """All but the first back end: a better ATE and a worse RPE; the last of three has NEES of thousands."""
    rng = np.random.default_rng([trial.seed, len(trial.backend), len(trial.mode)])
    other = trial.backend != "ekf"
    noise = 1 + 0.01 * rng.standard_normal(5)
    return {
        "ate_online_m": 0.003 * noise[0],
        "ate_final_m": (0.002 if other else 0.003) * noise[1],
        "rpe_1s_m": (0.006 if other else 0.005) * noise[2],
        "nees_per_dof": (580.0 if trial.backend == worst else 1.1) * noise[3],
        "nees_10m_per_dof": (58.0 if trial.backend == worst else 1.0) * noise[4],
        "tracked": 0.9 if trial.backend == worst else 1.0,
        "frames_lost": 0.1 if trial.backend == worst else 0.0,
        "frames_predicted": 0.0,
        "map_size": 100.0 + trial.seed,
    }


def make(out: Path, of: Plan, worst: str | None = None, failed: tuple[tuple[str, int], ...] = ()) -> list[Run]:
    """The runs of a plan and their files below `out`; `failed` are some by back end and seed."""
    (out / SWEEP).write_text(json.dumps({"versions": {"numpy": "9.9"}}))
    truth = open_sequence(f"{WORLD}&seed=0").ground_truth
    return [_run(out, trial, truth, worst, failed) for mode in of.modes for trial in of.trials_of(mode)]


def _run(out, trial, truth, worst, failed):
    folder = out / RUNS / trial.folder
    if (trial.backend, trial.seed) in failed:
        return Run(trial, "failed: EstimatorError: no way", {}, {}, folder)
    shutil.copytree(_files(), folder)
    rng = np.random.default_rng([trial.seed, len(trial.backend)])
    series = np.ones((len(truth), len(SERIES_COLUMNS)))
    series[:, 0], series[:, 1] = np.arange(len(truth)), truth.stamps
    series[:, 2:5], series[:, 5:8] = 0.002 * rng.standard_normal((len(truth), 3)), 0.002
    series[:, 9] = rng.chisquare(6, len(truth))
    series[0, 9] = np.nan
    np.savetxt(folder / SERIES, series, "%.9g", ",", header=",".join(SERIES_COLUMNS), comments="")
    return Run(trial, COMPLETED, metrics(trial, worst), {"extract": 2.0, "update": 5.0, "total": 7.0}, folder)


@cache
def _files() -> Path:
    """The folder of a short run, the same for all."""
    world, folder = open_sequence(f"{WORLD}&seed=0"), Path(tempfile.mkdtemp(prefix="made_up_"))
    options = RunOptions("ekf", "simulated", SystemConfig(), folder)
    run(WithoutImages(world), options, frontend=SimulatedFrontend(world))
    return folder
