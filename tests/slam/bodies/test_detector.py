from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import slam
from slam.bodies.config import WINDOW
from slam.config import SystemConfig
from slam.evaluation.objects import score_for


def system_for(sequence, mode="detect", **settings):
    config = SystemConfig.for_kind(sequence.kind, None)
    config = replace(config, objects=replace(config.objects, mode=mode, **settings))
    return slam.StereoSlam(sequence.rig, None, "ekf", config=config)


@pytest.fixture(scope="module")
def box_run():
    """The box of paper B's section 4.4, from its last twenty frames at rest to its second place."""
    sequence = slam.open_sequence("synthetic:box?density=300")
    system, score, results = system_for(sequence), score_for(sequence), []
    for k in range(40, 115):
        seen = sequence.simulate(k)
        results.append((system.process_features(seen.features), seen.objects))
        score.add(k, results[-1][0], seen.objects)
    return results, score


def test_the_box_is_found_once_and_followed_and_little_else_is_said_to_move(box_run):
    results, score = box_run
    body = score.body(1)
    assert body["ids"], "the box was not found"
    # It starts to move at frame 60, and is a pixel away at 66.
    assert body["delay [frames]"] <= 15
    longest = max(score.lives.values(), key=lambda life: len(life.frames))
    # In single frames too few of its features are found, here in some of the last five.
    assert longest.truth == 1 and longest.frames[-1] >= 108
    assert score.summary()["features"]["precision"] > 0.92  # of four seeds it is 0.94 to 0.99
    for result, _ in results:
        assert not np.isin(result.added_features, result.moving_features).any()


@pytest.mark.slow
def test_a_box_that_is_hidden_for_two_seconds_keeps_its_id():
    """It moves when it is hidden, and rests when it comes back, where nothing predicted it."""
    sequence = slam.open_sequence("synthetic:box?density=300&camera=moving&sigma=0.3")
    system, ids = system_for(sequence), {True: set(), False: set()}
    for k in range(50, 150):
        seen, hidden = sequence.simulate(k), 85 <= k < 145
        features = seen.features.select(seen.objects == 0) if hidden else seen.features
        ids[k < 145] |= {body.id for body in system.process_features(features).objects if body.estimate.measured}
    assert len(ids[True]) == 1
    assert ids[False] == ids[True]


def test_landmarks_on_what_may_be_a_body_do_not_measure_the_camera():
    """From the group's first suspicion until the body is proven, and its landmarks leave the map."""
    sequence = slam.open_sequence("synthetic:box?density=300")
    system, frames = system_for(sequence), 0
    for k in range(50, 90):
        system.process_features(sequence.simulate(k).features)
        tracks, bodies = system._state.tracks, system.objects.bodies
        unproven = np.isin(tracks.body, [id for id, body in bodies.items() if not body.proven])
        landmarks = tracks.ids[unproven & (tracks.ids >= 0)]
        assert np.isin(landmarks, system.objects.suspects).all()
        frames += len(landmarks) > 0
    assert frames


def test_what_finds_a_right_match_in_half_of_its_frames_only_is_no_body():
    """Such matches may all be wrong alike: here they are right, and the box that moves is not reported."""
    sequence, rng = slam.open_sequence("synthetic:box?density=300"), np.random.default_rng(0)
    system = system_for(sequence)
    for k in range(50, 90):
        seen = sequence.simulate(k)
        seen.features.uv_right[(seen.objects == 1) & (rng.random(len(seen.objects)) < 0.5)] = np.nan
        assert not system.process_features(seen.features).objects
    assert system.objects.bodies


def test_nothing_moves_in_a_still_world():
    sequence = slam.open_sequence("synthetic:desk?density=150")
    system = system_for(sequence)
    flagged = count = 0
    for k in range(50):
        result = system.process_features(sequence.observations(k))
        flagged, count = flagged + len(result.moving_features), count + len(result.features)
        assert not result.objects
    assert flagged <= 0.002 * count


def test_landmarks_that_were_lost_from_view_are_followed_again_once_they_are_found():
    """Also those that have joined the map beside the track of another landmark."""
    sequence = slam.open_sequence("synthetic:desk?density=150")
    system, again, lost = system_for(sequence), 0, set()
    for k in (*range(20), *range(30, 40)):
        result = system.process_features(sequence.simulate(k).features)
        tracks = system._state.tracks
        deep = result.features.has_stereo[result.matched_features]
        at = tracks.rows(np.setdiff1d(result.matched[deep], result.erased))
        assert (tracks.number[at] >= 0).all()
        again += len(lost & set(tracks.ids[at].tolist()))
        lost = set(tracks.ids[(tracks.ids >= 0) & (tracks.number < 0)].tolist())
    assert again


def test_a_slot_of_the_window_holds_only_what_its_frame_measured():
    sequence = slam.open_sequence("synthetic:desk?density=150")
    system = system_for(sequence)
    for k in range(WINDOW + 3):
        system.process_features(sequence.simulate(k).features)
    tracks = system._state.tracks
    lost = (tracks.number >= 0) & ~tracks.found
    assert lost.any() and not tracks.dof[lost, system.objects._number % WINDOW].any()
