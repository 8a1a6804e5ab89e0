from __future__ import annotations

import numpy as np
import pytest

from slam.sequences import open_sequence
from slam.worlds import open_world
from slam.worlds.export import write_euroc

WRITTEN = range(50, 58)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A world with faults, and the folder that it was written to."""
    sequence = open_world("box?frames=60&rig=toedin&dropright=53&drop=54")
    folder = tmp_path_factory.mktemp("euroc") / "run"
    told = []
    write_euroc(sequence, folder, WRITTEN.start, WRITTEN.stop, told.append)
    assert told == list(range(1, 9))
    return sequence, folder


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_an_exported_world_is_read_back_as_it_was(written):
    sequence, folder = written
    read = open_sequence(folder)
    assert read.format == "euroc"
    assert (folder / "mav0/world.txt").read_text() == f"synthetic:{sequence.name}\n"
    assert read.rig.left == sequence.rig.left and read.rig.right == sequence.rig.right
    assert np.allclose(read.rig.R, sequence.rig.R, atol=1e-15) and np.allclose(read.rig.b, sequence.rig.b, atol=1e-15)
    assert np.allclose(read.ground_truth.poses, sequence.ground_truth.poses[WRITTEN], atol=1e-8)
    assert np.allclose(read.ground_truth.stamps, sequence.stamps[WRITTEN], atol=1e-9)
    for frame, k in zip(read, WRITTEN, strict=True):
        original = sequence.frame(k)
        assert frame.stamp == pytest.approx(original.stamp, abs=1e-9)
        assert np.array_equal(frame.left, original.left)
        assert np.array_equal(frame.right, original.right) or frame.right is original.right is None
