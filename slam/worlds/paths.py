"""How cameras and objects move: poses as smooth functions of time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from slam.geometry.se3 import Array, about, pose, rotation

#: Camera axes of a level camera that looks along world +y: x right, y down, z forward.
R_LEVEL = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


def camera_poses(positions: Array, yaw: Array, pitch: Array, roll: Array) -> Array:
    """Poses ``T_world_left`` (N, 4, 4) of cameras at `positions` (N, 3) [m], with angles (N,) [rad].

    Yaw turns to the left about the vertical (0 looks along +y), pitch upwards, roll clockwise as the camera sees it.
    """
    return pose(about(yaw, 2) @ R_LEVEL @ about(pitch, 0) @ about(roll, 2), positions)


def sway(t: Array, rng: np.random.Generator, slowest: float, fastest: float, terms: int = 5) -> Array:
    """A smooth random signal (N,) of unit standard deviation with frequencies between two [Hz]."""
    frequency = np.exp(rng.uniform(np.log(slowest), np.log(fastest), terms))
    phase = rng.uniform(0, 2 * np.pi, terms)
    weight = 1 / np.sqrt(frequency)
    weight /= np.sqrt((weight**2).sum() / 2)
    return (weight * np.sin(2 * np.pi * np.outer(t, frequency) + phase)).sum(axis=1)


def smooth_step(x: Array) -> Array:
    """0 below 0, 1 above 1, and between them a rise with continuous velocity and acceleration."""
    x = np.clip(x, 0, 1)
    return x**3 * (10 - 15 * x + 6 * x**2)


def through(t: Array, times: Sequence[float], values: Sequence[float]) -> Array:
    """A value (N,) that moves from stop to stop: it is at ``values[i]`` at ``times[i]`` [s], smoothly."""
    out = np.full(len(t), float(values[0]))
    for t0, t1, a, b in zip(times[:-1], times[1:], values[:-1], values[1:]):
        out += (b - a) * smooth_step((t - t0) / (t1 - t0))
    return out


def carried(t: Array, rng: np.random.Generator, gait: float = 1.8, amount: float = 1.0) -> tuple[Array, Array]:
    """What carrying by hand adds to a path: offsets (N, 3) [m] across, forward, up, and yaw, pitch, roll (N, 3) [rad].

    Steps lift twice per stride (`gait` [Hz] is the step rate), the body sways once per stride, and the hands shake.
    """
    phase = rng.uniform(0, 2 * np.pi)
    step = 2 * np.pi * gait * t + phase
    gaits = ((0.018, 0.5, 0, 0.003), (0.006, 1, 1, 0.002), (0.012, 1, 0, 0.003))  # size, steps, phase, shaking
    turns = ((0.012, 0.5, 0.6, 0.004), (0.006, 1, 0.3, 0.004), (0.008, 0.5, 2, 0.003))
    offsets = [a * np.sin(f * step + p) + b * sway(t, rng, 1.5, 4) for a, f, p, b in gaits]
    angles = [a * np.sin(f * step + p) + b * sway(t, rng, 1, 5) for a, f, p, b in turns]
    return amount * np.stack(offsets, axis=1), amount * np.stack(angles, axis=1)


def clock(values: Mapping[str, Any], duration: float) -> tuple[Array, Array]:
    """Stamps [s] of the frames, and where they are on the path: its time [s] at the usual pace.

    `duration` [s] is the path's at the usual pace; the option `frames` cuts it short (or runs it on).
    """
    frames = values["frames"] or max(1, round(duration * values["rate"] / values["speed"]))
    stamps = np.arange(frames) / values["rate"]
    return stamps, stamps * values["speed"]


#: How the camera moves in worlds where objects do: the words of the option ``camera``.
CAMERAS = ("still", "sway", "moving")


def watching(t: Array, stamps: Array, way: str, rng: np.random.Generator) -> Array:
    """Poses (N, 4, 4) of a camera at the world's origin that looks along +y, at path times t (N,) [s].

    `way` is still; sway, as a robot that stands, by `stamps` (N,) [s] and `rng`; or moving, half a metre to and fro.
    """
    zero = np.zeros(len(t))
    if way == "still":
        return camera_poses(np.zeros((len(t), 3)), zero, zero, zero)
    offsets, angles = carried(stamps, rng, gait=1.1, amount=0.3)
    x = 0.25 * np.sin(2 * np.pi * t / 8.0) if way == "moving" else zero
    y = 0.10 * np.sin(2 * np.pi * t / 13.0) if way == "moving" else zero
    positions = offsets + np.stack([x, y, zero], axis=1)
    return camera_poses(positions, 0.5 * x + angles[:, 0], angles[:, 1], angles[:, 2])


def placed(place: Sequence[Array | float], angles: Sequence[Array | float]) -> Array:
    """Poses (..., 4, 4) of objects, from x, y, z [m] and yaw, pitch, roll [rad], each (...) or one number for all.

    Their orientation is ``Rz(yaw) Ry(pitch) Rx(roll)`` in world axes (paper B, step d).
    """
    x, y, z, yaw, pitch, roll = np.broadcast_arrays(*place, *angles)
    R = [rotation(one) for one in np.stack([roll, pitch, yaw], axis=-1).reshape(-1, 3)]
    return pose(np.reshape(R, (*x.shape, 3, 3)), np.stack([x, y, z], axis=-1))
