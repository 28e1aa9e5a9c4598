"""SQLite files of our own: told from others', opened by one process at a time, and what is said where that fails."""

from __future__ import annotations

import errno
import os
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pdr_graph.errors import InputError

WAL_LIMIT = 16 << 20  # [bytes] that are kept for reuse after a flood
PATIENCE = 1.0  # [s] for another process to end
OWN = 0o600  # where people were is nobody else's business; SQLite gives its -wal the mode of the file itself
ERRORS = {
    sqlite3.SQLITE_FULL: errno.ENOSPC,
    sqlite3.SQLITE_READONLY: errno.EROFS,
    sqlite3.SQLITE_IOERR: errno.EIO,
    sqlite3.SQLITE_CANTOPEN: errno.ENOENT,
    sqlite3.SQLITE_TOOBIG: errno.EFBIG,
}


@dataclass(frozen=True)
class Kind:
    """A kind of file. name: in messages, as "journal"; application, version: numbers that its header has."""

    name: str
    application: int
    version: int


def create_or_open(
    path: Path, kind: Kind, schema: Sequence[str], rows: Mapping[str, Sequence[Sequence[Any]]]
) -> sqlite3.Connection:
    """The database, which nobody else can open any more, with a write-ahead log.

    schema: statements that make its tables, and rows: those with which it begins by the statement that puts them in,
    if it is new.

    Raises InputError if the file is something else, of a newer version, damaged or in use; OSError of the disk.
    """
    _recognise(path, kind)
    with explained(path, kind):
        os.close(os.open(path, os.O_CREAT | os.O_RDWR, OWN))
        database = sqlite3.connect(path, PATIENCE, isolation_level=None, check_same_thread=False)
    try:
        with explained(path, kind):
            database.execute("PRAGMA locking_mode = EXCLUSIVE")
            database.execute("BEGIN EXCLUSIVE")
            if not database.execute("PRAGMA user_version").fetchone()[0]:
                _make(database, kind, schema, rows)
            database.execute("COMMIT")
            database.execute("PRAGMA journal_mode = WAL")
            database.execute(f"PRAGMA journal_size_limit = {WAL_LIMIT}")
        return database
    except BaseException:
        database.close()
        raise


@contextmanager
def explained(path: Path, kind: Kind) -> Iterator[None]:
    """What SQLite says, as this package says it: InputError of the file's content, OSError of the disk."""
    try:
        yield
    except sqlite3.ProgrammingError:
        raise
    except sqlite3.Error as error:
        code = getattr(error, "sqlite_errorcode", sqlite3.SQLITE_CORRUPT) & 0xFF  # without the details
        if code in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED):
            raise InputError(path, "", f"a {kind.name} that another process writes", "one that none does") from None
        if code in ERRORS:
            raise OSError(ERRORS[code], f"{error}", str(path)) from None
        raise InputError(path, "", f"a damaged {kind.name} ({error})", "one that is whole") from None


def _recognise(path: Path, kind: Kind) -> None:
    """Look before SQLite does: it would tidy up after another program's database."""
    if not path.exists():
        return
    with path.open("rb") as file:
        header = file.read(100)
    if not header:
        return  # of a process that was killed before it wrote anything
    version, application = (int.from_bytes(header[at : at + 4], "big") for at in (60, 68))
    if not header.startswith(b"SQLite format 3\0") or application != kind.application:
        raise InputError(path, "", "another kind of file", f"a {kind.name}, or a name that is not taken")
    if version > kind.version:
        raise InputError(path, "version", f"{version}", f"{kind.version} or older: a newer pdr_graph wrote it")
    size = int.from_bytes(header[16:18], "big") * int.from_bytes(header[28:32], "big")  # pages
    if path.stat().st_size < size and not path.with_name(f"{path.name}-wal").exists():  # where the rest may be
        raise InputError(path, "", f"a damaged {kind.name} ({path.stat().st_size} bytes)", f"one of {size} bytes")


def _make(
    database: sqlite3.Connection, kind: Kind, schema: Sequence[str], rows: Mapping[str, Sequence[Sequence[Any]]]
) -> None:
    for statement in schema:
        database.execute(statement)
    for statement, values in rows.items():
        database.executemany(statement, values)
    database.execute(f"PRAGMA application_id = {kind.application}")
    database.execute(f"PRAGMA user_version = {kind.version}")
