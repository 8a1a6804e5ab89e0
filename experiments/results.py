"""The results page and the gallery: every experiment in one command, its tables and figures with what the papers had.

    SLAM_DATA=/path/to/data python experiments/results.py [--quick] [--only NAME …] [--out DIR] [--page FILE]
        [--processes N] [--resume]

Runs the scripts beside this one, each with a folder of its own; what a script prints as Markdown is its section of the
page, and the pictures that it leaves are copied beside the page. A script that fails is said on the page, and the exit
status is 1; the others run all the same. ``--processes 2`` runs two at once, which spoils their times. ``--only``
replaces the sections of some scripts and leaves the others of the page as they are. ``--resume`` takes from its folder
what ran to its end in an earlier call with the same code and versions, and runs the rest. The
pictures make up the gallery, ``gallery.md`` beside the page.
"""

from __future__ import annotations

import argparse
import ast
import json
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
from experiments.explanations import caption, explained
from slam.compare.revision import made_with
from slam.run.repeat import versions

ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Experiment:
    """A script beside this one.

    Attributes:
        name: of the script, without ``.py``.
        title: heading of its section.
        paper: what the paper had; empty for our own.
        pictures: of those that it leaves, the ones to be shown, as patterns.
        arguments: of its long form.
    """

    name: str
    title: str
    paper: str = ""
    pictures: tuple[str, ...] = ("*.png",)
    arguments: tuple[str, ...] = ()

    def command(self, quick: bool) -> list[str]:
        """Script and arguments, without the folder."""
        return [f"experiments/{self.name}.py", *(["--quick"] if quick else self.arguments)]


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
    Experiment("consistency", "Do the back ends know how sure they are?", arguments=("--seeds", "30")),
    Experiment("long_run", "Cost growth: time and memory along a walk", arguments=("--frames", "4000")),
    Experiment("cost", "What a frame costs, next to others", "", ("growth.png",)),
    Experiment(
        "policies", "Policies of map management", arguments=("--frames", "930:1050", "--seeds", "6", "--processes", "1")
    ),
    Experiment("faults", "Blackout, dropped frames, a kidnapped camera"),
    Experiment("frame_rate", "What a frame rate costs in accuracy"),
    Experiment("informative", "How many measurements a frame needs", "", ("informative.png",)),
    Experiment("ablation", "What each part is worth"),
    Experiment("starry_night", "Starry Night: stereo observations and a known state"),
    Experiment(
        "loops", "Long drives that come back: loops closed",
        arguments=("--paths", "00", "05", "06", "07", "09", "--set", *loops.QUICK),
    ),
    Experiment(
        "recorded_tracks", "Recorded tracks of a drive, with more and more wrong matches",
        arguments=("--wrong", "0", "0.05", "0.1", "0.2", "--seeds", "5", "--moved", "0", "-0.19"),
    ),
    Experiment("calibration", "Self-calibration: wrong rigs, and one rig on two drives"),
    Experiment("residuals", "Errors of pixels that last"),
    Experiment("whole_drives", "Real drives many times over, to their end"),
    Experiment("perturbations", "Real drives many times over, and spoilt"),
    Experiment("real_sequences", "Real sequences"),
)  # fmt: skip


#: Those whose pictures are among the documentation's.
WORLDS = ("aisle", "box", "boxes", "desk", "field", "people", "startup", "street")


def run(experiment: Experiment, out: Path, quick: bool) -> tuple[str, str]:
    """Run a script: what it printed, and why it failed (empty where it did not)."""
    script = ROOT / "experiments" / f"{experiment.name}.py"
    if not script.exists():
        return "", "there is no such script"
    command = [sys.executable, *experiment.command(quick), "--out", str(out)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=ROOT)
    if done.returncode:
        lines = [line for line in done.stderr.splitlines() if line.strip()]
        return done.stdout, f"exit status {done.returncode}: {lines[-1] if lines else 'nothing was said'}"
    return done.stdout, ""


def printed_by(experiment: Experiment, folder: Path, quick: bool, resume: bool) -> tuple[str, str]:
    """What a script prints, now or in an earlier call of the same code, and why it failed; kept beside its files."""
    out = (folder / experiment.name).absolute()
    out.mkdir(parents=True, exist_ok=True)
    kept = out / "printed.json"
    made = {"command": experiment.command(quick), "versions": made_with([ROOT / "experiments"])}
    if resume and kept.exists():
        before = json.loads(kept.read_text(encoding="utf-8"))
        if before["made"] == made:
            return before["printed"], ""
        print(f"{experiment.name}: made by other code, run again", file=sys.stderr, flush=True)
    for left in [kept, *out.glob("*.png")]:
        left.unlink(missing_ok=True)
    print(f"{experiment.name} …", file=sys.stderr, flush=True)
    began = time.monotonic()
    printed, failure = run(experiment, out, quick)
    ended = failure or f"done in {time.monotonic() - began:.0f} s"
    print(f"{experiment.name}: {ended}", file=sys.stderr, flush=True)
    if not failure:
        kept.write_text(json.dumps({"made": made, "printed": printed}, indent=2) + "\n", encoding="utf-8")
    return printed, failure


def described(experiment: Experiment) -> str:
    """What a script is about: the first paragraph of its docstring."""
    script = ROOT / "experiments" / f"{experiment.name}.py"
    text = ast.get_docstring(ast.parse(script.read_text(encoding="utf-8"))) if script.exists() else None
    return " ".join((text or "").split("\n\n")[0].split())


