"""YAML that may be hostile: bounded in depth, in the number of values, and in what aliases make of them."""

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
_VALUES = 100_000  # most values, aliases written out
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
    loader = _loader()
    try:
        _require_small(path, text)
        root = yaml.compose(text, loader)
        if root is not None and _written_out(root, {}) > _VALUES:
            raise CalibrationError(f"{path}: its aliases stand for more than {_VALUES} values")
        node = None if root is None else yaml.load(text, loader)
    except (yaml.YAMLError, *_REFUSALS) as error:
        mark = getattr(error, "problem_mark", None)
        where = f", row {mark.line + 1}" if mark else ""
        raise CalibrationError(f"{path}{where}: no valid YAML") from error
    if not isinstance(node, Mapping):
        raise CalibrationError(f"{path}: no calibration in this file")
    return node


def _require_small(path: Path, text: str) -> None:
    """Raise where a file nests too deeply or holds too many values, before any is kept."""
    import yaml

    depth = values = 0
    for event in yaml.parse(text, _loader()):
        if isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
            continue
        values += 1
        depth += isinstance(event, yaml.CollectionStartEvent)
        long = isinstance(event, yaml.ScalarEvent) and len(event.value) > _LONGEST
        if depth > _DEEPEST or values > _VALUES or long:
            what = "nested too deeply" if depth > _DEEPEST else "a value too long" if long else "too many values"
            row = event.start_mark.line + 1  # type: ignore[union-attr]
            raise CalibrationError(f"{path}, row {row}: {what} for a calibration")


def _written_out(node: Any, known: dict[int, int]) -> int:
    """Number of values of a node with its aliases written out, stopped a little above the limit.

    Raises:
        RecursionError: it holds itself.
    """
    import yaml

    if isinstance(node, yaml.ScalarNode):
        return 1
    key = id(node)
    if key in known:
        if known[key] < 0:
            raise RecursionError("a value holds itself")
        return known[key]
    known[key] = -1
    children = [part for pair in node.value for part in pair] if isinstance(node, yaml.MappingNode) else node.value
    total = 1
    for child in children:
        total = min(total + _written_out(child, known), _VALUES + 1)
    known[key] = total
    return total


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
