"""The file of a journal: an SQLite database that one process at a time may open, and what is said where it cannot."""

from __future__ import annotations

import errno
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pdr_graph.errors import InputError
from pdr_graph.online.codec import decode, pack, unpack

APPLICATION, VERSION = 0x50445247, 1  # "PDRG", and of this form of file
WAL_LIMIT = 16 << 20  # [bytes] that are kept for reuse after a flood
PATIENCE = 1.0  # [s] for another process to end
SCHEMA = (
    "CREATE TABLE setting (name TEXT PRIMARY KEY, bytes BLOB NOT NULL)",
    "CREATE TABLE event (number INTEGER PRIMARY KEY, bytes BLOB NOT NULL)",
    "CREATE TABLE snapshot (number INTEGER PRIMARY KEY, bytes BLOB NOT NULL)",  # the state after that event
    "CREATE TABLE trajectory (number INTEGER PRIMARY KEY, bytes BLOB NOT NULL)",  # the rows that settled by then
    f"PRAGMA application_id = {APPLICATION}",
    f"PRAGMA user_version = {VERSION}",
)
ERRORS = {
    sqlite3.SQLITE_FULL: errno.ENOSPC,
    sqlite3.SQLITE_READONLY: errno.EROFS,
    sqlite3.SQLITE_IOERR: errno.EIO,
    sqlite3.SQLITE_CANTOPEN: errno.ENOENT,
    sqlite3.SQLITE_TOOBIG: errno.EFBIG,
}


def open_store(path: Path, settings: Mapping[str, Any], synchronous: str) -> tuple[sqlite3.Connection, dict[str, Any]]:
    """The database, and the settings that it was made with: these, if it is new.

    Raises InputError if the file is something else, of a newer version, damaged or in use; OSError of the disk.
    """
    _recognise(path)
    with explained(path):
        database = sqlite3.connect(path, PATIENCE, isolation_level=None, check_same_thread=False)
    try:
        with explained(path):
            rows = _prepare(database, settings)
            database.execute(f"PRAGMA synchronous = {synchronous}")
        return database, {name: read(path, f"setting {name}", blob) for name, blob in rows}
    except BaseException:
        database.close()
        raise


def read(path: Path, place: str, blob: bytes, kinds: tuple[type, ...] = ()) -> Any:
    """What bytes of the file say: an event or a trajectory of these kinds, or a snapshot or setting."""
    try:
        return decode(blob, kinds) if kinds else unpack(blob)
    except ValueError as error:
        raise InputError(path, place, str(error), "a journal that is whole") from None


@contextmanager
def explained(path: Path) -> Iterator[None]:
    """What SQLite says, as this package says it: InputError of the file's content, OSError of the disk."""
    try:
        yield
    except sqlite3.ProgrammingError:
        raise
    except sqlite3.Error as error:
        code = getattr(error, "sqlite_errorcode", sqlite3.SQLITE_CORRUPT) & 0xFF  # without the details
        if code in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED):
            raise InputError(path, "", "a journal that another process writes", "one that none does") from None
        if code in ERRORS:
            raise OSError(ERRORS[code], f"{error}", str(path)) from None
        raise InputError(path, "", f"a damaged journal ({error})", "one that is whole") from None


def _recognise(path: Path) -> None:
    """Look before SQLite does: it would tidy up after another program's database."""
    if not path.exists():
        return
    with path.open("rb") as file:
        header = file.read(100)
    if not header:
        return  # of a process that was killed before it wrote anything
    version, application = (int.from_bytes(header[at : at + 4], "big") for at in (60, 68))
    if not header.startswith(b"SQLite format 3\0") or application != APPLICATION:
        raise InputError(path, "", "another kind of file", "a journal, or a name that is not taken")
    if version > VERSION:
        raise InputError(path, "version", f"{version}", f"{VERSION} or older: a newer pdr_graph wrote it")


def _prepare(database: sqlite3.Connection, settings: Mapping[str, Any]) -> list[tuple[str, bytes]]:
    """The settings of a journal, which has them from now on if it is new; nobody else can open it any more."""
    database.execute("PRAGMA locking_mode = EXCLUSIVE")
    database.execute("BEGIN EXCLUSIVE")
    if not database.execute("PRAGMA user_version").fetchone()[0]:
        for statement in SCHEMA:
            database.execute(statement)
        rows = [(name, pack(value)) for name, value in settings.items()]
        database.executemany("INSERT INTO setting VALUES (?, ?)", rows)
    database.execute("COMMIT")
    database.execute("PRAGMA journal_mode = WAL")
    database.execute("PRAGMA wal_autocheckpoint = 0")  # but after each snapshot
    database.execute(f"PRAGMA journal_size_limit = {WAL_LIMIT}")
    said = database.execute("PRAGMA quick_check(1)").fetchone()[0]
    if said != "ok":
        raise sqlite3.DatabaseError(said)
    return database.execute("SELECT name, bytes FROM setting").fetchall()
