"""The notebooks of the documentation run, and show what they say."""

from pathlib import Path

import pytest

from tests.scripts import load_script

nbformat = pytest.importorskip("nbformat")
pytest.importorskip("nbclient")

DOCS = Path(__file__).parent.parent / "docs"
NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.ipynb"))


def texts(notebook):
    """What the cells print and return as text, without what kernels say while they are compiled."""
    shown = []
    for cell in notebook.cells:
        for output in cell.get("outputs", []):
            if output.get("name") != "stderr":
                shown.append(output.get("text") or output["data"].get("text/plain", ""))
    return shown


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # those of the kernel's own libraries
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_run_and_show_what_is_saved(path, monkeypatch):
    root = str(DOCS.parent)
    monkeypatch.setenv("PYTHONPATH", root)
    monkeypatch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")
    saved, shown = texts(nbformat.read(path, as_version=4)), texts(load_script("docs/make_notebooks.py").run(path))
    assert len(shown) == len(saved) > 3
    assert shown[0] == saved[0]  # the sequence, the same everywhere
    assert sum("Figure" in text for text in shown) >= 2
