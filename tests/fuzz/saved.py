"""Maps and recordings: archives with hostile bytes, members and values; what is accepted must work."""

from __future__ import annotations

import hashlib
import io
import json
import struct
import zipfile
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from slam.calibration.saved import RigNumbers, SavedCalibration, load_calibration
from slam.config import SystemConfig
from slam.mapping.map_io import SavedMap, decode, encode, load_map
from slam.objects.config import ObjectsConfig
from slam.objects.procedure1 import ObjectDatabase
from slam.run.recorded import record
from slam.run.recording import load_recording, save_recording
from slam.run.run_data import RunData, read_objects
from slam.run.runner import RunOptions, run_recording
from slam.system import StereoSlam
from tests.fuzz.harness import Broken, Subject
from tests.fuzz.hostile import VALUES, broken_bytes, broken_text, choose
from tests.fuzz.settings import scene

Members = dict[str, bytes]

_BACKENDS = ("ekf", "smoother")
_NUMBERS = (
    0,
    -1,
    1,
    2**31,
    2**62,
    2**63 - 1,
    -(2**63),
    1e308,
    -1e308,
    1e-308,
    1e30,
    1e10,
    np.nan,
    np.inf,
    -np.inf,
    0.5,
)


@lru_cache(maxsize=1)
def _run() -> tuple[StereoSlam, bytes]:
    """A short run, and the bytes of its recording."""
    rig, frames = scene()
    system = StereoSlam(rig, None, "ekf")
    results = [system.process_features(features) for features in frames]
    recording = record(results, rig, system.config.models, "desk")
    out = Path(_temporary()) / "a.npz"
    save_recording(recording, out)
    return system, out.read_bytes()


def _temporary() -> str:
    import tempfile

    return tempfile.mkdtemp(prefix="fuzz_")


@lru_cache(maxsize=1)
def _map() -> SavedMap:
    return _run()[0].snapshot()


def read_map(rng: np.random.Generator, folder: Path) -> None:
    """A mutated map, and a run that starts in it."""
    data = encode(_map())
    head, _, body = data.partition(b"\n")[2].partition(b"\n")
    kind = int(rng.integers(8))
    if kind == 0:
        (folder / "a.map").write_bytes(broken_bytes(rng, data))
        load_map(folder / "a.map")
        return
    if kind == 1:
        first = choose(rng, (b"surf-stereo-slam map 1.5", b"surf-stereo-slam map " + b"9" * 5000, b"\xff", b""))
        decode(first + b"\n" + head + b"\n" + body, "a.map")
        return
    archive = _pack(rng, _mutated(rng, _unpack(body)))
    if kind == 2:
        archive = broken_bytes(rng, archive)
    signed = b"surf-stereo-slam map 4\n" + hashlib.sha256(archive).hexdigest().encode() + b"\n" + archive
    rig, frames = scene()
    system = StereoSlam(rig, None, choose(rng, _BACKENDS), prior_map=decode(signed, "a.map"))
    for features in frames[:3]:
        system.process_features(features)
    system.snapshot()


def large_map(rng: np.random.Generator, folder: Path) -> None:
    """Far more landmarks than there are, or landmarks far away, hardly known, or known too well."""
    known = _map()
    if rng.random() < 0.2:
        n = int(rng.integers(5000, 100_000))
        known = SavedMap(
            np.arange(n), rng.standard_normal((n, 3)), np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 64), np.float32),
            np.ones(n, np.int8), np.ones(n, np.int64), np.ones(n, np.int64),
        )  # fmt: skip
    else:
        scale = 10.0 ** rng.integers(-20, 20)
        name = choose(rng, ("positions", "covariances", "descriptors"))
        known = replace(known, **{name: (getattr(known, name) * scale).astype(getattr(known, name).dtype)})
    rig, frames = scene()
    system = StereoSlam(rig, None, "ekf" if len(known) > 4999 else choose(rng, _BACKENDS), prior_map=known)
    for features in frames[:2]:
        system.process_features(features)


