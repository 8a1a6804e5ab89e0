"""YAML that may be hostile: bounded in size, depth and length of values, and without aliases."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from slam.errors import CalibrationError
from slam.files import read_text

#: Most bytes of a calibration file. OpenCV's sample programs keep all corners of all images in it.
CALIBRATION_LIMIT = 4 * 2**20

_DEEPEST = 32
_LONGEST = 4096  # characters of a value

#: What constructing a value of an odd tag (``!!bool maybe``, ``!!int ''``, ``!!timestamp x``) raises.
_REFUSALS = (ValueError, LookupError, AttributeError, TypeError, ArithmeticError, RecursionError)


def read_calibration(path: Path) -> str:
    """A calibration file's text.

    Raises:
        CalibrationError: the file is missing, cannot be read, or is too large for a calibration.
    """
    if not path.exists():
        raise CalibrationError(f"{path}: the calibration is missing")
    return read_text(path, CALIBRATION_LIMIT, CalibrationError)


def read_yaml(path: Path) -> Mapping[str, Any]:
    """The mapping in a YAML (or JSON) file, in OpenCV's dialect, too.

    That has ``%YAML:1.0`` in its first line, ``.Nan`` and ``.Inf``, and a mark on matrices (mappings with ``data``).

    Raises:
        CalibrationError: the file is missing, no YAML, or no mapping; or it holds too much for a calibration.
    """
    import yaml

    text = read_calibration(path)
    if text.startswith("%YAML:"):
        text = "\n" + text.partition("\n")[2]  # rows keep their numbers
    text = re.sub(r"\.(Nan|Inf)\b", lambda match: match[0].lower(), text)
    try:
        _require_small(path, text)
        node = yaml.load(text, _loader())
    except (yaml.YAMLError, *_REFUSALS) as error:
        mark = getattr(error, "problem_mark", None)
        where = f", row {mark.line + 1}" if mark else ""
        raise CalibrationError(f"{path}{where}: no valid YAML") from error
    if not isinstance(node, Mapping):
        raise CalibrationError(f"{path}: no calibration in this file")
    return node


def _require_small(path: Path, text: str) -> None:
    """Raise where a file nests too deeply, holds too long a value or an alias, which may stand for gigabytes."""
    import yaml

    depth = 0
    for event in yaml.parse(text, _loader()):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        long = isinstance(event, yaml.ScalarEvent) and len(event.value) > _LONGEST
        if depth > _DEEPEST or long or isinstance(event, yaml.AliasEvent):
            what = "nested too deeply" if depth > _DEEPEST else "a value too long" if long else "no aliases are read"
            row = event.start_mark.line + 1  # type: ignore[union-attr]
            raise CalibrationError(f"{path}, row {row}: {what} for a calibration")


@lru_cache(maxsize=1)
def _loader() -> Any:
    """A safe loader, in C where that is there, that reads values with an unknown mark as if they had none."""
    import yaml

    base: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)

    class Loader(base):
        """The loader."""

    def unmarked(loader: Any, _: str, node: Any) -> Any:
        return loader.construct_mapping(node, deep=True) if isinstance(node, yaml.MappingNode) else None

    Loader.add_multi_constructor("", unmarked)
    return Loader
