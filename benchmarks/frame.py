"""What a whole frame costs, next to what others take for it on the same machine at the same time.

    python benchmarks/frame.py [--quick] [--orbslam3 PYTHON] [--out DIR]

Real and rendered recordings, all back ends, detector of moving objects on, reading left out. Frame by frame, in turns:
each back end, and one ``cv2.SIFT`` with 800 features on the left image. Then each back end by itself with overlap
(`StereoSlam.run`): the time from one result to the next. Then, with ``--orbslam3``, ORB-SLAM3 on the same images as
fast as it goes; PYTHON, by default what the variable ORBSLAM3 names, is the interpreter of an environment in
which ``orbslam3-python`` is installed (``python -m venv E && E/bin/pip install orbslam3-python``), which is never
imported here. Median times; compare the ratios, not the milliseconds. ORB-SLAM3's vocabulary is a small one of
rendered images, good for tracking.
A second table has the CPU time of each stage, how much there was to do (features, landmarks of the map, those that were
matched, those that measured the pose), and the way of a frame through the code (`calls`): files entered, calls from one
file to another, and Python calls in all, the back end left out.

The first size is that of KITTI odometry 06 where SLAM_DATA has it, else of the same size rendered; MH_01 of EuRoC is
left out where it has not.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.calls import ways_of
from benchmarks.orb_vocabulary import write_vocabulary
from experiments.common import script_options
from experiments.tables import markdown, write_json
from slam.data import FrameResult, StereoFrame
from slam.errors import SlamError
from slam.evaluation.metrics import absolute_errors, associate
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.geometry.trajectory import Trajectory
from slam.registry import ONLINE
from slam.runtime import compilation
from slam.sequences import Sequence, open_sequence
from slam.system import StereoSlam

KITTI, EUROC = "kitti_odometry/sequences/06", "euroc/MH_01_part"
HEADER = ("images", "what", "wall [ms]", "CPU [ms]", "wall / SIFT", "CPU / SIFT", "wall / ORB-SLAM3", "CPU / ORB-SLAM3",
          "frames lost", "ATE [mm]")  # fmt: skip
STAGES = ("extract", "predict", "associate", "update", "estimate", "objects", "manage", "atlas")
COUNTS = ("features", "landmarks", "matched", "measured")  # of a frame: of the image, of the map, and of these
WAYS = ("images", "what", *(f"{name} [ms]" for name in STAGES), *COUNTS, "files", "calls between files", "Python calls")
SIFT, ORBSLAM3 = "cv2.SIFT, 800 features, left", "ORB-SLAM3"
OVERLAP = "{}, overlap"  # of a back end


@dataclass(frozen=True)
class Size:
    """A recording, frames whose times do not count, frames that do, and features for ORB-SLAM3."""

    name: str
    sequence: str
    skipped: int
    counted: int
    features: int


@dataclass
class Times:
    """Wall and CPU time of each frame [ms], its pose (None where it was lost)."""

    wall: list[float] = field(default_factory=list)
    cpu: list[float] = field(default_factory=list)
    poses: list[Array | None] = field(default_factory=list)

    def take(self, call: Callable[[], Array | None]) -> None:
        """Time one frame."""
        wall, cpu = time.perf_counter(), time.process_time()
        pose = call()
        self.cpu.append(1e3 * (time.process_time() - cpu))
        self.wall.append(1e3 * (time.perf_counter() - wall))
        self.poses.append(pose)

    def medians(self, counted: slice) -> Array:
        """Of wall and CPU time over the frames that count and were tracked; of all where none was."""
        tracked = np.array([pose is not None for pose in self.poses[counted]])
        times = np.array([self.wall[counted], self.cpu[counted]])
        return np.asarray(np.median(times[:, tracked] if tracked.any() else times, axis=1))


def sizes(quick: bool) -> list[Size]:
    """All sizes."""
    data, euroc = (Path(os.environ.get("SLAM_DATA", ""), name) for name in (KITTI, EUROC))
    kitti = str(data) if data.is_dir() else "synthetic:street?width=1226&height=370&frames=51"
    skipped, counted = (3, 5) if quick else (15, 36)
    return [
        Size("KITTI 06, 1226x370" if data.is_dir() else "street, 1226x370", kitti, skipped, counted, 2000),
        *([Size("MH_01, 752x480", str(euroc), skipped, counted, 1200)] if euroc.is_dir() else []),
        Size("desk, 752x480", "synthetic:desk?width=752&height=480&frames=60", skipped, counted, 1200),
        Size("aisle, 320x240", "synthetic:aisle?frames=60", skipped, counted, 1000),
    ]


def measure(size: Size, orbslam3: str | None) -> dict[str, Times]:
    """Everybody's times on one recording."""
    sequence = open_sequence(size.sequence)
    frames = list(sequence.frames(0, size.skipped + size.counted))
    systems = {name: StereoSlam(sequence.rig, backend=name, kind=sequence.kind) for name in ONLINE}
    sift, times = cv2.SIFT_create(800), {name: Times() for name in (*ONLINE, SIFT)}

    for frame in frames:
        for name, system in systems.items():
            times[name].take(lambda s=system, f=frame: tracked(s.process(f)))
        times[SIFT].take(lambda f=frame: sift.detectAndCompute(f.left, None) and None)
    for name in ONLINE:
        times[OVERLAP.format(name)] = overlapped(sequence, name, frames)
    if orbslam3 is not None:
        times[ORBSLAM3] = with_orbslam3(orbslam3, sequence, frames, size.features)
    return times


