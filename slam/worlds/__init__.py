"""Worlds with known truth: recordings made on demand, as images or as observations.

>>> from slam.worlds import open_world
>>> sequence = open_world("aisle?frames=200&seed=3")
>>> features = sequence.observations(0)  # no image is made

May import `slam.geometry` and the data.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from slam import registry
from slam.errors import ConfigurationError, UnknownNameError
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import so3_exp
from slam.naming import unknown
from slam.query import read_query
from slam.worlds.options import COMMON, FAULTS, IMAGING, OBSERVATION, RECORDING, Option
from slam.worlds.scenes import SCENES, assemble
from slam.worlds.sequence import Masks, WorldSequence
from slam.worlds.world import Scene, World

__all__ = ["WorldSequence", "describe", "describe_common", "names", "open_world", "options"]

#: Options that change the world itself; the others only change how it is recorded.
_RECORDING_ONLY = {o.name for o in (*OBSERVATION, *IMAGING, *FAULTS)} - {"density"}
_RECORDING_ONLY |= {"seed", "mask", "focal_error", "turn_error"}


def names() -> list[str]:
    """The built-in worlds."""
    return list(SCENES)


def open_world(text: str, read_masks: Callable[[str, StereoRig], Masks] | None = None) -> WorldSequence:
    """The recording that a text such as ``"aisle?frames=200&seed=3"`` describes.

    A world of one's own is ``"my_module:SCENE?frames=200"``, a `slam.worlds.world.Scene`. The option ``mask`` needs
    what reads it, as `slam.open_sequence` gives it.

    Raises:
        UnknownNameError: there is no such world.
        ConfigurationError: an option is unknown, has a wrong type, or lies outside its range.
    """
    text = text.removeprefix("synthetic:")
    name, _, query = text.partition("?")
    values = values_of(name, query)
    key = tuple(sorted((k, v) for k, v in values.items() if k not in _RECORDING_ONLY))
    world = _build(name, key)
    told, recorded = world.rig, world
    share, turn = 1 / (1 + values["focal_error"]), 1e-3 * values["turn_error"]
    if share != 1 or turn != 0:  # the cameras that record are others than the system is told
        left, right = (replace(c, fu=share * c.fu, fv=share * c.fv) for c in (told.left, told.right))
        true = StereoRig(left, right, so3_exp(np.full(3, turn)) @ told.R, told.b)
        recorded = replace(world, rig=true)
    sequence = WorldSequence(text, recorded, values, told)
    if values["mask"]:
        if read_masks is None:
            raise ConfigurationError(f"{name}: 'mask' is an option for slam.open_sequence alone")
        sequence.masks = read_masks(values["mask"], told)
    return sequence


def options(name: str) -> dict[str, Option]:
    """All options of a world by name; raises UnknownNameError."""
    scene = _scene(name)
    common = (replace(o, default=type(o.default)(scene.defaults.get(o.name, o.default))) for o in COMMON)
    return {o.name: o for o in (*scene.options, *common)}


def values_of(name: str, query: str) -> dict[str, Any]:
    """The values of all options of a world; errors as of `open_world`."""
    table = options(name)
    texts = read_query(query, f"world {name}", table)
    return {key: o.parse(texts[key]) if key in texts else o.default for key, o in table.items()}


def describe(name: str) -> str:
    """A world in a line, and a line for each option of its own or with another default; raises UnknownNameError."""
    scene, table = _scene(name), options(name)
    own = [o.name for o in scene.options]
    changed = [o for o in scene.defaults if o not in own]
    return "\n".join([f"{name}: {scene.text}", *(_line(table[key]) for key in (*own, *changed))])


def _scene(name: str) -> Scene:
    if ":" in name:
        found = registry.resolve("worlds", name)
        if not isinstance(found, Scene):
            raise ConfigurationError(f"world {name!r} is no slam.worlds.world.Scene")
        return found
    if name not in SCENES:
        raise UnknownNameError(unknown("world", name, tuple(SCENES)))
    return SCENES[name]


@lru_cache(maxsize=8)
def _build(name: str, key: tuple[tuple[str, Any], ...]) -> World:
    """A world, kept for the next recording of it: Monte-Carlo runs differ in `seed` alone."""
    return assemble(name, _scene(name), dict(key))


def describe_common() -> str:
    """The options that all worlds share, a line each, under headings."""
    groups = {"recording": RECORDING, "observations": OBSERVATION, "images": IMAGING, "faults": FAULTS}
    lines = []
    for heading, table in groups.items():
        lines += [f"{heading}:", *(_line(o) for o in table)]
    return "\n".join(lines)


def _line(o: Option) -> str:
    default = o.default if o.default != "" else "none"
    return f"  {o.name}={default}  {o.text} ({o.range})"
