"""The picture of the rooms and their imports is that of the code as it is."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.scripts import load_script

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def architecture():
    return load_script("docs/make_architecture.py")


@pytest.fixture
def tree(tmp_path):
    """A small code base: `a` imports `b`, both import from `slam`, and a back end imports all."""
    texts = {
        "slam/__init__.py": '"""The core.\n\nMore."""\n',
        "slam/data.py": "",
        "slam/system.py": "from slam.a import thing\n",
        "slam/a/__init__.py": '"""What a is for.\n\nMore."""\n',
        "slam/a/thing.py": "import slam.b.deep.thing\nfrom slam import data\nfrom slam.c import x\n",
        "slam/b/__init__.py": "",
        "slam/b/deep/thing.py": "def f():\n    from ...c import y\n",
        "slam/c/__init__.py": "x = y = 0\n",
        "slam/pictures/a.png": "",
        "frontends/__init__.py": "",
        "backends/__init__.py": "from slam import a, b, system\nimport numpy\n",
    }
    for name, text in texts.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


def test_the_picture_is_current(architecture):
    drawn = (ROOT / architecture.PICTURE).read_text(encoding="utf-8")
    assert drawn == architecture.picture(ROOT), "run: python docs/make_architecture.py"


def test_the_table_is_current(architecture):
    text = (ROOT / architecture.PAGE).read_text(encoding="utf-8")
    assert text == architecture.page(text, ROOT), "run: python docs/make_architecture.py"


def test_the_files_that_the_page_names_exist():
    for name in re.findall(r"`([a-z_/]+\.py)`", (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")):
        assert (ROOT / name).is_file(), name


def test_imports_are_found_wherever_they_stand(architecture, tree):
    assert set(architecture.imports(tree)) == {
        ("slam", "a"), ("a", "slam"), ("a", "b"), ("a", "c"), ("b", "c"),
        ("backends", "a"), ("backends", "b"), ("backends", "slam"),
    }  # fmt: skip


def test_an_arrow_that_a_chain_implies_is_left_out(architecture):
    assert architecture.reduced({("a", "b"), ("b", "c"), ("a", "c")}) == {("a", "b"), ("b", "c")}


def test_rooms_stand_above_what_they_import_and_a_circle_side_by_side(architecture):
    level = architecture.layers("abcd", {("a", "b"), ("b", "c"), ("c", "b"), ("c", "d")})
    assert level == {"d": 0, "b": 1, "c": 1, "a": 2}


def test_a_circle_is_drawn_in_red(architecture, tree):
    assert architecture.WRONG not in architecture.picture(tree).partition("</defs>")[2]
    (tree / "slam/c/__init__.py").write_text("import slam.b\n")
    assert architecture.WRONG in architecture.picture(tree).partition("</defs>")[2]


def test_duties_are_first_lines(architecture, tree):
    table = architecture.table(tree)
    assert "| `slam` | The core. | `a` |" in table
    assert "| `a` | What a is for. | `slam`, `b`, `c` |" in table
    assert "| `b` | – | `c` |" in table
