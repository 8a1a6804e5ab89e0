"""Single images: whole, or refused with a reason, never half; a damaged one costs its frame, or its right image."""

import io
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import PIL.ImageFile
import pytest

from slam.errors import SequenceError
from slam.sequences import open_sequence
from slam.sequences.images import MOST_PIXELS, decode_image, read_image
from tests import recordings
from tests.fuzz.mutations import png

SCENE = cv2.GaussianBlur(np.random.default_rng(1).integers(0, 255, (90, 120)).astype(np.uint8), (0, 0), 1.5)


def encoded(ending: str, image: np.ndarray = SCENE) -> bytes:
    good, data = cv2.imencode(ending, image)
    assert good
    return data.tobytes()


@pytest.mark.parametrize("ending", [".png", ".jpg", ".pgm", ".bmp", ".tiff", ".webp"])
def test_whole_images_are_read_and_cut_ones_refused_without_a_word(ending: str, tmp_path: Path, capfd) -> None:
    data = encoded(ending)
    path = tmp_path / f"a{ending}"
    path.write_bytes(data + b"\0" * 100 if ending in (".png", ".jpg") else data)  # bytes after the end do no harm
    image = read_image(path)
    assert image.shape == SCENE.shape
    assert np.abs(image.astype(int) - SCENE).mean() < 5  # JPEG and WebP lose a little
    for size in [0, 1, 9, 30, len(data) // 3, len(data) // 2, len(data) - 40]:
        path.write_bytes(data[:size])
        with pytest.raises(SequenceError) as error:
            read_image(path)
        assert str(error.value).startswith(f"{path}: ")
    if ending in (".png", ".jpg"):
        assert capfd.readouterr().err == ""


def test_a_jpeg_with_a_preview_or_a_turned_flag(tmp_path: Path) -> None:
    """An end mark in the preview is not the image's; and a calibration is for pixels as stored."""
    data, preview = encoded(".jpg"), encoded(".jpg", SCENE[:16, :16].copy())
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    path = tmp_path / "a.jpg"
    for segment in (preview, exif):
        path.write_bytes(data[:2] + b"\xff\xe1" + (len(segment) + 2).to_bytes(2, "big") + segment + data[2:])
        assert read_image(path).shape == SCENE.shape
        path.write_bytes(path.read_bytes()[:-200])
        with pytest.raises(SequenceError, match="the image is cut off or damaged"):
            read_image(path)


@pytest.mark.parametrize(("form", "channels"), [(".png", 1), (".png", 3), (".pgm", 1)])
def test_sixteen_bits_stay_sixteen_bits(form, channels):
    pixels = np.full((6, 5, channels), 40_000, np.uint16)
    found = decode_image(cv2.imencode(form, pixels)[1].tobytes(), "x")
    assert found.dtype == np.uint16 and np.abs(found.astype(int) - 40_000).max() <= 1


def test_grey_values_are_as_stored_and_colours_become_grey():
    np.testing.assert_array_equal(decode_image(b"P5\n4 2\n100\n" + bytes(range(8)), "x").ravel(), np.arange(8))
    red = np.full((4, 4, 3), (0, 0, 200), np.uint8)
    assert abs(int(decode_image(encoded(".png", red), "x")[0, 0]) - 0.299 * 200) <= 1
    large = io.BytesIO()
    PIL.Image.fromarray(np.array([[70_000, -5, 100_000]], np.int32)).save(large, "TIFF")
    with pytest.raises(SequenceError, match="int32, not 8 or 16 bit"):
        decode_image(large.getvalue(), "x")


def test_a_huge_image_is_refused_by_its_header():
    with pytest.raises(SequenceError, match=f"at most {MOST_PIXELS} pixels"):
        decode_image(png((8_000, 9_000), b""), "x")


def test_damaged_vanished_and_other_images_cost_no_more_than_themselves(kitti: Path) -> None:
    recordings.cut(kitti / "image_1" / "000000.png")
    recordings.write_image(kitti / "image_0" / "000002.png", 2, width=32)
    recordings.write_image(kitti / "image_1" / "000004.png", 2, width=32)
    sequence = open_sequence(kitti)
    (kitti / "image_0" / "000001.png").unlink()
    assert [(f.index, f.right is None) for f in sequence] == [(0, True), (3, False), (4, True), (5, False)]
    for words in (
        "frame 0 is given without its right image: ",
        "000001.png: there is no such file",
        "frame 2 skipped: ",
        "000002.png: image is 32x48, not 64x48",
    ):
        assert any(words in line for line in sequence.warnings)
