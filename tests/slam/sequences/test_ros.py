"""ROS recordings of all kinds, written by rosbags itself: topics found, stamps paired, cameras calibrated."""

from pathlib import Path

import cv2
import numpy as np
import pytest

import slam
from slam.errors import CalibrationError, ConfigurationError, SequenceError
from slam.sequences.ros_bag import COMPRESSED, INFO, RAW, grey_image
from tests.bags import LEFT, R_LEFT, R_RIGHT, RIGHT, STEP, STORES, T0, D, compressed, image, info, stereo, write
from tests.recordings import FIVE, HEIGHT, WIDTH, K, picture, seeds


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    return write(tmp_path / "walk.bag", stereo(STORES[1]))


def test_messages_out_of_order_are_sorted(tmp_path: Path) -> None:
    rows = stereo(STORES[1], 8)
    times = {(LEFT, 3): 4, (LEFT, 4): 3, (RIGHT, 5): 6, (RIGHT, 6): 5}  # written in another order than taken
    numbers = {LEFT: 0, RIGHT: 0}
    for at, (topic, kind, _, message) in enumerate(rows):
        if topic in numbers:
            place = times.get((topic, numbers[topic]), numbers[topic])
            rows[at] = topic, kind, T0 + place * STEP + 1000, message
            numbers[topic] += 1
    sequence = slam.open_sequence(write(tmp_path / "a.bag", rows))
    assert seeds(sequence) == [(k, k + 10) for k in range(8)]
    assert seeds(sequence.frames(4, 7)) == [(k, k + 10) for k in range(4, 7)]
    assert sum("out of order; sorted" in line for line in sequence.warnings) == 2


