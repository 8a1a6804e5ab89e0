"""Map files, written by one run and loaded by another. docs/saved_maps.md describes the format.

A file is two lines of text and a zip archive of a JSON header and NumPy arrays; nothing in it can be executed. The
second line is the SHA-256 of the archive, which detects altered files.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from slam.archives import array, json_text, unpack
from slam.checks import FARTHEST_POSITION, MOST_ID
from slam.data import Estimate, IdArray
from slam.errors import MeasurementError, SlamError
from slam.files import read_bytes, whole_file
from slam.geometry.se3 import Array
from slam.mapping.atlas.atlas import Atlas
from slam.mapping.atlas.keyframes import Keyframe, Loop
from slam.mapping.atlas.saved import ATLAS_TYPES, from_arrays, to_arrays
from slam.mapping.known_landmarks import require_known
from slam.showing import count
from slam.tracks.table import LandmarkTable


class HasMap(Protocol):
    """Whatever has a map to save, such as a running system."""

    def snapshot(self) -> SavedMap:
        """The map as it is now; raises SlamError where there is none."""
        ...


_MAGIC = "surf-stereo-slam map "
_VERSION = 4  # fixed: of the file format
_WITHOUT_PLACES = "2"  # also read; version 3 had keyframes without the common errors of their poses, and is not
_DATE = (1980, 1, 1, 0, 0, 0)  # fixed: of all members, so that the same map gives the same bytes

#: World frame of a map that was built from scratch.
FIRST_FRAME = "left camera at the first frame"

_LARGEST = 2**31  # bytes of a file
_MOST_DIMENSIONS, _LONGEST = 4096, 1e6  # guard: of descriptors

_TYPES = {
    "ids": np.int64, "positions": np.float64, "covariances": np.float64, "descriptors": np.float32,
    "laplacian": np.int8, "seen": np.int64, "in_view": np.int64, "seen_from": np.float64,
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class SavedMap:
    """A map, independent of any run: one row per landmark, ids ascending.

    Attributes:
        ids: landmark ids (N,).
        positions: (N, 3) [m] in the map's world frame.
        covariances: their marginal covariances (N, 3, 3) [m²].
        descriptors: unit vectors (N, D) float32.
        laplacian: signs of the Laplacian (N,) int8.
        seen: number of frames in which each was measured (N,).
        in_view: number of frames in which each was detected or should have been (N,).
        frontend: name of the front end that the descriptors are from; empty where it is not known.
        world_frame: what the world's axes are, in words.
        written_by: name and version of the program.
        seen_from: where the camera was when it saw each first (N, 3) [m] in the map's world frame; NaN where not known.
        source: where it was read from, for messages; not part of the map.
        keyframes: with the poses that the back end estimated at the time.
        keyframe_poses: poses in the map's world frame (K, 4, 4), corrected by loops; by default those of `keyframes`.
        loops: between keyframes.

    Raises:
        SlamError: arrays that do not fit together, or landmarks that no back end would take.
    """

    ids: IdArray
    positions: Array
    covariances: Array
    descriptors: NDArray[np.float32]
    laplacian: NDArray[np.int8]
    seen: IdArray
    in_view: IdArray
    frontend: str = ""
    world_frame: str = FIRST_FRAME
    written_by: str = ""
    source: str = "the map"
    seen_from: Array = field(default=None)  # type: ignore[arg-type]
    keyframes: tuple[Keyframe, ...] = ()
    keyframe_poses: Array = field(default=None)  # type: ignore[arg-type]
    loops: tuple[Loop, ...] = ()

    def __post_init__(self) -> None:
        arrays = [getattr(self, name) for name in _TYPES if name != "seen_from" or self.seen_from is not None]
        if not all(isinstance(a, np.ndarray) and a.ndim for a in arrays):
            raise SlamError(f"{self.source}: an array has the wrong number of dimensions")
        n = len(self.ids)
        if self.seen_from is None:
            object.__setattr__(self, "seen_from", np.full((n, 3), np.nan))
        if self.keyframe_poses is None:
            poses = np.array([k.T_odom_left for k in self.keyframes]).reshape(-1, 4, 4)
            object.__setattr__(self, "keyframe_poses", poses)
        for name, dtype in _TYPES.items():
            array = getattr(self, name)
            if array.dtype != dtype or array.ndim == 0 or len(array) != n:
                raise SlamError(f"{self.source}: {name} must be {n} rows of {np.dtype(dtype)}")
        if self.descriptors.ndim != 2 or any(
            getattr(self, a).ndim != 1 for a in ("ids", "laplacian", "seen", "in_view")
        ):
            raise SlamError(f"{self.source}: an array has the wrong number of dimensions")
        if self.seen_from.shape != (n, 3):
            raise SlamError(f"{self.source}: seen_from must be {n} rows of 3 numbers")
        if n and (self.ids[0] < 0 or self.ids[-1] > MOST_ID or (np.diff(self.ids) <= 0).any()):
            raise SlamError(f"{self.source}: landmark ids must ascend from 0 on, up to {MOST_ID}")
        if not (np.abs(self.descriptors) <= _LONGEST).all() or self.dimensions > _MOST_DIMENSIONS:
            raise SlamError(f"{self.source}: a descriptor is not finite, or far too long")
        if (
            not (np.abs(self.positions) <= FARTHEST_POSITION).all()
            or (np.abs(self.seen_from) > FARTHEST_POSITION).any()
        ):
            raise SlamError(f"{self.source}: the position of a landmark is not finite, or too far away")
        if any(((c := getattr(self, name)) < 0).any() or (c > MOST_ID).any() for name in ("seen", "in_view")):
            raise SlamError(f"{self.source}: a number of frames is impossible")
        try:
            require_known(self.source, self.ids, self.positions, self.covariances)
        except MeasurementError as error:
            raise SlamError(str(error)) from None

    def __len__(self) -> int:
        return len(self.ids)

    def __repr__(self) -> str:
        return f"SavedMap({self.holds}, {self.dimensions}-D, {self.world_frame})"

    @property
    def holds(self) -> str:
        """A summary of the contents, for people."""
        numbers = (len(self), "landmark"), (len(self.keyframes), "keyframe"), (len(self.loops), "loop")
        return ", ".join(count(number, name) for number, name in numbers)

    @property
    def dimensions(self) -> int:
        """Length D of the descriptors."""
        return self.descriptors.shape[1]

    @property
    def next_id(self) -> int:
        """The lowest id above all those of the map's landmarks and of its keyframes' landmarks."""
        return 1 + max([int(ids.max(initial=-1)) for ids in (self.ids, *(k.landmarks for k in self.keyframes))])

    @property
    def rows(self) -> LandmarkTable:
        """The landmarks' bookkeeping at the start of a run that has seen none of them yet."""
        none = np.zeros(len(self), np.int64)
        return LandmarkTable(
            self.ids, self.descriptors, self.laplacian, self.seen, self.in_view, none, none - 1, self.seen_from
        )  # fmt: skip

    @classmethod
    def of(
        cls,
        landmarks: LandmarkTable,
        estimate: Estimate,
        frontend: str,
        world_frame: str,
        version: str,
        atlas: Atlas,
    ) -> SavedMap:
        """The map of a running system: landmark rows, the back end's estimate, what both belong to, and keyframes."""
        P = 0.5 * (estimate.covariances + np.swapaxes(estimate.covariances, 1, 2))
        return cls(
            estimate.ids.astype(np.int64), estimate.positions, P, landmarks.descriptors.astype(np.float32),
            landmarks.laplacian.astype(np.int8), landmarks.seen, landmarks.in_view, frontend, world_frame,
            f"surf-stereo-slam {version}", seen_from=landmarks.seen_from,
            keyframes=atlas.keyframes, keyframe_poses=atlas.poses_in_map(), loops=atlas.loops,
        )  # fmt: skip

    def require_fits(self, frontend: str, dimensions: int | None = None) -> None:
        """Check that a front end's descriptors can be compared with the map's.

        Args:
            frontend: its name; empty where it is not known.
            dimensions: length of its descriptors, where it is known.

        Raises:
            SlamError: they cannot.
        """
        if self.frontend and frontend and self.frontend != frontend:
            raise SlamError(f"{self.source}: its descriptors are of front end {self.frontend!r}, not {frontend!r}")
        if dimensions is not None and dimensions != self.dimensions and len(self):
            raise SlamError(
                f"{self.source}: its descriptors have {self.dimensions} numbers, those of the front end {dimensions}"
            )


