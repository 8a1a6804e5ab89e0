"""Scripts outside of any package, as modules; the command in this process."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest
from typer.testing import CliRunner

from slam.commands.cli import app
from slam.errors import SlamError

ROOT = Path(__file__).parent.parent


def load_script(name: str) -> ModuleType:
    """The module of a file in the repository, such as ``docs/make_notebooks.py``."""
    path = ROOT / name
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, path.stem, module)  # dataclasses look their module up
        spec.loader.exec_module(module)
    return module


def command(*words: object, status: int = 0) -> str:
    """What the command ``slam`` prints, called in this process, with its exit status; an error of its own is raised."""
    done = CliRunner().invoke(app, [*map(str, words)])
    if isinstance(done.exception, SlamError):
        raise done.exception
    assert done.exit_code == status, (done.output, done.exception)
    return done.output
