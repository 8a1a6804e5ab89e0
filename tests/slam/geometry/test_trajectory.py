"""Trajectories: what is written is read again, by us and by evo; malformed files are refused with their name."""

from pathlib import Path

import numpy as np
import pytest
from evo.tools import file_interface
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from slam.errors import TrajectoryError
from slam.geometry.se3 import exp, rotation_angle
from slam.geometry.trajectory import Trajectory

#: Files have nine decimals; a quaternion rounded so turns by at most 2 · sqrt(4) · 0.5e-9 rad.
POSITION, ANGLE = 0.51e-9, 2.1e-9


@st.composite
def trajectories(draw: st.DrawFn) -> Trajectory:
    """Paths with any steps in time, turns up to half a revolution, and epochs from 0 to today's nanoseconds."""
    count = draw(st.integers(1, 8))
    start = draw(st.sampled_from([0.0, 17.25, 1_403_715_273.262143, 1.7e9]))
    steps = draw(st.lists(st.floats(0.001, 5), min_size=count, max_size=count))
    rows = st.lists(st.floats(-1, 1), min_size=6, max_size=6)
    xi = np.array(draw(st.lists(rows, min_size=count, max_size=count)))
    xi[:, :3] *= np.pi / np.sqrt(3)
    xi[:, 3:] *= 1e4
    return Trajectory(start + np.cumsum(steps), exp(xi))


def assert_same(read: Trajectory, written: Trajectory) -> None:
    assert np.abs(read.stamps - written.stamps).max() <= 3e-7  # a double's step at 1.7e9 s is 2.4e-7 s
    assert np.abs(read.positions - written.positions).max() <= POSITION
    turn = np.swapaxes(read.poses[:, :3, :3], 1, 2) @ written.poses[:, :3, :3]
    assert rotation_angle(turn).max() <= ANGLE + 1e-15 * len(turn)
    assert np.allclose(np.linalg.det(read.poses[:, :3, :3]), 1, atol=1e-8)


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(trajectories())
def test_tum_and_euroc_come_back(tmp_path: Path, trajectory: Trajectory) -> None:
    trajectory.write_tum(tmp_path / "a.txt")
    assert_same(Trajectory.read_tum(tmp_path / "a.txt"), trajectory)
    trajectory.write_euroc(tmp_path / "a.csv")
    assert_same(Trajectory.read_euroc(tmp_path / "a.csv"), trajectory)


def test_evo_reads_what_is_written(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    trajectory = Trajectory(1.4e9 + np.arange(20) / 20, exp(rng.normal(size=(20, 6))))
    trajectory.write_tum(tmp_path / "tum.txt")
    trajectory.write_kitti(tmp_path / "kitti.txt")
    trajectory.write_euroc(tmp_path / "euroc.csv")
    tum = file_interface.read_tum_trajectory_file(str(tmp_path / "tum.txt"))
    euroc = file_interface.read_euroc_csv_trajectory(str(tmp_path / "euroc.csv"))
    kitti = file_interface.read_kitti_poses_file(str(tmp_path / "kitti.txt"))
    for theirs in (tum, euroc, kitti):
        assert np.abs(np.array(theirs.poses_se3) - trajectory.poses).max() < 1e-8
    for theirs in (tum, euroc):
        assert np.abs(theirs.timestamps - trajectory.stamps).max() < 3e-7


READERS = [
    (Trajectory.read_tum, "1 0 0 0 0 0 0 2"),
    (Trajectory.read_kitti, "1 0 0 0 0 1 0 0 0 0 1 0"),
    (Trajectory.read_euroc, "1,0,0,0,2,0,0,0"),
]


@pytest.mark.parametrize(("read", "row"), READERS, ids=["tum", "kitti", "euroc"])
@pytest.mark.parametrize(
    "content", ["", "hello\n", "1 2 3\n", "1,2,3\n", "{row}\n{row} x\n", "{cut}\n", "{cut} nan\n", "{cut},inf\n", None]
)
def test_a_malformed_file_is_refused_with_its_name(read, row: str, content: str | None, tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text(row + "\n")
    np.testing.assert_array_equal(read(path).poses, np.eye(4)[None])  # whatever the length of a quaternion
    path.write_bytes(bytes(range(256)) if content is None else content.format(row=row, cut=row[:-2]).encode())
    for wrong in (path, tmp_path, tmp_path / "nowhere.txt"):
        with pytest.raises(TrajectoryError) as error:
            read(wrong)
        assert str(wrong) in str(error.value) and "\n" not in str(error.value)


def test_time_must_increase_and_shapes_must_fit(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n")
    with pytest.raises(TrajectoryError, match=r"a\.txt: .*time does not increase at row 2"):
        Trajectory.read_tum(tmp_path / "a.txt")
    with pytest.raises(TrajectoryError, match="2 stamps"):
        Trajectory(np.arange(2.0), np.tile(np.eye(4), (3, 1, 1)))
