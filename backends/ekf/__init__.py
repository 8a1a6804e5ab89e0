"""The papers' filter: an extended Kalman filter over camera and landmarks. See `backends.ekf.filter`."""

from backends.ekf.config import EkfConfig
from backends.ekf.filter import EkfBackend

__all__ = ["EkfBackend", "EkfConfig"]