def kept_calibration(rng: np.random.Generator, folder: Path) -> None:
    """A kept calibration with hostile values, and a run that begins with it."""
    rig, frames = scene()
    path = folder / "a.json"
    tree = SavedCalibration(_run()[0].calibration.posterior, RigNumbers.of(rig)).to_json()
    for _ in range(int(rng.integers(1, 3))):
        tree = _hostile_tree(rng, tree)
    text = json.dumps(tree)
    path.write_text(broken_text(rng, text) if rng.random() < 0.3 else text, errors="replace")
    system = StereoSlam(rig, None, choose(rng, _BACKENDS), rig_prior=load_calibration(path))
    for features in frames[:3]:
        result = system.process_features(features)
        if not np.isfinite(result.estimate.covariance).all():
            raise Broken("a covariance is not finite")


def read_recording(rng: np.random.Generator, folder: Path) -> None:
    """A mutated recording, replayed where it is accepted."""
    data = _run()[1]
    path = folder / "a.npz"
    if rng.random() < 0.2:
        path.write_bytes(broken_bytes(rng, data))
    else:
        path.write_bytes(_pack(rng, _mutated(rng, _unpack(data))))
    recording = load_recording(path)
    if len(recording) > 20:
        return
    backend = choose(rng, _BACKENDS)
    config = replace(SystemConfig.for_kind(recording.kind, None, backend), models=recording.models)
    run_recording(recording, RunOptions(backend, "recording", config, folder / "out"))


def read_database(rng: np.random.Generator, folder: Path) -> None:
    """A mutated database of an object's features, and a run that looks for the object."""
    rig, frames = scene()
    path = folder / "a.npz"
    ObjectDatabase.of(frames[0], np.arange(len(frames[0])) < 20, rig, np.eye(4)).save(path)
    data = path.read_bytes()
    path.write_bytes(broken_bytes(rng, data) if rng.random() < 0.2 else _pack(rng, _mutated(rng, _unpack(data))))
    config = SystemConfig(objects=ObjectsConfig(mode="procedure1", database=str(path)))
    system = StereoSlam(rig, None, "ekf", config=config)
    for features in frames[:3]:
        system.process_features(features)


def read_run(rng: np.random.Generator, folder: Path) -> None:
    """The files of a run, mutated, as the pictures and the viewer read them."""
    for name, data in _run_files().items():
        (folder / name).write_bytes(data)
    for _ in range(int(rng.integers(1, 3))):
        path = choose(rng, sorted(folder.iterdir()))
        kind = int(rng.integers(6))
        if path.is_dir():
            continue
        if kind == 0:
            path.unlink()
            path.mkdir()
        elif kind == 1:
            path.write_bytes(broken_bytes(rng, path.read_bytes()))
        else:
            text = path.read_text(errors="replace")
            path.write_text(broken_text(rng, text), errors="replace")
    RunData.read(folder, "run")
    read_objects(folder)


@lru_cache(maxsize=1)
def _run_files() -> Members:
    """The files of a short run."""
    out = Path(_temporary())
    path = out / "a.npz"
    path.write_bytes(_run()[1])
    run_recording(load_recording(path), RunOptions("ekf", "recording", SystemConfig(), out / "out"))
    return {p.name: p.read_bytes() for p in (out / "out").iterdir()}


def _unpack(data: bytes) -> Members:
    with zipfile.ZipFile(io.BytesIO(data)) as file:
        return {name: file.read(name) for name in file.namelist()}


def _mutated(rng: np.random.Generator, members: Members) -> Members:
    """One or two members changed."""
    changed: set[str] = set()
    for _ in range(int(rng.integers(1, 3))):
        name = choose(rng, sorted(members))
        kind = int(rng.integers(8))
        if kind == 0:
            del members[name]
            members.setdefault("x.npy", b"")
        elif kind == 1:
            members[name] = broken_bytes(rng, members[name])
        elif kind == 2:
            members[name] = hostile_header(rng)
        elif name not in changed:
            members[name] = _hostile_member(rng, name, members[name])
        changed.add(name)
    return members


def _hostile_member(rng: np.random.Generator, name: str, data: bytes) -> bytes:
    """A whole member with hostile values."""
    if not data:
        return b"x"
    if name.endswith(".npy"):
        return _npy(_hostile_array(rng, np.load(io.BytesIO(data))))
    return json.dumps(_hostile_tree(rng, json.loads(data))).encode()


