"""Files that earlier runs have left, with hostile bytes, members and values; what is accepted must work."""

import hashlib
import json
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from slam.atlas.map_io import decode, encode
from slam.calibration.saved import SavedCalibration, load_calibration
from slam.config import SystemConfig
from slam.geometry.rig import rig_numbers
from slam.run.options import RunOptions
from slam.run.recording import RecordedFrame, Recording, load_recording, save_recording
from slam.run.run_data import RunData
from slam.run.runner import run_recording
from slam.system import StereoSlam
from tests.fuzz.harness import Broken, Subject, scene
from tests.fuzz.mutations import changed, choose

_MAP = b"surf-stereo-slam map 7\n"


@lru_cache(maxsize=1)
def _files() -> dict[str, bytes]:
    """A file of each kind, from a short run."""
    rig, frames = scene()
    folder = Path(tempfile.mkdtemp(prefix="fuzz_"))
    system = StereoSlam(rig, None, "ekf")
    given = tuple(RecordedFrame.of(system.process_features(f)) for f in frames)
    recording = Recording("desk", rig, system.config.models, given)
    save_recording(recording, folder / "a.npz")
    run_recording(recording, RunOptions("ekf", "recording", SystemConfig(), folder / "run"))
    rig_errors = json.dumps(SavedCalibration(system.calibration.posterior, rig_numbers(rig)).to_json())
    kept = {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    return {**kept, "a.map": encode(system.snapshot()), "rig.json": rig_errors.encode()}


def _go_on(**options: Any) -> None:
    """A few frames with what was accepted."""
    rig, frames = scene()
    system = StereoSlam(rig, None, options.pop("backend", "ekf"), **options)
    for features in frames[:3]:
        if not np.isfinite(system.process_features(features).estimate.covariance).all():
            raise Broken("a covariance is not finite")
    system.snapshot()


def _use_map(path: Path, backend: str) -> None:
    body = path.read_bytes()
    if not body.startswith(b"surf"):  # an archive that was changed is signed anew
        body = _MAP + hashlib.sha256(body).hexdigest().encode() + b"\n" + body
    _go_on(backend=backend, prior_map=decode(body, "a.map"))


def _use_recording(path: Path, backend: str) -> None:
    recording = load_recording(path)
    if len(recording) <= 20:
        config = replace(SystemConfig.for_kind(recording.kind, None), models=recording.models)
        run_recording(recording, RunOptions(backend, "recording", config, path.parent / "out"))


def _use_calibration(path: Path, backend: str) -> None:
    _go_on(backend=backend, rig_prior=load_calibration(path))


def _use_run(path: Path, backend: str) -> None:
    RunData.read(path.parent, "run")


#: By the file that is changed: who uses it.
USES: dict[str, Callable[[Path, str], None]] = {
    "a.map": _use_map, "a.npz": _use_recording, "rig.json": _use_calibration,
    "run/*": _use_run,
}  # fmt: skip


def changed_file(name: str, rng: np.random.Generator, folder: Path) -> None:
    """Change a file, and use it where it is accepted."""
    files = {k: v for k, v in _files().items() if Path(k).match(name)}
    for key, data in files.items():
        (folder / key).parent.mkdir(exist_ok=True)
        (folder / key).write_bytes(data)
    key = choose(rng, sorted(files))
    (folder / key).write_bytes(changed(rng, key, files[key]))
    USES[name](folder / key, choose(rng, ("ekf", "smoother")))


SUBJECTS = (
    Subject("maps", partial(changed_file, "a.map"), quiet=False, short=40),
    Subject("recordings", partial(changed_file, "a.npz"), quiet=False, short=40),
    Subject("kept calibrations", partial(changed_file, "rig.json"), quiet=False, short=30),
    Subject("run folders", partial(changed_file, "run/*"), quiet=False, short=40),
)
