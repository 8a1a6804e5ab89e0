"""Start-up from pre-stored features (paper B, section 4.2 and Fig. 6).

    python experiments/startup.py [--quick] [--out DIR]

The board's landmarks are known to a millimetre, with their descriptors. The state begins at a wrong place; the camera
stands at [3, -70, 2.7] cm. Three wrong starts, both back ends, all pixels or the left ones alone; and the
back ends by themselves, without the search in the map that finds the first pose. Prints a Markdown table and draws
the figure (``startup.png``: the estimates in the x-y and x-z
planes as in Fig. 6, and the error over time with what the back end says of it). Paper B's own filter stopped at
[0, -55.8, 3.7] cm, 14 cm short.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from backends import create
from experiments.common import script_options
from experiments.tables import picture, show
from slam.atlas.map_io import SavedMap
from slam.config import SystemConfig
from slam.data import Observations
from slam.geometry import se3
from slam.models import MotionModel
from slam.registry import ONLINE
from slam.sequences import open_sequence
from slam.system import StereoSlam
from slam.worlds.sequence import WorldSequence

FACING = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  #: camera axes in the world's: looking along y, upright
STARTS = {  #: where the state begins [m], and how far it is turned about the vertical [deg]
    "[0, 0, 0]": ((0.0, 0.0, 0.0), 0.0),
    "[30, -120, -20]": ((0.3, -1.2, -0.2), 20.0),
    "[-40, -30, 30]": ((-0.4, -0.3, 0.3), -30.0),
}
PAPER = np.array([0.0, -0.558, 0.037])  #: where paper B's filter stopped [m]
STANDING = MotionModel(acceleration=0.1, angular_acceleration=0.1)  #: of a robot that trembles where it stands
ALONE = "stereo, no search"
KNOWN = 1e-3  #: standard deviation of the stored positions [m]
HEADER = (
    "pixels", "back end", "frame 0 [cm]", "mean after [cm]", "worst after [cm]", "1 sigma at the end [cm]",
)  # fmt: skip


@dataclass(frozen=True)
class StartUp:
    """One start."""

    pixels: str  # ``"stereo"`` or ``"left"``, or `ALONE` for the back end by itself
    backend: str  # names
    start: str  # likewise
    positions: np.ndarray  # estimated places of the camera (F + 1, 3) [m]; the first is where the state began
    truth: np.ndarray  # true places (F, 3) [m]
    sigma: np.ndarray  # standard deviation of the position, all axes together (F,) [m]

    @property
    def errors(self) -> np.ndarray:
        """Distances from the truth (F,) [m]."""
        return np.linalg.norm(self.positions[1:] - self.truth, axis=1)


def stored_map(sequence: WorldSequence) -> SavedMap:
    """The pre-stored features: the board's landmarks with a millimetre of noise, and how they look from the front."""
    seen: dict[int, np.ndarray] = {}
    signs: dict[int, int] = {}
    look = open_sequence(f"synthetic:startup?seed={sequence.values['seed'] + 1000}&frames=20")
    assert isinstance(look, WorldSequence)
    for one in map(look.simulate, range(len(look))):
        for row, i in enumerate(one.ids.tolist()):
            if i >= 0:
                seen.setdefault(i, one.features.descriptors[row])
                signs.setdefault(i, int(one.features.laplacian[row]))
    positions = sequence.landmarks.positions
    ids = np.array([i for i in sorted(seen) if abs(positions[i, 1]) < 0.01], np.int64)
    noise = KNOWN * np.random.default_rng(sequence.values["seed"]).standard_normal((len(ids), 3))
    ones = np.ones(len(ids), np.int64)
    return SavedMap(
        ids, positions[ids] + noise, np.tile(KNOWN**2 * np.eye(3), (len(ids), 1, 1)),
        np.array([seen[i] for i in ids.tolist()], np.float32), np.array([signs[i] for i in ids.tolist()], np.int8),
        ones, ones,
    )  # fmt: skip


