"""Stereo SLAM with interchangeable estimators: see `slam.StereoSlam` and `slam.open_sequence`.

This package holds everything that does not depend on the front end or back end in use. Importing it loads NumPy only;
everything else is loaded when it is used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from slam.version import __version__ as __version__

if TYPE_CHECKING:
    from slam.atlas.map_io import SavedMap as SavedMap
    from slam.atlas.map_io import load_map as load_map
    from slam.atlas.map_io import save_map as save_map
    from slam.calibration.saved import SavedCalibration as SavedCalibration
    from slam.calibration.saved import load_calibration as load_calibration
    from slam.calibration.saved import save_calibration as save_calibration
    from slam.config import SystemConfig as SystemConfig
    from slam.geometry.rig import StereoRig as StereoRig
    from slam.geometry.trajectory import Trajectory as Trajectory
    from slam.run.warm_up import warm_up as warm_up
    from slam.sequences import open_sequence as open_sequence
    from slam.sequences.live import LiveFrames as LiveFrames
    from slam.sequences.rigs import load_rig as load_rig
    from slam.system import StereoSlam as StereoSlam


_PUBLIC = {
    "EstimatorModels": "slam.models",
    "Estimate": "slam.data",
    "FrameResult": "slam.data",
    "SavedCalibration": "slam.calibration.saved",
    "LiveFrames": "slam.sequences.live",
    "Observations": "slam.data",
    "PinholeCamera": "slam.geometry.camera",
    "SavedMap": "slam.atlas.map_io",
    "SlamError": "slam.errors",
    "StereoFeatures": "slam.data",
    "StereoFrame": "slam.data",
    "StereoRig": "slam.geometry.rig",
    "StereoSlam": "slam.system",
    "SystemConfig": "slam.config",
    "Trajectory": "slam.geometry.trajectory",
    "load_calibration": "slam.calibration.saved",
    "load_map": "slam.atlas.map_io",
    "load_rig": "slam.sequences.rigs",
    "open_sequence": "slam.sequences",
    "save_calibration": "slam.calibration.saved",
    "save_map": "slam.atlas.map_io",
    "warm_up": "slam.run.warm_up",
}

__all__ = sorted(_PUBLIC)


def __dir__() -> list[str]:
    """The public names, and the attributes of every module."""
    return sorted({*_PUBLIC, *(name for name in globals() if name.startswith("__"))})


def __getattr__(name: str) -> Any:
    """Load a public name when it is first asked for."""
    if name in _PUBLIC:
        return getattr(import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module 'slam' has no attribute {name!r}")
