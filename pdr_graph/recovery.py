"""Recovery of SQLite files that a power cut or a failing disk has damaged.

A file that its last process did not close, which its write-ahead log tells, or that is shorter than its header says is
examined by `PRAGMA integrity_check` before it is opened for writing. Rows that can be read go into a new file, and the
damaged one is kept beside it. A file that cannot be recovered is left as it is.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from functools import partial
from itertools import count as numbers
from pathlib import Path
from typing import Any
from urllib.parse import quote

from pdr_graph import storage
from pdr_graph.errors import InputError, count, printable
from pdr_graph.storage import CHECKSUM, Kind

Row = tuple[Any, ...]
Rows = Mapping[str, Sequence[Sequence[Any]]]  # by the statement that inserts them
Check = Callable[[sqlite3.Connection], str]  # what is damaged in the rows of a file, "" if nothing is
Keep = Callable[[Callable[..., list[Row]]], tuple[Rows, str]]  # reader of a table -> rows to keep, what is lost
# SQLite's file format. Of a log: the order of its words, page size, salts, sums; of a frame: size of the database if it
# ends a change, else 0, and salts; of the index that all readers share: number of the frames they read, salts
LOG_HEADER, FRAME_HEADER = struct.Struct(">I4xI4x8s2I"), struct.Struct(">4xI8s8x")
INDEX_HEADER = struct.Struct("=16xI12x8s")
UNREADABLE_ROW = (sqlite3.DatabaseError, UnicodeDecodeError)  # the latter for names and messages


class DataLossWarning(UserWarning):
    """Stored data are damaged or lost; its text is one line: what, where, and what was kept."""


def checked(
    path: Path, kind: Kind, schema: Sequence[str], first: Rows, check: Check, keep: Keep, pages: bool
) -> tuple[sqlite3.Connection, str]:
    """As `storage.create_or_open`, after recovery of a damaged file; also returns what was lost, "" if nothing was.

    check: examines rows; keep: chooses the rows of the new file, and raises InputError if it cannot be used; pages:
    examine the pages also of a file that its last process closed, which reads all of it.
    Raises InputError, and leaves the files as they are, if they cannot be recovered.
    """
    loss = ""
    log = path.with_name(f"{path.name}-wal")
    open_before = log.exists() and log.stat().st_size > 0
    if open_before and not (path.exists() and path.stat().st_size):
        raise InputError(path, "", f"no {kind.name} beside its {log.name}", f"both, or a backup: {log.name} is kept")
    if is_of(path, kind):
        loss = lost_changes(path)
        damage = found_damage(path, check, pages or open_before or storage.is_cut(path))
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


def found_damage(path: Path, check: Check, pages: bool) -> str:
    """What is damaged in a file, "" if nothing is or it cannot be read now; the file is not changed."""
    try:
        with _reading(path) as database:
            verdict = _verdict(database) if pages else "ok"
            return check(database) if verdict == "ok" else f"damaged ({printable(' '.join(verdict.split()))})"
    except UNREADABLE_ROW as error:
        code = getattr(error, "sqlite_errorcode", sqlite3.SQLITE_CORRUPT) & 0xFF
        unreadable = (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED, *storage.SQLITE_ERRORS)
        return "" if code in unreadable else f"damaged ({printable(str(error))})"


def _verdict(database: sqlite3.Connection) -> str:
    """SQLite's verdict on a file, "ok" if it is whole; also reads all rows, whose texts must be UTF-8."""
    for (table,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall():
        for _ in database.execute(f"SELECT * FROM {table}"):
            pass
    return database.execute("PRAGMA integrity_check(1)").fetchone()[0]


@contextmanager
def _reading(path: Path) -> Iterator[sqlite3.Connection]:
    """A connection that changes neither the file nor its log."""
    address = f"file:{quote(str(path.resolve()))}?mode=ro"
    with closing(sqlite3.connect(address, storage.LOCK_TIMEOUT, uri=True)) as database:
        yield database


def is_whole(blob: Any) -> bool:
    """True if bytes that `storage.encode` returned have their checksum."""
    if not isinstance(blob, bytes) or len(blob) <= CHECKSUM:
        return False
    return zlib.crc32(memoryview(blob)[CHECKSUM:]) == int.from_bytes(blob[:CHECKSUM], "little")


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
        aside = _kept_aside(path)
        for suffix in ("-wal", "-shm"):
            path.with_name(f"{path.name}{suffix}").unlink(missing_ok=True)
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


def _kept_aside(path: Path) -> Path:
    """A second name of a damaged file and its log, which stays."""
    aside = next(name for n in numbers(1) if not (name := path.with_name(f"{path.name}.damaged-{n}")).exists())
    for suffix in ("-wal", ""):
        file = path.with_name(f"{path.name}{suffix}")
        if file.exists():
            kept = aside.with_name(f"{aside.name}{suffix}")
            kept.touch(storage.OWNER_ONLY)  # before it has any content
            shutil.copy2(file, kept)
    return aside


# ── the write-ahead log ─────────────────────────────────────────────────────────────────────────────────────────────


def lost_changes(path: Path) -> str:
    """What SQLite will not read of a file's write-ahead log: changes that were made after damaged bytes. "" if nothing.

    A process that is killed leaves a log without its last, unfinished change; that is no loss. How far the log is read,
    SQLite says in its index of the log.
    """
    log = path.with_name(f"{path.name}-wal")
    try:
        content = log.read_bytes()
        if not content:
            return ""
        if not _header_is_whole(content):
            used = len(content) > LOG_HEADER.size + FRAME_HEADER.size or not any(content)
            return f"{log}: its first bytes are damaged: all changes in it are lost" if used else ""
        with _reading(path) as database:
            database.execute("PRAGMA schema_version").fetchone()
            whole, salts = INDEX_HEADER.unpack_from(path.with_name(f"{path.name}-shm").read_bytes())
    except (OSError, struct.error, *UNREADABLE_ROW):
        return ""  # there is no log; or the examination of the file says why
    _, page, own, *_ = LOG_HEADER.unpack_from(content)
    if whole and salts != own:
        return ""  # another process has begun the log anew
    frame = FRAME_HEADER.size + page
    begin = LOG_HEADER.size + whole * frame
    later = range(begin, len(content) - FRAME_HEADER.size + 1, frame)
    lost = sum(size > 0 and salt == own for size, salt in (FRAME_HEADER.unpack_from(content, at) for at in later))
    if lost:
        return f"{log}: damaged at byte {begin}: {count(lost, 'change')} after that lost"
    torn = (len(content) - LOG_HEADER.size) % frame not in (0, FRAME_HEADER.size)  # SQLite writes it in two pieces
    if torn or any(not any(content[at : at + FRAME_HEADER.size]) for at in later):
        return f"{log}: cut within a change, which is lost with all after it"
    return ""


def _header_is_whole(content: bytes) -> bool:
    """True if the header of a log has its checksum: s0 += word + s1, s1 += the next + s0, modulo 2**32."""
    if len(content) < LOG_HEADER.size:
        return False
    magic, _, _, *sums = LOG_HEADER.unpack_from(content)
    words, found = struct.unpack_from(">6I" if magic & 1 else "<6I", content), [0, 0]
    for word, after in zip(words[::2], words[1::2], strict=True):
        found[0] = (found[0] + word + found[1]) % 2**32
        found[1] = (found[1] + after + found[0]) % 2**32
    return found == sums
