"""Map files, written by one run and loaded by another. docs/saved_maps.md describes the format.

A file is two lines of text and a zip archive of a JSON header and NumPy arrays; nothing in it can be executed. The
second line is the SHA-256 of the archive, which detects altered files.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.atlas.atlas import Atlas
from slam.atlas.keyframes import Keyframe, Loop
from slam.checks import FARTHEST_POSITION, MOST_ID, definite, require_known
from slam.data import Estimate, IdArray
from slam.errors import MeasurementError, SlamError
from slam.files import Kind, json_text, read_bytes, require_arrays, unpack, whole_file
from slam.geometry.rig import StereoRig, rig_difference, rig_numbers
from slam.geometry.se3 import Array, nearest_rotation
from slam.naming import count
from slam.tracks.table import LandmarkTable
from slam.version import __version__

_MAGIC = "surf-stereo-slam map "
_VERSION = 7  # fixed: of the file format

_LARGEST = 2**31  # bytes of a file
_MOST_DIMENSIONS, _LONGEST = 4096, 1e6  # guard: of descriptors
_GREATEST = 1e12  # guard: entry of a covariance [rad², m²], and time [s]
_RIG = ("width", "height", "focal", "baseline")  # by which a map tells its rig from others
_REFINED = 0.03  # guard: calibrations of one rig differ by less: it is ten deviations of a focal length, by the prior
_FAR, _HALF = FARTHEST_POSITION, float(np.finfo(np.float16).max)


#: Arrays of the landmarks.
_LANDMARKS = {
    "ids": Kind(np.int64, "n", 0, MOST_ID), "positions": Kind(np.float64, "n3", -_FAR, _FAR),
    "covariances": Kind(np.float64, "n33", -np.inf, np.inf),
    "descriptors": Kind(np.float32, "nd", -_LONGEST, _LONGEST), "laplacian": Kind(np.int8, "n", -128, 127),
    "seen": Kind(np.int64, "n", 0, MOST_ID), "in_view": Kind(np.int64, "n", 0, MOST_ID),
    "seen_from": Kind(np.float64, "n3", -_FAR, _FAR, "unknown"),
}  # fmt: skip

#: Those, keyframes by their attributes, the features of all of them in succession, and loops.
_ARRAYS = _LANDMARKS | {
    "keyframe_stamps": Kind(np.float64, "k", -_GREATEST, _GREATEST, field="stamp"),
    "keyframe_poses": Kind(np.float64, "k44", -_FAR, _FAR, "pose"),
    "keyframe_odometry": Kind(np.float64, "k44", -_FAR, _FAR, "pose", "T_odom_left"),
    "keyframe_covariances": Kind(np.float64, "k66", -_GREATEST, _GREATEST, "covariance", "covariance"),
    "keyframe_steps": Kind(np.float64, "k66", -_GREATEST, _GREATEST, "covariance", "step_covariance"),
    "keyframe_shares": Kind(np.float64, "k6m", -_GREATEST, _GREATEST, field="jacobian"),
    "keyframe_travelled": Kind(np.float64, "k", -_FAR, _FAR, field="travelled"),
    "keyframe_depths": Kind(np.float64, "k", np.nextafter(0, 1), _FAR, field="depth"),
    "keyframe_features": Kind(np.int64, "k", 0, MOST_ID),
    "place_points": Kind(np.float32, "f3", -_FAR, _FAR, field="points"),
    "place_descriptors": Kind(np.float16, "fd", -_HALF, _HALF, field="descriptors"),
    "place_laplacian": Kind(np.int8, "f", -128, 127, field="laplacian"),
    "place_landmarks": Kind(np.int64, "f", -1, MOST_ID, field="landmarks"),
    "loop_pairs": Kind(np.int64, "l2", 0, MOST_ID),
    "loop_motions": Kind(np.float64, "l44", -_FAR, _FAR, "pose", "T_first_second"),
    "loop_covariances": Kind(np.float64, "l66", -_GREATEST, _GREATEST, "covariance", "covariance"),
    "loop_inliers": Kind(np.int64, "l", 0, MOST_ID, field="inliers"),
    "rig": Kind(np.float64, "r", np.nextafter(0, 1), _GREATEST),
}


def _require(arrays: Mapping[str, Any], kinds: Mapping[str, Kind], source: str) -> None:
    """Raise SlamError where arrays are not of their kinds, or a row is no pose or covariance though it must be one."""
    require_arrays(arrays, kinds, source)
    for name, kind in kinds.items():
        if kind.what == "covariance" and any(_no_covariance(P) for P in arrays[name]):
            raise SlamError(f"{source}: {name} holds what is no covariance")
        R = arrays[name][:, :3, :3] if kind.what == "pose" else ()
        if any(np.abs(nearest_rotation(rotation) - rotation).max() > 1e-6 for rotation in R):
            raise SlamError(f"{source}: {name} holds what is no pose")


def _no_covariance(P: np.ndarray) -> bool:
    """Whether a matrix (6, 6) is not symmetric, or has a negative eigenvalue beyond rounding."""
    largest = np.abs(P).max()
    return bool(np.abs(P - P.T).max() > 1e-6 * largest or np.linalg.eigvalsh(P).min() < -1e-6 * largest)


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
        seen_from: where the camera was when it saw each first (N, 3) [m] in the map's world frame; NaN where not known.
        source: where it was read from, for messages; not part of the map.
        keyframes: with the poses of the rectified left camera that the back end estimated at the time.
        keyframe_poses: those poses in the map's world frame (K, 4, 4), corrected by loops; by default uncorrected.
        loops: between keyframes.
        rig: width, height and focal length of the rectified images [px], and baseline [m], (4,); empty where not known.

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
    source: str = "the map"
    seen_from: Array = field(default=None)  # type: ignore[arg-type]
    keyframes: tuple[Keyframe, ...] = ()
    keyframe_poses: Array = field(default=None)  # type: ignore[arg-type]
    loops: tuple[Loop, ...] = ()
    rig: Array = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        n = len(self.ids) if isinstance(self.ids, np.ndarray) and self.ids.ndim else 0
        if self.seen_from is None:
            object.__setattr__(self, "seen_from", np.full((n, 3), np.nan))
        if self.keyframe_poses is None:
            poses = np.array([k.T_odom_left for k in self.keyframes]).reshape(-1, 4, 4)
            object.__setattr__(self, "keyframe_poses", poses)
        _require(vars(self), _LANDMARKS, self.source)
        rig = self.rig if isinstance(self.rig, np.ndarray) else np.zeros(1)
        if rig.shape not in ((0,), (len(_RIG),)) or not (np.isfinite(rig) & (rig > 0)).all():
            raise SlamError(f"{self.source}: the rig must be {len(_RIG)} positive numbers, or none")
        if (np.diff(self.ids) <= 0).any():
            raise SlamError(f"{self.source}: landmark ids must ascend")
        if self.dimensions > _MOST_DIMENSIONS:
            raise SlamError(f"{self.source}: descriptors of {self.dimensions} numbers")
        try:
            require_known(self.source, self.ids, self.positions, self.covariances)
        except MeasurementError as error:
            raise SlamError(str(error)) from None

    def __len__(self) -> int:
        return len(self.ids)

    def __repr__(self) -> str:
        return f"SavedMap({self.holds}, {self.dimensions}-D)"

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
        cls, landmarks: LandmarkTable, estimate: Estimate, frontend: str, atlas: Atlas,
        rig: StereoRig,
    ) -> SavedMap:  # fmt: skip
        """The map of a running system: landmark rows, the back end's estimate, what both belong to, and keyframes."""
        numbers = rig_numbers(rig)
        P = definite(estimate.covariances)
        return cls(
            estimate.ids.astype(np.int64), estimate.positions, P, landmarks.descriptors.astype(np.float32),
            landmarks.laplacian.astype(np.int8), landmarks.seen, landmarks.in_view, frontend,
            seen_from=landmarks.seen_from, keyframes=atlas.keyframes, keyframe_poses=atlas.poses_in_map,
            loops=atlas.loops, rig=np.array([numbers[name] for name in _RIG]),
        )  # fmt: skip

    def require_fits(self, frontend: str, rig: StereoRig) -> None:
        """Check that the cameras and the front end, which may be empty where it is not known, are those of the map.

        Another calibration of the same cameras is accepted: what it changes is small.

        Raises:
            SlamError: they are not.
        """
        here, numbers = rig_numbers(rig), list(zip(_RIG, self.rig.tolist()))  # first the size of the images
        if other := rig_difference(dict(numbers[:2]), here) or rig_difference(dict(numbers[2:]), here, _REFINED):
            raise SlamError(f"{self.source}: the map is of another rig: {other}")
        if self.frontend and frontend and self.frontend != frontend:
            raise SlamError(f"{self.source}: its descriptors are of front end {self.frontend!r}, not {frontend!r}")


