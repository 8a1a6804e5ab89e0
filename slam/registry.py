"""Back ends and front ends by name: imported when used, open to other packages through entry points.

Another package adds a back end with::

    [project.entry-points."slam.backends"]
    mine = "my_package.module:MyBackend"
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any

from slam.errors import UnknownNameError
from slam.naming import unknown

#: What this distribution brings, so that a plain checkout works without being installed.
BUILT_IN = {
    "backends": {
        "batch": "backends.batch:BatchBackend",
        "ekf": "backends.ekf:EkfBackend",
        "smoother": "backends.smoother:SmootherBackend",
    },
    "frontends": {"surf": "frontends.surf:SurfFrontend"},
}


@cache
def _table(role: str) -> dict[str, str]:
    """Name to ``module:attribute``; a built-in name cannot be taken over."""
    found = {point.name: point.value for point in entry_points(group=f"slam.{role}")}
    return {**found, **BUILT_IN[role]}


def names(role: str) -> list[str]:
    """Known names of a role, ``"backends"`` or ``"frontends"``, sorted."""
    return sorted(_table(role))


def resolve(role: str, name: str) -> Any:
    """The class (or factory) behind a name.

    Raises:
        UnknownNameError: the name is not known (the message lists the known ones), or its module cannot be imported.
    """
    try:
        module, _, attribute = _table(role)[name].partition(":")
    except KeyError:
        raise UnknownNameError(unknown(role[:-1].replace("end", " end"), name, names(role))) from None
    try:
        return getattr(import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise UnknownNameError(f"{role[:-1].replace('end', ' end')} {name!r} cannot be loaded: {error}") from error


def create(role: str, name: str, rig: Any, **options: Any) -> Any:
    """An instance by name, for a rig, with its options.

    Raises:
        UnknownNameError: see `resolve`.
        ConfigurationError: an option is unknown or out of its range.
    """
    return resolve(role, name)(rig, **options)
