"""The keys of ``NAME?key=value&key=value``: types, ranges and meanings, and which frames suffer from what faults."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from slam.data import BoolArray
from slam.errors import ConfigurationError
from slam.query import number, word


@dataclass(frozen=True)
class Option:
    """One key."""

    name: str
    default: int | float | str  # its value where it is not given; its type is the value's type
    text: str  # what it means, with its unit
    low: float = 0.0  # range of a number, both ends included
    high: float = float("inf")
    choices: tuple[str, ...] = ()  # the words allowed, where it is a word

    def parse(self, text: str) -> int | float | str:
        """The value that a text means; raises ConfigurationError."""
        if isinstance(self.default, str):
            return word(self.name, text, self.choices) if self.choices else text
        return number(self.name, text, self.low, self.high, isinstance(self.default, int))

    @property
    def range(self) -> str:
        """The range or the choices, for people."""
        if isinstance(self.default, str):
            return "|".join(self.choices) or "text"
        return f"{self.low:.10g}..{self.high:.10g}"


#: Keys of every world: what is there and how it is recorded. (Their defaults may differ from world to world.)
RECORDING = (
    Option("frames", 0, "number of frames; the whole path unless it is given", 1, 1_000_000),
    Option("seed", 0, "of everything random in a recording: noise, misses, outliers, faults", 0, 2**31 - 1),
    Option("layout", 0, "of what stands where, and of the path's sway", 0, 2**31 - 1),
    Option("rate", 30.0, "frames per second [Hz]", 0.1, 1000),
    Option("speed", 1.0, "pace along the path, of camera and objects, as a multiple of the usual one", 0.05, 20),
    Option("rig", "rectified", "the stereo pair", choices=("rectified", "toedin")),
    Option("width", 320, "image width [px]; the focal length grows with it", 64, 4096),
    Option("height", 240, "image height [px]", 48, 4096),
    Option("baseline", 0.12, "distance between the cameras [m]", 0.01, 10),
    Option("focal_error", 0.0, "relative error of the focal length in the calibration; positive: too long", -0.2, 0.2),
    Option("mask", "", "image, black where features are not used; two joined by a comma for left and right"),
    Option("turn_error", 0.0, "turn of the right camera about each axis, not in the calibration [mrad]", -50, 50),
)

#: Keys for observations made without images.
OBSERVATION = (
    Option("density", 25.0, "landmarks per square metre of surface, at most", 0, 10_000),
    Option("sigma", 0.7, "standard deviation of uL, vL and uR [px]", 0, 100),
    Option("detect", 0.9, "chance that a visible landmark is detected", 0, 1),
    Option("stereo", 0.95, "chance that a detected one is matched in the right image", 0, 1),
    Option("outliers", 0.05, "share of features that are false, or are given a false match in the right image", 0, 0.9),
    Option("descriptor", 64, "length of descriptors", 4, 256),
    Option("descriptor_noise", 0.12, "typical length of the error of a unit descriptor", 0, 10),
    Option("descriptor_drift", 0.0, "change of a unit descriptor as the direction of view turns, per radian", 0, 10),
    Option("change", 0.0, "share of landmarks that look different when the camera comes back after a minute", 0, 1),
    Option("clutter", 0.0, "share of features that are points of the world, but never detected again", 0, 0.9),
    Option("confusion", 0.1, "share of landmarks that look nearly like another one", 0, 1),
)

#: Keys for images.
IMAGING = (
    Option("noise", 2.0, "standard deviation of the sensor noise [grey levels]", 0, 100),
    Option("vignetting", 0.2, "loss of light in the image corners", 0, 1),
    Option("lens", 0.5, "blur of the lens, standard deviation [px]", 0, 10),
    Option("colour", 0, "1 for colour images (BGR), 0 for grey ones", 0, 1),
)

#: Keys for faults; values are frames (100), ranges (100:110, end left out), or a chance for each frame (0.02), and
#: lists of these, joined by commas.
FAULTS = (
    Option("drop", "", "frames that are missing from the recording"),
    Option("dropright", "", "frames without a right image"),
    Option("black", "", "black frames"),
)

COMMON = (*RECORDING, *OBSERVATION, *IMAGING, *FAULTS)


def faulty_frames(values: Mapping[str, Any], frames: int, seed: int) -> dict[str, BoolArray]:
    """Which of the undisturbed recording's frames (N,) suffer from what, by the options' names.

    ConfigurationError where a text cannot be read, or every frame is dropped.
    """
    chosen = {
        option.name: _frames(option.name, values[option.name], frames, np.random.default_rng([seed, 7, number]))
        for number, option in enumerate(FAULTS)
    }
    if chosen["drop"].all():
        raise ConfigurationError("drop: no frame is left")
    return chosen


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
