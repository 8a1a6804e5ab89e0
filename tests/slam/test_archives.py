"""Maps and recordings that somebody made on purpose."""

from __future__ import annotations

import io
import time
import zipfile

import numpy as np
import pytest

from experiments.simulated_recording import true_recording
from slam.errors import SequenceError
from slam.run.recording import load_recording, save_recording
from slam.sequences import open_sequence


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
