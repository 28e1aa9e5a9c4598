"""Rows of a person's past: positions, receptions of Wi-Fi, guesses of other programs.

Merging of several exports does not depend on their order or overlaps. A position stands for its whole second. Of
several in a second the most accurate is kept: the same fix has another number of decimals in another export. Google's
processed path is kept apart from what was measured, and only where nothing accurate was measured near in time.

The midnight of a position is that of the sun, by its longitude: days part at night wherever the person is, and the day
of a position depends on nothing else. Receptions, whose place is unknown, have UTC days.
"""

from __future__ import annotations

import math
import re
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any, BinaryIO

import numpy as np

from pdr_graph.apps.lifelog import cache
from pdr_graph.apps.lifelog.facts import Guess
from pdr_graph.apps.lifelog.local_time import zone_at, zone_named
from pdr_graph.errors import count
from pdr_graph.frames import METRES_PER_DEGREE
from pdr_graph.io.past_day import CM, E7, GOOGLE_PATH, MS, NO_ACCURACY, POSITION, RECEPTIONS, SIGHTING, Rows
from pdr_graph.io.validation import (
    LOST_WEEKS,
    MAYBE_LOST,
    NO_ZONE,
    RECEIVER,
    ROLLOVER,
    float_of,
    in_seconds,
    plausible_times,
    rolls_over,
    unix_time,
    unix_times,
    without_rollover,
    zoneless,
)
from pdr_graph.types import Array, Index, Mask, OneLineRepr

PATH_ACCURACY = 113.0  # [m] 68 % radius of a point of Google's processed path, sigma 75 m per axis; chosen by hand


QUARTER_MS = int(900 * MS)  # changes of local time are at full quarters
FIRST_TIME = 315_964_800.0  # [s] Unix time of 1980-01-06, the first of GPS


@dataclass(frozen=True)
class Batch(OneLineRepr):
    """Some rows of a file. positions: of POSITION; sightings: of SIGHTING; left_out: number of invalid positions by
    reason; notes: warnings, a line each; unzoned: positions whose time has no zone.
    """

    positions: Rows = field(default_factory=lambda: np.empty(0, POSITION))
    sightings: Rows = field(default_factory=lambda: np.empty(0, SIGHTING))
    guesses: tuple[Guess, ...] = ()
    left_out: Counter[str] = field(default_factory=Counter[str])
    notes: tuple[str, ...] = ()
    unzoned: Index = field(default_factory=lambda: np.empty(0, np.intp))

    def after(self, last: float) -> Batch:
        """The batch of a track, put right if it is 1024 weeks before the `last` time of the batch before [s]."""
        if not len(self.positions) or not rolls_over(self.positions["time"][0] / MS - last):
            return self
        positions = self.positions.copy()
        positions["time"] += round(ROLLOVER * MS)
        others = (note for note in self.notes if not note.endswith(MAYBE_LOST))
        return replace(self, positions=positions, notes=(*others, f"positions: {LOST_WEEKS}"))

    def in_zone(self, zone: str) -> Batch:
        """The batch with times without a zone as those of a zone, "" for that of each position."""
        if not len(self.unzoned):
            return self
        positions, offsets = self.positions.copy(), dict[tuple[str, int], int]()
        for n in self.unzoned.tolist():
            time, lat, lon = (int(positions[name][n]) for name in ("time", "lat", "lon"))
            key = zone or zone_at(lat / E7, lon / E7), time // QUARTER_MS
            if key not in offsets:
                local = datetime.fromtimestamp(time / MS, UTC).replace(tzinfo=zone_named(key[0]))
                offsets[key] = round((local.utcoffset() or timedelta()).total_seconds() * MS)
            positions["time"][n] = time - offsets[key]
        where = zone or "where they were"
        notes = (NO_ZONE.replace("UTC", f"those of {where}") if note == NO_ZONE else note for note in self.notes)
        return replace(self, positions=positions, notes=tuple(notes))

    def _summary(self) -> list[str]:
        parts = [count(len(self.positions), "position"), count(len(self.sightings), "reception")]
        return [*parts, count(len(self.guesses), "guess"), f"{self.left_out.total()} left out"]


@dataclass(frozen=True)
class Format:
    """A file format. sign: pattern in the first bytes of its files; rows: reads a stream, whose name in messages is the
    second argument, some rows at a time. Raises InputError where the file is damaged.
    """

    name: str
    sign: re.Pattern[bytes]
    rows: Callable[[BinaryIO, str], Iterator[Batch]]


