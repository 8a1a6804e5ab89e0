"""Archives that somebody made on purpose are refused before anything is unpacked."""

from __future__ import annotations

import io
import time
import zipfile

import pytest

from slam.errors import SlamError
from slam.files import unpack


def packed(members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", method) as file:
        for name, data in members.items():
            file.writestr(name, data)
    return out.getvalue()


ONE = packed({"a": b"x"})
AT = ONE.index(b"PK\x01\x02") + 8  # its flags


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (packed({name: bytes(40_000_000) for name in "abc"}), "would unpack to 12"),
        (ONE[:AT] + b"\x01" + ONE[AT + 1 :], "encrypted"),
        (packed({"a": b"x"}, zipfile.ZIP_LZMA), "packed in a way"),
        (packed({f"{k}": b"" for k in range(200)}), "200 members"),
    ],
    ids=["bomb", "encrypted", "packed oddly", "many members"],
)
def test_an_archive_made_on_purpose_is_refused(data, words):
    assert unpack(ONE, "a.npz") == {"a": b"x"}
    started = time.process_time()
    with pytest.raises(SlamError, match=f"a.npz: .*{words}"):
        unpack(data, "a.npz")
    assert time.process_time() - started < 1.0
