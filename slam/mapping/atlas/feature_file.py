"""Features of keyframes in a temporary file instead of in memory."""

from __future__ import annotations

import tempfile
import weakref
from dataclasses import replace
from typing import IO

import numpy as np

from slam.errors import SlamError
from slam.mapping.atlas.keyframes import Keyframe

_ALIGNMENT = 8  # fixed: bytes
_PIECE = 2**26  # fixed: bytes of the file that are mapped at once; each piece takes a file descriptor


class FeatureFile:
    """Keeps the features of keyframes in a temporary file, memory-mapped, that is deleted with this object.

    A copy of this object is empty, as copied keyframes hold their features in memory.
    """

    def __init__(self) -> None:
        self._file: IO[bytes] | None = None
        self._piece = np.zeros(0, np.uint8)  # the last piece of the file, where it begins, and how much of it is used
        self._begin = self._used = 0

    def __getstate__(self) -> dict[str, object]:
        return FeatureFile().__dict__

    def put(self, keyframe: Keyframe) -> Keyframe:
        """The same keyframe, with its features in the file.

        Raises:
            SlamError: the file cannot be written.
        """
        k = keyframe  # the widest types first, so that all are aligned
        arrays = [np.ascontiguousarray(a) for a in (k.landmarks, k.points, k.descriptors, k.laplacian)]
        data = b"".join(a.tobytes() for a in arrays)
        try:
            whole = self._written(data + bytes(-len(data) % _ALIGNMENT))
        except OSError as error:
            raise SlamError(f"atlas.on_disk: {error.strerror or error}") from error
        found, at = [], 0
        for a in arrays:
            found.append(whole[at : at + a.nbytes].view(a.dtype).reshape(a.shape))
            at += a.nbytes
        landmarks, points, descriptors, laplacian = found
        return replace(keyframe, landmarks=landmarks, points=points, descriptors=descriptors, laplacian=laplacian)

    def _written(self, data: bytes) -> np.ndarray:
        """The bytes in the file, memory-mapped; raises OSError where there is no room for them."""
        if self._file is None:
            self._file = tempfile.TemporaryFile(prefix="slam_keyframes_", buffering=0)  # noqa: SIM115
            weakref.finalize(self, self._file.close)
        if self._used + len(data) > len(self._piece):
            begin, size = self._file.seek(0, 2), max(_PIECE, len(data))
            self._file.truncate(begin + size)  # takes no room on the disk yet
            self._piece, self._begin, self._used = np.memmap(self._file, np.uint8, "r", begin, (size,)), begin, 0
        self._file.seek(self._begin + self._used)
        rest = memoryview(data)
        while rest:
            rest = rest[self._file.write(rest) :]
        found = self._piece[self._used : self._used + len(data)]
        self._used += len(data)
        return found
