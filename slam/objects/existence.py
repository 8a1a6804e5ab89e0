"""How sure it is that a body exists, from the frames in which it was measured and those in which it was not.

The recursion of integrated probabilistic data association (Mušicki, Evans and Stanković, IEEE Transactions on Automatic
Control 39, 1994). A measurement counts the more, the better the body's motion explains its points compared with a still
world.
"""

from __future__ import annotations

import math

EVEN = 0.5  #: fixed: a body rather exists than not above this probability, which it has before its first evidence
_LEAST = 2.0  # ratio of the likelihoods of a measured body, at least: a body at rest shows no motion, but is there
_LARGEST = 20.0  # χ² that counts of the typical member: many members share one error of the camera's pose
_CERTAIN = 1.0 - 1e-9  # a probability of 1 could never fall again


def when_measured(probability: float, gain: float) -> float:
    """The probability after a frame in which the body was measured.

    Args:
        probability: before.
        gain: by how much χ² the body's motion explains its typical member better than a fixed point does.
    """
    ratio = max(_LEAST, math.exp(0.5 * min(gain, _LARGEST)))
    return min(_CERTAIN, probability * ratio / (1.0 - probability + probability * ratio))


def when_missed(probability: float, seen: int, age: int) -> float:
    """The probability after a frame in which the body was not measured.

    Args:
        probability: before.
        seen: number of frames in which it was measured, and
        age: number of frames since it was found: their ratio says how surely it is measured where it exists.
    """
    detection = (seen + 1.0) / (age + 2.0)
    return probability * (1.0 - detection) / (1.0 - probability * detection)
