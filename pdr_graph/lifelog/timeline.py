"""Timeline of a day: time, activity, distance, floor and place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime, tzinfo
from itertools import pairwise

import numpy as np

from pdr_graph.errors import one_line
from pdr_graph.io.writers import cell
from pdr_graph.lifelog.day import (
    GAP,
    STANDING,
    UNSEEN,
    VEHICLE,
    WALKING,
    Day,
    Outing,
    Stay,
    at,
    floors_along,
    shares,
    sigma,
    within,
)

STAY, PASSING = "stay", "passing"
WORDS = {VEHICLE: "riding", GAP: "no data"}  # shown instead of the kind
SHORT_STAND = 60.0  # [s] of waiting at a crossing or a bus stop: part of the walk or ride, unless it is a stay
SLIVER = 3.0  # [s] at the edge of a stay by which the two detectors disagree
SHORTEST_GAP = 1.0  # [s] between two outings that is shown as a gap
HEADER = "start,end,kind,distance,floor,place,probability,others,latitude,longitude,x,y,sigma"
SHORTEST_TOTAL = 60.0  # [s] at a place for which the totals name it
MOST_OTHERS = 2  # alternative names in the printed table; the CSV has all


@dataclass(frozen=True)
class Entry:
    """A line of the timeline.

    kind: one of KINDS, STAY, PASSING or PRIVATE; start, end: Unix times [s]; distance: along the path [m].
    floor: labels, in order, empty where unknown; facing: as in ``Stay``.
    x, y: in the outing's frame [m]; latitude, longitude: the same place [deg]; sigma: standard deviation per axis
    [m]; NaN for entries that are not at one place, and where the place is unknown.
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


@dataclass(frozen=True)
class Totals:
    """Totals of a day. Distances [m], times [s].

    places: time spent at each named place, longest first; the time of a stay is weighted by the probability of the
    place.
    """

    walked: float
    walking: float
    ridden: float
    riding: float
    staying: float
    unknown: float
    steps: int
    places: tuple[tuple[str, float], ...]


@dataclass(frozen=True)
class _Piece:
    """A part of an outing, times in seconds from its epoch; stay: None if it is not a stay."""

    kind: str
    start: float
    end: float
    distance: float
    stay: Stay | None = None


def timeline(day: Day) -> tuple[Entry, ...]:
    """Entries of a day in time order, with the gaps between outings.

    A stay replaces the part of the segment that it covers. Standing for less than SHORT_STAND that is not a stay
    belongs to the walk or ride around it.
    """
    entries: list[Entry] = []
    for outing in sorted(day.outings, key=lambda o: o.epoch):
        own = [_entry(outing, piece) for piece in _pieces(outing)]
        if entries and own and own[0].start - entries[-1].end > SHORTEST_GAP:
            entries.append(Entry(GAP, entries[-1].end, own[0].start))
        entries += own
    return tuple(entries)


def totals(day: Day, entries: Sequence[Entry]) -> Totals:
    """Totals of a day: distances from its segments, times from the entries of its timeline."""
    at_places = dict[str, float]()
    for stay in (entry for entry in entries if entry.kind == STAY):
        for name, probability in stay.facing:
            at_places[name] = at_places.get(name, 0.0) + (stay.end - stay.start) * probability
    return Totals(
        walked=day.total(WALKING)[1],
        walking=_lasted(entries, WALKING, PASSING),
        ridden=day.total(VEHICLE)[1],
        riding=_lasted(entries, VEHICLE),
        staying=_lasted(entries, STAY),
        unknown=_lasted(entries, *UNSEEN),
        steps=sum(outing.steps for outing in day.outings),
        places=tuple(sorted(at_places.items(), key=lambda item: -item[1])),
    )


def _lasted(entries: Sequence[Entry], *kinds: str) -> float:
    return float(sum(entry.end - entry.start for entry in entries if entry.kind in kinds))


