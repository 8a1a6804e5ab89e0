"""Whether a file of true poses fits an estimated path, and if not, which usual mistake would explain it.

Compared are motions over about a second, in which drift hardly counts: ``A`` of the estimated path and ``B`` of the
true one. A true path of another body, at the constant pose X in the left camera, in another unit (s to a metre) and of
another clock has ``B = X⁻¹ A X``, positions times s, at stamps that are a shift later. All three are fitted, for the
file as it is read, with quaternions as w x y z, and with inverse poses. What the fit cannot do without is named. Where
motions differ by little, which an error of the cameras' calibration may explain, only another clock is looked for.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from slam.errors import TrajectoryError
from slam.evaluation.metrics import absolute_errors, associate
from slam.geometry.se3 import Array, inverse, nearest_rotation, pose, quaternion, rotation_from_quaternion, so3_log
from slam.geometry.trajectory import Trajectory, TruthNoise

_SECONDS = 1.0  # over which motions are compared
_LEAST = 10  # guard: motions to judge by
_STILL = 0.02  # guard: motions [m] that tell nothing
_TURN = 0.05  # [rad] of a motion: turns that are less are compared with it
_ROWS = 400  # poses that are looked at
_EXPLAINS = 2.5  # times smaller errors become by a mistake that is named
_LATEST, _STEP = 2.0, 0.05  # [s] of the shifts that are tried
_APART_AT_LEAST = 5  # guard: motions one after the other, of which a shift cannot explain most by chance
_FINE = 0.01  # errors of motions, as a share of them, below which nothing but a shift is looked for
_MISFIT = 0.3  # errors of motions, as a share of them, that are no drift
_APART = 0.8  # the same, that no noise of an estimated path explains
_ALIKE = 0.05  # errors of positions, as a share of the path, that are drift
_POSES = 6**0.5  # by which errors of a motion exceed those of an axis: two poses, of three axes each
_EXACT = TruthNoise()
_ROUNDS = 8  # of the fit
_LEVER_PRIOR = 1e-4  # [rad²] of turns that tell no lever
_UNITS = {"mm": 1000.0, "cm": 100.0, "inches": 39.37, "feet": 3.281, "km": 0.001}
_NEAR = 0.15  # of a factor to that of a unit, as a logarithm
_MOUNTED = 10.0  # [deg] by which a principal point that is off does not turn a path
_FAR = 2.0  # factor of a length that no calibration is off by


class _Fit(NamedTuple):
    error: float  # of the motions that are left, as a share of them, root mean square
    scale: float
    turn: float  # of the body against the camera [deg]
    lever: float  # its distance from the camera [m]
    motions: int
    size: float = 1.0  # of the estimated ones [m], root mean square
    turning: float = 1.0  # the same of their rotations [rad]


def truth_doubt(own: Trajectory, truth: Trajectory, noise: TruthNoise = _EXACT) -> str:
    """Why covariances cannot be judged by a true path, in a line: it looks wrong, or is of another scale.

    Args:
        own: the estimated path, of measured poses.
        truth: the true path as it was given, at stamps of its own.
        noise: its errors; what its translation and rotation explain is no mistake.

    Returns:
        the line, empty where the paths agree or too little is known.
    """
    if len(own) > _ROWS:
        own = own.select(np.linspace(0, len(own) - 1, _ROWS).astype(int))
    given = _fit(own, truth, 0.0, free="")
    if given is None:
        return ""
    known = _POSES * np.hypot(noise.translation / given.size, noise.rotation / given.turning)
    w_first = quaternion(truth.poses[:, :3, :3])[:, [1, 2, 3, 0]]
    as_w_first = pose(rotation_from_quaternion(w_first), truth.positions)
    poses = {
        "": truth.poses,
        "its quaternions are w x y z, and must be x y z w": as_w_first,
        "its poses are inverse, and must be those of the camera in the world": inverse(truth.poses),
    }
    floor, frees = _FINE, ["", "scale", "body", "scale body"]
    if given.error < _EXPLAINS * max(_FINE, known):  # that may be the calibration's; a clock is none of it
        if np.ptp(own.stamps) < _APART_AT_LEAST * _SECONDS:
            return ""
        floor, frees, poses = 0.0, [""], {"": truth.poses}
    tried = []
    for said, read in poses.items():
        reading = Trajectory(truth.stamps, read)
        for at in (0.0, _shift(own, reading, frees[-1])):
            for free in frees:
                mistakes = bool(said) + bool(at) + len(free.split())
                if (fit := _fit(own, reading, at, free)) is not None:
                    tried.append((max(floor, fit.error) * _EXPLAINS**mistakes, mistakes, fit, said, at, free))
    _, mistakes, best, said, shift, free = min(tried, key=lambda one: one[:2])
    if not mistakes or best.error > _MISFIT:
        return _unexplained(own, truth, given.error) if floor else ""
    causes = [said] if said else []
    if shift:
        causes.append(f"its times are {abs(shift):.2f} s too {'late' if shift > 0 else 'early'}")
    if "body" in free:
        causes.append(
            f"it is that of a body turned by {best.turn:.1f}° against the left camera, {best.lever:.2g} m from it: "
            f"multiply its poses by the camera's in that body{'' if best.turn > _MOUNTED else ', or check cx and cy'}"
        )
    if not 1 / _FAR < best.scale < _FAR:
        near = (unit for unit, size in _UNITS.items() if abs(np.log(best.scale / size)) < _NEAR)
        causes.append(
            f"it is {best.scale:.3g} times as long as the estimated one: is it in {next(near, 'another unit')}? "
            "(The option unit= does not apply to it.)"
        )
    if causes:
        return f"the true path looks wrong: {'; and '.join(causes)}"
    return (
        f"the estimated path is {1 / best.scale:.3g} times as long as the true one: check the calibration's "
        "baseline and focal length, or the unit of the true path"
    )


def _unexplained(own: Trajectory, truth: Trajectory, error: float) -> str:
    """What to say where no mistake explains why motions differ: of rotations alone, where positions agree."""
    pairs = _pairs(own, truth)
    extent = float(np.sqrt(3 * pairs[1].positions.var(axis=0).mean()))
    if error < _APART or absolute_errors(*pairs).rmse > _ALIKE * extent:
        return ""
    return (
        "the true path looks wrong: its positions agree with the estimated path, its rotations do not: are they the "
        "left camera's (x right, y down, z forward), in the world of the positions?"
    )


def _shift(own: Trajectory, truth: Trajectory, free: str) -> float:
    """The shift [s] by which the truth's stamps are late, if the best fit of what is `free` is right."""
    best, shift = _fit(own, truth, 0.0, free) or _Fit(np.inf, 1.0, 0.0, 0.0, 0), 0.0
    half = best.motions / 2
    for step, reach in ((_STEP, _LATEST if free else 5 * _STEP), (_STEP / 10, _STEP)):
        for at in shift + np.arange(-reach, reach + step / 2, step):
            fit = _fit(own, truth, float(at), free)
            if fit is not None and fit.error < best.error and fit.motions > half:
                best, shift = fit, float(at)
    return shift


