"""Recordings of worlds with true association: what a back end is given by a data association without fault."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from slam.data import IdArray, Observations
from slam.models import EstimatorModels, SlideModel, models_for
from slam.run.recording import RecordedFrame, Recording
from slam.tracks.config import MapConfig
from slam.tracks.mapper import depth_is_known, new_landmarks
from slam.worlds.observe import SimulatedFeatures
from slam.worlds.sequence import WorldSequence

_LEAST_SIGMA = 0.01  # assumed pixel noise where there is none [px]: with none at all nothing could be weighed


def true_recording(
    sequence: WorldSequence,
    *,
    models: EstimatorModels | None = None,
    config: MapConfig | None = None,
    keep: int | None = None,
) -> Recording:
    """What a back end is given where every feature is known to be of its landmark.

    As in the system, landmarks are added where fewer than ``config.target_in_view`` are measured, spread over the
    image; false features and those of moving objects are left out.

    Args:
        sequence: the recorded world.
        models: noise, priors and motion; default: those of the sequence's kind, with its pixel noise.
        config: which features become landmarks.
        keep: landmarks that were not seen for so many frames leave the map; None: they stay for ever.
    """
    if models is None:
        sigma = max(sequence.values["sigma"], _LEAST_SIGMA)
        models = replace(models_for(sequence.kind), pixel_sigma=sigma, slide=SlideModel())
    frames = _frames(sequence, models, config or MapConfig(), keep)
    return Recording(sequence.name, sequence.rig, models, tuple(frames), sequence.ground_truth)


def with_mismatches(recording: Recording, share: float, seed: int = 0) -> Recording:
    """The recording with wrong matches: in every frame this share of the observations exchange their pixels.

    Args:
        recording: what to spoil; the first sights of landmarks stay as they are.
        share: of the observations in each frame, 0 to 1.
        seed: of the random choice.
    """
    rng = np.random.default_rng(seed)
    frames = []
    for frame in recording:
        seen = frame.observed
        source, wrong = np.arange(len(seen)), np.flatnonzero(rng.random(len(seen)) < share)
        source[wrong] = _deranged(wrong, rng)
        mixed = Observations(seen.ids, seen.uv_left[source], seen.uv_right[source])
        frames.append(replace(frame, observed=mixed))
    return replace(recording, frames=tuple(frames))


def _deranged(rows: IdArray, rng: np.random.Generator) -> IdArray:
    """The rows in another order, none in its place."""
    order = rng.permutation(len(rows))
    out = np.empty_like(rows)
    out[order] = rows[np.roll(order, 1)]
    return out


def _frames(
    sequence: WorldSequence, models: EstimatorModels, config: MapConfig, keep: int | None
) -> Iterator[RecordedFrame]:
    """What is given, frame by frame."""
    last_seen: dict[int, int] = {}
    for k in range(len(sequence)):
        seen = sequence.simulate(k)
        good = (seen.ids >= 0) & (seen.objects == 0) & ~seen.false_stereo
        known = good & np.array([i in last_seen for i in seen.ids.tolist()], bool)
        occupied = seen.features.uv_left[known]
        rows, rig = np.arange(len(known)), sequence.rig
        deep = depth_is_known(rig, seen.features, rows, models.pixel_sigma, config.max_depth_error)
        new = new_landmarks(seen.features, good & ~known & deep, occupied, rig, config)
        observed, added = _observations(seen, np.flatnonzero(known)), _observations(seen, new)
        for i in (*observed.ids.tolist(), *added.ids.tolist()):
            last_seen[i] = k
        removed = [] if keep is None else sorted(i for i, last in last_seen.items() if k - last > keep)
        for i in removed:
            del last_seen[i]
        yield RecordedFrame(k, seen.features.stamp, observed, added, np.array(removed, np.int64))


def _observations(seen: SimulatedFeatures, rows: IdArray) -> Observations:
    """Of features with known landmarks, by ascending id."""
    rows = rows[np.argsort(seen.ids[rows])]
    return Observations(seen.ids[rows], seen.features.uv_left[rows], seen.features.uv_right[rows])