def _pieces(outing: Outing) -> list[_Piece]:
    """What an outing is made of, in order of time."""
    return _joined(_without_short_standing(_joined(_without_slivers(_with_stays(outing)))))


def _with_stays(outing: Outing) -> list[_Piece]:
    """Segments, and in them the stays; the way gone is shared out as the trajectory's line has it."""
    pieces: list[_Piece] = []
    for segment in outing.segments:
        stays = [s for s in outing.stays if s.start < segment.end and s.end > segment.start]
        inside = [(max(s.start, segment.start), min(s.end, segment.end)) for s in stays]
        bounds = np.unique([segment.start, segment.end, *np.ravel(inside)]).tolist()
        for (start, end), share in zip(pairwise(bounds), shares(outing.trajectory, bounds).tolist(), strict=True):
            stay = next((s for s in stays if s.start <= start and end <= s.end), None)
            kind = segment.kind if stay is None else PASSING if stay.passing else STAY
            pieces.append(_Piece(kind, start, end, share * segment.distance, stay))
    return pieces


def _joined(pieces: Sequence[_Piece]) -> list[_Piece]:
    """Neighbours of one kind, or of one stay, as one."""
    joined: list[_Piece] = []
    for piece in pieces:
        if joined and joined[-1].kind == piece.kind and joined[-1].stay is piece.stay:
            last = joined.pop()
            piece = replace(last, end=piece.end, distance=last.distance + piece.distance)
        joined.append(piece)
    return joined


def _without_slivers(pieces: Sequence[_Piece]) -> list[_Piece]:
    """Without the standing of a moment at the edge of a stay: it is the stay's."""
    found = list(pieces)
    for n, piece in enumerate(found):
        beside = [p for p in found[max(n - 1, 0) : n + 2] if p.kind == STAY]
        if piece.kind == STANDING and piece.end - piece.start < SLIVER and beside:
            found[n] = replace(piece, kind=STAY, stay=beside[0].stay)
    return found


def _without_short_standing(pieces: Sequence[_Piece]) -> list[_Piece]:
    """Without the standing that is part of a way: that before it, else that after it."""
    found = list(pieces)
    for n, piece in enumerate(found):
        ways = [p.kind for p in (*found[max(n - 1, 0) : n], *found[n + 1 : n + 2]) if p.kind in (WALKING, VEHICLE)]
        if piece.kind == STANDING and piece.end - piece.start < SHORT_STAND and ways:
            found[n] = replace(piece, kind=ways[0])
    return found


def _entry(outing: Outing, piece: _Piece) -> Entry:
    start, end = outing.epoch + piece.start, outing.epoch + piece.end
    track = outing.trajectory
    if piece.stay is not None:
        stay = piece.stay
        entry = Entry(piece.kind, start, end, piece.distance, (stay.floor,) if stay.floor else (), stay.facing)
        return _placed(entry, outing, stay.position, stay.covariance)
    if piece.kind in UNSEEN:
        return Entry(piece.kind, start, end)
    entry = Entry(piece.kind, start, end, piece.distance, floors_along(within(track, piece.start, piece.end)))
    if piece.kind != STANDING:
        return entry
    middle = at(track, np.array([(piece.start + piece.end) / 2]))
    covariance = np.full((3, 3), np.nan) if middle.covariance is None else middle.covariance[0]
    return _placed(entry, outing, middle.position[0], covariance)


def _placed(entry: Entry, outing: Outing, position: np.ndarray, covariance: np.ndarray) -> Entry:
    """An entry that was at one place ``(2,)`` [m]."""
    lon, lat = outing.frame.to_lonlat(position[None])[0] if outing.frame.georeferenced else (np.nan, np.nan)
    x, y, spread = float(position[0]), float(position[1]), float(sigma(covariance))
    return replace(entry, x=x, y=y, latitude=float(lat), longitude=float(lon), sigma=spread)