def save_map(path: str | Path, what: HasMap | SavedMap) -> None:
    """Write a map, or a system's map, to a file: completely or not at all.

    Raises:
        SlamError: there is no map yet, or the file cannot be written.
    """
    data = encode(what if isinstance(what, SavedMap) else what.snapshot())
    with whole_file(path) as file:
        file.write(data)


def load_map(path: str | Path) -> SavedMap:
    """Read a map.

    Raises:
        SlamError: the file is missing, is no map, is of a version that this program does not know, or was altered or
            cut short.
    """
    return decode(read_bytes(path, _LARGEST, SlamError), str(path))


def encode(saved: SavedMap) -> bytes:
    """The bytes of a file; the same for the same map."""
    texts = {"world_frame": saved.world_frame, "frontend": saved.frontend, "written_by": saved.written_by}
    header = {**texts, "holds": saved.holds}
    members = {"header.json": json.dumps(header, indent=2, sort_keys=True, ensure_ascii=False).encode() + b"\n"}
    arrays = {name: getattr(saved, name) for name in _TYPES} | to_arrays(
        saved.keyframes, saved.keyframe_poses, saved.loops
    )
    for name, values in arrays.items():
        buffer = io.BytesIO()
        np.lib.format.write_array(buffer, np.ascontiguousarray(values), (1, 0), allow_pickle=False)
        members[f"{name}.npy"] = buffer.getvalue()
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_STORED) as file:
        for name, content in members.items():
            file.writestr(zipfile.ZipInfo(name, _DATE), content)
    body = archive.getvalue()
    return f"{_MAGIC}{_VERSION}\n{hashlib.sha256(body).hexdigest()}\n".encode() + body


