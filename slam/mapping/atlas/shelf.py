"""Features of keyframes in a temporary file instead of in memory."""

from __future__ import annotations

import tempfile
import weakref
from dataclasses import replace
from typing import IO

import numpy as np

from slam.errors import SlamError
from slam.mapping.atlas.keyframes import Keyframe

_ARRAYS = ("landmarks", "points", "descriptors", "laplacian")  # from large to small numbers, so that all are aligned
_ALIGNMENT = 8  # bytes


class Shelf:
    """Puts features of keyframes into a file that goes with this object; the system reads them where they are needed.

    A copy of a shelf is empty: what it holds so far belongs to the keyframes, whose copies are in memory.
    """

    def __init__(self) -> None:
        self._file: IO[bytes] | None = None

    def __getstate__(self) -> dict[str, object]:
        return {"_file": None}

    def put(self, keyframe: Keyframe) -> Keyframe:
        """The same keyframe, its features in the file.

        Raises:
            SlamError: the file cannot be written.
        """
        arrays = {name: np.ascontiguousarray(getattr(keyframe, name)) for name in _ARRAYS}
        data = b"".join(a.tobytes() for a in arrays.values())
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile(prefix="slam_keyframes_")  # noqa: SIM115
                weakref.finalize(self, self._file.close)
            begin = self._file.seek(0, 2)
            self._file.write(data + bytes(-len(data) % _ALIGNMENT))
            self._file.flush()
            whole = np.memmap(self._file, np.uint8, "r", begin, (len(data),))
        except OSError as error:
            raise SlamError(f"atlas.on_disk: {error.strerror or error}") from error
        found, at = {}, 0
        for name, a in arrays.items():
            found[name] = whole[at : at + a.nbytes].view(a.dtype).reshape(a.shape)
            at += a.nbytes
        return replace(keyframe, **found)
