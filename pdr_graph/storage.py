"""Lossless encoding of typed dataclasses without pickle; SQLite files.

One format serves the events of a journal and the blobs of a lifelog:

    CRC-32 of what follows (4 bytes) · format (1) · msgpack: [name of the type, fields by name in alphabetical order]

A numeric array is an extension of msgpack: its dtype, its shape, its bytes. `decode` checks every field against its
type hint, and that encoding the result gives the same bytes, so additional fields are errors. Fields with a default may
be missing, as in bytes of older versions.
"""

from __future__ import annotations

import errno
import hashlib
import math
import os
import sqlite3
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

import msgspec
import numpy as np

from pdr_graph.errors import InputError, check_not_special

FORMAT = 2  # of the bytes; 1 was JSON with the arrays behind it
HEADER = struct.Struct("<IB")  # checksum, format
CHECKSUM = 4  # bytes
ARRAY = 1  # code of the msgpack extension
ARRAY_SHAPE = struct.Struct("<4sB")  # dtype and number of dimensions, before the dimensions
SIMPLE = (str, float, int, np.ndarray, type(None))  # values without fields
DTYPES = frozenset(np.dtype(name).str for name in ("f8", "f4", "c16", "i8", "i4", "u8", "u4", "u1", "?"))
UNREADABLE = (
    *(msgspec.MsgspecError, struct.error, ValueError, TypeError, AttributeError),
    *(LookupError, RecursionError, OverflowError),
)
Value = TypeVar("Value")


def encode(value: object) -> bytes:
    """Encode a dataclass. Raises TypeError if a field is not of its type, since it could not be decoded."""
    return encode_and_decode(value)[0]


def encode_and_decode(value: Value) -> tuple[bytes, Value]:
    """The bytes of a dataclass, and the result of `decode` for these bytes. Raises TypeError as `encode`."""
    kind = type(value)
    if not is_dataclass(value):
        raise TypeError(f"found {kind.__name__}, expected a dataclass")
    try:
        again = _decoder(kind).decode(_ENCODER.encode(value))
        payload = _ENCODER.encode([kind.__name__, again])
    except UNREADABLE as error:
        raise TypeError(f"{kind.__name__}: {_on_one_line(error)}") from None
    checked = bytes([FORMAT]) + payload
    return struct.pack("<I", zlib.crc32(checked)) + checked, again


def decode(blob: bytes, *kinds: type) -> Any:
    """Decode the bytes of a dataclass of one of these kinds.

    Raises ValueError for other bytes; memory is allocated for no more than there are bytes.
    """
    try:
        return _decoded(blob, {kind.__name__: kind for kind in kinds})
    except UNREADABLE as error:
        names = " or ".join(kind.__name__ for kind in kinds)
        raise ValueError(f"bytes of no {names[:80]}: {_on_one_line(error)}") from None


def _decoded(blob: bytes, kinds: Mapping[str, type]) -> Any:
    checksum, version = HEADER.unpack_from(blob)
    if zlib.crc32(memoryview(blob)[CHECKSUM:]) != checksum:
        raise ValueError("their checksum does not match")
    if version != FORMAT:
        raise ValueError(f"found format {version}, expected {FORMAT}")
    payload = memoryview(blob)[HEADER.size :]
    name, raw = _ENVELOPE.decode(payload)
    if name not in kinds:
        raise ValueError(f"found a {name[:40]!r}")
    value = _decoder(kinds[name]).decode(raw)
    again = _ENCODER.encode([name, value])
    if again != bytes(payload):  # of a memoryview every byte would be compared by itself
        raise ValueError("found a field or an encoding that this version does not have")
    return value


def _on_one_line(error: Exception) -> str:
    return " ".join((str(error) or type(error).__name__).split())[:120]


def _plain(value: Any) -> Any:
    """A numpy value as a type that msgspec encodes. Raises TypeError for other values."""
    if isinstance(value, np.generic):
        return value.item()
    if not isinstance(value, np.ndarray) or value.dtype.str not in DTYPES:
        what = f"an array of {value.dtype}" if isinstance(value, np.ndarray) else type(value).__name__
        raise TypeError(f"found {what}, expected texts, numbers, numeric arrays and dataclasses of these")
    code = value.dtype.str.ljust(4).encode()
    head = ARRAY_SHAPE.pack(code, value.ndim) + struct.pack(f"<{value.ndim}Q", *value.shape)
    return msgspec.msgpack.Ext(ARRAY, head + value.tobytes())