def _hostile_array(rng: np.random.Generator, array: np.ndarray) -> np.ndarray:
    """An array with hostile numbers, of another type or shape; texts of JSON with hostile leaves."""
    kind = int(rng.integers(6))
    if array.dtype.kind == "U":
        text = str(array)
        if text.startswith("{"):
            return np.array(json.dumps(_hostile_tree(rng, json.loads(text))))
        return np.array(
            choose(rng, ("", "x", "a\nb", "y" * 100_000, 1.5, 10**10, None, "[" * 5000)), dtype=None
        ).astype("U")
    if kind == 0:
        return array[..., None] if rng.random() < 0.5 else array.ravel()
    if kind == 1:
        return array.astype(
            choose(rng, (np.float64, np.int64, np.float32, np.uint8, ">f8", ">i8", np.complex64, "U5", "?"))
        )
    if kind == 2:
        return np.array(choose(rng, (1.5, 2, -1, "1", True)))
    if kind == 3:
        return array[: int(rng.integers(len(array) + 1))] if array.ndim else array
    out = np.array(array)
    if out.size:
        with np.errstate(all="ignore"):
            value = choose(rng, _NUMBERS)
            chosen = rng.random(out.shape) < choose(rng, (0.01, 0.5, 1.0))
            chosen.flat[int(rng.integers(out.size))] = True
            number = value if out.dtype.kind == "f" else 0 if not np.isfinite(value) else value
            if out.dtype.kind != "f":
                limits = np.iinfo(out.dtype) if out.dtype.kind in "iu" else None
                number = number if limits is None else int(min(max(int(number), limits.min), limits.max))
            out[chosen] = number
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
    shape = choose(
        rng, ("(10**12,)", "(1000000000000,)", "(-1,)", "()", "(2,3)", "(" * 3000, "(1,)" * 100, "None", "(0,) * 2")
    )
    descr = choose(rng, ("'<f8'", "'|O'", "'<U1000000000'", "[('a', '<f8')]", "'<i8'", "'x'", "None", "'|S0'", "'<U0'"))
    header = f"{{'descr': {descr}, 'fortran_order': {choose(rng, ('False', 'True', '3'))}, 'shape': {shape}, }}"
    text = header.encode() + b" " * 10 + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", min(len(text), 65_535)) + text + bytes(int(rng.integers(100)))


def _npy(array: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.lib.format.write_array(out, array, allow_pickle=False)
    return out.getvalue()


def _pack(rng: np.random.Generator, members: Members) -> bytes:
    """An archive: packed as usual, oddly packed, marked as encrypted, or one that unpacks to gigabytes."""
    method = choose(
        rng, (zipfile.ZIP_STORED,) * 6 + (zipfile.ZIP_DEFLATED,) * 3 + (zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2)
    )
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", method) as file:
        for name, data in members.items():
            file.writestr(name, data)
        if rng.random() < 0.02:
            file.writestr("bomb.npy", _zeros(), zipfile.ZIP_DEFLATED)
    data = out.getvalue()
    if rng.random() < 0.1:
        data = data.replace(b"PK\x01\x02\x14\x03\x14\x00\x00\x00", b"PK\x01\x02\x14\x03\x14\x00\x01\x00")  # encrypted
    return data


@lru_cache(maxsize=1)
def _zeros() -> bytes:
    return bytes(300_000_000)


SUBJECTS = (
    Subject("maps", "mutated maps with right checksums, and runs that start in them", "a run or one line", read_map,
            quiet=False),
    Subject("extreme maps", "maps of 10⁵ landmarks, or scaled by 10⁻²⁰ to 10²⁰", "a run or one line", large_map,
            quiet=False, short=15),
    Subject("kept calibrations", "mutated files of a rig's errors, and runs that begin with them", "a run or one line",
            kept_calibration, short=40),
    Subject("recordings", "mutated recordings, replayed into both back ends", "a run or one line", read_recording,
            quiet=False, short=50),
    Subject("databases", "mutated databases of an object's features, and runs that look for it", "a run or one line",
            read_database, quiet=False, short=25),
    Subject("run folders", "mutated files of a run, read for pictures and the viewer", "a run or one line", read_run,
            quiet=False, short=40),
)  # fmt: skip
