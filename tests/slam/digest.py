"""What a short run comes to, as a digest; ``python -m tests.slam.digest`` prints those of all back ends as JSON."""

from __future__ import annotations

import hashlib
import json
import sys
import threading
from collections.abc import Iterable
from typing import Any

import numpy as np

import slam
from slam.config import SystemConfig
from slam.system import StereoSlam

WORLD = "synthetic:box?density=300&frames=100"
FIRST = 58  # the box moves, and is found some thirty frames later
BACKENDS = ("ekf", "smoother")


def digest_of(arrays: Iterable[Any]) -> str:
    """The same for the same bytes."""
    found = hashlib.sha256()
    for array in arrays:
        found.update(np.ascontiguousarray(array).tobytes())
    return found.hexdigest()


def state(system: StereoSlam) -> str:
    """Digest of path, map, covariances, descriptors and bodies."""
    e, path, rows = system.estimate(), system.trajectory(), system.landmarks
    parts = [e.T_world_left, e.covariance, e.ids, e.positions, e.covariances, path.stamps, path.poses]
    return digest_of([*parts, rows.descriptors, rows.seen, system.calibration.posterior.mean])


def run(backend: str, frames: int, images: int, threads: int) -> dict[str, str]:
    """Digests of a run on observations, and of one on images."""
    sequence = slam.open_sequence(WORLD)
    seen = StereoSlam(sequence.rig, None, backend)
    results = [seen.process_features(sequence.observations(FIRST + k)) for k in range(frames)]
    bodies = [body.estimate.T_world_object for result in results for body in result.objects]
    config = SystemConfig.for_kind(sequence.kind).with_settings([f"frontend.threads={threads}"])
    shown = StereoSlam(sequence.rig, "surf", backend, config=config)
    for frame in sequence.frames(FIRST, FIRST + images):
        shown.process(frame)
    return {"observations": state(seen), "images": state(shown), "bodies": digest_of(bodies), "count": str(len(bodies))}


def main() -> None:
    threads, elsewhere = int(sys.argv[1]), sys.argv[2] == "elsewhere"
    found: dict[str, dict[str, str]] = {}

    def work() -> None:
        for backend in BACKENDS:
            found[backend] = run(backend, 40, 4, threads)

    if elsewhere:
        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
    else:
        work()
    print(json.dumps(found))


if __name__ == "__main__":
    main()
