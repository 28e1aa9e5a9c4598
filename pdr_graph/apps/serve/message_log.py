"""The log of a session: every message of a phone, as it came, before it is acknowledged.

One file, only ever appended to: MAGIC, then for each message a header (checksum, length, identity, time of arrival) and
its bytes, compressed. What was appended survives the end of the process; a power cut may cost the last seconds.
Bytes that are no whole message are passed over and stay, so damage costs the messages that it hits and no others. It
is also the queue between the process that receives and the one that estimates: waiting messages cost no memory.
"""

from __future__ import annotations

import mmap
import os
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

from pdr_graph.errors import InputError
from pdr_graph.storage import CHECKSUM

MAGIC = b"PDRGLOG1"
RECORD_HEADER = struct.Struct("<IIqd")  # checksum of the rest, bytes of the body, identity, Unix time of arrival [s]
ZLIB_START = b"x\x01"  # how bytes begin that are compressed at this level


@dataclass(frozen=True)
class Entry:
    """A message in a log. identity: the app's number of it; received: Unix time [s]; offset: of its header [bytes];
    skipped: number of damaged bytes before it.
    """

    identity: int
    received: float
    offset: int
    end: int
    skipped: int = 0


class MessageLog:
    """The log of one session, open for appending; ``identities`` of all its messages.

    Raises InputError if the file is no log; OSError if the disk fails. What follows the last whole message was not
    written completely: it stays, and further messages come after it.
    """

    def __init__(self, path: Path):
        self._path = path
        self._file = os.open(path, os.O_CREAT | os.O_RDWR, 0o600)  # owner only
        try:
            if os.fstat(self._file).st_size < len(MAGIC):
                os.ftruncate(self._file, 0)
                _write(self._file, MAGIC)
            self.identities = {entry.identity for entry in read_entries(path)}
            self._end = os.lseek(self._file, 0, os.SEEK_END)
        except BaseException:
            os.close(self._file)
            raise

    def append(self, identity: int, received: float, body: bytes) -> bool:
        """Append a message; False if one of this identity is there already. Raises OSError if the disk fails."""
        if identity in self.identities:
            return False
        record = pack(identity, received, body)
        try:
            _write(self._file, record)
        except OSError:  # a full disk: what was written of it is no message
            os.ftruncate(self._file, self._end)
            os.lseek(self._file, self._end, os.SEEK_SET)
            raise
        self._end += len(record)
        self.identities.add(identity)
        return True

    def close(self) -> None:
        """Close the file."""
        os.close(self._file)


def pack(identity: int, received: float, body: bytes) -> bytes:
    """The record of a message."""
    packed = zlib.compress(body, 1)  # level of zlib: the next ones take twice the time for little
    rest = RECORD_HEADER.pack(0, len(packed), identity, received)[CHECKSUM:] + packed
    return struct.pack("<I", zlib.crc32(rest)) + rest


def read_entries(path: Path, offset: int = len(MAGIC)) -> Iterator[Entry]:
    """Yield the whole messages of a log from an offset [bytes]; stops before one that is still being written.

    Raises InputError for other files.
    """
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        if file.read(len(MAGIC)) != MAGIC and _found_after(file, 0, size) is None:
            raise InputError(path, "", "another kind of file", "a log of pdr-graph serve")
        while (entry := _entry_at(file, offset, size) or _found_after(file, offset, size)) is not None:
            yield entry
            offset = entry.end


def _entry_at(file: BinaryIO, offset: int, size: int) -> Entry | None:
    """The message at an offset of a file of a size [bytes]; None if there is no whole one."""
    file.seek(offset)
    header = file.read(RECORD_HEADER.size)
    if len(header) < RECORD_HEADER.size:
        return None
    checksum, length, identity, received = RECORD_HEADER.unpack(header)
    end = offset + RECORD_HEADER.size + length
    if end > size or zlib.crc32(file.read(length), zlib.crc32(header[CHECKSUM:])) != checksum:
        return None
    return Entry(identity, received, offset, end)


def _found_after(file: BinaryIO, offset: int, size: int) -> Entry | None:
    """The first whole message after an offset where there is none; None if there is none to the end."""
    if offset + RECORD_HEADER.size >= size:
        return None
    with mmap.mmap(file.fileno(), size, access=mmap.ACCESS_READ) as content:
        body = offset + RECORD_HEADER.size
        while (body := content.find(ZLIB_START, body + 1)) >= 0:
            entry = _entry_at(file, body - RECORD_HEADER.size, size)
            if entry is not None:
                return replace(entry, skipped=entry.offset - offset)
    return None


def read_body(path: Path, entry: Entry) -> bytes:
    """The bytes of a message. Raises InputError if they are damaged."""
    with path.open("rb") as file:
        file.seek(entry.offset)
        record = file.read(entry.end - entry.offset)
    if zlib.crc32(record[CHECKSUM:]) != struct.unpack_from("<I", record)[0]:
        raise InputError(path, f"byte {entry.offset}", "a damaged message", "a log that is whole")
    return zlib.decompress(record[RECORD_HEADER.size :])


def _write(file: int, data: bytes) -> None:
    """Write all bytes: a disk that becomes full writes a part without an error."""
    view = memoryview(data)
    while view:
        view = view[os.write(file, view) :]
