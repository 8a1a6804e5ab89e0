"""Back ends: from observations to an estimate. Choose one by name; nothing is imported before it is used."""

from __future__ import annotations

from typing import Any

from slam import registry
from slam.geometry.rig import StereoRig
from slam.interfaces import Backend


def names() -> list[str]:
    """Names of the known back ends, third-party ones included."""
    return registry.names("backends")


def create(name: str, rig: StereoRig, **options: Any) -> Backend:
    """A back end by name.

    Raises:
        UnknownNameError: no back end of this name.
        ConfigurationError: an option is unknown or out of range.
    """
    return registry.create("backends", name, rig, **options)
