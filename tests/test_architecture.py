"""The files that the architecture page names exist."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parent.parent


def test_the_files_that_the_page_names_exist():
    for name in re.findall(r"`([a-z_/]+\.py)`", (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")):
        assert (ROOT / name).is_file(), name
