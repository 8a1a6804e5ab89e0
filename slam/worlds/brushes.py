"""What textures are painted with: noise fields, and a page on which bars, discs and lettering are put; BGR, uint8."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np

Colour = Iterable[float]  #: blue, green, red
Rng = np.random.Generator
Size = tuple[int, int]  #: rows, columns
Spots = tuple[float, float, int]  #: how strong, how wide at most [m], and how many octaves
Box = tuple[float, float, float, float]  #: left, top, width, height [texels]

_LETTERS = "ABCDEFGHIJKLMNOPRSTUVWZ"
_FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_COMPLEX, cv2.FONT_HERSHEY_TRIPLEX)


def clouds(size: Size, rng: Rng, cells: float, octaves: int = 3) -> np.ndarray:
    """Smooth noise (H, W) float32 of about unit deviation; its largest blobs are `cells` texels wide."""
    out = np.zeros(size, np.float32)
    for octave in range(octaves):
        out += 0.6**octave * grain(size, rng, (cells, cells))
        cells = max(cells / 2, 1.0)
    return out / np.float32(1.3)


def grain(size: Size, rng: Rng, cells: tuple[float, float]) -> np.ndarray:
    """Stretched noise (H, W) float32 with blobs of (width, height) texels."""
    height, width = size
    small = rng.standard_normal((int(height / cells[1]) + 3, int(width / cells[0]) + 3), np.float32)
    return cv2.resize(small, (0, 0), fx=cells[0], fy=cells[1], interpolation=cv2.INTER_CUBIC)[:height, :width]


def tinted(light: np.ndarray, colour: Colour) -> np.ndarray:
    """A colour under light (H, W), 1 being full; BGR uint8 (H, W, 3)."""
    light = np.maximum(light, 0, dtype=np.float32)
    return np.asarray(cv2.merge([cv2.convertScaleAbs(light, alpha=float(c)) for c in colour]))


def mottled(size: Size, rng: Rng, density: float, colour: Colour, spots: Iterable[Spots]) -> np.ndarray:
    """A colour under uneven light, with some sorts of spots."""
    light: np.ndarray | int = 1
    for strength, wide, octaves in spots:
        light = light + strength * clouds(size, rng, wide * density, octaves)
    return tinted(np.asarray(light), colour)


def wood(size: Size, rng: Rng, density: float, colour: Colour = (105.0, 150.0, 190.0)) -> np.ndarray:
    """Wood with its grain along the rows, `density` texels per metre."""
    fine = grain(size, rng, (0.08 * density, 0.0022 * density))
    broad = grain(size, rng, (0.5 * density, 0.015 * density))
    rings = np.sin(6 * broad + 0.6 * fine)
    return tinted(1 + 0.05 * fine + 0.06 * rings + 0.04 * broad, colour)


def words(rng: Rng, letters: int) -> str:
    """Some capital letters, in two words."""
    text = "".join(_LETTERS[i] for i in rng.integers(len(_LETTERS), size=letters))
    cut = int(rng.integers(2, max(3, letters)))
    return text[:cut] + " " + text[cut:]


class Page:
    """A picture (H, W, 3) of `density` texels a metre on which things are put; (0, 0) is the first texel's corner."""

    def __init__(self, picture: np.ndarray, rng: Rng, density: float = 1.0) -> None:
        self.picture, self.rng, self.density = picture, rng, density
        self.height, self.width = picture.shape[:2]

    def part(self, left: float, top: float, width: float, height: float, of: Box | None = None) -> Box:
        """A box by shares of the picture's width and height, or of a box of it."""
        x, y, w, h = of or (0, 0, self.width, self.height)
        return x + left * w, y + top * h, width * w, height * h

    def bar(self, box: Box, colour: Colour) -> None:
        """A filled upright rectangle."""
        x, y, w, h = box
        points = np.rint((np.array([[x, y], [x + w, y], [x + w, y + h], [x, y + h]]) - 0.5) * 16).astype(np.int32)
        cv2.fillConvexPoly(self.picture, points, tuple(colour), cv2.LINE_AA, 4)

    def dot(self, x: float, y: float, radius: float, colour: Colour) -> None:
        """A filled disc."""
        centre = round((x - 0.5) * 16), round((y - 0.5) * 16)
        cv2.circle(self.picture, centre, max(1, round(radius * 16)), tuple(colour), -1, cv2.LINE_AA, 4)

    def write(self, text: str, box: Box, colour: Colour) -> None:
        """A line of text as large as fits into a box."""
        left, top, width, height = box
        font = _FONTS[int(self.rng.integers(len(_FONTS)))]
        (w, h), _ = cv2.getTextSize(text, font, 1.0, 1)
        scale = min(width / max(w, 1), height / max(h, 1))
        if scale > 0.05:
            place = round(left + (width - scale * w) / 2), round(top + (height + scale * h) / 2)
            thickness = max(1, round(scale * 1.6))
            cv2.putText(self.picture, text, place, font, scale, tuple(colour), thickness, cv2.LINE_AA)

    def title(self, letters: int, box: Box, colour: Colour) -> None:
        """Words of so many letters, as large as fits into a box."""
        self.write(words(self.rng, letters), box, colour)

    def print(self, box: Box, pitch: float, colour: Colour) -> None:
        """Lines of small print that fill a box, `pitch` texels apart."""
        left, top, width, height = box
        for i in range(int(height / pitch)):
            share = self.rng.uniform(0.3, 0.7) if self.rng.random() < 0.2 else self.rng.uniform(0.85, 1.0)
            y, x = top + (i + 0.5) * pitch, left
            while x < left + share * width:
                w = self.rng.uniform(1.0, 4.0) * pitch
                self.bar((x, y - 0.25 * pitch, min(w, left + share * width - x), 0.5 * pitch), colour)
                x += w + 0.6 * pitch
