"""What a notebook shows of an object: one short line, and a small picture of paths and sequences."""

from __future__ import annotations

import base64
import re
import xml.etree.ElementTree as ElementTree

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure

import backends
import slam
from slam.geometry.se3 import pose
from slam.geometry.trajectory import Trajectory
from slam.run.schema import LANDMARK_TABLE, header
from slam.sequences.base import RecordedSequence


@pytest.fixture(scope="module")
def sequence():
    return slam.open_sequence("synthetic:aisle?frames=4&width=160&height=120")


@pytest.fixture(scope="module")
def system(sequence):
    found = slam.StereoSlam(sequence.rig, None, "ekf")
    found.results = [found.process_features(sequence.observations(k)) for k in range(len(sequence))]
    return found


def test_every_line_is_short_and_says_what_matters(sequence, system):
    result = system.results[-1]
    prediction = backends.create("ekf", sequence.rig).predict(0.0)
    shown = {
        type(thing).__name__: repr(thing)
        for thing in (
            sequence, sequence.frame(0), sequence.rig, sequence.observations(0), system.estimate(), result,
            result.report, system.landmarks, system.trajectory(), system.snapshot(), prediction,
            slam.Observations.empty(), system, system.calibration.kept(), system.calibration.kept().posterior,
        )
    }  # fmt: skip
    for name, text in shown.items():
        assert text.startswith(f"{name}("), text
        assert len(text) < 200 and "\n" not in text and "array(" not in text, text
    assert "4 frames" in shown["WorldSequence"] and "160x120" in shown["WorldSequence"]
    assert f"{len(result.matched)} of {result.predicted} landmarks matched" in shown["FrameResult"]
    assert f"{len(system.landmarks)} landmarks" in shown["Estimate"]
    assert shown["Trajectory"].startswith("Trajectory(4 poses, 0.100 s, ")
    assert shown["StereoSlam"] == f"StereoSlam(no front end, EkfBackend, 4 frames, {len(system.landmarks)} landmarks)"
    assert "covariance=6x6" in shown["Prediction"]
    assert shown["Observations"] == "Observations(0 landmarks, 0 with a right pixel)"


def test_a_moving_object_says_where_it_is_and_how_fast():
    estimate = slam.object_data.ObjectEstimate(
        3, 0.0, pose(np.eye(3), np.array([1, 2, 3.0])), np.eye(6), np.array([0, 0, 0, 3, 4, 0.0]), np.eye(6), True,
        np.zeros(0, int), np.zeros(0, int),
    )  # fmt: skip
    found = slam.object_data.MovingObject(3, np.arange(7), estimate, np.eye(4), np.eye(4), np.zeros((2, 3)), True)
    assert repr(found) == "MovingObject(3, at (1.000, 2.000, 3.000) m, 5.00 m/s, 7 features)"


def test_the_public_names_are_offered():
    offered = {name for name in dir(slam) if not name.startswith("_")}
    assert set(slam.__all__) <= offered
    assert not offered & {"Any", "TYPE_CHECKING", "import_module", "annotations"}
    assert "__version__" in dir(slam)


def test_a_path_is_drawn_where_it_reaches_farthest():
    positions = np.column_stack([np.linspace(0, 4, 900), np.zeros(900), np.linspace(0, 2, 900)])
    path = Trajectory(np.arange(900.0), pose(np.tile(np.eye(3), (900, 1, 1)), positions))
    svg = ElementTree.fromstring(re.search(r"<svg.*</svg>", path._repr_html_())[0])
    points = np.array([pair.split(",") for pair in svg[0].get("points").split()], float)
    assert len(points) == 400
    np.testing.assert_allclose(points[[0, -1]], [[10, 107.5], [140, 42.5]])  # to the right and up, both on one scale
    assert "svg" not in Trajectory.empty()._repr_html_()
    assert Trajectory.empty().plot(Figure().add_subplot()).lines
    axis = path.plot(Figure().add_subplot(), label="mine")
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("x [m]", "z [m]")
    np.testing.assert_array_equal(axis.lines[0].get_ydata(), positions[:, 2])
    assert axis.lines[0].get_label() == "mine"
    assert path.plot(Figure().add_subplot(), "yx").get_ylabel() == "x [m]"
    with pytest.raises(slam.SlamError, match="two of x, y and z"):
        path.plot(Figure().add_subplot(), "top")


def test_a_new_figure_where_no_axis_is_given():
    import matplotlib.pyplot as plt

    before = plt.get_backend()
    plt.switch_backend("agg")
    try:
        assert Trajectory(np.arange(2.0), np.tile(np.eye(4), (2, 1, 1))).plot().figure.number in plt.get_fignums()
    finally:
        plt.close("all")
        plt.switch_backend(before)


def test_a_sequence_shows_its_first_image(sequence, tmp_path):
    html = sequence._repr_html_()
    png = base64.b64decode(re.search(r"base64,([^\"]+)", html)[1])
    assert cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED).shape[:2] == (150, 200)
    assert "<svg" in html


def test_a_recording_without_a_readable_image_shows_its_line(tmp_path):
    file = cv2.FileStorage(str(tmp_path / "calibration.yaml"), cv2.FILE_STORAGE_WRITE)
    K = np.array([[100.0, 0, 32], [0, 100, 24], [0, 0, 1]])
    for name, value in {"M1": K, "D1": np.zeros(5), "M2": K, "D2": np.zeros(5), "R": np.eye(3)}.items():
        file.write(name, value)
    file.write("T", np.array([-0.1, 0, 0]))
    file.release()
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
        for k in range(2):
            cv2.imwrite(str(tmp_path / side / f"{k}.png"), np.full((48, 64), 99, np.uint16))
    recording = slam.open_sequence(f"{tmp_path}?fps=10")
    assert isinstance(recording, RecordedSequence)
    assert "folders, handheld, 2 frames, 0.10 s, 64x48, no ground truth" in repr(recording)
    assert "<img" in recording._repr_html_()
    (tmp_path / "left" / "0.png").write_bytes(b"")
    assert "<img" not in recording._repr_html_()


def test_an_estimate_as_a_table_has_the_columns_of_the_file(system):
    table = system.estimate().to_table()
    assert [name for name in header(LANDMARK_TABLE) if name in table] == list(table)
    assert set(header(LANDMARK_TABLE)) - set(table) == {"seen", "last_seen"}
    assert {len(column) for column in table.values()} == {len(system.landmarks)}
    np.testing.assert_array_equal(table["cxz"], system.estimate().covariances[:, 0, 2])
