"""Parts of the experiment on loops: houses that look alike, the bounded smoother, the cost of a loop, images.

    python experiments/loops_parts.py alike --seeds 10
    python experiments/loops_parts.py bounded
    python experiments/loops_parts.py cost --keyframes 5000
    python experiments/loops_parts.py rendered --folder town      # some ten minutes on a core that does nothing else

`rendered` leaves the images in the folder, in EuRoC's layout, for other programs. Each prints a Markdown table.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from experiments.common import timed
from experiments.loops import QUICK, ate, drive, false_loops, nees, row, tables
from experiments.tables import markdown
from slam.config import SystemConfig
from slam.geometry.se3 import exp, inverse
from slam.mapping.atlas.chain import Chain
from slam.mapping.atlas.keyframes import Loop
from slam.mapping.atlas.pose_graph import PoseGraph, solve
from slam.registry import ONLINE
from slam.runtime.blas import one_blas_thread
from slam.sequences import open_sequence
from slam.system import StereoSlam
from slam.worlds.export import write_euroc

TOWN = "synthetic:town?descriptor=16&focal_error=0.005&speed=2&frames=420"
SHORT = {
    "desk": "synthetic:desk?frames=200",
    "aisle": "synthetic:aisle?frames=200",
    "street": "synthetic:street?frames=100",
}
_COMMON = 23  # errors that all poses share: those of the rig
_AROUND = 500  # keyframes of a lap
_EVERY = 40  # keyframes from one loop to the next


def alike(seeds: int) -> str:
    """Drives in towns where half of the streets' stretches look like another one: is any loop false?"""
    rows = []
    for seed in range(seeds):
        run = drive(f"{TOWN}&alike=0.5&seed={seed}&layout={seed}", "ekf", list(QUICK))
        s = run.atlas.summary()
        errors = [ate(poses, run.truth) for poses in (run.odometry, run.final.poses)]
        at = [r.index for r in run.results if r.loop is not None]
        errors.append(nees(run, at[-1], len(run.results)) if at else float("nan"))
        rows.append([seed, s["keyframes"], s["closed"], false_loops(run), s["refused"], *errors])
    columns = list(zip(*rows))
    total = ["all", *map(sum, columns[1:5]), *(float(np.mean(column)) for column in columns[5:])]
    header = ("seed", "keyframes", "loops", "false", "refused", "ATE without [m]", "final [m]", "NEES after the last")
    return markdown(header, [*rows, total])


def bounded(seeds: int = 6) -> str:
    """The smoother with bounded memory, as it is by default, against the full one, on the same features."""
    rows = []
    for name, world in SHORT.items():
        runs = np.array([[_lagged(f"{world}&seed={seed}", lag) for lag in ("50", "null")] for seed in range(seeds)])
        times = np.median(runs[:, :, 2], axis=0)
        for what, values in zip(("online", "final"), np.moveaxis(runs, 2, 0)):
            apart = 100 * (values[:, 0] / values[:, 1] - 1)
            rows.append([name, what, *np.median(values, axis=0), np.median(apart), apart.min(), apart.max(), *times])
    header = (
        "world", "path", "ATE bounded [mm]", "full [mm]", "difference, median [%]", "least [%]", "most [%]",
        "last frames bounded [CPU ms]", "full [CPU ms]",
    )  # fmt: skip
    return markdown(header, rows, texts=2)


def _lagged(world: str, lag: str) -> tuple[float, float, float]:
    """ATE online and final [mm], and the time of the last frames [CPU ms], of the smoother with a lag."""
    sequence = open_sequence(world)
    config = SystemConfig.for_kind(sequence.kind, None, "smoother").with_settings([f"backend.lag={lag}"])
    system = StereoSlam(sequence.rig, None, "smoother", config=config)
    results, times = timed(system.process_features, map(sequence.observations, range(len(sequence))))
    assert sequence.ground_truth is not None
    truth = sequence.ground_truth.poses[: len(results)]
    online = np.array([result.estimate.T_world_left for result in results])
    return 1e3 * ate(online, truth), 1e3 * ate(system.trajectory().poses, truth), float(np.median(times[-50:]))


@one_blas_thread  # as loops are closed
def cost(keyframes: int) -> str:
    """CPU time of closing one more loop, at the end of a path of laps with a loop every so often."""
    rng = np.random.default_rng(0)
    sigma = np.repeat([1e-3, 0.02], 3)
    turn = exp(np.array([0, 2 * np.pi / _AROUND, 0, 0, 0, 1.0]))
    true, odom = [np.eye(4)], [np.eye(4)]
    for _ in range(keyframes - 1):
        true.append(true[-1] @ turn)
        odom.append(odom[-1] @ turn @ exp(rng.normal(size=6) * sigma))
    common = np.tile(1e-4 * rng.normal(size=(6, _COMMON)), (keyframes, 1, 1))
    chain = Chain(np.array(odom), np.tile(np.diag(sigma**2), (keyframes, 1, 1)), common)
    loops = [
        Loop(
            k % _AROUND,
            k,
            inverse(true[k % _AROUND]) @ true[k] @ exp(rng.normal(size=6) * sigma),
            np.diag(sigma**2),
            50,
        )
        for k in [*range(_AROUND + _EVERY, keyframes - 1, _EVERY), keyframes - 1]
    ]
    known = solve(chain, loops[:-1], chain.poses)
    begin, last = time.process_time(), loops[-1]
    graph = PoseGraph.solved(chain, loops[:-1], known.poses, (last.first, last.second), known.common)
    graph.relative_pose(last.first, last.second)
    checked = time.process_time()
    graph.with_loop(last).solution()
    spent = 1e3 * (checked - begin), 1e3 * (time.process_time() - checked)
    header = ("keyframes", "loops", "to check one more [CPU ms]", "to close it [CPU ms]")
    return markdown(header, [[keyframes, len(loops), *(round(x) for x in spent)]])


def rendered(folder: Path, frames: int, backends: Sequence[str]) -> str:
    """A drive through the town as images, from a folder that is written first where there is none."""
    if not (folder / "mav0").exists():
        write_euroc(open_sequence(f"synthetic:town?frames={frames}"), folder, truth_images=False)
    rows = []
    for backend in backends:
        run = drive(str(folder), backend, [], images=True)
        rows.append(row("town, images", backend, run))
    return tables(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=["alike", "bounded", "cost", "rendered"])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--keyframes", type=int, default=5000)
    parser.add_argument("--folder", type=Path, default=Path("results/town"))
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--backend", nargs="*", default=list(ONLINE))
    given = parser.parse_args()
    parts = {
        "alike": lambda: alike(given.seeds),
        "bounded": bounded,
        "cost": lambda: cost(given.keyframes),
        "rendered": lambda: rendered(given.folder, given.frames, given.backend),
    }
    print(parts[given.part]())


if __name__ == "__main__":
    main()
