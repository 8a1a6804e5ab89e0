"""Both back ends on the Starry Night data: real stereo measurements of twenty landmarks, without images.

    SLAM_DATA=/path/to/data python experiments/starry_night.py [--quick] [--sigma PX] [--parts A:B ...] [--out DIR]

A sensor head is carried by hand through a motion-capture room; of its twenty landmarks five are seen on average, and
none in a tenth of the steps. The association is given. Every run starts at the true pose of its first step and prints
the error of its path, online and final, without any alignment, and that of the landmarks. In the first eight seconds at
most two landmarks are seen, mostly one or none: a run from step 0 cannot know where it is when the others come into
view, so that the ATE after alignment of the path from there on is given as well. Three sigma of its attitude are then
80 to 270 degrees. The poses that this allows lie on a curved surface, which no Gaussian describes: each axis is within
its bounds, as the share of errors within three sigma says, but the correlations, which the NEES counts, are not right.
"""

from __future__ import annotations

import csv
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import backends
from experiments.common import script_options, span
from experiments.tables import markdown
from slam.data import Observations
from slam.evaluation.metrics import absolute_errors, nees, pose_residuals
from slam.geometry import se3
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.geometry.trajectory import Trajectory
from slam.models import EstimatorModels, MotionModel
from slam.registry import ONLINE

FILE = "starry_night/steps_0_950.npz"
PARTS = [(0, 300), (130, 950), (300, 950), (500, 950)]
HEADER = (
    "steps", "back end", "updates ok / empty / failed", "rejected", "RMSE online [m]", "[deg]", "RMSE final [m]",
    "ATE aligned [m]", "landmarks [m]", "median NEES", "within 3 sigma [%]",
)  # fmt: skip


@dataclass(frozen=True)
class Data:
    """The recording: stamps (K,), true ``T_world_left`` (K, 4, 4), landmarks (20, 3) and their pixels (K, 20, 4)."""

    rig: StereoRig
    stamps: Array
    poses: Array
    points: Array
    pixels: Array

    def seen(self, k: int) -> Observations:
        """What was measured in step k; the row is the landmark's id."""
        ids = np.flatnonzero((self.pixels[k] >= 0).all(axis=1))
        return Observations(ids, self.pixels[k, ids, :2], self.pixels[k, ids, 2:])


def load(path: Path) -> Data:
    """Read the recording; poses of the vehicle become poses of its left camera."""
    raw = np.load(path)
    f, b = float(raw["fu"].item()), float(raw["b"].item())
    rig = StereoRig.rectified_pair(f, raw["cu"].item(), raw["cv"].item(), b, 640, 480)
    T_world_vehicle = se3.pose(se3.so3_exp(raw["theta_vk_i"].T), raw["r_i_vk_i"].T)
    T_vehicle_left = se3.pose(raw["C_c_v"].T, raw["rho_v_c_v"][:, 0])
    pixels = raw["y_k_j"].transpose(1, 2, 0)
    return Data(rig, raw["t"][0], T_world_vehicle @ T_vehicle_left, raw["rho_i_pj_i"].T, pixels)


Figures = dict[str, float | int]


def run(data: Data, name: str, start: int, stop: int, models: EstimatorModels) -> tuple[Figures, Array]:
    """One back end over some steps, from the true pose at the first: figures, and the position error by step [m]."""
    backend = backends.create(name, data.rig, models=models)
    known: set[int] = set()
    status = {"ok": 0, "empty": 0, "failed": 0}
    poses, covariances, rejected = [], [], 0
    for k in range(start, stop):
        seen = data.seen(k)
        old = np.array([i in known for i in seen.ids.tolist()], bool)
        backend.predict(float(data.stamps[k]))
        report = backend.update(seen.select(old))
        new = seen.select(~old & np.isfinite(data.rig.triangulate(seen.uv_left, seen.uv_right)).all(axis=1))
        backend.add(new)
        known.update(new.ids.tolist())
        estimate = backend.estimate(landmarks=False)
        poses.append(estimate.T_world_left)
        covariances.append(estimate.covariance)
        status[report.status.value] += 1
        rejected += len(report.rejected)
    last = backend.estimate()
    truth = data.poses[start:stop]
    online, final = (pose_residuals(path, truth) for path in (np.array(poses), backend.trajectory().poses))
    deviations = np.sqrt(np.array(covariances).diagonal(axis1=1, axis2=2))
    off = np.linalg.norm(last.positions - data.points[last.ids], axis=1)
    figures: Figures = {
        **status,
        "rejected": rejected,
        "online": rms(online[:, 3:]),
        "turn": float(np.rad2deg(rms(online[:, :3]))),
        "final": rms(final[:, 3:]),
        "aligned": aligned_ate(data, np.array(poses), start, stop),
        "landmarks": rms(off[:, None]),
        "nees": float(np.median(nees(online, np.array(covariances)))),
        "within": 100 * float((np.abs(online) <= 3 * deviations).mean()),
    }
    return figures, np.linalg.norm(online[:, 3:], axis=1)


