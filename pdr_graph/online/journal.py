"""The journal of a live walk: acknowledged events survive kill -9, and the walk resumes by replaying them.

A `RecordLog` is a file that is only ever appended to: eight bytes that name its kind, then for each record a header
(checksum, length, identity, time of arrival) and its bytes, compressed. What was appended survives the end of the
process. Bytes that are no whole record are passed over, so damage costs the records that it hits and no others. The
last bytes of the file, which the next record replaces, mark its end: a file without them was cut off.

The journal is such a log of the walk's settings and its events. ``push`` appends the event, and only then passes it to
the navigator. A navigator is a function of its events, so that a resumed one continues exactly as one that was never
interrupted; it receives the decoded event, with the memory layout of a replayed one. Replaying takes 3 to 9 % of the
time of the walk.
"""

from __future__ import annotations

import mmap
import os
import struct
import time
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO, Generic, Literal, TypeVar

from pdr_graph.errors import InputError, check_not_special, count, expect
from pdr_graph.online.interface import Event, LiveEstimator, Pose, Status, event_types
from pdr_graph.recovery import keep_aside
from pdr_graph.storage import CHECKSUM, decode, decode_json, encode_and_decode, encode_json
from pdr_graph.types import Estimate, Trajectory
from pdr_graph.whole_files import lock

WALK_MAGIC, MESSAGES = b"PDRGWALK", b"PDRGLOG1"  # first bytes of a journal, and of the messages of a session of serve
END = b"PDRGEND\n"  # shorter than a header
RECORD_HEADER = struct.Struct("<IIqd")  # checksum of the rest, bytes of the body, identity, Unix time of arrival [s]
ZLIB_START = b"x\x01"  # how bytes begin that are compressed at this level
ADVICE = "finish the walk with the pdr_graph that began it, or start a new --journal"
SECONDS = {"process": float("inf"), "minute": 60.0, "power": 0.0}  # [s] between two waits for the disk
Navigator = TypeVar("Navigator", bound=LiveEstimator)


@dataclass(frozen=True)
class Entry:
    """A record in a log. identity: its number; received: Unix time [s]; offset: of its header [bytes]; skipped: number
    of damaged bytes before it.
    """

    identity: int
    received: float
    offset: int
    end: int
    skipped: int = 0


class RecordLog:
    """A log of records, open for appending; ``file``: its descriptor, ``end``: its length without END [bytes]; ``cut``:
    True if END was missing.

    kind: its first bytes; sync: seconds between two waits for the disk.
    Raises OSError of the disk. What follows the last whole record was not written completely: it stays, and further
    records come after it.
    """

    def __init__(self, path: Path, kind: bytes, sync: float = SECONDS["process"]):
        self._path, self._sync, self._synced = path, sync, time.monotonic()
        bytes_as_they_are = getattr(os, "O_BINARY", 0)  # Windows writes two bytes for each end of a line otherwise
        self.file = os.open(path, os.O_CREAT | os.O_RDWR | bytes_as_they_are, 0o600)  # owner only
        begin = os.read(self.file, len(kind))
        self.end = os.lseek(self.file, 0, os.SEEK_END)
        os.lseek(self.file, max(0, self.end - len(END)), os.SEEK_SET)
        self.cut = self.end > 0 and os.read(self.file, len(END)) != END
        if self.end and not self.cut:
            self.end -= len(END)
        if self.end < len(kind) and kind.startswith(begin):  # the process was killed before it wrote all of it
            self._write(kind[self.end :])

    def append(self, identity: int, received: float, body: bytes) -> None:
        """Append a record. Raises OSError if the disk fails; the log is then unchanged."""
        packed = zlib.compress(body, 1)  # level of zlib: the next ones take twice the time for little
        rest = RECORD_HEADER.pack(0, len(packed), identity, received)[CHECKSUM:] + packed
        self._write(struct.pack("<I", zlib.crc32(rest)) + rest)

    def truncate(self, end: int) -> None:
        """Delete what follows the first ``end`` bytes."""
        os.ftruncate(self.file, end)
        self.end = end
        self._write(b"")

    def close(self) -> None:
        """Close the file."""
        os.close(self.file)

    def _write(self, data: bytes) -> None:
        view = memoryview(data + END)
        os.lseek(self.file, self.end, os.SEEK_SET)
        try:
            while view:  # a disk that becomes full writes a part without an error
                view = view[os.write(self.file, view) :]
            if time.monotonic() - self._synced >= self._sync:
                os.fsync(self.file)
                self._synced = time.monotonic()
        except OSError as error:
            os.ftruncate(self.file, self.end)
            with suppress(OSError):
                os.lseek(self.file, self.end, os.SEEK_SET)
                os.write(self.file, END)
            raise OSError(error.errno, error.strerror or str(error), str(self._path)) from None
        self.end += len(data)


