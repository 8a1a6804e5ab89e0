"""Single images: whole, or refused with a reason; never half."""

from __future__ import annotations

import io
import zlib
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import PIL.ImageFile
import pytest

from slam.errors import SequenceError
from slam.sequences.images import MOST_PIXELS, decode_image, read_image
from tests.fuzz.readers import chunk, png

SCENE = cv2.GaussianBlur(np.random.default_rng(1).integers(0, 255, (90, 120)).astype(np.uint8), (0, 0), 1.5)


def encoded(ending: str, image: np.ndarray = SCENE, *options: int) -> bytes:
    good, data = cv2.imencode(ending, image, options)
    assert good
    return data.tobytes()


@pytest.mark.parametrize("ending", [".png", ".jpg", ".pgm", ".bmp", ".tiff", ".webp"])
def test_whole_images_are_read_and_cut_ones_refused_without_a_word(
    ending: str, tmp_path: Path, capfd: pytest.CaptureFixture
) -> None:
    data = encoded(ending)
    path = tmp_path / f"a{ending}"
    path.write_bytes(data)
    image = read_image(path)
    assert image.shape == SCENE.shape
    assert np.abs(image.astype(int) - SCENE).mean() < 5  # JPEG and WebP lose a little
    for size in [0, 1, 9, 30, len(data) // 3, len(data) // 2, len(data) - 40, len(data) - 1]:
        if ending == ".pgm" and size == len(data) - 1:
            continue
        path.write_bytes(data[:size])
        try:
            partial = read_image(path)
        except SequenceError as error:
            assert str(error).startswith(f"{path}: ")
        else:  # a format that keeps its tables at the end, or padding, may lose a byte: then nothing must be missing
            assert np.array_equal(partial, image)
            assert size == len(data) - 1
    err = capfd.readouterr().err
    if ending in (".png", ".jpg"):
        assert err == ""


@pytest.mark.parametrize("ending", [".png", ".jpg"])
def test_every_cut_is_found(tmp_path: Path, ending: str) -> None:
    data = encoded(ending, SCENE[:8, :8].copy())
    path = tmp_path / "a"
    for size in range(len(data) - 4 * (ending == ".png")):  # the end mark's own checksum guards no pixel
        path.write_bytes(data[:size])
        with pytest.raises(SequenceError):
            read_image(path)


def test_a_flipped_byte_in_a_png_is_found_by_its_checksum(tmp_path: Path) -> None:
    data = bytearray(encoded(".png"))
    path = tmp_path / "a.png"
    for at in range(8, len(data) - 12, 97):
        broken = data.copy()
        broken[at] ^= 0x10
        path.write_bytes(broken)
        with pytest.raises(SequenceError, match="the image is cut off or damaged"):
            read_image(path)


def test_a_cut_jpeg_whose_preview_has_an_end_mark_is_found(tmp_path: Path) -> None:
    data = encoded(".jpg")
    preview = encoded(".jpg", SCENE[:16, :16].copy())
    segment = b"\xff\xe1" + (len(preview) + 2).to_bytes(2, "big") + preview
    path = tmp_path / "a.jpg"
    path.write_bytes(data[:2] + segment + data[2:])
    assert read_image(path).shape == SCENE.shape
    path.write_bytes((data[:2] + segment + data[2:])[:-200])
    with pytest.raises(SequenceError, match="the image is cut off or damaged"):
        read_image(path)


def test_bytes_after_the_end_do_no_harm(tmp_path: Path) -> None:
    for ending in (".png", ".jpg"):
        path = tmp_path / f"a{ending}"
        path.write_bytes(encoded(ending) + b"\0" * 100)
        assert read_image(path).shape == SCENE.shape


def test_floating_point_pixels_are_refused(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.tiff"), SCENE.astype(np.float32))
    with pytest.raises(SequenceError, match="pixels are float32, not 8 or 16 bit"):
        read_image(tmp_path / "a.tiff")


def test_what_is_no_image_at_all(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_text("hello")
    with pytest.raises(SequenceError, match=r"a\.png: not a readable image"):
        read_image(tmp_path / "a.png")
    with pytest.raises(SequenceError, match=r"b\.png: No such file"):
        read_image(tmp_path / "b.png")
    (tmp_path / "c.png").mkdir()
    with pytest.raises(SequenceError, match=r"c\.png: "):
        read_image(tmp_path / "c.png")


def test_the_camera_s_turned_flag_is_ignored(tmp_path: Path) -> None:
    """A calibration is for pixels as stored."""
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    data = encoded(".jpg")
    segment = b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif
    (tmp_path / "a.jpg").write_bytes(data[:2] + segment + data[2:])
    assert cv2.imread(str(tmp_path / "a.jpg"), 0).shape == SCENE.shape[::-1]  # OpenCV would turn it
    assert read_image(tmp_path / "a.jpg").shape == SCENE.shape


@pytest.mark.parametrize("size", [(8_000, 9_000), (30_000, 30_000), (2**31 - 1, 2**31 - 1), (0, 5)])
def test_a_huge_image_is_refused_by_its_header(tmp_path, size):
    (tmp_path / "a.png").write_bytes(png(size, b""))
    with pytest.raises(SequenceError, match=f"at most {MOST_PIXELS} pixels|damaged|not a readable"):
        read_image(tmp_path / "a.png")


def test_an_image_of_another_size_is_not_decoded(tmp_path, monkeypatch):
    (tmp_path / "a.png").write_bytes(png((8000, 8000), b""))
    monkeypatch.setattr(PIL.ImageFile.ImageFile, "load", None)
    with pytest.raises(SequenceError, match="8000x8000, not 64x48"):
        read_image(tmp_path / "a.png", (64, 48))


def test_a_damaged_image_prints_nothing(tmp_path, capfd):
    whole = png((64, 48), zlib.compress(bytes(65 * 48)))
    (tmp_path / "a.png").write_bytes(whole[:33] + chunk(b"iCCP", bytes(20)) + whole[33:])
    assert read_image(tmp_path / "a.png").shape == (48, 64)
    (tmp_path / "b.png").write_bytes(png((64, 48), b"no stream"))
    with pytest.raises(SequenceError, match=r"b\.png"):
        read_image(tmp_path / "b.png")
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("form", [".png", ".tiff", ".ppm"])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_sixteen_bits_stay_sixteen_bits(form, channels):
    if form == ".ppm" and channels == 4:
        form = ".png"
    pixels = np.full((6, 5, channels), 40_000, np.uint16)
    form = ".pgm" if (form, channels) == (".ppm", 1) else form
    found = decode_image(cv2.imencode(form, pixels)[1].tobytes(), "x")
    assert found.dtype == np.uint16 and np.abs(found.astype(int) - 40_000).max() <= 1


def test_grey_values_are_as_stored():
    np.testing.assert_array_equal(decode_image(b"P5\n4 2\n100\n" + bytes(range(8)), "x").ravel(), np.arange(8))
    large = io.BytesIO()
    PIL.Image.fromarray(np.array([[70_000, -5, 100_000]], np.int32)).save(large, "TIFF")
    with pytest.raises(SequenceError, match="int32, not 8 or 16 bit"):
        decode_image(large.getvalue(), "x")
