"""What the documentation shows is run as it stands there."""

import re
import runpy
import shlex
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

import slam
from frontends.surf import SurfConfig
from slam import worlds
from slam.errors import SlamError
from slam.evaluation.metrics import absolute_errors
from slam.geometry import se3
from slam.settings import can_be_set
from tests.recordings import write_opencv, write_video
from tests.scripts import load_script

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
#: Pages that are written by people; the results are written by a script.
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md")),
    *(page for page in sorted(DOCS.rglob("*.md")) if page.name != "results.md" and page.parent.name != "results"),
]


@pytest.mark.slow
def test_the_shown_back_end_follows_the_camera():
    sequence = slam.open_sequence("synthetic:aisle?frames=25")
    system = slam.StereoSlam(sequence.rig, None, load_script("docs/examples/pose_fit.py").PoseFit(sequence.rig))
    results = [system.process_features(sequence.observations(k)) for k in range(len(sequence))]
    assert all(result.status.value == "tracked" for result in results[1:])
    assert absolute_errors(system.trajectory(), sequence.ground_truth).rmse < 0.02  # measured 4 mm, on 25 cm of path


def test_a_world_and_a_format_of_one_s_own_are_opened_by_module_and_name(tmp_path, monkeypatch):
    monkeypatch.chdir(DOCS / "examples")
    monkeypatch.setattr(sys, "path", list(sys.path))
    world = slam.open_sequence("synthetic:hall:HALL?frames=3&high=4")
    for name in "ab":
        (tmp_path / name).mkdir()
    c = world.rig.left
    numbers = {"fx": c.fu, "fy": c.fv, "cx": c.u0, "cy": c.v0, "baseline": world.rig.baseline}
    (tmp_path / "rig.yaml").write_text("".join(f"{name}: {value}\n" for name, value in numbers.items()))
    for frame in world:
        for name, image in (("a", frame.left), ("b", frame.right)):
            cv2.imwrite(str(tmp_path / name / f"{frame.stamp + 1:.3f}.png"), image)
    assert "worlds.scenes" not in (DOCS / "examples/hall.py").read_text()  # so that scenes.py can name its scene
    assert "from slam.sequences import" not in (DOCS / "examples/pairs_format.py").read_text()  # as a module of it
    read = slam.open_sequence(tmp_path, "pairs_format:open_folder")
    assert read.rig.baseline == world.rig.baseline and read.stamps == pytest.approx(world.stamps + 1, abs=1e-3)
    for one, other in zip(world, read, strict=True):
        np.testing.assert_array_equal(one.right, other.right)
    with pytest.raises(SlamError, match=r"is no slam\.worlds\.world\.Scene"):
        slam.open_sequence("synthetic:hall:build")
    with pytest.raises(SlamError, match=r"format 'numpy:eye': TypeError"):
        slam.open_sequence(tmp_path, "numpy:eye")


@pytest.mark.slow
def test_two_streams_of_arrays_are_followed(capsys):
    module = load_script("docs/examples/two_streams.py")
    sequence = slam.open_sequence("synthetic:desk?frames=4&width=160&height=120")
    lefts, rights, stamps = zip(*((frame.left, frame.right, frame.stamp) for frame in sequence))
    path = module.follow(lefts, rights, stamps, sequence.rig.left.K, sequence.rig.baseline)
    assert absolute_errors(path, sequence.ground_truth).rmse < 0.01
    assert capsys.readouterr().out.count("tracked") == 3


def test_a_pose_is_found_among_known_points():
    found = runpy.run_path(str(DOCS / "examples" / "pose_from_points.py"))
    solution = found["solution"]
    error = se3.log(se3.inverse(solution.window.poses[0]) @ found["T_true"])
    assert error @ np.linalg.solve(solution.pose_covariance, error) < 22.5  # χ²₆: 0.1 %
    assert 45 < solution.cost < 130  # 90 measurements


@pytest.mark.parametrize("name", ["walk", "walk.bag"])  # ROS 2, ROS 1
@pytest.mark.parametrize("rig", ["rectified", "toedin"])
def test_a_bag_is_written_and_read_again(tmp_path, monkeypatch, rig, name):
    source = f"synthetic:desk?frames=3&width=160&height=120&rig={rig}"
    monkeypatch.setattr(sys, "argv", ["write_bag.py", source, str(tmp_path / name)])
    runpy.run_path(str(DOCS / "examples" / "write_bag.py"))
    written, read = slam.open_sequence(source), slam.open_sequence(tmp_path / name)
    assert read.rig.is_rectified == (rig == "rectified")
    assert read.rig.baseline == pytest.approx(written.rig.baseline)
    np.testing.assert_allclose(read.rig.left.distortion, written.rig.left.distortion)
    np.testing.assert_allclose(read.rig.R, written.rig.R, atol=1e-9)
    np.testing.assert_allclose(read.rig.left.K, written.rig.left.K)
    for one, other in zip(written, read, strict=True):
        assert one.stamp == pytest.approx(other.stamp, abs=1e-6)
        np.testing.assert_array_equal(one.left, other.left)
        np.testing.assert_array_equal(one.right, other.right)


