"""The window back end: the last poses and their landmarks, solved together. See `backends.window.backend`."""

from backends.window.backend import WindowBackend
from backends.window.state import WindowConfig

__all__ = ["WindowBackend", "WindowConfig"]
