"""How a run went as a whole: whether the camera was tracked, and if not, why not, in one line."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slam.data import StereoFeatures
from slam.geometry.arrays import BoolArray
from slam.geometry.camera import baseline_doubt, in_units
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, inverse, log
from slam.input.warnings import REPEATED
from slam.models import MotionModel
from slam.run.options import RunOptions
from slam.run.run_record import RunRecord
from slam.tracks.step import ENOUGH_FEATURES, HIDDEN

_TRACKED, _STARTED = "tracked", "started"

#: guard: So many times the expected change of velocity in the median says that times or the kind of motion are wrong.
#: The median over the recordings and worlds at hand is .02 to .4; of times ten times too short it is 30 times as large.
_JERKY = 3.0
_LEAST_CHANGES = 10  # guard: changes of velocity of which a median is taken
_ASIDE = 1.0  # guard: speed [m/s] at which no vehicle goes sideways

#: guard: Changes of velocity [m/s] that no hand and no vehicle makes: as accelerations [m/s²], and over their median.
#: On real and spoilt recordings accelerations are up to 10, ratios up to 12 where the path is right, else 25 and 23.
_AT_ONCE, _BRAKES, _RARE = 1.0, 20.0, 20.0

#: guard: Median speeds [m/s] that no camera in a hand and no vehicle has, and median distances [m] that neither sees.
_FASTEST = {False: 10.0, True: 100.0}
_NEAREST = {False: 0.05, True: 1.0}
_WIDEST = {False: 1.0, True: np.inf}  # guard: baseline [m] that no hand carries
_MANY = 0.1  # guard: share of frames that were not tracked, from which on it is said


def outcome(
    record: RunRecord, rig: StereoRig, options: RunOptions, warnings: Sequence[str] = (), dropped: int = 0,
    doubt: str = "", recorded: bool = False,
) -> str:  # fmt: skip
    """What to say of a run in which many frames were not tracked, with the likely cause; empty for others.

    The first frame is not counted: there is no map yet, unless the run began in one. The first of the `warnings` is
    taken for a cause; repeated images are counted instead. `dropped` frames of a live run came too late; `doubt`, of
    `motion_doubt`, is a cause where nothing else is one. What was `recorded` has no images.
    """
    untracked = [row for row, status in enumerate(record.statuses) if row and status not in (_TRACKED, _STARTED)]
    frames, missed = len(record.statuses) - 1, len(untracked)
    if frames < 1 or missed <= _MANY * frames:
        return ""
    frozen = 2 * record.repeated > missed
    cause = next((line for line in warnings if REPEATED not in line), "")
    if not cause and not frozen:
        cause = _starved(record, untracked, rig, options.prior_map is not None, recorded) or doubt
        if not cause and dropped < frames:  # where most came, the gaps are hardly all of it
            cause = _unexplained(record, rig, options.kind == "driving")
            if ":" in (name := options.backend):  # somebody's own
                cause = f"the back end {name} (`python -m slam.testing {name}` checks it); or {cause}"
    causes = [cause] if cause else []
    if frozen:
        causes.append(f"in {record.repeated} of them {REPEATED}")
    if dropped:
        were = "a frame was" if dropped == 1 else f"{dropped} frames were"
        cheaper = "make a frame cheaper (smaller images, --set objects.mode=off), or move more slowly"
        causes.append(f"{were} dropped, and the frames about them are far apart: {cheaper}")
    every, first = len(record.statuses), record.statuses[0] == _STARTED
    few, of_all = 2 * missed > frames, missed + (not first)  # counted as in a run's table
    count, word = (every - of_all, "tracked") if few else (of_all, "not tracked")
    said = f"{'only ' if few else ''}{count} of {every} frames {'was' if count == 1 else 'were'} {word}"
    if missed == frames:
        said = f"no frame {'after the first ' if first else ''}was tracked"
    return f"{said}; likely cause: {'; and '.join(causes)}"


def _starved(record: RunRecord, untracked: Sequence[int], rig: StereoRig, in_map: bool, recorded: bool) -> str:
    """The first step that gave frames that were not tracked too little, and what to look at; empty where none did."""
    features, stereo = np.median(np.array(record.features)[untracked], axis=0)
    without = set(record.without_right)
    for row in untracked:  # ascending: without a right image, or after such without a tracked one between
        without |= {row} if row - 1 in without else set()
    missing = len(without.intersection(untracked))
    if features < ENOUGH_FEATURES and recorded:
        return f"the run that was recorded was not tracked there: it has {features:.0f} measurements in their median"
    if features < ENOUGH_FEATURES:
        return f"the images show hardly anything to follow ({features:.0f} features in the median of these frames)"
    if 2 * record.hidden > len(untracked):
        return f"in {record.hidden} of them {HIDDEN}"
    if in_map:
        return "the camera is not where the map was made, or the place looks different now"
    if 2 * missing > len(untracked):
        return (
            f"{missing} of these {len(untracked)} frames have no right image or follow such, and nothing new can be "
            "added to the map there: look for the missing images, and whether their names or times are the left ones'"
        )
    if stereo < ENOUGH_FEATURES:
        return (
            f"in the median of these frames {stereo:.0f} of {features:.0f} features are found in the right image: "
            "check that the images are of two cameras, the left one first, and the calibration"
        )
    return baseline_doubt(rig.baseline)


def _unexplained(record: RunRecord, rig: StereoRig, driving: bool) -> str:
    """What may be the cause where each step gave enough, with what is known."""
    depth = _depth(record)
    apart = f"the cameras are {rig.baseline:.3g} m apart"
    if np.isfinite(depth):
        apart += f" and what they see is {_rounded(depth)} m away in the median"
    if rig.baseline > _WIDEST[driving]:
        return (
            f"by the calibration {apart}, which no hand carries: a baseline in another unit"
            f"{in_units(rig.baseline)}, or a vehicle's camera without --kind driving"
        )
    vehicle = "" if driving else "a vehicle's camera without --kind driving, "
    return (
        f"features are found in both images, but not again in the next frame: {vehicle}frames too far apart, images "
        "that are not in order of time or have other times than theirs (fps=…, times=…), or the calibration of "
        f"another camera or in another unit: by it {apart}"
    )


def scale_doubt(record: RunRecord, rig: StereoRig, driving: bool = False) -> str:
    """What to say where speed or distance are impossible in their medians, as by a baseline in another unit.

    A baseline that is k times too long makes path, speed and distances k times too large, and no residual shows it.
    Empty where they are possible, or too few are known.
    """
    velocities, whole, _ = _velocities(record)
    speeds, depth = np.linalg.norm(velocities[whole, 3:], axis=1), _depth(record)
    if len(speeds) < _LEAST_CHANGES or not np.isfinite(depth):
        return ""
    apart = f"by the calibration the cameras are {rig.baseline:.3g} m apart"
    asked = f"{apart}; is that in metres?{in_units(rig.baseline)}"
    speed = float(np.median(speeds))
    if speed <= _FASTEST[driving] and depth >= _NEAREST[driving]:
        return asked if rig.baseline > _WIDEST[driving] else ""
    carrier = "no vehicle does" if driving else "no camera in a hand does (is it a vehicle's: --kind driving?)"
    said = f"the camera moved at {_rounded(speed)} m/s and saw things {_rounded(depth)} m away in the median"
    return f"{said}, which {carrier}: {asked}"


def motion_doubt(record: RunRecord, motion: MotionModel, driving: bool = False) -> str:
    """What to say where velocities change far more than the motion model lets them, or a vehicle goes sideways.

    Images that are missing, or come twice, make single changes that no camera makes. Times in another unit or of other
    rates do so in all frames, and a vehicle that is taken for a camera in a hand, unless the motion is known to be that
    of a vehicle. Empty where the motion is as expected.
    """
    velocities, whole, durations = _velocities(record)
    if len(velocities) < _LEAST_CHANGES + 1:
        return ""
    between = 0.5 * (durations[1:] + durations[:-1])[:, None]
    densities = np.repeat([motion.angular_acceleration, motion.acceleration], 3)
    changes = np.diff(velocities, axis=0) / (np.sqrt(between) * densities)
    counted = changes[whole[1:] & whole[:-1]]
    if len(counted) < _LEAST_CHANGES:
        return ""
    if driving:
        along = np.abs(velocities[whole, 3:])
        aside = along[(along[:, 0] > _ASIDE) & (along[:, 0] > along[:, 2]), 0]
        if len(aside) >= _LEAST_CHANGES:
            return (
                f"in {len(aside)} frames the camera moved sideways, at {_rounded(float(np.median(aside)))} m/s in the "
                "median, which no vehicle does: unless the camera looks to the side, something large that moved past "
                "was taken for the world"
            )
    faster = np.linalg.norm(np.diff(velocities[:, 3:], axis=0), axis=1)[whole[1:] & whole[:-1]]
    needs = faster / between[whole[1:] & whole[:-1], 0]
    torn = faster[(faster > _AT_ONCE) & (needs > max(_BRAKES, _RARE * float(np.median(needs))))]
    if len(torn):
        return (
            f"the velocity changes by {_rounded(float(torn.max()))} m/s between measured frames, as no camera's "
            "does: images are missing, come twice or are exchanged there, or something large that moved was taken for "
            "the world"
        )
    ratio = float(np.median(np.sqrt((counted**2).reshape(-1, 2, 3).mean(2)).max(1)))
    if not ratio >= _JERKY:  # also where it is no number
        return ""
    return (
        f"from frame to frame the velocity changes {ratio:.0f} times as much as expected: check the times of the "
        f"images (fps=…, or seconds in times=…){'' if driving else ', and whether this is a vehicle (--kind driving)'}"
    )


def median_depth(features: StereoFeatures, rig: StereoRig) -> float:
    """Depth [m] of the feature with the median disparity; NaN where none has a right pixel."""
    stereo = np.flatnonzero(features.has_stereo)
    if not len(stereo):
        return float("nan")
    left, right = features.uv_left[stereo], features.uv_right[stereo]
    middle = [np.argsort(left[:, 0] - right[:, 0], kind="stable")[len(stereo) // 2]]
    return float(rig.triangulate(left[middle], right[middle])[0, 2])


def _velocities(record: RunRecord) -> tuple[Array, BoolArray, Array]:
    """Velocities (N, 6) between measured frames in the camera's axes [rad/s, m/s], whether they count, times [s].

    Where a loop moves the path, what is between is no motion.
    """
    rows = np.flatnonzero(record.measured)
    poses, durations = np.array(record.poses).reshape(-1, 4, 4)[rows], np.diff(np.array(record.stamps)[rows])
    whole = np.diff(np.searchsorted(record.closed, rows, side="right")) == 0
    return log(inverse(poses[:-1]) @ poses[1:]) / durations[:, None], whole, durations


def _depth(record: RunRecord) -> float:
    """Median distance of what the frames see [m]; NaN where none is known."""
    depths = np.array(record.depths)[np.isfinite(record.depths)]
    return float(np.median(depths)) if len(depths) else float("nan")


def _rounded(value: float) -> str:
    return f"{float(f'{value:.2g}'):g}"
