"""Faults of one line each, put into a copy of the package one after another: do the tests find them?

    python tests/seeded_faults.py            # all of them: an hour or two, so by hand or at night
    python tests/seeded_faults.py window     # those whose name, file or tests hold this word
    python tests/seeded_faults.py --near     # only the test files nearest to each fault, not the rest after them

Prints a line for each fault, with the first test that fails. Exit status 1 where a fault is not found.
`tests/test_seeded_faults.py` checks that what is changed still stands in the code, once.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
_LONGEST = 1800  # of the tests after one fault [s]; what takes longer hangs, and is found
_LEFT_OUT = ("tests/test_seeded_faults.py",)  # reads the source


class Fault(NamedTuple):
    """A part of a line of a file, and what stands there instead."""

    name: str
    file: str
    old: str
    new: str

    @property
    def tests(self) -> str:
        """The tests nearest to it, those of the file first."""
        tests = next(tests for start, tests in NEAREST.items() if self.file.startswith(start))
        own = f"{tests}/test_{Path(self.file).stem}.py"
        return f"{own} {tests}" if (ROOT / own).exists() else tests


#: By how a file's path begins: the tests nearest to it.
NEAREST = {
    "backends/ekf": "tests/backends/test_ekf_parts.py tests/backends/test_ekf.py tests/backends/test_ekf_robustness.py "
    "tests/backends/test_ekf_inactive.py",
    "backends/smoother": "tests/backends/test_insert.py tests/backends/test_all_backends.py "
    "tests/backends/test_smoother.py tests/backends/test_contract.py",
    "backends/window": "tests/backends/test_window.py tests/backends/test_insert.py",
    "backends/batch": "tests/backends/test_all_backends.py tests/backends/test_batch.py",
    "frontends": "tests/frontends",
    "slam/window": "tests/slam/window tests/backends/test_window.py tests/backends/test_all_backends.py",
    "slam/kernels": "tests/slam/kernels tests/backends/test_all_backends.py tests/backends/test_batch.py",
    **{f"slam/{room}": f"tests/slam/{room}" for room in ("input", "tracks", "bodies", "atlas", "calibration")},
}

FAULTS = (
    # the filter
    Fault(
        "turning the camera moves points the wrong way", "backends/ekf/camera.py",
        "hat(camera.pose[:3, 3]) @ J, J", "-hat(camera.pose[:3, 3]) @ J, -J",
    ),
    Fault(
        "clones are corrected as if they were in the state", "backends/ekf/covariance.py",
        "P[clones, clones], by_rig[clones] = self.P[clones, clones], self.by_rig[clones]",
        "by_rig[clones] = self.by_rig[clones]",
    ),
    Fault(
        "no process noise", "backends/ekf/covariance.py",
        "own[:CAMERA, :CAMERA] += noise", "own[:CAMERA, :CAMERA] += 0 * noise",
    ),
    Fault(
        "landmarks start without their measurement's noise", "backends/ekf/covariance.py",
        "[each, :, each] += noise", "[each, :, each] += 0 * noise",
    ),
    Fault(
        "one wrong match takes out its neighbours", "backends/ekf/solve.py",
        "used = used & (excess <= max(1.0, 0.5 * worst))", "used = used & (excess <= 1.0)",
    ),
    # the smoother
    Fault(
        "a landmark out of view forgets earlier drift", "backends/smoother/landmarks.py",
        "away[unseen] += J @ drift @ np.swapaxes(J, 1, 2)", "away[unseen] = J @ drift @ np.swapaxes(J, 1, 2)",
    ),
    Fault(
        "what is known of a landmark beforehand is lost from its covariance", "backends/smoother/kernels.py",
        "H_there[i, j] = information[m, i, j]", "H_there[i, j] = 0.0",
    ),
    Fault(
        "pixel noise not scaled to the rectified image", "slam/input/features.py",
        "models.pixel_sigma * scale", "models.pixel_sigma",
    ),
    # the sliding window
    Fault(
        "a landmark that joins the prior counts twice", "backends/window/slide.py",
        "free = np.where((joins | ends)[:, None, None], 0.0, free)", "free = np.where(ends[:, None, None], 0.0, free)",
    ),
    Fault(
        "the prior's information vector is not moved with its reference", "slam/window/marginal.py",
        "vector[at] = A.T @ vector", "vector[at] = 0.0",
    ),
    Fault(
        "a point's derivative by inverse distance forgets its direction", "slam/window/chart_kernels.py",
        "E[m, i, 2] = -(e[i, 2] + a * e[i, 0] + b * e[i, 1]) * r * r", "E[m, i, 2] = -e[i, 2] * r * r",
    ),
    Fault(
        "a pose relative to the reference changes the wrong way", "slam/window/terms.py",
        "A[at + i, j] = (1.0 if i == j else 0.0) if p == 0 else -Ad[i, j]",
        "A[at + i, j] = (1.0 if i == j else 0.0) if p == 0 else Ad[i, j]",
    ),
    Fault(
        "the gate of a left pixel alone has three degrees of freedom", "slam/window/pose_only.py",
        "limits = chi_square_limits(2 + np.isfinite(problem.z[:, 2]), problem.probability)",
        "limits = chi_square_limits(np.full(len(problem.z), 3), problem.probability)",
    ),
    Fault(
        "unequal frame intervals in the motion's derivative", "slam/window/motion.py",
        "J0[3:, 3:] = -s * R2.T @ R0", "J0[3:, 3:] = -R2.T @ R0",
    ),
    # the batch solution
    Fault(
        "velocity's derivative by the middle pose", "slam/kernels/velocities.py",
        "J[3 + i, 9 + j] -= poses[i1, i, j] / d0", "J[3 + i, 9 + j] = -poses[i1, i, j] / d0",
    ),
    Fault(
        "the earlier velocity is taken over the later interval", "backends/smoother/state.py",
        "return dt[-1], dt[0] if number - 2", "return dt[-1], dt[-1] if number - 2",
    ),
    # tracks
    Fault(
        "a second feature that is as near counts for nothing", "slam/tracks/follow.py",
        "elif d < second[row]:  # also one that is as near as the first",
        "elif nearest[row] < d < second[row]:",
    ),
    Fault(
        "a match need not be mutual", "slam/tracks/follow.py",
        "good[p] = good[p] and distance[p] <= of_column[columns[p]]", "pass",
    ),
    Fault(
        "withheld landmarks count as missed", "slam/tracks/kernels.py",
        "expected[n] and not withheld[n]", "expected[n]",
    ),
    Fault(
        "a hidden landmark counts as missed", "slam/tracks/kernels.py",
        "nearer += points[f, 2] + SIGMAS * sigma[f] < 0.9 * depth", "nearer += 0",
    ),
    # moving bodies
    Fault(
        "what slides with the camera has moved for certain", "slam/bodies/proof.py",
        "_FARTHER * np", "0.0 * np",
    ),
    Fault(
        "a body's point counts twice as its frame leaves", "slam/bodies/belief.py",
        "rows.select(~taken & (rows.pose > 0))", "rows.select(rows.pose > 0)",
    ),
    # the front end
    Fault(
        "weight of the mixed derivative in the response", "frontends/surf/localisation.py",
        "return xx * yy - 0.81 * xy * xy", "return xx * yy - 0.9 * xy * xy",
    ),
    Fault(
        "a quarter of the wavelets of a turned descriptor has the wrong sign", "frontends/surf/descriptor.py",
        "dx, dy = (falling + rising) * weights[i, j], (falling - rising) * weights[i, j]",
        "dx, dy = (falling + rising) * weights[i, j], (rising - falling) * weights[i, j]",
    ),
    # keyframes and loops
    Fault(
        "a relative pose's covariance forgets the turn between its frames", "slam/atlas/pose_graph.py",
        "J = np.concatenate([-adjoint(inverse(T)), np.eye(6)], axis=1)",
        "J = np.concatenate([-np.eye(6), np.eye(6)], axis=1)",
    ),
    Fault(
        "a loop is tested without its own covariance", "slam/atlas/closing.py",
        "return distance(T, loop.T_first_second, P + loop.covariance)", "return distance(T, loop.T_first_second, P)",
    ),
    Fault(
        "errors of earlier stretches are counted again", "slam/atlas/pose_graph.py",
        "total -= total[begin]", "total -= 0 * total[begin]",
    ),
    Fault(
        "features that slid count for nothing in a loop's covariance", "slam/atlas/verification.py",
        "return solution.window.poses[1], P + covariance_growth(_jackknife(solution.window, P), P)",
        "return solution.window.poses[1], P",
    ),
    # calibration
    Fault(
        "the baseline's forward part moves rows the wrong way", "slam/calibration/kernels.py",
        "vertical_by_pose = -1 - y * y, right * y, right, d, -d * y",
        "vertical_by_pose = -1 - y * y, right * y, right, d, d * y",
    ),
    Fault(
        "the spread between the prior's scales is left out", "slam/calibration/posterior.py",
        "covariance = np.tensordot(weights, covariances + off[:, :, None] * off[:, None], axes=1)",
        "covariance = np.tensordot(weights, covariances, axes=1)",
    ),
)  # fmt: skip


def main() -> int:
    """Try the faults that the command line names; the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("words", nargs="*", help="only faults whose name, file or tests hold one of these")
    parser.add_argument("--near", action="store_true", help="only the tests nearest to each fault")
    parser.add_argument("--processes", type=int, default=2, help="pytest's")
    given = parser.parse_args()
    chosen = [
        f for f in FAULTS if not given.words or any(w in " ".join((f.name, f.file, f.tests)) for w in given.words)
    ]
    found = 0
    with tempfile.TemporaryDirectory() as scratch:
        tree = Path(scratch) / "tree"
        shutil.copytree(ROOT, tree, ignore=shutil.ignore_patterns(".git", ".*_cache", "results-*"))
        for number, fault in enumerate(chosen, start=1):
            begun = time.monotonic()
            by = _found_by(tree, fault, given.near, given.processes)
            found += by is not None
            took = f"{time.monotonic() - begun:.0f} s"
            print(f"{number:2} {fault.file}: {fault.name}: {by or 'NOT FOUND'} ({took})", flush=True)
    print(f"{found} of {len(chosen)} found")
    return 0 if found == len(chosen) else 1


