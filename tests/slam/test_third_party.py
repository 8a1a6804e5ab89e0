"""Back ends and front ends from elsewhere that raise: one line with the part, the call and the frame."""

from __future__ import annotations

import numpy as np
import pytest

from backends.ekf import EkfBackend
from frontends.surf import SurfFrontend
from slam.data import StereoFrame
from slam.errors import ConfigurationError, PartError
from slam.models import EstimatorModels
from slam.system import StereoSlam
from slam.third_party import named_failures
from tests.frontends.scenes import stereo_pair
from tests.slam.test_answers import RIG

LEFT, RIGHT = stereo_pair(12.25)


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