def overlapped(sequence: Sequence, backend: str, frames: list[StereoFrame]) -> Times:
    """A back end's times from result to result, the next frame's features being extracted beside its estimation."""
    results, times = StereoSlam(sequence.rig, backend=backend, kind=sequence.kind).run(frames), Times()
    for _ in frames:
        times.take(lambda: tracked(next(results)[1]))
    return times


def ways(size: Size) -> Iterable[list[str]]:
    """Of each back end, medians over the frames that count: CPU time by stage, and the way through the code."""
    sequence, last = open_sequence(size.sequence), size.skipped + size.counted
    for name in ONLINE:
        clock, compilation.working_time = compilation.working_time, time.process_time
        try:
            system = StereoSlam(sequence.rig, backend=name, kind=sequence.kind)
            results = [system.process(frame) for frame in sequence.frames(0, last)][size.skipped :]
        finally:
            compilation.working_time = clock
        way = np.median([w.summary() for w in ways_of(sequence, name, size.skipped, last)], axis=0)
        by_stage = (np.median([r.milliseconds.get(stage, 0.0) for r in results]) for stage in STAGES)
        counts = np.median([(len(r.features), r.map_size, len(r.matched), len(r.report.used)) for r in results], axis=0)
        yield [size.name, name, *(f"{x:.1f}" for x in by_stage), *(f"{x:.0f}" for x in (*counts, *way))]


def tracked(result: FrameResult) -> Array | None:
    """The pose of a frame, None where it was lost."""
    return result.estimate.T_world_left if result.status.measured else None