def read_entries(path: Path, offset: int = 0, kind: bytes = MESSAGES) -> Iterator[Entry]:
    """Yield the whole records of a log from an offset [bytes]; stops before one that is still being written.

    Raises InputError for other files.
    """
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        if file.read(len(kind)) != kind and _found_after(file, 0, size) is None:
            expected = f"a journal of this version: {ADVICE}" if kind == WALK_MAGIC else "a log of pdr-graph serve"
            raise InputError(path, "", "another kind of file", expected)
        offset = max(offset, len(kind))
        while (entry := _entry_at(file, offset, size) or _found_after(file, offset, size)) is not None:
            yield entry
            offset = entry.end


def _entry_at(file: BinaryIO, offset: int, size: int) -> Entry | None:
    """The record at an offset of a file of a size [bytes]; None if there is no whole one."""
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
    """The first whole record after an offset where there is none; None if there is none to the end."""
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
    """The bytes of a record. Raises InputError if they are damaged."""
    with path.open("rb") as file:
        file.seek(entry.offset)
        record = file.read(entry.end - entry.offset)
    if zlib.crc32(record[CHECKSUM:]) != struct.unpack_from("<I", record)[0]:
        raise InputError(path, f"byte {entry.offset}", "a damaged record", "a log that is whole")
    return zlib.decompress(record[RECORD_HEADER.size :])


