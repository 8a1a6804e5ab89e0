"""What each part is worth: recordings and worlds with one part of the system switched off at a time.

    [SLAM_DATA=/path/to/data] python experiments/ablation.py [--quick] [--trials 5] [--only VARIANT …]
        [--sequences NAME …] [--out DIR]

Each sequence is run several times, with another first frame, pixel noise of half a grey level, and up to 20 % more or
fewer features, a world with another seed as well (`experiments/perturbations.py`). Features are extracted once for
all variants, so a variant is compared with everything on, on the same features. Runs are appended to
``ablation.csv`` as they end, and a later call goes on with those that are missing. Printed are, for each back end and
variant, ratios to everything on.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import slam
from experiments.ablation_parts import ALL_ON, CASES, GROUPS, Case, Variant, opened, path_figures
from experiments.common import script_options, timed
from experiments.perturbations import NONE, features_of, frames_of
from experiments.tables import resumed, show, write_json
from frontends import create
from slam.data import StereoFeatures
from slam.interfaces import Frontend
from slam.sequences import Sequence
from slam.system import StereoSlam

BACKENDS = ("ekf", "smoother")  # whose parts are switched off

_LONG = 100  # frames from which a sequence comes last
#: What was decided by these tables, without figures: they are above it.
FOLLOWED = """
The ratios of `smoother` are alike. The detector stays for the bodies that it finds.
"""
COLUMNS = ("without", "error", "largest", "larger in", "NEES", "CPU")
HEADER = ("sequence", "trial", "back end", "variant", "error", "NEES", "frames", "lost", "ms")


def run(
    sequence: Sequence, case: Case, frontend: Frontend, features: list[StereoFeatures], backend: str, variant: Variant
) -> list[float | int]:
    """Error [m], NEES, number of frames, of those without a measured pose, and CPU time of a step, median [ms]."""
    config, nan = variant.config(sequence, case, backend), float("nan")
    try:
        with variant.patch():
            system = StereoSlam(sequence.rig, frontend, backend, config=config)
            results, times = timed(system.process_features, features)
    except slam.SlamError as error:  # a run that ends before its last frame has no figures
        print(f"{case.name}, {backend}, {variant.name}: {error}", file=sys.stderr, flush=True)
        return [nan, nan, len(features), len(features), nan]
    return [*path_figures(results, case, sequence), float(np.median(times))]


def runs(cases: list[Case], trials: int, names: list[str], done: set[tuple[str, ...]]) -> Iterator[list[object]]:
    """The rows that are missing; those of the longest sequence come last."""
    for late, group in itertools.product((False, True), GROUPS):
        for trial, case in ((t, c) for t in range(trials) for c in cases if t < c.trials):
            if late != (case.frames > _LONG):
                continue
            chosen = [v for v in group if not names or v.name in names]
            sequence = opened(case, trial)
            if sequence is None:
                continue
            base = {b: ALL_ON.config(sequence, case, b) for b in BACKENDS}
            wanted = [
                (b, v) for v in chosen for b in BACKENDS
                if (v is ALL_ON or v.patch is not nullcontext or v.config(sequence, case, b) != base[b])
                and (case.name, str(trial), b, v.name) not in done
            ]  # fmt: skip
            if not wanted:
                continue
            options = {**base[BACKENDS[0]].frontend, "features": features_of(sequence, trial)}
            frontend = create("surf", sequence.rig, **options)
            features = [frontend.extract(f) for f in frames_of(sequence, NONE, case.frames, trial)]
            for backend, variant in wanted:
                figures = run(sequence, case, frontend, features, backend, variant)
                yield [case.name, trial, backend, variant.name, *figures]


def table(rows: list[dict[str, str]], backend: str) -> list[list[object]]:
    """What each variant changes, as ratios to everything on: medians over the trials, means over the sequences.

    Besides the mean, the sequence with the largest ratio, and the number of those in whose trials, three at least, all
    errors are larger: what is beyond the scatter.
    """
    own = [row for row in rows if row["back end"] == backend]
    cases = list(dict.fromkeys(row["sequence"] for row in own))
    base = {(row["sequence"], row["trial"]): row for row in own if row["variant"] == ALL_ON.name}
    out: list[list[object]] = []
    for variant in (v for group in GROUPS for v in group if v is not ALL_ON):
        mine = [r for r in own if r["variant"] == variant.name and (r["sequence"], r["trial"]) in base]
        pairs = [(r, base[r["sequence"], r["trial"]]) for r in mine]
        ratios = {c: np.array([_ratio(r, u, "error") for r, u in pairs if r["sequence"] == c]) for c in cases}
        ratios = {c: r[np.isfinite(r)] for c, r in ratios.items() if np.isfinite(r).any()}
        if not ratios:
            continue
        medians = {c: float(np.median(r)) for c, r in ratios.items()}
        worst = max(medians, key=lambda case: medians[case])
        larger = sum(len(r) > 2 and bool((r > 1).all()) for r in ratios.values())
        known = [[p for p in pairs if p[0]["sequence"] == c and np.isfinite(_ratio(*p, "NEES"))] for c in cases]
        nees = [
            np.median([float(r["NEES"]) for r, _ in k]) / np.median([float(u["NEES"]) for _, u in k])
            for k in known
            if k
        ]
        out.append([
            variant.name, f"{np.exp(np.mean(np.log(list(medians.values())))):.2f}", f"{medians[worst]:.2f} {worst}",
            larger, f"{np.median(nees):.2f}" if nees else None,
            f"{np.nanmedian([_ratio(r, u, 'ms') for r, u in pairs]):.2f}",
        ])  # fmt: skip
    return out


def _ratio(row: dict[str, str], base: dict[str, str], column: str) -> float:
    return float(row[column]) / float(base[column])


def main() -> int:
    parser = script_options(__file__, __doc__, "one trial, twelve frames of one world, two variants")
    parser.add_argument("--trials", type=int, default=5, help="runs of each sequence")
    parser.add_argument("--only", nargs="*", default=[], metavar="VARIANT", help="these variants alone")
    parser.add_argument("--sequences", nargs="*", metavar="NAME", help="these alone")
    given = parser.parse_args()
    cases = [case for case in CASES if not given.sequences or case.name in given.sequences]
    trials, names = given.trials, given.only
    if given.quick:
        cases, trials, names = [Case("desk", "synthetic:desk?frames=12", 12)], 1, [ALL_ON.name, "no patch alignment"]
    file = given.out / ("quick.csv" if given.quick else "ablation.csv")
    rows = resumed(file, HEADER, HEADER[:4], lambda done: runs(cases, trials, names, done))
    for backend in BACKENDS[1:]:
        write_json(given.out / f"{backend}.json", COLUMNS, table(rows, backend))
    show(given.out / f"{BACKENDS[0]}.json", COLUMNS, table(rows, BACKENDS[0]))
    if not given.quick:
        print(FOLLOWED)
    return 0


if __name__ == "__main__":
    sys.exit(main())