def copied_pictures(experiment: Experiment, out: Path, page: Path) -> list[str]:
    """Markdown for the pictures that a script has left; they go to ``images/results`` beside the page."""
    shown = []
    for picture in sorted({p for pattern in experiment.pictures for p in out.glob(pattern)}):
        target = page.parent / "images" / "results" / f"{experiment.name}_{picture.name}"
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(picture, target)
        said = caption(experiment.name, picture.stem)
        image = f"![{said or f'{experiment.title}: {picture.stem}'}](images/results/{target.name})"
        shown.append(f"{image}\n\n*{said}*" if said else image)
    return shown


def section(experiment: Experiment, printed: str, failure: str, pictures: Sequence[str], quick: bool) -> str:
    """A script's section of the page."""
    lines = [f"## {experiment.title}", "", described(experiment), ""]
    if experiment.paper:
        lines += [f"**The paper:** {experiment.paper}", ""]
    if failure:
        lines += [f"**Failed:** {failure}", ""]
    lines += [explained(experiment.name, printed), "", demoted(printed), ""]
    for picture in pictures:
        lines += [picture, ""]
    lines += [f"`python {' '.join(experiment.command(quick))}`", ""]
    return "\n".join(lines)


def with_sections(page: str, chosen: Sequence[Experiment], sections: Sequence[str]) -> str:
    """A page with the sections of some experiments replaced, or added at its end; the others stay as they are."""
    parts = page.split("\n## ")
    for experiment, text in zip(chosen, sections):
        new = text.removeprefix("## ").rstrip("\n") + "\n"
        at = next((i for i, part in enumerate(parts) if part.split("\n")[0] == experiment.title), None)
        if at is None:
            parts.append(new)
        else:
            parts[at] = new
    return "\n## ".join(parts)


def gallery(pictures: Sequence[tuple[Experiment, Sequence[str]]]) -> str:
    """The page of pictures; of the worlds and the demo they are there already."""
    lines = [
        "# Gallery", "",
        "Pictures of the experiments, the demo and the worlds. [Results](results.md) says what each picture of an "
        "experiment shows. Written by `python experiments/results.py`.", "",
    ]  # fmt: skip
    for experiment, shown in pictures:
        if shown:
            lines += [f"## {experiment.title}", "", *(line for picture in shown for line in (picture, ""))]
    lines += [
        "## The demo", "",
        "`slam demo`: the map of the bookshelf aisle that each back end makes. Red triangles: measured in the last "
        "frame; grey: landmarks of before; the squared line is the box.",
        "", "![Top view of both maps](images/demo_top_view.png)", "",
        "## The worlds", "", "Drawn by `python docs/make_world_pictures.py`; see [worlds](worlds.md).", "",
    ]  # fmt: skip
    return "\n".join([*lines, *(f"![{name}](images/worlds/{name}.jpg)" for name in WORLDS), ""])


def demoted(text: str) -> str:
    """Markdown whose headings stand below the section's."""
    return "\n".join(f"##{line}" if line.startswith("#") else line for line in text.strip().splitlines())


def head(quick: bool) -> str:
    """Title, and with what the page was made."""
    used = ", ".join(f"{name} {version}" for name, version in versions().items())
    short = " in its short form, which shows that everything runs, and no more" if quick else ""
    return (
        "# Results\n\nBoth papers' experiments and our own. Papers A and B: see [the papers](papers.md); errors, "
        "covariances and NEES: see [concepts](concepts.md). A click on *What the columns say* explains the tables of a "
        "section, and its last line is the command that makes it.\n\nThis page is written by "
        f"`python experiments/results.py`{short}; nothing in it is typed in. With {used}.\n"
    )


def summary() -> str:
    """The section that the page begins with: the README's results, whose figures tests compare with the others."""
    text = (ROOT / "README.md").read_text(encoding="utf-8").partition("\n## Results\n")[2].partition("\n## ")[0]
    return "## In short\n" + text.replace("](docs/results.md#", "](#").replace("](docs/", "](").rstrip("\n") + "\n"


def with_summary(page: str) -> str:
    """A page that begins with the present summary."""
    first, *parts = page.split("\n## ")
    parts = [part for part in parts if not part.startswith("In short\n")]
    return "\n## ".join([first, summary().removeprefix("## "), *parts])


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="every script in its short form")
    parser.add_argument("--only", nargs="*", choices=[e.name for e in EXPERIMENTS], help="these scripts alone")
    parser.add_argument("--out", type=Path, default=Path("results"), help="folder for what the scripts leave")
    parser.add_argument("--page", type=Path, default=ROOT / "docs" / "results.md", help="the page")
    parser.add_argument("--processes", type=int, default=1, help="how many scripts run at once")
    parser.add_argument("--resume", action="store_true", help="take what the same code has left in --out")
    given = parser.parse_args(arguments)
    chosen = [e for e in EXPERIMENTS if not given.only or e.name in given.only]
    with ThreadPoolExecutor(given.processes) as pool:
        outcomes = list(pool.map(lambda e: printed_by(e, given.out, given.quick, given.resume), chosen))
    pictures = [(e, copied_pictures(e, given.out / e.name, given.page)) for e in chosen]
    sections = [section(e, *outcome, shown, given.quick) for (e, shown), outcome in zip(pictures, outcomes)]
    failed = [e.name for e, (_, failure) in zip(chosen, outcomes) if failure]
    given.page.parent.mkdir(parents=True, exist_ok=True)
    if given.only and given.page.exists():
        page = with_sections(given.page.read_text(encoding="utf-8"), chosen, sections)
    else:
        page = "\n".join([head(given.quick), *sections])
    given.page.write_text(with_summary(page), encoding="utf-8")
    if not given.only:  # a part of the pictures would be no gallery
        given.page.with_name("gallery.md").write_text(gallery(pictures), encoding="utf-8")
    print(f"{len(sections)} experiments, {len(failed)} failed. Page: {given.page}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
