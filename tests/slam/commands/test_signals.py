import signal

import pytest

from slam.commands import cli
from slam.commands.ending import Stopped, whole_frames

WORLD = "synthetic:desk?frames=3"


@pytest.mark.parametrize(
    ("arguments", "function", "left"),
    [
        (["calibrate", WORLD], "slam.commands.calibrate.calibrate", "; nothing is written"),
        (
            ["compare", WORLD, "--out", "all"],
            "slam.commands.compare.compare",
            "; trials done so far are kept",
        ),
        (["run", WORLD, "--out", "one"], "slam.run.runner.run", "; no frame was done yet"),
        (["settings"], "slam.run.settings_reference.listing", ""),
    ],
)
def test_a_signal_ends_a_command_with_what_it_leaves(monkeypatch, tmp_path, capsys, arguments, function, left):
    def stop(*_, **__):
        raise Stopped(signal.SIGTERM)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(function, stop)
    monkeypatch.setattr(cli, "catch_signals", lambda: None)
    monkeypatch.setattr("sys.argv", ["slam", *arguments])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 128 + signal.SIGTERM
    said = capsys.readouterr().err
    assert said.startswith(f"slam: stopped by SIGTERM{left}") and said.count("\n") == 1


def test_a_run_that_did_frames_says_where_they_are_and_how_to_see_them(tmp_path):
    with pytest.raises(Stopped) as stopped, whole_frames(lambda result: None, tmp_path / "my run") as end_of_frame:
        end_of_frame(None)
        raise Stopped(signal.SIGTERM)
    assert stopped.value.leaves == f"frames done so far are kept: `slam plot '{tmp_path}/my run'` draws them"
