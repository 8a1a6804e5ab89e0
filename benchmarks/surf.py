"""The speed of SURF against OpenCV's SIFT and ORB, as ratios of medians of CPU time in one run.

    python benchmarks/surf.py

Uses the images under the environment variable SLAM_DATA where it is set, else rendered ones.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import slam
from frontends.surf import Surf

SIZES = ((320, 240), (752, 480), (1241, 376))
DATA = Path(os.environ["SLAM_DATA"]) if os.environ.get("SLAM_DATA") else None


def medians(tasks: dict[str, Callable[[], object]], rounds: int = 21) -> dict[str, float]:
    """Median CPU time of each task in this thread [ms], taken in turns."""
    times: dict[str, list[float]] = {name: [] for name in tasks}
    for k in range(rounds + 1):
        for name, task in tasks.items():
            start = time.thread_time()
            task()
            if k:
                times[name].append(1e3 * (time.thread_time() - start))
    return {name: float(np.median(row)) for name, row in times.items()}


def test_image(width: int, height: int) -> np.ndarray:
    """A bookshelf, or a street where the image is wide."""
    if DATA and (width, height) != SIZES[2]:
        with np.load(DATA / "surf_reference" / "surf_reference.npz") as file:
            return file[f"shelf_{width}x{height}/image"]
    name = "street" if width > 1000 else "aisle"
    return slam.open_sequence(f"synthetic:{name}?frames=60&width={width}&height={height}").frame(30).left


def with_features(image: np.ndarray, count: int = 800) -> float:
    """The D_threshold that finds `count` features."""
    response = Surf(0.0).detect(image).response
    return float(response[min(count, len(response) - 1)])


def speed() -> None:
    """Detection and description by one thread, about 800 features."""
    print("\n## Speed: CPU time of one thread, about 800 features\n")
    print("| image | what | ms | SIFT(800) takes | ORB(1000) takes |\n| --- | --- | --- | --- | --- |")
    for width, height in SIZES:
        image = test_image(width, height)
        threshold = with_features(image)
        tasks: dict[str, Callable[[], object]] = {
            "SIFT": lambda image=image: cv2.SIFT_create(800).detectAndCompute(image, None),
            "ORB": lambda image=image: cv2.ORB_create(1000).detectAndCompute(image, None),
        }
        for descriptor in (64, 16):
            for upright in (True, False):
                surf = Surf(threshold, descriptor=descriptor, upright=upright)
                name = f"{descriptor}-D {'upright' if upright else 'oriented'}"
                tasks[name] = lambda surf=surf, image=image: surf.detect_and_describe(image)
        tasks["detection alone"] = lambda surf=surf, image=image: surf.detect(image)
        ms = medians(tasks)
        for name in tasks:
            ratios = f"{ms['SIFT'] / ms[name]:.1f} x | {ms['ORB'] / ms[name]:.2f} x"
            print(f"| {width}x{height} ({len(surf.detect(image))}) | {name} | {ms[name]:.2f} | {ratios} |")


if __name__ == "__main__":
    cv2.setNumThreads(1)
    speed()
