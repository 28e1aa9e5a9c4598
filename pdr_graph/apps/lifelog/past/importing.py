"""Import a person's past into a lifelog: read exports in any order, merge them by day, keep foreign guesses apart.

Files come alone, in folders or zips (Google Takeout), are recognised by their content and read as streams. Memory does
not grow with them: their rows wait on disk, parted by days, and each day is merged by itself.
"""

from __future__ import annotations

import errno
import os
import re
import shutil
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, BinaryIO, cast

import numpy as np

from pdr_graph.apps.lifelog import cache
from pdr_graph.apps.lifelog.facts import END, Guess, forgotten_times
from pdr_graph.apps.lifelog.ingest import DEFAULT_PERSON
from pdr_graph.apps.lifelog.local_time import checked_zone
from pdr_graph.apps.lifelog.past import google, tracks
from pdr_graph.apps.lifelog.past.past_days import FOLDER, Changes, PastDays, add_sources, enter
from pdr_graph.apps.lifelog.past.past_rows import Batch, DaySpill, Format, assumed_accuracy, day_of, metres_of
from pdr_graph.apps.lifelog.sessions import doubted_positions
from pdr_graph.apps.lifelog.store import Store
from pdr_graph.errors import InputError, count, quoted
from pdr_graph.io.past_day import GOOGLE_PATH, MS, POSITION, RECEPTIONS, SIGHTING, Rows
from pdr_graph.io.source import Source
from pdr_graph.io.validation import NO_ZONE, RADIUS_68
from pdr_graph.types import DAY_LENGTH

# The first whose sign a file has reads it
PAST_FORMATS = (
    tracks.FIT,
    *google.GOOGLE_FORMATS,
    tracks.OVERLAND,
    google.IOS_TIMELINE,
    tracks.OWNTRACKS,
    tracks.GPX_TRACKS,
    tracks.KML,
    tracks.TCX,
)
HEAD_BYTES = 65_536  # [bytes] of a file by which it is recognised
LARGEST_UNPACKED = 20_000_000_000  # [bytes] unpacked of one argument; ten years of Records.json have 2 GB
MOST_FILES, DEEPEST_FOLDER = 100_000, 8  # a Takeout has other products beside the timeline
# What a file is that comes with a timeline and is none
OTHER_FILES = (
    (
        re.compile(rb'"(?:deviceSettings|hasReportedLocations|hasSetRetention)"'),
        "settings of Google's timeline",
    ),
    (
        re.compile(rb"(?i)\A[^{\[<]*encrypted[^{\[<]*\Z"),
        "an encrypted backup, which only the phone can read",
    ),
)
EXPECTED_TIMELINE = "a timeline: " + ", ".join(form.name for form in PAST_FORMATS)


@dataclass(frozen=True)
class PastFile:
    """A file of a known format. size: [bytes]."""

    source: Source
    name: str
    format: Format
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
            yield from self.format.rows(cast("BinaryIO", _CountedStream(stream, self.where, advance)), self.where)


class _CountedStream:
    """A stream that reports how much is read, and refuses more than LARGEST_UNPACKED."""

    def __init__(self, stream: IO[bytes], where: str, advance: Callable[[int], None]):
        self._stream, self._where, self._advance = stream, where, advance
        self._left = LARGEST_UNPACKED

    def read(self, size: int) -> bytes:
        return self._counted(self._stream.read(size))

    def readline(self, size: int) -> bytes:
        return self._counted(self._stream.readline(size))

    def _counted(self, content: bytes) -> bytes:
        self._left -= len(content)
        if self._left < 0:
            raise InputError(self._where, "", f"more than {LARGEST_UNPACKED // 10**9} GB", "fewer")
        self._advance(len(content))
        return content


def find_files(paths: Sequence[Path]) -> tuple[list[PastFile], int, list[str], list[str]]:
    """Find timelines in files, folders and zips; returns them, the number of other files, and two lists of lines: what
    some of these are, and why paths are refused.
    """
    found, skipped, notes, refused = list[PastFile](), 0, list[str](), list[str]()
    for path in dict.fromkeys(paths):
        try:
            source = Source(path, "timeline", LARGEST_UNPACKED, MOST_FILES, DEEPEST_FOLDER)
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
                raise InputError(path, "", f"{len(source.names)} files, none of them a timeline", EXPECTED_TIMELINE)
        except InputError as error:
            refused.append(str(error))
        except OSError as error:
            refused.append(str(InputError(path, "", error.strerror or str(error), "a readable file")))
    return found, skipped, notes, refused


