"""The results: every experiment in one command, its tables and figures with what the papers had, a page per question.

    SLAM_DATA=/path/to/data python experiments/results.py [--quick] [--only NAME …] [--out DIR] [--page FILE]
        [--processes N]

Runs the scripts beside this one and the benchmarks, each with a folder of its own. What a script prints as Markdown is
its section of a page in the folder ``results`` beside the first page, and the pictures that it leaves are copied there.
A script that fails is said on its page, and the exit status is 1; the others run all the same. ``--processes 2`` runs
two at once, which spoils their times. ``--only`` replaces the sections of some scripts and leaves the others.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from experiments import loops
from slam.run.options import versions

ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Experiment:
    """A script."""

    name: str  # without ``.py``
    page: str  # one of `PAGES`
    title: str  # heading of its section
    paper: str = ""  # what the paper had; empty for our own
    pictures: dict[str, str] | None = None  # captions of those that are shown, by name
    arguments: tuple[str, ...] = ()  # of its long form
    left_out: tuple[str, ...] = ()  # columns that are not shown on the page; they are in the files that it leaves
    folder: str = "experiments"
    says: str = ""  # what its table says, where it does not say so itself

    def command(self, quick: bool) -> list[str]:
        """Script and arguments, without the folder for what it leaves."""
        return [f"{self.folder}/{self.name}.py", *(["--quick"] if quick else self.arguments)]


#: Title and question of each page, and the answer in short, by its name.
PAGES = {
    "recordings": (
        "Real recordings",
        "How far from the truth are paths on real drives, and what is each part worth?",
        "Centimetres on the shorter drives, some decimetres on the longest, whose truth is hardly better. "
        "Self-calibration is worth most; the path hardly needs the detector of moving objects.",
    ),
    "honesty": (
        "Covariances",
        "Do the back ends know how sure they are, also with a wrong calibration?",
        "They do in worlds: NEES is in its band, along a corridor of a thousand frames too, and errors of filter and "
        "window are near the Cramér-Rao bound. Self-calibration finds a wrong rig within its uncertainty.",
    ),
    "papers": (
        "The papers' experiments",
        "What did the papers find, and what is found here?",
        "Features, savings of the short descriptor, and the map of the aisle are as in the papers; the path is twice "
        "as near, and a wrong start is mended in one frame. The short descriptor makes no map better or worse.",
    ),
    "objects": (
        "Moving objects",
        "Are bodies found without being told, and how well are their motions known?",
        "All are found within some frames, their motions known to millimetres and tenths of a degree a frame, cars' "
        "speeds to a hundredth. Their covariances are too small. What the paper's own procedure sees is far off.",
    ),
    "loops": (
        "Loops",
        "What does closing loops give on long drives that come back?",
        "The final path over kilometres is within some decimetres, in most cases several times nearer than without; no "
        "loop is false.",
    ),
    "faults": (
        "Faults",
        "What do blackouts, lost frames, a kidnapped camera, and spoilt images do?",
        "After each of them the camera is tracked again within some frames, and the path stays within centimetres; "
        "carried to an unknown place, within a decimetre or so.",
    ),
    "cost": (
        "Cost",
        "What does a frame cost, next to others?",
        "On a drive about a third of the CPU time of SIFT for one image, on small images nearly as much, however long "
        "the run.",
    ),
}
ERRORS = "Error of the online pose (solid), and the standard deviation that is claimed (dashed)."
EXPERIMENTS = (
    Experiment(
        "real_sequences", "recordings", "Real sequences", says="One run each, over all frames.",
        pictures={"paths": "From above, aligned with the true ones."},
    ),
    Experiment("bars", "recordings", "The back ends beside each other", left_out=("window / better",)),
    Experiment(
        "slide", "recordings", "The slide of features",
        says="Distance of a left pixel from the epipolar line of an earlier one of the same landmark [px], by the "
        "angle between the two lines of sight. The variance grows with that angle, as by a random walk of 3 px / √rad "
        "on drives. Features of MH_01 are aligned with their first sight.",
    ),
    Experiment(
        "ablation", "recordings", "What each part is worth", left_out=("largest", "larger in", "NEES"),
        says="Ratios to a run of `ekf` with everything on: medians over the trials, means over the sequences.",
    ),
    Experiment(
        "knee", "recordings", "How many features and landmarks",
        left_out=("largest", "±", "ekf", "window", "CPU window", "bodies", "measured"),
        says="Ratios to 600 (handheld 800) features, and to 100 (handheld 80) landmarks in view.",
    ),
    Experiment(
        "consistency", "honesty", "Do the back ends know how sure they are?", arguments=("--seeds", "30"), pictures={
            "consistency": "Above: error of the newest position and the bound. Below: NEES of its pose and the band."
        }, says="Errors, also over the Cramér-Rao bound, and how many times as large a tenth of wrong matches makes "
        "them; whether covariances hold. The bound of `drawn` is a mean over paths that differ, which an estimator "
        "with the right prior may go below. The smoother's [smart factors end](../estimators.md#smoother) while "
        "landmarks stay in view.",
    ),
    Experiment(
        "corridor", "honesty", "The camera along a corridor without end", arguments=("--seeds", "8"), pictures={
            "corridor": "Left: mean NEES and its band. Right: what is claimed of the heading, which nothing measures."
        }, left_out=("lost updates",),
    ),
    Experiment(
        "calibration", "honesty", "Self-calibration: wrong rigs, and one rig on two drives",
        left_out=("ratio", "parameter"),
    ),
    Experiment(
        "detector", "papers", "D_threshold, octaves, radius (A, III.A)",
        "One 320x240 webcam image: 837 features at D_threshold 0, 41 at 10000; "
        "radii grow with the octave and numbers fall; octaves 3 and 4 are left out.",
        {"detector": "Left: features found with a threshold, by octave. Middle: time to detect them. Right: radii."},
    ),
    Experiment(
        "descriptors", "papers", "16 and 64 dimensions, known points (A, III.B, first experiment)",
        "16-D takes 45 % less time for 100 to 800 features, and is best in the estimation of known points; no figures "
        "of the latter are printed.",
    ),
    Experiment(
        "aisle", "papers", "The bookshelf aisle (A, V, Figs. 5 and 6)",
        "1524 frames, 318 landmarks, about 10 features used per frame; mean pose deviation under 1.5 cm, peak 3 cm; no "
        "ground truth is named.",
        {
            "errors": ERRORS,
            "top_view": "The map from above with ellipses of two standard deviations (paper A, Fig. 6).",
        },
    ),
    Experiment(
        "startup", "papers", "Start-up from stored features (B, 4.2, Fig. 6)",
        "Camera truly at [3, −70, 2.7] cm, started at [0, 0, 0]: stopped at [0, −55.8, 3.7], 15 cm off.",
        {"startup": "Left and middle: from three wrong starts to the true place in one frame. Right: the error then."},
    ),
    Experiment(
        "moving_objects", "objects", "Moving box, moving objects (B, 4.4, Table 1, Fig. 10)",
        "A box at four places by three features; Table 1 prints roll, pitch, yaw and translation, no ground truth.",
        {"box": "Error of the box's pose while it moves and rests, body frames aligned once."},
        left_out=("runs", "other ids", "body", "cyclist"),
    ),
    Experiment(
        "loops", "loops", "Long drives that come back: loops closed",
        arguments=("--paths", "00", "05", "06", "07", "09", "--set", *loops.QUICK),
        pictures={"loops": "From above: true, without loops, and at the end with loops; circles: loops closed."},
        left_out=("longest frame with a loop [ms]",),
    ),
    Experiment(
        "faults", "faults", "Blackout, dropped frames, a kidnapped camera",
        pictures={"faults": "Error of the position, frame by frame; the fault is grey."}, left_out=("states",),
    ),
    Experiment("perturbations", "faults", "Real drives many times over, and spoilt"),
    Experiment(
        "frame", "cost", "Whole frames", folder="benchmarks",
        says="Median times of a frame, images in memory, the detector of moving objects on, and their ratios to "
        "`cv2.SIFT` on one image and to ORB-SLAM3 on the same images; with overlap, times from one result to the next. "
        "CPU time adds up all threads.",
        left_out=("ATE [mm]", "frames lost", "wall [ms]", "wall / SIFT", "wall / ORB-SLAM3"),
    ),
    Experiment(
        "command", "cost", "Whole runs", folder="benchmarks",
        says="`slam run` with nothing compiled and once more, and its peak memory.",
        left_out=("cv2.SIFT at 752x480, wall / CPU [ms]",),
    ),
)  # fmt: skip

#: What the first page shows: of which experiment, which picture.
SHOWN = (("real_sequences", "paths"), ("consistency", "consistency"), ("aisle", "top_view"))


def run(experiment: Experiment, folder: Path, quick: bool) -> tuple[str, str]:
    """Run a script: what it printed, and why it failed (empty where it did not)."""
    out = (folder / experiment.name).absolute()
    out.mkdir(parents=True, exist_ok=True)
    for left in out.glob("*.png"):
        left.unlink()
    print(f"{experiment.name} …", file=sys.stderr, flush=True)
    began = time.monotonic()
    command = [sys.executable, *experiment.command(quick), "--out", str(out)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=ROOT)
    lines = [line for line in done.stderr.splitlines() if line.strip()] or ["nothing was said"]
    failure = f"exit status {done.returncode}: {lines[-1]}" if done.returncode else ""
    took = failure or f"done in {time.monotonic() - began:.0f} s"
    print(f"{experiment.name}: {took}", file=sys.stderr, flush=True)
    return done.stdout, failure


def readable(text: str, left_out: Sequence[str] = ()) -> str:
    """Tables without some columns (without the first: not at all), and first cells only where they change."""
    out: list[str] = []
    kept, before = None, ""
    for line in text.splitlines():
        if not line.startswith("|"):
            kept, before = None, ""
            out.append(line)
            continue
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
        if kept is None:
            kept = [i for i, name in enumerate(cells) if name not in left_out]
        if 0 not in kept:
            continue
        cells = [cells[i] for i in kept]
        before, first = cells[0], "" if cells[0] == before and len(kept) > 2 else cells[0]
        out.append(f"| {' | '.join([first, *cells[1:]])} |".replace("|  |", "| |"))
    return "\n".join(out)


def copied_pictures(experiment: Experiment, out: Path, page: Path) -> list[str]:
    """Markdown for the pictures that a script has left; they go to ``images/results`` beside the first page."""
    shown = []
    for name, said in (experiment.pictures or {}).items():
        target = page.parent / "images" / "results" / f"{experiment.name}_{name}.png"
        if (out / f"{name}.png").exists():
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(out / f"{name}.png", target)
            shown.append(f"![{name}](../images/results/{target.name})\n\n*{said}*")
    return shown


def section(experiment: Experiment, printed: str, failure: str, pictures: Sequence[str], quick: bool) -> str:
    """A script's section of its page; headings that it printed stand below the section's."""
    text = "\n".join(f"##{line}" if line.startswith("#") else line for line in printed.strip().splitlines())
    text = readable(text, experiment.left_out)
    parts = [f"## {experiment.title}"]
    parts += [f"**The paper:** {experiment.paper}"] if experiment.paper else []
    parts += [experiment.says] if experiment.says else []
    parts += [f"**Failed:** {failure}"] if failure else []
    return "\n\n".join([*parts, text, *pictures, f"`python {' '.join(experiment.command(quick))}`\n"])


def with_section(page: str, title: str, text: str) -> str:
    """A page with the section of this title replaced, or added at its end; the others stay as they are."""
    parts = page.rstrip("\n").split("\n## ")
    at = next((i for i, part in enumerate(parts) if part.split("\n")[0] == title), len(parts))
    parts[at : at + 1] = [text.removeprefix("## ").rstrip("\n") + "\n"]
    return "\n## ".join(part.rstrip("\n") + "\n" for part in parts)


def page_head(name: str, quick: bool) -> str:
    """Title, question, and the answer in short."""
    title, question, answer = PAGES[name]
    answer = "In the short form, which shows that everything runs, and no more." if quick else answer
    return f"# {title}\n\n{question} {answer}\n"


def first_page() -> str:
    """A screen: the README's table of recordings; pictures; the pages."""
    text = (ROOT / "README.md").read_text(encoding="utf-8").partition("\n## Results\n")[2].partition("\n## ")[0]
    recordings = text.strip().partition("\n\n| on these drives")[0].replace("](docs/", "](")
    captions = {(e.name, name): said for e in EXPERIMENTS for name, said in (e.pictures or {}).items()}
    pictures = [f"![{captions.get(shown, shown[0])}](images/results/{'_'.join(shown)}.png)" for shown in SHOWN]
    pages = [f"- [{title}](results/{name}.md): {question}" for name, (title, question, _) in PAGES.items()]
    used = ", ".join(f"{package} {version}" for package, version in versions().items())
    made = f"Terms are those of [concepts](concepts.md). Written by `python experiments/results.py`, with {used}."
    return "\n\n".join(["# Results", recordings, *pictures, "\n".join(pages), made]) + "\n"


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="every script in its short form")
    parser.add_argument("--only", nargs="*", choices=[e.name for e in EXPERIMENTS], help="these scripts alone")
    parser.add_argument("--out", type=Path, default=Path("results"), help="folder for what the scripts leave")
    parser.add_argument("--page", type=Path, default=ROOT / "docs" / "results.md", help="the first page")
    parser.add_argument("--processes", type=int, default=1, help="how many scripts run at once")
    given = parser.parse_args(arguments)
    chosen = [e for e in EXPERIMENTS if not given.only or e.name in given.only]
    with ThreadPoolExecutor(given.processes) as pool:  # the last ones take longest
        outcomes = list(pool.map(lambda e: run(e, given.out, given.quick), chosen[::-1]))[::-1]
    folder = given.page.with_name("results")
    folder.mkdir(parents=True, exist_ok=True)
    for name in dict.fromkeys(e.page for e in chosen):
        file = folder / f"{name}.md"
        text = file.read_text(encoding="utf-8") if given.only and file.exists() else page_head(name, given.quick)
        for experiment, outcome in zip(chosen, outcomes):
            if experiment.page == name:
                pictures = copied_pictures(experiment, given.out / experiment.name, given.page)
                text = with_section(text, experiment.title, section(experiment, *outcome, pictures, given.quick))
        file.write_text(text, encoding="utf-8")
    given.page.write_text(first_page(), encoding="utf-8")
    failed = sum(bool(failure) for _, failure in outcomes)
    print(f"{len(chosen)} experiments, {failed} failed. Pages: {folder}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
