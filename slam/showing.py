"""How objects show themselves in a notebook: one line of text, or a small piece of HTML with a picture."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import fields
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.errors import SlamError
from slam.grey_range import eight_bits

_SIZE = 150  # of a picture [px]
_MOST_POINTS = 400  # of a drawn path


def of_shapes(thing: Any) -> str:
    """A dataclass in one line: its arrays by their shapes, everything else as it shows itself."""
    shown = []
    for f in fields(thing):
        value = getattr(thing, f.name)
        shown.append(f"{f.name}={'x'.join(map(str, value.shape)) if isinstance(value, np.ndarray) else repr(value)}")
    return f"{type(thing).__name__}({', '.join(shown)})"


def count(number: int, what: str) -> str:
    """A number of things, such as ``"1 frame"`` or ``"3 frames"``."""
    return f"{number} {what}{'' if number == 1 else 's'}"


def point(values: NDArray) -> str:
    """Coordinates in millimetre steps."""
    return "(" + ", ".join(f"{value:.3f}" for value in values) + ")"


def widest(positions: NDArray) -> tuple[int, int]:
    """The two coordinates of positions (N, 3) with the largest range, for a plane picture."""
    if not len(positions):
        return 0, 2
    first, second = sorted(np.argsort(-np.ptp(positions, axis=0), kind="stable")[:2].tolist())
    return first, second


def path_svg(positions: NDArray) -> str:
    """A path (N, 3) as a small picture: its two widest coordinates at equal scale, a dot at the start."""
    if not len(positions):
        return ""
    across, up = widest(positions)
    kept = positions[np.unique(np.linspace(0, len(positions) - 1, _MOST_POINTS).astype(int))][:, [across, up]]
    low, high = kept.min(axis=0), kept.max(axis=0)
    scale = (_SIZE - 20) / max(float((high - low).max()), 1e-9)
    xy = (kept - 0.5 * (low + high)) * (scale, -scale) + 0.5 * _SIZE
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in xy)
    return (
        f'<svg width="{_SIZE}" height="{_SIZE}" viewBox="0 0 {_SIZE} {_SIZE}" role="img" aria-label="path">'
        f'<polyline points="{points}" fill="none" stroke="#1565c0" stroke-width="1.5"/>'
        f'<circle cx="{xy[0, 0]:.1f}" cy="{xy[0, 1]:.1f}" r="3.5" fill="#ef6c00"/></svg>'
    )


def image_html(image: NDArray | None) -> str:
    """An image (H, W) or (H, W, 3), uint8 or uint16, as a small picture."""
    import cv2

    if image is None:
        return ""
    small = cv2.resize(image, None, fx=_SIZE / len(image), fy=_SIZE / len(image), interpolation=cv2.INTER_AREA)
    done, png = cv2.imencode(".png", eight_bits(small))
    return f'<img alt="" src="data:image/png;base64,{base64.b64encode(png.tobytes()).decode()}">' if done else ""


def card(text: str, pictures: Sequence[str]) -> str:
    """Pictures side by side, and a line of text below."""
    shown = "".join(picture for picture in pictures if picture)
    return f'<div><div style="display:flex;gap:8px;align-items:center">{shown}</div><small>{escape(text)}</small></div>'


def sequence_line(sequence: Any) -> str:
    """A sequence in one line: its name, its length, and further facts."""
    stamps, rig, truth = sequence.stamps, sequence.rig, sequence.ground_truth
    seconds = float(stamps[-1] - stamps[0]) if len(stamps) else 0.0
    known = "no ground truth" if truth is None else "with ground truth"
    what = f"{sequence.format}, {sequence.kind}, {count(len(sequence), 'frame')}, {seconds:.2f} s"
    return f"{type(sequence).__name__}({sequence.name!r}, {what}, {rig.width}x{rig.height}, {known})"


def sequence_html(sequence: Any) -> str:
    """A sequence as its first left image, its true path where that is known, and its line."""
    image = None
    with suppress(SlamError):  # a picture less
        image = next((frame.left for frame in sequence.frames(0, 1)), None)
    truth = sequence.ground_truth
    return card(sequence_line(sequence), [image_html(image), "" if truth is None else path_svg(truth.positions)])
