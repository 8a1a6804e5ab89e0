"""The back ends beside each other: medians over perturbations. Tests on recordings allow half as much more.

    SLAM_DATA=/path/to/data python experiments/bars.py [--quick] [--trials 5] [--sequences NAME …] [--out DIR]

Recordings and worlds with the usual settings, each time with another first frame, pixel noise, and number of features
(`experiments/perturbations.py`), worlds with another seed, too: the error of the online and of the final path.
Writes ``bars.json``, whose place is ``tests/bars.json``, and prints it as a Markdown table; with ``--trials 0`` what is
there already.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from experiments.ablation_parts import CASES, USUAL, Case, error_of, opened
from experiments.common import path_of, script_options
from experiments.perturbations import NONE, features_of, frames_of
from experiments.tables import markdown
from frontends import create
from slam.config import SystemConfig
from slam.data import FrameResult, StereoFeatures
from slam.interfaces import Frontend
from slam.sequences import Sequence
from slam.system import StereoSlam

BACKENDS = ("ekf", "smoother", "window")
ROOM = 1.5  # of a test, times the median
FILE = Path(__file__).resolve().parents[1] / "tests" / "bars.json"

Medians = dict[str, dict[str, dict[str, float]]]


def bars(name: str) -> dict[str, dict[str, float]]:
    """What a test allows, by back end and figure [m]: `ROOM` times the medians of a recording."""
    medians: Medians = json.loads(FILE.read_text(encoding="utf-8"))
    return {b: {f: ROOM * value for f, value in figures.items()} for b, figures in medians[name].items()}


def perturbed(case: Case, sequence: Sequence, trial: int) -> tuple[Frontend, list[StereoFeatures]]:
    """The front end of one trial, and what it finds."""
    options = {**SystemConfig.for_kind(sequence.kind).frontend, "features": features_of(sequence, trial)}
    frontend = create("surf", sequence.rig, **options)
    return frontend, [frontend.extract(frame) for frame in frames_of(sequence, NONE, case.frames, trial)]


def errors(
    case: Case, sequence: Sequence, frontend: Frontend, features: list[StereoFeatures], backend: str
) -> tuple[dict[str, float], list[FrameResult]]:
    """The error of the online and of the final path of one back end [m], and the results of the frames."""
    system = StereoSlam(sequence.rig, frontend, backend, config=USUAL.config(sequence, case, backend))
    results = [system.process_features(one) for one in features]
    paths = {"online": path_of(results, measured=True), "final": system.trajectory()}
    return {name: error_of(path, sequence) for name, path in paths.items()}, results


def _medians(trials: list[dict[str, dict[str, float]]]) -> dict[str, dict[str, float]]:
    """Of each back end and figure."""
    first = trials[0]
    return {b: {f: round(float(np.median([t[b][f] for t in trials])), 6) for f in first[b]} for b in first}


def table(found: Medians) -> str:
    """The medians [mm], and those of the window in units of the better of the others."""
    rows = []
    for name, medians in found.items():
        for figure in ("online", "final"):
            errors_ = [medians[b][figure] for b in BACKENDS]
            ratio = errors_[2] / min(errors_[:2])
            rows.append([name if figure == "online" else "", figure, *(f"{1e3 * e:.3g}" for e in errors_), ratio])
    return markdown(("sequence", "path", *BACKENDS, "window / better"), rows, 2)


def main() -> int:
    parser = script_options(__file__, __doc__, "one trial of twelve frames of one sequence")
    parser.add_argument("--trials", type=int, default=5)
    parser.add_argument("--sequences", nargs="*", metavar="NAME", help="these alone; a file in DIR keeps its others")
    parser.add_argument("--backends", nargs="*", default=BACKENDS, metavar="NAME", help="these alone, likewise")
    given = parser.parse_args()
    trials, file = 1 if given.quick else given.trials, given.out / "bars.json"
    found: Medians = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
    for case in [replace(CASES[0], frames=12)] if given.quick else CASES:
        if given.sequences and case.name not in given.sequences:
            continue
        runs = []
        for trial in range(min(trials, case.trials)):
            sequence = opened(case, trial)
            if sequence is not None:
                one = perturbed(case, sequence, trial)
                runs.append({b: errors(case, sequence, *one, b)[0] for b in given.backends})
        if runs:
            found[case.name] = found.get(case.name, {}) | _medians(runs)
            print(case.name, found[case.name], file=sys.stderr, flush=True)
    if not found:
        print("bars: set SLAM_DATA to the folder that holds the recordings; nothing was run")
        return 0
    given.out.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    print(
        "Medians of five runs, each with another first frame, pixel noise and number of features, in mm: ATE; in the "
        "library the distance of the last from the first position, without loops."
    )
    print("\n" + table(found))
    return 0


if __name__ == "__main__":
    sys.exit(main())
