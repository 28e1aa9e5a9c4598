"""Which rows of a journal belong together: found damage, and what is whole of a damaged journal."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pdr_graph.errors import InputError
from pdr_graph.recovery import Row, Rows, is_whole
from pdr_graph.storage import decode, encode

LAST = "last snapshot"  # name of a row beside the settings
TABLES = ("setting", "event", "snapshot", "trajectory")
PUT = {table: f"INSERT OR REPLACE INTO {table} VALUES (?, ?)" for table in TABLES}


@dataclass(frozen=True)
class Setting:
    """An option of the navigator: texts, numbers, None, lists and dictionaries of these."""

    value: Any


@dataclass(frozen=True)
class LastSnapshot:
    """What belongs together. count: events before the last snapshot; parts: numbers of the parts of the trajectory."""

    count: int
    parts: list[int]


def setting_row(name: str, value: Any) -> tuple[str, bytes]:
    """The row of a setting."""
    return name, encode(Setting(value))


def last_row(count: int, parts: list[int]) -> tuple[str, bytes]:
    """The row that says which snapshot and which parts belong together."""
    return LAST, encode(LastSnapshot(count, parts))


def damaged_rows(database: sqlite3.Connection) -> str:
    """What is damaged or missing in a journal whose pages are whole; "" if nothing is."""
    numbers = dict[str, list[Any]]()
    settings = list[Row]()
    for table in TABLES:
        numbers[table] = []
        for name, blob in database.execute(f"SELECT * FROM {table} ORDER BY rowid"):
            if not is_whole(blob):
                return f"damaged ({table} {name})"
            numbers[table].append(name)
            if table == "setting":
                settings.append((name, blob))
    snapshots, parts, events = numbers["snapshot"], numbers["trajectory"], numbers["event"]
    last = _last_snapshot(settings) or LastSnapshot(max(snapshots, default=0), parts)  # older journals do not state it
    if (snapshots or [0]) != [last.count] or parts != last.parts:
        return "of two ages (a snapshot that does not belong to the trajectory)"
    later = (number for number in events if number > last.count)
    missing = next((n for n, number in enumerate(later, last.count + 1) if number != n), None)
    return "" if missing is None else f"damaged (no event {missing})"


def whole_rows(path: Path, required: Collection[str], read: Callable[[str], list[Row]]) -> tuple[Rows, str]:
    """The rows of a damaged journal up to the last whole event, and what is lost. required: settings.

    Raises InputError if no walk can go on from them: the settings, the snapshot or all events are damaged.
    """
    rows = {table: {row[0]: row for row in read(table) if is_whole(row[1])} for table in TABLES}
    last = _last_snapshot(list(rows["setting"].values()))
    expected = "one that is whole: start the walk anew with another file"
    if last is None or not rows["setting"].keys() >= {*required, LAST}:
        raise InputError(path, "settings", "a damaged journal", expected)
    count, parts = last.count, last.parts
    if count and count not in rows["snapshot"]:
        raise InputError(path, f"snapshot {count}", "a damaged journal", expected)
    end = count
    while end + 1 in rows["event"]:
        end += 1
    if not end:
        raise InputError(path, "event 1", "a damaged journal", expected)
    whole_parts = [number for number in parts if number in rows["trajectory"]]
    rows["setting"][LAST] = last_row(count, whole_parts)
    kept = {"setting": rows["setting"].keys(), "event": range(count + 1, end + 1), "trajectory": whole_parts}
    kept["snapshot"] = [count] if count else []
    found = {PUT[table]: [rows[table][name] for name in names] for table, names in kept.items()}
    lost = f"{len(parts) - len(whole_parts)} of {len(parts)} parts of the trajectory and " * (whole_parts != parts)
    return found, f"{lost}all events after the last whole one are lost"


def _last_snapshot(settings: list[Row]) -> LastSnapshot | None:
    """What belongs together; None if no row says it."""
    blob = dict(settings).get(LAST)
    try:
        return None if blob is None else decode(blob, LastSnapshot)
    except ValueError:
        return None
