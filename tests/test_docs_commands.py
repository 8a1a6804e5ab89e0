"""Every command that a page shows is run: in the page's order, in one folder, on a few frames of stand-ins."""

import importlib.util
import os
import re
import shutil
import subprocess
import sys

import cv2
import numpy as np
import pytest

import slam
from slam.worlds.export import write_euroc
from tests.recordings import write_opencv, write_video
from tests.scripts import command
from tests.slam.numeric import straight
from tests.test_docs import DOCS, PAGES, ROOT, blocks, commands

pytestmark = pytest.mark.slow

FEW = 4  # frames
SHELLS = ("sh", "shell", "bash")  # consoles have tests of their own
#: First words of what installs, tests or builds the package itself: `.ci/run` does all of it.
OF_THE_PACKAGE = {"git", "cd", "pip", "pytest", "ruff", "mypy", "mkdocs", "pre-commit", "python3", ".", ".ci/run"}
#: A camera and recordings of ROS, which tests/slam/sequences plays and writes; timings; kernels are compiled by .ci/run
#: and tests/slam/runtime.
NOT_AT_HAND = re.compile(r"^camera:|\.(bag|mcap|db3)(\?|$)|^walk_folder$|^benchmarks/|^warm-up$")
#: What the page shows, and what is run in its place.
STAND_INS = {
    "path/to/kitti_or_euroc_folder": "euroc",
    "path/to/drive_1": "synthetic:street",
    "path/to/drive_2": "synthetic:street?layout=1",
    "truth.txt": "mine_ekf/trajectory.txt",
}
#: Options that get another value.
SHORTER = {"--trials": "1", "--seeds": "1"}
#: Options that are added to a command; runs leave pictures on README alone.
ADDED = {"demo": ["--frames", "10"], "compare": ["--workers", "1", "--trials", "1"], "view": ["--to", "shown.rrd"]}
WITHOUT_PICTURE = ("run", "replay")
README = PAGES[0]


@pytest.fixture(scope="module")
def reader(tmp_path_factory):
    """A folder with what a reader has: a recording in EuRoC's form, folders of images, videos, and a path."""
    root = tmp_path_factory.mktemp("reader")
    sequence = slam.open_sequence(f"synthetic:desk?frames={FEW}")
    write_euroc(sequence, root / "euroc")
    for name, file, unit in (("recording", "calibration.yaml", 1), ("mine", "stereo.yml", 1000)):
        (root / name).mkdir()
        write_opencv(root / name / file, sequence.rig, unit)
    both = [np.hstack([frame.left, frame.right]) for frame in sequence]
    write_images(root / "images", both)
    for folder in (root, root / "images"):
        write_opencv(folder / "calibration.yaml", sequence.rig)
    for name in ("walk", "both"):
        write_video(root / f"{name}.mp4", both)
    for side in ("left", "right"):
        images = [getattr(frame, side) for frame in sequence]
        write_images(root / "recording" / side, images)
        write_video(root / "mine" / f"{side[0]}.mp4", images)
    for name in ("pose_fit.py", "orb_front.py"):
        shutil.copy(DOCS / "examples" / name, root)
    (root / "poses").mkdir()
    straight(60).write_kitti(root / "poses" / "00.txt")
    return root


def write_images(folder, images):
    folder.mkdir()
    for k, image in enumerate(images):
        cv2.imwrite(str(folder / f"{k:06}.png"), image)


def shortened(words):
    """The command for stand-ins and a few frames; it opens no window."""
    words = [STAND_INS.get(word, word) for word in words]
    out = []
    for option, word in zip([None, *words], words):
        if option == "--frames":
            first, colon, _ = word.partition(":")
            word = f"{first}:{int(first) + FEW}" if colon else str(4 * FEW)
        elif word.startswith("synthetic:"):
            word = re.sub(r"frames=\d+", f"frames={FEW}", word)
            if "frames=" not in word and "--frames" not in words:
                word += f"{'&' if '?' in word else '?'}frames={FEW}"
        out.append(SHORTER.get(option) or word)
    return out + (ADDED.get(out[1], []) if out[0] == "slam" else [])


def needs_rerun(words):
    return "--viewer" in words or words[:2] == ["slam", "view"]


def run_on(page):
    """Words of the commands of a page that are run: of README all, of the others what README does not show."""
    shown = (words for words in commands(page, *SHELLS) if words[0] not in OF_THE_PACKAGE)
    at_hand = [words for words in shown if not any(NOT_AT_HAND.search(word) for word in words)]
    return [words for words in at_hand if page == README or words not in run_on(README)]


@pytest.mark.parametrize("page", [page for page in PAGES if run_on(page)], ids=lambda page: page.stem)
def test_commands_run(page, reader, tmp_path, monkeypatch):
    shutil.copytree(reader, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))  # a back end of the working folder adds to it
    if page.name == "objects.md":  # the database that its Python saves
        (code,) = [block for block in blocks(page, "python") if "ObjectDatabase" in block]
        exec(compile(code, page.name, "exec", dont_inherit=True), {})
    for words in map(shortened, run_on(page)):
        if needs_rerun(words) and importlib.util.find_spec("rerun") is None:
            continue
        if words[0] == "slam":
            words += ["--no-picture"] if words[1] in WITHOUT_PICTURE and page != README else []
            command(*words[1:], status=int(words[1] == "calibrate"))  # so few frames do not tell how good a rig is
        else:
            done = in_a_process(words, tmp_path)
            assert done.returncode == 0, f"{' '.join(words)}\n{done.stdout[-800:]}\n{done.stderr[-800:]}"


def in_a_process(words, folder):
    """Run a script of this repository, or a tool that is installed with the tests."""
    words = [word for word in words if word != "--plot"]  # it would open a window
    if words[0] == "python":
        words = [sys.executable, *(str(ROOT / word) if word.startswith("experiments/") else word for word in words[1:])]
    else:
        words[0] = shutil.which(words[0]) or words[0]
    paths = os.pathsep.join([str(ROOT), str(DOCS / "examples")])
    environment = {**os.environ, "PYTHONPATH": paths, "HOME": str(folder), "MPLBACKEND": "agg"}
    return subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, timeout=300)