def decode(data: bytes, source: str) -> SavedMap:
    """The map of a file's bytes; `source` names it in messages. Raises as `load_map` does."""
    first, _, rest = data.partition(b"\n")
    digest, _, body = rest.partition(b"\n")
    if not first.startswith(_MAGIC.encode()):
        raise SlamError(f"{source}: not a saved map")
    version = first[len(_MAGIC) :].decode("ascii", "replace")
    if version not in (_WITHOUT_PLACES, str(_VERSION)):
        known = f"this program reads versions {_WITHOUT_PLACES} and {_VERSION}: make the map again with --save-map"
        raise SlamError(f"{source}: a map of version {version!r}; {known}")
    if hashlib.sha256(body).hexdigest().encode() != digest:
        raise SlamError(f"{source}: the map was altered or cut short: its checksum is wrong")
    return SavedMap(**_members(body, source, version != _WITHOUT_PLACES), source=source)


def _members(body: bytes, source: str, with_places: bool) -> dict[str, Any]:
    """The attributes of `SavedMap` in an archive."""
    members = unpack(body, source)
    kinds = _TYPES | (ATLAS_TYPES if with_places else {})
    missing = {"header.json", *(f"{name}.npy" for name in kinds)} - set(members)
    if missing:
        raise SlamError(f"{source}: the map lacks {min(missing)}")
    header = json_text(members["header.json"], f"{source}: header.json")
    texts = [f.name for f in fields(SavedMap) if f.name in ("frontend", "world_frame", "written_by")]
    if not isinstance(header, dict) or any(not isinstance(header.get(name), str) for name in texts):
        raise SlamError(f"{source}: header.json must give {', '.join(texts)}")
    content: dict[str, Any] = {name: header[name] for name in texts}
    for name, kind in kinds.items():
        content[name] = found = array(members[f"{name}.npy"], name, source)
        if found.dtype != kind:  # of the other byte order, or of another kind
            raise SlamError(f"{source}: {name} must be of {np.dtype(kind)}")
    if with_places:
        arrays = {name: content.pop(name) for name in ATLAS_TYPES}
        names = ("keyframes", "keyframe_poses", "loops")
        content |= dict(zip(names, from_arrays(arrays, content["descriptors"].shape[1:], source)))
    return content
