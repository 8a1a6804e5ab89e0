"""What faults do to a run: blackout, dropped frames, dropped right images, and a kidnapped camera.

    python experiments/faults.py [--quick] [--out DIR]

Each fault on the rendered world ``desk``, both back ends. Prints a Markdown table: the sequence of states, the position
error after the fault, how long it took to localize the map again, and the share of right associations.
Draws the error frame by frame.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from experiments.common import AssociationCheck, script_options
from experiments.tables import picture, show
from frontends import create
from slam.config import SystemConfig
from slam.data import FrameResult, StereoFeatures, StereoFrame
from slam.geometry.se3 import inverse
from slam.registry import ONLINE
from slam.sequences import open_sequence
from slam.system import StereoSlam

HEADER = (
    "fault", "back end", "states", "mean after [cm]", "peak after [cm]", "frames until relocalised",
    "right associations [%]",
)  # fmt: skip


@dataclass(frozen=True)
class Fault:
    """One recording of the desk."""

    name: str  # for the table
    options: str  # of the world
    last_good: int  # the last frame before the fault
    over: int  # the first frame after it
    #: The camera is carried from one frame to another: (last before, first after); None for not
    jump: tuple[int, int] | None = None


def faults(quick: bool) -> list[Fault]:
    """The recordings; frame numbers are in the recording, after any are dropped."""
    n, dark = (14, 10) if quick else (120, 60)
    rng = np.random.default_rng(0)  # frame 0 keeps its right image: without it there is no map that could be kept
    chosen = ",".join(str(k) for k in range(1, 2 * n) if rng.random() < 0.3)
    every = [
        Fault("none", f"frames={2 * n}", n, n + 1),
        Fault(f"{dark / 30:.2g} s of blackout", f"frames={2 * n + dark}&black={n}:{n + dark}", n - 1, n + dark),
        Fault("30 % of frames dropped", f"frames={2 * n}&drop=0.3", n // 2, n // 2 + 1),
        Fault("30 % of right images dropped", f"frames={2 * n}&dropright={chosen}", n, n + 1),
        Fault("kidnapped to a known place", "frames=900", n - 1, n, (n, 2 if quick else 30)),
        Fault("kidnapped to an unknown place", "frames=900", n - 1, n, (n, 450)),
    ]
    return [every[1], every[4]] if quick else every


def frames(fault: Fault, count: int) -> Iterator[tuple[int, StereoFrame]]:
    """Numbers in the world's recording, and frames with times that go on evenly."""
    sequence = open_sequence(f"synthetic:desk?{fault.options}")
    if fault.jump is None:
        yield from enumerate(sequence)
        return
    last, first = fault.jump
    order = [*range(last), *range(first, first + count - last)]
    stamps = sequence.stamps
    for step, k in enumerate(order):
        yield k, replace(next(iter(sequence.frames(k, k + 1))), index=step, stamp=float(stamps[step]))


def extract(fault: Fault, count: int) -> list[tuple[int, StereoFeatures]]:
    """Features of a recording, for both back ends."""
    sequence = open_sequence(f"synthetic:desk?{fault.options}")
    frontend = create("surf", sequence.rig, **SystemConfig.for_kind("handheld").frontend)
    return [(k, frontend.extract(frame)) for k, frame in frames(fault, count)]


def run(fault: Fault, backend: str, features: list[tuple[int, StereoFeatures]]) -> tuple[list[Any], list[float]]:
    """One row of the table, and the error of every frame [cm]."""
    sequence = open_sequence(f"synthetic:desk?{fault.options}")
    system = StereoSlam(sequence.rig, None, backend, config=SystemConfig.for_kind(sequence.kind))
    truth = sequence.ground_truth.poses
    world = np.linalg.inv(truth[features[0][0]])
    check, results, errors = AssociationCheck(sequence), [], []
    for k, seen in features:
        result = system.process_features(seen)
        check.add(k, result)
        if result.status.value == "started":  # errors count from where the map begins
            world = result.estimate.T_world_left @ np.linalg.inv(truth[k])
        errors.append(100 * float(np.linalg.norm((inverse(world @ truth[k]) @ result.estimate.T_world_left)[:3, 3])))
        results.append(result)
    found = [i for i in range(fault.over, len(results)) if results[i].status.value == "tracked"]
    after = errors[found[0] :] if found else [float("nan")]
    row = [
        fault.name, backend, states(results), float(np.mean(after)), max(after),
        found[0] - fault.over if found else None, check.share,
    ]  # fmt: skip
    return row, errors


def states(results: list[FrameResult]) -> str:
    """The states one after the other, with the number of frames of each."""
    return ", ".join(f"{name} {len(list(group))}" for name, group in groupby(r.status.value for r in results))


def draw(errors: dict[tuple[Fault, str], list[float]], path: Path) -> None:
    """Position error over the frames, a panel a fault; grey from the last good frame to the first after the fault."""
    names = list(dict.fromkeys(fault for fault, _ in errors))
    with picture(path, 11, 5.6, 2, -(-len(names) // 2), sharey=True) as panels:
        axes = np.ravel(panels)
        for axis, fault in zip(axes, names):
            axis.axvspan(fault.last_good, fault.over, color="0.85")
            for backend in (name for other, name in errors if other == fault):
                axis.semilogy(np.maximum(errors[fault, backend], 1e-2), lw=1, label=backend)
            axis.set_title(fault.name, fontsize=9)
            axis.set(xlabel="frame", ylabel="error [cm]")
        for axis in axes[len(names) :]:
            axis.remove()
        axes[0].legend(frameon=False, fontsize=8)


def main() -> int:
    parser = script_options(__file__, __doc__, "two of the faults, shorter recordings, one back end")
    arguments = parser.parse_args()
    rows, errors = [], {}
    for fault in faults(arguments.quick):
        features = extract(fault, 30 if arguments.quick else 300)
        for backend in ONLINE[: 1 if arguments.quick else None]:
            row, errors[fault, backend] = run(fault, backend, features)
            rows.append(row)
            print(row, file=sys.stderr, flush=True)
    show(arguments.out / "table.json", HEADER, rows, 3)
    draw(errors, arguments.out / "faults.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
