"""Tracks a recording with ORB-SLAM3, for `frame.py`: python orbslam3_worker.py FOLDER

Runs in an environment of its own, which holds ``orbslam3-python`` (GPL-3) and NumPy; imports nothing else. The folder
holds ``frames.npz`` (left, right, stamps), ``vocabulary.txt`` and ``settings.yaml``; ``result.json`` is left there.
Wall time is that of the tracking call, CPU time that of the process from one call to the next, mapping included.
"""

from __future__ import annotations

import json
import resource
import sys
import time
from pathlib import Path

import numpy as np
import orbslam3

TRACKED = 2


def main(folder: Path) -> None:
    frames = np.load(folder / "frames.npz")
    system = orbslam3.System(str(folder / "vocabulary.txt"), str(folder / "settings.yaml"), orbslam3.Sensor.STEREO)
    system.set_use_viewer(False)
    system.initialize()
    wall, cpu, states, poses = [], [], [], []
    before = time.process_time()
    for left, right, stamp in zip(frames["left"], frames["right"], frames["stamps"].tolist()):
        start = time.perf_counter()
        system.process_image_stereo(left, right, stamp)
        wall.append(1e3 * (time.perf_counter() - start))
        states.append(int(getattr(system.get_tracking_state(), "value", system.get_tracking_state())))
        pose = np.asarray(system.get_frame_pose())
        poses.append(np.linalg.inv(pose).tolist() if pose.shape == (4, 4) and np.isfinite(pose).all() else None)
        now = time.process_time()
        cpu.append(1e3 * (now - before))
        before = now
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    result = {"wall": wall, "cpu": cpu, "tracked": [s == TRACKED for s in states], "poses": poses, "memory_mb": peak}
    (folder / "result.json").write_text(json.dumps(result), encoding="utf-8")
    system.shutdown()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
