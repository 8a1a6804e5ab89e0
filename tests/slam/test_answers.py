"""Parts of elsewhere that raise or answer nonsense end a step with one line: the frame, the part and the method."""

from dataclasses import replace

import numpy as np
import pytest

from backends.ekf import EkfBackend
from frontends.surf import SurfFrontend
from slam.data import Observations, StereoFrame
from slam.errors import MeasurementError, PartError, SlamError
from slam.models import EstimatorModels
from slam.system import StereoSlam
from tests.frontends.scenes import RIG, stereo_pair
from tests.scripts import load_script

LEFT, RIGHT = stereo_pair(12.25)


class Changed(EkfBackend):
    """A filter with one answer changed."""

    def __init__(self, method: str, change) -> None:
        super().__init__(RIG, models=EstimatorModels())
        answer = getattr(self, method)
        setattr(self, method, lambda *arguments, **options: change(answer(*arguments, **options)))


ANSWERS = [
    ("predict", lambda p: replace(p, T_world_left=np.full((4, 4), np.nan)), "predict: T_world_left is not finite"),
    (
        "predict",
        lambda p: replace(p, T_world_left=np.diag([1.1, 1.1, 1.1, 1])),
        "predict: .* no rotation and translation",
    ),
    ("predict", lambda p: replace(p, covariance=np.eye(3)), "predict: covariance must be an array"),
    ("update", lambda r: None, "update: must be of type UpdateReport"),
    ("update", lambda r: replace(r, used=r.used.astype(float)), "update: used must be an array"),
    ("estimate", lambda e: replace(e, stamp=np.nan), "estimate: stamp must be within"),
    ("estimate", lambda e: replace(e, covariance=-np.eye(6)), "estimate: covariance has a negative variance"),
    ("recent", lambda r: [r], "recent: must be of type RecentPoses, got list"),
    ("recent", lambda r: replace(r, covariance=np.eye(5)), r"recent: covariance must be an array \(6, 6\)"),
    ("recent", lambda r: replace(r, poses=0 * r.poses), "recent: poses is no rotation"),
    ("positions", lambda x: x[:-1] if len(x) else None, "positions:? must be (of type|an) (ndarray|array)"),
]


def test_a_path_of_another_type_and_places_of_an_estimate_that_is_none_are_named():
    """The first ended within this package; the second was laid to a method that a guarded class need not have."""
    system = StereoSlam(RIG, "surf", Changed("trajectory", lambda path: [path]))
    system.process(LEFT, RIGHT, 0.0)
    with pytest.raises(SlamError, match=r"Changed\.trajectory: must be of type Trajectory, got list"):
        system.trajectory()
    lost = load_script("docs/examples/pose_fit.py").PoseFit(RIG, models=EstimatorModels())
    lost.predict(0.0)
    lost.add(Observations(np.array([3]), np.array([[160.0, 120.0]]), np.array([[150.0, 120.0]])))
    lost._backend.points[3] = np.full(3, np.nan)
    with pytest.raises(SlamError, match=r"^PoseFit\.estimate: positions is not finite"):
        lost.positions(np.array([3]))


@pytest.mark.parametrize("method,change,words", ANSWERS)
def test_a_back_end_of_nonsense_is_named(method, change, words):
    system = StereoSlam(RIG, "surf", Changed(method, change))
    with pytest.raises(SlamError, match=f"^frame [01]: Changed.{words}"):
        for stamp in (0.0, 0.1):  # positions are asked for once there are landmarks
            system.process(LEFT, RIGHT, stamp)


def test_a_front_end_whose_features_are_no_features_ends_in_one_line():
    class Flat(SurfFrontend):
        def extract(self, frame):
            features = super().extract(frame)
            return replace(features, uv_right=features.uv_right[:, 0])

    with pytest.raises(MeasurementError, match="uv_right must be an array of 2 dimensions"):
        StereoSlam(RIG, Flat(RIG, features=50)).process(StereoFrame(0, 0.0, LEFT, RIGHT))


class Failing(EkfBackend):
    error: BaseException

    def predict(self, stamp):
        raise self.error


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (np.linalg.LinAlgError("Singular matrix"), r"LinAlgError: Singular matrix \(test_answers\.py, line \d+\)"),
        (SystemExit(0), "SystemExit"),  # it must not end the program
    ],
)
def test_a_failing_back_end_is_named_with_its_own_line_and_the_cause_is_kept(error, words, monkeypatch):
    monkeypatch.setattr(Failing, "error", error, raising=False)
    with pytest.raises(PartError, match=f"^frame 0: Failing failed: {words}") as raised:
        StereoSlam(RIG, "surf", Failing(RIG, models=EstimatorModels())).process(LEFT, RIGHT, 0.0)
    assert raised.value.__cause__ is error


class Blind(SurfFrontend):
    def extract(self, frame):
        raise StopIteration


def test_a_front_end_that_stops_does_not_end_the_frames():
    system = StereoSlam(RIG, Blind(RIG), "ekf")
    frames = [StereoFrame(0, 0.0, LEFT, RIGHT)]
    for overlap in (True, False):
        with pytest.raises(PartError, match=r"^frame 0: Blind failed: StopIteration"):
            list(system.run(frames, overlap))
