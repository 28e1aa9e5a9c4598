"""The days of a person's past in ``STORE.d/past``: one recording per day, an entry of the lifelog each.

A day with fewer than two positions is kept without an entry: it cannot be reconstructed until a later export has more.

Positions from Wi-Fi receptions: a map of access points, learnt from all scans of a person near a good position.

Each scan at a known place gives a weighted mean position to the access points in it; an access point that was received
at places far apart (a phone's hotspot, a router that moved) is not used. A scan without a position gets the weighted
mean of its access points. How far that is wrong is measured on the scans at known places, each with a map without its
own day, and scales the stated sigma to cover 68 % and 95 % of them.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, date, datetime, timedelta
from pathlib import Path

import numpy as np

from pdr_graph.apps.lifelog import cache
from pdr_graph.apps.lifelog.observation import MIN_POSITIONS
from pdr_graph.apps.lifelog.past.past_rows import assumed_accuracy, changes, day_of, merged_positions, merged_sightings
from pdr_graph.apps.lifelog.store import SOURCES, Entry, Store
from pdr_graph.frames import METRES_PER_DEGREE
from pdr_graph.io.delimited import MAXIMUM_LINE
from pdr_graph.io.past_day import (
    CM,
    E7,
    GOOGLE_PATH,
    HEAD_LINE,
    MS,
    POSITION,
    RECEPTIONS,
    SIGHTING,
    Rows,
    from_text,
    to_text,
)
from pdr_graph.io.validation import RADIUS_68
from pdr_graph.types import DAY_LENGTH, Array, Index

GOOD_RADIUS = 60.0  # [m] 68 % radius of a position from which the map is learnt
BOTH_SIDES_TIME, ONE_SIDE_TIME = 60.0, 20.0  # [s] from a scan at a known place to positions before and after, or one
WALKING_SPEED, CURVATURE = 1.5, 0.25  # [m/s] of a person beside a position; error of a straight line over its length
FEWEST_POINTS = 3  # access points in a scan that agree
ACCESS_POINT_SIGMA = 15.0  # [m] error per axis of an access point's position as that of the scan
UNCHECKED_FACTOR = 2.0  # factor of sigma where there are too few scans to measure it
FEWEST_PLACES, MOST_DAYS = 10, 30  # places, and days at most, from which it is measured
PLACE_CELL = 50.0  # [m] size of a place there, all of which have the same weight: most scans are at home
LARGEST_SIGMA = 200.0  # [m] per axis of a position that is used
COVERAGE = np.array([0.683, 0.95]), np.array([2.30, 5.99])  # shares; the χ² of 2 degrees of freedom they are below

# Sums over the receptions of an access point on a day. weight: sum; lat, lon: weighted mean [deg]; spread: weighted
# variance [m²], mean of both axes; low, high: limits of its receptions [deg]
POINT_SUMS = np.dtype(
    [
        *(("mac", "i8"), ("day", "i4"), ("weight", "f8"), ("lat", "f8"), ("lon", "f8"), ("spread", "f8")),
        *(("low", "f8", 2), ("high", "f8", 2)),
    ]
)


@dataclass(frozen=True)
class Scans:
    """Scans of a day. time: ``(n,)`` [ms]; first: ``(n + 1,)`` of each its first row in mac and rssi, and the end."""

    time: Array
    first: Index
    mac: Array
    rssi: Array

    def __len__(self) -> int:
        return len(self.time)


@dataclass(frozen=True)
class ScanPositions:
    """Positions of scans. scan: ``(n,)`` their numbers; lat, lon: [deg]; sigma: per axis [m]."""

    scan: Index
    lat: Array
    lon: Array
    sigma: Array


def scans_of(sightings: Rows) -> Scans:
    """The scans of receptions in order of time: those of one time."""
    time, first = np.unique(sightings["time"], return_index=True)
    return Scans(time, np.append(first, len(sightings)), sightings["mac"], sightings["rssi"].astype(float))


def known_places(scans: Scans, positions: Rows) -> ScanPositions:
    """The scans near in time to good measured positions, and where they were."""
    measured = ~np.isin(positions["source"], (GOOGLE_PATH, RECEPTIONS))
    good = positions[measured & (assumed_accuracy(positions) <= GOOD_RADIUS)]
    if not len(good) or not len(scans):
        return ScanPositions(np.empty(0, int), *np.empty((3, 0)))
    time, at = good["time"] / MS, scans.time / MS
    after = np.searchsorted(time, at).clip(0, len(time) - 1)
    before = np.where(time[after] <= at, after, (after - 1).clip(0))
    ages = at - time[before], time[after] - at
    share = np.clip(ages[0] / np.maximum(ages[0] + ages[1], 1e-9), 0, 1)
    lat, lon, sigma = good["lat"] / E7, good["lon"] / E7, assumed_accuracy(good) / RADIUS_68
    between = (ages[0] >= 0) & (ages[1] >= 0) & (np.maximum(*ages) <= BOTH_SIDES_TIME)
    nearest = np.where(np.abs(ages[0]) <= np.abs(ages[1]), before, after)
    age = np.minimum(np.abs(ages[0]), np.abs(ages[1]))
    length = _distance(lat[before], lon[before], lat[after], lon[after])
    middle = [(1 - share) * x[before] + share * x[after] for x in (lat, lon)]
    both = np.hypot(np.maximum(sigma[before], sigma[after]), CURVATURE * length)
    one = np.hypot(sigma[nearest], WALKING_SPEED * age)
    error = np.where(between, both, one)
    near = np.flatnonzero((between | (age <= ONE_SIDE_TIME)) & (error <= GOOD_RADIUS / RADIUS_68))
    places = [np.where(between, x, y[nearest])[near] for x, y in zip(middle, (lat, lon), strict=True)]
    return ScanPositions(near, places[0], places[1], error[near])


def day_sums(scans: Scans, places: ScanPositions, day: int) -> Rows:
    """The sums of each access point over the scans of a day at known places."""
    sizes = np.diff(scans.first)[places.scan]
    scan = np.repeat(np.arange(len(places.scan)), sizes)
    row = np.repeat(scans.first[places.scan] - np.cumsum(sizes) + sizes, sizes) + np.arange(int(sizes.sum()))
    place = np.stack([places.lat[scan], places.lon[scan]], axis=1)
    return _combined(
        scans.mac[row],
        _strength(scans.rssi[row]) / (places.sigma[scan] ** 2 + ACCESS_POINT_SIGMA**2),
        place,
        places.sigma[scan] ** 2,
        (place, place),
        day,
    )


def access_points(sums: Sequence[Rows], without: int = -1) -> Rows:
    """The map: the sums of all days but `without`, of access points that were received at one place alone."""
    rows = np.concatenate(
        [np.empty(0, POINT_SUMS), *(part for part in sums if len(part) and part["day"][0] != without)]
    )
    place = np.stack([rows["lat"], rows["lon"]], axis=1)
    all_days = _combined(rows["mac"], rows["weight"], place, rows["spread"], (rows["low"], rows["high"]), without)
    low, high = all_days["low"].T, all_days["high"].T
    # farthest [m] between two receptions of one access point that stays: twice its reach and the errors outdoors
    return all_days[_distance(low[0], low[1], high[0], high[1]) <= 400.0]


def scan_positions(scans: Scans, points: Rows) -> ScanPositions:
    """The positions of the scans in which enough access points of the map agree; sigma: before it is scaled."""
    scan = np.repeat(np.arange(len(scans)), np.diff(scans.first))
    column = np.searchsorted(points["mac"], scans.mac).clip(0, max(len(points) - 1, 0))
    mapped = points["mac"][column] == scans.mac if len(points) else np.zeros(len(scan), bool)
    scan, column, rssi = scan[mapped], column[mapped], scans.rssi[mapped]
    if not len(scan):
        return ScanPositions(np.empty(0, int), *np.empty((3, 0)))
    lat, lon, spread = (points[name][column] for name in ("lat", "lon", "spread"))
    order = np.lexsort((rssi, scan))
    strongest = order[np.searchsorted(scan[order], scan, side="right") - 1]
    # agreed [m] from the strongest access point's position within which another agrees
    agrees = _distance(lat, lon, lat[strongest], lon[strongest]) <= 200.0
    weight = np.where(agrees, _strength(rssi) / (spread + ACCESS_POINT_SIGMA**2), 0)
    total, number = np.bincount(scan, weight), np.bincount(scan, agrees)
    chosen = np.flatnonzero(number >= FEWEST_POINTS)
    sums = [np.bincount(scan, weight * x) for x in (lat - lat[0], lon - lon[0])]
    mean = [x / np.maximum(total, 1e-300) + first for x, first in zip(sums, (lat[0], lon[0]), strict=True)]
    scatter = _distance(lat, lon, mean[0][scan], mean[1][scan]) ** 2 / 2  # of the access points about their mean
    variance = np.bincount(scan, weight**2 * (spread + ACCESS_POINT_SIGMA**2 + scatter))[chosen] / total[chosen] ** 2
    return ScanPositions(chosen, mean[0][chosen], mean[1][chosen], np.sqrt(variance))


def sigma_factor(days: Iterator[tuple[Scans, ScanPositions, int]], sums: Sequence[Rows]) -> float:
    """The factor of sigma with which the stated shares of known places are covered, at least 1.

    days: scans, their places and the number of each day.
    """
    errors, sigmas, known, cells = [np.empty(0)], [np.empty(0)], [np.empty(0)], [np.empty((0, 2))]
    for scans, places, day in days:
        found = scan_positions(scans, access_points(sums, without=day))
        _, ours, theirs = np.intersect1d(found.scan, places.scan, return_indices=True)
        errors.append(_distance(found.lat[ours], found.lon[ours], places.lat[theirs], places.lon[theirs]))
        sigmas.append(found.sigma[ours])
        known.append(places.sigma[theirs])
        cells.append(
            np.rint(np.stack([places.lat[theirs], places.lon[theirs]], axis=1) * METRES_PER_DEGREE / PLACE_CELL)
        )
    error, sigma, place = (np.concatenate(parts) for parts in (errors, sigmas, known))
    _, of, number = np.unique(np.concatenate(cells), axis=0, return_inverse=True, return_counts=True)
    if not len(number):
        return UNCHECKED_FACTOR
    weight = 1 / number[of] / len(number)
    factors = np.geomspace(1, 30, 69)[:, None]
    squares = error**2 / ((factors * sigma) ** 2 + place**2)
    covers = np.all([(squares < limit) @ weight >= share for share, limit in zip(*COVERAGE, strict=True)], axis=0)
    factor = float(factors[np.argmax(covers) if covers.any() else -1, 0])
    return factor if len(number) >= FEWEST_PLACES else max(factor, UNCHECKED_FACTOR)


def wifi_rows(scans: Scans, positions: Rows, points: Rows, factor: float) -> Rows:
    """The positions of scans that have no measured position near in time, as rows with the source RECEPTIONS."""
    found = scan_positions(scans, points)
    found = replace(found, sigma=factor * found.sigma)
    measured = positions[positions["source"] != GOOGLE_PATH]
    measured = measured[assumed_accuracy(measured) <= LARGEST_SIGMA * RADIUS_68]["time"]
    time = scans.time[found.scan]
    after = np.searchsorted(measured, time)
    padded = np.concatenate([[-(2**60)], measured, [2**60]])
    # alone [s] from a measured position within which a scan gives none
    lonely = np.minimum(time - padded[after], padded[after + 1] - time) > 60.0 * MS
    chosen = lonely & (found.sigma <= LARGEST_SIGMA)
    rows = np.zeros(int(chosen.sum()), POSITION)
    rows["time"], rows["source"] = time[chosen], RECEPTIONS
    rows["lat"], rows["lon"] = np.rint(found.lat[chosen] * E7), np.rint(found.lon[chosen] * E7)
    rows["accuracy"] = np.rint(found.sigma[chosen] * RADIUS_68 * CM)
    return rows


def _combined(mac: Array, weight: Array, place: Array, spread: Array, limits: tuple[Array, Array], day: int) -> Rows:
    """The sums of each access point over parts that each have a weight, a mean place, a variance and limits."""
    names, of = np.unique(mac, return_inverse=True)
    sums = np.zeros(len(names), POINT_SUMS)
    if not len(names):
        return sums
    sums["mac"], sums["day"] = names, day
    sums["weight"] = np.bincount(of, weight)
    origin = place[np.unique(of, return_index=True)[1]]  # near the mean, so that the squares keep their digits
    moved = (
        (place - origin[of])
        * METRES_PER_DEGREE
        * np.stack([np.ones(len(mac)), np.cos(np.radians(place[:, 0]))], axis=1)
    )
    mean = np.stack([np.bincount(of, weight * x) / sums["weight"] for x in moved.T], axis=1)
    square = np.bincount(of, weight * ((moved**2).sum(axis=1) / 2 + spread)) / sums["weight"]
    sums["spread"] = np.maximum(square - (mean**2).sum(axis=1) / 2, 0)
    sums["lat"] = origin[:, 0] + mean[:, 0] / METRES_PER_DEGREE
    sums["lon"] = origin[:, 1] + mean[:, 1] / (METRES_PER_DEGREE * np.cos(np.radians(origin[:, 0])).clip(1e-3))
    order = np.argsort(of, kind="stable")
    first = np.searchsorted(of[order], np.arange(len(names)))
    sums["low"] = np.minimum.reduceat(limits[0][order], first)
    sums["high"] = np.maximum.reduceat(limits[1][order], first)
    return sums


def _strength(rssi: Array) -> Array:
    """Weight of a reception by its power: inverse to the distance in free space."""
    return 10 ** ((rssi + 100) / 20)


def _distance(lat: Array, lon: Array, lat2: Array, lon2: Array) -> Array:
    """Distances [m] between places less than some hundred kilometres apart; far ones only have to be far."""
    return METRES_PER_DEGREE * np.hypot(lat - lat2, (lon - lon2) * np.cos(np.radians((lat + lat2) / 2)))


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
        sums = [day_sums(scans, places, day) for scans, places, day in self._known(days)]
        points = access_points(sums)
        checked = days[:: -(-len(days) // MOST_DAYS) or 1]
        factor = sigma_factor(self._known(checked), sums) if days else 1.0
        empty = np.empty(0, POSITION)
        found = [wifi_rows(scans_of(self.read(day)[1]), self._positions_about(day), points, factor) for day in days]
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
            yield scans, known_places(scans, self._positions_about(day)), day

    def counts(self, day: int) -> tuple[int, int]:
        """The numbers of positions and receptions of a day, from the first line of its file."""
        with self.file(day).open(encoding="utf-8") as file:
            match = HEAD_LINE.match(file.readline(MAXIMUM_LINE))
        return (int(match[1]), int(match[2])) if match else (0, 0)


Spans = list[tuple[float, float]]  # Unix times of the first and last row of each day [s]


def sources_of(store: Store, person: str) -> dict[Path, Spans]:
    """The files, folders and zips that were imported for a person, with their times: none if these are not known."""
    stored = json.loads(store.setting(SOURCES + person) or "{}")  # a list of earlier versions
    return {Path(path): [(a, b) for a, b in stored[path]] if isinstance(stored, dict) else [] for path in stored}


def add_sources(store: Store, person: str, spans: Mapping[Path, Spans]) -> None:
    """Remember what was imported for a person, to name it when something is deleted."""
    every = sources_of(store, person) | {path.resolve(): own for path, own in spans.items()}
    store.put_setting(SOURCES + person, json.dumps({str(path): every[path] for path in sorted(every)}))


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


def cut_past(store: Store, person: str, spans: Sequence[tuple[float, float]]) -> int:
    """Delete a person's imported positions, receptions and guesses of times (Unix times [s]); returns how many rows.

    Positions that were computed from receptions are deleted with them, and computed again without them.
    """
    past = PastDays(store, person)
    deleted, touched = 0, list[int]()
    for day in past.days():
        first = datetime.combine(FIRST_DAY + timedelta(days=day), datetime.min.time(), UTC).timestamp()
        near = [(a * MS, b * MS) for a, b in spans if first - DAY_LENGTH <= b and a <= first + 2 * DAY_LENGTH]
        if not near:
            continue
        tables = past.read(day)
        kept = [rows[~np.any([(rows["time"] >= a) & (rows["time"] <= b) for a, b in near], axis=0)] for rows in tables]
        if lost := sum(map(len, tables)) - sum(map(len, kept)):
            past.write(day, *kept)
            deleted, touched = deleted + lost, [*touched, day]
    if touched:
        past.place_scans()
        enter(store, past, past.days() + touched)
    for start, stop in spans:
        store.delete_guesses(person, start, stop)
    return deleted
