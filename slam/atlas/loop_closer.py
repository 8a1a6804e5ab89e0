"""Makes keyframes of frames, and finds places that were seen before: for loops, and for a lost camera."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slam.atlas.atlas import Atlas
from slam.atlas.closing import close
from slam.atlas.config import AtlasConfig
from slam.atlas.keyframes import Keyframe, Loop, step_covariance
from slam.atlas.verification import keyframe_landmarks, verify
from slam.data import BoolArray, Correction, IdArray, StereoFeatures
from slam.geometry.arrays import narrowed
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, inverse, transform
from slam.models import EstimatorModels
from slam.tracks.config import AssociationConfig
from slam.tracks.follow import match_everywhere
from slam.tracks.localizer import Localizer
from slam.tracks.mapper import depth_is_known
from slam.tracks.step import Step
from slam.tracks.table import LandmarkTable
from slam.window.gating import MIN_OBSERVATIONS


@dataclass(frozen=True, eq=False)
class Found:
    """A camera found without a prior, by a keyframe."""

    T_odom_left: Array  # the camera's pose (4, 4) in the back end's frame
    landmarks: LandmarkTable  # the keyframe's features (M); ids of the landmarks that they showed, −1 for none
    positions: Array  # of these (M, 3) [m] in the back end's world
    covariances: Array  # (M, 3, 3) [m²]
    stamp: float  # time of the keyframe that shows the place [s]; −inf for one of an earlier run


class LoopCloser:
    """Adds keyframes to an atlas and closes loops, if `enabled`.

    Features whose depth has a relative standard deviation above `max_depth_error` are not kept, as no landmark begins.
    """

    def __init__(
        self, rig: StereoRig, enabled: bool, association: AssociationConfig, models: EstimatorModels,
        max_depth_error: float,
    ) -> None:  # fmt: skip
        self._rig = rig
        self._enabled = enabled
        self._sigma, self._max_depth_error = models.pixel_sigma, max_depth_error
        lax = 2 * association.consistency_sigmas  # a keyframe's points have the depth of one frame alone
        # with a quarter of the matches right, 300 poses miss one place in a hundred
        association = replace(association, wide_hypotheses=300, consistency_sigmas=lax)
        self._localizer = Localizer(self._rig, association, models)

    def update(self, atlas: Atlas, step: Step) -> Atlas:
        """The atlas after a frame."""
        begins = not len(atlas) or len(atlas.gaps) > atlas.restarts
        wanted = begins or (not step.tracking.unmeasured and self._is_keyframe(atlas, step))
        if not (self._enabled and wanted):
            return atlas
        seen, landmark_of = step.matches.joined(step.added), np.full(len(step.features), -1)
        landmark_of[seen.rows] = seen.ids
        new = self._keyframe(atlas, step, landmark_of)
        if new is None:
            return atlas
        known = landmark_of[landmark_of >= 0]
        candidates = self._candidates(atlas, new, step, known)
        atlas = replace(atlas.with_new(new), restarts=len(atlas.gaps))
        found = self._verified(atlas, candidates, step.features, step.correction, step.index)
        if not found:  # whatever the path says
            lookalike = self._anywhere(atlas, new, known, step.features)
            found = self._verified(atlas, lookalike, step.features, step.correction, step.index)
            found = [loop for loop in found if self._is_same_view(atlas, loop, step.features)]
        if not found:
            return atlas
        loop = max(found, key=lambda loop: loop.inliers)
        same = self._is_same_view(atlas, loop, step.features)
        return close(atlas, loop, step.common, same)

    def find(self, atlas: Atlas, features: StereoFeatures, correction: Correction | None, seed: int) -> Found | None:
        """Find a camera that may be anywhere by the keyframes; None if no place fits or several do.

        `correction` is that of the features; `seed` of the random choice in the geometric check.
        """
        if not self._enabled or len(features) < AtlasConfig.inliers:
            return None
        likely = self._most_alike(atlas, features.descriptors, np.ones(len(atlas), bool))
        verified = self._verified(atlas, self._ranked(atlas, likely, features), features, correction, seed)
        if not verified:
            return None
        loop = max(verified, key=lambda loop: loop.inliers)
        keyframe = atlas.keyframes[loop.first].corrected(correction, self._rig)
        at = np.array([(atlas.poses_in_map[x.first] @ x.T_first_second)[:3, 3] for x in (loop, *verified)])
        elsewhere = np.linalg.norm(at[1:] - at[0], axis=1) >= keyframe.depth  # than the scene is deep
        if any(2 * x.inliers > loop.inliers for x, far in zip(verified, elsewhere.tolist()) if far):
            return None
        T, points = inverse(atlas.T_map_odom) @ atlas.poses_in_map[loop.first], keyframe.points.astype(float)
        P = T[:3, :3] @ self._rig.triangulation_covariance(points, self._sigma) @ T[:3, :3].T
        landmarks = replace(keyframe_landmarks(keyframe), seen_from=np.tile(T[:3, 3], (len(points), 1)))
        stamp = -np.inf if loop.first < atlas.prior_count else keyframe.stamp
        P = 0.5 * (P + np.swapaxes(P, 1, 2))
        return Found(T @ loop.T_first_second, landmarks, transform(T, points), P, stamp)

    def _is_keyframe(self, atlas: Atlas, step: Step) -> bool:
        """Whether the view differs enough from the last keyframe's, or its loop waits to be confirmed by another."""
        pending = atlas.pending
        if pending is not None and pending.second == len(atlas) - 1 and not atlas.confirmed:
            return True
        if len(atlas) == atlas.prior_count:
            return True
        last = atlas.keyframes[-1]
        return view_has_changed(last, inverse(last.T_odom_left) @ step.estimate.T_world_left, self._rig)

    def _keyframe(self, atlas: Atlas, step: Step, landmark_of: IdArray) -> Keyframe | None:
        """The frame as a keyframe, of features that do not move, landmarks first; None where too few have a depth."""
        features = step.features
        rows = np.setdiff1d(np.flatnonzero(features.has_stereo), step.labels.moving)
        rows = rows[depth_is_known(self._rig, features, rows, self._sigma, self._max_depth_error)]
        order = np.lexsort((-features.response[rows], landmark_of[rows] < 0))
        rows = np.sort(rows[order[: AtlasConfig.features]])
        if len(rows) < MIN_OBSERVATIONS:
            return None
        points = self._rig.triangulate(features.uv_left[rows], features.uv_right[rows])
        T, P = step.estimate.T_world_left, step.estimate.covariance - step.common.covariance
        last, gaps = atlas.keyframes[-1] if len(atlas) else None, atlas.gaps[atlas.restarts :]
        # Between an earlier run and this one, or in a kidnapping, the camera went 1 km, anywhere within 100 m, 1 rad.
        went, added = 1000.0, np.diag(np.repeat([1.0, 100.0], 3) ** 2)
        if last is not None and len(atlas) > atlas.prior_count and not gaps:
            went = float(np.linalg.norm(T[:3, 3] - last.T_odom_left[:3, 3]))
            added = step_covariance(last, T, P)
        elif len(gaps) == 1 and gaps[0].covariance is not None:
            added = gaps[0].covariance + P
        largest = float(np.finfo(np.float16).max)
        descriptors = narrowed(np.clip(features.descriptors[rows], -largest, largest), np.float16)
        return Keyframe(
            step.index, features.stamp, T, P, added, step.common.jacobian,
            0.0 if last is None else last.travelled + went, float(np.median(points[:, 2])),
            narrowed(points, np.float32), descriptors, features.laplacian[rows], landmark_of[rows], step.correction,
        )  # fmt: skip

    def _candidates(self, atlas: Atlas, new: Keyframe, step: Step, known: IdArray) -> NDArray[np.intp]:
        """Numbers of old keyframes that may show this place, the likeliest first.

        Keyframes of a place that the camera has not left yet are excluded, those that it cannot have come to, given its
        uncertainty, and those whose landmarks the back end still measures: it knows their position by itself.
        """
        c, poses, here = AtlasConfig, atlas.poses_in_map, atlas.T_map_odom @ new.T_odom_left
        sigma = np.sqrt(np.trace(atlas.estimate(step.estimate, step.common).covariance[3:, 3:]))
        length, far = new.travelled - atlas.travelled, np.linalg.norm(poses[:, :3, 3] - here[:3, 3], axis=1)
        reach = c.view_depths * new.depth + c.gate_sigmas * sigma + c.drift * length
        possible = np.asarray((length > c.return_depths * new.depth) & (far < reach))
        if not possible.any():
            return np.zeros(0, np.intp)
        likely = self._most_alike(atlas, new.descriptors.astype(np.float32), possible)
        looks_at = poses[:, :3, 3] + new.depth * poses[:, :3, 2] - here[:3, 3] - new.depth * here[:3, 2]
        nearest = np.argsort(np.where(possible, far + np.linalg.norm(looks_at, axis=1), np.inf), kind="stable")
        likely = np.unique(np.concatenate([likely, nearest[: min(4, int(possible.sum()))]]))
        return self._ranked(atlas, self._not_measured(atlas, likely, known), step.features)

    def _anywhere(self, atlas: Atlas, new: Keyframe, known: IdArray, features: StereoFeatures) -> NDArray[np.intp]:
        """Number of the keyframe that looks most like a new one, unless the path says that it shows the same view.

        Of the same view most features agree on a pose, so that a third of them at least match by descriptor alone.
        """
        moved = inverse(atlas.poses[:-1]) @ new.T_odom_left
        apart = np.linalg.norm(moved[:, :3, 3], axis=1) > AtlasConfig.keyframe_distance * new.depth
        likely = self._most_alike(atlas, new.descriptors.astype(np.float32), np.append(apart, False))
        best = self._not_measured(atlas, likely, known)[:1]
        enough = min(AtlasConfig.features, int(features.has_stereo.sum())) / 3
        return self._ranked(atlas, best, features, enough)

    def _not_measured(self, atlas: Atlas, rows: NDArray[np.intp], known: IdArray) -> NDArray[np.intp]:
        """Those keyframes whose landmarks the back end does not measure."""
        few = [np.isin(atlas.keyframes[k].landmarks, known).sum() < MIN_OBSERVATIONS for k in rows.tolist()]
        return rows[np.array(few, bool)]

    def _is_same_view(self, atlas: Atlas, loop: Loop, features: StereoFeatures) -> bool:
        """Whether a frame shows what a loop's first keyframe did: most features, from the same place."""
        keyframe = atlas.keyframes[loop.first]
        most = min(len(keyframe), int(features.has_stereo.sum()))
        return 2 * loop.inliers >= most and not view_has_changed(keyframe, loop.T_first_second, self._rig)

    def _most_alike(self, atlas: Atlas, descriptors: NDArray[np.float32], possible: BoolArray) -> NDArray[np.intp]:
        """Numbers of those `possible` keyframes (K,) whose descriptors as a whole are most similar, best first."""
        similarity = atlas.index.similarity(descriptors)
        similarity[~possible] = -np.inf
        best = np.argsort(-similarity, kind="stable")[: AtlasConfig.candidates]
        return np.asarray(best[np.isfinite(similarity[best])])

    def _ranked(
        self, atlas: Atlas, likely: NDArray[np.intp], features: StereoFeatures, enough: float = 0.0
    ) -> NDArray[np.intp]:
        """The keyframes with most matches by descriptor, if there are enough of them, best first."""
        seen, config = [atlas.keyframes[k] for k in likely.tolist()], self._localizer.config
        limits = config.wide_d_match, config.wide_ratio
        found = [match_everywhere(k.descriptors.astype(np.float32), k.laplacian, features, *limits) for k in seen]
        number = np.array([len(matches) for matches in found], int)
        order = np.argsort(-number, kind="stable")[:3]  # the geometry of so many is checked
        return likely[order[number[order] >= max(enough, AtlasConfig.inliers)]]

    def _verified(
        self, atlas: Atlas, candidates: NDArray[np.intp], features: StereoFeatures, correction: Correction | None,
        seed: int,
    ) -> list[Loop]:  # fmt: skip
        """The candidates that geometry confirms, as loops that end at the present camera.

        Their second number is that of the newest keyframe, which is the present camera's unless it is lost.
        """
        found = []
        for k in candidates.tolist():
            keyframe, pair = atlas.keyframes[k].corrected(correction, self._rig), (k, len(atlas) - 1)
            found.append(verify(keyframe, features, pair, self._rig, self._localizer, seed))
        return [loop for loop in found if loop is not None]


def view_has_changed(keyframe: Keyframe, motion: Array, rig: StereoRig) -> bool:
    """Whether a camera's view differs enough from a keyframe's for a new one: other features, or another viewpoint.

    `motion` is the camera's pose (4, 4) in the keyframe's coordinates.
    """
    if np.linalg.norm(motion[:3, 3]) > AtlasConfig.keyframe_distance * keyframe.depth:
        return True
    uv = rig.left.project(transform(inverse(motion), keyframe.points.astype(float)))
    return bool(rig.left.in_image(uv).mean() < AtlasConfig.keyframe_share)
