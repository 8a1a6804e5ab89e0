"""What the documentation site is made of: pages, docstrings as its API pages read them, links of notebooks."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml

import slam
from tests.scripts import load_script

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


@pytest.mark.parametrize("package", ["slam", "frontends", "backends"])
def test_sections_of_docstrings_are_names_with_descriptions(package):
    """A strict build of the site refuses others."""
    for path in (ROOT / package).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef | ast.FunctionDef):
                for kind, rows in SECTION.findall((ast.get_docstring(node) or "") + "\n"):
                    for row in re.findall(r"^    (\S.*)", rows, re.M):
                        assert re.match(r"[\w.*]+(, [\w.*]+)*: ", row), f"{path.name}, {node.name}, {kind}: {row}"


def test_links_of_notebooks_go_to_pages_as_they_are_built():
    pytest.importorskip("mkdocs")
    from mkdocs.exceptions import PluginError
    from mkdocs.structure.files import File, Files

    hook = load_script("docs/notebook_links.py").on_page_content
    files = Files([File(name, "docs", "site", True) for name in ("guide.md", "notebooks/one.ipynb")])
    note, guide = (SimpleNamespace(file=files.get_file_from_path(name)) for name in ("notebooks/one.ipynb", "guide.md"))
    note.file.url = "notebooks/one/"
    kept = '<a href="https://a.example/b.md">, <a href="#part">'
    assert hook(f'<a href="../guide.md#run">{kept}', note, SITE, files) == f'<a href="../../guide/#run">{kept}'
    assert hook('<a href="../guide.md">', guide, SITE, files) == '<a href="../guide.md">'
    with pytest.raises(PluginError, match=r"notebooks/one.ipynb: there is no page ../none.md"):
        hook('<a href="../none.md">', note, SITE, files)
