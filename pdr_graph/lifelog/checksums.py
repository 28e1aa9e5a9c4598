"""Checksums of a lifelog's rows: a value that a disk has changed, or a row that is missing, is noticed.

SQLite has no checksums of its own. Each recording, correction, guess, phone and setting has one, each day has one over
all its rows, and each of these tables has a total over the checksums of its rows.
"""

from __future__ import annotations

import sqlite3
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from functools import cache
from typing import Any

from pdr_graph.errors import count, printable
from pdr_graph.lifelog.day import DAY_SCHEMA, TABLES
from pdr_graph.recovery import SUM, Row, Rows, row_sum

COLUMNS = {  # of the tables whose rows have a checksum each
    "setting": ("name", "value"),
    "phone": ("transmitter", "person"),
    "recording": (
        *("hash", "person", "path", "plan", "fixes", "beacons", "ranges", "walker", "floor", "begins", "observation"),
        *("epoch", "duration", "steps", "refusal", "zone"),
    ),
    "correction": ("number", "person", "made", "kind", "start", "stop", "value"),
    "guess": ("person", "source", "start", "stop", "kind", "name", "latitude", "longitude", "probability"),
}
DAY = ("person", "date", "key", "recordings")  # all columns but its checksum
THE_DAY = "WHERE person = ? AND date = ?"
SUMMED = (*COLUMNS, "day")  # tables with a column `sum`, NULL until `seal`
SCHEMA = (
    *(f"ALTER TABLE {table} ADD sum INTEGER" for table in SUMMED),
    "CREATE TABLE total (name TEXT PRIMARY KEY, rows INTEGER, sum INTEGER)",
)
SUMS = "SELECT count(*), ifnull(sum(sum), 0) FROM {}"
Execute = Callable[[str, Sequence[Any]], sqlite3.Cursor]


def seal(execute: Execute, tables: Iterable[str]) -> None:
    """Set the checksums of new rows of tables, and the totals, within the transaction that changed them."""
    for table in tables:
        if table == "day":
            for person, date in execute("SELECT person, date FROM day WHERE sum IS NULL", ()).fetchall():
                found = _day_sums(execute, THE_DAY, person, date)[person, date]
                execute(f"UPDATE day SET sum = ? {THE_DAY}", (found, person, date))
        else:
            execute(f"UPDATE {table} SET sum = {SUM}({', '.join(COLUMNS[table])}) WHERE sum IS NULL", ())
        total = execute(SUMS.format(table), ()).fetchone()
        execute("INSERT OR REPLACE INTO total VALUES (?, ?, ?)", (table, *total))


def _day_sums(execute: Execute, where: str = "", *own: str) -> dict[tuple[str, str], int]:
    """Checksums over all rows of each stored day, by person and date."""
    sums = defaultdict[tuple[str, str], int](int)
    for table in TABLES:
        of_row = f"{SUM}({', '.join(_day_columns()[table])})"
        for person, date, found in execute(
            f"SELECT person, date, sum({of_row}) FROM {table} {where} GROUP BY person, date", own
        ):
            sums[person, date] += found
    return sums


@cache
def _day_columns() -> dict[str, tuple[str, ...]]:
    """Names of the columns of the tables with rows of days."""
    with closing(sqlite3.connect(":memory:")) as empty:
        for statement in DAY_SCHEMA:
            empty.execute(statement)
        return {table: tuple(row[1] for row in empty.execute(f"PRAGMA table_info({table})")) for table in TABLES}


def is_whole_day(execute: Execute, person: str, date: str) -> bool:
    """True if the rows of a stored day are those that were written, or if there are none."""
    stated = execute(f"SELECT sum FROM day {THE_DAY}", (person, date)).fetchone()
    return stated is None or stated[0] == _day_sums(execute, THE_DAY, person, date)[person, date]


def are_sealed(execute: Execute) -> bool:
    """False for a new lifelog, and for one of an older version."""
    return execute("SELECT 1 FROM total", ()).fetchone() is not None


def damaged_rows(database: sqlite3.Connection, days: bool) -> str:
    """What is damaged or missing in the tables; "" if nothing is. days: also in the rows of days, which reads all."""
    if not are_sealed(database.execute):
        return ""
    for table, columns in _day_columns().items():
        database.execute(f"SELECT {', '.join(columns)} FROM {table} LIMIT 0")  # raises if their names are damaged
    for table, columns in COLUMNS.items():
        wrong = f"SELECT count(*) FROM {table} WHERE sum IS NOT {SUM}({', '.join(columns)})"
        number = database.execute(wrong).fetchone()[0]
        if number:
            return f"damaged ({count(number, 'row')} of {table})"
    totals = {name: tuple(total) for name, *total in database.execute("SELECT * FROM total")}
    for table, total in totals.items():
        if table in SUMMED and database.execute(SUMS.format(table)).fetchone() != total:
            return f"damaged (rows of {table} are missing or of another age)"
    return _damaged_days(database.execute) if days else ""


def _damaged_days(execute: Execute) -> str:
    """Which stored days have other rows than those that were written; "" if none."""
    stated = {(person, date): own for person, date, own in execute("SELECT person, date, sum FROM day", ())}
    found = _day_sums(execute)
    damaged = [f"{day[0]} {day[1]}" for day in stated | found if stated.get(day) != found.get(day)]
    return f"damaged ({count(len(damaged), 'day')}: {printable(', '.join(damaged[:3]))})" if damaged else ""


# ── what is whole of a damaged lifelog ──────────────────────────────────────────────────────────────────────────────


def whole_rows(read: Callable[[str], list[Row]]) -> tuple[Rows, str]:
    """The rows of a damaged lifelog that are as they were written, and a text that counts those that are lost.

    read: returns the readable rows of a table. A day of which a row is damaged is not kept: a build makes it again.
    """
    kept, counts = dict[str, list[Row]](), list[str]()
    totals = {row[0]: row[1] for row in read("total") if len(row) == 3 and isinstance(row[1], int)}
    for table in COLUMNS:
        kept[table] = [row for row in read(table) if row[-1] == row_sum(*row[:-1])]
    days = _whole_days({table: read(table) for table in TABLES})
    for table, rows in (*kept.items(), ("day", days["day"])):
        expected = max(totals.get(table, 0), len(rows))
        if expected:
            counts.append(f"{len(rows)} of {count(expected, 'row')} of {table}")
    kept |= days | {"version": [row for row in read("version") if all(isinstance(value, str) for value in row)]}
    statements = {_insert(table, rows): rows for table, rows in kept.items() if rows}
    return statements, f"{', '.join(counts) or 'nothing'} recovered"


def _whole_days(rows: dict[str, list[Row]]) -> dict[str, list[Row]]:
    """The rows of the days whose checksum is right, by table."""
    found = defaultdict[tuple[Any, Any], list[Row]](list)
    for table in TABLES:
        for row in rows[table]:
            found[row[:2]].append(row[: len(DAY)] if table == "day" else row)
    sums = {row[:2]: row[-1] for row in rows["day"]}
    whole = {own for own, stated in sums.items() if stated == sum(row_sum(*row) for row in found[own])}
    return {table: [row for row in rows[table] if row[:2] in whole] for table in TABLES}


def _insert(table: str, rows: list[Row]) -> str:
    return f"INSERT OR REPLACE INTO {table} VALUES ({', '.join('?' * len(rows[0]))})"