def valid_positions(
    time: Array, lat: Array, lon: Array, accuracy: Array, source: Any, unzoned: Mask | None = None
) -> Batch:
    """The valid positions, and how many are invalid for which reason.

    time: ``(n,)`` Unix times [s, ms, µs or ns]; lat, lon: [deg]; accuracy: 68 % radius [m], not above 0 or NaN if
    unknown; each NaN where missing. source: number in SOURCES, of all or ``(n,)``; unzoned: as of `Batch`, a mask.
    """
    time = in_seconds(time)
    with np.errstate(invalid="ignore"):
        tests: dict[str, Mask] = {
            "no time": ~np.isfinite(time),
            "no position": ~(np.isfinite(lat) & np.isfinite(lon)),
            "a time before 1980 or after tomorrow": ~((time >= FIRST_TIME) & plausible_times(time)),
            "latitude and longitude swapped?": (np.abs(lat) > 90) & (np.abs(lat) <= 180) & (np.abs(lon) <= 90),
            "a latitude beyond 90° or a longitude beyond 180°": ~((np.abs(lat) <= 90) & (np.abs(lon) <= 180)),
            "latitude 0, longitude 0": (lat == 0) & (lon == 0),
            "a negative accuracy": accuracy < 0,
        }
        stated = (accuracy > 0) & np.isfinite(accuracy)
    valid, left_out = np.ones(len(time), bool), Counter[str]()
    for reason, fails in tests.items():
        if (new := int((fails & valid).sum())) > 0:
            left_out[reason] = new
        valid &= ~fails
    rows = np.zeros(int(valid.sum()), POSITION)
    rows["time"], rows["lat"], rows["lon"] = (
        np.rint(values[valid] * unit) for values, unit in ((time, MS), (lat, E7), (lon, E7))
    )
    # largest accuracy [m]: no two points on earth are farther apart than twice this
    radius = np.clip(np.rint(np.where(stated, np.minimum(accuracy, 10_000_000.0), 0)[valid] * CM), 1, None)
    rows["accuracy"] = np.where(stated[valid], radius, NO_ACCURACY)
    rows["source"] = source[valid] if isinstance(source, np.ndarray) else source
    return Batch(rows, left_out=left_out, unzoned=np.flatnonzero([] if unzoned is None else unzoned[valid]))


Point = tuple[Any, tuple[float, float], float, int]  # time, latitude and longitude [deg], accuracy [m], source


def batch_of(
    points: Sequence[Point],
    unreadable: int = 0,
    guesses: Iterable[Guess] = (),
    left_out: Mapping[str, int] = MappingProxyType({}),
) -> Batch:
    """The valid positions and the guesses whose times are valid; the others are counted.

    unreadable: number of elements that could not be read; left_out: numbers of others, by reason.
    """
    texts, notes = [point[0] for point in points], list[str]()
    time = without_rollover(unix_times(texts), "positions", notes)
    unzoned = zoneless(texts)
    notes += [NO_ZONE] if unzoned.any() else []
    lat, lon = np.array([point[1] for point in points], float).reshape(-1, 2).T
    accuracy = np.array([point[2] for point in points], float)
    source = np.array([point[3] for point in points], np.uint8)
    batch = valid_positions(time, lat, lon, accuracy, source, unzoned)
    items = tuple(guesses)
    valid = tuple(item for item in items if math.isfinite(item.start))
    lost = {"unreadable": unreadable, "a visit or activity without a valid time": len(items) - len(valid)}
    left_out = +(batch.left_out + Counter(left_out) + Counter(lost))
    return replace(batch, guesses=valid, left_out=left_out, notes=tuple(notes))


def guess(source: str, kind: str, times: tuple[Any, Any], name: Any, place: tuple[float, float], share: Any) -> Guess:
    """A guess from untrusted values; its times are NaN if they are invalid.

    times: start and stop, as of `unix_time`; place: latitude and longitude [deg]; share: probability from 0 to 1.
    """
    start, stop = (unix_time(time) for time in times)
    if not (FIRST_TIME <= start <= stop and plausible_times(np.array(stop))):
        start = stop = math.nan
    lat, lon = place if abs(place[0]) <= 90 and abs(place[1]) <= 180 else (math.nan, math.nan)
    probability = float_of(share)
    probability = probability if 0 <= probability <= 1 else math.nan
    # longest name: characters of a guess's name
    text = "".join(c for c in name if c.isprintable())[:200] if isinstance(name, str) else ""
    return Guess(source, start, stop, kind, text, lat, lon, probability)


SECOND_MS = 1000


def merged_positions(rows: Rows) -> Rows:
    """The positions of a day without duplicates, in order of time, measured ones before the path.

    Positions that were computed from receptions are left out.
    """
    rows = rows[rows["source"] != RECEPTIONS]
    is_path = rows["source"] == GOOGLE_PATH
    path = rows[is_path]
    measured = _best_of_each_second(rows[~is_path])
    path = path[~_shadowed(path, measured)]
    if not len(path):
        return measured
    both = np.concatenate([measured, _best_of_each_second(path)])
    return both[np.lexsort((both["source"], both["time"]))]


