"""Self-calibration: worlds whose calibration is wrong on purpose, and the same rig on two real drives.

    SLAM_DATA=/path/to/data python experiments/calibration.py [--quick] [--seeds N] [--out DIR]

In the worlds the focal length is 0.5 % too long and the right camera is turned by 0.5 mrad about each axis. `ekf`
drives through them with the right calibration, with the wrong one, and with the wrong one and no self-calibration.
Of the drives of one day it is compared, parameter by parameter, whether they find the same rig. Prints Markdown tables.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from experiments.common import recordings, script_options
from experiments.loops import ate
from experiments.tables import show
from slam.calibration.posterior import RigPosterior
from slam.commands.calibrate import unit_of
from slam.config import SystemConfig
from slam.naming import count
from slam.run.calibrating import calibrate
from slam.sequences import open_sequence
from slam.system import StereoSlam

#: Worlds as features, so that a drive takes some seconds.
WORLDS = {"street": "density=40&frames=200", "aisle": "frames=200"}
DRIVES = {f"raw {n}": f"kitti_raw/2011_09_26/2011_09_26_drive_{n}_sync" for n in ("0001", "0013")}
FOCAL, TURN = 0.005, 0.5  # relative error of the focal length; turn of the right camera [mrad]

#: What is wrong: the parameters, the correction that takes it away, the factor to the unit shown, and that unit.
WRONG = {
    "focal length [%]": (("left_f", "right_f"), 100 * FOCAL, 100.0),
    "pitch [mrad]": (("pitch",), -TURN, 1e3),
    "yaw [mrad]": (("yaw",), -TURN, 1e3),
    "roll [mrad]": (("roll",), -TURN, 1e3),
}


def drive(name: str, settings: list[str]) -> tuple[float, RigPosterior]:
    """Error of the online path [m], and what is found of the rig."""
    sequence = open_sequence(name)
    config = SystemConfig.for_kind(sequence.kind, None).with_settings(settings)
    system = StereoSlam(sequence.rig, None, config=config)
    results = [system.process_features(sequence.observations(k)) for k in range(len(sequence))]
    poses = np.array([r.estimate.T_world_left for r in results])
    assert sequence.ground_truth is not None
    return ate(poses, sequence.ground_truth.poses[: len(poses)]), system.calibration.posterior


def found(posterior: RigPosterior) -> list[tuple[float, float, float]]:
    """Correction, its standard deviation, and its error in standard deviations, for each row of `WRONG`."""
    out = []
    for names, true, factor in WRONG.values():
        rows = [posterior.names.index(name) for name in names]
        w = np.full(len(rows), factor / len(rows))
        mean, sigma = float(w @ posterior.mean[rows]), float(np.sqrt(w @ posterior.covariance[np.ix_(rows, rows)] @ w))
        out.append((mean, sigma, abs(mean - true) / sigma))
    return out


def world_row(world: str, options: str, seeds: int) -> list[str]:
    """A row of the table: medians over seeds."""
    right, wrong, off, corrections = [], [], [], []
    for seed in range(seeds):
        name = f"synthetic:{world}?" + "&".join(x for x in (options, f"seed={seed}") if x)
        miscalibrated = f"{name}&focal_error={FOCAL}&turn_error={TURN}"
        right.append(drive(name, [])[0])
        error, posterior = drive(miscalibrated, [])
        wrong.append(error)
        corrections.append(found(posterior))
        off.append(drive(miscalibrated, ["self_calibration.enabled=false"])[0])
    a, b, c = (float(np.median(x)) for x in (right, wrong, off))
    mean, sigma = np.median(np.array(corrections)[:, :, :2], axis=0).T
    said = [f"{m:.2f} ± {s:.2f}" for m, s in zip(mean, sigma)]
    farthest = float(np.max(np.array(corrections)[:, :, 2]))
    return [world, f"{a:.3f}", f"{b:.3f}", f"{b / a:.1f}", f"{c:.3f}", *said, f"{farthest:.1f}"]


def show_drives(drives: Mapping[str, Path], out: Path, frames: int | None) -> None:
    """Corrections by each drive that both of them show, and how far apart they are."""
    sequences = [open_sequence(f) for f in drives.values()]
    found = calibrate(sequences, out / "rig.json", (), (0, frames), overwrite=True)
    alone = [one["parameters"] for one in found["recordings"]]
    rows = []
    for k, row in enumerate(found["parameters"]):
        if found["apart"] is not None and np.isfinite(found["apart"][k]):
            factor, unit = unit_of(row, found["rig"]["focal"])
            cells = (f"{factor * one[k]['mean']:.2f} ± {factor * one[k]['sigma']:.2f}" for one in alone)
            rows.append([row["name"], unit, *cells, f"{found['apart'][k]:.1f}"])
    header = ("parameter", "unit", *drives, "apart [sigma]")
    show(out / "drives.json", header, rows, 2, found["agreement"] or "")


def main() -> int:
    parser = script_options(__file__, __doc__, "few frames")
    parser.add_argument("--seeds", type=int, default=3, help="of each world")
    arguments = parser.parse_args()
    out: Path = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    worlds = {"street": "density=40&frames=12"} if arguments.quick else WORLDS
    seeds = 1 if arguments.quick else arguments.seeds
    header = ("world", "ATE, right [m]", "ATE, wrong [m]", "ratio", "ATE, not calibrated [m]", *WRONG,
              "largest error [sigma]")  # fmt: skip
    rows = [world_row(world, options, seeds) for world, options in worlds.items()]
    true = ", ".join(f"{name}: {true:g}" for name, (_, true, _) in WRONG.items())
    print(f"Worlds with a wrong calibration, medians of {count(seeds, 'seed')} (true corrections: {true}):\n")
    show(out / "worlds.json", header, rows, 1)
    drives = recordings(DRIVES)
    if len(drives) == len(DRIVES):
        print("\nThe same rig on two drives of one day:\n")
        show_drives(drives, out, 12 if arguments.quick else None)
    return 0


if __name__ == "__main__":
    sys.exit(main())