def save_map(path: str | Path, what: Any) -> None:
    """Write a `SavedMap`, or the map of a `StereoSlam`, to a file: completely or not at all.

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
    expected = "a map, which `slam run --save-map FILE` leaves"
    return decode(read_bytes(path, _LARGEST, SlamError, expected), str(path))


def encode(saved: SavedMap) -> bytes:
    """The bytes of a file; the same for the same map."""
    header = {"frontend": saved.frontend, "holds": saved.holds, "written_by": f"surf-stereo-slam {__version__}"}
    archive = io.BytesIO()
    arrays: dict[str, Any] = dict(map_arrays(saved))
    np.savez(archive, **arrays)
    with zipfile.ZipFile(archive, "a") as file:
        content = json.dumps(header, indent=2, sort_keys=True, ensure_ascii=False) + "\n"
        # its date is that which NumPy gives all members, so that the same map gives the same bytes
        file.writestr(zipfile.ZipInfo("header.json"), content)
    body = archive.getvalue()
    return f"{_MAGIC}{_VERSION}\n{hashlib.sha256(body).hexdigest()}\n".encode() + body


def decode(data: bytes, source: str) -> SavedMap:
    """The map of a file's bytes; `source` names it in messages. Raises as `load_map` does."""
    first, _, rest = data.partition(b"\n")
    digest, _, body = rest.partition(b"\n")
    if not first.startswith(_MAGIC.encode()):
        raise SlamError(f"{source}: not a saved map")
    version = first[len(_MAGIC) :].decode("ascii", "replace")
    if version != str(_VERSION):
        known = f"this program reads version {_VERSION}: make the map again with --save-map"
        raise SlamError(f"{source}: a map of version {version!r}; {known}")
    if hashlib.sha256(body).hexdigest().encode() != digest:
        raise SlamError(f"{source}: the map was altered or cut short: its checksum is wrong")
    members = unpack(body, source, ("header.json", *_ARRAYS))
    header = json_text(members["header.json"], f"{source}: header.json")
    if not isinstance(header, dict) or not isinstance(header.get("frontend"), str):
        raise SlamError(f"{source}: header.json must give the frontend")
    return map_of(members, header["frontend"], source)