def merged_sightings(rows: Rows) -> Rows:
    """The receptions of a day without duplicates, the strongest of each access point and time, in order of time."""
    rows = rows[np.lexsort((-rows["rssi"].astype(int), rows["mac"], rows["time"]))]
    again = (np.diff(rows["time"]) == 0) & (np.diff(rows["mac"]) == 0)
    return rows[~np.append(False, again)[: len(rows)]]


def changes(before: Rows, after: Rows) -> tuple[int, int]:
    """Number of positions that are new in `after`, and that replace a less accurate one."""
    _, old, now = np.intersect1d(_keys(before), _keys(after), assume_unique=True, return_indices=True)
    return len(after) - len(now), int((before[old] != after[now]).sum())


def assumed_accuracy(rows: Rows) -> Array:
    """The 68 % radius ``(n,)`` [m], where it is unknown that which a reader assumes."""
    return np.where(rows["accuracy"] == NO_ACCURACY, RECEIVER.accuracy, rows["accuracy"] / CM)


def metres_of(rows: Rows) -> Array:
    """Positions ``(n, 2)`` east and north [m] on a plane about the first."""
    lat, lon = rows["lat"] / E7, rows["lon"] / E7
    east = METRES_PER_DEGREE * np.cos(np.radians(lat[:1])) * (lon - lon[:1])
    return np.column_stack([east, METRES_PER_DEGREE * (lat - lat[:1])])


def _keys(rows: Rows) -> Index:
    """A number for each position, equal for those of which one is kept."""
    return 2 * (rows["time"] // SECOND_MS) + (rows["source"] == GOOGLE_PATH)


def _best_of_each_second(rows: Rows) -> Rows:
    """The most accurate position of each second; of equally accurate ones always the same one."""
    second = rows["time"] // SECOND_MS
    if (np.diff(second) > 0).all():
        return rows
    ties = (rows["source"], rows["lon"], rows["lat"], rows["time"], rows["accuracy"])
    order = np.lexsort((*ties, assumed_accuracy(rows), second))
    return rows[order][np.append(True, np.diff(second[order]) > 0)[: len(rows)]]


def _shadowed(path: Rows, measured: Rows) -> Mask:
    """True for points of the path near in time to a measured position that is more accurate."""
    times = (measured["time"] // SECOND_MS)[assumed_accuracy(measured) <= PATH_ACCURACY]
    if not len(times):
        return np.zeros(len(path), bool)
    second = path["time"] // SECOND_MS
    after = np.searchsorted(times, second)
    gaps = [np.abs(times[np.clip(after + by, 0, len(times) - 1)] - second) for by in (-1, 0)]
    # shadow [s] from an accurate measurement within which the path is not used; chosen by hand
    return np.minimum(*gaps) <= 300


DAY_MS = 86_400_000
SUN_MS = DAY_MS / 360 / E7  # [ms] per 1e-7 degree of longitude
MOST_ROWS = 1_000_000  # in memory: 21 MB, and as much again while they are sorted


def day_of(rows: Rows) -> Index:
    """The day ``(n,)`` of each row, counted from 1970-01-01."""
    names = rows.dtype.names or ()
    sun = np.rint(rows["lon"] * SUN_MS).astype(np.int64) if "lon" in names else 0
    return (rows["time"] + sun) // DAY_MS


class DaySpill:
    """Collects rows of one type, which have a ``time`` [ms]; a context manager, whose files are then removed."""

    def __init__(self, folder: Path, kind: np.dtype[np.void]):
        """folder: for the temporary files, of their owner alone."""
        cache.make_folder(folder)
        self._folder = Path(tempfile.mkdtemp(cache.PARTIAL, dir=folder))
        self._kind, self._waiting, self._size = kind, list[Rows](), 0
        self.number = 0  # of rows added

    def add(self, rows: Rows) -> None:
        """Add rows, in any order."""
        if len(rows):
            self._waiting.append(rows)
            self._size += len(rows)
            self.number += len(rows)
        if self._size > MOST_ROWS:
            self._write()

    def days(self) -> list[int]:
        """The days that have rows, counted from 1970-01-01."""
        self._write()
        return sorted(int(file.name) for file in self._folder.iterdir())

    def rows(self, day: int) -> Rows:
        """The rows of a day, in the order in which they were added."""
        file = self._folder / str(day)
        return np.fromfile(file, self._kind) if file.exists() else np.empty(0, self._kind)

    def _write(self) -> None:
        """Append the rows in memory to the files of their days."""
        if not self._waiting:
            return
        rows = np.concatenate(self._waiting)
        self._waiting, self._size = [], 0
        day = day_of(rows)
        if (np.diff(day) < 0).any():
            order = np.argsort(day, kind="stable")
            rows, day = rows[order], day[order]
        numbers, first = np.unique(day, return_index=True)
        for number, part in zip(numbers.tolist(), np.split(rows, first[1:]), strict=True):
            with (self._folder / str(number)).open("ab") as file:
                part.tofile(file)

    def __enter__(self) -> DaySpill:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        shutil.rmtree(self._folder, ignore_errors=True)
