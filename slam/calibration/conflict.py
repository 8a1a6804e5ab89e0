"""Errors of a calibration that the images show, but that no calibration of this camera has, in words with their cause.

What is estimated is held back by the prior, which a calibration of another camera, or one that leaves a part out, does
not keep. So each cause is freed of the prior in turn, and what the likelihood gains by that is compared: a test of the
prior against the data (Box, Sampling and Bayes' inference in scientific modelling and robustness, 1980).
"""

from __future__ import annotations

import numpy as np

from slam.calibration.model import RigModel
from slam.calibration.posterior import FOCALS, Evidence, Prior, along
from slam.geometry.camera import off_middle, size_doubt

#: guard: Least gain of twice the log-likelihood. With unlimited data it is the square of the error in standard
#: deviations of the prior, so this is 7 of them. Over the recordings and worlds at hand it is up to 28; with the lens
#: distortion of three recordings left out it is 230 to 790.
GAIN = 49.0

#: guard: The same of the focal length alone for a warning, 4 of them: what a path is too long by. It is up to 7 on the
#: recordings and worlds at hand; of one that is a tenth wrong 12 to 220 where the camera turns, less on straight roads.
FOCAL_WARNING = 16.0


def conflict(model: RigModel, prior: Prior, evidence: Evidence | None, which: str = "", focal: float = GAIN) -> str:
    """What is wrong with a calibration, in a line; empty where no cause alone explains the images far better.

    Of the `prior` the widest covariance counts, which allows the errors that calibrations have. Principal points far
    from the middle of the images are wrong unless the `evidence` makes the middle far less likely. A focal length is
    named from the gain `focal` on, other causes from `GAIN`. `which` says which calibration it is: "kept ", or nothing.
    """
    whose, unlikely = f"{which}calibration", size_doubt(model.rig.left, model.rig.right)
    if evidence is None:
        return unlikely
    information = prior.information[-1]
    posterior = np.linalg.inv(information + evidence.S)
    held = information - information @ posterior @ information  # information on the prior's mean
    pull = information @ (posterior @ (evidence.e - evidence.S @ prior.mean))
    middle = -prior.mean
    for side, camera in (("left", model.rig.left), ("right", model.rig.right)):
        x, y = off_middle(camera) * (camera.width - 1, camera.height - 1) / 2 / (camera.fu, camera.fv)
        middle = middle + x * along(model, f"{side}_cx") + y * along(model, f"{side}_cy")
    if unlikely and middle @ held @ middle - 2 * pull @ middle < GAIN:
        return unlikely

    def freed(*directions: tuple[str, ...]) -> tuple[float, list[float]]:
        """Twice the log-likelihood that is gained with these parameters at any values, and the values."""
        A = np.column_stack([along(model, *names) for names in directions])
        values = np.linalg.lstsq(A.T @ held @ A, A.T @ pull, rcond=1e-9)[0]  # of what nothing shows: 0
        return float(pull @ A @ values), values.tolist()

    gain, (share,) = freed(FOCALS)
    much = f"at least {abs(100 * share):.0f} % {'shorter' if share > 0 else 'longer'} than the {whose}'s"
    cause = "is it of this camera, and for images of this size?"
    causes = [(gain, focal, f"the images fit a focal length {much}: {cause}")]  # gain, from which on it is named, words
    gain, (k1, _) = freed(("left_k1", "right_k1"), ("left_k2", "right_k2"))
    cause = "are its coefficients of this camera, in this order and of this model?"
    if not (model.rig.left.has_distortion or model.rig.right.has_distortion):
        cause = "were the coefficients left out?"
    much = f"that is not in the {whose} (k1 about {-k1:+.2f})"
    causes.append((gain, GAIN, f"the images show a lens distortion {much}: {cause}"))
    gain, shift = freed(("left_cx", "right_cx"), ("left_cy", "right_cy"))
    much = f"about {model.focal * np.linalg.norm(shift):.0f} px from the {whose}'s"
    cause = "were they cropped, or is it for images of another size?"
    causes.append((gain, GAIN, f"the images fit a principal point {much}: {cause}"))
    gain, (offset,) = freed(("right_cx",))
    much = f"about {abs(model.focal * offset):.1f} px off the {whose}'s"
    cause = "was the right image cropped or shifted, or a camera turned since?"
    causes.append((gain, GAIN, f"the images fit disparities {much}: {cause}"))
    gain, turn = freed(("pitch",), ("roll",))
    much = f"turned by about {np.degrees(np.linalg.norm(turn)):.1f}° against the {whose}'s"
    cause = "was a camera moved since, or is its rotation the inverse one?"
    causes.append((gain, GAIN, f"the images fit a right camera that is {much}: {cause}"))
    _, named = max(((gain, words) for gain, least, words in causes if gain > least), default=(0.0, ""))
    return named
