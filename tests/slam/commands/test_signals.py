import signal

import pytest

from slam.commands import cli
from slam.commands.signals import Stopped

WORLD = "synthetic:desk?frames=3"


@pytest.mark.parametrize(
    ("arguments", "function", "left"),
    [
        (["calibrate", WORLD], "slam.commands.calibrate.calibrate", "; nothing is written"),
        (
            ["compare", WORLD, "--out", "all"],
            "slam.commands.compare.compare",
            "; trials done so far are kept: the same command continues",
        ),
        (["run", WORLD, "--out", "one"], "slam.run.runner.run", "; frames done so far are kept"),
        (["settings"], "slam.commands.settings.print_settings", ""),
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
    assert capsys.readouterr().err == f"slam: stopped by SIGTERM{left}\n"
