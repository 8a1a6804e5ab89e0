"""What a package index and a citing reader are told: versions agree, links lead somewhere, extras exist."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
import yaml

import slam

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def test_the_citation_has_this_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == slam.__version__
    assert citation["license"] == PROJECT["project"]["license"]
    assert citation["repository-code"] == PROJECT["project"]["urls"]["Repository"]


def test_the_changelog_has_a_date_for_every_release():
    headings = re.findall(r"^## (.*)$", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.M)
    first, *releases = [h for h in headings if h != "Unreleased"]
    for heading in (first, *releases):
        assert re.fullmatch(r"\d+\.\d+\.\d+ - \d{4}-\d{2}-\d{2}", heading), heading
    if "dev" not in slam.__version__:
        assert first.startswith(f"{slam.__version__} ")


@pytest.mark.parametrize("folder", ["slam", "frontends", "backends", "docs"])
def test_extras_that_are_named_exist(folder):
    extras = {"", *PROJECT["project"]["optional-dependencies"]}
    for path in [*(ROOT / folder).rglob("*.py"), *(ROOT / folder).rglob("*.md")]:
        for named in re.findall(r"pip install '\S*\[([\w,-]+)\]'", path.read_text(encoding="utf-8")):
            assert set(named.split(",")) <= extras, path
