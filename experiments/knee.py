"""How many measurements carry information: errors, NEES and cost over the numbers of features and of landmarks in view.

    [SLAM_DATA=/path/to/data] python experiments/knee.py [--quick] [--trials 3] [--sequences NAME …] [--out DIR]

Each recording and world is run several times, with another first frame and pixel noise of half a grey level, a world
with another seed as well (`experiments/perturbations.py`): with each number of features at the usual number of
landmarks in view, and with each number of landmarks at the usual number of features. Runs are appended to
``knee.csv`` as they end, and a later call goes on with those that are missing.

Printed are, for each kind of motion, ratios to the runs with both usual numbers: of the online error, geometric means
over sequences, trials and back ends, with the standard error of that mean; of NEES; of the frames in which bodies are
followed, all bodies together; and of CPU times of a frame, for extraction and for all that follows. The knee of the
error is the least number whose error is larger than the smallest by no more than the standard error of the difference.
"""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import slam
from experiments.ablation_parts import RECORDED, Case, opened, path_figures
from experiments.common import script_options
from experiments.perturbations import NONE, frames_of
from experiments.tables import resumed, show
from frontends import create
from slam.config import SystemConfig
from slam.data import FrameResult, StereoFeatures
from slam.runtime import compilation
from slam.sequences import Sequence
from slam.system import StereoSlam

BACKENDS = ("ekf", "window")
#: Worlds are rendered so large that there are as many features as are asked for. The library's images have 300.
CASES = (
    *RECORDED[:-1],
    Case("desk", "synthetic:desk?frames=60&width=752&height=480", 60),
    Case("street", "synthetic:street?frames=45&width=752&height=300", 45, 10),
)
FEATURES = {"driving": (200, 300, 400, 600), "handheld": (300, 400, 600, 800)}
IN_VIEW = {"driving": (60, 80, 100, 150), "handheld": (50, 80, 120)}
USUAL = {"driving": (600, 100), "handheld": (800, 80)}  # both numbers: each is kept while the other changes
ROOM = 4 / 3  # driving: size of the map over the landmarks in view
HEADER = ("sequence", "kind", "trial", "back end", "asked", "in view", "error", "NEES", "lost", "features", "measured",
          "bodies", "extract", "step")  # fmt: skip
COLUMNS = ("kind", "what", "number", "error", "±", "ekf", "window", "largest", "NEES", "bodies", "measured",
           "CPU extract", "CPU ekf", "CPU window")  # fmt: skip

NAMES = {"asked": "features", "in view": "landmarks in view"}
#: What was decided by these tables, without figures: they are above it.
FOLLOWED = """
Drives need their features: with fewer, paths are farther off, and moving cars are followed for fewer frames. More
landmarks in view make them a little better, for a third more time of `ekf` and little of `window`. Of a
hand-held camera 400 features give as good a path, but fewer features of what moves are found; so its numbers stay.
"""

Row = dict[str, str]
KEYS = ("sequence", "trial", "back end", "asked", "in view")


class Run:
    """One system on one sequence."""

    def __init__(self, sequence: Sequence, case: Case, frontend: object, backend: str, in_view: int) -> None:
        config = SystemConfig.for_kind(sequence.kind).with_settings(case.settings)
        largest = round(ROOM * in_view) if sequence.kind == "driving" else max(config.map.max_landmarks, in_view)
        wanted = {"map.target_in_view": in_view, "map.max_landmarks": largest}
        self.system = StereoSlam(sequence.rig, frontend, backend, config=config.with_settings(wanted))
        self.results: list[FrameResult] = []
        self.failed = False

    def step(self, features: StereoFeatures) -> None:
        """A frame; nothing after one that ended the run."""
        try:
            if not self.failed:
                self.results.append(self.system.process_features(features))
        except slam.SlamError as error:
            print(error, file=sys.stderr, flush=True)
            self.failed = True

    def figures(self, case: Case, sequence: Sequence) -> list[float]:
        """Error [m], NEES, frames without a measured pose, features and landmarks measured (medians), bodies, times."""
        if self.failed:
            return [float("nan")] * 7
        error, nees, _, lost = path_figures(self.results, case, sequence)
        counts = [(len(r.features), len(r.matched), sum(r.milliseconds.values())) for r in self.results]
        features, measured, took = np.median(counts, axis=0)
        return [error, nees, lost, features, measured, sum(len(r.objects) for r in self.results), round(took, 2)]


def settings(kind: str) -> dict[int, list[int]]:
    """Numbers of landmarks in view that are run with each number of features."""
    features, in_view = USUAL[kind]
    wanted = {number: [in_view] for number in FEATURES[kind]}
    wanted[features] = sorted({in_view, *IN_VIEW[kind]})
    return wanted


