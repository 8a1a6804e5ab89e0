"""The results page: every experiment in one command, its tables and figures with what the papers had.

    SLAM_DATA=/path/to/data python experiments/results.py [--quick] [--only NAME …] [--out DIR] [--page FILE]
        [--processes N] [--resume]

Runs the scripts beside this one, each with a folder of its own; what a script prints as Markdown is its section of the
page, and the pictures that it leaves are copied beside the page. A script that fails is said on the page, and the exit
status is 1; the others run all the same. ``--processes 2`` runs two at once, which spoils their times; ``--resume``
takes what ran to its end in an earlier call, of the same code, from its folder.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from slam.runner import versions

ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Experiment:
    """A script beside this one.

    Attributes:
        name: of the script, without ``.py``.
        title: heading of its section.
        paper: what the paper had; empty for our own.
        pictures: of those that it leaves, the ones to be shown, as patterns.
    """

    name: str
    title: str
    paper: str = ""
    pictures: tuple[str, ...] = ("*.png",)


EXPERIMENTS = (
    Experiment(
        "detector", "D_threshold, octaves, radius (A, III.A)",
        "One 320x240 webcam image: 837 features at D_threshold 0, 41 at 10000; "
        "radii grow with the octave and numbers fall; octaves 3 and 4 are left out.",
    ),
    Experiment(
        "descriptors", "16 and 64 dimensions, known points (A, III.B, first experiment)",
        "16-D takes 45 % less time for 100 to 800 features, and is best in the estimation of known points; no figures "
        "of the latter are printed.",
    ),
    Experiment(
        "aisle", "The bookshelf aisle (A, V, Figs. 5 and 6)",
        "1524 frames, 318 landmarks, about 10 features used per frame; mean pose deviation under 1.5 cm, peak 3 cm; no "
        "ground truth is named.",
    ),
    Experiment(
        "startup", "Start-up from stored features (B, 4.2, Fig. 6)",
        "Camera truly at [3, −70, 2.7] cm, started at [0, 0, 0]: stopped at [0, −55.8, 3.7], 15 cm off.",
    ),
    Experiment(
        "walking_robot", "Walking robot (B, 4.3, Fig. 8)", "Map and states in 3D; no ground truth, no figures.",
        ("map_3d.png", "errors.png"),
    ),
    Experiment(
        "moving_objects", "Moving box, moving objects (B, 4.4, Table 1, Fig. 10)",
        "A box at four places by three features; Table 1 prints roll, pitch, yaw and translation, no ground truth.",
    ),
    Experiment("consistency", "Do the back ends know how sure they are?"),
    Experiment("policies", "Policies of map management"),
    Experiment("faults", "Blackout, dropped frames, a camera that is carried off"),
    Experiment("starry_night", "Starry Night: stereo observations and a known state"),
    Experiment("real_sequences", "Real sequences"),
)  # fmt: skip


def run(experiment: Experiment, out: Path, quick: bool) -> tuple[str, str]:
    """Run a script: what it printed, and why it failed (empty where it did not)."""
    script = ROOT / "experiments" / f"{experiment.name}.py"
    if not script.exists():
        return "", "there is no such script"
    command = [sys.executable, str(script), "--out", str(out), *(["--quick"] if quick else [])]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=ROOT)
    if done.returncode:
        lines = [line for line in done.stderr.splitlines() if line.strip()]
        return done.stdout, f"exit status {done.returncode}: {lines[-1] if lines else 'nothing was said'}"
    return done.stdout, ""


def printed_by(experiment: Experiment, folder: Path, quick: bool, resume: bool) -> tuple[str, str]:
    """What a script prints, now or in an earlier call, and why it failed; it is kept beside its files."""
    out = (folder / experiment.name).absolute()
    out.mkdir(parents=True, exist_ok=True)
    kept = out / ("printed_quick.md" if quick else "printed.md")
    if resume and kept.exists():
        return kept.read_text(encoding="utf-8"), ""
    kept.unlink(missing_ok=True)
    print(f"{experiment.name} …", file=sys.stderr, flush=True)
    printed, failure = run(experiment, out, quick)
    if failure:
        print(f"{experiment.name}: {failure}", file=sys.stderr, flush=True)
    else:
        kept.write_text(printed, encoding="utf-8")
    return printed, failure


def section(experiment: Experiment, printed: str, failure: str, out: Path, page: Path) -> str:
    """A script's section of the page; its pictures go to ``images/results`` beside the page."""
    lines = [f"## {experiment.title}", ""]
    if experiment.paper:
        lines += [f"**The paper:** {experiment.paper}", ""]
    if failure:
        lines += [f"**Failed:** {failure}", ""]
    lines += [demoted(printed), ""]
    for picture in sorted({p for pattern in experiment.pictures for p in out.glob(pattern)}):
        target = page.parent / "images" / "results" / f"{experiment.name}_{picture.name}"
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(picture, target)
        lines += [f"![{experiment.title}: {picture.stem}](images/results/{target.name})", ""]
    lines += [f"`python experiments/{experiment.name}.py`", ""]
    return "\n".join(lines)


def demoted(text: str) -> str:
    """Markdown whose headings stand below the section's."""
    return "\n".join(f"##{line}" if line.startswith("#") else line for line in text.strip().splitlines())


def head(quick: bool) -> str:
    """Title, and with what the page was made."""
    used = ", ".join(f"{name} {version}" for name, version in versions().items())
    short = " in its short form, which shows that everything runs, and no more" if quick else ""
    return (
        "# Results\n\nBoth papers' experiments and our own. This page is written by `python experiments/results.py`"
        f"{short}; nothing in it is typed in. Papers A and B: see [the papers](papers.md). With {used}.\n"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="every script in its short form")
    parser.add_argument("--only", nargs="*", choices=[e.name for e in EXPERIMENTS], help="these scripts alone")
    parser.add_argument("--out", type=Path, default=Path("results"), help="folder for what the scripts leave")
    parser.add_argument("--page", type=Path, default=ROOT / "docs" / "results.md", help="the page")
    parser.add_argument("--processes", type=int, default=1, help="how many scripts run at once")
    parser.add_argument("--resume", action="store_true", help="do not run again what ran to its end in --out")
    given = parser.parse_args(arguments)
    if given.only and given.page == parser.get_default("page"):
        parser.error("--only would leave the other sections out of the page: name another --page")
    chosen = [e for e in EXPERIMENTS if not given.only or e.name in given.only]
    with ThreadPoolExecutor(given.processes) as pool:
        outcomes = list(pool.map(lambda e: printed_by(e, given.out, given.quick, given.resume), chosen))
    sections = [section(e, *outcome, given.out / e.name, given.page) for e, outcome in zip(chosen, outcomes)]
    failed = [e.name for e, (_, failure) in zip(chosen, outcomes) if failure]
    given.page.parent.mkdir(parents=True, exist_ok=True)
    given.page.write_text("\n".join([head(given.quick), *sections]), encoding="utf-8")
    print(f"{len(sections)} experiments, {len(failed)} failed. Page: {given.page}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
