"""What looks wrong with images and times is said once each; what is right is left in peace."""

import itertools
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

import slam
from slam.data import StereoFeatures
from slam.errors import SequenceError
from slam.geometry.camera import PinholeCamera
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import exp
from slam.input import warnings
from slam.input.moment import MomentWatch, _lags
from slam.input.pair import PairGeometry, pair_geometry, points_of, share_shown
from slam.input.warnings import InputWarnings
from slam.models import models_for

SEQUENCE = slam.open_sequence("synthetic:desk?frames=1")
FRAME = next(iter(SEQUENCE))
RIG = SEQUENCE.rig


def lines(frames, features=200, rig=RIG, kind="handheld", stereo=90, **arrays):
    """What is said of frames in which the front end found so many features, so many with a right pixel."""
    watch = InputWarnings(rig, models_for(kind), 1.5)
    image = np.zeros((features, 2))
    found = replace(
        StereoFeatures.empty(0.0),
        uv_right=np.where(np.arange(features)[:, None] < stereo, image, np.nan),
        **{
            **{name: image[:, 0] for name in ("scale", "angle", "response")},
            "laplacian": np.zeros(features, np.int8),
            "uv_left": image,
            "descriptors": image,
            **arrays,
        },
    )
    for frame in frames:
        watch.look(frame, replace(found, stamp=frame.stamp))
    return watch.lines


def stamped(stamps, change=lambda left, right: (left, right)):
    """The frame at these times, with its images changed."""
    left, right = change(FRAME.left, FRAME.right)
    return [replace(FRAME, index=k, stamp=stamp, left=left, right=right) for k, stamp in enumerate(stamps)]


def every(count, change=lambda left, right: (left, right), interval=0.05):
    """So many frames at 20 Hz."""
    return stamped(interval * np.arange(count), change)


def swap(left, right):
    return right, left


def rolled(rows):
    return lambda left, right: (left, np.roll(right, rows, axis=0))


def noise(left, right):
    rng = np.random.default_rng(0)
    return tuple(rng.integers(0, 255, (240, 320), dtype=np.uint8) for _ in range(2))


