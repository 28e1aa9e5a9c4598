"""Timeline of a day: time, activity, distance, floor and place."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, tzinfo
from itertools import pairwise
from typing import Any

import numpy as np

from pdr_graph.apps.lifelog.day import (
    GAP,
    KINDS_WITHOUT_DATA,
    STANDING,
    VEHICLE,
    WALKING,
    Day,
    Outing,
    Stay,
    floors_visited,
    path_shares,
    rows_between,
    sampled,
)
from pdr_graph.errors import one_line
from pdr_graph.geometry import horizontal_sigma
from pdr_graph.io.writers import cell
from pdr_graph.types import OneLineRepr

STAY, PASSING = "stay", "passing"
KIND_NAMES = {VEHICLE: "riding", GAP: "no data"}  # shown instead of the kind
TIMELINE_DIGITS = {"latitude": 7, "longitude": 7, "probability": 3, "x": 2, "y": 2, "sigma": 2}  # of its table
TIMELINE_HEADER = "start,end,kind,distance,floor,place,probability,others,latitude,longitude,x,y,sigma"
# Chosen by hand
SHORT_STAND = 60.0  # [s] of waiting at a crossing or a bus stop: part of the walk or ride, unless it is a stay
LONGEST_SLIVER = 3.0  # [s] of standing at the edge of a stay, by which the detectors of standing and stays disagree
SHORTEST_GAP = 1.0  # [s] between two outings that is shown as a gap


@dataclass(frozen=True)
class TimelineEntry(OneLineRepr):
    """A line of the timeline.

    kind: one of ACTIVITIES, STAY, PASSING or PRIVATE; start, end: Unix times [s]; distance: along the path [m].
    floor: labels, in order, empty where unknown; facing: as in ``Stay``.
    x, y: in the outing's frame [m]; latitude, longitude: the same place [deg]; sigma: standard deviation per axis
    [m]; NaN for entries that are not at one place, and where the place is unknown.
    Of a diary: place: name of the visited place, "" if it has none, and place_number: its number, -1 for none; offset,
    end_offset: of local time from UTC at start and end [s]; observed: share of the time with data; parts: the finer
    entries that it covers, in time order, none for a single one.
    mode: what the person calls the activity, as "bus", "" by default; corrected: True if the person states it.
    Of a visit: arrived, left: True if its start and end were observed, not inside a time without data.
    """

    kind: str
    start: float
    end: float
    distance: float = 0.0
    floor: tuple[str, ...] = ()
    facing: tuple[tuple[str, float], ...] = ()
    x: float = np.nan
    y: float = np.nan
    latitude: float = np.nan
    longitude: float = np.nan
    sigma: float = np.nan
    place: str = ""
    place_number: int = -1
    offset: float = 0.0
    end_offset: float = 0.0
    observed: float = 1.0
    parts: tuple[TimelineEntry, ...] = ()
    mode: str = ""
    corrected: bool = False
    arrived: bool = False
    left: bool = False

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return self.end - self.start

    @property
    def is_known(self) -> bool:
        """True if it is known what the person did; a stay may go on without data."""
        return self.kind not in KINDS_WITHOUT_DATA

    @property
    def is_seen(self) -> bool:
        """True if it has data."""
        return self.is_known and self.observed > 0

    @property
    def label(self) -> str:
        """The name of its place, else the number of the place, else ""."""
        return place_label(self.place, self.place_number)

    def _summary(self) -> list[str]:
        names = [repr(self.place or self.facing[0][0])] if self.place or self.facing else []
        return [self.kind, duration_text(self.duration), f"{self.distance:.0f} m", *names]


def place_label(name: str, number: int) -> str:
    """The name of a place, else its number, else "" (a stay that belongs to no place)."""
    return name or (f"place {number}" if number >= 0 else "")


@dataclass(frozen=True)
class _Piece:
    """A part of an outing; start, end: [s] from its epoch; distance [m]; stay: None if it is not a stay."""

    kind: str
    start: float
    end: float
    distance: float
    stay: Stay | None = None


def timeline(day: Day) -> tuple[TimelineEntry, ...]:
    """Entries of a day in time order, with the gaps between outings.

    A stay replaces the part of the segment that it covers. Standing for less than SHORT_STAND that is not a stay
    belongs to the walk or ride around it.
    """
    entries: list[TimelineEntry] = []
    for outing in sorted(day.outings, key=lambda o: o.epoch):
        own = [_entry(outing, piece) for piece in _pieces(outing)]
        if entries and own and own[0].start - entries[-1].end > SHORTEST_GAP:
            entries.append(TimelineEntry(GAP, entries[-1].end, own[0].start))
        entries += own
    return tuple(entries)


def _pieces(outing: Outing) -> list[_Piece]:
    """The parts of an outing, in time order."""
    return _merged(_without_short_standing(_merged(_without_slivers(_with_stays(outing)))))


def _with_stays(outing: Outing) -> list[_Piece]:
    """Segments split at the stays; a segment's distance is divided by the path length of each part."""
    pieces: list[_Piece] = []
    for segment in outing.segments:
        stays = [s for s in outing.stays if s.start < segment.end and s.end > segment.start]
        inside = [(max(s.start, segment.start), min(s.end, segment.end)) for s in stays]
        bounds = np.unique([segment.start, segment.end, *np.ravel(inside)]).tolist()
        for (start, end), share in zip(pairwise(bounds), path_shares(outing.trajectory, bounds).tolist(), strict=True):
            stay = next((s for s in stays if s.start <= start and end <= s.end), None)
            kind = segment.kind if stay is None else PASSING if stay.passing else STAY
            pieces.append(_Piece(kind, start, end, share * segment.distance, stay))
    return pieces


