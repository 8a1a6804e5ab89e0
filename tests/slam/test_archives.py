"""Maps and recordings that somebody made on purpose."""

from __future__ import annotations

import hashlib
import io
import json
import time
import zipfile

import numpy as np
import pytest

from experiments.simulated_recording import true_recording
from slam.archives import unpack
from slam.errors import SequenceError, SlamError
from slam.mapping.map_io import SavedMap, decode, encode
from slam.run.recording import load_recording, save_recording
from slam.sequences import open_sequence
from slam.system import StereoSlam
from tests.fuzz.saved import hostile_header, small_map


def packed(members, method=zipfile.ZIP_DEFLATED):
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", method) as file:
        for name, data in members.items():
            file.writestr(name, data)
    return out.getvalue()


@pytest.fixture(scope="module")
def members(tmp_path_factory):
    """Members of a good recording."""
    path = tmp_path_factory.mktemp("recording") / "a.npz"
    save_recording(true_recording(open_sequence("synthetic:desk?frames=4&density=3")), path)
    with zipfile.ZipFile(path) as file:
        return {name: file.read(name) for name in file.namelist()}


def refused(tmp_path, data, words):
    (tmp_path / "a.npz").write_bytes(data)
    started = time.process_time()
    with pytest.raises(SequenceError, match=words) as caught:
        load_recording(tmp_path / "a.npz")
    assert "\n" not in str(caught.value) and time.process_time() - started < 2.0


def changed(members, **arrays):
    out = dict(members)
    for name, array in arrays.items():
        buffer = io.BytesIO()
        np.lib.format.write_array(buffer, np.asarray(array), allow_pickle=False)
        out[f"{name}.npy"] = buffer.getvalue()
    return packed(out)


@pytest.mark.slow
def test_a_file_that_would_unpack_to_gigabytes_is_not_unpacked(tmp_path, members):
    big = bytes(100_000_000)
    refused(tmp_path, packed({**members, "a.npy": big, "b.npy": big, "c.npy": big}), "would unpack to 3")


def test_encrypted_odd_and_many_members(tmp_path, members):
    data = packed(members)
    at = data.index(b"PK\x01\x02")
    refused(tmp_path, data[: at + 8] + b"\x01" + data[at + 9 :], "encrypted")
    refused(tmp_path, packed(members, zipfile.ZIP_LZMA), "packed in a way")
    refused(tmp_path, packed({f"{k}": b"" for k in range(200)}), "200 members")


def test_members_that_stand_twice():
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as file, pytest.warns(UserWarning):
        file.writestr("a", b"1")
        file.writestr("a", b"2")
    with pytest.raises(SlamError, match="2 members"):
        unpack(out.getvalue(), "x")


@pytest.mark.parametrize("seed", range(40))
def test_headers_of_arrays_that_are_not_true(tmp_path, members, seed):
    refused(tmp_path, packed({**members, "stamps.npy": hostile_header(np.random.default_rng(seed))}), "stamps")


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ({"version": 1.5}, "version 1.5"), ({"version": [1]}, "version"), ({"rig": "[" * 5000}, "JSON"),
        ({"rig": 3}, "rig is no text"), ({"kind": "flying"}, "flying"), ({"stamps": [0.0, 1.0, 2.0, 1e300]}, "beyond"),
    ],
)  # fmt: skip
def test_values_that_are_none(tmp_path, members, arrays, words):
    refused(tmp_path, changed(members, **arrays), words)


@pytest.mark.parametrize("key", ["pixel_sigma", "initial_velocity_sigma", "motion", "objects", "gate_probability"])
@pytest.mark.parametrize("value", [None, "x", 1e308, []])
def test_models_that_are_none(tmp_path, members, key, value):
    tree = json.loads(str(np.load(io.BytesIO(members["models.npy"]))))
    refused(tmp_path, changed(members, models=json.dumps({**tree, key: value})), ".")


def test_a_recording_of_many_stamps_is_checked_quickly(tmp_path, members):
    n = 500_000
    data = changed(members, stamps=np.arange(n, dtype=float), numbers=np.arange(n), shift=np.zeros(n))
    (tmp_path / "a.npz").write_bytes(data)
    started = time.process_time()
    assert len(load_recording(tmp_path / "a.npz")) == n
    assert time.process_time() - started < 20.0  # on a slow machine; what looks at all pairs takes hours


def map_with(**arrays):
    """A map with other arrays, its checksum right."""
    body = encode(small_map()).split(b"\n", 2)[2]
    with zipfile.ZipFile(io.BytesIO(body)) as file:
        found = {name: file.read(name) for name in file.namelist()}
    data = changed(found, **arrays)
    return b"surf-stereo-slam map 5\n" + hashlib.sha256(data).hexdigest().encode() + b"\n" + data


def test_maps_with_impossible_values():
    good = small_map()
    n = len(good)
    ids = good.ids.copy()
    ids[-1] = 2**63 - 1
    cases = {
        "ids": ids, "seen": np.full(n, -1), "in_view": np.full(n, 2**62), "positions": np.full((n, 3), 1e300),
        "descriptors": np.full((n, 64), 1e30, np.float32), "covariances": np.tile(1e300 * np.eye(3), (n, 1, 1)),
        "laplacian": np.int8(1), "seen_from": np.full((n, 3), np.inf),
    }  # fmt: skip
    for name, array in cases.items():
        with pytest.raises(SlamError, match=r"a\.map") as caught:
            decode(map_with(**{name: array}), "a.map")
        assert "\n" not in str(caught.value)


def test_a_map_that_the_filter_cannot_hold_is_refused_in_a_line():
    n = 100_000
    known = SavedMap(
        np.arange(n), np.ones((n, 3)), np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 4), np.float32),
        np.ones(n, np.int8), np.ones(n, np.int64), np.ones(n, np.int64),
    )  # fmt: skip
    rig = open_sequence("synthetic:desk?frames=1").rig
    with pytest.raises(SlamError, match="100000 landmarks, but EkfBackend takes a map of at most 2000"):
        StereoSlam(rig, None, "ekf", prior_map=known)
