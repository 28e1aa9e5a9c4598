"""Recovery of SQLite files that a power cut, a failing disk or a mixed backup has damaged.

SQLite notices a page that is no page, and bytes of the write-ahead log whose checksum is wrong; it says nothing of the
log's lost end, and nothing of values that have changed. So a file is examined before it is opened for writing: rows by
their checksums, and if its last process did not close it, which its log tells, pages and indexes by SQLite, and the log
for changes that SQLite will not read. What is whole then goes into a new file, and the damaged one is kept beside it. A
file that cannot be recovered is left as it is.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from functools import cache
from itertools import count as numbers
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from pdr_graph import storage
from pdr_graph.errors import InputError, count
from pdr_graph.storage import CHECKSUM, Kind

Row = tuple[Any, ...]
Rows = Mapping[str, Sequence[Sequence[Any]]]  # by the statement that inserts them
Check = Callable[[sqlite3.Connection], str]  # what is damaged in the rows of a file, "" if nothing is
Keep = Callable[[Callable[[str], list[Row]]], tuple[Rows, str]]  # reader of a table -> rows to keep, what is lost
WAL_HEADER, FRAME_HEADER = struct.Struct(">8I"), struct.Struct(">6I")
UNREADABLE = (sqlite3.DatabaseError, UnicodeDecodeError)  # the latter for names and messages
SUM = "row_sum"  # name of the SQL function


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
    database = storage.create_or_open(path, kind, schema, first)
    database.create_function(SUM, -1, row_sum, deterministic=True)
    return database, loss


def is_of(path: Path, kind: Kind) -> bool:
    """True if a file has the header of this version of this kind."""
    if not path.is_file():
        return False  # a pipe would be waited for
    try:
        with path.open("rb") as file:
            header = file.read(100)
    except OSError:
        return False  # opening it says why
    numbers = [int.from_bytes(header[at : at + 4], "big") for at in (60, 68)]
    return header.startswith(b"SQLite format 3\0") and numbers == [kind.version, kind.application]


def found_damage(path: Path, check: Check, pages: bool) -> str:
    """What is damaged in a file, "" if nothing is or it cannot be read now; the file is not changed."""
    try:
        with _reading(path) as database:
            verdict = database.execute("PRAGMA integrity_check(1)").fetchone()[0] if pages else "ok"
            return check(database) if verdict == "ok" else f"damaged ({' '.join(verdict.split())})"
    except UNREADABLE as error:
        code = getattr(error, "sqlite_errorcode", sqlite3.SQLITE_CORRUPT) & 0xFF
        unreadable = (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED, *storage.ERRORS)
        return "" if code in unreadable else f"damaged ({error})"


@contextmanager
def _reading(path: Path) -> Iterator[sqlite3.Connection]:
    """A connection that changes neither the file nor its log, and returns texts that are no UTF-8 as such."""
    shared = path.with_name(f"{path.name}-shm")
    existed = shared.exists()
    address = f"file:{quote(str(path.resolve()))}?mode=ro"
    try:
        with closing(sqlite3.connect(address, storage.PATIENCE, uri=True)) as database:
            database.text_factory = lambda text: text.decode(errors="surrogateescape")
            database.create_function(SUM, -1, row_sum, deterministic=True)
            yield database
    finally:
        if not existed:
            shared.unlink(missing_ok=True)


def row_sum(*values: Any) -> int:
    """Checksum of the values of a row."""
    found = 0
    for value in values:
        found = zlib.crc32(value if isinstance(value, bytes) else repr(value).encode(errors="surrogatepass"), found)
    return found


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
            rows, lost = keep(lambda table: _readable(database, table))
    except UNREADABLE as error:
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


def _readable(database: sqlite3.Connection, table: str) -> list[Row]:
    """The rows of a table in order, but for those in damaged pages: read from either end."""
    found = dict[int, Row]()
    for order in ("ASC", "DESC"):
        try:
            for number, *row in database.execute(f"SELECT rowid, * FROM {table} NOT INDEXED ORDER BY rowid {order}"):
                if number in found and order == "DESC":
                    break
                found[number] = tuple(row)
        except UNREADABLE:
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

    A process that is killed leaves a log without its last, unfinished change; that is no loss.
    """
    log = path.with_name(f"{path.name}-wal")
    try:
        content = log.read_bytes()
    except OSError:
        return ""
    if not content:
        return ""
    if len(content) < WAL_HEADER.size or not _header_is_whole(content):
        found = len(content) > WAL_HEADER.size + FRAME_HEADER.size or content.strip(b"\0") == b""
        return f"{log}: its first bytes are damaged: all changes in it are lost" if found else ""
    page = WAL_HEADER.unpack_from(content)[2]
    frame = FRAME_HEADER.size + page
    whole = _whole_frames(content, page)
    begin = WAL_HEADER.size + whole * frame
    rest = range(begin, len(content) - FRAME_HEADER.size + 1, frame)
    salts = WAL_HEADER.unpack_from(content)[4:6]
    later = [FRAME_HEADER.unpack_from(content, at) for at in rest]
    commits = sum(size > 0 and (salt, other) == salts for _, size, salt, other, _, _ in later)
    if commits:
        return f"{log}: damaged at byte {begin}: {count(commits, 'change')} after that lost"
    torn = (len(content) - WAL_HEADER.size) % frame
    if torn not in (0, FRAME_HEADER.size) or (
        rest and not any(content[-FRAME_HEADER.size :])
    ):  # SQLite writes a frame in two pieces
        return f"{log}: cut within a change, which is lost with all after it"
    return ""