def _array(code: int, data: memoryview) -> Any:
    """The numeric array of a msgpack extension, aligned and writable. Raises ValueError for other bytes."""
    if code != ARRAY:
        raise ValueError(f"found msgpack extension {code}")
    name, dimensions = ARRAY_SHAPE.unpack_from(data)
    text = name.decode("ascii").rstrip()
    if text not in DTYPES or dimensions > 8:  # most dimensions
        raise ValueError(f"found an array of dtype {text!r} and {dimensions} dimensions")
    shape, dtype = struct.unpack_from(f"<{dimensions}Q", data, ARRAY_SHAPE.size), np.dtype(text)
    begin = ARRAY_SHAPE.size + 8 * dimensions
    if math.prod(shape) * dtype.itemsize != len(data) - begin:
        raise ValueError(f"found an array of shape {shape} in {len(data) - begin} bytes")
    array = np.frombuffer(data, dtype, offset=begin).reshape(shape).copy()
    if dtype.kind == "b" and array.view(np.uint8).max(initial=0) > 1:
        raise ValueError("found truth values beyond 1")
    return array


def _typed(kind: Any, value: Any) -> Any:
    """The value of a field whose type msgspec does not know: an array of the declared dtype, if one is declared."""
    if kind is not np.ndarray and get_origin(kind) is not np.ndarray:
        raise TypeError(f"a field of type {kind} cannot be stored")
    if not isinstance(value, np.ndarray):
        raise ValueError(f"Expected `array of numbers`, got `{type(value).__name__}`")
    declared: Any = Any if kind is np.ndarray else get_args(get_args(kind)[1])[0]
    if declared is not Any and value.dtype != np.dtype(declared):
        raise ValueError(f"Expected `array of {np.dtype(declared)}`, got `array of {value.dtype}`")
    return value


@cache
def _decoder(kind: type) -> msgspec.msgpack.Decoder[Any]:
    return msgspec.msgpack.Decoder(kind, dec_hook=_typed, ext_hook=_array)


_ENCODER = msgspec.msgpack.Encoder(enc_hook=_plain, order="sorted")
_ENVELOPE = msgspec.msgpack.Decoder(tuple[str, msgspec.Raw])


def compress(value: object) -> bytes:
    """`encode`, compressed."""
    # level of zlib: the next ones take twice the time for a hundredth of the size of random digits
    return zlib.compress(encode(value), 1)


def decompress(blob: bytes, *kinds: type) -> Any:
    """The dataclass, one of these kinds, that `compress` made the bytes of. Raises ValueError for other bytes."""
    try:
        return decode(zlib.decompress(blob), *kinds)
    except zlib.error as error:
        raise ValueError(f"bytes of no {kinds[0].__name__}: {_on_one_line(error)}") from None


def encode_json(value: object) -> str:
    """A dataclass of texts and numbers as JSON."""
    return msgspec.json.encode(value).decode()


def decode_json(text: str, kind: type[Value]) -> Value:
    """The dataclass of which `encode_json` made the text. Raises ValueError for other texts."""
    try:
        return msgspec.json.decode(text, type=kind)
    except UNREADABLE as error:
        raise ValueError(f"no JSON of {kind.__name__}: {_on_one_line(error)}") from None


def fingerprint(path: Path, files: Sequence[Path] = ()) -> str:
    """The name of an input with the SHA-256 of names and contents of its files, by default of ``path`` itself."""
    digest = hashlib.sha256()
    for file in files or (path,):
        with file.open("rb") as content:
            content_hash = hashlib.file_digest(content, "sha256").hexdigest()
        digest.update(f"{file.name}\0{content_hash}\n".encode(errors="surrogateescape"))
    return f"{path.resolve().name}, sha256 {digest.hexdigest()}"


def write_text(path: Path, text: str) -> None:
    r"""Write a text as UTF-8; bytes of a file name that are not UTF-8 become escapes, which JSON reads back: \udcff."""
    path.write_text(text, encoding="utf-8", errors="backslashreplace")


LOCK_TIMEOUT = 1.0  # [s] to wait for another process to close the file
OWNER_ONLY = 0o600  # positions are private; SQLite gives its journal the mode of the file itself
SQLITE_ERRORS = {
    sqlite3.SQLITE_FULL: errno.ENOSPC,
    sqlite3.SQLITE_READONLY: errno.EROFS,
    sqlite3.SQLITE_IOERR: errno.EIO,
    sqlite3.SQLITE_CANTOPEN: errno.ENOENT,
    sqlite3.SQLITE_TOOBIG: errno.EFBIG,
}