def _merged(pieces: Sequence[_Piece]) -> list[_Piece]:
    """The pieces, with neighbours of one kind or of one stay merged."""
    joined: list[_Piece] = []
    for piece in pieces:
        if joined and joined[-1].kind == piece.kind and joined[-1].stay is piece.stay:
            last = joined.pop()
            piece = replace(last, end=piece.end, distance=last.distance + piece.distance)
        joined.append(piece)
    return joined


def _without_slivers(pieces: Sequence[_Piece]) -> list[_Piece]:
    """The pieces; standing shorter than LONGEST_SLIVER beside a stay becomes part of the stay."""
    found = list(pieces)
    for n, piece in enumerate(found):
        beside = [p for p in found[max(n - 1, 0) : n + 2] if p.kind == STAY]
        if piece.kind == STANDING and piece.end - piece.start < LONGEST_SLIVER and beside:
            found[n] = replace(piece, kind=STAY, stay=beside[0].stay)
    return found


def _without_short_standing(pieces: Sequence[_Piece]) -> list[_Piece]:
    """The pieces; short standing becomes part of the walk or ride before it, else after it."""
    found = list(pieces)
    for n, piece in enumerate(found):
        ways = [p.kind for p in (*found[max(n - 1, 0) : n], *found[n + 1 : n + 2]) if p.kind in (WALKING, VEHICLE)]
        if piece.kind == STANDING and piece.end - piece.start < SHORT_STAND and ways:
            found[n] = replace(piece, kind=ways[0])
    return found


def _entry(outing: Outing, piece: _Piece) -> TimelineEntry:
    start, end = outing.epoch + piece.start, outing.epoch + piece.end
    track = outing.trajectory
    if piece.stay is not None:
        stay = piece.stay
        entry = TimelineEntry(piece.kind, start, end, piece.distance, (stay.floor,) if stay.floor else (), stay.facing)
        return _with_position(entry, outing, stay.position, stay.covariance)
    if piece.kind in KINDS_WITHOUT_DATA:
        return TimelineEntry(piece.kind, start, end)
    entry = TimelineEntry(
        piece.kind, start, end, piece.distance, floors_visited(rows_between(track, piece.start, piece.end))
    )
    if piece.kind != STANDING:
        return entry
    middle = sampled(track, np.array([(piece.start + piece.end) / 2]))
    covariance = np.full((3, 3), np.nan) if middle.covariance is None else middle.covariance[0]
    return _with_position(entry, outing, middle.position[0], covariance)


def _with_position(entry: TimelineEntry, outing: Outing, position: np.ndarray, covariance: np.ndarray) -> TimelineEntry:
    """The entry with a position ``(2,)`` [m] in the outing's frame and its covariance [m²]."""
    lon, lat = outing.frame.to_lonlat(position[None])[0] if outing.frame.georeferenced else (np.nan, np.nan)
    x, y, spread = float(position[0]), float(position[1]), float(horizontal_sigma(covariance))
    return replace(entry, x=x, y=y, latitude=float(lat), longitude=float(lon), sigma=spread)


def timeline_csv(entries: Sequence[TimelineEntry], zone: tzinfo) -> str:
    """``timeline.csv``: ISO 8601 times with the zone's offset, metres, degrees; empty where a value is unknown."""
    return csv_table([_record(entry, zone) for entry in entries], TIMELINE_HEADER.split(","), TIMELINE_DIGITS)


def _record(entry: TimelineEntry, zone: tzinfo) -> dict[str, Any]:
    """An entry by the columns of its table."""
    name, probability = entry.facing[0] if entry.facing else ("", np.nan)
    start, end = (datetime.fromtimestamp(t, zone).isoformat(timespec="seconds") for t in (entry.start, entry.end))
    return vars(entry) | {
        "start": start,
        "end": end,
        "distance": entry.distance if entry.is_known else np.nan,
        "floor": " > ".join(entry.floor),
        "place": name,
        "probability": probability,
        "others": "; ".join(f"{one_line(n)} {p:.3f}" for n, p in entry.facing[1:]),
    }


def csv_table(records: Iterable[Mapping[str, Any]], names: Sequence[str], digits: Mapping[str, int]) -> str:
    """A CSV table with columns of some names; unknown numbers are empty. digits: of numbers, one by default."""

    def text(name: str, value: Any) -> str:
        if isinstance(value, float):
            return f"{value:.{digits.get(name, 1)}f}" if np.isfinite(value) else ""
        return str(value).lower() if isinstance(value, bool) else cell(one_line(str(value)))

    rows = [",".join(text(name, record[name]) for name in names) for record in records]
    return "\n".join([",".join(names), *rows]) + "\n"


def duration_text(seconds: float) -> str:
    """A duration as text: "45 s", "12 min", "2 h 05 min"."""
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60:02d} min"
