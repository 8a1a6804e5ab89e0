"""The GTSAM smoother: a fixed lag of smart stereo factors. See `backends.smoother.backend`."""

from backends.smoother.backend import SmootherBackend
from backends.smoother.config import SmootherConfig

__all__ = ["SmootherBackend", "SmootherConfig"]
