"""A SQLite file that one process opens at a time, and its recovery after a power cut or a fault of the disk.

A file whose last change was interrupted, which its rollback journal tells, or that is shorter than its header says is
examined by `PRAGMA integrity_check` before it is opened for writing. Rows that can be read go into a new file, and the
damaged one is kept beside it. A file that cannot be recovered is left as it is.
"""

from __future__ import annotations

import errno
import os
import shutil
import sqlite3
import struct
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from itertools import count as numbers
from pathlib import Path
from typing import Any

from pdr_graph.errors import InputError, check_not_special, printable
from pdr_graph.whole_files import locked

Row = tuple[Any, ...]
Rows = Mapping[str, Sequence[Sequence[Any]]]  # by the statement that inserts them
UNREADABLE_ROW = (sqlite3.DatabaseError, UnicodeDecodeError)  # the latter for names and messages
LOCK_TIMEOUT = 30.0  # [s] to wait until another process closes the file, as a build does at its end
LOCK_CALL = 0.5  # [s] of it in one call of SQLite, which Ctrl-C does not interrupt
OWNER_ONLY = 0o600  # positions are private; SQLite gives its journal the mode of the file itself
LOCKED = (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED)
DISK_ERRORS = {
    sqlite3.SQLITE_FULL: errno.ENOSPC,
    sqlite3.SQLITE_READONLY: errno.EROFS,
    sqlite3.SQLITE_IOERR: errno.EIO,
    sqlite3.SQLITE_CANTOPEN: errno.ENOENT,
    sqlite3.SQLITE_TOOBIG: errno.EFBIG,
}


DATABASE = b"SQLite format 3\0"  # at the beginning of a file


def is_database(path: Path) -> bool:
    """True for an existing file of SQLite."""
    with path.open("rb") if path.is_file() else BytesIO() as file:
        return file.read(len(DATABASE)) == DATABASE


class DataLossWarning(UserWarning):
    """Stored data are damaged or lost; its text is one line: what, where, and what was kept."""


@dataclass(frozen=True)
class Kind:
    """A kind of file. name: in messages, as "lifelog"; application, version: numbers in its header.

    schema: statements that create the tables of a new file; rows: its first rows; upgrades: by version, the statements
    that upgrade a file to the next version; remedy: advice for a file of an older version without upgrade; repair: for
    a damaged one; keep: chooses the rows of a damaged file, of a reader of its tables, and says what is lost; shared:
    True if others may read while one process writes (`write_lock`, `copied`).
    """

    name: str
    application: int
    version: int
    schema: Sequence[str]
    rows: Rows
    upgrades: Mapping[int, Sequence[str]]
    remedy: str
    repair: str
    keep: Callable[[Callable[..., list[Row]]], tuple[Rows, str]]
    shared: bool = False


def open_database(path: Path, kind: Kind, pages: bool) -> tuple[sqlite3.Connection, str]:
    """Open or create a file with exclusive access, upgraded to this version, after recovery of a damaged one.

    Also returns what was lost, "" if nothing was. pages: examine the pages also of a file that its last process closed,
    which reads all of it.
    Raises InputError if the file is of another kind or a newer version, in use, or damaged beyond recovery, and leaves
    it as it is; OSError if the disk fails.
    """
    loss, (version, cut) = "", _recognised(path, kind)
    examined = version == kind.version and (pages or cut or path.with_name(f"{path.name}-journal").exists())
    if examined and (damage := _damage(path)):
        loss = f"{path}: {damage}; {_recover(path, kind, damage)}"
    elif cut and not path.with_name(f"{path.name}-wal").exists():  # where the rest may be
        raise InputError(path, "", f"a damaged {kind.name} ({path.stat().st_size} bytes)", "one of all its pages")
    return _opened(path, kind, kind.rows), loss


@contextmanager
def explained(path: Path, kind: Kind) -> Iterator[None]:
    """Translate errors of SQLite: InputError about the content of the file, OSError about the disk."""
    try:
        yield
    except sqlite3.ProgrammingError:
        raise
    except UNREADABLE_ROW as error:
        code = _code(error)
        if code in LOCKED:
            raise InputError(path, "", f"a {kind.name} that another process writes", "one that none does") from None
        if code in DISK_ERRORS:
            raise OSError(DISK_ERRORS[code], f"{error}", str(path)) from None
        raise InputError(path, "", f"a damaged {kind.name} ({error})", f"one that is whole{kind.repair}") from None


def _code(error: Exception) -> int:
    """The code of an error of SQLite without its details."""
    return getattr(error, "sqlite_errorcode", sqlite3.SQLITE_CORRUPT) & 0xFF


