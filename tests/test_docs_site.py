"""What the documentation site is made of: pages, docstrings as its API pages read them, links of notebooks."""

from __future__ import annotations

import re
from pathlib import Path

import yaml

import slam

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
SITE = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))


def files_of(nav):
    """Files that the navigation names, at any depth."""
    if isinstance(nav, str):
        return {nav}
    return set().union(*map(files_of, nav.values() if isinstance(nav, dict) else nav))


def test_the_navigation_names_every_page():
    pages = {path.relative_to(DOCS).as_posix() for end in ("md", "ipynb") for path in DOCS.rglob(f"*.{end}")}
    assert {name for name in files_of(SITE["nav"]) if not name.startswith("https:")} == pages


def test_every_public_name_is_on_an_api_page():
    pages = "\n".join(path.read_text(encoding="utf-8") for path in (DOCS / "api").glob("*.md"))
    modules = re.findall(r"^::: (\S+)$", pages, re.M)
    for name in slam.__all__:
        assert getattr(slam, name).__module__ in modules, name


SECTION = re.compile(r"^(Args|Attributes|Raises):\n((?:    .*\n|\n(?=    ))+)", re.M)