def _header_is_whole(content: bytes) -> bool:
    """True if SQLite will read a log with this header."""
    magic, _, page, *_, first, second = WAL_HEADER.unpack_from(content)
    sums = _summed(content[: WAL_HEADER.size - 8], (0, 0), magic)
    # native magic of a log whose checksums are of little-endian words; + 1: big-endian
    return magic | 1 == 0x377F0682 | 1 and page >= 512 and sums == (first, second)


def _whole_frames(content: bytes, page: int) -> int:
    """Number of the first frames of a log, up to the last commit, that SQLite will read."""
    magic, _, _, _, *salts, first, second = WAL_HEADER.unpack_from(content)
    sums, whole, frame = (first, second), 0, FRAME_HEADER.size + page
    for number, at in enumerate(range(WAL_HEADER.size, len(content) - frame + 1, frame)):
        _, commit, *own, left, right = FRAME_HEADER.unpack_from(content, at)
        if own != salts:
            break
        sums = _summed(content[at : at + 8] + content[at + FRAME_HEADER.size : at + frame], sums, magic)
        if sums != (left, right):
            break
        if commit:
            whole = number + 1
    return whole


def _summed(data: bytes, sums: tuple[int, int], magic: int) -> tuple[int, int]:
    """The checksum of SQLite's log over more bytes: t[k] = t[k-1] + t[k-2] + word[k], the last two of them.

    So a word counts as often as a Fibonacci number says.
    """
    words = np.frombuffer(data, ">u4" if magic & 1 else "<u4").astype(np.uint32)
    words[:2] += np.array([sums[0] + sums[1], sums[1]], np.uint64).astype(np.uint32)
    weights = _fibonacci(len(words))
    return int((words[:-1] * weights[1:]).sum(dtype=np.uint32)), int((words * weights).sum(dtype=np.uint32))


@cache
def _fibonacci(number: int) -> np.ndarray:
    """The first Fibonacci numbers, the last of them first, modulo 2**32."""
    found = [1, 1]
    while len(found) < number:
        found.append((found[-1] + found[-2]) & 0xFFFFFFFF)
    return np.array(found[:number][::-1], np.uint32)
