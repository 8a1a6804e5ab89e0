"""Outputs are checked before any work, and archives before they are unpacked: what is there stays, inputs always."""

import io
import os
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest

from slam.errors import SlamError
from slam.files import RowFile, unpack, write_png, write_text
from slam.outputs import Output, require_outputs


def file(path, option="--save-map", **more):
    return Output(Path(path), option, **more)


def folder(path, *names, option="--out"):
    return Output(Path(path), option, names or ("a.txt", "[0-9]*.png", "runs/"))


def refused(outputs, match, inputs=(), overwrite=False):
    with pytest.raises(SlamError, match=match) as caught:
        require_outputs(outputs, inputs, overwrite)
    assert "\n" not in str(caught.value)


def test_what_is_there_is_not_replaced_without_being_asked(tmp_path):
    for name in ("old", "a.txt", "000001.png", "mine.txt"):
        (tmp_path / name).write_text("x")
    before = sorted(tmp_path.iterdir())
    refused([file(tmp_path / "old")], r"old: is there already; give another --save-map, or --overwrite to replace it$")
    refused([file(tmp_path / "old")], "give another --save-map$", overwrite=None)
    refused([folder(tmp_path)], r"000001\.png: is there already")
    require_outputs([file(tmp_path / "old"), folder(tmp_path)], overwrite=True)
    require_outputs([folder(tmp_path, "b.txt"), folder(tmp_path / "new" / "er"), file(tmp_path / "new.map")])
    assert sorted(tmp_path.iterdir()) == before  # and nothing is made


def test_an_input_is_never_replaced(tmp_path):
    images = tmp_path / "data" / "image_0"
    images.mkdir(parents=True)
    for path in (images / "a.png", tmp_path / "data" / "calib.txt", tmp_path / "a.map"):
        path.write_text("x")
    (tmp_path / "link").symlink_to("data/calib.txt")
    os.link(tmp_path / "a.map", tmp_path / "same.map")
    inputs = [tmp_path / "data", tmp_path / "a.map"]
    for path in ("a.map", "same.map", "link", "data/calib.txt", "data/image_0/../calib.txt"):
        refused([file(tmp_path / path)], "is an input", inputs, overwrite=True)
    for path in ("data", "data/image_0"):
        refused([folder(tmp_path / path)], "in a folder of inputs", inputs, overwrite=True)
    require_outputs([folder(tmp_path / "data" / "results" / "1"), file(tmp_path / "data" / "new.map")], inputs)
    run = tmp_path / "data" / "run"
    run.mkdir()
    for name in ("config.json", "frames.csv", "a.txt"):
        (run / name).write_text("x")
    require_outputs([folder(run)], inputs, overwrite=True)  # of an earlier run: not what was recorded
    refused([folder(run)], "is there already", inputs)


def test_two_outputs_are_not_the_same(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "link").symlink_to("out")
    out, words = folder(tmp_path / "out"), "cannot write to the same place"
    for path in ("out/a.txt", "link/a.txt", "out/000000.png", "out/./a.txt"):
        refused([out, file(tmp_path / path)], words)
    for path in ("out", "link"):
        refused([out, folder(tmp_path / path, option="--draw")], words)
    refused([file(tmp_path / "x"), file(tmp_path / "./x", "--record")], words)
    require_outputs([out, file(tmp_path / "out/my.map"), folder(tmp_path / "out" / "pictures", option="--draw")])
    require_outputs([folder(tmp_path / "new"), file(tmp_path / "new" / "my.map")])  # in a folder that will be made


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("loop", "symbolic links"), ("folder", "not a regular file"), ("text/a", "ot a directory|not a folder"),
        ("x" * 300, "too long"), ("a\0b", "no possible"),
    ],
)  # fmt: skip
def test_what_cannot_be_written_is_said(tmp_path, path, words):
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "folder").mkdir()
    (tmp_path / "text").write_text("x")
    refused([file(tmp_path / path)], words, overwrite=True)
    if path != "folder":
        refused([folder(tmp_path / path)], "cannot be written|no possible", overwrite=True)


def test_what_a_link_points_to_is_left_alone(tmp_path):
    (tmp_path / "real").write_text("mine")
    for name in ("rows", "picture.png"):
        (tmp_path / name).symlink_to("real")
    RowFile(tmp_path / "rows").close()
    write_png(tmp_path / "picture.png", np.zeros((4, 4), np.uint8))
    assert (tmp_path / "real").read_text() == "mine"
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(SlamError, match="symbolic links"):
        write_text(tmp_path / "loop", "x")


def packed(members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", method) as file:
        for name, data in members.items():
            file.writestr(name, data)
    return out.getvalue()


ONE = packed({"a": b"x"})
AT = ONE.index(b"PK\x01\x02") + 8  # its flags


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: packed({name: bytes(40_000_000) for name in "abc"}), "would unpack to 12"),
        (lambda: ONE[:AT] + b"\x01" + ONE[AT + 1 :], "encrypted"),
        (lambda: packed({"a": b"x"}, zipfile.ZIP_LZMA), "packed in a way"),
        (lambda: packed({f"{k}": b"" for k in range(200)}), "200 members"),
    ],
    ids=["bomb", "encrypted", "packed oddly", "many members"],
)
def test_an_archive_made_on_purpose_is_refused(make, words):
    assert unpack(ONE, "a.npz") == {"a": b"x"}
    data = make()
    started = time.process_time()
    with pytest.raises(SlamError, match=f"a.npz: .*{words}"):
        unpack(data, "a.npz")
    assert time.process_time() - started < 1.0
