"""Runs in the Rerun viewer: images, features, map with ellipsoids, path and objects on one time line.

Rerun is an optional dependency (``pip install rerun-sdk``), loaded when a viewer is made.
"""

from __future__ import annotations

import logging
import os
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from slam.data import FrameResult, StereoFrame
from slam.errors import SlamError, one_line, text_of
from slam.files import noting_inputs, require_utf8
from slam.geometry.rig import StereoRig
from slam.geometry.se3 import Array, inverse, quaternion
from slam.geometry.trajectory import Trajectory
from slam.outputs import Output, require_outputs
from slam.run.run_data import RunData
from slam.run.schema import body_colour
from slam.system import StereoSlam

LIVE = "live"

_SIGMAS = 2.0
_SEEN, _UNSEEN, _NEW, _PATH, _TRUTH = (40, 53, 147), (159, 168, 218), (255, 235, 59), (21, 101, 192), (120, 120, 120)
_MEASURED = (0, 230, 118)  # in images
_CLOSED, _MOVING = (142, 36, 170), (255, 145, 0)
_MAP_EVERY = 10  # frames between two pictures of the whole map, whose covariances take their time


class Viewer:
    """Shows a run in a window (`LIVE`), or keeps it in an ``.rrd`` file; a context manager.

    Without `rig` no images are shown. Raises SlamError where Rerun is not installed, the window cannot be opened, or
    the file not be written.
    """

    def __init__(self, target: str, rig: StereoRig | None = None, truth: Trajectory | None = None) -> None:
        try:
            self.rr = import_module("rerun")
        except ImportError as error:
            raise SlamError("the viewer needs Rerun: pip install '.[viewer]' in the checkout, or rerun-sdk") from error
        self._target, self._rig, self._truth = target, rig, truth
        self._recording = _open(self.rr, target)
        self._stamps: list[float] = []
        self._path: list[Array] = []
        self.log("", self.rr.ViewCoordinates.RDF, static=True)

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            self._recording.flush()
        except RuntimeError as error:  # a window that was closed or never opened takes nothing from the run
            if kind is None and self._target != LIVE:
                raise SlamError(f"viewer {self._target}: {one_line(text_of(error))}") from error
            logging.getLogger(__name__).warning(
                "viewer %s: not all was shown: %s", self._target, one_line(text_of(error))
            )

    def show(self, frame: StereoFrame, result: FrameResult, system: StereoSlam) -> None:
        """One more frame, right after its step."""
        rr, e, pixels = self.rr, result.estimate, result.features.uv_left
        if self._truth is not None and not self._path:  # placed by the first pose
            at = int(np.argmin(np.abs(self._truth.stamps - e.stamp)))
            placed = e.T_world_left @ inverse(self._truth.poses[at]) @ self._truth.poses
            self.log("/truth", rr.LineStrips3D([placed[:, :3, 3]], colors=_TRUTH), static=True)
        self.show_pose(frame.index, e.stamp, e.T_world_left)
        image = frame.left if frame.left.ndim == 2 else frame.left[..., 2::-1]
        if image.dtype == np.uint8 and self._rig is not None:
            self.log("/camera/image", rr.Image(image).compress(jpeg_quality=80))
        for name, rows, colour in (
            ("measured", result.matched_features, _MEASURED),
            ("new", result.added_features, _NEW),
            ("moving", result.moving_features, _MOVING),
        ):
            self.log(f"/camera/image/{name}", rr.Points2D(pixels[rows], colors=colour, radii=2.0))
        for body in result.objects:
            T, box = body.estimate.T_world_object, {"centers": [body.extent.mean(axis=0)]}
            self.log(f"/objects/{body.id}", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
            box["half_sizes"] = [np.ptp(body.extent, axis=0) / 2]
            self.log(f"/objects/{body.id}/box", rr.Boxes3D(**box, colors=body_colour(body.id)))
        if result.keyframe and system.atlas.loops:
            ends = np.array([(loop.first, loop.second) for loop in system.atlas.loops])
            self.log("/loops", rr.LineStrips3D(system.atlas.poses_in_map[ends, :3, 3], colors=_CLOSED))
        if result.index % _MAP_EVERY == 0:
            whole = system.estimate()
            self.show_map(whole.positions, whole.covariances, np.isin(whole.ids, result.matched))

    def show_map(self, positions: Array, covariances: Array, seen: np.ndarray) -> None:
        """Landmarks (N, 3) with the 2σ ellipsoids of their covariances (N, 3, 3), dark where they are seen."""
        values, vectors = np.linalg.eigh(covariances.reshape(-1, 3, 3))
        vectors *= np.sign(np.linalg.det(vectors))[:, None, None]
        half, turned = _SIGMAS * np.sqrt(np.maximum(values, 0)), quaternion(vectors)
        for name, rows, colour in (("seen", seen, _SEEN), ("not_seen", ~seen, _UNSEEN)):
            shape = {"centers": positions[rows], "half_sizes": half[rows], "quaternions": turned[rows]}
            self.log(f"/map/{name}", self.rr.Ellipsoids3D(**shape, colors=colour))

    def show_pose(self, number: int, stamp: float, T_world_left: Array) -> None:
        """The camera alone."""
        rr = self.rr
        self._stamps.append(stamp)
        self._path.append(T_world_left[:3, 3])
        self._recording.set_time("frame", sequence=number)
        self._recording.set_time("time", duration=stamp - self._stamps[0])
        self.log("/camera", rr.Transform3D(translation=T_world_left[:3, 3], mat3x3=T_world_left[:3, :3]))
        if self._rig is not None:
            left = self._rig.left
            size = {"resolution": [left.width, left.height], "image_plane_distance": 0.2}
            self.log("/camera/image", rr.Pinhole(image_from_camera=left.K, **size))
        self.log("/path", rr.LineStrips3D([np.array(self._path)], colors=_PATH))

    def log(self, path: str, what: Any, static: bool = False) -> None:
        """Show something at its place below the world."""
        self._recording.log(f"world{path}", what, static=static)


def outputs(target: str | None, option: str) -> list[Output]:
    """The file that a `Viewer` writes; none where it opens a window, or there is none."""
    return [] if target in (None, LIVE) else [Output(Path(target), option)]


def view_run(folder: Path, target: str, overwrite: bool = False) -> None:
    """Show a finished run from its files: path, where bodies were, and the map at its end; it has no images.

    Raises SlamError where the folder does not hold a finished run, and as `Viewer` does.
    """
    with noting_inputs() as inputs:
        run = RunData.read(folder, folder.name)
    require_outputs(outputs(target, "--to"), inputs, overwrite)
    with Viewer(target) as viewer:
        for number, (stamp, pose) in enumerate(zip(run.online.stamps, run.online.poses)):
            viewer.show_pose(number, float(stamp), pose)
        for name, places in run.bodies.items():
            viewer.log(f"/objects/{name}", viewer.rr.Points3D(places, colors=body_colour(int(name)), radii=0.03))
        viewer.show_map(run.positions, run.covariances, run.seen_last)


def _open(rr: Any, target: str) -> Any:
    """A recording stream into a window or a file."""
    if target == LIVE and sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys():
        raise SlamError(
            "viewer live: there is no display for a window; give a file, such as run.rrd, in place of live, "
            "and open it where there is one: rerun run.rrd"
        )
    recording = rr.RecordingStream("surf-stereo-slam")
    try:
        if target == LIVE:
            recording.spawn()
        else:
            require_utf8(Path(target))
            Path(target).parent.mkdir(parents=True, exist_ok=True)
            recording.save(target)
    except (OSError, RuntimeError) as error:
        raise SlamError(f"viewer {target}: {one_line(text_of(error))}") from error
    return recording