def start_up(sequence: WorldSequence, known: SavedMap, backend: str, start: str, frames: int, pixels: str) -> StartUp:
    """Run one start: in the system, or the back end alone with true associations, without the search in the map."""
    place, turn = STARTS[start]
    T = se3.pose(se3.so3_exp(np.array([0, 0, np.deg2rad(turn)])) @ FACING, np.array(place))
    config = SystemConfig.for_kind(sequence.kind, None)
    sigma_px = sequence.values["sigma"]
    models = replace(config.models, T_world_left=T.tolist(), pixel_sigma=sigma_px, motion=STANDING)
    if pixels == ALONE:
        models = replace(models, initial_position_sigma=1.0, initial_rotation_sigma=0.3)
        estimator: Any = create(backend, sequence.rig, models=models)
        estimator.insert(known.ids, known.positions, known.covariances)
    else:
        system = StereoSlam(sequence.rig, None, backend, config=replace(config, models=models), prior_map=known)
    positions, sigma = [T[:3, 3]], []
    for k in range(frames):
        if pixels == ALONE:
            seen = sequence.simulate(k)
            rows, f = np.isin(seen.ids, known.ids), seen.features
            estimator.predict(f.stamp)
            estimator.update(Observations(seen.ids[rows], f.uv_left[rows], f.uv_right[rows]))
            estimate = estimator.estimate(landmarks=False)
        else:
            f = sequence.observations(k)
            f = f if pixels == "stereo" else replace(f, uv_right=np.full_like(f.uv_right, np.nan))
            estimate = system.process_features(f).estimate
        positions.append(estimate.T_world_left[:3, 3])
        sigma.append(np.sqrt(np.trace(estimate.covariance[3:, 3:])))
    truth = sequence.ground_truth.positions[:frames]
    return StartUp(pixels, backend, start, np.array(positions), truth, np.array(sigma))


def worst_of_starts(runs: list[StartUp]) -> list[list[object]]:
    """A row of the table for each kind of pixels and back end: of its starts the worst."""
    rows: list[list[object]] = []
    for kind in dict.fromkeys((run.pixels, run.backend) for run in runs):
        own = [run for run in runs if (run.pixels, run.backend) == kind]
        e = 100 * np.array([run.errors for run in own])
        after = e[:, 10:]
        figures = (e[:, 0].max(), after.mean(axis=1).max(), after.max())
        rows.append([*kind, *map(float, figures), 100 * max(float(run.sigma[-1]) for run in own)])
    return rows


def draw(runs: list[StartUp], path: Path) -> None:
    """The figure: x-y and x-z planes as in paper B, Fig. 6, and the error over time."""
    with picture(path, 14, 4.4, 1, 3) as axes:
        for axis, (a, b), letters in zip(axes, ((0, 1), (0, 2)), ("xy", "xz")):
            for run in runs:
                p = 100 * run.positions
                axis.plot(p[:, a], p[:, b], {"ekf": "o-", "smoother": "x:"}.get(run.backend, "+--"), ms=4, lw=0.8)
            truth = 100 * runs[0].truth.mean(axis=0)
            axis.plot(truth[a], truth[b], "k^", ms=10, mfc="none", label="true place")
            axis.plot(100 * PAPER[a], 100 * PAPER[b], "rs", mfc="none", label="where paper B's stopped")
            axis.set(xlabel=f"{letters[0]} [cm]", ylabel=f"{letters[1]} [cm]")
            axis.legend(fontsize=8)
        for run in runs:
            line = axes[2].semilogy(100 * run.errors, lw=0.8, label=f"{run.backend}, {run.start}")[0]
            axes[2].semilogy(100 * run.sigma, "--", lw=0.8, color=line.get_color())
        axes[2].axhline(1.0, color="k", lw=0.8)
        axes[2].set(xlabel="frame", ylabel="error (dashed: 1 sigma) [cm]")
        axes[2].legend(fontsize=7)


def main() -> int:
    parser = script_options(__file__, __doc__, "15 frames instead of 150, one back end")
    arguments = parser.parse_args()
    sequence = open_sequence("synthetic:startup")
    assert isinstance(sequence, WorldSequence)
    known, frames = stored_map(sequence), 15 if arguments.quick else 150
    names = ONLINE[: 1 if arguments.quick else None]
    cases = [(pixels, backend, start) for pixels in ("stereo", "left", ALONE) for backend in names for start in STARTS]
    runs = [start_up(sequence, known, backend, start, frames, pixels) for pixels, backend, start in cases]
    print(f"{len(known)} stored features, {frames} frames; of three wrong starts the worst. ", end="")
    print(
        "Sigmas of the system count errors of the rig, too. In the system a camera that stands keeps its pose: its "
        "images have the same errors again. Here their noise is new in each frame, and is not averaged.\n"
    )
    show(arguments.out / "table.json", HEADER, worst_of_starts(runs), 2)
    draw([run for run in runs if run.pixels == "stereo"], arguments.out / "startup.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
