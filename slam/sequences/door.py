"""What is done to every frame of a recording or a camera at the door: quarter turns, and masks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from slam.data import StereoFrame
from slam.errors import ConfigurationError, SequenceError
from slam.files import expanded
from slam.geometry.rig import StereoRig
from slam.sequences.images import read_image, recorded_size, size_text

#: Of the left and the right camera (H, W) bool, False where the image is not to be used; None for all of it.
Masks = tuple[np.ndarray | None, np.ndarray | None]


def at_the_door(frame: StereoFrame, rig: StereoRig, masks: Masks) -> StereoFrame:
    """The frame as the rig sees it: turned as the rig is, with the masks of both cameras."""
    if rig.turns:
        right = None if frame.right is None else np.ascontiguousarray(np.rot90(frame.right, rig.turns))
        frame = replace(frame, left=np.ascontiguousarray(np.rot90(frame.left, rig.turns)), right=right)
    none = masks[0] is None and masks[1] is None
    return frame if none else replace(frame, left_mask=masks[0], right_mask=masks[1])


def read_masks(text: str | None, folder: Path, rig: StereoRig) -> Masks:
    """The masks by the option ``mask``: one image for both cameras, or two joined by a comma, one perhaps empty.

    Args:
        text: the option; None for no mask. Masks are of the images as they are recorded, before they are turned.
        folder: that names are relative to.
        rig: of the images.

    Raises:
        SequenceError: an image cannot be read.
        ConfigurationError: it is of another size than the camera's images, or covers all of them.
    """
    if text is None:
        return None, None
    names = text.split(",")
    if len(names) > 2 or not any(names):
        raise ConfigurationError(f"mask must be one image, or two joined by a comma, got {text!r}")
    masks = [_read_mask(folder / expanded(name), rig) if name else None for name in names]
    return masks[0], masks[-1]


def _read_mask(path: Path, rig: StereoRig) -> np.ndarray:
    """One mask (H, W) bool, turned as the rig is."""
    try:
        mask = np.rot90(read_image(path) > 0, rig.turns)
    except SequenceError as error:
        raise SequenceError(f"mask: {error}") from error
    if mask.shape != (rig.height, rig.width):
        size = size_text(recorded_size(rig))
        raise ConfigurationError(f"mask {path}: images are {size}, the mask is of another size")
    if not mask.any():
        raise ConfigurationError(f"mask {path}: it is black all over, so that nothing is left of the images")
    return mask
