"""What closing loops gives on long drives that come back: the path's error with and without, and how sure it is.

    SLAM_DATA=/path/to/data python experiments/loops.py [--quick] [--paths 00 05 …] [--backend NAME ...]
        [--set KEY=VALUE …] [--out DIR]

Features of streets along true roads (``kitti_paths`` of the data folder), or of the built-in town where there is no
such folder. The system is told a focal length that is 0.5 % too long, so that the path drifts. Prints a Markdown table
and draws the paths. A loop is false where its two frames are farther apart than it may see (``_FAR``), or its pose is
wrong by more than a tenth of that.
"""

from __future__ import annotations

import argparse
import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from experiments.common import script_options
from experiments.tables import markdown, picture, write_json
from slam.atlas.atlas import Atlas
from slam.config import SystemConfig
from slam.data import FrameResult
from slam.evaluation.metrics import absolute_errors
from slam.geometry.se3 import inverse, log
from slam.geometry.trajectory import Trajectory
from slam.registry import ONLINE
from slam.sequences import open_sequence
from slam.system import StereoSlam

QUICK = ("map.target_in_view=40", "map.max_landmarks=100", "objects.mode=off")  # settings of quick runs
ROW_TEXTS = 2
ACCURACY = (
    "frames", "loops", "false", "refused", "ATE without [m]", "online [m]", "final [m]",
)  # fmt: skip
TRUST = (
    "error at the last loop [m]", "its 3σ [m]", "NEES before loops", "NEES after the last",
    "longest frame with a loop [ms]",
)  # fmt: skip
HEADER = ("path", "back end", *ACCURACY, *TRUST)

_FAR = 40.0  # from which a place can be seen again, at most [m]


@dataclass
class Drive:
    """One drive with one back end."""

    results: list[FrameResult]  # of the frames, without their features
    atlas: Atlas  # at the end
    final: Trajectory  # the path as estimated at the end
    truth: np.ndarray  # in the axes of its first pose (F, 4, 4)

    @property
    def online(self) -> np.ndarray:
        """Poses (F, 4, 4) as they were reported."""
        return np.array([r.estimate.T_world_left for r in self.results])

    @property
    def odometry(self) -> np.ndarray:
        """Poses (F, 4, 4) as the back end had them, which knows of no loop."""
        return np.array([inverse(r.T_map_odom) @ r.estimate.T_world_left for r in self.results])


def drive(name: str, backend: str, settings: list[str]) -> Drive:
    """Drive along a world's path, from its features."""
    sequence = open_sequence(name)
    config = SystemConfig.for_kind("driving", None).with_settings(settings)
    system = StereoSlam(sequence.rig, None, backend, config=config)
    results = [_light(system.process_features(sequence.observations(k))) for k in range(len(sequence))]
    assert sequence.ground_truth is not None
    truth = sequence.ground_truth.poses
    return Drive(results, system.atlas, system.trajectory(), inverse(truth[0]) @ truth)


def _light(result: FrameResult) -> FrameResult:
    """A result without what takes memory."""
    none = result.features.empty(result.features.stamp, 16)
    return replace(result, features=none, matched=result.matched[:0], matched_features=result.matched_features[:0])


def ate(poses: np.ndarray, truth: np.ndarray) -> float:
    """Root mean square error of the positions after alignment [m]."""
    stamps = np.arange(len(poses))
    return absolute_errors(Trajectory(stamps, poses), Trajectory(stamps, truth)).rmse


def false_loops(run: Drive) -> int:
    """Loops between places that are not the same, or with a pose that is far off."""
    count = 0
    for loop in run.atlas.loops:
        a, b = (run.atlas.keyframes[k].frame for k in (loop.first, loop.second))
        true = inverse(run.truth[a]) @ run.truth[b]
        error = log(inverse(true) @ loop.T_first_second)
        count += bool(np.linalg.norm(true[:3, 3]) > _FAR or np.linalg.norm(error[3:]) > 0.1 * _FAR)
    return count


def nees(run: Drive, first: int, stop: int) -> float:
    """Mean NEES of the online poses of some frames, from the start of the path; 6 is right."""
    estimates = [r.estimate for r in run.results[first:stop]]
    errors = [log(inverse(e.T_world_left) @ T) for e, T in zip(estimates, run.truth[first:stop])]
    values = [x @ np.linalg.solve(e.covariance, x) for x, e in zip(errors, estimates)]
    return float(np.mean(values)) if values else float("nan")


