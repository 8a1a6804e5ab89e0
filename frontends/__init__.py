"""Front ends: they turn a pair of images into features. See `slam.interfaces.Frontend`."""

from __future__ import annotations

from typing import Any

from slam import registry
from slam.geometry.rig import StereoRig
from slam.interfaces import Frontend

__all__ = ["create", "names"]


def create(name: str, rig: StereoRig, **options: Any) -> Frontend:
    """A front end by name for a rig, with its options.

    Raises:
        UnknownNameError: the name is not known; the message lists the known ones.
        ConfigurationError: an option is unknown or out of its range.
    """
    frontend: Frontend = registry.create("frontends", name, rig, **options)
    return frontend


def names() -> list[str]:
    """The known names."""
    return registry.names("frontends")
