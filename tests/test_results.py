from __future__ import annotations

from pathlib import Path

import pytest

from tests.scripts import load_script

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def results():
    return load_script("experiments/results.py")


@pytest.fixture
def scripts(results, tmp_path, monkeypatch):
    """Three scripts: one that works, one that fails, one that is missing."""
    folder = tmp_path / "experiments"
    folder.mkdir()
    (folder / "good.py").write_text(
        '"""What is\nshown.\n\nMore."""\n'
        "import sys\nfrom pathlib import Path\nout = Path(sys.argv[sys.argv.index('--out') + 1])\n"
        "(out / 'a.png').write_bytes(b'picture')\n"
        "print('# A heading\\n\\n| a |\\n| - |\\n| 1 |', '--quick' in sys.argv)\n"
    )
    (folder / "bad.py").write_text("print('half')\nraise SystemExit('no way')\n")
    monkeypatch.setattr(results, "ROOT", tmp_path)
    (tmp_path / "README.md").write_text("# It\n\n## Results\n\nGood.\n\n## More\n")
    names = [results.Experiment("good", "papers", "Good", "the paper's", {"a": "Shown."})]
    names.append(results.Experiment("bad", "papers", "Bad"))
    monkeypatch.setattr(results, "EXPERIMENTS", (*names, results.Experiment("none", "papers", "None")))
    return tmp_path


def test_every_section_is_on_the_page_also_those_that_failed(results, scripts, capsys):
    page = scripts / "docs" / "results.md"
    status = results.main(["--quick", "--out", str(scripts / "out"), "--page", str(page)])
    assert status == 1
    text = (page.parent / "results" / "papers.md").read_text()
    for words in (
        "## Good",
        "What is shown.\n",
        "**The paper:** the paper's",
        "### A heading",
        "| 1 | True",
        "(../images/results/good_a.png)",
    ):
        assert words in text
    assert "**Failed:** exit status 1: no way" in text
    assert "half" in text
    assert "there is no such script" in text
    assert (page.parent / "images" / "results" / "good_a.png").read_bytes() == b"picture"
    assert "2 failed" in capsys.readouterr().err


def test_the_sections_of_others_stay_where_one_is_made_anew(results, scripts):
    page = scripts / "results" / "papers.md"
    page.parent.mkdir()
    page.write_text("# Results\n\nWritten before.\n\n## Good\n\nold\n\n## Other\n\nkept\n")
    results.main(["--only", "good", "--out", str(scripts / "out"), "--page", str(scripts / "results.md")])
    text = page.read_text()
    assert text.count("## Good") == 1
    assert "\nold\n" not in text
    assert "| 1 | False" in text
    assert text.index("## Good") < text.index("## Other\n\nkept")


def test_every_experiment_has_its_script(results):
    for experiment in results.EXPERIMENTS:
        assert (ROOT / "experiments" / f"{experiment.name}.py").exists()


def test_the_first_page_has_the_readmes_results(results):
    assert (ROOT / "docs" / "results.md").read_text(encoding="utf-8") == results.first_page()
