"""Do the back ends say how sure they are? Monte Carlo over worlds with true association, against the bound.

    python experiments/consistency.py [--quick] [--seeds N] [--frames N] [--out DIR]

Every run simulates a world's observations, gives the same to every back end (`slam.run.replay`), and starts it at a
pose drawn from the prior about the true one. Reported, over the runs:

- RMSE of the poses against the posterior Cramér-Rao bound, online (newest pose) and final (whole path);
- average NEES of the online pose and of landmarks, with their 95 % chi-square bands, and NIS of the updates; the band
  of NIS is that of a distribution cut off at the gate, and on a smooth path it begins where the six degrees of freedom
  of the motion tell nothing (see `nis_band`);
- what 10 % wrong matches cost.

The paths of `desk` and `aisle` are what they are: smoother than the motion model expects. In `drawn` the path on the
desk is drawn from the motion model itself, so that predictions, too, can be held to their covariances.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from scipy.stats import chi2

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from experiments.common import script_options
from experiments.consistency_trials import CASES, Trial, trials
from experiments.tables import markdown, picture
from slam.evaluation.metrics import chi_square_band
from slam.geometry.se3 import Array
from slam.registry import ONLINE


def rms(errors: Array) -> float:
    return float(np.sqrt((errors**2).sum(axis=-1).mean()))


def against_the_bound(done: Sequence[Trial], name: str) -> tuple[float, float, float, float]:
    """RMSE and bound of the position, online and final."""
    part = slice(3, 6)
    online = rms(np.array([t.runs[name].online[t.checked, part] for t in done]))
    final = rms(np.array([t.runs[name].final[:, part] for t in done]))
    bounds = [
        np.sqrt(np.mean([np.trace(b[:, part, part], axis1=1, axis2=2).mean() for b in each]))
        for each in ([t.online_bound for t in done], [t.final_bound for t in done])
    ]
    return online, float(bounds[0]), final, float(bounds[1])


def nis_band(case: str, dof: int, updates: int, gate: float = 0.999) -> tuple[float, float]:
    """95 % band of the NIS per degree of freedom.

    The gate cuts off what is beyond its quantile: of a χ² distribution of three degrees of freedom the mean sinks by
    half a per cent. A path that is smoother than the motion model expects has fewer degrees of freedom: six of an
    update's are the prediction's, and where it is always nearly right they come out near 0 instead of 6. A path drawn
    from the model has them all.
    """
    cut = chi2.cdf(chi2.ppf(gate, 3), 5) / gate  # E[x | x < q] = n F_{n+2}(q) / F_n(q)
    low, high = chi_square_band(1, dof)
    told = 1.0 if case == "drawn" else 1 - 6 * updates / dof
    return low * cut * told, high * cut


def accuracy_rows(case: str, done: Sequence[Trial]) -> Iterator[list[str]]:
    for name in ONLINE:
        online, online_bound, final, final_bound = against_the_bound(done, name)
        row = [case, name, f"{1e3 * online:.2f}", f"{online / online_bound:.2f}"]
        yield [*row, f"{1e3 * final:.2f}", f"{final / final_bound:.2f}", with_wrong_matches(done, name)]


def with_wrong_matches(done: Sequence[Trial], name: str) -> str:
    """How many times as large online errors are with a tenth of the matches wrong."""
    spoilt = [t for t in done if t.spoilt]
    every = ([t.runs for t in spoilt], [t.spoilt for t in spoilt]) if spoilt else ()
    errors = [rms(np.array([runs[name].online[:, 3:] for runs in each])) for each in every]
    return f"{errors[1] / errors[0]:.2f}" if errors else "–"


def consistency_rows(case: str, done: Sequence[Trial]) -> Iterator[list[str]]:
    """Each mean beside its band; the mean over a run has the band of one frame, as its frames are correlated."""
    n = len(done)
    low, high = chi_square_band(6, n)
    for name in ONLINE:
        runs = [t.runs[name] for t in done]
        mean = np.mean([r.nees for r in runs], axis=0)
        nis, dof = sum(r.nis.sum() for r in runs), sum(r.dof.sum() for r in runs)
        nis_low, nis_high = nis_band(case, int(dof), sum(int(np.count_nonzero(r.dof)) for r in runs))
        mark_low, mark_high = chi_square_band(3, n)
        yield [
            case, name, f"{mean.mean():.2f} ({low:.2f}–{high:.2f})", f"{nis / dof:.3f} ({nis_low:.3f}–{nis_high:.3f})",
            f"{np.mean([r.landmark for r in runs]):.2f} ({mark_low:.2f}–{mark_high:.2f})",
        ]  # fmt: skip


ACCURACY = "world", "back end", "online [mm]", "/ bound", "final [mm]", "/ bound", "wrong matches"
CONSISTENCY = "world", "back end", "NEES (95 %)", "NIS/dof", "landmark NEES"


def report(results: dict[str, list[Trial]]) -> str:
    """The two tables."""
    tables = ((ACCURACY, accuracy_rows), (CONSISTENCY, consistency_rows))
    return "\n\n".join(
        markdown(header, [row for case, done in results.items() for row in rows(case, done)], 2)
        for header, rows in tables
    )


def draw(path: Path, results: dict[str, list[Trial]]) -> None:
    """Error against the bound, and average NEES against its band, frame by frame."""
    with picture(path, 4.2 * len(results), 6, 2, len(results), sharex="col") as panels:
        axes = np.reshape(panels, (2, len(results)))
        for (case, done), (top, bottom) in zip(results.items(), axes.T):
            for name in ONLINE:
                errors = np.array([t.runs[name].online[:, 3:] for t in done])
                top.plot(1e3 * np.sqrt((errors**2).sum(axis=2).mean(axis=0)), label=name)
                bottom.plot(np.mean([t.runs[name].nees for t in done], axis=0), label=name)
            bound = np.mean([np.trace(t.online_bound[:, 3:, 3:], axis1=1, axis2=2) for t in done], axis=0)
            top.plot(done[0].checked, 1e3 * np.sqrt(bound), "k.--", label="bound")
            bottom.axhspan(*chi_square_band(6, len(done)), color="0.85", label="95 % band")
            top.set(title=case, ylim=(0, None))
            bottom.set(xlabel="frame", ylim=(0, None))
        axes[0, 0].set_ylabel("RMSE of the newest position [mm]")
        axes[1, 0].set_ylabel("average NEES of the newest pose")
        axes[0, 0].legend()
        axes[1, 0].legend()


def main() -> int:
    parser = script_options(__file__, __doc__, "two seeds of fifteen frames")
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--wrong", type=int, default=6, help="seeds that are run with wrong matches as well")
    parser.add_argument("--frames", type=int, default=120)
    parser.add_argument("--cases", nargs="*", default=CASES, choices=CASES)
    arguments = parser.parse_args()
    seeds, frames, wrong = arguments.seeds, arguments.frames, arguments.wrong
    if arguments.quick:
        seeds, frames, wrong = 2, 15, 1
    results = trials(arguments.cases, seeds, frames, wrong)
    print(f"{seeds} runs of {frames} frames; wrong matches in {min(wrong, seeds)} of them\n\n" + report(results))
    draw(arguments.out / "consistency.png", results)
    return 0


if __name__ == "__main__":
    sys.exit(main())
