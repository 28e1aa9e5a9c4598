"""The files of a past: alone, in folders or zips (Google Takeout), recognised by their content and read as streams."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import IO, BinaryIO, cast

from pdr_graph.errors import InputError
from pdr_graph.io.source import Source
from pdr_graph.lifelog.past import (
    fit,
    google_edits,
    google_ios,
    google_records,
    google_semantic,
    google_timeline,
    gpx_track,
    kml,
    overland_batches,
    owntracks_log,
)
from pdr_graph.lifelog.past.past_rows import Batch

# Modules with NAME, recognizes(head) and read(stream, where); the first that recognises a file reads it
READERS: tuple[ModuleType, ...] = (
    fit,
    google_records,
    google_semantic,
    google_timeline,
    google_edits,
    overland_batches,
    google_ios,
    owntracks_log,
    gpx_track,
    kml,
)
HEAD = 65_536  # [bytes] of a file by which it is recognised
LARGEST = 20_000_000_000  # [bytes] unpacked of one argument; ten years of Records.json have 2 GB
MOST_FILES, DEEPEST = 100_000, 8  # a Takeout has other products beside the timeline
# What a file is that comes with a timeline and is none
OTHERS = (
    (
        re.compile(rb'"(?:deviceSettings|hasReportedLocations|hasSetRetention)"'),
        "settings of Google's timeline",
    ),
    (
        re.compile(rb"(?i)\A[^{\[<]*encrypted[^{\[<]*\Z"),
        "an encrypted backup, which only the phone can read",
    ),
)
EXPECTED = "a timeline: " + ", ".join(reader.NAME for reader in READERS)


@dataclass(frozen=True)
class PastFile:
    """A file that a reader recognises. where: its name in messages; size: [bytes]."""

    source: Source
    name: str
    reader: ModuleType
    size: int

    @property
    def where(self) -> str:
        """Its name in messages."""
        return self.source.where(self.name)

    def batches(self, advance: Callable[[int], None]) -> Iterator[Batch]:
        """Read its rows, some at a time; advance: called with the number of bytes read since the last call.

        Raises InputError if it is damaged.
        """
        with self.source.stream(self.name) as stream:
            yield from self.reader.read(cast("BinaryIO", _CountedStream(stream, self.where, advance)), self.where)


class _CountedStream:
    """A stream that reports how much is read, and refuses more than LARGEST."""

    def __init__(self, stream: IO[bytes], where: str, advance: Callable[[int], None]):
        self._stream, self._where, self._advance = stream, where, advance
        self._left = LARGEST

    def read(self, size: int) -> bytes:
        return self._counted(self._stream.read(size))

    def readline(self, size: int) -> bytes:
        return self._counted(self._stream.readline(size))

    def _counted(self, content: bytes) -> bytes:
        self._left -= len(content)
        if self._left < 0:
            raise InputError(self._where, "", f"more than {LARGEST // 10**9} GB", "fewer")
        self._advance(len(content))
        return content


def find_files(paths: Sequence[Path]) -> tuple[list[PastFile], int, list[str], list[str]]:
    """Find timelines in files, folders and zips; returns them, the number of other files, and two lists of lines: what
    some of these are, and why paths are refused.
    """
    found, skipped, notes, refused = list[PastFile](), 0, list[str](), list[str]()
    for path in dict.fromkeys(paths):
        try:
            source = Source(path, "timeline", LARGEST, MOST_FILES, DEEPEST)
            lines = list[str]()
            before = len(found)
            for name in source.names:
                try:
                    found.append(_recognized(source, name))
                except InputError as error:
                    skipped += 1
                    lines += [str(error)] if source.single or "expected a timeline: " not in str(error) else []
            (notes if len(found) > before else refused).extend(lines)
            if len(found) == before and not lines:
                raise InputError(path, "", f"{len(source.names)} files, none of them a timeline", EXPECTED)
        except InputError as error:
            refused.append(str(error))
        except OSError as error:
            refused.append(str(InputError(path, "", error.strerror or str(error), "a readable file")))
    return found, skipped, notes, refused


def _recognized(source: Source, name: str) -> PastFile:
    """The file with the reader that recognises it. Raises InputError, which says what else it is."""
    head = source.head(name, HEAD)
    where = source.where(name)
    reader = next((reader for reader in READERS if reader.recognizes(head.removeprefix(b"\xef\xbb\xbf"))), None)
    if reader is not None:
        return PastFile(source, name, reader, source.size(name))
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise InputError(where, "", "UTF-16 text", "UTF-8: save it again with this encoding")
    other = next((what for sign, what in OTHERS if sign.search(head)), "")
    if other:
        raise InputError(where, "", other, "a timeline")
    raise InputError(where, "", repr(head[:40]) if head else "an empty file", EXPECTED)
