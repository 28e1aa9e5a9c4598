"""The days of a person's past in ``STORE.d/past``: one recording per day, an entry of the lifelog each.

A day with fewer than two positions is kept without an entry: it cannot be reconstructed until a later export has more.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from pathlib import Path

import numpy as np

from pdr_graph.apps.lifelog import cache
from pdr_graph.apps.lifelog.observation import MIN_POSITIONS
from pdr_graph.apps.lifelog.past import access_points
from pdr_graph.apps.lifelog.past.access_points import ScanPositions, Scans, scans_of
from pdr_graph.apps.lifelog.past.past_rows import changes, day_of, merged_positions, merged_sightings
from pdr_graph.apps.lifelog.store import Entry, Store
from pdr_graph.io.delimited import MAXIMUM_LINE
from pdr_graph.io.past_day import HEAD_LINE, MS, POSITION, RECEPTIONS, SIGHTING, Rows, from_text, to_text
from pdr_graph.types import DAY_LENGTH

FOLDER = "past"  # in STORE.d
FIRST_DAY = date(1970, 1, 1)


@dataclass(frozen=True)
class Changes:
    """What merging changed. new, better, existing: positions that were not there, that replace less accurate ones, and
    that were there already or are less accurate; days: files that changed.
    """

    new: int = 0
    better: int = 0
    existing: int = 0
    days: int = 0

    def __add__(self, other: Changes) -> Changes:
        return Changes(*(a + b for a, b in zip(vars(self).values(), vars(other).values(), strict=True)))


class PastDays:
    """The files of the days of a person. folder: of this person."""

    def __init__(self, store: Store, person: str):
        self.person = person
        self.folder = store.folder / FOLDER / hashlib.sha256(person.encode()).hexdigest()[:16]

    def file(self, day: int) -> Path:
        """The file of a day, counted from 1970-01-01."""
        return self.folder / f"{FIRST_DAY + timedelta(days=day)}.csv"

    def read(self, day: int) -> tuple[Rows, Rows]:
        """Positions and receptions of a day; empty if it has no file. Raises InputError if it is damaged."""
        file = self.file(day)
        if not file.exists():
            return np.empty(0, POSITION), np.empty(0, SIGHTING)
        return from_text(str(file), file.read_text(encoding="utf-8"))

    def write(self, day: int, positions: Rows, sightings: Rows) -> bool:
        """Write a day, or remove its file if nothing is left; True if its content changed."""
        file = self.file(day)
        if not len(positions) + len(sightings):
            existed = file.exists()
            file.unlink(missing_ok=True)
            return existed
        content = to_text(self.person, positions, sightings).encode()
        if cache.read(file, bytes) == content:
            return False
        cache.write(file, content)
        return True

    def days(self) -> list[int]:
        """The days that have a file, in order."""
        files = self.folder.glob("????-??-??.csv")
        return sorted((date.fromisoformat(file.stem) - FIRST_DAY).days for file in files)

    def merge(self, day: int, positions: Rows, sightings: Rows) -> Changes:
        """Add rows to a day. Positions from receptions are kept as they are."""
        old, heard = self.read(day)
        before = merged_positions(old)
        sought = merged_positions(positions)
        after = merged_positions(np.concatenate([before, sought])) if len(before) else sought
        scans = merged_sightings(np.concatenate([heard, sightings]))
        if np.array_equal(before, after) and np.array_equal(heard, scans):
            return Changes(existing=len(sought))
        new, better = changes(before, after)
        self.write(day, np.concatenate([after, old[old["source"] == RECEPTIONS]]), scans)
        return Changes(new, better, max(len(sought) - new - better, 0), 1)

    def place_scans(self) -> int:
        """Compute the positions of all scans that have none, from all days; returns how many."""
        days = [day for day in self.days() if self.counts(day)[1]]
        sums = [access_points.day_sums(scans, places, day) for scans, places, day in self._known(days)]
        points = access_points.access_points(sums)
        checked = days[:: -(-len(days) // access_points.MOST_DAYS) or 1]
        factor = access_points.sigma_factor(self._known(checked), sums) if days else 1.0
        empty = np.empty(0, POSITION)
        found = [
            access_points.wifi_rows(scans_of(self.read(day)[1]), self._positions_about(day), points, factor)
            for day in days
        ]
        placed = np.concatenate([empty, *found])
        day_of_placed = day_of(placed)
        touched = {near for number in days for near in about(number)}
        for day in sorted(touched | set(day_of_placed.tolist())):
            rows, heard = self.read(day)
            self.write(day, np.concatenate([merged_positions(rows), placed[day_of_placed == day]]), heard)
        return len(placed)

    def _positions_about(self, day: int) -> Rows:
        """The positions of the days that a UTC day touches, in order of time."""
        rows = np.concatenate([merged_positions(self.read(near)[0]) for near in about(day)])
        return rows[np.argsort(rows["time"], kind="stable")]

    def _known(self, days: Iterable[int]) -> Iterator[tuple[Scans, ScanPositions, int]]:
        """The scans of each day, and the places of those near a good position."""
        for day in days:
            scans = scans_of(self.read(day)[1])
            yield scans, access_points.known_places(scans, self._positions_about(day)), day

    def counts(self, day: int) -> tuple[int, int]:
        """The numbers of positions and receptions of a day, from the first line of its file."""
        with self.file(day).open(encoding="utf-8") as file:
            match = HEAD_LINE.match(file.readline(MAXIMUM_LINE))
        return (int(match[1]), int(match[2])) if match else (0, 0)


def about(day: int) -> tuple[int, ...]:
    """A UTC day and those before and after it: days by the sun begin up to twelve hours before or after it."""
    return (day - 1, day, day + 1)


def enter(store: Store, past: PastDays, days: Iterable[int]) -> int:
    """Bring the lifelog's entries of some days up to date with their files; returns how many changed."""
    known = {entry.path: entry for entry in store.entries()}
    changed = 0
    for day in days:
        file = past.file(day)
        old = known.get(str(file))
        usable = file.exists() and past.counts(day)[0] >= MIN_POSITIONS
        digest = cache.content_hash(file) if usable else ""
        if (old.hash if old else "") == digest:
            continue
        if usable:
            store.put(Entry(digest, past.person, str(file)))
        if old:
            store.delete(old.hash)
        changed += 1
    return changed


def cut_past(store: Store, person: str, start: float, stop: float) -> int:
    """Delete a person's imported positions, receptions and guesses of a time (Unix times [s]); returns how many rows.

    Positions that were computed from receptions are deleted with them, and computed again without them.
    """
    past = PastDays(store, person)
    deleted, touched = 0, list[int]()
    for day in past.days():
        first = datetime.combine(FIRST_DAY + timedelta(days=day), datetime.min.time(), UTC).timestamp()
        if first - DAY_LENGTH > stop or first + 2 * DAY_LENGTH < start:
            continue
        tables = past.read(day)
        kept = [rows[(rows["time"] < start * MS) | (rows["time"] > stop * MS)] for rows in tables]
        if lost := sum(map(len, tables)) - sum(map(len, kept)):
            past.write(day, *kept)
            deleted, touched = deleted + lost, [*touched, day]
    if touched:
        past.place_scans()
        enter(store, past, past.days() + touched)
    store.delete_guesses(person, start, stop)
    return deleted
