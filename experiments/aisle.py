"""The bookshelf aisle of paper A, section V, rendered, with both back ends: its figures, and the errors.

    python experiments/aisle.py [--quick] [--out DIR]

Leaves for each back end the files of a run, and the pictures ``top_view.png`` (paper A, Fig. 6) and ``errors.png``.
Prints a Markdown table. The paper's marks: mean
pose deviation below 1.5 cm, peak 3 cm, 318 landmarks.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from experiments.common import AssociationCheck, script_options
from experiments.tables import show
from frontends.surf import SurfFrontend
from slam.config import SystemConfig
from slam.data import StereoFeatures, StereoFrame
from slam.geometry.rig import StereoRig
from slam.geometry.trajectory import Trajectory
from slam.registry import ONLINE
from slam.run.options import RunOptions
from slam.run.plots import plot
from slam.run.run_data import RunData
from slam.run.runner import run
from slam.sequences import Sequence, open_sequence

HEADER = (
    "back end", "tracked", "mean error [cm]", "peak [cm]", "final mean [cm]", "final peak [cm]", "landmarks",
    "right associations [%]",
)  # fmt: skip


class Remembered(SurfFrontend):
    """The front end, which does its work once for each frame and remembers."""

    def __init__(self, rig: StereoRig, **options: Any) -> None:
        super().__init__(rig, **options)
        self._features: dict[int, StereoFeatures] = {}

    def extract(self, frame: StereoFrame) -> StereoFeatures:
        """See `slam.interfaces.Frontend`."""
        if frame.index not in self._features:
            self._features[frame.index] = super().extract(frame)
        return self._features[frame.index]


def position_errors(path: Trajectory, truth: Trajectory) -> np.ndarray:
    """Distances (F,) [cm] from the truth, in the frame of the first pose; nothing is aligned."""
    poses = np.linalg.inv(truth.poses[0]) @ truth.poses[: len(path.poses)]
    return np.asarray(100 * np.linalg.norm(path.positions - poses[:, :3, 3], axis=1))


def _mean_and_peak(errors: np.ndarray) -> tuple[float, float]:
    return float(errors.mean()), float(errors.max())


def row(sequence: Sequence, backend: str, frontend: Remembered, config: SystemConfig, out: Path) -> list[Any]:
    """Run one back end; its row of the table."""
    check = AssociationCheck(sequence)
    summary = run(
        sequence,
        RunOptions(backend, "surf", config, out / backend),
        lambda result: check.add(result.index, result),
        frontend,
    )
    data = RunData.read(out / backend, backend)
    assert sequence.ground_truth is not None
    online = position_errors(data.online, sequence.ground_truth)
    final = position_errors(data.final, sequence.ground_truth)
    tracked = summary["status"].get("tracked", 0) + summary["status"].get("started", 0)
    return [
        backend, f"{tracked} of {summary['frames']}", *_mean_and_peak(online), *_mean_and_peak(final),
        summary["landmarks"], check.share,
    ]  # fmt: skip


def main() -> int:
    parser = script_options(__file__, __doc__, "15 frames, one back end")
    arguments = parser.parse_args()
    sequence = open_sequence("synthetic:aisle?frames=15" if arguments.quick else "synthetic:aisle")
    names = ONLINE[: 1 if arguments.quick else None]
    config = SystemConfig.for_kind(sequence.kind)
    frontend = Remembered(sequence.rig, **config.frontend)
    rows = [row(sequence, backend, frontend, config, arguments.out) for backend in names]
    runs = [RunData.read(arguments.out / backend, backend) for backend in names]
    plot(runs, arguments.out / "top_view.png", "map")
    plot(runs, arguments.out / "errors.png", "errors")
    show(arguments.out / "table.json", HEADER, rows, 2)
    return 0


if __name__ == "__main__":
    sys.exit(main())
