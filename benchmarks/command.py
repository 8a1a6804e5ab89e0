"""What ``slam run`` costs as a whole: the first run on a machine, the second one, and the memory of a long one.

    python benchmarks/command.py [--quick] [--backend NAME ...] [--only first memory] [--out DIR]

The first run has an empty folder for compiled kernels, the second one what the first has left there; between them,
``cv2.SIFT`` with 800 features on an image of the same size says how fast the machine is at that time. Memory is the
peak of the process after 100 and after 1000 frames: the images of KITTI odometry 06, forwards and backwards again and
again, where SLAM_DATA has them, else a rendered street. Prints Markdown tables.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.frame import KITTI
from experiments.common import script_options
from experiments.tables import markdown, write_json
from slam.errors import SlamError
from slam.registry import ONLINE
from slam.sequences import open_sequence

ROOT = Path(__file__).resolve().parents[1]
DESK = "synthetic:desk?width=752&height=480&frames=20"
FIRST = (
    "back end", "first, wall [s]", "first, CPU [s]", "second, wall [s]", "second, CPU [s]", "more, wall [s]",
    "more, CPU [s]", "cv2.SIFT at 752x480, wall / CPU [ms]",
)  # fmt: skip
MEMORY = ("back end", "sequence", "frames", "peak memory [MB]", "CPU time of the run by frame [ms]")


@dataclass(frozen=True)
class Cost:
    """Of a process and those that it has started: wall and CPU time [s], peak memory [MB]."""

    wall: float
    cpu: float
    peak: float


def cost(arguments: list[str], **environment: str) -> Cost:
    """What ``slam`` with these arguments costs."""
    began, out = time.perf_counter(), subprocess.DEVNULL
    settings = {**os.environ, "PYTHONPATH": str(ROOT), **environment}
    process = subprocess.Popen([sys.executable, "-m", "slam", *arguments], stdout=out, stderr=out, env=settings)
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SlamError(f"slam {' '.join(arguments)}: exit status {process.returncode}")
    return Cost(time.perf_counter() - began, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)


def sift(repeats: int) -> np.ndarray:
    """Wall and CPU time of ``cv2.SIFT`` on an image of 752x480, medians (2,) [ms]."""
    image, detector, times = next(iter(open_sequence(DESK))).left, cv2.SIFT_create(800), []
    for _ in range(repeats):
        start = np.array([time.perf_counter(), time.process_time()])
        detector.detectAndCompute(image, None)
        times.append(1e3 * (np.array([time.perf_counter(), time.process_time()]) - start))
    return np.asarray(np.median(times, axis=0))


def first_run(name: str) -> list[object]:
    """First and second run of a short sequence with one back end, as `FIRST`."""
    with TemporaryDirectory() as folder:
        run = ["run", DESK, "--backend", name, "--quiet", "--out", f"{folder}/run", "--overwrite"]
        first = cost(run, NUMBA_CACHE_DIR=f"{folder}/kernels")
        speed = sift(20)
        second = cost(run, NUMBA_CACHE_DIR=f"{folder}/kernels")
    more = (first.wall - second.wall, first.cpu - second.cpu)
    return [name, first.wall, first.cpu, second.wall, second.cpu, *more, f"{speed[0]:.0f} / {speed[1]:.0f}"]


def there_and_back(recording: Path, folder: Path, frames: int) -> None:
    """A recording of so many frames in KITTI's form: the images of a shorter one, forwards and backwards."""
    folder.mkdir()
    stamps = np.loadtxt(recording / "times.txt")
    once = [*range(len(stamps)), *range(len(stamps) - 2, 0, -1)]
    chosen = [once[k % len(once)] for k in range(frames)]
    for side in ("image_0", "image_1"):
        images = sorted((recording / side).iterdir())
        (folder / side).mkdir()
        for k, i in enumerate(chosen):
            (folder / side / f"{k:06d}{images[i].suffix}").symlink_to(images[i])
    np.savetxt(folder / "times.txt", np.median(np.diff(stamps)) * np.arange(frames))
    shutil.copyfile(recording / "calib.txt", folder / "calib.txt")


def memory(name: str, frames: int) -> list[object]:
    """Peak memory of a run, as `MEMORY`."""
    data = Path(os.environ.get("SLAM_DATA", ""), KITTI).absolute()
    with TemporaryDirectory() as folder:
        sequence, said = f"synthetic:street?width=1226&height=370&frames={frames}", "street, 1226x370"
        if data.is_dir():
            sequence, said = str(Path(folder, "drive")), "KITTI 06, there and back"
            there_and_back(data, Path(sequence), frames)
        used = cost(["run", sequence, "--backend", name, "--quiet", "--out", f"{folder}/run"])
    return [name, said, frames, round(used.peak), 1e3 * used.cpu / frames]


def main() -> int:
    parser = script_options(__file__, __doc__, "memory alone, after 10 frames with one back end")
    parser.add_argument("--backend", nargs="+", choices=ONLINE, default=ONLINE, help="these alone")
    parser.add_argument("--only", nargs="+", choices=("first", "memory"), default=("first", "memory"))
    given = parser.parse_args()
    if "first" in given.only and not given.quick:
        table = [first_run(name) for name in given.backend]
        print(markdown(FIRST, table) + "\n", flush=True)
        write_json(given.out / "first.json", FIRST, table)
    if "memory" in given.only:
        names, numbers = (given.backend[:1], (10,)) if given.quick else (given.backend, (100, 1000))
        table = [memory(name, n) for name in names for n in numbers]
        print(markdown(MEMORY, table, 2), flush=True)
        write_json(given.out / "memory.json", MEMORY, table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