def aligned_ate(data: Data, poses: Array, start: int, stop: int) -> float:
    """ATE RMSE [m] of the online path after rigid alignment, from where more than two landmarks are seen."""
    first = next(k for k in range(start, stop) if len(data.seen(k)) > 2)
    stamps = data.stamps[first:stop]
    found, truth = Trajectory(stamps, poses[first - start :]), Trajectory(stamps, data.poses[first:stop])
    return absolute_errors(found, truth).translation_statistics.rmse


def rms(errors: Array) -> float:
    return float(np.sqrt((errors**2).sum(axis=1).mean()))


@dataclass(frozen=True)
class Part:
    """One back end over one part of the recording: its figures, and the position error by step [m]."""

    start: int
    stop: int
    backend: str
    figures: Figures
    errors: Array

    @property
    def span(self) -> str:
        """For the table."""
        return f"{self.start}–{self.stop}"


def run_parts(data: Data, parts: list[tuple[int, int]], sigma: float) -> Iterator[Part]:
    for start, stop in parts:
        for name in ONLINE:
            models = EstimatorModels(
                MotionModel(1.0, 1.0), pixel_sigma=sigma, T_world_left=data.poses[start],
                initial_position_sigma=0.01, initial_rotation_sigma=0.01,
            )  # fmt: skip
            yield Part(start, stop, name, *run(data, name, start, stop, models))


def draw(data: Data, found: list[Part], path: Path) -> None:
    """Landmarks seen and position error, step by step."""
    from matplotlib.figure import Figure

    spans = list(dict.fromkeys(part.span for part in found))
    figure = Figure((9, 1.6 * (1 + len(spans))), layout="constrained")
    top, *others = figure.subplots(1 + len(spans), 1, sharex=True)
    top.plot([len(data.seen(k)) for k in range(max(part.stop for part in found))], color="0.4", lw=0.8)
    top.set_ylabel("landmarks seen")
    for axis, steps in zip(others, spans):
        for part in (p for p in found if p.span == steps):
            axis.semilogy(range(part.start, part.stop), part.errors, lw=1, label=part.backend)
        axis.set_ylabel(f"from step {steps.partition('–')[0]}\nerror [m]")
    others[0].legend(frameon=False, fontsize=8)
    others[-1].set_xlabel("step")
    figure.savefig(path, dpi=110, metadata={"Software": None})


def cells(part: Part) -> list[str]:
    r = part.figures
    return [
        part.span, part.backend, f"{r['ok']} / {r['empty']} / {r['failed']}", str(r["rejected"]), f"{r['online']:.3f}",
        f"{r['turn']:.2f}", f"{r['final']:.3f}", f"{r['aligned']:.3f}", f"{r['landmarks']:.3f}", f"{r['nees']:.1f}",
        f"{r['within']:.1f}",
    ]  # fmt: skip


def main() -> int:
    parser = script_options(__file__, __doc__, "a hundred steps from one start")
    parser.add_argument("--sigma", type=float, default=6.0, help="assumed pixel noise [px]")
    parser.add_argument("--parts", type=span, nargs="*", default=PARTS, metavar="A:B", help="steps from A to before B")
    arguments = parser.parse_args()
    folder = os.environ.get("SLAM_DATA")
    if not folder or not (Path(folder) / FILE).is_file():
        print(f"starry night: set SLAM_DATA to the folder that holds {FILE}; nothing was run")
        return 0
    data = load(Path(folder) / FILE)
    found = []
    for part in run_parts(data, [(130, 230)] if arguments.quick else arguments.parts, arguments.sigma):
        found.append(part)
        print(cells(part), file=sys.stderr, flush=True)
    text = markdown(HEADER, [cells(part) for part in found], 2)
    print(text)
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / "table.md").write_text(text + "\n", encoding="utf-8")
    with (arguments.out / "starry_night.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["steps", "back_end", *found[0].figures])
        writer.writerows([part.span, part.backend, *part.figures.values()] for part in found)
    draw(data, found, arguments.out / "starry_night.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
