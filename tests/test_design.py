"""The source layout is that of docs/design.md: each file is listed once, imports point down."""

import ast
import re
from collections import Counter
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
HOUSE = ROOT / "pdr_graph"
# From the top: a file may import what stands on its own floor or below
FLOORS = [
    ["__main__"],
    ["cli", "papers"],
    ["serve"],
    ["lifelog", "evaal"],
    ["online"],
    ["batch", "comparison"],
    ["pipeline"],
    ["outputs"],
    ["report"],
    ["inputs"],
    ["plausibility", "walk_options"],
    ["estimation", "simulation", "plotting", "evaluation"],
    ["colours"],
    ["gait", "io"],
    ["inertial", "floor"],
    ["recovery"],
    ["geometry", "frames", "storage", "web_request", "source", "measurements", "types", "contradiction", "columns"],
    ["sensor_names", "notebook_html"],
    ["second_core"],
    ["errors", "whole_files", "progress", "priors"],
]
HEIGHT = {room: -n for n, floor in enumerate(FLOORS) for room in floor}
ROOMS = {
    "gtsam": {"estimation"},
    "matplotlib": {"plotting", "lifelog"},
    "pyproj": {"frames"},
    "pygeomag": {"frames"},
    "lxml": {"io", "floor", "lifelog"},
    "ezdxf": {"floor"},
    "skimage": {"floor"},
    "pypdfium2": {"floor"},
    "yaml": {"floor"},
    "PIL": {"floor"},
    "vqf": {"inertial", "papers"},
    "joblib": {"lifelog"},
    "tzfpy": {"lifelog"},
    "dask": {"lifelog"},
    "geopandas": {"lifelog"},
    "pandas": {"lifelog"},
    "pyarrow": {"io", "lifelog"},
    "isal": {"source", "report"},
    "numba": {"estimation"},
    "sqlite3": {"storage", "recovery", "online", "lifelog"},
    "starlette": {"serve"},
    "uvicorn": {"serve"},
    "aiomqtt": {"serve"},
    "typer": {"cli"},
    "garmin_fit_sdk": {"lifelog"},
}


def files():
    """Every module of the package."""
    return [path for path in HOUSE.rglob("*.py") if path.name != "__init__.py"]


def everything():
    """Every file of the package, those of packages themselves too."""
    return sorted(HOUSE.rglob("*.py"))


def room(path):
    """The folder of a file, or the file itself at the top of the package."""
    return path.relative_to(HOUSE).parts[0].removesuffix(".py")


def is_type_checking(node):
    """Whether a block is for type checkers alone."""
    return isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"


@cache
def imported(path, checking=True):
    """What a file imports, wherever in it, in functions too: module and name; checking: for type checkers too."""
    nodes, found = [ast.parse(path.read_text(encoding="utf-8"))], set()
    while nodes:
        node = nodes.pop()
        if isinstance(node, ast.Import):
            found |= {(alias.name, "") for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= {(node.module or "", alias.name) for alias in node.names}
        if checking or not is_type_checking(node):
            nodes += ast.iter_child_nodes(node)
    return found


def test_every_folder_has_its_place_in_the_page():
    page = (ROOT / "docs" / "design.md").read_text(encoding="utf-8")
    house = page.split("## Source layout")[1].split("\n## ")[0]
    folders = {path.parent.relative_to(HOUSE).as_posix() for path in everything()} - {"."}
    assert folders <= set(re.findall(r"`([\w/]+)/`", house))


@pytest.mark.parametrize("path", files(), ids=lambda p: p.relative_to(HOUSE).as_posix())
def test_imports_point_down(path):
    own = HEIGHT[room(path)]
    below = [f"{module}.{name}".split(".")[1] for module, name in imported(path) if module.split(".")[0] == "pdr_graph"]
    assert [name for name in below if name in HEIGHT and HEIGHT[name] > own] == []


@pytest.mark.parametrize("library", ROOMS)
def test_a_dependency_has_its_rooms(library):
    using = {room(path) for path in files() if any(module.split(".")[0] == library for module, _ in imported(path))}
    assert using <= ROOMS[library]


def test_no_import_circle_even_among_imports_in_functions():
    names = {".".join(p.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): p for p in everything()}
    graph = {}
    for name, path in names.items():
        found = {whole if (whole := f"{module}.{of}") in names else module for module, of in imported(path, False)}
        graph[name] = found & names.keys()
    TopologicalSorter(graph).prepare()  # raises CycleError, which says which


def test_no_two_modules_have_the_same_name():
    count = Counter(path.stem for path in files())
    assert {name for name, times in count.items() if times > 1} == set()


def test_the_product_imports_no_papers():
    for path in everything():
        if room(path) != "papers":
            assert not [name for name in imported(path) if ".".join(name).startswith("pdr_graph.papers")], path
