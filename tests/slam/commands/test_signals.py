import signal

import pytest

from slam.commands import cli
from slam.commands.ending import Stopped, whole_frames


def test_a_signal_ends_a_command_in_one_line(monkeypatch, tmp_path, capsys):
    def stop(*_, **__):
        raise Stopped(signal.SIGTERM)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("slam.run.runner.run", stop)
    monkeypatch.setattr(cli, "catch_signals", lambda: None)
    monkeypatch.setattr("sys.argv", ["slam", "run", "synthetic:desk?frames=3", "--out", "one"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 128 + signal.SIGTERM
    said = capsys.readouterr().err
    assert said.startswith("slam: stopped by SIGTERM; no frame was done yet") and said.count("\n") == 1


def test_a_run_that_did_frames_says_where_they_are_and_how_to_see_them(tmp_path):
    with pytest.raises(Stopped) as stopped, whole_frames(lambda result: None, tmp_path / "my run") as end_of_frame:
        end_of_frame(None)
        raise Stopped(signal.SIGTERM)
    assert stopped.value.leaves == f"frames done so far are kept: `slam plot '{tmp_path}/my run'` draws them"
