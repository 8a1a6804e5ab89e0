import csv
import json
from dataclasses import replace

import numpy as np
import pytest

from slam.config import SystemConfig
from slam.geometry.se3 import pose, rotation
from slam.object_data import MovingObject, ObjectEstimate
from slam.run.options import RunOptions
from slam.run.run_files import RunFiles
from slam.run.runner import run
from slam.run.schema import FILES, OLD_LANDMARKS, TABLES, header
from slam.sequences import open_sequence

WORLD = "synthetic:aisle?frames=4&width=160&height=120"
PLACE = ("x", "y", "z", "roll", "pitch", "yaw")


def body(id, seed):
    """A moving body with a full covariance, all of its numbers different."""
    rng = np.random.default_rng(seed)
    A, none = rng.normal(size=(6, 12)), np.zeros(0, np.int64)
    T, motion = (pose(rotation(rng.normal(size=3) / scale), rng.normal(size=3)) for scale in (3, 9))
    e = ObjectEstimate(id, 0.1 * seed, T, A @ A.T, rng.normal(size=6), A @ A.T, bool(seed % 2), none, none)
    return MovingObject(id, none, e, motion, T, A[:2, :3], id == 1, 0.1, 0.05, 0.75)


BODIES = {2: (body(1, 1),), 3: (body(1, 2), body(4, 3))}


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    """The folder of a short run that is told of moving bodies."""
    folder = tmp_path_factory.mktemp("run")
    write = RunFiles.write_frame

    def write_frame(files, number, result, *places):
        write(files, number, replace(result, objects=BODIES.get(number, ())), *places)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RunFiles, "write_frame", write_frame)
        options = RunOptions("ekf", "surf", SystemConfig.for_kind("handheld"), folder)
        run(open_sequence(WORLD), options)
    return folder


def rows_of(path):
    """A table's rows by column; the trajectories' columns stand in the schema alone."""
    lines = path.read_text(encoding="utf-8").splitlines()
    if path.suffix == ".txt":
        return [dict(zip(header(TABLES[path.name]), line.split(), strict=True)) for line in lines]
    return list(csv.DictReader(lines))


def test_the_schema_has_every_file_and_every_column(out):
    files = json.loads((out / "schema.json").read_text(encoding="utf-8"))["files"]
    assert set(files) == set(FILES)
    for name in TABLES:
        columns, rows = files[name]["columns"], rows_of(out / name)
        if name != OLD_LANDMARKS or rows:  # so short a run may keep all its landmarks
            assert [column["name"] for column in columns] == list(rows[0])
        assert all(column["meaning"] for column in columns)


def test_rows_of_objects_are_what_the_system_said(out):
    rows = [{name: float(value) for name, value in row.items()} for row in rows_of(out / "objects.csv")]
    expected = [(number, thing) for number, things in BODIES.items() for thing in things]
    assert len(rows) == len(expected)
    for row, (number, thing) in zip(rows, expected):
        e = thing.estimate
        assert (row["frame"], row["id"], row["stamp"]) == (number, thing.id, pytest.approx(e.stamp))
        assert (row["moving"], row["measured"]) == (thing.moving, e.measured)
        assert (row["last_measured"], row["existence"]) == (0.05, 0.75)
        assert [row[c] for c in ("wx", "wy", "wz", "vx", "vy", "vz")] == pytest.approx(list(e.velocity), rel=1e-6)
        for T, prefix in ((e.T_world_object, ""), (thing.motion, "motion_")):
            numbers = np.array([row[f"{prefix}{name}"] for name in PLACE])
            np.testing.assert_allclose(numbers[:3], T[:3, 3], rtol=1e-6)
            np.testing.assert_allclose(rotation(numbers[3:]), T[:3, :3], atol=1e-7)
        upper = [row[f"c{i}{j}"] for i in range(6) for j in range(i, 6)]
        np.testing.assert_allclose(upper, e.covariance[np.triu_indices(6)], rtol=1e-6)