def table(entries: Sequence[Entry], zone: tzinfo) -> str:
    """``timeline.csv``: ISO 8601 times with the zone's offset, metres, degrees; empty where nothing is known."""
    return "\n".join([HEADER, *(_row(entry, zone) for entry in entries)]) + "\n"


def _row(entry: Entry, zone: tzinfo) -> str:
    name, probability = entry.facing[0] if entry.facing else ("", np.nan)
    others = "; ".join(f"{one_line(n)} {p:.3f}" for n, p in entry.facing[1:])
    moment = [datetime.fromtimestamp(t, zone).isoformat(timespec="seconds") for t in (entry.start, entry.end)]
    words = (" > ".join(entry.floor), name, others)
    floor, place, others = (cell(one_line(word)) for word in words)
    distance = "" if entry.kind in UNSEEN else f"{entry.distance:.1f}"
    numbers = [_number(entry.latitude, 7), _number(entry.longitude, 7), *(_number(n, 2) for n in (entry.x, entry.y))]
    cells = [*moment, entry.kind, distance, floor, place, _number(probability, 3), others, *numbers]
    return ",".join([*cells, _number(entry.sigma, 2)])


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) else ""


def printed(day: Day, entries: Sequence[Entry], zone: tzinfo) -> str:
    """The timeline for a terminal, with the day's sums below."""
    lines = [f"{one_line(day.person)}  {day.date}  {zone}".rstrip()]
    for entry in entries:
        clock = "  ".join(f"{datetime.fromtimestamp(t, zone):%H:%M:%S}" for t in (entry.start, entry.end))
        lasted, what, far, floor, place = cells(entry)
        lines.append(f"{clock}  {lasted:>10}  {what:<15} {far:>9}  {floor:<6}  {place}".rstrip())
    sums = totals(day, entries)
    places = ", ".join(f"{one_line(name)} {spoken(time)}" for name, time in sums.places if time >= SHORTEST_TOTAL)
    lines += ["", "; ".join(in_words(sums)), *([f"at places: {places}"] if places else [])]
    return "\n".join(lines) + "\n"


def cells(entry: Entry) -> tuple[str, str, str, str, str]:
    """Texts of an entry: duration, activity, distance, floors, place."""
    what, floor = WORDS.get(entry.kind, entry.kind), one_line(" > ".join(entry.floor))
    far = f"{entry.distance:,.0f} m" if entry.distance >= 0.5 else ""
    return spoken(entry.end - entry.start), what, far, floor, _where(entry)


def _where(entry: Entry) -> str:
    """Names with probabilities; coordinates for a place without a name."""
    if entry.facing:
        (name, probability), *others = entry.facing
        beside = ", ".join(f"{one_line(n)} {p:.0%}" for n, p in others[:MOST_OTHERS])
        return f"{one_line(name)} {probability:.0%}" + (f"  ({beside})" if beside else "")
    if np.isfinite(entry.latitude):
        return f"{entry.latitude:.5f}, {entry.longitude:.5f} ± {entry.sigma:.0f} m"
    return f"x {entry.x:.0f}, y {entry.y:.0f} ± {entry.sigma:.0f} m" if np.isfinite(entry.x) else ""


def in_words(sums: Totals) -> list[str]:
    """Totals as texts, one per kind of activity that occurred."""
    counted = f", {sums.steps} steps" if sums.steps else ""  # unknown without an accelerometer
    texts = [f"walked {sums.walked / 1000:.2f} km in {spoken(sums.walking)}{counted}"]
    texts += [f"rode {sums.ridden / 1000:.2f} km in {spoken(sums.riding)}"] if sums.riding else []
    texts += [f"stayed {spoken(sums.staying)}"] if sums.staying else []
    return texts + ([f"no data {spoken(sums.unknown)}"] if sums.unknown else [])


def spoken(seconds: float) -> str:
    """A duration as text: "45 s", "12 min", "2 h 05 min"."""
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60:02d} min"
