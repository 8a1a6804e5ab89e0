"""Which frames of a recording suffer from what."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from slam.data import BoolArray
from slam.errors import ConfigurationError
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array
from slam.worlds.observe import SimulatedFeatures
from slam.worlds.options import FAULTS

_CHOSEN = [option.name for option in FAULTS if option.name != "jump"]


@dataclass(frozen=True, eq=False)
class Faults:
    """Faults of every frame of the undisturbed recording."""

    frames: Mapping[str, BoolArray]  # which frames suffer (N,), by the option's name
    delay: Array  # what the clock has jumped ahead by (N,) [s]

    @classmethod
    def of(cls, values: Mapping[str, Any], frames: int, seed: int) -> Faults:
        """Faults by the options' texts; ConfigurationError where one cannot be read, or every frame is dropped."""
        chosen = {
            name: _frames(name, values[name], frames, np.random.default_rng([seed, 7, number]))
            for number, name in enumerate(_CHOSEN)
        }
        if chosen["drop"].all():
            raise ConfigurationError("drop: no frame is left")
        delay = np.zeros(frames)
        for part in filter(None, values["jump"].split(",")):
            frame, _, seconds = part.partition(":")
            try:
                start, by = int(frame), float(seconds)
            except ValueError:
                raise ConfigurationError(f"jump must be FRAME:SECONDS, got {part!r}") from None
            if start < 1 or not (np.isfinite(by) and by > 0):
                raise ConfigurationError(f"jump must be from frame 1 on and ahead in time, got {part!r}")
            delay[start:] += by
        return cls(chosen, delay)

    def of_frame(self, frame: int) -> set[str]:
        """What a frame suffers from."""
        return {name for name, suffers in self.frames.items() if suffers[frame]}

    def spoil(self, frame: int, seen: SimulatedFeatures, rig: StereoRig, rng: np.random.Generator) -> SimulatedFeatures:
        """What is left of a frame's features under its faults.

        Black and over-exposed frames show nothing, a hand hides a part, blur leaves a third, which are three times as
        noisy; bursts of noise double the noise.
        """
        faults = self.of_frame(frame)
        if not faults:
            return seen
        keep = np.full(len(seen.ids), not faults & {"black", "bright"})
        if "hand" in faults:
            keep &= ~in_hand(seen.features.uv_left, rig.width, rig.height)
        if "blur" in faults:
            keep &= rng.random(len(keep)) < 1 / 3
        noise = 3.0 if "blur" in faults else 1.7 if "burst" in faults else 0.0
        return seen.select(keep, noise * rng.standard_normal((len(keep), 3)), "dropright" not in faults)


def in_hand(uv: Array, width: int, height: int) -> BoolArray:
    """Which pixels (N, 2) a hand before the lens covers: it comes in from below on the right."""
    x, y = uv[:, 0] / width, uv[:, 1] / height
    return (x - 0.75) ** 2 / 0.4**2 + (y - 0.9) ** 2 / 0.6**2 < 1


def _frames(name: str, text: str, frames: int, rng: np.random.Generator) -> BoolArray:
    """Which frames a text such as ``0.02``, ``17`` or ``100:110,200`` means."""
    out = np.zeros(frames, bool)
    for part in filter(None, text.split(",")):
        first, colon, last = part.partition(":")
        try:
            if colon:
                out[int(first) : int(last)] = True
            elif "." in part:
                if not 0 <= float(part) <= 1:
                    raise ConfigurationError(f"{name}: a chance must lie in 0..1, got {part}")
                out |= rng.random(frames) < float(part)
            elif int(part) < frames:
                out[int(part)] = True
        except ValueError:
            line = f"{name} must be frames (100), ranges (100:110) or a chance (0.02), got {part!r}"
            raise ConfigurationError(line) from None
    return out
