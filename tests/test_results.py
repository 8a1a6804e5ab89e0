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
    names = [results.Experiment("good", "Good", "the paper's"), results.Experiment("bad", "Bad")]
    monkeypatch.setattr(results, "EXPERIMENTS", (*names, results.Experiment("none", "None")))
    return tmp_path


def test_every_section_is_on_the_page_also_those_that_failed(results, scripts, capsys):
    page = scripts / "docs" / "results.md"
    status = results.main(["--quick", "--out", str(scripts / "out"), "--page", str(page)])
    assert status == 1
    text = page.read_text()
    for words in (
        "## Good",
        "What is shown.\n",
        "**The paper:** the paper's",
        "### A heading",
        "| 1 | True",
        "(images/results/good_a.png)",
    ):
        assert words in text
    assert "**Failed:** exit status 1: no way" in text
    assert "half" in text
    assert "there is no such script" in text
    assert (page.parent / "images" / "results" / "good_a.png").read_bytes() == b"picture"
    pictures = page.with_name("gallery.md").read_text()
    assert "![Good: a](images/results/good_a.png)" in pictures
    assert "## Bad" not in pictures
    assert "2 failed" in capsys.readouterr().err


def test_one_alone(results, scripts, capsys):
    page = scripts / "page.md"
    assert results.main(["--only", "good", "--out", str(scripts / "out"), "--page", str(page)]) == 0
    assert "short form" not in page.read_text()
    assert not page.with_name("gallery.md").exists()


def test_the_sections_of_others_stay_where_one_is_made_anew(results, scripts):
    page = scripts / "page.md"
    page.write_text("# Results\n\nWritten before.\n\n## Good\n\nold\n\n## Other\n\nkept\n")
    results.main(["--only", "good", "--out", str(scripts / "out"), "--page", str(page)])
    text = page.read_text()
    assert text.count("## Good") == 1
    assert "\nold\n" not in text
    assert "| 1 | False" in text
    assert text.index("## Good") < text.index("## Other\n\nkept")


def test_only_what_the_same_code_has_left_is_taken_again(results, scripts, capsys):
    def run(*more):
        results.main(["--only", "good", "--out", str(scripts / "out"), "--page", str(scripts / "page.md"), *more])
        return capsys.readouterr().err

    assert "good …" in run()
    assert "good …" not in run("--resume")
    assert "| 1 | False" in (scripts / "page.md").read_text()
    assert "good …" in run("--resume", "--quick")
    assert "good …" in run("--resume")
    script = scripts / "experiments" / "good.py"
    script.write_text(script.read_text() + "print('more')\n")
    assert "made by other code" in run("--resume")
    assert "more" in (scripts / "page.md").read_text()
    assert "good …" in run()


def test_every_experiment_has_its_script(results):
    for experiment in results.EXPERIMENTS:
        assert (ROOT / "experiments" / f"{experiment.name}.py").exists()


def test_the_gallery_in_the_documentation_is_as_the_script_writes_it(results):
    head, demo, tail = results.gallery([]).partition("## The demo")
    page = (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
    assert page.startswith(head)
    assert page.endswith(demo + tail)


def test_the_page_begins_with_the_readmes_results(results):
    page = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
    assert page.split("\n## ")[1].startswith("In short\n")
    assert results.with_summary(page) == page


def test_columns_are_explained_in_their_order_and_others_are_not(results):
    table = "text\n\n| back end | doubled | tracked |\n| --- | ---: | ---: |\n| ekf | 1 | 2 |\n"
    said = results.explained("aisle", table)
    assert said.index("**doubled**: pairs") < said.index("**tracked**: frames")
    assert "back end" not in said
    assert results.explained("frame_rate", table).count("- **") == 1
    assert results.explained("aisle", "no table") == ""


def test_what_is_explained_is_there(results):
    """Each column and picture that has an explanation is on the page, where its experiment is."""
    from experiments.explanations import OF_ONE, PICTURES

    names = {e.name: e for e in results.EXPERIMENTS}
    page = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
    sections = {part.split("\n")[0]: part for part in page.split("\n## ")[1:]}
    assert {*OF_ONE, *PICTURES} <= set(names)
    for name, experiment in names.items():
        section = sections.get(experiment.title)
        for column in OF_ONE.get(name, {}) if section else ():
            assert f"| {column} |" in section, f"{name}: {column}"
        for picture in PICTURES.get(name, {}) if section else ():
            assert f"results/{name}_{picture}.png" in section, f"{name}: {picture}"


def test_the_api_pages_list_what_their_modules_hold():
    make = load_script("docs/make_api.py")
    for page in make.PAGES:
        text = page.read_text(encoding="utf-8")
        assert make.written(text) == text, f"docs/api/{page.name}: run python docs/make_api.py"
