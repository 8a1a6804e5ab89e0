"""What the documentation shows is run as it stands there."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import numpy as np
import pytest

import slam
from slam.evaluation.metrics import absolute_errors
from slam.interfaces import Backend

DOCS = Path(__file__).parent.parent / "docs"
#: Sections of the results page that the README quotes.
SECTIONS = ("The bookshelf aisle", "Do the back ends know", "Moving box")


def pose_fit():
    path = DOCS / "examples" / "pose_fit.py"
    spec = importlib.util.spec_from_file_location("pose_fit", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.PoseFit


def test_the_back_end_in_50_lines_is_one_and_follows_the_camera():
    lines = [line for line in (DOCS / "examples" / "pose_fit.py").read_text().splitlines() if line.strip()]
    assert len(lines) <= 50
    sequence = slam.open_sequence("synthetic:aisle?frames=25")
    system = slam.StereoSlam(sequence.rig, None, pose_fit()(sequence.rig))
    assert isinstance(system.backend, Backend)
    results = [system.process_features(sequence.observations(k)) for k in range(len(sequence))]
    assert all(result.status.value == "tracked" for result in results[1:])
    errors = absolute_errors(system.trajectory(), sequence.ground_truth)
    assert errors.translation_statistics.rmse < 0.02  # measured 4 mm, on 25 cm of path


def test_the_back_end_in_50_lines_keeps_the_map():
    sequence = slam.open_sequence("synthetic:aisle?frames=2")
    backend = pose_fit()(sequence.rig)
    system = slam.StereoSlam(sequence.rig, None, backend)
    for k in range(2):
        system.process_features(sequence.observations(k))
    estimate = backend.estimate()
    assert list(estimate.ids) == list(system.landmarks.ids)
    backend.remove(estimate.ids[:3])
    assert len(backend.estimate().ids) == len(estimate.ids) - 3
    with pytest.raises(slam.SlamError, match="later"):
        backend.predict(0.0)


def test_a_recording_as_the_guide_has_it_opens(tmp_path):
    import cv2

    K, D = np.array([[200.0, 0, 80], [0, 200, 60], [0, 0, 1]]), np.array([-0.1, 0.01, 0, 0, 0])
    rng = np.random.default_rng(0)
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
        for k in range(3):
            cv2.imwrite(str(tmp_path / side / f"{k:06}.png"), rng.integers(0, 255, (120, 160), dtype=np.uint8))
    code = re.search(r"```python\n(file = cv2.*?)```", (DOCS / "guide.md").read_text(), re.S).group(1)
    code = code.replace('"calibration.yaml"', repr(str(tmp_path / "calibration.yaml")))
    exec(code, {"cv2": cv2, "M1": K, "D1": D, "M2": K, "D2": D, "R": np.eye(3), "T": np.array([-0.12, 0, 0])})
    sequence = slam.open_sequence(f"{tmp_path}?fps=30")
    assert len(sequence) == 3
    assert sequence.rig.baseline == pytest.approx(0.12)
    assert [frame.stamp for frame in sequence] == pytest.approx([0, 1 / 30, 2 / 30])


def test_every_page_in_the_documentation_links_to_what_exists():
    for page in DOCS.rglob("*.md"):
        for target in re.findall(r"\]\(([^)#\s]+)", page.read_text(encoding="utf-8")):
            if not target.startswith(("http:", "https:", "mailto:")):
                assert (page.parent / target).exists(), f"{page.relative_to(DOCS)}: {target}"


def table_rows(text, columns):
    """Cells of the table rows of a Markdown text that have so many columns; an empty first cell is the row's above."""
    rows, name = [], ""
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
        if line.startswith("|") and len(cells) == columns and set(cells[1]) - set("-: "):
            name = cells[0] or name
            rows.append([name, *cells[1:]])
    return rows


def test_the_figures_in_the_readme_are_those_of_the_results_page():
    page = (DOCS / "results.md").read_text(encoding="utf-8")
    if "\n## Real sequences" not in page:
        pytest.skip("the results page has no real sequences: run experiments/results.py with SLAM_DATA")
    section = page.split("\n## Real sequences")[1].split("\n## ")[0]
    measured = {(row[0], row[1]): row[2:6] for row in table_rows(section, 8)}
    readme = (DOCS.parent / "README.md").read_text(encoding="utf-8")
    shown = [row for row in table_rows(readme, 6) if row[1] in ("ekf", "smoother")]
    assert len(shown) == 6
    for name, backend, *cells in shown:
        own = next(values for (short, other), values in measured.items() if name.startswith(short) and other == backend)
        for cell, value in zip(cells, own):
            digits = len(cell.partition(".")[2])
            assert cell == (f"{float(value):.{digits}f}" if digits else value), (name, backend, cell, value)


def test_the_figures_of_worlds_in_the_readme_are_those_of_the_results_page():
    page = (DOCS / "results.md").read_text(encoding="utf-8")
    section = {text.split("\n")[0]: text for text in page.split("\n## ")}
    of = {name: next(text for title, text in section.items() if title.startswith(name)) for name in SECTIONS}
    aisle = {row[0]: row for row in table_rows(of["The bookshelf aisle"], 11)}
    consistency = table_rows(of["Do the back ends know"], 10)
    nees = table_rows(of["Do the back ends know"], 8)
    bodies = {row[1]: row for row in table_rows(of["Moving box"], 12) if row[0].startswith("box?") and row[2] == "1"}
    cars = [row for row in table_rows(of["Moving box"], 10) if row[2] in ("0", "1") and row[4] not in ("1", "–")]
    worlds = ("desk", "aisle")
    for column, backend in ((1, "ekf"), (2, "smoother")):
        bound = [row[3] for world in worlds for row in consistency if row[:2] == [world, backend]]
        honest = [f"{float(row[2].split()[0]):.1f}" for world in worlds for row in nees if row[:2] == [world, backend]]
        body = bodies[backend]
        speeds = [f"{float(row[7]):.1f} %" for row in cars if row[0] == backend]
        expected = [
            f"{aisle[backend][2]}, {aisle[backend][3]} cm",
            ", ".join(bound),
            ", ".join(honest),
            f"{float(body[7]):.2f}°, {float(body[8]):.1f} mm",
            ", ".join(speeds),
        ]
        readme = table_rows((DOCS.parent / "README.md").read_text(encoding="utf-8"), 3)
        assert [row[column] for row in readme if row[1] != "ekf"] == expected