def _recognized(source: Source, name: str) -> PastFile:
    """The file with its format. Raises InputError, which says what else it is."""
    head = source.head(name, HEAD_BYTES)
    where = source.where(name)
    known = next((form for form in PAST_FORMATS if form.sign.search(head)), None)
    if known is not None:
        return PastFile(source, name, known, source.size(name))
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise InputError(where, "", "UTF-16 text", "UTF-8: save it again with this encoding")
    other = next((what for sign, what in OTHER_FILES if sign.search(head)), "")
    if other:
        raise InputError(where, "", other, "a timeline")
    raise InputError(where, "", quoted(head[:40]) if head else "an empty file", EXPECTED_TIMELINE)


Progress = Callable[[str, int, int], None]  # called with the name of a stage, what is done, and all
MB = 10**6


@dataclass(frozen=True)
class ImportResult:
    """Result of an import. positions: what changed; guesses: number of new ones; placed: scans whose positions come
    from the map of access points; skipped: files that are no timelines; notes, refused: a line each.
    """

    positions: Changes
    guesses: int = 0
    placed: int = 0
    skipped: int = 0
    notes: tuple[str, ...] = ()
    refused: tuple[str, ...] = ()


def import_past(
    store: Path,
    files: Sequence[Path],
    person: str | None = None,
    progress: Progress = lambda stage, done, total: None,
    zone: str | None = None,
) -> ImportResult:
    """Import timelines of a person into a lifelog, which is created if it does not exist.

    files: of PAST_FORMATS, also folders and zips of them; person: DEFAULT_PERSON by default. What the person
    has deleted stays deleted. A file that is damaged from some place on is imported up to there. zone: of times that
    state none, LOCAL_ZONE for that of each position; UTC by default, with a note.

    Raises InputError if the person's name or the lifelog cannot be used; OSError of the disk.
    """
    person = DEFAULT_PERSON if person is None else person
    if not (person.strip() and person.isprintable()):
        raise InputError("--person", "", repr(person), "a name")
    zone = None if zone is None else checked_zone(zone)
    found, skipped, notes, refused = find_files(files)
    if not found:
        return ImportResult(Changes(), 0, 0, skipped, tuple(notes), tuple(refused))
    is_new = not store.exists()
    with Store(store, new=True) as log:
        folder = log.folder / FOLDER
        cache.remove_partial_copies(folder)
        with DaySpill(folder, POSITION) as positions, DaySpill(folder, SIGHTING) as sightings:
            reading = _Reading(log, person, sum(file.size for file in found), progress, zone)
            for file in found:
                refused += reading.read(file, positions, sightings)
            past, changed = PastDays(log, person), Changes()
            days = sorted({*positions.days(), *sightings.days()})
            _check_space(folder, ROW_SIZE * (positions.number + sightings.number + len(reading.guesses)))
            for done, day in enumerate(days, start=1):
                before, new = past.read(day)[0], positions.rows(day)
                notes += _doubts(
                    np.concatenate([before, new]), [*["earlier imports"] * len(before[:1]), *reading.files[day]]
                )
                changed += past.merge(day, new, sightings.rows(day))
                progress("days", done, len(days))
            guesses = log.put_guesses(person, (guess for guess in reading.guesses if guess.kind != END))
            log.put_guesses(person, (guess for guess in reading.guesses if guess.kind == END))
            placed = past.place_scans()
            enter(log, past, past.days())
        add_sources(log, person, {path: sorted(own.values()) for path, own in reading.spans.items()})
        result = ImportResult(changed, guesses, placed, skipped, (*notes, *reading.notes), tuple(refused))
        is_empty = not log.entries() and not log.guesses(person) and not PastDays(log, person).days()
    if is_new and is_empty:
        store.unlink(missing_ok=True)
        with suppress(OSError):
            folder.rmdir()
            folder.parent.rmdir()
    return result


ROW_SIZE = 300  # [bytes] of a row on the disk: in its day's file, while that is replaced, or of a guess


