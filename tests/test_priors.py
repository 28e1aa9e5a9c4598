"""Every number that steers the estimate stands in the table of `pdr_graph.priors`, with its unit and its source."""

import re
from pathlib import Path

import pytest

from pdr_graph import Prior, priors
from pdr_graph.priors import MOTION, WALKER, WALLS, changed, entries, tables

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "pdr_graph"
PAGE = (ROOT / "docs" / "results" / "settings.md").read_text(encoding="utf-8")
DONE = [  # files whose numbers are in the table
    "estimation/**/*.py",
    "gait/*.py",
    "inertial/*.py",
    *("floor/cells.py", "floor/distance_field.py", "floor/building.py"),
    "online/status.py",
]


@pytest.mark.parametrize("entry", list(entries()), ids=str)
def test_a_number_has_unit_meaning_and_source(entry):
    assert entry.unit
    assert len(entry.meaning.split()) > 1
    assert entry.source


@pytest.mark.parametrize("entry", [entry for entry in entries() if entry.still is not None], ids=str)
def test_a_value_lies_within_its_range(entry):
    least, most = entry.still
    assert least <= 1 <= most


def test_the_page_has_every_number():
    """Once: in a row of its name, or with its value in the row of its table."""
    listed = re.findall(r"^\| `([A-Z_]+\.\w+)` \|", PAGE, re.MULTILINE)
    for table, numbers in re.findall(r"^\| `([A-Z_]+)` \|(.*)$", PAGE, re.MULTILINE):
        listed += [f"{table}.{name}" for name in re.findall(r"`(\w+)` -?\d", numbers)]
    assert sorted(listed) == sorted(str(entry) for entry in entries())


def test_every_number_is_used():
    """By its name behind its table, or by a property of the table."""
    text = "\n".join(path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py"))
    unused = [
        str(entry)
        for entry in entries()
        if not re.search(rf"\b{entry}\b", text) and not re.search(rf"\bself\.{entry.name}\b", text)
    ]
    assert unused == []


def test_no_number_chosen_by_hand_stands_elsewhere():
    """A public constant of a module says so in its comment."""
    by_hand = re.compile(r"^[A-Z][A-Z_, ]* = .*# .*\bby hand\b", re.MULTILINE)
    paths = [path for pattern in DONE for path in PACKAGE.glob(pattern)]
    assert len(paths) > 40
    assert [line for path in paths for line in by_hand.findall(path.read_text(encoding="utf-8"))] == []


def test_numbers_are_read_where_they_are_used():
    with changed(WALKER, sigma=(0.3, 0.06, 0.006)), changed(WALLS, margin=0.4):
        assert Prior().sigma == (0.3, 0.06, 0.006)
        assert Prior().wall_margin == 0.4
    assert Prior().sigma == WALKER.sigma == (0.15, 0.03, 0.003)


def test_a_change_ends_with_an_error():
    before = MOTION.lateral
    with pytest.raises(ZeroDivisionError), changed(MOTION, lateral=1.0):
        _ = 1 / 0
    assert MOTION.lateral == before


def test_the_table_imports_nothing_of_the_package():
    text = Path(priors.__file__).read_text(encoding="utf-8")
    assert "pdr_graph" not in re.findall(r"^(?:from|import) (\w+)", text, re.MULTILINE)
    assert len(tables()) > 30