def runs(cases: list[Case], trials: int, done: set[tuple[str, ...]]) -> Iterator[list[object]]:
    """The rows that are missing, trial by trial; all runs with one number of features get the same ones."""
    for trial, case in ((t, c) for t in range(trials) for c in cases if t < c.trials):
        sequence = opened(case, trial)
        if sequence is None:
            continue
        kind, frames = sequence.kind, None
        for asked, numbers in settings(kind).items():
            both = [(b, n) for n in numbers for b in BACKENDS]
            wanted = [(b, n) for b, n in both if (case.name, str(trial), b, str(asked), str(n)) not in done]
            if not wanted:
                continue
            frames = frames or list(frames_of(sequence, NONE, case.frames, trial))
            frontend = create("surf", sequence.rig, **{**SystemConfig.for_kind(kind).frontend, "features": asked})
            systems = [Run(sequence, case, frontend, *one) for one in wanted]
            extraction = []
            for frame in frames:
                start = time.process_time()
                features = frontend.extract(frame)
                extraction.append(1e3 * (time.process_time() - start))
                for system in systems:
                    system.step(features)
            for (backend, in_view), system in zip(wanted, systems):
                figures, took = system.figures(case, sequence), round(float(np.median(extraction)), 2)
                yield [case.name, kind, trial, backend, asked, in_view, *figures[:6], took, *figures[6:]]


Runs = dict[tuple[str, str, str], dict[int, Row]]  # rows by number, of each sequence, trial and back end


def table(rows: list[Row], kind: str) -> tuple[list[list[object]], dict[str, int]]:
    """Figures over both numbers, for one kind of motion; and the knees."""
    out: list[list[object]] = []
    knees = {}
    for what, fixed, usual in (("asked", "in view", USUAL[kind]), ("in view", "asked", USUAL[kind][::-1])):
        own = [row for row in rows if row["kind"] == kind and row[fixed] == str(usual[1])]
        numbers = sorted({int(row[what]) for row in own})
        found: Runs = {}
        for row in own:
            found.setdefault((row["sequence"], row["trial"], row["back end"]), {})[int(row[what])] = row
        found = {key: by for key, by in found.items() if len(by) == len(numbers)}
        if found:
            logs = np.log([[float(by[n]["error"]) for n in numbers] for by in found.values()])
            knees[what] = numbers[_knee(logs)]
            out += ([kind, NAMES[what], number, *figures(found, number, usual[0])] for number in numbers)
    return out, knees


def figures(found: Runs, number: int, usual: int) -> list[object]:
    """The columns of a number, from the error on."""

    def ratios(column: str, backend: str = "") -> np.ndarray:
        pairs = [(by[number], by[usual]) for key, by in found.items() if backend in ("", key[2])]
        return np.array([float(own[column]) / float(base[column]) for own, base in pairs])

    def mean(logs: np.ndarray) -> float:
        return float(np.exp(np.nanmean(logs)))

    log = np.log(ratios("error"))
    cases = {name: np.median(log[[key[0] == name for key in found]]) for name, _, _ in found}
    worst = max(cases, key=lambda name: cases[name])
    bodies = (sum(float(by[n]["bodies"]) for by in found.values()) for n in (number, usual))
    return [
        mean(log), _scatter(log), *(mean(np.log(ratios("error", b))) for b in BACKENDS),
        f"{np.exp(cases[worst]):.2f} {worst}", float(np.nanmedian(ratios("NEES"))), next(bodies) / max(next(bodies), 1),
        round(float(np.nanmedian([float(by[number]["measured"]) for by in found.values()]))),
        float(np.nanmedian(ratios("extract"))), *(float(np.nanmedian(ratios("step", b))) for b in BACKENDS),
    ]  # fmt: skip


def _scatter(ratio: np.ndarray) -> float:
    """Standard error of a mean."""
    known = ratio[np.isfinite(ratio)]
    return float(np.std(known, ddof=1) / np.sqrt(len(known))) if len(known) > 1 else float("nan")


def _knee(logs: np.ndarray) -> int:
    """Column of the least number whose error is no larger than the smallest, within their difference's error."""
    best = int(np.argmin(np.nanmean(logs, axis=0)))
    differences = [logs[:, k] - logs[:, best] for k in range(best + 1)]
    return next(k for k, d in enumerate(differences) if k == best or np.nanmean(d) <= _scatter(d))


def main() -> int:
    parser = script_options(__file__, __doc__, "one trial of twelve frames of one world")
    parser.add_argument("--trials", type=int, default=3, help="runs of each sequence")
    parser.add_argument("--sequences", nargs="*", metavar="NAME", help="these alone")
    given = parser.parse_args()
    cases = [case for case in CASES if not given.sequences or case.name in given.sequences]
    if given.quick:
        cases = [Case("desk", "synthetic:desk?frames=12", 12)]
    file = given.out / ("quick.csv" if given.quick else "knee.csv")
    compilation.working_time = time.process_time
    trials = 1 if given.quick else given.trials
    rows = resumed(file, HEADER, KEYS, lambda done: runs(cases, trials, done))
    tables = {kind: table(rows, kind) for kind in USUAL}
    show(given.out / "knee.json", COLUMNS, [row for shown, _ in tables.values() for row in shown], 2)
    done = Counter(name for name, _ in {(row["sequence"], row["trial"]) for row in rows})
    found = [
        f"{number} {NAMES[what]} ({kind})" for kind, (_, knees) in tables.items() for what, number in knees.items()
    ]
    print(f"\nTrials: {dict(sorted(done.items()))}; knees of the error: {', '.join(found)}", file=sys.stderr)
    if not given.quick:
        print(FOLLOWED)
    return 0


if __name__ == "__main__":
    sys.exit(main())
