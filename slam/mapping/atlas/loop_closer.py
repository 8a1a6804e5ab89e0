"""Makes keyframes of frames, and closes loops between keyframes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigvalsh

from slam.data import BoolArray, IdArray, StereoFeatures
from slam.geometry.arrays import narrowed
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, adjoint, inverse, points_by_pose, transform
from slam.geometry.trajectory import Trajectory
from slam.mapping.atlas.atlas import Atlas
from slam.mapping.atlas.chain import Chain
from slam.mapping.atlas.config import AtlasConfig
from slam.mapping.atlas.feature_file import FeatureFile
from slam.mapping.atlas.keyframes import (
    Keyframe,
    Loop,
    distance,
    features_with_depth,
    kept_features,
    step_covariance,
    view_has_changed,
)
from slam.mapping.atlas.places import Vectors
from slam.mapping.atlas.verification import Verified, alike, verify
from slam.mapping.mapper import KnownPlace, Returned
from slam.mapping.step import Step
from slam.models import EstimatorModels
from slam.rig_error import CommonError, Correction
from slam.runtime.blas import one_blas_thread
from slam.tracks.config import AssociationConfig
from slam.tracks.localizer import Localizer

if TYPE_CHECKING:
    from slam.mapping.atlas.pose_graph import PoseGraph

_NEARBY = 4  # cost: keyframes compared because they are near the path, besides those that look alike
_VERIFIED = 3  # cost: keyframes whose geometry is checked, of those that are compared in detail
_DIMENSIONS = 6  # fixed: mean of χ² of a pose
_MINIMAL = 6  # least number of features of a keyframe: enough for a pose with a covariance
_LARGEST = 6e4  # guard: largest number in a keyframe's descriptors, which are half floats
_HYPOTHESES = 300  # cost: poses tried, so that with a quarter of the matches right one place in a hundred is missed


@dataclass(frozen=True, eq=False)
class Found:
    """Pose and place of a camera found without a prior.

    Attributes:
        T_odom_left: the camera's pose (4, 4) in the back end's frame.
        place: landmarks of the place.
        stamp: time of the keyframe that shows the place [s]; −inf for one of an earlier run.
    """

    T_odom_left: Array
    place: KnownPlace
    stamp: float


class LoopCloser:
    """Adds keyframes to an atlas and closes loops.

    Args:
        rig: the rectified pair.
        config: settings.
        association: settings of the search by descriptor.
        models: with the noise of uL, vL, uR [px].
        max_depth_error: largest relative standard deviation of a kept feature's depth, the same as a new landmark's.
    """

    def __init__(
        self,
        rig: StereoRig,
        config: AtlasConfig,
        association: AssociationConfig,
        models: EstimatorModels,
        max_depth_error: float,
    ) -> None:
        self._rig = rig
        self._config = config
        self._sigma, self._max_depth_error = models.pixel_sigma, max_depth_error
        self._file = FeatureFile() if config.on_disk else None
        lax = 2 * association.consistency_sigmas  # a keyframe's points have the depth of one frame alone
        association = replace(association, wide_hypotheses=_HYPOTHESES, consistency_sigmas=lax)
        self._localizer = Localizer(self._rig, association, models)

    @one_blas_thread
    def update(self, atlas: Atlas, step: Step, path: Callable[[], Trajectory]) -> tuple[Atlas, Returned | None]:
        """The atlas after a frame, and the old features that the frame shows again if it closed a loop.

        Args:
            atlas: before the frame.
            step: the frame's result.
            path: returns the path in odom so far.
        """
        begins = not len(atlas) or len(atlas.gaps) > atlas.restarts
        wanted = begins or (not step.tracking.unmatched and self._is_keyframe(atlas, step))
        if not (self._config.enabled and wanted):
            return atlas, None
        landmark_of = step.matches.landmark_of(len(step.features))
        landmark_of[step.added.rows] = step.added.ids
        new = self._keyframe(atlas, step, landmark_of)
        if new is None:
            return atlas, None
        known = landmark_of[landmark_of >= 0]
        candidates = self._candidates(atlas, new, step, known)
        descriptors = new.descriptors.astype(np.float32)
        kept = new if self._file is None else self._file.put(new)
        atlas = replace(atlas.with_new(kept, descriptors), restarts=len(atlas.gaps))
        found = self._verified(atlas, candidates, step.features, step.correction, step.index)
        if not found:  # whatever the path says
            lookalike = self._anywhere(atlas, new, known, step.features)
            found = self._verified(atlas, lookalike, step.features, step.correction, step.index)
            found = [one for one in found if self._is_same_view(one[1], step.features)]
        best = max(found, key=_inliers, default=None)
        if best is None:
            return atlas, None
        same = self._is_same_view(best[1], step.features)
        return self._close(atlas, *best, step.common, path, same)

    @one_blas_thread
    def find(self, atlas: Atlas, features: StereoFeatures, correction: Correction | None, seed: int) -> Found | None:
        """Find a camera that may be anywhere by the keyframes; None if no place fits or several do.

        Args:
            atlas: the places.
            features: of the frame.
            correction: with which the features were corrected.
            seed: of the random choice in the geometric check.
        """
        if not self._config.enabled or len(features) < self._config.inliers:
            return None
        likely = self._most_alike(atlas, features.descriptors, np.ones(len(atlas), bool))
        likely = self._ranked(atlas, likely, features)
        verified = self._verified(atlas, likely, features, correction, seed)
        if not verified:
            return None
        loop, seen = max(verified, key=_inliers)
        if any(2 * other.inliers > loop.inliers and not self._same_place(atlas, loop, other) for other, _ in verified):
            return None
        T_odom_keyframe = inverse(atlas.T_map_odom) @ atlas.pose_in_map(loop.first)
        place = self._place(seen.keyframe, T_odom_keyframe)
        stamp = -np.inf if loop.first < atlas.prior_count else seen.keyframe.stamp
        return Found(T_odom_keyframe @ loop.T_first_second, place, stamp)

    def _place(self, keyframe: Keyframe, T_odom_left: Array) -> KnownPlace:
        """A keyframe's features as landmarks, given its pose (4, 4)."""
        points, T = keyframe.points.astype(float), T_odom_left
        P = T[:3, :3] @ self._rig.triangulation_covariance(points, self._sigma) @ T[:3, :3].T
        descriptors = keyframe.descriptors.astype(np.float32)
        P = 0.5 * (P + np.swapaxes(P, 1, 2))
        return KnownPlace(keyframe.landmarks, transform(T, points), P, descriptors, keyframe.laplacian, T[:3, 3])

    def _is_keyframe(self, atlas: Atlas, step: Step) -> bool:
        """Whether the view differs enough from the last keyframe's, or a loop waits for confirmation."""
        if len(atlas) == atlas.prior_count or self._in_doubt(atlas):
            return True
        last = atlas.keyframes[-1]
        return view_has_changed(last, inverse(last.T_odom_left) @ step.estimate.T_world_left, self._rig, self._config)

    def _in_doubt(self, atlas: Atlas) -> bool:
        """Whether the last keyframe has a loop that is not confirmed yet; the next frame may confirm it."""
        pending = atlas.pending
        return pending is not None and pending.second == len(atlas) - 1 and not atlas.confirmed

    def _keyframe(self, atlas: Atlas, step: Step, landmark_of: IdArray) -> Keyframe | None:
        """The frame as a keyframe; None where too few features have a depth."""
        features, moving = step.features, step.labels.moving
        known = features_with_depth(self._rig, features, self._sigma, self._max_depth_error)
        rows = kept_features(known, features.response, landmark_of, moving, self._config.features)
        points = self._rig.triangulate(features.uv_left[rows], features.uv_right[rows])
        if len(rows) < _MINIMAL:
            return None
        T, P = step.estimate.T_world_left, step.estimate.covariance - step.common.covariance
        travelled = 0.0
        # Between an earlier run and this one, or in a kidnapping, the camera went 1 km, anywhere within 100 m, 1 rad.
        added: Array = np.diag(np.repeat([1.0, 100.0], 3) ** 2)
        if len(atlas):
            last = atlas.keyframes[-1]
            travelled = last.travelled + 1000.0
        gaps = atlas.gaps[atlas.restarts :]
        if len(atlas) > atlas.prior_count and not gaps:
            last = atlas.keyframes[-1]
            travelled = last.travelled + float(np.linalg.norm(T[:3, 3] - last.T_odom_left[:3, 3]))
            added = step_covariance(last, T, P)
        elif len(gaps) == 1 and gaps[0].covariance is not None:
            added = gaps[0].covariance + P
        return Keyframe(
            step.index,
            features.stamp,
            T,
            P,
            added,
            step.common.jacobian,
            travelled,
            float(np.median(points[:, 2])),
            narrowed(points, np.float32),
            narrowed(np.clip(features.descriptors[rows], -_LARGEST, _LARGEST), np.float16),
            features.laplacian[rows],
            landmark_of[rows],
            step.correction,
        )

    def _candidates(self, atlas: Atlas, new: Keyframe, step: Step, known: IdArray) -> NDArray[np.intp]:
        """Numbers of old keyframes that may show this place, the likeliest first.

        Keyframes of a place that the camera has not left yet are excluded, and those whose landmarks the back end still
        measures: it knows their position by itself.
        """
        poses, here = atlas.poses_in_map(), atlas.T_map_odom @ new.T_odom_left
        covariance = atlas.estimate(step.estimate, step.common).covariance
        possible = self._within_reach(atlas, new, poses, here, covariance)
        if not possible.any():
            return np.zeros(0, np.intp)
        likely = self._most_alike(atlas, new.descriptors.astype(np.float32), possible)
        likely = np.unique(np.concatenate([likely, _nearest(poses, here, new.depth, possible)]))
        return self._ranked(atlas, self._not_measured(atlas, likely, known), step.features)

    def _anywhere(self, atlas: Atlas, new: Keyframe, known: IdArray, features: StereoFeatures) -> NDArray[np.intp]:
        """Number of the keyframe that looks most like a new one, unless the path says that it shows the same view.

        Of the same view most features agree on a pose, so that a third of them at least match by descriptor alone.
        """
        moved = inverse(atlas.poses[:-1]) @ new.T_odom_left
        apart = np.linalg.norm(moved[:, :3, 3], axis=1) > self._config.keyframe_distance * new.depth
        likely = self._most_alike(atlas, new.descriptors.astype(np.float32), np.append(apart, False))
        best = self._not_measured(atlas, likely, known)[:1]
        enough = min(self._config.features, int(features.has_stereo.sum())) / 3
        return best[[alike(atlas.keyframes[k], features, self._localizer.config) >= enough for k in best.tolist()]]

    def _not_measured(self, atlas: Atlas, rows: NDArray[np.intp], known: IdArray) -> NDArray[np.intp]:
        """Those keyframes whose landmarks the back end does not measure."""
        few = [np.isin(atlas.keyframes[k].landmarks, known).sum() < _MINIMAL for k in rows.tolist()]
        return rows[np.array(few, bool)]

    def _is_same_view(self, seen: Verified, features: StereoFeatures) -> bool:
        """Whether a frame shows what a keyframe did: most features, from the same place."""
        most = min(len(seen.keyframe), int(features.has_stereo.sum()))
        moved = view_has_changed(seen.keyframe, seen.T_keyframe_left, self._rig, self._config)
        return 2 * len(seen.matches) >= most and not moved

    def _most_alike(self, atlas: Atlas, descriptors: Vectors, possible: BoolArray) -> NDArray[np.intp]:
        """Numbers of those `possible` keyframes (K,) whose descriptors as a whole are most similar, best first."""
        similarity = atlas.index.similarity(descriptors)
        similarity[~possible] = -np.inf
        best = np.argsort(-similarity, kind="stable")[: self._config.candidates]
        return np.asarray(best[np.isfinite(similarity[best])])

    def _ranked(self, atlas: Atlas, likely: NDArray[np.intp], features: StereoFeatures) -> NDArray[np.intp]:
        """The keyframes with most matches by descriptor, if there are enough of them, best first."""
        number = np.array([alike(atlas.keyframes[k], features, self._localizer.config) for k in likely], int)
        order = np.argsort(-number, kind="stable")[:_VERIFIED]
        return likely[order[number[order] >= self._config.inliers]]

    def _within_reach(self, atlas: Atlas, new: Keyframe, poses: Array, here: Array, covariance: Array) -> BoolArray:
        """Which keyframes (K,), at poses (K, 4, 4), the camera has left but may, given its uncertainty, see again."""
        c, length = self._config, new.travelled - atlas.travelled
        far = np.linalg.norm(poses[:, :3, 3] - here[:3, 3], axis=1)
        sigma = np.sqrt(np.trace(covariance[3:, 3:]))
        reach = c.view_depths * new.depth + c.gate_sigmas * sigma + c.drift * length
        return np.asarray((length > c.return_depths * new.depth) & (far < reach))

    def _verified(
        self, atlas: Atlas, candidates: NDArray[np.intp], features: StereoFeatures, correction: Correction | None,
        seed: int,
    ) -> list[tuple[Loop, Verified]]:  # fmt: skip
        """The candidates that geometry confirms, as loops that end at the present camera.

        Their second number is that of the newest keyframe, which is the present camera's unless it is lost.
        """
        found = []
        for k in candidates.tolist():
            keyframe = atlas.keyframes[k].corrected(correction, self._rig)
            seen = verify(keyframe, features, self._rig, self._localizer, self._config, seed)
            if seen is not None:
                # Each of both poses has an error of its own frame too, at most as large as such a measurement's noise.
                P = seen.covariance + seen.noise
                found.append((Loop(k, len(atlas) - 1, seen.T_keyframe_left, P, len(seen.matches)), seen))
        return found

    def _same_place(self, atlas: Atlas, one: Loop, other: Loop) -> bool:
        """Whether two verified loops put the camera at positions closer together than the scene's depth."""
        T, U = (atlas.pose_in_map(loop.first) @ loop.T_first_second for loop in (one, other))
        return bool(np.linalg.norm(T[:3, 3] - U[:3, 3]) < atlas.keyframes[one.first].depth)

    def _close(
        self,
        atlas: Atlas,
        loop: Loop,
        seen: Verified,
        rig: CommonError,
        path: Callable[[], Trajectory],
        same_view: bool = False,
    ) -> tuple[Atlas, Returned | None]:
        """Close a loop or refuse it; one that cannot be judged is refused."""
        try:
            return self._judge(atlas, loop, seen, rig, path, same_view)
        except np.linalg.LinAlgError:
            return replace(atlas, refused=(*atlas.refused, loop.pair)), None

    def _judge(
        self,
        atlas: Atlas,
        loop: Loop,
        seen: Verified,
        rig: CommonError,
        path: Callable[[], Trajectory],
        same_view: bool,
    ) -> tuple[Atlas, Returned | None]:
        """Close a loop if it agrees with the path and a keyframe shortly before has seen the same loop.

        A loop with the same view is believed against the path, whose covariance between is then as much too small as
        the two disagree.
        """
        from slam.mapping.atlas.consensus import disagreement
        from slam.mapping.atlas.pose_graph import PoseGraph

        chain = atlas.chain(rig, path())
        common = None if atlas.solved is None else atlas.solved.common_as(rig)
        graph = PoseGraph.solved(chain, atlas.loops, atlas.in_map(chain), (loop.first, loop.second), common)
        limit, off = self._config.gate_sigmas**2, disagreement(graph, loop)
        if off > limit and not (same_view and np.isfinite(off)):
            return self._left_out(atlas, chain, loop, seen, rig, off > self._config.refused_beyond)
        before, atlas = atlas.pending, replace(atlas, pending=loop, confirmed=False)
        if self._config.agreeing > 1 and not (before is not None and self._agree(chain, before, loop)):
            return atlas.with_inactive_loop(loop, self._config.most_loops), None
        atlas = replace(atlas, confirmed=True)
        if off > limit:
            atlas = atlas.inflated(loop.first, loop.second, off / _DIMENSIONS)
            chain = atlas.chain(rig, path())
            graph = PoseGraph.solved(chain, atlas.loops, atlas.in_map(chain), (loop.first, loop.second), common)
        elif atlas.loops and not is_informative(graph, loop):
            return atlas.with_inactive_loop(loop, self._config.most_loops), None
        graph = graph.with_loop(loop)
        if (graph.disagreement() > limit).any():
            return self._left_out(replace(atlas, pending=None), chain, loop, seen, rig)
        atlas = atlas.with_loop(loop, self._config.most_loops).solved_by(graph.solution(), rig)
        return atlas, self._returned(seen) if self._config.give_back else None

    def _left_out(
        self, atlas: Atlas, chain: Chain, loop: Loop, seen: Verified, rig: CommonError, refused: bool = True
    ) -> tuple[Atlas, Returned | None]:
        """Leave out a loop that contradicts the others, or the others if fewer places support them.

        One that is not `refused` contradicts them by no more than may be: it does not count as another place.
        """
        from slam.mapping.atlas.consensus import agreeing, spaced
        from slam.mapping.atlas.pose_graph import PoseGraph

        most, limit = self._config.most_loops, self._config.gate_sigmas**2
        atlas = atlas.with_inactive_loop(loop, most)
        if refused:
            atlas = replace(atlas, refused=(*atlas.refused, loop.pair))
        left = self._config.return_depths * np.array([k.depth for k in atlas.keyframes])
        every, start = (*atlas.loops, *atlas.inactive_loops), atlas.in_map(chain)

        def places(loops: Sequence[Loop]) -> list[Loop]:
            return spaced(loops, atlas.travelled, left)

        if not atlas.loops or len(places(atlas.inactive_loops)) < 2:
            return atlas, None
        rival = agreeing(chain, every, loop, chain.poses, limit)
        if len(places(rival)) <= len(places(agreeing(chain, every, atlas.loops[-1], start, limit))):
            return atlas, None
        before = {x.pair for x in atlas.loops}
        held = {x.pair: x for x in (*places(rival), *(x for x in rival if x.pair in before), loop)}
        atlas = atlas.with_loops(sorted(held.values(), key=lambda x: x.second), rival, most)
        solution = PoseGraph.solved(chain, atlas.loops, start).solution()
        return atlas.solved_by(solution, rig), self._returned(seen) if self._config.give_back else None

    def _agree(self, chain: Chain, before: Loop, loop: Loop) -> bool:
        """Whether two loops, seen by keyframes shortly after each other, are consistent with each other."""
        if loop.second - before.second > 3:  # keyframes
            return False
        T_old, P_old = chain.motion(before.first, loop.first)
        T_new, P_new = chain.motion(before.second, loop.second)
        expected = inverse(T_old) @ before.T_first_second @ T_new
        back, far = adjoint(inverse(T_new)), adjoint(inverse(expected))
        P = back @ before.covariance @ back.T + P_new + loop.covariance + far @ P_old @ far.T
        return distance(expected, loop.T_first_second, P) < self._config.gate_sigmas**2

    def _returned(self, seen: Verified) -> Returned:
        """The old keyframe's inliers, in coordinates of the present left camera."""
        keyframe, m = seen.keyframe, seen.matches
        back = inverse(seen.T_keyframe_left)
        points = keyframe.points[m.landmarks].astype(float)
        near, R = transform(back, points), back[:3, :3]
        J = points_by_pose(near)
        P = R @ self._rig.triangulation_covariance(points, self._sigma) @ R.T
        P = P + J @ seen.covariance @ np.swapaxes(J, 1, 2)
        symmetric = 0.5 * (P + np.swapaxes(P, 1, 2))
        return Returned(m.features, keyframe.landmarks[m.landmarks], near, symmetric)


