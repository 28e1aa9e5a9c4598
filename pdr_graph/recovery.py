"""Recovery of SQLite files that a power cut or a failing disk has damaged.

A file whose last change was interrupted, which its rollback journal tells, or that is shorter than its header says is
examined by `PRAGMA integrity_check` before it is opened for writing. Rows that can be read go into a new file, and the
damaged one is kept beside it. A file that cannot be recovered is left as it is.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from functools import partial
from itertools import count as numbers
from pathlib import Path
from typing import Any
from urllib.parse import quote

from pdr_graph import storage
from pdr_graph.errors import InputError, printable
from pdr_graph.storage import Kind

Row = tuple[Any, ...]
Rows = Mapping[str, Sequence[Sequence[Any]]]  # by the statement that inserts them
Keep = Callable[[Callable[..., list[Row]]], tuple[Rows, str]]  # reader of a table -> rows to keep, what is lost
UNREADABLE_ROW = (sqlite3.DatabaseError, UnicodeDecodeError)  # the latter for names and messages


class DataLossWarning(UserWarning):
    """Stored data are damaged or lost; its text is one line: what, where, and what was kept."""


def checked(
    path: Path, kind: Kind, schema: Sequence[str], first: Rows, keep: Keep, pages: bool
) -> tuple[sqlite3.Connection, str]:
    """As `storage.create_or_open`, after recovery of a damaged file; also returns what was lost, "" if nothing was.

    keep: chooses the rows of the new file, and raises InputError if it cannot be used; pages: examine the pages also of
    a file that its last process closed, which reads all of it.
    Raises InputError, and leaves the files as they are, if they cannot be recovered.
    """
    loss = ""
    interrupted = path.with_name(f"{path.name}-journal").exists()
    if is_of(path, kind) and (pages or interrupted or storage.is_cut(path)):
        damage = found_damage(path)
        if damage:
            loss = f"{path}: {damage}; {_recover(path, kind, schema, keep, damage)}"
    return storage.create_or_open(path, kind, schema, first), loss


def is_of(path: Path, kind: Kind) -> bool:
    """True if a file has the header of this version of this kind."""
    if not path.is_file():
        return False  # a pipe would be waited for
    try:
        return storage.header(path)[:2] == (kind.version, kind.application)
    except OSError:
        return False  # opening it says why


def found_damage(path: Path) -> str:
    """What SQLite finds damaged in a file, "" if nothing is or it cannot be read now; the file is not changed.

    Also reads all rows, whose texts must be UTF-8.
    """
    try:
        with _reading(path) as database:
            for (table,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall():
                for _ in database.execute(f"SELECT * FROM {table}"):
                    pass
            verdict = database.execute("PRAGMA integrity_check(1)").fetchone()[0]
        return "" if verdict == "ok" else f"damaged ({printable(' '.join(verdict.split()))})"
    except UNREADABLE_ROW as error:
        code = getattr(error, "sqlite_errorcode", sqlite3.SQLITE_CORRUPT) & 0xFF
        unreadable = (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED, *storage.SQLITE_ERRORS)
        return "" if code in unreadable else f"damaged ({printable(str(error))})"


@contextmanager
def _reading(path: Path) -> Iterator[sqlite3.Connection]:
    """A connection that changes neither the file nor its log."""
    address = f"file:{quote(str(path.resolve()))}?mode=ro"
    with closing(sqlite3.connect(address, storage.LOCK_TIMEOUT, uri=True)) as database:
        yield database


# ── a new file of what is whole ─────────────────────────────────────────────────────────────────────────────────────


def _recover(path: Path, kind: Kind, schema: Sequence[str], keep: Keep, damage: str) -> str:
    """Replace a damaged file by one of the rows that are kept; returns what is lost, and where the damaged file is."""
    try:
        with _reading(path) as database:
            database.execute("PRAGMA writable_schema = ON")  # or nothing of a file that is cut could be read
            database.text_factory = lambda text: text.decode(errors="surrogateescape")
            rows, lost = keep(partial(_readable, database))
    except UNREADABLE_ROW as error:
        raise InputError(path, "", f"a {kind.name} that is {damage}, unreadable ({error})", "a backup of it") from None
    if not any(rows.values()):
        raise InputError(path, "", f"a {kind.name} that is {damage}, without a whole row", "a backup of it")
    part = path.with_name(f"{path.name}.part")
    part.unlink(missing_ok=True)
    try:
        storage.create_or_open(part, kind, schema, rows).close()
        with part.open("rb+") as file:
            os.fsync(file.fileno())
        aside = keep_aside(path)
        path.with_name(f"{path.name}-journal").unlink(missing_ok=True)
        os.replace(part, path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise
    return f"{lost}; the damaged file is {aside.name}"


def _readable(database: sqlite3.Connection, table: str, columns: str = "*") -> list[Row]:
    """The rows of a table in order, read from either end, but for those of damaged pages and damaged texts."""
    found = dict[int, Row]()
    for order in ("ASC", "DESC"):
        statement = f"SELECT rowid, {columns} FROM {table} NOT INDEXED ORDER BY rowid {order}"
        try:
            for number, *row in database.execute(statement):
                if number in found and order == "DESC":
                    break
                texts = "".join(value for value in row if isinstance(value, str))
                with suppress(UnicodeEncodeError):
                    if b"\0" not in texts.encode():
                        found[number] = tuple(row)
        except UNREADABLE_ROW:
            continue
    return [found[number] for number in sorted(found)]


def keep_aside(path: Path) -> Path:
    """Copy a damaged file to a new name beside it; returns that name."""
    aside = next(name for n in numbers(1) if not (name := path.with_name(f"{path.name}.damaged-{n}")).exists())
    aside.touch(storage.OWNER_ONLY)  # before it has any content
    shutil.copy2(path, aside)
    return aside
