"""Brushes: noise fields, lettering and shading from which textures are painted; BGR, uint8."""

from __future__ import annotations

import cv2
import numpy as np

Colour = tuple[float, float, float]  #: blue, green, red
Area = tuple[float, float]  #: height, width [m]
Size = tuple[int, int]  #: rows, columns
Box = tuple[float, float, float, float]  #: left, top, width, height [texels]
_LETTERS = "ABCDEFGHIJKLMNOPRSTUVWZ"
_FONTS = (
    cv2.FONT_HERSHEY_SIMPLEX,
    cv2.FONT_HERSHEY_DUPLEX,
    cv2.FONT_HERSHEY_COMPLEX,
    cv2.FONT_HERSHEY_TRIPLEX,
)


def clouds(shape: tuple[int, int], rng: np.random.Generator, cells: float, octaves: int = 3) -> np.ndarray:
    """Smooth noise (H, W) float32 of about unit deviation; its largest blobs are `cells` texels wide."""
    height, width = shape
    out = np.zeros(shape, np.float32)
    weight = 1.0
    for _ in range(octaves):
        small = rng.standard_normal((int(height / cells) + 3, int(width / cells) + 3), np.float32)
        full = cv2.resize(small, (0, 0), fx=cells, fy=cells, interpolation=cv2.INTER_CUBIC)
        out += weight * full[:height, :width]
        weight *= 0.6
        cells = max(cells / 2, 1.0)
    return out / np.float32(1.3)


def grain(shape: tuple[int, int], rng: np.random.Generator, cells: tuple[float, float]) -> np.ndarray:
    """Stretched noise (H, W) float32 with blobs of (width, height) texels."""
    height, width = shape
    small = rng.standard_normal((int(height / cells[1]) + 3, int(width / cells[0]) + 3), np.float32)
    return cv2.resize(small, (0, 0), fx=cells[0], fy=cells[1], interpolation=cv2.INTER_CUBIC)[:height, :width]


def tinted(light: np.ndarray, colour: Colour) -> np.ndarray:
    """A colour under light (H, W), 1 being full; BGR uint8 (H, W, 3)."""
    light = np.maximum(light, 0, dtype=np.float32)
    return np.asarray(cv2.merge([cv2.convertScaleAbs(light, alpha=float(c)) for c in colour]))


def wood(shape: tuple[int, int], rng: np.random.Generator, colour: Colour, density: float) -> np.ndarray:
    """Wood with its grain along the rows."""
    fine = grain(shape, rng, (0.08 * density, 0.0022 * density))
    broad = grain(shape, rng, (0.5 * density, 0.015 * density))
    rings = np.sin(6 * broad + 0.6 * fine)
    return tinted(1 + 0.05 * fine + 0.06 * rings + 0.04 * broad, colour)


def words(rng: np.random.Generator, letters: int) -> str:
    """Some capital letters, in words."""
    text = "".join(_LETTERS[i] for i in rng.integers(len(_LETTERS), size=letters))
    cut = int(rng.integers(2, max(3, letters)))
    return text[:cut] + " " + text[cut:]


def lettering(canvas: np.ndarray, text: str, box: Box, colour: Colour, rng: np.random.Generator) -> None:
    """Write a line of text as large as fits into a box (left, top, width, height) of texels, in place."""
    left, top, width, height = box
    font = _FONTS[int(rng.integers(len(_FONTS)))]
    (w, h), _ = cv2.getTextSize(text, font, 1.0, 1)
    scale = min(width / max(w, 1), height / max(h, 1))
    if scale <= 0.05:
        return
    thickness = max(1, round(scale * 1.6))
    x = left + (width - scale * w) / 2
    y = top + (height + scale * h) / 2
    cv2.putText(canvas, text, (round(x), round(y)), font, scale, colour, thickness, cv2.LINE_AA)


def text_lines(canvas: np.ndarray, box: Box, pitch: float, colour: Colour, rng: np.random.Generator) -> None:
    """Fill a box of texels with lines of small print, `pitch` texels apart, in place."""
    left, top, width, height = box
    for i in range(int(height / pitch)):
        share = rng.uniform(0.3, 0.7) if rng.random() < 0.2 else rng.uniform(0.85, 1.0)
        y = top + (i + 0.5) * pitch
        x = left
        while x < left + share * width:
            w = rng.uniform(1.0, 4.0) * pitch
            bar(canvas, (x, y - 0.25 * pitch, min(w, left + share * width - x), 0.5 * pitch), colour)
            x += w + 0.6 * pitch


def fill(canvas: np.ndarray, polygon: np.ndarray, colour: Colour) -> None:
    """A filled polygon (M, 2) of texel places, (0, 0) being the outer corner of the first texel, in place."""
    points = np.rint((polygon - 0.5) * 16).astype(np.int32)
    cv2.fillConvexPoly(canvas, points, colour, cv2.LINE_AA, 4)


def bar(canvas: np.ndarray, box: Box, colour: Colour) -> None:
    """A filled upright rectangle (left, top, width, height) of texels, in place."""
    x, y, w, h = box
    fill(canvas, np.array([[x, y], [x + w, y], [x + w, y + h], [x, y + h]]), colour)


def dot(canvas: np.ndarray, x: float, y: float, radius: float, colour: Colour) -> None:
    """A filled disc, in texels, in place."""
    centre = round((x - 0.5) * 16), round((y - 0.5) * 16)
    cv2.circle(canvas, centre, max(1, round(radius * 16)), colour, -1, cv2.LINE_AA, 4)


def ring(canvas: np.ndarray, x: float, y: float, radius: float, width: float, colour: Colour) -> None:
    """A circle drawn with a line, in texels, in place."""
    centre = round((x - 0.5) * 16), round((y - 0.5) * 16)
    cv2.circle(canvas, centre, round(radius * 16), colour, max(1, round(width)), cv2.LINE_AA, 4)
