"""The invariant filter: the papers' update on the Lie group of camera and map. See `backends.iekf.filter`."""

from backends.iekf.filter import IekfBackend, IekfConfig

__all__ = ["IekfBackend", "IekfConfig"]