def map_arrays(saved: SavedMap) -> dict[str, np.ndarray]:
    """A map as arrays by the names of `_ARRAYS`."""
    k, loops = saved.keyframes, saved.loops
    m = max((f.jacobian.shape[1] for f in k), default=0)
    k = tuple(f if f.jacobian.shape[1] == m else replace(f, jacobian=np.zeros((6, m))) for f in k)
    numbers = len(k), m, len(loops), len(saved), saved.dimensions, sum(map(len, k)), len(saved.rig)
    sizes = dict(zip("kmlndfr", numbers))
    whole: dict[str, Any] = {"keyframe_features": [len(f) for f in k], "loop_pairs": [x.pair for x in loops]}
    arrays: dict[str, np.ndarray] = {}
    for name, kind in _ARRAYS.items():
        if kind.field:
            values: Any = [getattr(x, kind.field) for x in (loops if kind.shape[0] == "l" else k)]
            values = np.concatenate(values) if kind.shape[0] == "f" and values else values
        else:
            values = whole[name] if name in whole else getattr(saved, name)
        shape = [sizes[c] if c.isalpha() else int(c) for c in kind.shape]
        arrays[name] = np.ascontiguousarray(np.array(values, kind.dtype).reshape(shape))
    return arrays


def map_of(arrays: Mapping[str, np.ndarray], frontend: str, source: str) -> SavedMap:
    """The map of arrays by the names of `_ARRAYS`, whose descriptors are of a front end.

    Raises:
        SlamError: the arrays do not fit together, or a value is impossible; `source` names them in the message.
    """
    _require(arrays, _ARRAYS, source)
    begin = np.concatenate([[0], np.cumsum(arrays["keyframe_features"])]).astype(int).tolist()
    pairs = arrays["loop_pairs"]
    if begin[-1] != len(arrays["place_points"]):
        raise SlamError(f"{source}: the keyframes have other features than there are")
    if (pairs >= len(begin) - 1).any() or (pairs[:, :1] >= pairs[:, 1:]).any():
        raise SlamError(f"{source}: a loop is between keyframes that there are not")

    def fields_of(**rows: Any) -> dict[str, Any]:
        """Fields of a keyframe or loop, given its row, or the slice of its rows, in arrays of each size."""
        kinds = ((name, kind) for name, kind in _ARRAYS.items() if kind.field and kind.shape[0] in rows)
        found = {kind.field: arrays[name][rows[kind.shape[0]]] for name, kind in kinds}
        return {name: x.item() if x.ndim == 0 else x for name, x in found.items()}

    keyframes = [Keyframe(-1, **fields_of(k=i, f=slice(*span))) for i, span in enumerate(pairwise(begin))]
    loops = [Loop(first, second, **fields_of(l=i)) for i, (first, second) in enumerate(pairs.tolist())]
    whole: dict[str, Any] = {name: arrays[name] for name in (*_LANDMARKS, "keyframe_poses", "rig")}
    return SavedMap(**whole, frontend=frontend, source=source, keyframes=tuple(keyframes), loops=tuple(loops))