def _fit(own: Trajectory, truth: Trajectory, shift: float, free: str) -> _Fit | None:
    """The fit of what is `free`; None where too little is known, or the camera hardly moves."""
    try:
        P, Q = _pairs(Trajectory(own.stamps + shift, own.poses), truth)
    except TrajectoryError:
        return None
    if len(P) <= _LEAST:
        return None
    every = min(max(1, round(_SECONDS / float(np.median(np.diff(P.stamps))))), len(P) // 4)
    A, B = (inverse(path.poses[:-every]) @ path.poses[every:] for path in (P, Q))
    wa, wb, ta, tb = so3_log(A[:, :3, :3]), so3_log(B[:, :3, :3]), A[:, :3, 3], B[:, :3, 3]
    size, turn = _rms(ta), max(_rms(wa), _TURN)
    if size < _STILL:
        return None
    R: Array = np.eye(3)
    lever: Array = np.zeros(3)
    scale, J = 1.0, A[:, :3, :3] - np.eye(3)
    rows = J.reshape(-1, 3)
    prior = _LEVER_PRIOR * len(J) * np.eye(3)
    for _ in range(_ROUNDS if free else 0):  # each in turn, given the others
        if "scale" in free:
            scale = _rms(tb) / _rms(ta + J @ lever)
        if "body" in free:
            R = nearest_rotation((ta + J @ lever).T @ tb / (scale * size**2) + wa.T @ wb / turn**2)
            lever = np.linalg.solve(rows.T @ rows + prior, rows.T @ (tb @ R.T / scale - ta).ravel())
    off_t, off_w = tb @ R.T / scale - ta - J @ lever, wb @ R.T - wa
    error = float(np.hypot(_rms(off_t) / size, _rms(off_w) / turn))
    turned = float(np.degrees(np.linalg.norm(so3_log(R))))
    return _Fit(error, scale, turned, float(np.linalg.norm(lever)), len(A), size, turn)


def _pairs(own: Trajectory, truth: Trajectory) -> tuple[Trajectory, Trajectory]:
    """`associate`, also between true poses as far apart as most are: else a shift would choose among the poses."""
    return associate(own, truth, max(0.02, float(np.median(np.diff(truth.stamps))) if len(truth) > 1 else 0.0))


def _rms(vectors: Array) -> float:
    return float(np.sqrt(np.square(vectors).sum(axis=1).mean()))