@pytest.mark.slow
def test_the_webcam_writes_a_path(tmp_path, monkeypatch, capsys):
    text = (DOCS / "examples" / "webcam.py").read_text()
    sequence = slam.open_sequence("synthetic:desk?frames=8&width=160&height=120")
    write_opencv(tmp_path / "calibration.yaml", sequence.rig)
    write_video(tmp_path / "both.avi", [np.hstack([f.left, f.right]) for f in sequence], "MJPG", 5.0)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["webcam.py", "both.avi?layout=sbs"])
    exec(compile(text, "webcam.py", "exec"), {})
    poses = len((tmp_path / "path.txt").read_text().splitlines())
    assert 1 <= poses <= 8
    assert capsys.readouterr().out.count(" m, ") == poses


def test_every_page_links_to_what_exists():
    for page in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *DOCS.rglob("*.md")]:
        for target in re.findall(r"\]\(([^)#\s]+)", page.read_text(encoding="utf-8")):
            if not target.startswith(("http:", "https:", "mailto:")):
                assert (page.parent / target).exists(), f"{page.relative_to(ROOT)}: {target}"


def test_api_pages_say_what_the_docstrings_say():
    make_api = load_script("docs/make_api.py")
    for page in (DOCS / "api").glob("*.md"):
        text = page.read_text(encoding="utf-8")
        assert make_api.ROW.sub(make_api.row, text) == text, "python docs/make_api.py"


SETTING = re.compile(r"[` ](models|association|map|atlas|self_calibration|objects|frontend)\.(?!csv)(\w+)[`=]")
FENCE = re.compile(r"^```[ {.]*(\w*)[^\n]*\n(.*?)^```", re.M | re.S)


def each_page(test):
    return pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())(test)


def blocks(page, *languages):
    """Texts of the fenced blocks in one of these languages."""
    return [text for language, text in FENCE.findall(page.read_text(encoding="utf-8")) if language in languages]


def commands(page, *languages):
    """Words of every command in the fenced blocks of a shell; comments and what consoles answer left out."""
    for block in blocks(page, *(languages or ("sh", "shell", "bash", "console"))):
        lines = block.replace("\\\n", " ").splitlines()
        for line in [line.removeprefix("$ ") for line in lines if line.startswith("$ ") or "\n$ " not in f"\n{block}"]:
            words = shlex.split(line, comments=True)
            while words:
                end = next((i for i, word in enumerate(words) if word in ("&&", "|", ";")), len(words))
                yield words[:end]
                words = words[end + 1 :]


@each_page
def test_settings_exist(page):
    for section, name in SETTING.findall(page.read_text(encoding="utf-8")):
        fine = name in SurfConfig.__dataclass_fields__ if section == "frontend" else can_be_set(f"{section}.{name}")
        assert fine, f"{section}.{name}"


@each_page
def test_worlds_and_scripts_exist(page):
    text = page.read_text(encoding="utf-8")
    for name, query in re.findall(r"synthetic:([a-z]+)(?!:)\b(?:\?([\w=&.:,]+))?", text):
        worlds.values_of(name, "" if "key=" in query else query)
    for script in re.findall(r"\b(?:python|pytest)(?: -\S+)* ((?:experiments|benchmarks|docs|tests)/\S+?\.py)", text):
        assert (ROOT / script).is_file(), script


#: What is put in place of what the reader has, by page. On all pages worlds have a few frames.
FOR_THE_READER = {
    "README.md": {"path/to/kitti_or_euroc_folder": "synthetic:desk?frames=3"},
    "docs/worlds.md": {"box=1": "box=1&width=160&height=120"},
}
#: Run by a test of its own.
ELSEWHERE = {"docs/guide.md"}
_FRAMES = 11


def reader_has(name):
    """What the Python of a page takes for granted."""
    if name == "docs/selfcalibration.md":
        rig = slam.open_sequence("synthetic:street?frames=2").rig
        slam.save_calibration("rig.json", slam.StereoSlam(rig).calibration.kept())
    return {}


@pytest.mark.slow
@each_page
def test_python_in_pages_runs(page, tmp_path, monkeypatch):
    name = page.relative_to(ROOT).as_posix()
    parts = blocks(page, "python")
    if not parts or name in ELSEWHERE:
        return
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(DOCS / "examples"), *sys.path])
    names = reader_has(name)
    for block in parts:
        for shown, used in FOR_THE_READER.get(name, {}).items():
            block = block.replace(shown, used)
        block = re.sub(r"frames=(\d+)", lambda found: f"frames={min(int(found[1]), _FRAMES)}", block)
        exec(compile(block, name, "exec", dont_inherit=True), names)
