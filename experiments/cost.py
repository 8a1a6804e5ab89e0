"""What a frame costs next to ORB-SLAM3 and SIFT, how that grows, and what a whole run takes.

    [ORBSLAM3=PYTHON] python experiments/cost.py [--quick] [--only NAME ...] [--out DIR]

Runs the benchmarks one after the other and prints what they print, as Markdown. Only ratios from one run can be
compared, and only from a quiet machine; its load is printed with them. ORBSLAM3 names the interpreter of an environment
in which ``orbslam3-python`` is installed (`benchmarks/frame.py`); without it ORB-SLAM3 is left out.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from experiments.common import script_options
from slam.errors import SlamError

ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Part:
    """A benchmark: its script, its heading, what its table says, and what its short form leaves out."""

    script: str
    title: str
    says: str
    short: tuple[str, ...] = ()


PARTS = (
    Part(
        "frame", "Whole frames",
        "Median times of a frame, images in memory, the detector of moving objects on, and their ratios to `cv2.SIFT` "
        "on one image and to ORB-SLAM3 on the same images; with overlap, times from one result to the next. CPU "
        "time adds up all threads.",
    ),
    Part(
        "growth", "How it grows",
        "CPU time over the number of landmarks, features, moving cars and frames, and of what cannot be done without "
        "(floor, dashed): the filter's bare `dsyrk`, gtsam's own calls, SURF alone, no detector.",
    ),
    Part(
        "command", "Whole runs",
        "`slam run` with nothing compiled and once more, and its peak memory.", ("--only", "memory"),
    ),
)  # fmt: skip


def printed_by(part: Part, quick: bool, out: Path) -> str:
    """What a benchmark prints; its files go to a folder of its own."""
    command = [sys.executable, str(ROOT / "benchmarks" / f"{part.script}.py"), "--out", str(out / part.script)]
    command += ["--quick", *part.short] if quick else []
    if part.script == "frame" and os.environ.get("ORBSLAM3"):
        command += ["--orbslam3", os.environ["ORBSLAM3"]]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, env=environment, cwd=ROOT)
    if done.returncode:
        raise SlamError(f"benchmarks/{part.script}.py ended with exit status {done.returncode}")
    return done.stdout.strip()


def main() -> int:
    parser = script_options(__file__, __doc__, "every benchmark in its short form; nothing is compiled again")
    parser.add_argument("--only", nargs="+", choices=[p.script for p in PARTS], help="these benchmarks alone")
    given = parser.parse_args()
    for part in PARTS:
        if given.only and part.script not in given.only:
            continue
        print(f"# {part.title}\n\n{part.says}\n\n{printed_by(part, given.quick, given.out.absolute())}\n")
        load = f"{os.getloadavg()[0]:.1f}, of {os.cpu_count()} cores"
        print(f"`python benchmarks/{part.script}.py`; load of the machine in the last minute: {load}.\n", flush=True)
    picture = given.out / "growth" / "growth.png"
    if picture.is_file():
        shutil.copyfile(picture, given.out / "growth.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
