"""A camera that is moved unseen to a place that it has not been to: a map of its own begins there, until a loop."""

from dataclasses import replace
from itertools import groupby

import numpy as np
import pytest
from scipy.stats import chi2

import slam
from slam.atlas.atlas import covariance_after_unseen_motion
from slam.data import FrameResult, StereoFeatures
from slam.geometry.se3 import inverse, log
from slam.models import KINDS
from slam.system import StereoSlam
from tests.slam.atlas.test_atlas import sequence, system_for  # noqa: F401 (a fixture)
from tests.slam.scene import BACKENDS, RIG, Cloud, path

SEEN, DARK, SKIPPED = 35, 30, 12  # frames before the dark, in it, and how much farther than they the camera was carried


class Run:
    """A round of 100 m with a dark stretch, in which the camera is carried farther than it would have gone."""

    def __init__(self, sequence, backend: str, *settings: str) -> None:  # noqa: F811
        self.system: StereoSlam = system_for(sequence, backend, settings)
        self.results: list[FrameResult] = []
        shown = [*range(SEEN + DARK), *range(SEEN + DARK + SKIPPED, len(sequence))]
        for k, at in enumerate(shown):
            features = replace(sequence.observations(at), stamp=0.1 * k)
            dark = SEEN <= k < SEEN + DARK
            self.results.append(self.system.process_features(StereoFeatures.empty(0.1 * k, 16) if dark else features))
        self.truth = inverse(sequence.ground_truth.poses[0]) @ sequence.ground_truth.poses[shown]

    def squares(self, k: int) -> float:
        """Squared error of a frame's pose over its covariance."""
        e = self.results[k].estimate
        error = log(inverse(e.T_world_left) @ self.truth[k])
        return float(error @ np.linalg.solve(e.covariance, error))

    @property
    def begins(self) -> int:
        """The frame in which the map begins again."""
        (frame,) = self.system.restarted
        return frame

    @property
    def loop(self) -> int:
        """The first frame that closes a loop."""
        return next(r.index for r in self.results if r.loop is not None)


@pytest.fixture(scope="module", params=BACKENDS)
def run(request, sequence) -> Run:  # noqa: F811
    return Run(sequence, request.param)


def test_it_goes_on_in_a_map_of_its_own(run):
    restart_after = run.system.config.map.restart_after
    assert run.begins == SEEN + DARK + restart_after - 1
    assert [name for name, _ in groupby(r.status.value for r in run.results)] == [
        "started", "tracked", "predicted", "lost", "tracked",
    ]  # fmt: skip
    assert run.results[run.begins + 1].status.value == "tracked"
    old = np.concatenate([r.added for r in run.results[:SEEN]])
    matched = np.concatenate([r.matched for r in run.results[run.begins : run.loop]])
    assert len(matched) and not np.isin(matched, old).any()
    assert run.results[run.begins].map_size == len(run.results[run.begins].added) > 0


def test_it_says_how_little_is_known_of_where_that_map_is(run):
    at, end = run.begins, run.loop
    distance = np.linalg.norm(run.results[at].estimate.T_world_left[:3, 3] - run.truth[at][:3, 3])
    assert distance > 3.0  # so that there is something to know
    assert max(run.squares(k) for k in range(at, end)) < chi2.ppf(0.999, 6)
    assert max(run.squares(k) for k in range(end, len(run.results))) < chi2.ppf(0.999, 6)
    before, after = (np.diag(run.results[k].estimate.covariance) for k in (at - 1, at))
    assert (after > before).all()  # no information comes from nowhere


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_camera_that_sees_another_place_in_each_frame_goes_on(backend):
    """Pictures of a slide show: nothing is ever measured, and no number overflows."""
    config = slam.config.SystemConfig.for_kind("handheld", None)
    system = StereoSlam(RIG, None, backend, config=config)
    frames = [Cloud(150, seed=k).features(T, k / 30, 0.3)[0] for k, T in enumerate(path(30))]
    results = [system.process_features(features) for features in frames]
    assert len(system.restarted) >= 4
    assert {r.status.value for r in results[1:]} <= {"predicted", "lost"}
    assert all(np.isfinite(r.estimate.covariance).all() for r in results)
    assert len(system.trajectory()) == 30


@pytest.mark.parametrize("duration", [0.0, 1.0, 1e5, 1e12])
@pytest.mark.parametrize("kind", ["handheld", "driving"])
def test_nothing_is_more_uncertain_than_unknown(kind, duration):
    before = np.diag(np.repeat([0.1, 2.0], 3) ** 2)
    P = covariance_after_unseen_motion(before, duration, KINDS[kind])
    assert (np.linalg.eigvalsh(P) > 0).all()
    assert np.sqrt(P[0, 0]) < 1.9 and np.sqrt(P[3, 3]) < 1001.0
    assert duration or np.array_equal(P, before)


def test_a_loop_puts_the_map_in_its_place(run):
    # since the new map began the reported covariances are not the back end's own
    assert [r.recent is None for r in run.results] == [k >= run.begins for k in range(len(run.results))]
    path = run.system.trajectory()
    assert len(path) == len(run.results)
    off = np.linalg.norm(path.positions - run.truth[:, :3, 3], axis=1)
    assert off[:SEEN].max() < 0.3
    assert off[run.begins :].max() < 0.5
    online = np.linalg.norm([r.estimate.T_world_left[:3, 3] - T[:3, 3] for r, T in zip(run.results, run.truth)], axis=1)
    assert online[run.loop + 1 :].max() < 0.5
    assert off[SEEN - 1] < 0.3 and off[run.begins + 1] < 0.5  # all of the change is in the dark


@pytest.mark.slow
def test_what_was_seen_before_is_found_again_where_the_camera_returns_at_once(sequence):  # noqa: F811
    """A second map begins; then the camera is carried back to the first one, whose frame it is in again."""
    system = system_for(sequence, "ekf")
    shown = [*range(40), *[-1] * 20, *range(60, 80), *[-1] * 6, *range(10, 30)]
    results = []
    for k, at in enumerate(shown):
        dark = StereoFeatures.empty(0.1 * k, 16)
        results.append(system.process_features(dark if at < 0 else replace(sequence.observations(at), stamp=0.1 * k)))
    assert len(system.restarted) == 2
    last = results[-1]
    assert last.status.value == "tracked"
    truth = (inverse(sequence.ground_truth.poses[0]) @ sequence.ground_truth.poses[shown[-1]])[:3, 3]
    assert np.linalg.norm(last.estimate.T_world_left[:3, 3] - truth) < 0.3
    assert np.sqrt(np.trace(last.estimate.covariance[3:, 3:])) < 1.0
    assert np.sqrt(np.trace(results[75].estimate.covariance[3:, 3:])) > 2.0
