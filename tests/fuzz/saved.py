"""Files that earlier runs have left, with hostile bytes, members and values; what is accepted must work."""

from __future__ import annotations

import hashlib
import io
import json
import struct
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from slam.atlas.map_io import SavedMap, decode, encode
from slam.bodies.config import ObjectsConfig
from slam.calibration.saved import SavedCalibration, load_calibration
from slam.config import SystemConfig
from slam.geometry.rig_numbers import rig_numbers
from slam.papers.procedure1 import ObjectDatabase
from slam.run.options import RunOptions
from slam.run.recording import load_recording, record, save_recording
from slam.run.run_data import RunData
from slam.run.runner import run_recording
from slam.system import StereoSlam
from tests.fuzz.harness import Broken, Subject
from tests.fuzz.hostile import VALUES, broken_bytes, broken_text, choose
from tests.fuzz.settings import scene

_NUMBERS = (0, -1, 1, 2**31, 2**62, -(2**63), 1e308, -1e308, 1e-308, 1e30, 1e10, np.nan, np.inf, -np.inf, 0.5)
_MAP = b"surf-stereo-slam map 6\n"


@lru_cache(maxsize=1)
def _files() -> dict[str, bytes]:
    """A file of each kind, from a short run."""
    rig, frames = scene()
    folder = Path(tempfile.mkdtemp(prefix="fuzz_"))
    system = StereoSlam(rig, None, "ekf")
    recording = record([system.process_features(f) for f in frames], rig, system.config.models, "desk")
    save_recording(recording, folder / "a.npz")
    run_recording(recording, RunOptions("ekf", "recording", SystemConfig(), folder / "run"))
    ObjectDatabase.of(frames[0], np.arange(len(frames[0])) < 20, rig, np.eye(4)).save(folder / "objects.npz")
    rig_errors = json.dumps(SavedCalibration(system.calibration.posterior, rig_numbers(rig)).to_json())
    kept = {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    return {**kept, "a.map": encode(system.snapshot()), "rig.json": rig_errors.encode()}


def small_map() -> SavedMap:
    return decode(_files()["a.map"], "a.map")


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


def _use_database(path: Path, backend: str) -> None:
    _go_on(config=SystemConfig(objects=ObjectsConfig(mode="procedure1", database=str(path))))


def _use_calibration(path: Path, backend: str) -> None:
    _go_on(backend=backend, rig_prior=load_calibration(path))


def _use_run(path: Path, backend: str) -> None:
    RunData.read(path.parent, "run")


#: By the file that is changed: who uses it.
USES: dict[str, Callable[[Path, str], None]] = {
    "a.map": _use_map, "a.npz": _use_recording, "objects.npz": _use_database, "rig.json": _use_calibration,
    "run/*": _use_run,
}  # fmt: skip


def changed(name: str, rng: np.random.Generator, folder: Path) -> None:
    """Change a file, and use it where it is accepted."""
    files = {k: v for k, v in _files().items() if Path(k).match(name)}
    for key, data in files.items():
        (folder / key).parent.mkdir(exist_ok=True)
        (folder / key).write_bytes(data)
    key = choose(rng, sorted(files))
    (folder / key).write_bytes(_changed(rng, key, files[key]))
    USES[name](folder / key, choose(rng, ("ekf", "smoother")))


def _changed(rng: np.random.Generator, name: str, data: bytes) -> bytes:
    """Bytes, words, members or leaves of a file replaced."""
    if rng.random() < 0.15:
        return broken_bytes(rng, data)
    if name.endswith((".map", ".npz")):
        archive = data.split(b"\n", 2)[2] if name.endswith(".map") else data
        return _pack(rng, _mutated(rng, _unpack(archive)))
    text = data.decode(errors="replace")
    if name.endswith(".json") and rng.random() < 0.7:
        text = json.dumps(_hostile_tree(rng, json.loads(text)))
    return (broken_text(rng, text) if rng.random() < 0.5 else text).encode(errors="replace")


def large_map(rng: np.random.Generator, folder: Path) -> None:
    """Far more landmarks than there are, or landmarks far away, hardly known, or known too well."""
    if rng.random() < 0.2:
        n = int(rng.integers(5000, 100_000))
        covariances = np.tile(np.eye(3), (n, 1, 1))
        signs, ones = np.ones(n, np.int8), np.ones(n, np.int64)
        points, looks = rng.standard_normal((n, 3)), np.zeros((n, 64), np.float32)
        known = SavedMap(np.arange(n), points, covariances, looks, signs, ones, ones)
    else:
        known, scale = small_map(), 10.0 ** rng.integers(-20, 20)
        name = choose(rng, ("positions", "covariances", "descriptors"))
        known = replace(known, **{name: (getattr(known, name) * scale).astype(getattr(known, name).dtype)})
    _go_on(prior_map=known)


def _unpack(data: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(data)) as file:
        return {name: file.read(name) for name in file.namelist()}


def _mutated(rng: np.random.Generator, members: dict[str, bytes]) -> dict[str, bytes]:
    """A member missing, damaged, with a false header, or with hostile values."""
    name = choose(rng, sorted(members))
    kind = int(rng.integers(6))
    if kind == 0:
        del members[name]
        members.setdefault("x.npy", b"")
    elif kind == 1:
        members[name] = broken_bytes(rng, members[name])
    elif kind == 2:
        members[name] = hostile_header(rng)
    elif name.endswith(".npy"):
        out = io.BytesIO()
        array = _hostile_array(rng, np.load(io.BytesIO(members[name])))
        np.lib.format.write_array(out, array, allow_pickle=False)
        members[name] = out.getvalue()
    else:
        members[name] = json.dumps(_hostile_tree(rng, json.loads(members[name]))).encode()
    return members


def _hostile_array(rng: np.random.Generator, array: np.ndarray) -> np.ndarray:
    """An array with hostile numbers, of another type or shape; texts of JSON with hostile leaves."""
    kind = int(rng.integers(6))
    if array.dtype.kind == "U":
        text = str(array)
        if text.startswith("{"):
            return np.array(json.dumps(_hostile_tree(rng, json.loads(text))))
        return np.array(choose(rng, ("", "x", "a\nb", "y" * 100_000, 1.5, 10**10, None, "[" * 5000))).astype("U")
    if kind == 0:
        return array[..., None] if rng.random() < 0.5 else array.ravel()
    if kind == 1:
        return array.astype(choose(rng, (np.float64, np.int64, np.float32, np.uint8, ">f8", np.complex64, "U5", "?")))
    if kind == 2:
        return np.array(choose(rng, (1.5, 2, -1, "1", True)))
    if kind == 3:
        return array[: int(rng.integers(len(array) + 1))] if array.ndim else array
    out, value = np.array(array), choose(rng, _NUMBERS)
    if out.size:
        rows = rng.random(out.shape) < choose(rng, (0.01, 0.5, 1.0))
        rows.flat[int(rng.integers(out.size))] = True
        if out.dtype.kind in "iu":
            limits = np.iinfo(out.dtype)
            value = int(min(max(value, limits.min), limits.max)) if np.isfinite(value) else 0
        with np.errstate(all="ignore"):
            out[rows] = value
    return out


def _hostile_tree(rng: np.random.Generator, tree: Any) -> Any:
    """A tree of JSON with one leaf or branch replaced."""
    node, parent, key = tree, None, None
    while isinstance(node, (dict, list)) and len(node) and (parent is None or rng.random() < 0.8):
        parent = node
        key = choose(rng, list(node)) if isinstance(node, dict) else int(rng.integers(len(node)))
        node = node[key]
    value = choose(rng, [v for v in VALUES if not isinstance(v, (bytes, complex))])
    if parent is None:
        return value
    parent[key] = value
    return tree


def hostile_header(rng: np.random.Generator) -> bytes:
    """An array whose header says what is not so."""
    shape = choose(rng, ("(10**12,)", "(1000000000000,)", "(-1,)", "()", "(2,3)", "(" * 3000, "(1,)" * 100, "None"))
    descr = choose(rng, ("'<f8'", "'|O'", "'<U1000000000'", "[('a', '<f8')]", "'<i8'", "'x'", "None", "'|S0'", "'<U0'"))
    header = f"{{'descr': {descr}, 'fortran_order': {choose(rng, ('False', 'True', '3'))}, 'shape': {shape}, }}"
    text = header.encode() + b" " * 10 + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", min(len(text), 65_535)) + text + bytes(int(rng.integers(100)))


def _pack(rng: np.random.Generator, members: dict[str, bytes]) -> bytes:
    """An archive: packed as usual, oddly packed, marked as encrypted, or one that unpacks to gigabytes."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", choose(rng, (0, 0, 0, 0, 8, 8, zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2))) as file:
        for name, data in members.items():
            file.writestr(name, data)
        if rng.random() < 0.02:
            file.writestr("bomb.npy", bytes(300_000_000), zipfile.ZIP_DEFLATED)
    data = out.getvalue()
    if rng.random() < 0.1:
        data = data.replace(b"PK\x01\x02\x14\x03\x14\x00\x00\x00", b"PK\x01\x02\x14\x03\x14\x00\x01\x00")  # encrypted
    return data


SUBJECTS = (
    Subject("maps", partial(changed, "a.map"), quiet=False, short=40),
    Subject("recordings", partial(changed, "a.npz"), quiet=False, short=40),
    Subject("databases", partial(changed, "objects.npz"), quiet=False, short=20),
    Subject("kept calibrations", partial(changed, "rig.json"), quiet=False, short=30),
    Subject("run folders", partial(changed, "run/*"), quiet=False, short=40),
    Subject("extreme maps", large_map, quiet=False, short=12),
)
