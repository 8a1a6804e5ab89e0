"""How many measurements a frame needs: accuracy and time where back ends get the k most informative matches alone.

    python experiments/informative.py [--quick] [--seeds 2] [--out DIR]

Paper A measured ten landmarks a frame. Worlds with simulated features, some seeds each; where SLAM_DATA is set, also
KITTI odometry 06 and raw 0001. For each back end and k (``association.measured``): the error of the online path after
alignment, the CPU time of a frame without its features, and, for comparison, the error with k landmarks in view
(``map.target_in_view``), medians over the seeds. Prints a Markdown table and draws both over k.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from experiments.common import features_of, online_error, recordings, script_options, timed
from experiments.tables import markdown, write_json
from slam.config import SystemConfig
from slam.data import StereoFeatures
from slam.registry import ONLINE
from slam.sequences import Sequence, open_sequence
from slam.system import StereoSlam

COUNTS = (10, 20, 30, 50, None)  # None for all
WORLDS = {"aisle": 90, "desk": 90, "street": 40}
DRIVES = {
    "KITTI odometry 06": "kitti_odometry/sequences/06",
    "KITTI raw 0001": "kitti_raw/2011_09_26/2011_09_26_drive_0001_sync",
}
HEADER = ("sequence", "back end", "measured", "ATE online [cm]", "CPU [ms]", "ATE with so many in view [cm]")


def sequences(quick: bool, seeds: int) -> Iterator[tuple[str, list[Sequence]]]:
    """Names for the table, and the same world with several seeds."""
    for world, frames in list(WORLDS.items())[: 1 if quick else None]:
        length = 30 if quick else frames
        yield world, [open_sequence(f"synthetic:{world}?frames={length}&seed={seed}") for seed in range(seeds)]
    for name, drive in recordings({} if quick else DRIVES).items():
        yield name, [open_sequence(drive)]


def run(sequence: Sequence, backend: str, features: list[StereoFeatures], settings: list[str]) -> tuple[float, float]:
    """RMSE of the online path [cm] and median CPU time of a frame [ms]."""
    config = SystemConfig.for_kind(sequence.kind, None, backend).with_settings(settings)
    system = StereoSlam(sequence.rig, None, backend, kind=sequence.kind, config=config)
    results, times = timed(system.process_features, features)
    return 100 * online_error(results, sequence.ground_truth), float(np.median(times[len(times) // 3 :]))


def rows(name: str, same: list[Sequence], counts: tuple[int | None, ...]) -> Iterator[list[object]]:
    """A row for each back end and number of measurements."""
    features = [features_of(sequence) for sequence in same]
    for backend in ONLINE:
        for count in counts:

            def found(setting: str, count: int | None = count, backend: str = backend) -> np.ndarray:
                settings = [] if count is None else [f"{setting}={count}"]
                return np.median([run(s, backend, seen, settings) for s, seen in zip(same, features)], axis=0)

            chosen = found("association.measured")
            fewer = None if count is None else float(found("map.target_in_view")[0])
            yield [name, backend, "all" if count is None else count, *map(float, chosen), fewer]


def draw(path: Path, table: list[list[object]]) -> None:
    """Error and time over k, both as shares of those with all measurements: a panel for each back end."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, len(ONLINE), figsize=(9, 6), sharex=True, squeeze=False)
    for backend, panels in zip(ONLINE, axes.T):
        for name in dict.fromkeys(row[0] for row in table):
            mine = [row for row in table if row[:2] == [name, backend]]
            errors, times = (np.array([float(str(row[k])) for row in mine]) for k in (3, 4))
            x = [row[2] if row[2] != "all" else 100 for row in mine]
            for panel, y in zip(panels, (errors, times)):
                panel.plot(x, y / y[-1], "o-", label=str(name), markersize=3)
        panels[0].set(title=backend, ylabel="ATE over that with all", ylim=(0.5, 3))
        panels[1].set(
            xlabel="measurements a frame at most (100: all)", ylabel="CPU time over that with all", ylim=(0, 1.3)
        )
        for panel in panels:
            panel.axhline(1.0, color="0.7", linewidth=0.8)
    axes[0, 0].legend(fontsize=7)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def main() -> int:
    parser = script_options(__file__, __doc__, "one world, 30 frames, two numbers")
    parser.add_argument("--seeds", type=int, default=2, help="of each world")
    arguments = parser.parse_args()
    table: list[list[object]] = []
    for name, same in sequences(arguments.quick, 1 if arguments.quick else arguments.seeds):
        for row in rows(name, same, COUNTS[-2:] if arguments.quick else COUNTS):
            table.append(row)
            print(row, file=sys.stderr, flush=True)
    print(markdown(HEADER, table, 3))
    write_json(arguments.out / "table.json", HEADER, table)
    draw(arguments.out / "informative.png", table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