class Journal(Generic[Navigator]):
    """A navigator whose events survive the process, started or resumed by `Journal.open`. One thread at a time.

    count: events acknowledged so far by all processes. loss: what a power cut has damaged, "" if nothing; it is an
    issue of the status.
    """

    def __init__(self, path: Path, log: RecordLog, make: Callable[[], Navigator]):
        self._path, self._log, self._make = path, log, make
        self._navigator: Navigator | None = self._replayed()
        self.loss = ""
        if log.cut:
            self.loss = f"{path}: cut off, all later events are lost: the walk goes on after event {self.count}"
        if (end := self._end) < log.end:
            aside = keep_aside(path)
            log.truncate(end)
            text = f"damaged at byte {end}, all events after that are lost; the damaged file is {aside.name}"
            self.loss = f"{path}: {text}: the walk goes on after event {self.count}"

    @classmethod
    def open(
        cls,
        path: str | Path,
        make: Callable[[], Navigator],
        settings: Mapping[str, Any] | None = None,
        *,
        durable: Literal["process", "minute", "power"] = "minute",
    ) -> Journal[Navigator]:
        """Start a journal, or continue the walk of an existing one.

        make: returns a navigator at the start of a walk.
        settings: options of the navigator, of JSON types; they must be the same when the walk continues.
        durable: every event survives the end of the process. "minute": a power cut costs the last minute of events;
            "power": it costs nothing, and each event waits for the disk; "process": nothing waits.

        A damaged journal comes back to its last whole event, and ``loss`` says so; the damaged file is kept beside it.

        Raises InputError if the file is no journal, of another version or other settings, in use, or so damaged that
        no walk comes back; OSError if it cannot be written.
        """
        path, requested = Path(path), encode_json(dict(settings or {})).encode()
        if path.exists():
            check_not_special(path, "a journal, or a name that is not taken")
        log = RecordLog(path, WALK_MAGIC, SECONDS[durable])
        try:
            lock(log.file, path)
            first = next(read_entries(path, kind=WALK_MAGIC), None)
            if first is None and log.end == len(WALK_MAGIC):
                log.append(0, time.time(), requested)
            elif first is None or first.identity or first.skipped:
                raise InputError(path, "settings", "a damaged journal", "a whole one: start the walk with another file")
            else:
                stored, wanted = (decode_json(text.decode(), dict) for text in (read_body(path, first), requested))
                for name in sorted(stored.keys() | wanted.keys()):
                    if stored.get(name) != wanted.get(name):
                        expected = f"{wanted.get(name)}, or that with which the walk began"
                        raise InputError(path, name, f"{stored.get(name)}", expected)
            return cls(path, log, make)
        except BaseException:
            log.close()
            raise

    def __repr__(self) -> str:
        return f"Journal({str(self._path)!r}, {count(self.count, 'event')})"

    def push(self, event: Event) -> None:
        """Process an event; after the return it is in the journal.

        After an exception the event is not in the journal and the navigator has its former state. Raises OSError if the
        disk is full or fails, TypeError if the event is malformed, or any error of the navigator.
        """
        expect("Journal.push, event", event, *event_types(), instead="events_of(recording)")
        navigator = self.navigator
        blob, event = encode_and_decode(event)
        end = self._log.end
        self._log.append(self.count + 1, time.time(), blob)
        try:
            navigator.push(event)
        except BaseException:  # also Ctrl-C: the navigator may have used half of the event
            self._navigator = None
            self._log.truncate(end)
            raise
        self.count += 1

    @property
    def navigator(self) -> Navigator:
        """The navigator after all events; after one that failed, another that has replayed those before."""
        if self._navigator is None:
            self._navigator = self._replayed()
        return self._navigator

    def review(self) -> None:
        """Let the navigator do long computations in an idle moment."""
        self.navigator.review()

    @property
    def pose(self) -> Pose | None:
        """The causal pose, None before there is one."""
        return self.navigator.pose

    @property
    def filtered(self) -> Pose | None:
        """The pose of the Kalman filter beside the smoother; None before there is one."""
        return getattr(self.navigator, "filtered", None)  # another class of navigator need not have it

    @property
    def steps(self) -> int:
        """Number of steps so far."""
        return self.navigator.steps

    @property
    def status(self) -> Status:
        """The state of the navigator."""
        status: Any = self.navigator.status  # a dataclass
        return replace(status, issues=(*status.issues, self.loss)) if self.loss else status

    @property
    def trajectory(self) -> Trajectory:
        """The walk smoothed so far, from its beginning."""
        return self.navigator.trajectory

    def finish(self) -> Estimate:
        """End the walk and return its estimate."""
        return self.navigator.finish()

    def close(self) -> None:
        """Close the file, so that another process can continue the walk."""
        self._log.close()

    def __enter__(self) -> Journal[Navigator]:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _replayed(self) -> Navigator:
        """A new navigator after all events of the file before the first damaged byte, at ``_end``."""
        navigator, self.count = self._make(), 0
        for number, entry in enumerate(read_entries(self._path, kind=WALK_MAGIC)):
            if entry.skipped or entry.identity != number:
                break
            if number:
                try:
                    event: Any = decode(read_body(self._path, entry), *event_types())
                except ValueError as error:
                    raise InputError(self._path, f"event {number}", str(error), "a journal that is whole") from None
                try:
                    navigator.push(replace(event))  # with columns that are new since then
                except Exception:  # the process ended before `push` could delete this event, which was not acknowledged
                    if entry.end < self._log.end:
                        raise
                    self._log.truncate(entry.offset)
                    return self._replayed()
            self.count, self._end = number, entry.end
        return navigator
