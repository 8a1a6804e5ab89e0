"""Keyword options of a front end or a back end as its configuration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, TypeVar

from slam.errors import ConfigurationError
from slam.naming import unknown

_C = TypeVar("_C")


def from_options(kind: type[_C], owner: str, options: Mapping[str, Any]) -> _C:
    """A configuration, of the dataclass `kind`, from keyword options; others have their defaults.

    Args:
        kind: the dataclass; it checks its values itself.
        owner: whose options they are, for the message.
        options: by name.

    Raises:
        ConfigurationError: an option is unknown (the message lists the known ones) or out of its range.
    """
    known = [f.name for f in fields(kind)]  # type: ignore[arg-type]
    for key in options:
        if key not in known:
            raise ConfigurationError(f"{owner}: {unknown('option', key, known)}")
    return kind(**options)
