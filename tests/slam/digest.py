"""A short run and its digest; ``python -m tests.slam.digest`` prints those of back ends, or of parts, as JSON."""

import hashlib
import json
import sys
import threading
from collections.abc import Iterable
from functools import cache
from typing import Any

import numpy as np

import backends
import slam
from frontends.surf import Surf
from slam.config import SystemConfig
from slam.data import StereoFeatures
from slam.system import StereoSlam
from tests.backends.scenes import RIG, path, scene
from tests.backends.scenes import run as step_through

SEQUENCE = slam.open_sequence("synthetic:box?density=300&frames=100")
FIRST = 58  # the box moves, and is found some thirty frames later
BACKENDS = ("ekf", "smoother")


@cache
def seen(k: int) -> StereoFeatures:
    """Features of the k-th frame of the run."""
    return SEQUENCE.observations(FIRST + k)


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
    told = StereoSlam(SEQUENCE.rig, None, backend)
    results = [told.process_features(seen(k)) for k in range(frames)]
    bodies = [body.estimate.T_world_object for result in results for body in result.objects]
    config = SystemConfig.for_kind(SEQUENCE.kind).with_settings([f"frontend.threads={threads}"])
    shown = StereoSlam(SEQUENCE.rig, "surf", backend, config=config)
    for frame in SEQUENCE.frames(FIRST, FIRST + images):
        shown.process(frame)
    return {"observations": state(told), "images": state(shown), "bodies": digest_of(bodies), "count": str(len(bodies))}


def parts() -> dict[str, str]:
    """Digests of the features of an image, and of what a filter knows after some frames: few kernels are compiled."""
    keypoints, descriptors = Surf(300).detect_and_describe(SEQUENCE.frame(FIRST).left)
    backend = backends.create("ekf", RIG)
    step_through(backend, scene(path(12, 0.1, np.array([0.0, 0.0, 0.5]), np.array([0.0, 0.03, 0.0]))))
    found = backend.estimate()
    return {
        "features": digest_of([keypoints.uv, keypoints.response, descriptors]),
        "estimate": digest_of([found.T_world_left, found.covariance, found.positions, found.covariances]),
    }


def main() -> None:
    if sys.argv[1] == "parts":
        print(json.dumps(parts()))
        return
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
