"""The house is as docs/design.md draws it: every file has its place, imports point down, a dependency has its rooms."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
HOUSE = ROOT / "pdr_graph"
# From the top: a file may import what stands on its own floor or below
FLOORS = [
    ["cli"],
    ["lifelog"],
    ["online"],
    ["pipeline"],
    ["report"],
    ["inputs"],
    ["estimation", "simulation", "plotting", "evaluation"],
    ["gait", "io", "confidence"],
    ["inertial", "floor"],
    ["geometry", "frames", "earth", "settings", "database", "viterbi", "types", "errors", "state", "verbs"],
]
HEIGHT = {room: -n for n, floor in enumerate(FLOORS) for room in floor}
ROOMS = {
    "gtsam": {"estimation"},
    "matplotlib": {"plotting", "lifelog"},
    "pyproj": {"frames"},
    "pygeomag": {"earth"},
    "lxml": {"io"},
    "vqf": {"inertial"},
    "joblib": {"lifelog"},
    "dask": {"lifelog"},
    "typer": {"cli", "lifelog"},
}


def files():
    """Every module of the package."""
    return [path for path in HOUSE.rglob("*.py") if path.name != "__init__.py"]


def room(path):
    """The folder of a file, or the file itself at the top of the package."""
    return path.relative_to(HOUSE).parts[0].removesuffix(".py")


def imported(path):
    """The modules that a file imports, wherever in it."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names if node.module == "pdr_graph")


def drawn():
    """The files that the page names."""
    page = (ROOT / "docs" / "design.md").read_text(encoding="utf-8")
    house = page.split("## The house")[1].split("\n## ")[0]
    folder = ""
    for row in (line for line in house.splitlines() if line.startswith("|")):
        heading = re.match(r"\| \*\*`?([\w ]+)/?`?\*\*", row)
        folder = "" if heading and heading[1] == "pdr_graph" else heading[1] if heading else folder
        yield from (f"{folder}/{name}".lstrip("/") for name in re.findall(r"`(\w+\.py)`", row))


def test_every_file_has_its_place_in_the_page_once():
    named = list(drawn())
    assert sorted(named) == sorted(path.relative_to(HOUSE).as_posix() for path in files())


@pytest.mark.parametrize("path", files(), ids=lambda p: p.relative_to(HOUSE).as_posix())
def test_imports_point_down(path):
    own = HEIGHT[room(path)]
    below = [name.split(".")[1] for name in imported(path) if name and name.startswith("pdr_graph.")]
    assert [name for name in below if name in HEIGHT and HEIGHT[name] > own] == []


@pytest.mark.parametrize("library", ROOMS)
def test_a_dependency_has_its_rooms(library):
    using = {room(path) for path in files() if any(n and n.split(".")[0] == library for n in imported(path))}
    assert using <= ROOMS[library]
