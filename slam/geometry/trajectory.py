"""A camera's path: stamps and poses, in the file forms of TUM, KITTI and EuRoC, and its alignment with another one."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from slam.errors import TrajectoryError
from slam.files import read_text, write_text
from slam.geometry.arrays import Table
from slam.geometry.se3 import Array, nearest_rotation, pose, quaternion, rotation_from_quaternion, so3_exp
from slam.naming import count

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, eq=False)
class Trajectory(Table):
    """Poses over time.

    Attributes:
        stamps: times (N,) [s], strictly increasing.
        poses: ``T_world_left`` (N, 4, 4).

    Raises:
        TrajectoryError: shapes differ, a value is not finite, or time does not increase.
    """

    stamps: Array
    poses: Array

    def __post_init__(self) -> None:
        try:
            stamps, poses = np.asarray(self.stamps, float), np.asarray(self.poses, float)
        except (TypeError, ValueError, OverflowError):
            raise TrajectoryError("trajectory: stamps and poses must be arrays of numbers") from None
        object.__setattr__(self, "stamps", stamps)
        object.__setattr__(self, "poses", poses)
        if stamps.ndim != 1:
            raise TrajectoryError(f"trajectory: stamps must be an array (N,), got {stamps.shape}")
        if self.poses.shape != (len(self.stamps), 4, 4):
            raise TrajectoryError(f"trajectory: {len(self.stamps)} stamps, poses {self.poses.shape}")
        if not (np.isfinite(self.stamps).all() and np.isfinite(self.poses).all()):
            raise TrajectoryError("trajectory: a value is not finite")
        if (np.diff(self.stamps) <= 0).any():
            row = int(np.argmax(np.diff(self.stamps) <= 0)) + 1
            raise TrajectoryError(f"trajectory: time does not increase at row {row}")

    def __repr__(self) -> str:
        seconds = float(self.stamps[-1] - self.stamps[0]) if len(self) else 0.0
        return f"Trajectory({count(len(self), 'pose')}, {seconds:.3f} s, {self.length:.3f} m)"

    def plot(self, axis: Axes | None = None, plane: str = "", **options: Any) -> Axes:
        """Draw the path, two of its coordinates, both on one scale.

        Args:
            axis: of matplotlib, to draw into; None for a new figure.
            plane: the coordinates to the right and up, such as ``"xz"``: the top view, if the world is the first
                camera's frame. If it is empty, the two in which the path extends farthest.
            **options: of the line, such as ``label="ekf"``.

        Returns:
            the axis.

        Raises:
            TrajectoryError: the plane is not named by two of x, y, z.
        """
        if plane and not (len(plane) == 2 and set(plane) <= set("xyz")):
            raise TrajectoryError(f"trajectory: a plane is two of x, y and z, such as 'xz', not {plane!r}")
        if axis is None:
            import matplotlib.pyplot as plt

            axis = plt.figure(layout="constrained").add_subplot()
        extent = np.ptp(self.positions, axis=0) if len(self) else np.array([1.0, 0.0, 1.0])
        across, up = map("xyz".index, plane) if plane else sorted(np.argsort(-extent, kind="stable")[:2])
        axis.plot(self.positions[:, across], self.positions[:, up], **options)
        if "label" in options:
            axis.legend()
        axis.set(xlabel=f"{'xyz'[across]} [m]", ylabel=f"{'xyz'[up]} [m]")
        axis.set_aspect("equal", adjustable="datalim")
        return axis

    @property
    def positions(self) -> Array:
        """Camera positions (N, 3) [m]."""
        return self.poses[:, :3, 3]

    @property
    def length(self) -> float:
        """Length of the path [m]."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())

    @classmethod
    def empty(cls) -> Trajectory:
        """No pose."""
        return cls(np.zeros(0), np.zeros((0, 4, 4)))

    def write_tum(self, path: str | Path) -> None:
        """Write ``stamp tx ty tz qx qy qz qw`` lines."""
        write_text(path, "".join(tum_line(s, T) for s, T in zip(self.stamps, self.poses)))

    def write_kitti(self, path: str | Path) -> None:
        """Write rows of twelve numbers, the upper (3, 4) of each pose; stamps are lost."""
        rows = self.poses[:, :3].reshape(-1, 12).tolist()
        write_text(path, "".join(" ".join(f"{x:.9e}" for x in row) + "\n" for row in rows))

    def write_euroc(self, path: str | Path) -> None:
        """Write EuRoC's CSV: ``timestamp [ns], position, quaternion w x y z``."""
        q = quaternion(self.poses[:, :3, :3])[:, [3, 0, 1, 2]]
        head = "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []\n"
        rows = zip(self.stamps.tolist(), self.positions, q)
        lines = (",".join([f"{s * 1e9:.0f}", *(f"{x:.9f}" for x in (*p, *qi))]) + "\n" for s, p, qi in rows)
        write_text(path, head + "".join(lines))

    @classmethod
    def read_tum(cls, path: str | Path) -> Trajectory:
        """Read ``stamp tx ty tz qx qy qz qw`` lines; raises TrajectoryError with the file's name."""
        rows = _read_table(path, None, "stamp tx ty tz qx qy qz qw")
        return cls._of_file(path, rows[:, 0], pose(_rotations(path, rows[:, 4:8]), rows[:, 1:4]))

    @classmethod
    def read_kitti(cls, path: str | Path) -> Trajectory:
        """Read rows of twelve numbers; stamps are the row numbers."""
        rows = _read_table(path, None, "r11 r12 r13 tx r21 r22 r23 ty r31 r32 r33 tz")
        poses = np.tile(np.eye(4), (len(rows), 1, 1))
        poses[:, :3] = rows[:, :12].reshape(-1, 3, 4)
        return cls._of_file(path, np.arange(len(rows), dtype=float), poses)

    @classmethod
    def read_euroc(cls, path: str | Path) -> Trajectory:
        """Read EuRoC's ground truth CSV (body frame): the first eight columns."""
        rows = _read_table(path, ",", "timestamp x y z qw qx qy qz")
        R = _rotations(path, rows[:, [5, 6, 7, 4]])
        return cls._of_file(path, rows[:, 0] * 1e-9, pose(R, rows[:, 1:4]))

    @classmethod
    def _of_file(cls, path: str | Path, stamps: Array, poses: Array) -> Trajectory:
        """The trajectory of a file's rows; faults are reported under the file's name."""
        try:
            return cls(stamps, poses)
        except TrajectoryError as error:
            raise TrajectoryError(f"{path}: {error}") from error


