"""The SURF front end against OpenCV's SIFT and ORB: speed and quality.

``python benchmarks/surf.py``        all of it, as ratios of medians of CPU time in one run
``python benchmarks/surf.py speed``  one of: speed quality

Uses the images under the environment variable SLAM_DATA where it is set, else rendered ones.
"""

from __future__ import annotations

import argparse
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


def medians(tasks: dict[str, Callable[[], object]], rounds: int = 21, clock: Callable[[], float] | None = None) -> dict:
    """Median time of each task [ms], taken in turns in one run; CPU time of this thread unless a clock is given."""
    clock = clock or time.thread_time
    times: dict[str, list[float]] = {name: [] for name in tasks}
    for k in range(rounds + 1):
        for name, task in tasks.items():
            start = clock()
            task()
            if k:
                times[name].append(1e3 * (clock() - start))
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


def turned(degrees: float, factor: float, size: tuple[int, int]) -> np.ndarray:
    """Homography (3, 3) that turns and zooms an image about its middle."""
    return np.vstack([cv2.getRotationMatrix2D((size[0] / 2, size[1] / 2), degrees, factor), [0, 0, 1]])


def seen_from_aside(degrees: float, size: tuple[int, int]) -> np.ndarray:
    """Homography (3, 3) of a plane that turns about its vertical middle line, at a distance of its width."""
    a, w = np.deg2rad(degrees), float(size[0])
    K = np.array([[w, 0, size[0] / 2], [0, w, size[1] / 2], [0, 0, 1]])
    P = np.array([[np.cos(a), 0, 0], [0, 1, 0], [-np.sin(a), 0, 1]])
    return K @ P @ np.linalg.inv(K)


def changes(size: tuple[int, int]) -> dict[str, tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]]:
    """Warps (3, 3), and what else happens to the image, by name."""

    def plain(image: np.ndarray) -> np.ndarray:
        return image

    def noisy(image: np.ndarray) -> np.ndarray:
        return np.clip(image + 8 * np.random.default_rng(0).standard_normal(image.shape), 0, 255).astype(np.uint8)

    still = np.eye(3)
    table = {f"turned {d}°": (turned(d, 1.0, size), plain) for d in (15, 45, 100)}
    table |= {f"scale {f}": (turned(0, f, size), plain) for f in (0.5, 0.8, 1.25, 2.0)}
    table |= {f"aside {d}°": (seen_from_aside(d, size), plain) for d in (20, 40)}
    table["blur 1.5 px"] = (still, lambda image: cv2.GaussianBlur(image, (0, 0), 1.5))
    table["noise 8"] = (still, noisy)
    table["darker"] = (still, lambda image: (0.4 * image + 5).astype(np.uint8))
    return table


Found = tuple[np.ndarray, np.ndarray, np.ndarray]  # pixels (N, 2), sizes (N,), descriptors (N, D)


def surf_method(threshold: float, count: int, localise: bool = False, **options: object) -> Callable:
    """Our features."""
    surf = Surf(threshold, **options)  # type: ignore[arg-type]

    def run(image: np.ndarray) -> Found:
        keypoints = surf.detect(image)
        if localise:
            keypoints = surf.localise(image, keypoints)
        keypoints, descriptors = surf.describe(image, keypoints.select(np.arange(min(count, len(keypoints)))))
        return keypoints.uv, keypoints.size, descriptors

    return run


def opencv_method(detector: cv2.Feature2D) -> Callable[[np.ndarray], Found]:
    """OpenCV's features."""

    def run(image: np.ndarray) -> Found:
        keypoints, descriptors = detector.detectAndCompute(image, None)
        if descriptors.dtype == np.uint8:  # Hamming distance is the squared distance of the bits
            descriptors = np.unpackbits(descriptors, axis=1).astype(np.float32)
        return np.array([k.pt for k in keypoints]), np.array([k.size for k in keypoints]), descriptors

    return run


def score(a: Found, b: Found, H: np.ndarray, shape: tuple[int, int]) -> tuple[float, float, float]:
    """Repeatability, matching score, and median distance [px] of repeated features under the true warp.

    A feature is repeated where one lies within 2.5 px of its true place, sizes alike; it is matched where its nearest
    descriptor is that of such a one. Both as shares of the features whose place is inside the other image.
    """
    there = cv2.perspectiveTransform(a[0][None].astype(float), H)[0]
    grown = cv2.perspectiveTransform((a[0] + (1, 0))[None].astype(float), H)[0]
    height, width = shape
    inside = ((there > 20) & (there < (width - 20, height - 20))).all(axis=1)
    factor = np.linalg.norm(grown - there, axis=1)
    distance = np.linalg.norm(there[:, None] - b[0][None], axis=2)
    ratio = (a[1] * factor)[:, None] / b[1][None]
    good = (distance < 2.5) & (np.abs(np.log(ratio)) < np.log(1.6))
    repeated = good.any(axis=1) & inside
    nearest = (-2 * a[2] @ b[2].T + (b[2] ** 2).sum(axis=1)).argmin(axis=1)
    matched = good[np.arange(len(there)), nearest] & inside
    off = np.where(good, distance, np.inf).min(axis=1)[repeated]
    return repeated.sum() / inside.sum(), matched.sum() / inside.sum(), float(np.median(off)) if len(off) else np.nan


def quality() -> None:
    """Repeatability and matching score on warps."""
    print("\n## Quality on warps: repeatability / matching score / median error [px], 500 features\n")
    image = test_image(752, 480)
    threshold = 100.0
    methods = {
        "64-D oriented": surf_method(threshold, 500, upright=False),
        "16-D oriented": surf_method(threshold, 500, upright=False, descriptor=16),
        "64-D upright": surf_method(threshold, 500),
        "16-D upright": surf_method(threshold, 500, descriptor=16),
        "64-D oriented, localised": surf_method(threshold, 500, upright=False, localise=True),
        "SIFT": opencv_method(cv2.SIFT_create(500)),
        "ORB": opencv_method(cv2.ORB_create(500)),
    }
    print("| change | " + " | ".join(methods) + " |\n" + "| --- " * (len(methods) + 1) + "|")
    size = image.shape[::-1]
    first = {name: run(image) for name, run in methods.items()}
    rows = []
    for name, (H, change) in changes(size).items():
        other = change(cv2.warpPerspective(image, H, size, flags=cv2.INTER_AREA, borderMode=cv2.BORDER_REFLECT))
        row = [score(first[m], run(other), H, image.shape) for m, run in methods.items()]
        rows.append(row)
        print(f"| {name} | " + " | ".join(f"{r:.2f} / {m:.2f} / {e:.2f}" for r, m, e in row) + " |")
    print("| mean | " + " | ".join(f"{r:.3f} / {m:.3f} / {e:.2f}" for r, m, e in np.mean(rows, axis=0)) + " |")


SECTIONS = {f.__name__: f for f in (speed, quality)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sections", nargs="*", choices=[*SECTIONS, []], metavar="SECTION", help=", ".join(SECTIONS))
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    for name in arguments.sections or SECTIONS:
        SECTIONS[name]()


if __name__ == "__main__":
    main()
