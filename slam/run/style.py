"""How pictures of runs and of comparisons look alike: a colour a back end, a colour and a name a stage."""

from __future__ import annotations

from collections.abc import Iterable

from slam.run.schema import STAGES

#: Of back ends, in the order in which they are drawn.
COLOURS = ("#1565c0", "#ef6c00", "#6a1b9a", "#00838f", "#2e7d32", "#c62828", "#5d4037", "#9e9d24")

#: Of lines around bands: where bands of two back ends are equal, both are seen.
DASHES = ("-", "--", ":", "-.")

_STAGES = {
    "read": ("reading images", "#bdbdbd"),
    "extract": ("features", "#1565c0"),
    "predict": ("prediction", "#90caf9"),
    "associate": ("data association", "#ef6c00"),
    "update": ("update", "#c62828"),
    "estimate": ("estimate and covariances", "#f48fb1"),
    "objects": ("moving objects", "#6a1b9a"),
    "manage": ("map management", "#2e7d32"),
    "atlas": ("places and loops", "#00838f"),
}


def stages(known: Iterable[str]) -> list[str]:
    """Those of some stages that a step has, in the order of a step."""
    names = set(known)
    return [stage for stage in STAGES if stage in names]


def stage_name(stage: str) -> str:
    """What a stage does, for a legend."""
    return _STAGES[stage][0]


def stage_colour(stage: str) -> str:
    """The colour of a stage."""
    return _STAGES[stage][1]


def repeated(styles: tuple[str, ...], count: int) -> list[str]:
    """So many of some styles, from the first on again where they are too few."""
    return [styles[i % len(styles)] for i in range(count)]