def tum_line(stamp: float, T: Array) -> str:
    """One line of a TUM file, newline included."""
    values = (*T[:3, 3], *quaternion(T[:3, :3]))
    return f"{stamp:.9f} " + " ".join(f"{v:.9f}" for v in values) + "\n"


def _rotations(path: str | Path, quaternions: Array) -> Array:
    """Rotations (N, 3, 3) of a file's quaternions (N, 4) as (x, y, z, w)."""
    largest = np.abs(quaternions).max(axis=1)
    for wrong, what in ((largest < 1e-6, "zero"), (largest > 1e6, "none: its numbers are too large")):
        if wrong.any():
            raise TrajectoryError(f"{path}: the quaternion of row {int(np.argmax(wrong))} is {what}")
    return rotation_from_quaternion(quaternions)


def _read_table(path: str | Path, delimiter: str | None, columns: str) -> Array:
    """Finite numbers of a text table with at least these columns."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # an empty file is an error below
            text = read_text(path, error=TrajectoryError)
            rows = np.loadtxt(text.splitlines(), delimiter=delimiter, ndmin=2, comments="#")
    except ValueError as error:
        if delimiter is None and "," in text.splitlines()[-1]:
            raise TrajectoryError(f"{path}: its columns are apart by commas, and have to be by spaces") from error
        raise TrajectoryError(f"{path}: cannot be read as a trajectory: {error}") from error
    needed = len(columns.split())
    if rows.shape[1] < needed or not len(rows):
        raise TrajectoryError(f"{path}: its {needed} columns must be {columns}, found are {rows.shape[1]}")
    if not np.isfinite(rows[:, :needed]).all():
        raise TrajectoryError(f"{path}: a value is not finite")
    return rows


@dataclass(frozen=True)
class TruthNoise:
    """How far a sequence's true poses may be off.

    Attributes:
        rotation: standard deviation of each rotation axis [rad]; how fast this error and that of the translation change
            is found from the path, see `slam.evaluation.truth_error`.
        translation: the same of each coordinate [m].
        time: the same of the stamps [s]: a pose is that of a moment before or after; independent in each
            pose.
        mounting: standard deviation of a rotation between the truth's axes and the camera's [rad] that is the same in
            all poses: how the other sensor is mounted, and its own slow errors.
        lever: likewise, of each coordinate of the camera's place beside the other sensor [m].
        clock: likewise, of the time by which the other sensor's clock is ahead [s].
        wheels: the camera is on a vehicle that does not slip sideways, and looks ahead.
    """

    rotation: float = 0.0
    translation: float = 0.0
    time: float = 0.0
    mounting: float = 0.0
    lever: float = 0.0
    clock: float = 0.0
    wheels: bool = False

    @property
    def covariance(self) -> Array:
        """Covariance (6, 6) of one true pose, [rotation, translation], in its own axes; without that of its stamp."""
        return np.diag(np.repeat(np.square([self.rotation, self.translation]), 3))


_STILL = 1e-12  # numerics: [m²] product of the two spreads: less than a micrometre each is no motion
_LINE = 1e-12  # numerics: second singular value by the first, below which positions lie on a line


def alignment(estimate: Trajectory, truth: Trajectory) -> Array:
    """The motion (4, 4) that takes an estimated path's positions nearest to the true ones, row by row (Umeyama 1991).

    The scale stays. Where positions leave a turn open (fewer than three, on one line, standing still), orientations
    decide it: the mean of ``R_true R_estimateᵀ``, to which the rotation is brought nearest.

    Raises:
        TrajectoryError: the lengths differ, there is no pose, or a position is impossibly large.
    """
    if len(estimate) != len(truth) or not len(truth):
        raise TrajectoryError(f"alignment: {len(estimate)} estimated poses, {len(truth)} true ones")
    if np.abs([estimate.positions, truth.positions]).max() > 1e100:  # 1e100: position [m] whose square is a number
        raise TrajectoryError("alignment: a position is impossibly large")
    centre, true_centre = estimate.positions.mean(axis=0), truth.positions.mean(axis=0)
    s, t = estimate.positions - centre, truth.positions - true_centre
    guide = (truth.poses[:, :3, :3] @ np.swapaxes(estimate.poses[:, :3, :3], 1, 2)).mean(axis=0)
    M = t.T @ s / len(s)
    U, d, _ = np.linalg.svd(M)
    if np.sqrt((s**2).mean() * (t**2).mean()) < _STILL or d[0] < _STILL:
        R = nearest_rotation(guide)
    else:
        R = nearest_rotation(M)
        R = _turn_about(U[:, 0], R, guide) if d[1] <= _LINE * d[0] else R
    return pose(R, true_centre - R @ centre)


def _turn_about(axis: Array, R: Array, guide: Array) -> Array:
    """``Rot(axis, φ) R`` with the φ that brings it nearest to `guide` in the Frobenius norm."""
    N = guide @ R.T
    skew = np.array([N[2, 1] - N[1, 2], N[0, 2] - N[2, 0], N[1, 0] - N[0, 1]])
    sine, cosine = axis @ skew, np.trace(N) - axis @ N @ axis
    if np.hypot(sine, cosine) < 1e-12:  # the guide says nothing about this turn
        return R
    return np.asarray(so3_exp(axis * np.arctan2(sine, cosine)) @ R, np.float64)
