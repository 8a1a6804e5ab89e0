"""Back ends and front ends from elsewhere that raise: one line with the part, the call and the frame."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from backends.ekf import EkfBackend
from frontends.surf import SurfFrontend
from slam.commands.cli import main
from slam.data import StereoFrame
from slam.errors import ConfigurationError, PartError
from slam.models import EstimatorModels
from slam.system import StereoSlam
from slam.third_party import named_failures
from tests.frontends.scenes import stereo_pair
from tests.fuzz.commands import elsewhere
from tests.slam.test_answers import RIG

LEFT, RIGHT = stereo_pair(12.25)

MODULE = """
from backends.ekf import EkfBackend
class Raises(EkfBackend):
    def update(self, observations, guess=None):
        if len(self.trajectory()) > 2:
            raise ZeroDivisionError("no way")
        return super().update(observations, guess)
class Short(EkfBackend):
    def update(self, observations):
        return super().update(observations)
"""


class Failing(EkfBackend):
    def __init__(self, method: str, error: BaseException) -> None:
        super().__init__(RIG, models=EstimatorModels())
        self.error = error
        setattr(self, method, self.fails)

    def fails(self, *_: object, **__: object) -> None:
        raise self.error


class Blind(SurfFrontend):
    def extract(self, frame):
        raise StopIteration


@pytest.mark.parametrize("error", [ZeroDivisionError("no way"), SystemExit(3), StopIteration()])
@pytest.mark.parametrize("method", ["predict", "estimate"])
def test_a_failing_back_end_is_named_and_the_cause_is_kept(method, error):
    system = StereoSlam(RIG, "surf", Failing(method, error))
    with pytest.raises(PartError, match=rf"^frame 0: Failing.fails failed: {type(error).__name__}") as raised:
        system.process(LEFT, RIGHT, 0.0)
    assert raised.value.__cause__ is error


def test_a_front_end_that_stops_does_not_end_the_frames():
    system = StereoSlam(RIG, Blind(RIG), "ekf")
    frames = [StereoFrame(0, 0.0, LEFT, RIGHT)]
    for overlap in (True, False):
        with pytest.raises(PartError, match=r"^frame 0: Blind.extract failed: StopIteration"):
            list(system.run(frames, overlap))


def test_exceptions_of_our_own_parts_and_interrupts_go_on():
    for error in (ValueError("a defect"), np.linalg.LinAlgError("singular")):
        with pytest.raises(type(error)), named_failures("frame 0", EkfBackend(RIG, models=EstimatorModels())):
            raise error
    with pytest.raises(KeyboardInterrupt), named_failures("frame 0", Failing("predict", ValueError())):
        raise KeyboardInterrupt


def test_what_is_no_part_is_refused():
    with pytest.raises(ConfigurationError, match="back end int is none: it lacks predict"):
        StereoSlam(RIG, None, 3)
    with pytest.raises(ConfigurationError, match="rig must be a StereoRig, got NoneType"):
        StereoSlam(None)


@pytest.mark.parametrize(
    ("name", "words", "rows"),
    [
        ("Raises", "frame 2: Raises.update failed: ZeroDivisionError: no way (my_failing_module.py, line 6)", 2),
        ("Short", "frame 0: Short.update failed: TypeError: Short.update() takes 2 positional arguments", 0),
    ],
)
def test_a_run_keeps_the_frames_before(tmp_path, monkeypatch, capsys, name, words, rows):
    (tmp_path / "my_failing_module.py").write_text(MODULE)
    monkeypatch.setattr(sys, "path", list(sys.path))
    words_of_command = ["run", "synthetic:desk?frames=4&width=96&height=72", "--out", "out", "--quiet"]
    monkeypatch.setattr(sys, "argv", ["slam", *words_of_command, "--backend", f"my_failing_module:{name}"])
    with elsewhere(tmp_path), pytest.raises(SystemExit) as end:  # and signals as they were
        main()
    lines = capsys.readouterr().err.strip().splitlines()
    assert end.value.code == 2
    assert words in lines[-1] and "SLAM_DEBUG=1" in lines[-1]
    assert len((tmp_path / "out/frames.csv").read_text().splitlines()) == 1 + rows
    monkeypatch.setenv("SLAM_DEBUG", "1")
    monkeypatch.setattr(sys, "argv", [*sys.argv, "--overwrite"])
    with elsewhere(tmp_path), pytest.raises(PartError):
        main()
