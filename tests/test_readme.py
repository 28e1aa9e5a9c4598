"""What the reader sees is executed."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import simulated

ROOT = Path(__file__).parent.parent


def test_the_readme_examples_run_as_printed(tmp_path, monkeypatch, capsys):
    """In a folder with a simulated walk, its fixes and the plan that the example names."""
    examples = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    route = np.array([(2.5, 18.0), (6.8, 18.2), (6.8, 27.8), (27.6, 27.6), (27.9, 8.0), (40.0, 7.7)])
    simulated.indoor_location(tmp_path, route)
    shutil.copytree(ROOT / "maps", tmp_path / "maps")
    monkeypatch.chdir(tmp_path)
    exec(compile("\n".join(examples), "README.md", "exec"), {})
    assert (tmp_path / "walk.png").stat().st_size > 20_000
    said = capsys.readouterr().out
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


def test_public_names():
    """Every public name resolves, and an unknown one says so."""
    import pdr_graph

    assert all(getattr(pdr_graph, name) is not None for name in pdr_graph.__all__)
    with pytest.raises(AttributeError, match="no attribute 'smoothe'"):
        _ = pdr_graph.smoothe