def with_orbslam3(python: str, sequence: Sequence, frames: list[StereoFrame], features: int) -> Times:
    """ORB-SLAM3's times, in a process of its own; it is given rectified images, and not charged for that."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        images = {
            side: np.stack([cv2.remap(getattr(f, side), *maps, cv2.INTER_LINEAR) for f in frames])
            for side, maps in zip(("left", "right"), sequence.rig.rectified.maps)
        }
        np.savez(folder / "frames.npz", **images, stamps=np.array([f.stamp for f in frames]))
        scenes = ("synthetic:aisle?frames=60", "synthetic:desk?frames=60", "synthetic:street?frames=60")
        training = (f.left for scene in scenes for f in list(open_sequence(scene).frames())[::4])
        write_vocabulary(training, folder / "vocabulary.txt")
        (folder / "settings.yaml").write_text(settings(sequence.rig.rectified.rig, frames, features), encoding="ascii")
        worker = Path(__file__).with_name("orbslam3_worker.py")
        done = subprocess.run([python, str(worker), str(folder)], capture_output=True, text=True)
        if not (folder / "result.json").is_file():
            raise SlamError(f"ORB-SLAM3 left no result: {(done.stderr or done.stdout).strip()[-300:]}")
        found = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    poses = [np.array(p) if ok and p is not None else None for p, ok in zip(found["poses"], found["tracked"])]
    return Times(found["wall"], found["cpu"], poses)


def settings(rig: StereoRig, frames: list[StereoFrame], features: int) -> str:
    """ORB-SLAM3's settings for a rectified rig in their old form: real numbers have a point."""
    camera = rig.left
    rate = (len(frames) - 1) / (frames[-1].stamp - frames[0].stamp)
    values = {
        "Camera.type": '"PinHole"', "Camera.fx": camera.fu, "Camera.fy": camera.fv, "Camera.cx": camera.u0,
        "Camera.cy": camera.v0, "Camera.k1": 0.0, "Camera.k2": 0.0, "Camera.p1": 0.0, "Camera.p2": 0.0,
        "Camera.bf": camera.fu * rig.baseline, "Camera.width": rig.width, "Camera.height": rig.height,
        "Camera.fps": float(rate), "Camera.RGB": 1, "ThDepth": 40.0, "ORBextractor.nFeatures": features,
        "ORBextractor.scaleFactor": 1.2, "ORBextractor.nLevels": 8, "ORBextractor.iniThFAST": 20,
        "ORBextractor.minThFAST": 7, "Viewer.KeyFrameSize": 0.05, "Viewer.KeyFrameLineWidth": 1.0,
        "Viewer.GraphLineWidth": 0.9, "Viewer.PointSize": 2.0, "Viewer.CameraSize": 0.08,
        "Viewer.CameraLineWidth": 3.0, "Viewer.ViewpointX": 0.0, "Viewer.ViewpointY": -0.7,
        "Viewer.ViewpointZ": -1.8, "Viewer.ViewpointF": 500.0,
    }  # fmt: skip
    return "%YAML:1.0\n" + "".join(f"{key}: {float(v)!r}\n" if isinstance(v, float) else f"{key}: {v}\n"
                                   for key, v in values.items())  # fmt: skip


def rows(size: Size, times: dict[str, Times]) -> Iterable[list[str]]:
    """A row for each, medians over the frames that count."""
    sequence, last = open_sequence(size.sequence), slice(size.skipped, None)
    stamps = np.array([f.stamp for f in sequence.frames(0, size.skipped + size.counted)])
    medians = {name: t.medians(last) for name, t in times.items()}
    for name, t in times.items():
        ratios = [medians[name] / medians[other] if other in medians else None for other in (SIFT, ORBSLAM3)]
        seen = np.array([p is not None for p in t.poses])
        ate = "–"
        if name != SIFT and seen.sum() > 2 and sequence.ground_truth is not None:
            path = Trajectory(stamps[seen], np.array([p for p in t.poses if p is not None]))
            own, true = associate(path, sequence.ground_truth)
            ate = f"{1e3 * absolute_errors(own, true).rmse:.1f}"
        figures = [f"{x:.2f}" for r in ratios for x in ((np.nan, np.nan) if r is None else r)]
        lost = "–" if name == SIFT else str(int((~seen).sum()))
        yield [size.name, name, *(f"{x:.0f}" for x in medians[name]), *figures, lost, ate]


def main() -> int:
    parser = script_options(__file__, __doc__, "a few frames of the smallest images: does it work?")
    python = os.environ.get("ORBSLAM3")
    parser.add_argument("--orbslam3", metavar="PYTHON", default=python, help="interpreter that has orbslam3-python")
    arguments = parser.parse_args()
    table: list[list[str]] = []
    by_way: list[list[str]] = []
    for size in sizes(arguments.quick)[-1 if arguments.quick else 0 :]:
        table += rows(size, measure(size, arguments.orbslam3))
        by_way += ways(size)
    load = f"Load of the machine in the last minute: {os.getloadavg()[0]:.1f}, of {os.cpu_count()} cores."
    print(markdown(HEADER, table, 2), markdown(WAYS, by_way, 2), load, sep="\n\n")
    write_json(arguments.out / "table.json", HEADER, table)
    write_json(arguments.out / "ways.json", WAYS, by_way)
    return 0


if __name__ == "__main__":
    sys.exit(main())
