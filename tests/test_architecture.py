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


def test_the_table_is_current(architecture):
    text = (ROOT / architecture.PAGE).read_text(encoding="utf-8")
    assert text == architecture.page(text, ROOT), "run: python docs/make_architecture.py"


def test_the_files_that_the_page_names_exist():
    for name in re.findall(r"`([a-z_/]+\.py)`", (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")):
        assert (ROOT / name).is_file(), name