def row(name: str, backend: str, run: Drive) -> list[str]:
    """One row of the table."""
    closed = [r.index for r in run.results if r.loop is not None]
    last = closed[-1] if closed else len(run.results) - 1
    e = run.results[last].estimate
    error = log(inverse(e.T_world_left) @ run.truth[last])
    first = closed[0] if closed else len(run.results)
    sigma = 3 * np.sqrt(np.trace(e.covariance[3:, 3:]))
    without, final = run.odometry, run.final.poses
    figures = [ate(poses, run.truth) for poses in (without, run.online, final)]
    times = np.array([sum(r.milliseconds.values()) for r in run.results])
    slowest = times[closed].max(initial=0.0) if closed else float("nan")
    s = run.atlas.summary()
    return [
        name, backend, str(len(run.results)), str(s["closed"]), str(false_loops(run)), str(s["refused"]),
        *(f"{x:.2f}" for x in (*figures, np.linalg.norm(error[3:]), sigma)), f"{nees(run, 1, first):.1f}",
        f"{nees(run, last, len(run.results)):.1f}", f"{slowest:.0f}",
    ]  # fmt: skip


def tables(rows: list[list[str]]) -> str:
    """Two tables: how good the paths are; how far that is known, and what it costs."""
    middle = ROW_TEXTS + len(ACCURACY)
    accuracy = markdown(HEADER[:middle], [line[:middle] for line in rows], texts=ROW_TEXTS)
    trust = [[*line[:ROW_TEXTS], *line[middle:]] for line in rows]
    cost = markdown((*HEADER[:ROW_TEXTS], *TRUST), trust, texts=ROW_TEXTS)
    return f"{accuracy}\n\nLoops cannot show the scale: a path that is too long everywhere closes as well.\n\n{cost}"


def worlds(given: argparse.Namespace) -> dict[str, str]:
    """Names of the drives, and the sequences."""
    if given.quick:
        return {"town": "synthetic:town?descriptor=16&focal_error=0.005&speed=2&frames=395"}
    folder = Path(os.environ.get("SLAM_DATA", "")) / "kitti_paths"
    found = {
        n: folder / f"{n}.txt" for n in given.paths if "SLAM_DATA" in os.environ and (folder / f"{n}.txt").exists()
    }
    options = "descriptor=16&focal_error=0.005"
    return {n: f"synthetic:drive?path={f}&{options}" for n, f in found.items()} or {"town": f"synthetic:town?{options}"}


def draw(runs: dict[tuple[str, str], Drive], out: Path) -> None:
    """The paths from above: true, without loops, and as estimated at the end; loops as circles."""
    rows = len({backend for _, backend in runs})  # the runs are in order of their paths
    shape = (rows, len(runs) // rows)
    with picture(out / "loops.png", 2.6 * shape[1], 2.9 * shape[0], *shape) as panels:
        axes = np.reshape(panels, shape)
        for axis, ((name, backend), run) in zip(axes.T.flat, runs.items()):
            for poses, style, label in (
                (run.truth, "k--", "true"), (run.odometry, "C1-", "without loops"),
                (run.final.poses, "C0-", "with loops"),
            ):  # fmt: skip
                axis.plot(*poses[:, [0, 2], 3].T, style, lw=1.2, label=label)
            at = [run.atlas.keyframes[loop.second].frame for loop in run.atlas.loops]
            axis.plot(*run.final.positions[at][:, [0, 2]].T, "o", mfc="none", mec="C2", ms=4, label="loops closed")
            axis.set(title=f"{name}, {backend}", aspect="equal", adjustable="datalim")
            axis.set(xlabel="right [m]", ylabel="forward [m]")
            axis.locator_params(nbins=4)
        labels = axes[0, 0].get_legend_handles_labels()
        axes[0, 0].figure.legend(*labels, loc="outside upper center", ncols=4, fontsize=8)


def main() -> None:
    parser = script_options(__file__, __doc__)
    parser.add_argument("--paths", nargs="*", default=["06"])
    parser.add_argument("--backend", nargs="*", default=list(ONLINE))
    parser.add_argument("--set", nargs="*", default=[])
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    quick = list(QUICK) if given.quick else []
    runs = {
        (name, backend): drive(sequence, backend, [*quick, *given.set])
        for name, sequence in worlds(given).items()
        for backend in (given.backend[:1] if given.quick else given.backend)
    }
    rows = [row(name, backend, run) for (name, backend), run in runs.items()]
    print("Features of streets along true roads; the focal length that the system is told is 0.5 % too long.\n")
    print(tables(rows))
    write_json(given.out / "loops.json", HEADER, rows)
    draw(runs, given.out)


if __name__ == "__main__":
    main()
