from __future__ import annotations

import sys
from types import SimpleNamespace

import numpy as np
import pytest

from slam.config import SystemConfig
from slam.errors import SlamError
from slam.run.options import RunOptions
from slam.run.runner import run
from slam.run.viewer import Viewer, view_run
from slam.sequences import open_sequence


def test_without_rerun_one_line_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(SlamError, match=r"pip install 'surf-stereo-slam\[viewer\]'"):
        Viewer(str(tmp_path / "a.rrd"))


def test_without_a_display_one_line_says_what_to_do(monkeypatch):
    monkeypatch.setattr("slam.run.viewer._rerun", SimpleNamespace)
    monkeypatch.setattr("sys.platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(SlamError, match=r"no display for a window; give a file, such as run\.rrd"):
        Viewer("live")


class Unreachable:
    """A recording whose viewer has gone."""

    def log(self, *_, **__):
        pass

    def flush(self):
        raise RuntimeError("\nno connection\nsee the manual")


def test_a_window_that_was_closed_takes_nothing_from_the_run(monkeypatch, caplog):
    monkeypatch.setattr("slam.run.viewer._rerun", lambda: SimpleNamespace(ViewCoordinates=SimpleNamespace(RDF=None)))
    monkeypatch.setattr("slam.run.viewer._open", lambda rr, target: Unreachable())
    with Viewer("live"):
        pass
    assert caplog.messages == ["viewer live: not all was shown: no connection"]
    with pytest.raises(SlamError, match=r"a\.rrd: no connection$"), Viewer("a.rrd"):
        pass
    with pytest.raises(ZeroDivisionError), Viewer("a.rrd"):  # what went wrong first is what is said
        1 / 0  # noqa: B018


def test_places_and_loops_are_shown(monkeypatch):
    logged = {}
    shapes = SimpleNamespace(
        ViewCoordinates=SimpleNamespace(RDF=None),
        Points3D=lambda points, **_: points,
        LineStrips3D=lambda strips, **_: strips,
    )
    recording = SimpleNamespace(log=lambda path, what, static: logged.update({path: what}), flush=lambda: None)
    monkeypatch.setattr("slam.run.viewer._rerun", lambda: shapes)
    monkeypatch.setattr("slam.run.viewer._open", lambda rr, target: recording)
    at = np.arange(12.0).reshape(4, 3)
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, :3, 3] = at
    atlas = SimpleNamespace(
        poses_in_map=lambda: poses, prior_count=1, loops=(SimpleNamespace(first=0, second=3),), refused=((1, 2), (0, 2))
    )
    with Viewer("live") as viewer:
        viewer._draw_places(SimpleNamespace(atlas=atlas))
    np.testing.assert_array_equal(logged["world/places/keyframes"], at)
    np.testing.assert_array_equal(logged["world/places/path"], [at[1:]])
    np.testing.assert_array_equal(logged["world/places/loops_closed"], at[[[0, 3]]])
    np.testing.assert_array_equal(logged["world/places/loops_refused"], at[[[1, 2], [0, 2]]])


@pytest.mark.filterwarnings("default")  # Rerun's own
def test_a_run_is_kept_for_rerun(tmp_path):
    pytest.importorskip("rerun")
    sequence = open_sequence("synthetic:aisle?frames=3")
    live, after = tmp_path / "live.rrd", tmp_path / "after.rrd"
    options = RunOptions("ekf", "surf", SystemConfig.for_kind("handheld"), tmp_path / "run")
    with Viewer(str(live), sequence.rig, sequence.ground_truth) as viewer:
        run(sequence, options, watches=[viewer.show])
    view_run(tmp_path / "run", str(after))
    assert live.stat().st_size > 3 * 3000  # three images, compressed, are in it
    assert after.stat().st_size > 1000
