"""What the reader sees is executed."""

import re
from pathlib import Path

import pages

ROOT = Path(__file__).parent.parent


def test_the_readme_examples_run_as_printed(tmp_path):
    """In an empty folder: what they need they make."""
    said = pages.execute(ROOT / "README.md", tmp_path)
    assert (tmp_path / "walk.png").stat().st_size > 20_000
    assert "p50" in said
    assert "Pose(" in said


def test_the_readme_and_the_accuracy_page_agree():
    """The graph's figures in the README are those of the table that `scripts/reproduce` wrote."""
    readme, accuracy = (ROOT / "README.md").read_text(), (ROOT / "docs" / "accuracy.md").read_text()
    for given, method, in_readme in (
        ("every second waypoint", "graph", "every second waypoint: **graph**"),
        ("first and last", "graph", "first and last waypoint: **graph**"),
        ("first and last", "graph with map", "first and last waypoint: **graph with the floor plan**"),
        ("first only", "graph", "first waypoint alone: **graph**, the direction by the magnetometer"),
        ("first only", "graph with map", "first waypoint alone: **graph with the floor plan**"),
    ):
        row = next(line for line in accuracy.splitlines() if line.startswith(f"| {given} | {method} |"))
        reproduced = [cell.split()[0] for cell in row.split("|")[3:6]]
        shown = next(line for line in readme.splitlines() if line.startswith(f"| {in_readme} |"))
        assert re.findall(r"\*\*([\d.]+) m\*\*", shown) == reproduced
