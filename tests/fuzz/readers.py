"""Folders of every format, and ROS recordings, with hostile files in them."""

import os
import tempfile
from functools import cache
from pathlib import Path

import numpy as np

import slam
from slam.sequences.images import quiet_libraries
from tests import bags, recordings
from tests.fuzz.harness import Broken, Subject
from tests.fuzz.mutations import NUMBERS, PATHS, Files, choose, mutate


def raw(folder: Path) -> Path:
    """A drive of KITTI raw, with OXTS records too."""
    drive = recordings.write_raw(folder / "day")
    recordings.write_oxts(drive, [f"49.0 8.400{k} 112.8 0.02 0.01 -1.2" for k in range(6)])
    return drive


def videos(folder: Path) -> Path:
    """Two videos with OpenCV's calibration."""
    recordings.write_storage(folder / "calibration.xml", recordings.stereo_entries())
    for side in ("left", "right"):
        with quiet_libraries():  # ffmpeg asks only once how much it may say
            recordings.write_video(folder / f"{side}.avi", [recordings.picture(k) for k in range(4)], "MJPG", 20.0)
    return folder


WRITERS = (recordings.write_euroc, recordings.write_kitti, raw, recordings.write_two_folders, videos)


@cache
def _written(number: int) -> tuple[Files, str]:
    """The files of a format, by their names, and the folder of the sequence among them."""
    with tempfile.TemporaryDirectory() as name:
        sequence = WRITERS[number](Path(name))
        files = {str(p.relative_to(name)): p.read_bytes() for p in sorted(Path(name).rglob("*")) if p.is_file()}
        return files, str(sequence.relative_to(name))


def some_format(rng: np.random.Generator) -> tuple[Files, str]:
    """The files of one of the formats, and the folder of the sequence among them."""
    files, sequence = _written(int(rng.integers(len(WRITERS))))
    return dict(files), sequence


def read_folder(rng: np.random.Generator, folder: Path) -> None:
    """Write a mutated folder and read it to its end."""
    files, sequence = some_format(rng)
    for _ in range(int(rng.integers(1, 4))):
        mutate(rng, files)
    write(files, folder / "tree")
    for _ in range(int(rng.integers(3)) // 2):
        special(rng, folder / "tree")
    consume(str(folder / "tree" / sequence))


def read_path(rng: np.random.Generator, folder: Path) -> None:
    """Open what is no folder at all, or a folder with hostile options."""
    if rng.random() < 0.5:
        consume(choose(rng, PATHS), frames=2)
        return
    files, sequence = some_format(rng)
    write(files, folder / "tree")
    key = choose(rng, ("left", "right", "calibration", "times", "fps", "unit", "rectified", "fisheye", "kind", "x"))
    consume(f"{folder / 'tree' / sequence}?{key}={choose(rng, (*PATHS, *NUMBERS))}")


def consume(path: str, frames: int = 100) -> None:
    """Open a sequence and read frames; what comes must be sound."""
    sequence = slam.open_sequence(path)
    if len(str(sequence.warnings)) > 100_000 or any("\n" in line for line in sequence.warnings):
        raise Broken("warnings are not lines of bounded length")
    last = -np.inf
    for count, frame in enumerate(sequence, 1):
        if not (np.isfinite(frame.stamp) and frame.stamp > last):
            raise Broken("time does not increase")
        last = frame.stamp
        for pixels in (frame.left, frame.right):
            if pixels is not None and pixels.shape[:2] != (sequence.rig.height, sequence.rig.width):
                raise Broken("an image is not of the rig's size")
        if count == frames:
            break
    truth = sequence.ground_truth
    if truth is not None and len(truth) > 1 and not path.startswith("synthetic:"):
        R = truth.poses[:, :3, :3]
        rigid = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max() < 0.1 and (np.linalg.det(R) > 0).all()
        if not (rigid and np.abs(truth.positions).max() < 1e9 and truth.poses[:, :3, 3].any()):
            raise Broken("ground truth that cannot be true is accepted")


def special(rng: np.random.Generator, root: Path) -> None:
    """Put something that is not a regular file in a file's place."""
    files = sorted(p for p in root.rglob("*") if p.is_file() and not p.is_symlink())
    if not files:
        return
    path = choose(rng, files)
    path.unlink()
    kind = int(rng.integers(6))
    if kind == 0:
        os.mkfifo(path)
    elif kind == 1:
        path.mkdir()
    else:
        path.symlink_to(
            choose(rng, ("/dev/zero", "/dev/full", path.name, "nowhere", "/proc/self/mem", "/proc/kmsg", "/"))
        )


def write(files: Files, root: Path) -> None:
    """Write files below a folder; those whose names no file can have are left out."""
    root.mkdir(exist_ok=True)
    for name, data in files.items():
        path = root / name
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        except (OSError, ValueError):
            continue


KINDS = ("walk.bag", "walk.bag CHUNKS", *(f"walk{e}{p}" for e in (".mcap", "") for p in ("", " FILE", " MESSAGE")))


@cache
def _recorded(kind: str) -> Files:
    """The files of a small recording of a kind."""
    with tempfile.TemporaryDirectory() as folder:
        name, _, packed = kind.partition(" ")
        version = 1 if name.endswith(".bag") else 2
        bags.write(Path(folder) / name, bags.stereo(bags.STORES[version], 5), version, packed)
        return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(Path(folder).rglob("*")) if p.is_file()}


def read_bag(rng: np.random.Generator, folder: Path) -> None:
    """Write a damaged recording and read it to its end."""
    files = dict(_recorded(choose(rng, KINDS)))
    whole = folder / Path(min(files)).parts[0]
    mutate(rng, files)
    write(files, folder)
    alone = sorted(path for path in whole.glob("*") if path.suffix != ".yaml") or [whole]
    consume(str(whole if rng.random() < 0.6 else alone[0]))


SUBJECTS = (
    Subject("folders", read_folder, runs=False),
    Subject("paths", read_path, runs=False),
    Subject("bags", read_bag, quiet=False, runs=False),
)