def _check_space(folder: Path, size: int) -> None:
    """Raise OSError if the disk has less space than the rows of an import [bytes]: a part of one is worse than none."""
    if shutil.disk_usage(folder).free < size:
        raise OSError(errno.ENOSPC, f"{os.strerror(errno.ENOSPC)}: {-(-size // MB)} MB of rows", str(folder))


def _doubts(rows: Rows, sources: Sequence[str]) -> tuple[str, ...]:
    """A line about the positions of a day if those of several sources are not of one person (`doubted_positions`)."""
    rows = rows[(rows["source"] != GOOGLE_PATH) & (rows["source"] != RECEPTIONS)]
    if len(sources) < 2 or not len(rows):
        return ()
    rows = rows[np.argsort(rows["time"], kind="stable")]
    return doubted_positions(rows["time"] / MS, metres_of(rows), assumed_accuracy(rows) / RADIUS_68, sources)


class _Reading:
    """Reads files into the spills; guesses: those that are kept."""

    def __init__(self, log: Store, person: str, size: int, progress: Progress, zone: str | None):
        self._size, self._progress, self._zone = size, progress, zone
        self._done = 0
        self._forgotten = forgotten_times(log.corrections(person))
        self.guesses, self.notes = list[Guess](), list[str]()
        self.files = defaultdict[int, list[str]](list)  # of each day
        self.spans = defaultdict[Path, dict[int, tuple[float, float]]](dict)  # of each path and UTC day [s]

    def read(self, file: PastFile, positions: DaySpill, sightings: DaySpill) -> list[str]:
        """Read a file; returns why it is refused, or where it is damaged, on a line."""
        refused, valid, left_out, others, last = list[str](), 0, Counter[str](), 0, np.inf
        try:
            for raw in file.batches(self._advance):
                batch = raw if self._zone is None else raw.in_zone(self._zone)
                batch = batch.after(last)
                last = batch.positions["time"][-1] / MS if len(batch.positions) else last
                valid, left_out = valid + len(batch.positions), left_out + batch.left_out
                others += len(batch.guesses) + len(batch.sightings)
                self._remember(file.source.path, batch)
                positions.add(kept_rows := self._kept(batch.positions))
                for day in set(day_of(kept_rows).tolist()):
                    self.files[day] += [] if file.where in self.files[day] else [file.where]
                sightings.add(self._kept(batch.sightings))
                touched = self._forgotten
                self.guesses += [g for g in batch.guesses if not any(a <= g.stop and b >= g.start for a, b in touched)]
                notes = (f"{file.where}: {note}{' (--zone)' if note == NO_ZONE else ''}" for note in batch.notes)
                self.notes += [note for note in notes if note not in self.notes]
        except InputError as error:
            before = f"; imported up to there: {count(valid, 'position')}" if valid else ""
            refused.append(f"{error}{before}")
        if left_out:
            reasons = ", ".join(f"{number} {reason}" for reason, number in left_out.most_common())
            total = valid + left_out.total()
            self.notes.append(f"{file.where}: {left_out.total()} of {total} positions were left out: {reasons}")
        elif not valid + others and not refused:
            self.notes.append(f"{file.where}: {file.format.name} without a position, visit or activity")
        return refused

    def _remember(self, path: Path, batch: Batch) -> None:
        """Note the times of all rows of a file, also of those that the person has deleted."""
        own, time = self.spans[path], np.concatenate([batch.positions["time"], batch.sightings["time"]]) / MS
        start = np.concatenate([time, [guess.start for guess in batch.guesses]])
        end = np.concatenate([time, [guess.stop for guess in batch.guesses]])
        day = start // DAY_LENGTH
        for number in np.unique(day).tolist():
            first, last = own.get(int(number), (np.inf, -np.inf))
            inside = day == number
            own[int(number)] = min(first, float(start[inside].min())), max(last, float(end[inside].max()))

    def _advance(self, size: int) -> None:
        self._done += size
        self._progress("MB read", self._done // MB, max(self._size, self._done) // MB)

    def _kept(self, rows: Rows) -> Rows:
        """The rows outside times that the person has deleted."""
        deleted = np.zeros(len(rows), bool)
        for start, stop in self._forgotten:
            deleted |= (rows["time"] >= start * MS) & (rows["time"] <= stop * MS)
        return rows[~deleted]
