"""Runs the notebooks of the documentation and saves what they show: ``python docs/make_notebooks.py``."""

from __future__ import annotations

import os
from pathlib import Path

import nbformat
from nbclient import NotebookClient

NOTEBOOKS = Path(__file__).parent / "notebooks"


def run(path: Path) -> nbformat.NotebookNode:
    """The notebook with the outputs of a new kernel in its own folder; raises where a cell does."""
    notebook = nbformat.read(path, as_version=4)
    os.environ["PYDEVD_DISABLE_FILE_VALIDATION"] = "1"  # no debugger, no warning about it
    folder = {"metadata": {"path": str(path.parent)}}
    NotebookClient(notebook, timeout=300, record_timing=False, resources=folder).execute()
    return notebook


def main() -> None:
    """Run them all in their places."""
    for path in sorted(NOTEBOOKS.glob("*.ipynb")):
        notebook = run(path)
        notebook.metadata = {key: notebook.metadata[key] for key in ("kernelspec",)}
        nbformat.write(notebook, path)
        print(path.name)


if __name__ == "__main__":
    main()