def _recognised(path: Path, kind: Kind) -> tuple[int, bool]:
    """The version in the header of a file, 0 of a new one, and True if the file is shorter than its header says.

    SQLite has not opened the file yet: it would change the database of another program. Raises InputError if the file
    is of another kind or version.
    """
    if not path.exists():
        return 0, False
    check_not_special(path, f"a {kind.name}, or a name that is not taken")
    if not (size := path.stat().st_size):
        return 0, False  # the process was killed before it wrote anything
    with path.open("rb") as file:
        content = file.read(100)
    page, pages, version, application = struct.unpack_from(">16xH10xI28xI4xI", content.ljust(100, b"\0"))
    if not content.startswith(DATABASE) or application != kind.application:
        raise InputError(path, "", "another kind of file", f"a {kind.name}, or a name that is not taken")
    if version != kind.version and version not in kind.upgrades:
        remedy = kind.remedy if version < kind.version else "use the newer pdr_graph that wrote it"
        raise InputError(path, "format", f"{version}", f"{kind.version}, which this version reads: {remedy}")
    return version, size < page * pages


def _opened(path: Path, kind: Kind, rows: Rows) -> sqlite3.Connection:
    """Open a file, or create it with some rows."""
    with explained(path, kind):
        os.close(os.open(path, os.O_CREAT | os.O_RDWR, OWNER_ONLY))
        database = sqlite3.connect(path, LOCK_CALL, isolation_level=None, check_same_thread=False)
    try:
        with explained(path, kind):
            if not kind.shared:
                database.execute("PRAGMA locking_mode = EXCLUSIVE")
            _begin(database)
            version = database.execute("PRAGMA user_version").fetchone()[0]
            upgrades = (statement for older in range(version, kind.version) for statement in kind.upgrades[older])
            for statement in upgrades if version else kind.schema:
                database.execute(statement)
            if not version:
                for statement, values in rows.items():
                    database.executemany(statement, values)
                database.execute(f"PRAGMA application_id = {kind.application}")
            database.execute(f"PRAGMA user_version = {kind.version}")
            database.execute("COMMIT")
            database.execute("PRAGMA journal_mode = DELETE")  # of a file of an older version too
            database.execute(f"PRAGMA busy_timeout = {1000 * LOCK_TIMEOUT:.0f}")  # while a reader copies it
        return database
    except BaseException:
        database.close()
        raise


def write_lock(path: Path, kind: Kind, wait: bool = True) -> int | None:
    """A handle that lets this process alone write a shared file until it is closed; the file is created if necessary.

    wait: for up to LOCK_TIMEOUT, after which InputError is raised; else None if another process writes.
    """
    with explained(path, kind):
        handle = os.open(path, os.O_CREAT | os.O_RDWR, OWNER_ONLY)
    end = time.monotonic() + LOCK_TIMEOUT
    while True:
        if locked(handle):
            return handle
        if wait and time.monotonic() < end:
            time.sleep(0.1)
            continue
        os.close(handle)
        if not wait:
            return None
        raise InputError(path, "", f"a {kind.name} that another process writes", "one that none does")


def copied(path: Path, kind: Kind) -> sqlite3.Connection:
    """A copy in memory of what is stored in a file that another process writes."""
    if _recognised(path, kind)[0] != kind.version:
        raise InputError(path, "", f"a {kind.name} that another process upgrades", "one that none does")
    with explained(path, kind), _reading(path) as stored:
        copy = sqlite3.connect(":memory:", isolation_level=None, check_same_thread=False)
        stored.backup(copy, sleep=0.01)  # between its transactions
    return copy


def _begin(database: sqlite3.Connection) -> None:
    """Begin an exclusive transaction, when other processes have closed the file."""
    end = time.monotonic() + LOCK_TIMEOUT
    while True:
        try:
            database.execute("BEGIN EXCLUSIVE")
            return
        except sqlite3.OperationalError as error:
            if _code(error) not in LOCKED or time.monotonic() > end:
                raise


# ── a new file of what is whole ─────────────────────────────────────────────────────────────────────────────────────


def _damage(path: Path) -> str:
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
        return "" if _code(error) in (*LOCKED, *DISK_ERRORS) else f"damaged ({printable(str(error))})"


@contextmanager
def _reading(path: Path) -> Iterator[sqlite3.Connection]:
    """A connection that changes neither the file nor its log."""
    address = f"{path.resolve().as_uri()}?mode=ro"
    with closing(sqlite3.connect(address, LOCK_CALL, uri=True)) as database:
        yield database


def _recover(path: Path, kind: Kind, damage: str) -> str:
    """Replace a damaged file by one of the rows that are kept; returns what is lost, and where the damaged file is."""
    try:
        with _reading(path) as database:
            database.execute("PRAGMA writable_schema = ON")  # or nothing of a file that is cut could be read
            database.text_factory = lambda text: text.decode(errors="surrogateescape")
            rows, lost = kind.keep(partial(_readable, database))
    except UNREADABLE_ROW as error:
        raise InputError(path, "", f"a {kind.name} that is {damage}, unreadable ({error})", "a backup of it") from None
    if not any(rows.values()):
        raise InputError(path, "", f"a {kind.name} that is {damage}, without a whole row", "a backup of it")
    part = path.with_name(f"{path.name}.part")
    part.unlink(missing_ok=True)
    try:
        _opened(part, kind, rows).close()
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
    aside.touch(OWNER_ONLY)  # before it has any content
    shutil.copy2(path, aside)
    return aside
