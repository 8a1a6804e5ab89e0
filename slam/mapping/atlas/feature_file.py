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


class FeatureFile:
    """Keeps the features of keyframes in a temporary file, memory-mapped, that is deleted with this object.

    A copy of this object is empty, as copied keyframes hold their features in memory.
    """

    def __init__(self) -> None:
        self._file: IO[bytes] | None = None

    def __getstate__(self) -> dict[str, object]:
        return {"_file": None}

    def put(self, keyframe: Keyframe) -> Keyframe:
        """The same keyframe, with its features in the file.

        Raises:
            SlamError: the file cannot be written.
        """
        k = keyframe  # the widest types first, so that all are aligned
        arrays = [np.ascontiguousarray(a) for a in (k.landmarks, k.points, k.descriptors, k.laplacian)]
        data = b"".join(a.tobytes() for a in arrays)
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
        found, at = [], 0
        for a in arrays:
            found.append(whole[at : at + a.nbytes].view(a.dtype).reshape(a.shape))
            at += a.nbytes
        landmarks, points, descriptors, laplacian = found
        return replace(keyframe, landmarks=landmarks, points=points, descriptors=descriptors, laplacian=laplacian)
