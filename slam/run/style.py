"""How pictures of runs and of comparisons look alike: a colour a back end, a colour a stage."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle

_BACKENDS = {"ekf": "#1565c0", "smoother": "#ef6c00", "batch": "#6a1b9a", "window": "#00838f", "iekf": "#ad1457"}
_OTHERS = ("#2e7d32", "#c62828", "#5d4037", "#9e9d24")

_BODIES = ((230, 90, 40), (40, 140, 255), (160, 60, 200), (60, 180, 60), (60, 60, 230))  # BGR

#: Of lines around bands: where bands of two back ends are equal, both are seen.
DASHES = ("-", "--", ":", "-.")

#: Stages of a step, in their order.
STAGE_COLOURS = {
    "read": "#bdbdbd", "extract": "#1565c0", "predict": "#90caf9", "associate": "#ef6c00", "update": "#c62828",
    "estimate": "#f48fb1", "objects": "#6a1b9a", "manage": "#2e7d32", "atlas": "#00838f",
}  # fmt: skip


def backend_colours(backends: Sequence[str]) -> list[str]:
    """A colour for each of the runs in a picture, by the names of their back ends.

    A built-in back end has the same colour in all pictures, in whatever order. Others, and further runs of the same
    back end, have the next colour that is left.
    """
    left = cycle([*_OTHERS, *(colour for name, colour in _BACKENDS.items() if name not in backends)])
    own = dict(_BACKENDS)
    return [own.pop(name) if name in own else next(left) for name in backends]


def body_colour(number: int) -> tuple[int, int, int]:
    """The colour (BGR) of a moving body in images, by its number."""
    return _BODIES[(number - 1) % len(_BODIES)]