@dataclass(frozen=True)
class Kind:
    """A kind of file. name: in messages, as "journal"; application, version: numbers in its header.

    remedy: advice for a file of an older version without upgrade; repair: for a damaged one; upgrades: by version, the
    statements that upgrade a file to the next version.
    """

    name: str
    application: int
    version: int
    remedy: str
    upgrades: Mapping[int, Sequence[str]] = field(default_factory=dict)
    repair: str = ""


def create_or_open(
    path: Path, kind: Kind, schema: Sequence[str], rows: Mapping[str, Sequence[Sequence[Any]]]
) -> sqlite3.Connection:
    """Open or create a database with exclusive access, and upgrade it to this version.

    schema: statements that create the tables of a new file; rows: its first rows, by the statement that inserts them.

    Raises InputError if the file is of another kind or a newer version, damaged or in use; OSError if the disk fails.
    """
    _recognise(path, kind)
    with explained(path, kind):
        os.close(os.open(path, os.O_CREAT | os.O_RDWR, OWNER_ONLY))
        database = sqlite3.connect(path, LOCK_TIMEOUT, isolation_level=None, check_same_thread=False)
    try:
        with explained(path, kind):
            database.execute("PRAGMA locking_mode = EXCLUSIVE")
            database.execute("BEGIN EXCLUSIVE")
            version = database.execute("PRAGMA user_version").fetchone()[0]
            if version:
                _upgrade(database, kind, version)
            else:
                _make(database, kind, schema, rows)
            database.execute("COMMIT")
            database.execute("PRAGMA journal_mode = DELETE")  # of a file of an older version too
        return database
    except BaseException:
        database.close()
        raise


@contextmanager
def explained(path: Path, kind: Kind) -> Iterator[None]:
    """Translate errors of SQLite: InputError about the content of the file, OSError about the disk."""
    try:
        yield
    except sqlite3.ProgrammingError:
        raise
    except (sqlite3.Error, UnicodeDecodeError) as error:  # the latter where a message names a damaged table
        code = getattr(error, "sqlite_errorcode", sqlite3.SQLITE_CORRUPT) & 0xFF  # without the details
        if code in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED):
            raise InputError(path, "", f"a {kind.name} that another process writes", "one that none does") from None
        if code in SQLITE_ERRORS:
            raise OSError(SQLITE_ERRORS[code], f"{error}", str(path)) from None
        raise InputError(path, "", f"a damaged {kind.name} ({error})", f"one that is whole{kind.repair}") from None


def _recognise(path: Path, kind: Kind) -> None:
    """Check the header before SQLite opens the file, since it would modify another program's database.

    Raises InputError if the file is of another kind or version, or truncated.
    """
    if not path.exists():
        return
    check_not_special(path, f"a {kind.name}, or a name that is not taken")
    if not path.stat().st_size:
        return  # the process was killed before it wrote anything
    version, application, _ = header(path)
    if application != kind.application:
        raise InputError(path, "", "another kind of file", f"a {kind.name}, or a name that is not taken")
    if version != kind.version and version not in kind.upgrades:
        remedy = kind.remedy if version < kind.version else "use the newer pdr_graph that wrote it"
        raise InputError(path, "format", f"{version}", f"{kind.version}, which this version reads: {remedy}")
    if is_cut(path) and not path.with_name(f"{path.name}-wal").exists():  # where the rest may be
        raise InputError(path, "", f"a damaged {kind.name} ({path.stat().st_size} bytes)", "one of all its pages")


def header(path: Path) -> tuple[int, int, int]:
    """Version, application and size [bytes] in the header of a database; zeros for another file."""
    with path.open("rb") as file:
        content = file.read(100)
    if not content.startswith(b"SQLite format 3\0"):
        return 0, 0, 0
    page, pages, version, application = struct.unpack_from(">16xH10xI28xI4xI", content.ljust(100, b"\0"))
    return version, application, page * pages


def is_cut(path: Path) -> bool:
    """True if a database has fewer bytes than its header says."""
    return path.stat().st_size < header(path)[2]


def _make(
    database: sqlite3.Connection, kind: Kind, schema: Sequence[str], rows: Mapping[str, Sequence[Sequence[Any]]]
) -> None:
    for statement in schema:
        database.execute(statement)
    for statement, values in rows.items():
        database.executemany(statement, values)
    database.execute(f"PRAGMA application_id = {kind.application}")
    database.execute(f"PRAGMA user_version = {kind.version}")


def _upgrade(database: sqlite3.Connection, kind: Kind, version: int) -> None:
    """Upgrade a file to the present version, in the transaction that is open."""
    for older in range(version, kind.version):
        for statement in kind.upgrades[older]:
            database.execute(statement)
        database.execute(f"PRAGMA user_version = {older + 1}")