def is_informative(graph: PoseGraph, loop: Loop) -> bool:
    """Whether a loop is more certain than what path and loops so far say of it, in any direction.

    In a place that is seen again and again they soon know as much, and most loops add nothing.
    """
    _, P = graph.relative_pose(loop.first, loop.second)
    return bool(eigvalsh(P, loop.covariance)[-1] > 1.0)


def _inliers(one: tuple[Loop, Verified]) -> int:
    """Number of inliers."""
    return one[0].inliers


def _nearest(poses: Array, here: Array, depth: float, possible: BoolArray) -> NDArray[np.intp]:
    """Numbers of the possible keyframes nearest by the path, in the camera's position and in what it looks at.

    Args:
        poses: of the keyframes (K, 4, 4).
        here: of the camera (4, 4).
        depth: of what it looks at [m].
        possible: which of them may be chosen (K,).
    """
    places = np.linalg.norm(poses[:, :3, 3] - here[:3, 3], axis=1)
    views = np.linalg.norm(poses[:, :3, 3] + depth * poses[:, :3, 2] - here[:3, 3] - depth * here[:3, 2], axis=1)
    distance = np.where(possible, places + views, np.inf)
    best = np.argsort(distance, kind="stable")[:_NEARBY]
    return np.asarray(best[np.isfinite(distance[best])])
