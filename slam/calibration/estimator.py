"""The self-calibration: learns the rig's error while the system runs, corrects pixels by it, and says what is left.

The uncertainty that is left in poses and landmarks is that of consider parameters (Schmidt, 1966), followed by the back
end. With δ the error of the applied correction and ``Σ`` its covariance, poses and landmarks are
``T_true = T exp(J δ)``, ``y_true = y + L δ``, and their covariances grow by ``J Σ Jᵀ`` and ``L Σ Lᵀ``. The back end
knows J and L (`slam.interfaces.ConsideringBackend`); what is known of δ is the self-calibration's.

Measurements of a path have been corrected by different corrections c_k. With θ the true parameters, the error that
they leave is ``Σ_k G_k F_k (θ − c_k) = J θ − Σ_k G_k F_k c_k``, with gains G_k and fields F_k. So δ is what is followed
of θ and of the baseline's length, and 1, whose column has the field ``−F_k c_k``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from slam.calibration.config import SelfCalibrationConfig
from slam.calibration.conflict import FOCAL_WARNING, GAIN, conflict
from slam.calibration.model import Revision, RigCorrection, RigModel
from slam.calibration.pairs import View, match, noise_variances, pair_evidence, pair_of, parallax
from slam.calibration.posterior import (
    FOCALS,
    Accumulator,
    Evidence,
    RigEvidence,
    RigPosterior,
    along,
    factory_prior,
    mean_variance,
    prior_information,
    residual_likelihoods,
    resumed_prior,
    row_evidence,
    solve,
    systematic_variance,
)
from slam.calibration.saved import SavedCalibration, joint_calibration
from slam.data import CommonError, Estimate, StereoFeatures
from slam.errors import CalibrationError, ConfigurationError
from slam.geometry.arrays import changed
from slam.geometry.rig import StereoRig, rig_difference, rig_numbers
from slam.geometry.se3 import Array, adjoint
from slam.interfaces import Backend, ConsideringBackend, RevisingBackend
from slam.tracks.follow import Matches

_BLOCK_OF_ROWS, _BLOCK_OF_PAIRS = 8, 4  # frames, pairs: within a block of so many, errors are taken to be correlated
_MOST_FEATURES = 1000  # cost: of a view, the strongest ones; half of the usual 800 made drives worse by a half

#: Change of the correction, in standard deviations of the disparities' error, for a back end to revise its past: it
#: then processes all its measurements again.
SIGNIFICANT = 0.5

#: Standard deviation of the baseline's length, as a share of it: the squares of a calibration board are known to some
#: tenths of a percent. It scales the whole world, so images never show it.
BASELINE = 0.002
_NO_IDS = np.zeros(0, np.int64)


class SelfCalibration:
    """Estimates the rig's error: its posterior, and the views that wait for a second one.

    `kept` is a calibration from earlier recordings; raises CalibrationError where it is of another rig, and
    ConfigurationError where self-calibration is switched off.
    """

    def __init__(self, rig: StereoRig, config: SelfCalibrationConfig, kept: SavedCalibration | None = None) -> None:
        self.rig, self.config = rig, config
        self.model = RigModel(rig)
        self._kept = kept
        self._systematic = systematic_variance(self.model, config.systematic)
        if kept is None:
            self._prior = self._own_prior = factory_prior(self.model)
            start = self._prior.covariances[-1]
        else:
            if found := rig_difference(kept.rig, rig_numbers(rig)):
                raise CalibrationError(f"the kept calibration is of another rig: {found}")
            if not config.enabled:
                raise ConfigurationError("a kept calibration needs self_calibration.enabled=true")
            mean, covariance = kept.posterior.mean, kept.posterior.covariance
            self._prior = resumed_prior(self.model, mean, covariance)
            self._own_prior = resumed_prior(self.model, mean, covariance + np.diag(self._systematic))
            start = self._own_prior.covariances.mean(axis=0)
        self._own = RigPosterior(self._prior.mean, start)  # of the errors in this recording, without residual fields
        # covariance (n, n) of its mean by what its evidence has in common: a systematic error, unknown residual fields
        self._by_bias = np.zeros_like(start)
        self._before = np.linalg.inv(start)  # information (n, n) without evidence
        self._rows = Accumulator(config.inflation, _BLOCK_OF_ROWS)
        self._motion = Accumulator(config.inflation, _BLOCK_OF_PAIRS)
        self._fields: Evidence | None = None  # of rows: parameters and residual fields
        self._far = self.model.field(self.model.far())[:, 2]  # disparities of far points by the parameters
        self._focal = along(self.model, *FOCALS) / 2  # the focal lengths' common error by the parameters
        self._unknown = mean_variance(self._far, np.linalg.inv(prior_information(self.model)))
        self._variances = np.log(np.square([config.pixel_sigma, config.disparity_sigma]))  # and of how many pairs
        self._scattered = 4  # 4: number of pairs that the configured noise counts for
        self._waiting: list[View] = []
        self._open: Evidence | None = None  # of a pair that is not complete
        self._frames, self._solved = 0, 0  # frames of the incomplete pair: now, and when last solved
        self._seen = self.unsolved = 0
        self._looked: Array | None = None  # pose of the last frame that was used
        self.applied = RigCorrection(self.model, self._prior.mean.copy())

    @property
    def pairs(self) -> int:
        """Number of pairs of views in the posterior."""
        return self._motion.count

    @property
    def posterior(self) -> RigPosterior:
        """The present posterior of the rig's error in this recording."""
        return RigPosterior(self._own.mean.copy(), self._own.covariance + self._by_bias)

    @property
    def doubt(self) -> str:
        """What the images contradict by far in the calibration, in a line; empty where they do not."""
        return self._contradicted(GAIN)

    @property
    def warning(self) -> str:
        """As `doubt`, but also a focal length that the images contradict less surely."""
        return self._contradicted(FOCAL_WARNING)

    def _contradicted(self, focal: float) -> str:
        rows, moved = self._rows.total(), self._moved()
        found = rows if rows is None or moved is None else rows + moved
        return conflict(self.model, self._prior, found, "kept " if self._kept else "", focal)

    def apply(self, least: float = 0.0) -> Revision | None:
        """Apply the present posterior to features from now on; returns the change, or None.

        The calibration as delivered is used

        - until motion has halved the prior variance of the disparities, unless there is a kept calibration: rows alone
          hardly determine disparities, so that the posterior is mostly the prior;
        - while it explains the motion nearly as well as the posterior: rows have errors of their own, such as wrong
          matches.

        The correction is unchanged if both the disparities of far points (root mean square over the image) and the
        focal length, which far points do not show, would change by less than `least` standard deviations.
        """
        if not self.config.enabled:
            return None
        variance = mean_variance(self._far, self._own.covariance)
        known = self._kept is not None or (variance <= 0.5 * self._unknown and self._motion_agrees())
        mean = self._own.mean if known else np.zeros_like(self._own.mean)
        step = mean - self.applied.parameters
        if not step.any():
            return None
        focal = self._focal @ self._own.covariance @ self._focal
        changes = np.square(self._far @ step).mean() / variance, (self._focal @ step) ** 2 / focal
        if max(changes) <= least**2:
            return None
        before, self.applied = self.applied, RigCorrection(self.model, mean.copy())
        return Revision(before, self.applied)

    def _motion_agrees(self) -> bool:
        """Whether the evidence of motion is likelier with the posterior mean than with the calibration as delivered."""
        motion, mean = self._moved(), self._own.mean
        gain = 0.0 if motion is None else motion.e @ mean - 0.5 * mean @ motion.S @ mean
        return bool(gain > 1)  # 1: a fitted parameter's gain (Akaike)

    def correct(self, features: StereoFeatures) -> StereoFeatures:
        """Features with the applied correction."""
        if not self.config.enabled or not self.applied.parameters.any():
            return features
        return self.applied.features(features)

    def observe(self, features: StereoFeatures, T_world_left: Array) -> None:
        """Learn from one frame's features as measured, not corrected.

        `T_world_left` (4, 4) is the left camera's pose by the system, a first guess.
        """
        if not self.config.enabled:
            return
        self._seen += 1
        # 0.05: one frame at least per rotation by this angle [rad]: turns are rare, and alone show the focal length
        least, before = 1 + 2 * np.cos(0.05), self._looked
        turned = before is None or np.sum(T_world_left[:3, :3] * before[:3, :3]) < least
        # 20: after this many pairs every second frame is used, after twice as many every third, and so on
        if self._seen % (1 + self.pairs // 20) and not turned:
            return
        self._looked = T_world_left
        view = View.of(self.model, features, T_world_left, _MOST_FEATURES)
        if (count := len(view.points)) < self.config.minimum_common:
            return
        # 250: features of a frame whose rows are used: more add little
        some = np.linspace(0, count - 1, min(count, 250)).astype(int)
        rows, fields = row_evidence(self.model, view.points[some], view.vertical[some], self._own.mean)
        self._rows.add(rows)
        self._fields = fields if self._fields is None else self._fields + fields
        pairs, part = self.pairs, self._open
        self._compare(view)
        # By rows alone the posterior would change little: it follows what motion shows.
        if self.pairs > pairs or (self._open is not part and (self.pairs or self._open is not None)):
            self._update()

    def _compare(self, view: View) -> None:
        """Compare a view with the earlier ones, oldest first, until one still overlaps too much and keeps waiting."""
        c, waiting = self.config, self._waiting
        with_last = match(waiting[-1], view) if waiting else None
        # 0.5: a new view is taken when the last one has lost this share of the features it may lose
        apart = with_last is None or len(with_last) < (1 - 0.5 * (1 - c.kept_share)) * len(waiting[-1].points)
        ended = 0
        for first in waiting:
            matched = with_last if with_last is not None and first is waiting[-1] else match(first, view)
            if len(matched) > max(c.kept_share * len(first.points), c.minimum_common):
                break
            ended += 1
            evidence = self._evidence(first, view, matched) if len(matched) >= c.minimum_common else None
            if evidence is not None:
                self._motion.add(evidence)
        if waiting and not ended and self.pairs < 6:  # 6: with fewer pairs, an incomplete one counts provisionally
            self._frames += 1
            # 1.25: an incomplete pair is solved again after so many times the frames: parallax grows no faster
            if self._frames >= 1.25 * self._solved:
                self._open, self._solved = self._evidence(waiting[0], view, matched), self._frames
        else:
            self._open, self._frames, self._solved = None, 0, 0
        self._waiting = [*waiting[ended:], view] if apart else waiting[ended:]

    def evidence(self) -> RigEvidence | None:
        """The evidence of this recording alone, without any prior; None if no motion was seen."""
        moved, rows = self._moved(), self._rows.total()
        if moved is None or rows is None or self._fields is None:
            return None
        whole, scales = rows + moved, residual_likelihoods(self._prior, self._fields)
        return RigEvidence(whole, whole.with_error(self._systematic), scales)

    def _moved(self) -> Evidence | None:
        """The evidence of motion: of the pairs, and of the incomplete one."""
        complete = self._motion.total()
        if self._open is None:
            return complete
        part = self._open.scaled(1 / self._motion.inflation)
        return part if complete is None else complete + part

    def kept(self) -> SavedCalibration:
        """What is known of the rig, as a prior for further recordings of it."""
        found = self.evidence()
        if found is None:
            return self._kept or SavedCalibration(self.posterior, rig_numbers(self.rig))
        before = [] if self._kept is None or self._kept.evidence is None else [self._kept.evidence]
        return joint_calibration(self.model, factory_prior(self.model), [*before, found])

    def summary(self) -> dict[str, Any]:
        """The result as plain types."""
        return {"pairs": self.pairs, "unsolved_pairs": self.unsolved, **self.kept().to_json()}

    @property
    def _noise(self) -> Array:
        """Covariance (3, 3) of a point ``(x, y, d)`` [px²]."""
        return np.diag(np.exp(self._variances)[[0, 0, 1]])

    def _evidence(self, first: View, second: View, matched: Matches) -> Evidence | None:
        """The evidence of a pair of views with matched features; None without a solution."""
        mean = self._own.mean
        pair = pair_of(self.model, first, second, mean, self._noise, self._seen, matched)
        if len(pair.first) < self.config.minimum_common:
            self.unsolved += 1
            return None
        if parallax(self.model, pair) < self.config.minimum_parallax:
            return None
        self._scattered += 1
        scatter = np.log(noise_variances(pair, self.model.focal, self._noise))
        self._variances = self._variances + (scatter - self._variances) / self._scattered
        evidence = pair_evidence(self.model, pair, mean, self._noise)
        self.unsolved += evidence is None
        return evidence

    def _update(self) -> None:
        """Update the posterior by Bayes' rule from all pairs of views and all rows so far."""
        for part in (self._rows, self._motion):
            part.update_inflation(self._own.mean, self._own.covariance)
        moved, found = self._moved(), self.evidence()
        assert moved is not None and found is not None  # because there are pairs
        # The correction is to explain this recording, so it may take up what the residual fields do here.
        self._own = solve(self._own_prior, moved, found.plain)
        # What is still from the prior has no bias of this recording: the gain is the evidence's weight.
        gain = np.eye(len(self._systematic)) - self._own.covariance @ self._before
        effect = self._own.covariance @ found.plain.cross
        self._by_bias = gain * self._systematic @ gain.T + found.fields * effect @ effect.T


class RemainingRigError:
    """The rig's error that is left in a back end's estimate while self-calibration continues.

    What back ends follow are the errors of the n parameters, that of the baseline's length, and 1.
    """

    def __init__(self, calibration: SelfCalibration) -> None:
        self._calibration, self._measured_with = calibration, calibration.applied  # of what the back end was given
        self._revised = np.zeros(len(calibration.model.names))  # changes of the correction that the whole path followed
        self._turned = np.zeros(6)  # how the world turned as the whole path was revised: a motion, on the left
        self._root: tuple[Array, Array] | None = None  # of the last covariance, which is asked for thrice in a frame

    def follow(self, backend: Backend, pose: Array | None = None) -> None:
        """Let a back end that can follow the errors, before its first frame; `pose` (6, m) is J of its first pose."""
        if self._calibration.config.enabled and isinstance(backend, ConsideringBackend):
            backend.consider(self.field, pose)

    def field(self, z: Array) -> Array:
        """Derivatives (N, 3, n + 2) of true rows (uL, vL, uR) by what is followed, at corrected rows (N, 3) [px]."""
        points = self._calibration.model.points(z)
        field = self._calibration.model.field(points)[:, :3]
        field[:, 2] = field[:, 0] - field[:, 2]
        out = np.zeros((len(z), 3, field.shape[2] + 2))
        out[:, :, :-2] = field
        out[:, 2, -2] = points[:, 2]  # with a longer baseline, the nominal one's disparity is smaller
        out[:, :, -1] = -field @ (self._calibration.applied.parameters - self._revised)
        return out

    def revise(self, backend: Backend, restarted: bool) -> Revision | None:
        """Correct a back end's earlier measurements, if it can revise them; returns the change, or None.

        Where the back end has `restarted`, part of the path is an earlier one's and cannot be revised.
        """
        applied = self._calibration.applied
        if applied is self._measured_with or not isinstance(backend, RevisingBackend):
            return None
        revision = Revision(self._measured_with, applied)
        whole = not restarted and backend.revises_path
        if whole:
            step = applied.parameters - self._measured_with.parameters
            self._revised = self._revised + step
            if isinstance(backend, ConsideringBackend):
                self._turned = self._turned + _adjoint_of(backend) @ backend.sensitivities(_NO_IDS)[0][:, :-2] @ step
        backend.revise(revision.rows)
        self._measured_with = applied
        return revision

    def added_to(self, backend: Backend, estimate: Estimate) -> Estimate:
        """The back end's estimate with the rig's uncertainty added."""
        if not (self._calibration.config.enabled and isinstance(backend, ConsideringBackend)):
            return estimate
        root, (J, L) = self._common_root(self._revised), backend.sensitivities(estimate.ids)
        J, L = J @ root, L @ root
        return changed(
            estimate, covariance=estimate.covariance + J @ J.T,
            covariances=estimate.covariances + L @ np.swapaxes(L, 1, 2),
        )  # fmt: skip

    def common(self, backend: Backend, as_reported: bool) -> CommonError:
        """The part of the pose's error that it shares with those of other frames.

        The covariance that `added_to` adds to the pose is ``J S Sᵀ Jᵀ``. Poses of several frames have the common errors
        ``J₁ S c``, ``J₂ S c``, …, with the same c of unit variance, where S is of the last frame.

        Where a whole path is revised, the newest pose stays and all before it move. Poses as reported keep in this way
        what the earlier correction did to them: as if the world had turned under the path. `as_reported` asks for poses
        as reported in each frame, with the correction of that time; else for the present path, in which a back end may
        have revised earlier poses.
        """
        if not (self._calibration.config.enabled and isinstance(backend, ConsideringBackend)):
            return CommonError()
        J, revised = backend.sensitivities(_NO_IDS)[0], self._revised
        if as_reported:
            J, revised = J.copy(), 0.0 * revised
            J[:, -1] -= J[:, :-2] @ self._revised
            J[:, -1] += np.linalg.solve(_adjoint_of(backend), self._turned)
        return CommonError(J, self._common_root(revised))

    def _common_root(self, revised: Array) -> Array:
        """Square root (n + 2, n + 2) of the mean square of what is followed, less that of `revised` (n,).

        It is the symmetric root, so that its columns mean the same in all frames.
        """
        covariance = self._calibration.posterior.covariance
        if self._root is None or not np.array_equal(self._root[0], covariance):
            values, vectors = np.linalg.eigh(covariance)
            self._root = covariance, vectors * np.sqrt(np.maximum(values, 0)) @ vectors.T
        n = len(covariance)
        root = np.diag(np.append(np.zeros(n), [BASELINE, 1.0]))
        root[:n, :n], root[:n, -1] = self._root[1], self._calibration.applied.parameters - revised
        return root


def _adjoint_of(backend: Any) -> Array:
    """From motions on the right of the newest pose to those on the left of the world (6, 6)."""
    return adjoint(backend.estimate(landmarks=False).T_world_left)