def _found_by(tree: Path, fault: Fault, near: bool, processes: int) -> str | None:
    """The first test that fails with the fault in the copy, which is as before afterwards; None where none does."""
    path = tree / fault.file
    text, times = path.read_text(encoding="utf-8"), path.stat()
    path.write_text(text.replace(fault.old, fault.new), encoding="utf-8")
    try:
        nearest = _failure(tree, [*fault.tests.split()], processes)
        if nearest is not None or near:
            return nearest
        return _failure(tree, ["tests", *(f"--ignore={path}" for path in fault.tests.split())], processes)
    finally:
        path.write_text(text, encoding="utf-8")
        os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))  # compiled kernels stay valid


def _failure(tree: Path, tests: list[str], processes: int) -> str | None:
    """The first test that fails, or None."""
    words = [
        sys.executable, "-m", "pytest", "-q", "-x", "-m", "not slow", "-n", str(processes), "-p", "no:cacheprovider",
        *(f"--ignore={path}" for path in _LEFT_OUT), *tests,
    ]  # fmt: skip
    environment = {**os.environ, "PYTHONPATH": str(tree)}
    try:
        run = subprocess.run(words, cwd=tree, env=environment, capture_output=True, text=True, timeout=_LONGEST)
    except subprocess.TimeoutExpired:
        return "hangs"
    if run.returncode == 0:
        return None
    named = re.search(r"^(?:FAILED|ERROR) (\S+)", run.stdout, re.MULTILINE)
    if named is None:
        raise SystemExit(f"pytest itself failed:\n{run.stdout[-2000:]}{run.stderr[-2000:]}")
    return named[1]


if __name__ == "__main__":
    sys.exit(main())
