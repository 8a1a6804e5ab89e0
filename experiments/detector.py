"""D_threshold, octaves and radius of the features (paper A, III.A).

    python experiments/detector.py [--quick] [--out DIR]

Paper A, on one 320x240 webcam image: 837 features at D_threshold 0, 41 at 10000; the number and the time fall as the
threshold rises; radii grow with the octave and numbers fall, so that octaves 3 and 4 are left out. Here: the median
over frames of the rendered aisle.
"""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.surf import medians
from experiments.common import script_options
from experiments.tables import picture, show
from frontends.surf import Surf
from slam.sequences import open_sequence

THRESHOLDS = (0, 10, 100, 300, 1000, 3000, 10_000)
PAPER = {0: "837", 10_000: "41"}
OCTAVES = 4


def images(count: int) -> list[np.ndarray]:
    """Images along the whole aisle."""
    sequence = open_sequence("synthetic:aisle?speed=6")
    return [sequence.frame(int(k)).left for k in np.linspace(0, len(sequence) - 1, count)]


def counts(pictures: list[np.ndarray]) -> tuple[np.ndarray, list[np.ndarray]]:
    """Median number of features (T, octaves), and the radii [px] of all at threshold 100 by octave."""
    radii: list[list[np.ndarray]] = [[] for _ in range(OCTAVES)]
    table = np.zeros((len(THRESHOLDS), len(pictures), OCTAVES))
    for i, limit in enumerate(THRESHOLDS):
        for j, image in enumerate(pictures):
            found = Surf(limit, OCTAVES).detect(image)
            table[i, j] = np.bincount(found.octave, minlength=OCTAVES)
            if limit == 100:
                for octave in range(OCTAVES):
                    radii[octave].append(0.5 * found.size[found.octave == octave])
    return np.median(table, axis=1), [np.concatenate(r) for r in radii]


def times(image: np.ndarray, rounds: int) -> np.ndarray:
    """CPU time of detection [ms] (T, 2) with one and with two octaves."""
    tasks = {f"{limit} {n}": partial(Surf(limit, n).detect, image) for limit in THRESHOLDS for n in (1, 2)}
    found = medians(tasks, rounds)
    return np.array([[found[f"{limit} {n}"] for n in (1, 2)] for limit in THRESHOLDS])


def draw(table: np.ndarray, ms: np.ndarray, radii: list[np.ndarray], path: Path) -> None:
    """Features and time over the threshold, and radii by octave."""
    x, names = np.maximum(THRESHOLDS, 1), [f"octave {i + 1}" for i in range(OCTAVES)]
    with picture(path, 11, 3.2, 1, 3) as (a, b, c):
        a.stackplot(x, *table.T, labels=names)
        a.plot([1, 10_000], [837, 41], "k*", label="paper A, its own image")
        a.set(xscale="log", xlabel="D_threshold", ylabel="features")
        b.plot(x, ms[:, 0], "o-", x, ms[:, 1], "s-")
        b.set(xscale="log", xlabel="D_threshold", ylabel="CPU time of detection [ms]", ylim=(0, None))
        b.legend(["one octave", "two octaves"])
        c.hist(radii, bins=np.arange(3, 80, 2), stacked=True, label=names)
        c.set(xlabel="radius [px]", ylabel="features")
        a.legend(fontsize=8)
        c.legend(fontsize=8)


def main() -> int:
    parser = script_options(__file__, __doc__, "three images, few repetitions")
    arguments = parser.parse_args()
    pictures = images(3 if arguments.quick else 25)
    table, radii = counts(pictures)
    ms = times(pictures[len(pictures) // 2], 3 if arguments.quick else 41)
    rows = [
        [str(limit), f"{row[:2].sum():.0f}", PAPER.get(limit, ""), f"{time[1]:.2f}"]
        for limit, row, time in zip(THRESHOLDS, table, ms)
    ]
    shares = table[THRESHOLDS.index(100)] / max(table[THRESHOLDS.index(100)].sum(), 1)
    sizes = ", ".join(f"{np.median(r):.1f} px" for r in radii if len(r))
    first = f"At D_threshold 100, {100 * shares[:2].sum():.0f} % of all features are in the first two octaves"
    header = ("D_threshold", "octaves 1 and 2", "paper A", "ms, 2 octaves")
    show(arguments.out / "table.json", header, rows, 0, f"{first}; median radius by octave: {sizes}.")
    draw(table, ms, radii, arguments.out / "detector.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
