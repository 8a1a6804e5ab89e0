"""For the site: links of notebooks go to the pages as they are built; lists of names become their documentation."""

from __future__ import annotations

import posixpath
import re
from typing import Any

from mkdocs.exceptions import PluginError

_LISTED = re.compile(r"^- \[`([\w.]+)`\]\(\.\./\.\./.*\n", re.MULTILINE)
_LINK = re.compile(r'href="([^":#]+\.(?:md|ipynb))')


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """An API page's text with mkdocstrings in place of the lines of `make_api`."""
    return _LISTED.sub(r"::: \1\n\n", markdown) if page.file.src_uri.startswith("api/") else markdown


def on_page_content(html: str, page: Any, config: Any, files: Any) -> str:
    """The page's HTML; raises where it links to no page."""
    here = page.file.src_uri
    if not here.endswith(".ipynb"):
        return html

    def built(found: re.Match[str]) -> str:
        target = files.get_file_from_path(posixpath.normpath(posixpath.join(posixpath.dirname(here), found[1])))
        if target is None:
            raise PluginError(f"{here}: there is no page {found[1]}")
        return f'href="{target.url_relative_to(page.file)}'

    return _LINK.sub(built, html)
