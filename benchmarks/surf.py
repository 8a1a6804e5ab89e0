"""Times and images for the experiments on features: medians of CPU time, taken in turns.

Images are those under the environment variable SLAM_DATA where it is set, else rendered ones.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import slam

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
    if DATA and width <= 1000:
        with np.load(DATA / "surf_reference" / "surf_reference.npz") as file:
            return file[f"shelf_{width}x{height}/image"]
    name = "street" if width > 1000 else "aisle"
    return slam.open_sequence(f"synthetic:{name}?frames=60&width={width}&height={height}").frame(30).left