@pytest.mark.parametrize("back", [2.5, 0.2])
def test_a_clock_that_is_set_back(tmp_path: Path, back: float) -> None:
    rows, store = [], STORES[1]
    for topic, kind, time, message in stereo(store, 15):
        if topic in (LEFT, RIGHT) and time > T0 + 6 * STEP:
            stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec - round(back * 1e9)
            message.header.stamp.__dict__.update(sec=stamp // 10**9, nanosec=stamp % 10**9)
        rows.append((topic, kind, time, message))
    sequence = slam.open_sequence(write(tmp_path / "a.bag", rows))
    assert seeds(sequence) == [(k, k + 10) for k in range(15)]
    assert np.allclose(np.diff(sequence.stamps), 1e-9 * STEP, atol=1e-6)
    assert any(f"the clock was set back by {back:.3f} s at message 6" in line for line in sequence.warnings)


def test_a_single_wrong_stamp_costs_its_frame(tmp_path: Path) -> None:
    rows = stereo(STORES[1], 8)
    message = [row for row in rows if row[0] == LEFT][3][3]
    message.header.stamp.__dict__.update(sec=5)
    assert [left for left, _ in seeds(slam.open_sequence(write(tmp_path / "a.bag", rows)))] == [0, 1, 2, 4, 5, 6, 7]


@pytest.mark.parametrize("kind", ["ros1", "mcap", "db3", "packed folder", "packed mcap", "single folder", "images"])
def test_every_kind_of_recording_is_found_out_and_read(kind: str, tmp_path: Path) -> None:
    version = 1 if kind == "ros1" else 2
    packed = {"packed": "FILE", "single": "MESSAGE"}.get(kind.split()[0], "")
    name = "walk.bag" if version == 1 else "walk.mcap" if kind.endswith("mcap") else "walk"
    rows, store = stereo(STORES[version]), STORES[version]
    if kind == "images":
        small = [(f"{topic}/compressed", COMPRESSED, at, compressed(store, m)) for topic, k, at, m in rows if k == RAW]
        rows = [*small, *(row for row in rows if row[1] != RAW)]
    path = write(tmp_path / name, rows, version, packed)
    if kind.endswith(("mcap", "db3")):
        (path,) = path.glob(f"*.{kind.split()[-1]}*")
    sequence = slam.open_sequence(f"{path}?kind=driving")
    assert (sequence.format, sequence.kind, len(sequence)) == ("ros", "driving", 6)
    assert seeds(sequence) == [(k, k + 10) for k in range(6)]
    assert [(f.index, *seeds([f])[0]) for f in sequence.frames(4)] == [(4, 4, 14), (5, 5, 15)]
    assert np.allclose(np.diff([f.stamp for f in sequence]), 0.05)
    assert next(iter(sequence)).stamp == pytest.approx(T0 * 1e-9, abs=1e-6)
    assert sequence.warnings == []


def test_raw_images_have_the_rig_that_the_rectified_ones_come_from(bag: Path) -> None:
    rig = slam.open_sequence(bag).rig
    points = np.array([[0.1, -0.2, 2.0], [-0.3, 0.1, 4.0]])
    for camera, R, shift in ((rig.left, R_LEFT, 0.0), (rig.right, R_RIGHT, -0.2)):
        own = (points @ R_LEFT.T + [shift, 0, 0]) @ R  # to rectified axes, to the other camera, and back
        expected = cv2.projectPoints(own, np.zeros(3), np.zeros(3), K, D)[0].reshape(-1, 2)
        pixels = rig.project(points)[0 if camera is rig.left else 1]
        assert np.allclose(pixels, expected, atol=1e-6)
    assert rig.baseline == pytest.approx(0.2)


def test_rectified_images_come_before_raw_ones_and_have_the_rig_of_p(tmp_path: Path) -> None:
    rows = stereo(STORES[1])
    rows += [(t.replace("image_raw", "image_rect"), *rest) for t, *rest in rows if t.endswith("image_raw")]
    path = write(tmp_path / "rect.bag", rows)
    rig = slam.open_sequence(path).rig
    assert rig.is_rectified
    assert (rig.left.fu, rig.left.u0, rig.baseline) == (48.0, 30.0, pytest.approx(0.2))
    assert not slam.open_sequence(f"{path}?rectified=no").rig.is_rectified


COLOURS = np.zeros((4, 6, 3), np.uint8)
COLOURS[:] = (10, 60, 200)  # blue, green, red
GREY = int(cv2.cvtColor(COLOURS, cv2.COLOR_BGR2GRAY)[2, 2])


def bayer(pattern: str) -> np.ndarray:
    value = {"b": 10, "g": 60, "r": 200}
    return np.tile(np.array([[value[pattern[0]], value[pattern[1]]], [value[pattern[2]], value[pattern[3]]]]), (2, 3))


@pytest.mark.parametrize(
    ("encoding", "pixels", "grey", "dtype"),
    [
        ("mono8", np.full((4, 6), 7, np.uint8), 7, np.uint8),
        ("mono16", np.full((4, 6), 700, np.uint16), 700, np.uint16),
        ("bgr8", COLOURS, GREY, np.uint8),
        ("rgb8", np.ascontiguousarray(COLOURS[..., ::-1]), GREY, np.uint8),
        ("bgr16", COLOURS.astype(np.uint16) * 256, 256 * GREY, np.uint16),
        *((f"bayer_{p}8", bayer(p).astype(np.uint8), GREY, np.uint8) for p in ("rggb", "bggr", "gbrg", "grbg")),
        ("bayer_rggb16", (bayer("rggb") * 256).astype(np.uint16), 256 * GREY, np.uint16),
    ],
)
def test_encodings(encoding: str, pixels: np.ndarray, grey: int, dtype: type) -> None:
    found = grey_image(image(STORES[2], T0, pixels, encoding), RAW, "/x", (6, 4))
    assert found.dtype == dtype
    assert found.shape == (4, 6)
    assert abs(int(found[2, 2]) - grey) <= 256 * (dtype == np.uint16) * (encoding != "mono16") + 1
    if dtype == np.uint16:
        swapped = grey_image(image(STORES[2], T0, pixels.byteswap(), encoding, True), RAW, "/x")
        assert np.array_equal(swapped, found)


def test_an_image_of_another_size_costs_its_frame_alone(tmp_path: Path) -> None:
    store, rows = STORES[1], stereo(STORES[1])
    third = [k for k, row in enumerate(rows) if row[0] == LEFT][2]
    rows[third] = (*rows[third][:3], image(store, T0 + 2 * STEP, picture(2)[:, :32]))
    sequence = slam.open_sequence(write(tmp_path / "hurt.bag", rows))
    assert seeds(sequence) == [(k, k + 10) for k in (0, 1, 3, 4, 5)]
    assert sequence.warnings == ["frame 2 skipped: /stereo/left/image_raw, message 2: image is 32x48, not 64x48"]


def test_topics_can_be_named_and_a_missing_one_lists_those_there_are(bag: Path) -> None:
    assert np.allclose(slam.open_sequence(f"{bag}?left={LEFT}&right={RIGHT}&fps=3").stamps, np.arange(6) / 3)
    with pytest.raises(SequenceError, match=rf"/stereo/lft/image_raw: there is none .*mean '{LEFT}'.*{LEFT}, {RIGHT}"):
        slam.open_sequence(f"{bag}?left=/stereo/lft/image_raw&right={RIGHT}")
    with pytest.raises(ConfigurationError, match="left and right are the same topic"):
        slam.open_sequence(f"{bag}?left={LEFT}&right={LEFT}")
    for option in ("unit=cm", "fisheye=yes"):  # camera messages are in metres, and name their lenses
        with pytest.raises(ConfigurationError, match=r"does nothing with .*camera_info, which is ROS's"):
            slam.open_sequence(f"{bag}?{option}")


def test_depth_images_and_other_cameras_are_no_stereo_pair(tmp_path: Path) -> None:
    store, rows = STORES[1], stereo(STORES[1])
    depth = image(store, T0, np.zeros((HEIGHT, WIDTH), np.uint16), "16UC1")
    rows += [("/depth/camera_info", INFO, T0, info(store, 0.0)), ("/depth/image_rect", RAW, T0, depth)]
    rows += [("/colour/camera_info", INFO, T0, info(store, 0.0, width=2 * WIDTH))]
    rows += [("/colour/image_raw", RAW, T0, image(store, T0, np.zeros((HEIGHT, 2 * WIDTH), np.uint8)))]
    assert seeds(slam.open_sequence(write(tmp_path / "many.bag", rows)).frames(0, 1)) == [(0, 10)]
    rows += [
        ("/twin/camera_info", INFO, T0, info(store, 0.0)),
        ("/twin/image_raw", RAW, T0, image(store, T0, picture(3))),
    ]
    with pytest.raises(
        SequenceError, match=rf"several stereo pairs, choose one: left={LEFT}&right={RIGHT}; left=/twin"
    ):
        slam.open_sequence(write(tmp_path / "more.bag", rows))


def test_one_topic_with_both_images_side_by_side(tmp_path: Path) -> None:
    store = STORES[1]
    rows = [
        ("/zed/image", RAW, T0 + k * STEP, image(store, T0 + k * STEP, np.hstack([picture(k), picture(k + 10)])))
        for k in range(6)
    ]
    path = write(tmp_path / "zed.bag", rows)
    (tmp_path / "five.yaml").write_text(FIVE)
    for named in ("", "&left=/zed/image"):
        sequence = slam.open_sequence(f"{path}?layout=sbs&calibration=five.yaml{named}")
        assert (sequence.rig.width, sequence.rig.height) == (WIDTH, HEIGHT)
        assert seeds(sequence) == [(k, k + 10) for k in range(6)]
        assert np.diff(sequence.stamps) == pytest.approx(1e-9 * STEP, abs=1e-6)
    two = write(tmp_path / "two.bag", stereo(store))
    with pytest.raises(SequenceError, match=rf"several topics of images, choose one: left={LEFT}; left={RIGHT}"):
        slam.open_sequence(f"{two}?layout=sbs&calibration=five.yaml")


def test_without_camera_messages_a_calibration_file_and_names_decide(tmp_path: Path) -> None:
    rows = [row for row in stereo(STORES[1]) if row[1] == RAW]
    rows = [(t.replace("/stereo/left", "/cam0").replace("/stereo/right", "/cam1"), *rest) for t, *rest in rows]
    path = write(tmp_path / "euroc.bag", rows)
    with pytest.raises(SequenceError, match=r"no stereo pair: add left=/….* of /cam0/image_raw, /cam1/image_raw, and"):
        slam.open_sequence(path)
    with pytest.raises(CalibrationError, match=r"no /cam0/camera_info for /cam0/image_raw \(there are none\): add cal"):
        slam.open_sequence(f"{path}?left=/cam0/image_raw&right=/cam1/image_raw")
    (tmp_path / "five.yaml").write_text(FIVE)
    sequence = slam.open_sequence(f"{path}?calibration=five.yaml")
    assert sequence.rig.baseline == pytest.approx(0.2)
    assert seeds(sequence) == [(k, k + 10) for k in range(6)]
