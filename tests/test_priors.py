"""Every number that steers the estimate stands in the table of `pdr_graph.priors`, with its unit and its source."""

import re
from contextlib import suppress

from source import FILES, PACKAGE, ROOT, text_of

from pdr_graph import Prior
from pdr_graph.priors import WALKER, WALLS, changed, entries, tables

PAGE = (ROOT / "docs" / "results" / "settings.md").read_text(encoding="utf-8")
DONE = [  # files whose numbers are in the table
    "estimation/**/*.py",
    "gait/*.py",
    "inertial/*.py",
    *("floor/cells.py", "floor/distance_field.py", "floor/building.py"),
    "online/status.py",
]


def test_a_number_has_unit_meaning_and_source_and_lies_within_its_range():
    listed = list(entries())
    assert [str(e) for e in listed if not e.unit or not e.source or len(e.meaning.split()) < 2] == []
    assert [str(e) for e in listed if e.still is not None and not e.still[0] <= 1 <= e.still[1]] == []


def test_the_page_has_every_number():
    """Once: in a row of its name, or in the row of its table."""
    listed = re.findall(r"^\| `([A-Z_]+\.\w+)` \|", PAGE, re.MULTILINE)
    for table, numbers in re.findall(r"^\| `([A-Z_]+)` \|(.*)$", PAGE, re.MULTILINE):
        listed += [f"{table}.{name}" for name in re.findall(r"`(\w+)`", numbers)]
    assert sorted(listed) == sorted(str(entry) for entry in entries())


def test_every_number_is_used():
    """By its name behind its table, or by a property of the table."""
    words = set(re.findall(r"\b\w+\.\w+\b", "\n".join(map(text_of, FILES))))
    assert [str(entry) for entry in entries() if not {str(entry), f"self.{entry.name}"} & words] == []


def test_no_number_chosen_by_hand_stands_elsewhere():
    """A public constant of a module says so in its comment."""
    by_hand = re.compile(r"^[A-Z][A-Z_, ]* = .*# .*\bby hand\b", re.MULTILINE)
    paths = [path for pattern in DONE for path in PACKAGE.glob(pattern)]
    assert len(paths) > 40
    assert [line for path in paths for line in by_hand.findall(text_of(path))] == []


def test_numbers_are_read_where_they_are_used_and_a_change_ends_with_an_error():
    walker, walls = changed(WALKER, sigma=(0.3, 0.06, 0.006)), changed(WALLS, margin=0.4)
    with suppress(ZeroDivisionError), walker, walls:
        assert Prior().sigma == (0.3, 0.06, 0.006)
        assert Prior().wall_margin == 0.4
        _ = 1 / 0
    assert Prior().sigma == WALKER.sigma == (0.15, 0.03, 0.003)


def test_the_table_imports_nothing_of_the_package():
    imported = re.findall(r"^(?:from|import) (\w+)", text_of(PACKAGE / "priors.py"), re.MULTILINE)
    assert "pdr_graph" not in imported
    assert len(tables()) > 30
