"""Timeline of a day: time, activity, distance, floor and place."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta, timezone
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
TIMELINE_DIGITS = {
    "latitude": 7,
    "longitude": 7,
    "probability": 3,
    "x": 2,
    "y": 2,
    "sigma": 2,
    "observed": 3,
}  # of its table
TIMELINE_HEADER = (
    "start,end,kind,distance,floor,place,probability,others,latitude,longitude,x,y,sigma,"
    "number,mode,corrected,guess,observed"
)
# Chosen by hand
SHORT_STAND = 60.0  # [s] of waiting at a crossing or a bus stop: part of the walk or ride, unless it is a stay
LONGEST_SLIVER = 3.0  # [s] of standing at the edge of a stay, by which the detectors of standing and stays disagree
SHORTEST_GAP = 1.0  # [s] between two outings that is shown as a gap


@dataclass(frozen=True)
class TimelineEntry(OneLineRepr):
    """A line of the timeline.

    kind: one of ACTIVITIES, STAY, PASSING or PRIVATE; start, end: Unix times [s]; distance: along the path, also that
    within a stay of a diary [m].
    floor: labels, in order, empty where unknown; facing: as in ``Stay``.
    x, y: in the outing's frame [m]; latitude, longitude: the same place [deg]; sigma: standard deviation per axis
    [m]; NaN for entries that are not at one place, and where the place is unknown.
    Of a diary: place: name of the visited place, "" if it has none, and place_number: its number, -1 for none; offset,
    end_offset: of local time from UTC at start and end [s]; observed: share of the time with data; parts: the finer
    entries that it covers, in time order, none for a single one.
    mode: what the person calls the activity, as "bus", "" by default; corrected: True if the person states it.
    guess: what another program guessed, as "Google Timeline: HOME, 78 %"; it is all that is known if observed is 0.
    likely: kinds with the probability that each is what the person did at a moment of the entry, likeliest first; ()
    where it is not known.
    evidence: receipts and photos of its time, each with a time [s] and a text.
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
    guess: str = ""
    likely: tuple[tuple[str, float], ...] = ()
    evidence: tuple[tuple[float, str], ...] = ()
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
    def is_guess(self) -> bool:
        """True if all that is known of it is what another program guessed."""
        return bool(self.guess) and not self.observed

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
        pieces = _merged(_absorbed(_with_stays(outing), LONGEST_SLIVER, (STAY,)))
        own = [_entry(outing, piece) for piece in _merged(_absorbed(pieces, SHORT_STAND, (WALKING, VEHICLE)))]
        if entries and own and own[0].start - entries[-1].end > SHORTEST_GAP:
            entries.append(TimelineEntry(GAP, entries[-1].end, own[0].start))
        entries += own
    return tuple(entries)


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
    """The pieces, with neighbours of one kind or of one stay merged; between two gaps is a fix."""
    joined: list[_Piece] = []
    for piece in pieces:
        if joined and joined[-1].kind == piece.kind != GAP and joined[-1].stay is piece.stay:
            last = joined.pop()
            piece = replace(last, end=piece.end, distance=last.distance + piece.distance)
        joined.append(piece)
    return joined


def _absorbed(pieces: Sequence[_Piece], shortest: float, kinds: Sequence[str]) -> list[_Piece]:
    """The pieces; standing below `shortest` [s] belongs to the piece before it, else after it, of one of some kinds."""
    found = list(pieces)
    for n, piece in enumerate(found):
        beside = [p for p in found[max(n - 1, 0) : n + 2] if p.kind in kinds]
        if piece.kind == STANDING and piece.end - piece.start < shortest and beside:
            found[n] = replace(piece, kind=beside[0].kind, stay=beside[0].stay)
    return found


def _entry(outing: Outing, piece: _Piece) -> TimelineEntry:
    """The entry of a piece; a stay, a slow pass and standing have a position."""
    entry = TimelineEntry(piece.kind, outing.epoch + piece.start, outing.epoch + piece.end)
    if piece.kind in KINDS_WITHOUT_DATA:
        return entry
    track, stay = outing.trajectory, piece.stay
    if stay is not None:
        floor, position, covariance = (stay.floor,) if stay.floor else (), stay.position, stay.covariance
        entry = replace(entry, distance=piece.distance, floor=floor, facing=stay.facing)
    else:
        floor = floors_visited(rows_between(track, piece.start, piece.end))
        entry = replace(entry, distance=piece.distance, floor=floor)
        if piece.kind != STANDING:
            return entry
        middle = sampled(track, np.array([(piece.start + piece.end) / 2]))
        position = middle.position[0]
        covariance = np.full((3, 3), np.nan) if middle.covariance is None else middle.covariance[0]
    lon, lat = outing.frame.to_lonlat(position[None])[0].tolist() if outing.frame.georeferenced else (np.nan, np.nan)
    (x, y), sigma = position.tolist(), float(horizontal_sigma(covariance))
    return replace(entry, x=x, y=y, latitude=lat, longitude=lon, sigma=sigma)


def timeline_csv(entries: Iterable[TimelineEntry]) -> str:
    """``timeline.csv``: ISO 8601 times at the offset of each entry, metres, degrees; empty where a value is unknown.

    The name that the person gave a place goes before that of a plan, which has a probability.
    """
    records = []
    for entry in entries:
        name, probability = entry.facing[0] if entry.facing else ("", np.nan)
        changed = {
            "start": local_iso(entry.start, entry.offset),
            "end": local_iso(entry.end, entry.end_offset),
            "distance": entry.distance if entry.is_known else np.nan,
            "floor": " > ".join(entry.floor),
            "place": entry.place or name,
            "probability": probability if entry.place in ("", name) else np.nan,
            "others": "; ".join(f"{one_line(n)} {p:.3f}" for n, p in entry.facing[1:]),
            "number": entry.place_number,
        }
        records.append(vars(entry) | changed)
    return csv_table(records, TIMELINE_HEADER.split(","), TIMELINE_DIGITS)


def local_iso(time: float, offset: float) -> str:
    """A Unix time [s] in ISO 8601 at an offset from UTC [s]: ``2024-05-01T07:42:00+02:00``."""
    moment = datetime.fromtimestamp(round(time), UTC).astimezone(timezone(timedelta(seconds=round(offset))))
    return moment.isoformat(timespec="seconds")


def csv_table(records: Iterable[Mapping[str, Any]], names: Sequence[str], digits: Mapping[str, int]) -> str:
    """A CSV table with columns of some names; unknown numbers are empty. digits: of numbers, one by default."""

    def text(name: str, value: Any) -> str:
        if isinstance(value, float):
            return f"{value:.{digits.get(name, 1)}f}" if np.isfinite(value) else ""
        return str(value).lower() if isinstance(value, bool) else cell(one_line(str(value)))

    rows = [",".join(text(name, record[name]) for name in names) for record in records]
    return "\n".join([",".join(names), *rows]) + "\n"


def distance_text(metres: float) -> str:
    """A distance as a text: ``640 m``, ``6.2 km``, ``1,250 km``."""
    if metres < 999.5:
        return f"{metres:.0f} m"
    return f"{metres / 1000:.1f} km" if metres < 99_950 else f"{metres / 1000:,.0f} km"


def duration_text(seconds: float) -> str:
    """A duration as text: "45 s", "12 min", "2 h 05 min"."""
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60:02d} min"
