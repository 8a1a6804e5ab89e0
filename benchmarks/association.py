"""Association of one frame: window matching and consensus, with 1000 landmarks in view and 800 features.

    python benchmarks/association.py [--landmarks 1000] [--features 800]

CPU time, medians in one run, one thread. For comparison: the full matrix of descriptor distances, which comparing
every landmark with every feature would need before anything else.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from slam.data import Prediction, StereoFeatures
from slam.geometry import se3
from slam.geometry.rig import StereoRig
from slam.models import EstimatorModels
from slam.tracks.config import AssociationConfig
from slam.tracks.follow import follow, match_everywhere
from slam.tracks.localizer import Localizer
from slam.tracks.table import LandmarkTable

RIG = StereoRig.rectified_pair(f=520.0, u0=319.5, v0=239.5, baseline=0.12, width=640, height=480)
SIGMA = 0.5
ROUNDS = 41


def unit(rows: np.ndarray) -> np.ndarray:
    """Rows of length one."""
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def scene(
    landmarks: int, features: int, uncertainty: float, outliers: float, rng: np.random.Generator
) -> tuple[Prediction, LandmarkTable, np.ndarray, StereoFeatures]:
    """Landmarks in view of a camera whose predicted pose is off, and the features of the frame.

    A part of the landmarks has a feature; a share `outliers` of these lies some pixels off.
    """
    uv = rng.uniform((8, 8), (632, 472), (landmarks, 2))
    z = rng.uniform(1.0, 6.0, landmarks)
    points = np.column_stack([RIG.left.normalise(uv) * z[:, None], z])
    looks, signs = unit(rng.normal(size=(landmarks, 64))), rng.choice([-1, 1], landmarks).astype(np.int8)
    seen = rng.permutation(landmarks)[: int(0.7 * min(landmarks, features))]
    left, right = RIG.project(points[seen])
    left = left + SIGMA * rng.normal(size=left.shape)
    left[rng.random(len(seen)) < outliers] += 3 * uncertainty
    stray = features - len(seen)
    uv_left = np.concatenate([left, rng.uniform((0, 0), (639, 479), (stray, 2))])
    uv_right = np.concatenate([right, np.full((stray, 2), np.nan)])
    descriptors = unit(
        np.concatenate([looks[seen] + 0.03 * rng.normal(size=(len(seen), 64)), rng.normal(size=(stray, 64))])
    )
    laplacian = np.concatenate([signs[seen], rng.choice([-1, 1], stray).astype(np.int8)])
    n = np.ones(features)
    frame = StereoFeatures(0.0, uv_left, uv_right, n, n, n, laplacian, descriptors)
    angle = uncertainty / RIG.left.fu
    T = se3.exp(np.array([0.7 * angle, -0.7 * angle, 0, 0.002, 0, 0.002]))
    local = se3.transform(se3.inverse(T), points)
    expected, expected_right = RIG.project(local)
    S = np.tile(np.eye(2) * (uncertainty**2 + SIGMA**2), (landmarks, 1, 1))
    ids, count = np.arange(landmarks), np.ones(landmarks, np.int64)
    prediction = Prediction(0.0, T, np.eye(6) * 1e-4, ids, expected, expected_right, S)
    rows = LandmarkTable(ids, looks, signs, count, count, count, count)
    return prediction, rows, points, frame


def cpu_ms(function: Callable[[], object]) -> float:
    """Median CPU time of a call [ms]."""
    times = []
    for _ in range(ROUNDS):
        start = time.process_time()
        function()
        times.append(time.process_time() - start)
    return 1e3 * float(np.median(times))


def all_distances(rows: LandmarkTable, features: StereoFeatures) -> np.ndarray:
    """What comparing all with all costs at least."""
    return np.asarray(np.sqrt(np.maximum(2 - 2 * (rows.descriptors @ features.descriptors.T), 0)))


def row(landmarks: int, features: int, uncertainty: float, outliers: float) -> str:
    """One row of the table."""
    config = AssociationConfig()
    localizer = Localizer(RIG, config, EstimatorModels(pixel_sigma=SIGMA))
    prediction, rows, points, frame = scene(landmarks, features, uncertainty, outliers, np.random.default_rng(0))
    place, look = (prediction.uv_left, prediction.innovation), (rows.descriptors, rows.laplacian, frame)
    full = cpu_ms(lambda: all_distances(rows, frame))
    windows = cpu_ms(lambda: follow(*place, *look, config))
    fixed = cpu_ms(lambda: follow(*place, *look, replace(config, windows="fixed")))
    whole = cpu_ms(lambda: localizer.match(prediction, rows, points, frame, 0))
    found = len(localizer.match(prediction, rows, points, frame, 0))
    times = " | ".join(f"{t:.2f} ({t / full:.2f})" for t in (windows, fixed, whole))
    return f"| {uncertainty:.0f} | {outliers:.0%} | {found} | {times} |"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--landmarks", type=int, default=1000)
    parser.add_argument("--features", type=int, default=800)
    arguments = parser.parse_args()
    print(
        f"{arguments.landmarks} landmarks in view, {arguments.features} features; CPU ms, in brackets the ratio to (a)"
    )
    print("| prediction off by [px] | outliers | matched | windows | fixed windows | windows and consensus |")
    print("| ---: | ---: | ---: | ---: | ---: | ---: |")
    with threadpool_limits(limits=1):
        for uncertainty, outliers in ((1.0, 0.0), (3.0, 0.1), (8.0, 0.1), (30.0, 0.1)):
            print(row(arguments.landmarks, arguments.features, uncertainty, outliers))
        _, rows, _, features = scene(arguments.landmarks, arguments.features, 1.0, 0.0, np.random.default_rng(0))
        full = cpu_ms(lambda: all_distances(rows, features))
        wide = cpu_ms(lambda: match_everywhere(rows.descriptors, rows.laplacian, features, AssociationConfig()))
        print(f"(a) all descriptor distances and nothing else: {full:.2f}; matching without windows: {wide:.2f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
