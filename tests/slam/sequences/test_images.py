"""Single images: whole, or refused with a reason; never half."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from slam.errors import SequenceError
from slam.sequences.images import read_image

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


def test_every_cut_of_a_png_is_found(tmp_path: Path) -> None:
    data = encoded(".png", SCENE[:8, :8].copy())
    path = tmp_path / "a.png"
    for size in range(len(data)):
        path.write_bytes(data[:size])
        with pytest.raises(SequenceError):
            read_image(path)


def test_every_cut_of_a_jpeg_is_found(tmp_path: Path) -> None:
    data = encoded(".jpg", SCENE[:8, :8].copy())
    path = tmp_path / "a.jpg"
    for size in range(len(data)):
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
        with pytest.raises(SequenceError, match=r"PNG is (damaged|cut off)"):
            read_image(path)


def test_a_cut_jpeg_whose_preview_has_an_end_mark_is_found(tmp_path: Path) -> None:
    data = encoded(".jpg")
    preview = encoded(".jpg", SCENE[:16, :16].copy())
    segment = b"\xff\xe1" + (len(preview) + 2).to_bytes(2, "big") + preview
    path = tmp_path / "a.jpg"
    path.write_bytes(data[:2] + segment + data[2:])
    assert read_image(path).shape == SCENE.shape
    path.write_bytes((data[:2] + segment + data[2:])[:-200])
    with pytest.raises(SequenceError, match="JPEG is cut off after"):
        read_image(path)


def test_bytes_after_the_end_do_no_harm(tmp_path: Path) -> None:
    for ending in (".png", ".jpg"):
        path = tmp_path / f"a{ending}"
        path.write_bytes(encoded(ending) + b"\0" * 100)
        assert read_image(path).shape == SCENE.shape


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_depth_is_kept(tmp_path: Path, dtype: type) -> None:
    image = (SCENE.astype(np.uint32) * (1 if dtype == np.uint8 else 257)).astype(dtype)
    cv2.imwrite(str(tmp_path / "a.png"), image)
    read = read_image(tmp_path / "a.png")
    assert read.dtype == dtype
    assert np.array_equal(read, image)


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
