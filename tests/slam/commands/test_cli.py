import subprocess
import sys

import pytest

from slam.commands.run import require_no_recording
from slam.errors import SlamError
from slam.sequences import open_sequence
from slam.worlds.export import write_euroc
from tests.scripts import command


def test_a_folder_that_is_missing_ends_in_one_line(tmp_path):
    words = [sys.executable, "-m", "slam", "run", str(tmp_path / "nowhere"), "--out", str(tmp_path / "out")]
    done = subprocess.run(words, capture_output=True, text=True, timeout=600)
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1 and "nowhere" in done.stderr


def test_a_recording_is_no_place_for_a_run(tmp_path):
    euroc = tmp_path / "euroc"
    write_euroc(open_sequence("synthetic:desk?frames=3&width=160&height=120"), euroc)
    before = sorted(euroc.rglob("*"))
    for words in (["run", "synthetic:desk?frames=1"], ["compare", "synthetic:desk?frames=1"], ["demo"]):
        with pytest.raises(SlamError, match=r"holds a recording \(format euroc\)"):
            command(*words, "--out", euroc, "--overwrite")
    assert sorted(euroc.rglob("*")) == before
    runs = tmp_path / "runs"
    for name in ("left", "right"):  # a run's folder may have any name
        (runs / name).mkdir(parents=True)
        (runs / name / "summary.json").touch()
        (runs / name / "summary.png").touch()
    require_no_recording(runs)
    (runs / "left" / "summary.json").unlink()
    with pytest.raises(SlamError, match="holds a recording"):
        require_no_recording(runs)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["run", "{empty}"], "empty"),
        (["run", "synthetic:desk", "--backend", "foo"], "'foo'; known: .*ekf, .*smoother"),
        (["run", "synthetic:desk", "--set", "backend.colour=1"], "colour"),
        (["run", "synthetic:desk", "--frames", "40"], "A:B; 0:40 are the first 40"),
        (["run", "synthetic:desk?frames=3", "--frames", "7:9"], "7:9"),
        (["run", "synthetic:desk", "--record", "tape.txt"], r"tape\.txt: .*--record FILE\.npz"),
        (["compare", "synthetic:desk", "--trials", 0], "trials must be 1 or more"),
    ],
)
def test_bad_input_is_refused(tmp_path, words, said):
    with pytest.raises(SlamError, match=said):
        command(*(str(word).replace("{empty}", str(tmp_path)) for word in words), "--out", tmp_path / "out")
