"""Names of the variables, and how far each may move before it is relinearised.

gtsam names a variable by a letter and a number, and takes one threshold for each letter. A far landmark may move
much further than a near one for the same error in the image, so a landmark's letter follows from its threshold.
"""

from __future__ import annotations

import gtsam
import numpy as np

from slam.window.stereo import RectifiedStereo

_POSE = "x"
_BALLAST = "z"
_LETTERS = "ABCDEFGHIJKLMNOP"
_INDEX_BITS = 56  # numerics: of a key, below those of its letter; asking gtsam for each key would take longer
_FIRST_POSE = int(gtsam.symbol(_POSE, 0))
_FINEST = 1e-3  # cost: threshold of the first letter [m]; each next one's is twice as large

#: cost: Distance of near landmarks, in baselines; what is nearer is hardly seen by both cameras.
_NEAR = 8.0


def pose_key(frame: int) -> int:
    """Variable of a frame's pose."""
    return _FIRST_POSE + frame


def landmark_key(number: int, threshold: float = _FINEST) -> int:
    """Variable of a landmark's position with a threshold of relinearisation of `threshold` [m] or slightly less."""
    letter = int(np.clip(np.floor(np.log2(threshold / _FINEST)), 0, len(_LETTERS) - 1))
    return int(gtsam.symbol(_LETTERS[letter], number))


def ballast_key(number: int) -> int:
    """A variable that nothing depends on."""
    return int(gtsam.symbol(_BALLAST, number))


def size_of(key: int) -> int:
    """Degrees of freedom of a pose or landmark."""
    return 6 if key >> _INDEX_BITS == ord(_POSE) else 3


def put(values: gtsam.Values, key: int, of: gtsam.Values) -> None:
    """Insert a pose or landmark `of` other values."""
    values.insert(key, of.atPose3(key) if size_of(key) == 6 else of.atPoint3(key))


def landmark_threshold(stereo: RectifiedStereo, distance: float, error: float) -> float:
    """How far a landmark may move along its ray before linearised pixels are off by `error` [px].

    The disparity ``d = f b / z`` is off by ``d (δz / z)²``.
    """
    return distance * float(np.sqrt(error * distance / (stereo.f * stereo.baseline)))


def thresholds(stereo: RectifiedStereo, error: float, share: float = 1.0) -> gtsam.ISAM2ThresholdMap:
    """How far each kind of variable may move before linearised pixels are off by about `share` of `error` [px].

    `error` is that of the landmarks' names (`landmark_threshold`).

    A turn by δ moves pixels near the centre by f δ, to within f δ² / 2; a step by δ those at depth z to within f δ²/z².
    """
    turn = np.sqrt(2 * share * error / stereo.f)
    step = _NEAR * stereo.baseline * np.sqrt(share * error / stereo.f)
    table = gtsam.ISAM2ThresholdMap()
    table.insert((_POSE, np.repeat([turn, step], 3)))
    table.insert((_BALLAST, np.ones(1)))
    for i, letter in enumerate(_LETTERS):
        table.insert((letter, np.full(3, np.sqrt(share) * _FINEST * 2**i)))
    return table
