"""Dataclasses that hold arrays are compared and hashed by identity: generated `==` of arrays has no truth value."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import numpy as np

from slam.data import Observations
from tests.test_rooms import modules

#: Arrays by their names in annotations.
ARRAYS = {"Array", "BoolArray", "IdArray", "IndexArray", "NDArray", "ndarray"}


@cache
def dataclasses() -> dict[str, tuple[Path, ast.ClassDef, ast.expr]]:
    """All dataclasses by name, with their files and decorators."""
    found = {}
    for file in modules("slam", "backends", "frontends").values():
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            for decorator in node.decorator_list if isinstance(node, ast.ClassDef) else ():
                if ast.unparse(decorator).startswith("dataclass"):
                    found[f"{file}:{node.name}"] = (file, node, decorator)
    return found


def with_arrays() -> set[str]:
    """Keys of those that hold arrays, themselves or in others that they hold."""
    classes = dataclasses()
    words = {
        key: {
            word
            for part in node.body
            if isinstance(part, ast.AnnAssign)
            for word in re.findall(r"\w+", re.sub(r"Callable\[.*", "", ast.unparse(part.annotation)))
        }
        for key, (_, node, _) in classes.items()
    }
    names, found = set(ARRAYS), set()
    while more := {key for key in set(classes) - found if words[key] & names}:
        found |= more
        names |= {classes[key][1].name for key in more}
    return found


def test_dataclasses_of_arrays_have_no_generated_equality():
    wrong = []
    for key in sorted(with_arrays()):
        _, node, decorator = dataclasses()[key]
        own = any(isinstance(part, ast.FunctionDef) and part.name == "__eq__" for part in node.body)
        if "eq=False" not in ast.unparse(decorator) and not own:
            wrong.append(key)
    assert not wrong, "\n".join(wrong)


def test_observations_are_compared_and_hashed_by_identity():
    one, other = (Observations(np.arange(2), np.zeros((2, 2)), np.zeros((2, 2))) for _ in range(2))
    assert one == one and one != other and other not in [one] and {one: 1}[one] == 1