def dim(left, right):
    """Noisy, and across a multiple of 256."""
    grain = np.random.default_rng(0).integers(0, 6, left.shape, np.uint16)
    return tuple(x.astype(np.uint16) // 16 + 1020 + grain for x in (left, right))


def never_rectified(left, right):
    H = RIG.left.K @ cv2.Rodrigues(np.array([0.03, 0.0, -0.02]))[0] @ np.linalg.inv(RIG.left.K)
    return left, cv2.warpPerspective(right, H, (320, 240))


def turned(left, right):
    """Images whose disparity is along columns."""
    return tuple(cv2.resize(np.rot90(image), (320, 240)) for image in (left, right))


def mosaic(left, right):
    """Grey things seen through a filter that lets less of two colours through."""
    share = np.tile(np.array([[0.6, 1.0], [1.0, 0.4]]), (120, 160))
    return tuple((image * share).astype(np.uint8) for image in (left, right))


def blurred_copy(left, right):
    return left, cv2.GaussianBlur(left, (3, 3), 0.5)


def unlike_cameras(turn, *lenses):
    """A rig of two cameras, the right one turned; each with the two first numbers of its lens."""
    left = PinholeCamera(250.0, 251.0, 170.0, 110.0, 320, 240, "radtan", (*lenses[0], 0.001, 0.0))
    right = PinholeCamera(255.0, 256.0, 150.0, 130.0, 320, 240, "radtan", (*lenses[1], 0.0, 0.001))
    R = cv2.Rodrigues(np.array(turn))[0]
    return slam.StereoRig(left, right, R, R.T @ np.array([-0.12, 0.004, 0.002]))


def seen_by(image, camera, R):
    """The image of a camera, turned by R, of what is in an image of `RIG`: where each pixel's ray meets that."""
    v, u = np.mgrid[:240, :320]
    rays = np.column_stack([camera.normalise(np.column_stack([u.ravel(), v.ravel()]).astype(float)), np.ones(76800)])
    uv = np.nan_to_num(RIG.left.project(rays @ R), nan=-1).astype(np.float32).reshape(240, 320, 2)
    return cv2.remap(image, uv[..., 0], uv[..., 1], cv2.INTER_LINEAR)


def seen_by_both(left, right, R):
    """A change of images into what two cameras have of them, the right one turned."""
    return lambda a, b: (seen_by(a, left, np.eye(3)), seen_by(b, right, R))


DISTORTED = unlike_cameras([0.01, 0.02, -0.01], (-0.25, 0.08), (-0.26, 0.08))
_LENS = PinholeCamera(260.0, 260.0, 159.5, 119.5, 320, 240, "radtan", (-0.37, 0.2, 0.0, 0.0))
ALIKE = slam.StereoRig(_LENS, _LENS, np.eye(3), np.array([-0.12, 0.0, 0.0]))  # most rows agree to a pixel all the same
OBLONG = PinholeCamera(300.0, 350.0, 160.0, 120.0, 320, 240)
PLAIN = [replace(camera, model="none", distortion=()) for camera in (DISTORTED.left, DISTORTED.right)]
TURNED = unlike_cameras([0.02, 0.12, -0.02], (-0.1, 0.02), (-0.12, 0.02))
TRANSPOSED = slam.StereoRig(TURNED.left, TURNED.right, TURNED.R.T, TURNED.b)
OTHER_SIGN = [replace(_LENS, distortion=tuple(-d for d in _LENS.distortion))] * 2

#: Two looks that take turns on a grid of 20 columns.
_TWO = np.random.default_rng(0).normal(size=(2, 64))
REPEATED = {
    "stereo": 0, "laplacian": np.ones(200, np.int8), "scale": np.full(200, 8.0),
    "uv_left": np.column_stack([10 + 15.0 * (np.arange(200) % 20), 10 + 20.0 * (np.arange(200) // 20)]),
    "descriptors": (_TWO / np.linalg.norm(_TWO, axis=1, keepdims=True))[np.arange(200) % 2].astype(np.float32),
}  # fmt: skip


def of_size(times):
    return slam.StereoRig.rectified_pair(times * 300.0, times * 160.0, times * 120.0, 0.12, 320, 240)


#: Frames, what else `lines` is told, and what is said once; nothing where that is empty.
SAID = {
    "swapped": (every(8, swap), {}, "left and right look swapped.*exchange them"),
    "swapped colour": (
        every(1, lambda a, b: tuple(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) for image in (b, a))), {}, "swapped"
    ),
    "rows up": (every(8, rolled(-9)), {}, r"rows of left and right image do not agree.*off by 9\.0 px"),
    "rows down": (every(8, rolled(4)), {}, r"rows of left and right image do not agree.*off by 4\.0 px"),
    "different things": (every(70, noise), {}, ""),
    "one camera": ([replace(FRAME, right=None)], {}, ""),
    "one image twice": (
        every(8, lambda a, b: (a, a)), {},
        f"left and right image show the same.*nearer than {RIG.left.fu * RIG.baseline / 2:.0f} m",
    ),
    "one blurred": (every(8, blurred_copy), {"rig": DISTORTED}, "left and right image show the same"),
    # one lens as two cameras: the halves of an image show different things
    "no partners": (
        every(12, noise), {"stereo": 3}, "^only 3 of 200 features of frame 4 are found in the right image"
    ),
    "no partners yet": (every(4, noise), {"stereo": 3}, ""),
    "no right image": ([replace(f, right=None) for f in every(12, noise)], {"stereo": 0}, ""),
    "milliseconds": (
        every(20, interval=50.0), {}, r"stamps are 50 s apart \(are they in milliseconds\?\): give them in seconds"
    ),
    "nanoseconds": (every(20, interval=5e7), {}, "are they in nanoseconds"),
    "too close": (every(20, interval=5e-11), {}, "stamps are 5e-11 s apart: give them in seconds"),
    "slow": (every(20, interval=2.0), {}, "frames are 2 s apart: in that time a camera can turn so far"),
    "1 kHz": (every(8, interval=0.001), {}, ""),
    "2 Hz": (every(8, interval=0.5), {}, ""),
    "a gap": (stamped([0, 0.1, 0.2, 40.0, 40.1, 40.2, 40.3]), {}, ""),
    "an hour": (
        stamped(0.1 * np.arange(20) + 3600.0 * (np.arange(20) > 9) + 7200.0 * (np.arange(20) > 15)), {},
        "^frame 10: its stamp is 3600 s after that of the frame before: if the clock was set there",
    ),
    "an hour at the start": (
        stamped(0.1 * np.arange(9) + 3600.0 * (np.arange(9) > 2)), {}, "^before frame 5: a stamp is 3600 s after"
    ),
    "no texture": (
        every(12), {"features": 3}, r"hardly anything to follow \(3 features in frame 4, grey values from "
    ),
    "no texture yet": (every(4), {"features": 3}, ""),
    # a calibration's file names no size: that of the images is taken
    "half size": (every(12), {"rig": of_size(0.5), "stereo": 3}, "for images of about 160x120 px, 0.5 times the size"),
    "same size": (every(12), {"rig": of_size(1.0)}, ""),
    "rectified twice": (every(3), {"rig": DISTORTED}, "images were rectified before, or undistorted, and are again"),
    "equal lenses": (every(3), {"rig": ALIKE}, "images were rectified before, or undistorted, and are again"),
    "of a size a fifth larger": (every(3), {"rig": of_size(1.2)}, "384x288 px, 1.2 times .* or these were cropped"),
    "cx and cy exchanged": (
        every(3), {"rig": slam.StereoRig.rectified_pair(300.0, 120.0, 160.0, 0.12, 320, 240)}, "cx and cy exchanged"
    ),
    "fx and fy": (
        every(3), {"rig": slam.StereoRig(*2 * [OBLONG], np.eye(3), np.array([-0.12, 0, 0]))},
        "300 px along rows and 350 px along columns, differ, but pixels are square",
    ),
    "fy of both cameras": (
        every(3), {"rig": slam.StereoRig(*(replace(c, fv=1.07 * c.fv) for c in (RIG.left, RIG.right)), RIG.R, RIG.b)},
        "along rows and columns differ by 7 %: pixels of digital cameras are square",
    ),
    "mirrored": (every(1, lambda a, b: (a, b[:, ::-1].copy())), {"stereo": 40}, "one of the images looks mirrored"),
    "fy of one camera": (
        every(3), {"rig": slam.StereoRig(replace(RIG.left, fv=275.0), RIG.right, RIG.R, RIG.b)},
        r"show 0 % .*fy 275\.0 and 260\.0.*mistyped",
    ),
    "turned": (every(3, turned), {}, "the images are turned by 90°, or the cameras stand above each other"),
    "bytes exchanged": (
        every(3, lambda a, b: tuple((x.astype(np.uint16) * 16).byteswap() for x in (a, b))), {}, "two bytes of each"
    ),
    "a few grey values of 16 bits": (every(3, dim), {}, ""),
    "12 of 16 bits": (every(3, lambda a, b: (a.astype(np.uint16) * 16, b.astype(np.uint16) * 16)), {}, ""),
    "mosaic": (every(3, mosaic), {}, "mosaic of a colour camera"),
    "interlaced": (
        every(3, lambda a, b: tuple(np.where(np.arange(240)[:, None] % 2, x, np.roll(x, 9, 1)) for x in (a, b))), {},
        "rows of the image alternate, as in interlaced video",
    ),
    # these were taken for images that are rectified twice
    "transposed rotation": (
        every(3, seen_by_both(TURNED.left, TURNED.right, TURNED.R)), {"rig": TRANSPOSED},
        "with the inverse of the calibration's rotation.*is R transposed",
    ),
    "distortion of the other sign": (
        every(3, seen_by_both(*OTHER_SIGN, np.eye(3))), {"rig": ALIKE}, "the sign of the distortion exchanged"
    ),
    "undistorted, not rectified": (
        every(3, seen_by_both(*PLAIN, DISTORTED.R)), {"rig": DISTORTED}, "undistorted, and are again"
    ),
    "lenses as calibrated": (every(3, seen_by_both(_LENS, _LENS, np.eye(3))), {"rig": ALIKE}, ""),
    "repeated pattern": (
        every(6), REPEATED, "only 0 of 200 features.*the view is a repeated pattern: 200 of them have a look-alike"
    ),
    "never rectified": (every(3, never_rectified), {}, "were they rectified, as this calibration says"),
}  # fmt: skip


@pytest.mark.parametrize("case", SAID)
def test_what_looks_wrong_is_said_once(case):
    frames, told, words = SAID[case]
    said = lines(frames, **told)
    assert len(said) == bool(words)
    assert not words or re.search(words, said[0])


def test_cameras_that_are_exchanged_for_certain_are_refused():
    for rig in (RIG, of_size(1.2)):  # also where a principal point is far from the middle
        with pytest.raises(SequenceError, match=r"left and right look swapped: .* exchange them"):
            lines(every(8, swap), stereo=3, rig=rig)
    right_before = [*stamped([0.0, 0.1]), *itertools.islice(every(8, swap), 3, None)]
    assert len(lines(right_before, stereo=3)) <= 1


@pytest.mark.parametrize(
    "right",
    [np.zeros((0, 0), np.uint8), FRAME.right.tolist(), "x", FRAME.right.astype(object), FRAME.right.astype(str)],
)
def test_what_is_no_right_image_is_refused_in_one_line(right):
    with pytest.raises(SequenceError, match="right"):
        slam.StereoSlam(RIG, "surf", "ekf").process(replace(FRAME, right=right))


def test_one_camera_twice_is_refused_and_a_single_frame_loses_its_right_image():
    for rig in (RIG, DISTORTED):
        system = slam.StereoSlam(rig, "surf", "ekf")
        with pytest.raises(SequenceError, match="frame 0: left and right are one and the same image"):
            system.process(replace(FRAME, right=FRAME.left.copy()))
    frames = list(slam.open_sequence("synthetic:desk?frames=5"))
    frames[2] = replace(frames[2], right=frames[2].left.copy())
    system = slam.StereoSlam(RIG, "surf", "ekf")
    seen = [system.process(frame).features.has_stereo.sum() for frame in frames]
    assert [count > 50 for count in seen] == [True, True, False, True, True]
    assert any("frame 2: left and right are one and the same image; it and others" in line for line in system.warnings)


def test_a_right_image_that_stays_is_not_used():
    frames = list(slam.open_sequence("synthetic:desk?frames=6"))
    right = [replace(f, right=frames[2].right if 2 <= f.index < 5 else f.right) for f in frames]
    system = slam.StereoSlam(RIG, "surf", "ekf")
    seen = [system.process(frame).features.has_stereo.sum() > 50 for frame in right]
    assert seen == [True, True, True, False, False, True]
    assert any("frame 3: the right image is that of the frame before: its camera froze" in w for w in system.warnings)


@pytest.mark.slow
@pytest.mark.parametrize(("world", "late"), [("aisle?frames=120", (0, -1, 2)), ("desk?frames=72", (0, 1))])
def test_right_images_of_another_moment_are_doubted(world, late):
    """Numbers off by one: the run is tracked, with another scale."""
    sequence = slam.open_sequence(f"synthetic:{world}")
    frames = [sequence.frame(k) for k in range(0, len(sequence), 4)]
    for by in late:
        moments, system = zip(frames, frames[abs(by) :]), slam.StereoSlam(RIG, backend="ekf")
        for a, b in moments:
            system.process(replace(b, right=a.right) if by > 0 else replace(a, right=b.right))
        assert ("one moment" in system.doubt) == bool(by) == bool(system.warnings)


def test_swapped_cameras_of_an_unrectified_rig():
    rig = unlike_cameras([0.02, 0.05, -0.03], (-0.1, 0.02), (-0.12, 0.02))
    views = [points_of(image) for image in seen_by_both(rig.left, rig.right, rig.R)(FRAME.left, FRAME.right)]
    rig = slam.StereoRig(rig.left, rig.right, rig.R, RIG.b)
    good, bad = pair_geometry(rig, *views, 1.5), pair_geometry(rig, *views[::-1], 1.5)
    assert good.conclusive and not good.swapped and not good.mostly(good.off_rows)
    assert bad.swapped


@pytest.mark.parametrize("early", [False, True])
def test_rows_that_agree_with_the_frame_before_are_of_two_moments(early):
    """They were taken for a rotation that is transposed."""
    see = seen_by_both(TURNED.left, TURNED.right, TURNED.R)
    seen = [see(*(np.roll(image, 7 * k, axis=0) for image in (FRAME.left, FRAME.right))) for k in range(4)]
    moved = [replace(FRAME, index=k, stamp=0.05 * k, left=a, right=b) for k, (a, b) in enumerate(seen)]
    pairs = [replace(a, right=b.right) if early else replace(b, right=a.right) for a, b in itertools.pairwise(moved)]
    (line,) = lines(pairs, rig=TURNED)
    assert f"to come a frame {'early' if early else 'late'}" in line


@pytest.mark.parametrize(("off", "explained"), [(150, False), (20, True)])
def test_another_moment_is_the_cause_only_where_most_rows_agree_by_it(monkeypatch, off, explained):
    """Of a right camera that is rolled somewhat more rows agree with those of the frame before."""
    own, other = PairGeometry(446, True, 100, off_rows=368, row_offset=2.0), PairGeometry(244, True, 90, off_rows=off)
    found = itertools.chain([own, own], itertools.repeat(other))
    monkeypatch.setattr(warnings, "pair_geometry", lambda *_: next(found))
    (line,) = lines(every(3))
    assert ("where right images are taken to come a frame" in line) == explained


def test_rounding_is_no_share_of_what_rectification_does():
    """Without lenses the change that they make was nothing but rounding, and rows showed billions of per cent of it."""
    rng = np.random.default_rng(0)
    before = rng.normal(0.0, 0.3, 100)
    assert share_shown(before, (1 + 1e-13) * before, 0.5) == 1.0
    assert share_shown(before, 2 * before, 0.5) == pytest.approx(-1.0)


@pytest.mark.parametrize("pitch", [-0.003, 0.003])
def test_a_camera_that_has_turned_a_little_is_no_rectification_done_twice(pitch):
    """Raw images whose rows are all off by as much as lenses move them were said to be rectified before."""
    rig = slam.StereoRig(_LENS, _LENS, cv2.Rodrigues(np.array([pitch, 0.0, 0.0]))[0], RIG.b)
    assert not lines(every(3, seen_by_both(_LENS, _LENS, np.eye(3))), rig=rig)


def test_a_distortion_that_is_missing_is_named_before_a_rectification_done_twice(monkeypatch):
    """Raw images with a calibration without their lenses were said to be undistorted twice."""
    monkeypatch.setattr(warnings, "pair_geometry", lambda rig, *given: pair_geometry(DISTORTED, *given))
    (line,) = lines(every(3), rig=slam.StereoRig(*PLAIN, DISTORTED.R, DISTORTED.b))
    assert "the lenses' distortion is missing in it; or the images were rectified before" in line


@pytest.mark.parametrize(("baseline", "doubted"), [(120.0, True), (0.00012, True), (0.006, False), (9.0, False)])
def test_a_baseline_in_another_unit_is_doubted(baseline, doubted):
    rig = slam.StereoRig.from_pinhole(RIG.left.K, baseline=baseline, size=(320, 240))
    said = InputWarnings(rig, models_for("handheld"), 1.5).lines
    assert [f"{baseline:g} m apart" in line for line in said] == [True] * doubted


def test_a_calibration_that_cannot_be_that_of_the_images_leaves_no_path_to_trust():
    system = slam.StereoSlam(of_size(0.5))
    assert [system.doubt] == system.warnings and "times the size of these" in system.doubt


WIDE = StereoRig.rectified_pair(300.0, 160.0, 120.0, 0.12, 320, 240)


def doubt(late, step, box, frames, rows=lambda x, y: 0.4, late_in=None):
    """What is said of frames with steps (6,) and points in a box, of which some have late right images, or all."""
    rng, watch, T = np.random.default_rng(0), MomentWatch(WIDE), np.eye(4)
    last = exp(step(rng))
    for k in range(frames):
        points, now = rng.uniform(*box, (200, 3)), exp(step(rng))  # `now` to the next frame, `last` from the one before
        left, right = WIDE.project(points)
        there = points @ last[:3, :3].T + last[:3, 3] if late > 0 else (points - now[:3, 3]) @ now[:3, :3]
        off = abs(late) * (WIDE.left.project(there) - left)[:, 1] if late_in is None or k in late_in else 0.0
        right[:, 1] += off + rows(*(left - [160.0, 120.0]).T / 300.0) + rng.normal(0, 0.1, len(points))
        ones = np.ones(len(points))
        looks = np.ones((len(points), 4), "f4")
        seen = StereoFeatures(0.0, left, right, ones, 0 * ones, ones, ones.astype(np.int8), looks)
        watch.add(seen, T, measured=True)
        T, last = T @ now, now
    return watch.doubt


def by_hand(rng):
    return rng.normal(0, 1, 6) * [0.006, 0.006, 0.006, 0.01, 0.01, 0.01]


@pytest.mark.parametrize(
    ("late", "frames", "late_in", "word"),
    [
        (0.0, 31, None, ""), (0.3, 31, None, "late"), (-0.3, 31, None, "early"), (0.3, 500, range(300, 500), "late"),
        (-0.3, 500, range(300, 310), "early"), (0.0, 500, None, ""),
    ],
)  # fmt: skip
def test_rows_that_follow_the_motion(late, frames, late_in, word):
    """A right camera that is pitched moves rows, too, but in the same way whatever the motion is."""
    said = doubt(late, by_hand, ([-2, -1.5, 3], [2, 1.5, 9]), frames, late_in=late_in)
    assert bool(said) == bool(word) and f"right images were {word} by" in (said or "right images were  by")


@pytest.mark.parametrize("late", [0.0, 0.3])
def test_rows_that_differ_by_the_calibration_are_no_lag_where_the_motion_is_always_the_same(late):
    """A car that drives straight on: its motion moves rows in the same way in all frames, as the calibration does."""
    said = doubt(
        late, lambda rng: np.array([0, 0, 0, 0, 0, 0.5]), ([-6, -1, 8], [6, 3, 50]), 31,
        lambda x, y: 1.0 + 3.0 * x - 4.0 * y + 2.0 * x * y,
    )  # fmt: skip
    assert ("late by" in said) if late else said == ""


def test_a_camera_that_hardly_moves_shows_no_lag():
    """Its rows, here off by the lens, and the flow by errors of its poses are alike in all frames."""
    step = np.array([1e-5, 0, 0, 0, 0, 0])
    assert doubt(0.0, lambda rng: step, ([-2, -1.5, 3], [2, 1.5, 9]), 31, lambda x, y: y * y) == ""


@pytest.mark.parametrize(("flow", "lag"), [(1.0, 0.5), (0.03, 0.0)])
def test_a_lag_counts_only_where_the_motion_moves_rows(flow, lag):
    """A board that moves before a standing camera was taken for right images of another moment."""
    columns = np.random.default_rng(0).normal(size=(8, 2, 50, 7)) * [0.1 * flow, flow, 1, 1, 1, 1, 1]
    columns[..., 0] -= 0.5 * columns[..., 1]
    sums = np.swapaxes(columns, 2, 3) @ columns
    np.testing.assert_allclose(_lags(sums, sums.sum(axis=0), 0.2), lag, atol=0.02)
