"""A small vocabulary of ORB descriptors in the text form of DBoW2, for measuring ORB-SLAM3, whose wheel has none.

It is made of rendered images, so it serves for tracking; what it says of loops means little.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

BRANCHES, LEVELS = 10, 4
_ROUNDS = 6  # of clustering at most


def write_vocabulary(images: Iterable[np.ndarray], path: Path, features: int = 500) -> None:
    """Train on images and write the tree: a line a node, parents before children."""
    orb = cv2.ORB_create(features)
    found = [orb.detectAndCompute(image, None)[1] for image in images]
    bits = np.unpackbits(np.concatenate([d for d in found if d is not None]), axis=1)
    rng, lines = np.random.default_rng(0), [f"{BRANCHES} {LEVELS} 0 0"]
    waiting = [(0, 0, np.arange(len(bits)))]  # node, level, its descriptors
    while waiting:
        parent, level, rows = waiting.pop(0)
        for centre, members in _clusters(bits, rows, rng):
            node, leaf = len(lines), level + 1 == LEVELS or len(members) < 2
            lines.append(" ".join(map(str, [parent, int(leaf), *np.packbits(centre).tolist(), 1.0])))
            if not leaf:
                waiting.append((node, level + 1, members))
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def _clusters(bits: np.ndarray, rows: np.ndarray, rng: np.random.Generator) -> list[tuple[np.ndarray, np.ndarray]]:
    """Centres (256,) and members of the clusters of some descriptors, by k-majority."""
    own = bits[rows].astype(np.float32)
    centres = own[rng.permutation(len(rows))[:BRANCHES]]
    for _ in range(_ROUNDS):
        nearest = np.argmin(centres.sum(axis=1) - 2 * own @ centres.T, axis=1)  # Hamming distance, but for a constant
        moved = np.array([own[nearest == k].mean(axis=0) >= 0.5 if (nearest == k).any() else c
                          for k, c in enumerate(centres)], np.float32)  # fmt: skip
        if (moved == centres).all():
            break
        centres = moved
    nearest = np.argmin(centres.sum(axis=1) - 2 * own @ centres.T, axis=1)
    return [(c.astype(np.uint8), rows[nearest == k]) for k, c in enumerate(centres) if (nearest == k).any()]
