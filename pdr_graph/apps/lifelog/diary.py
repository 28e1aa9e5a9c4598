"""The diary of a person: places and the ways between them, parted by the midnights of where the person was.

The timeline of an outing is fine: each stand, each silence of the receiver. A diary has the rows that a person would
write: visits, and between two visits a *leg* for each walk or ride, with its short stops and short silences; a longer
silence is a leg of its own (`stays_and_legs`). The finer entries are the `parts` of a row, so that a visit has its
spots and a leg its stops. Outings on a floor plan, or without positions on Earth, keep their fine rows.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from pdr_graph.apps.lifelog import cache
from pdr_graph.apps.lifelog.corrections import apply_to_entries, corrected, place_names
from pdr_graph.apps.lifelog.day import GAP, KINDS_WITHOUT_DATA, STANDING, VEHICLE, WALKING, Outing
from pdr_graph.apps.lifelog.facts import VISITED, Correction, Guess
from pdr_graph.apps.lifelog.local_time import LocalClock, zone_at, zone_named
from pdr_graph.apps.lifelog.places import NamedArea, Place, places_of, plan_name
from pdr_graph.apps.lifelog.stays_and_legs import (
    SHORTEST_VISIT,
    Track,
    cut,
    rows_of,
    visits_of,
    with_guesses,
    with_likely,
)
from pdr_graph.apps.lifelog.store import ZONE, Store
from pdr_graph.apps.lifelog.timeline import PASSING, SHORTEST_GAP, STAY, TimelineEntry, timeline
from pdr_graph.apps.lifelog.visited import beside
from pdr_graph.errors import count
from pdr_graph.storage import compress, decompress
from pdr_graph.types import DAY_LENGTH, INSTANT, Index, OneLineRepr


@dataclass(frozen=True)
class Totals:
    """Sums over days of a person: times [s], distances [m]. days, recorded: number of days, and of those with data.

    unknown: all time that is not walking, riding or staying; observed: time with data, since stays and legs go on over
    short times without; places: time at each named place, longest first, weighted by the probability of the place.
    """

    days: int
    recorded: int
    walking: float
    riding: float
    staying: float
    unknown: float
    observed: float
    walked: float
    ridden: float
    steps: int
    places: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True)
class DiaryDay(OneLineRepr):
    """A day of a person, from midnight to midnight of where the person was.

    date: "2024-05-01"; start, end: Unix times of its midnights [s]; entries: its rows, in time order; totals: of these;
    outings: those with a part in it.
    """

    person: str
    date: str
    start: float
    end: float
    entries: tuple[TimelineEntry, ...]
    outings: tuple[Outing, ...]
    totals: Totals

    @classmethod
    def of(
        cls,
        person: str,
        date: str,
        midnights: tuple[float, float],
        entries: Sequence[TimelineEntry],
        outings: Sequence[Outing],
    ) -> DiaryDay:
        """Construct with the totals of the rows; the distance of a stay is walked too."""
        first, last = (entries[0].start, entries[-1].end) if entries else (0.0, 0.0)  # days overlap in flights east
        steps = sum(_steps_between(outing, first, last) for outing in outings)
        totals = _totals(entries, midnights[1] - midnights[0], steps)
        return cls(person, date, *midnights, tuple(entries), tuple(outings), totals)

    def _summary(self) -> list[str]:
        return [repr(self.person), self.date, count(len(self.entries), "row")]

    @property
    def offset(self) -> float:
        """Offset of local time from UTC at the start of the day [s]."""
        return self.entries[0].offset if self.entries else 0.0

    @property
    def known(self) -> tuple[TimelineEntry, ...]:
        """The entries from the first to the last one that is known."""
        rows = [n for n, entry in enumerate(self.entries) if entry.is_known]
        return self.entries[rows[0] : rows[-1] + 1] if rows else ()


@dataclass(frozen=True)
class Diary(OneLineRepr):
    """The diary of a person. days: those asked for that have data, in order; places: of all days, unless they are those
    of an overview; visits: of an overview, in time order; doubts: receipts and photos of these days that do not fit.
    """

    person: str
    days: tuple[DiaryDay, ...]
    places: tuple[Place, ...]
    visits: tuple[TimelineEntry, ...] = ()
    doubts: tuple[str, ...] = ()

    def _summary(self) -> list[str]:
        return [repr(self.person), count(len(self.days), "day"), count(len(self.places), "place")]


def dates_of(log: Store) -> list[tuple[str, str]]:
    """Each person and date that is recorded, or of which another program guessed something, in order."""
    fixed, found = log.setting(ZONE), set(log.days())
    for person in log.people():
        found |= {(person, date_of_guess(guess, fixed)) for guess in log.guesses(person)}
    return sorted(found)


def date_of_guess(guess: Guess, zone: str) -> str:
    """The local date of a guess. zone: of the lifelog, "" for that of each place."""
    name = zone or (zone_at(guess.latitude, guess.longitude) if np.isfinite(guess.latitude) else "")
    return datetime.fromtimestamp(guess.start, zone_named(name)).date().isoformat()


def diary(
    log: Store, person: str, first: str = "", last: str = "", tolerance: float = 0.0, outings: bool = True
) -> Diary:
    """The diary of a person from one date to another, both included; all days by default.

    Places are those of all days. tolerance: [m] to which the tracks of outings are simplified, 0 for not; outings:
    False for days without outings and steps, which is faster. Raises InputError if the lifelog is damaged.
    """
    whole = UnpartedDiary.of(log, person, [date for name, date in log.days() if name == person])
    days = parted(_rows_near(whole.rows, first, last), whole.clock, whole.track)
    wanted = {date: own for date, own in days.items() if first <= date and (not last or date <= last)}

    corrections = log.corrections(person)

    @lru_cache(maxsize=4)  # those of a day have parts in its neighbours
    def stored(date: str) -> tuple[Outing, ...]:
        return corrected(day, corrections).outings if outings and (day := log.day(person, date)) else ()

    made = list[DiaryDay]()
    for date, own in wanted.items():
        day = _day(person, date, own, whole, stored)
        made.append(replace(day, outings=tuple(_with_fewer_rows(o, tolerance) for o in day.outings)))
    spans = [(day.start, day.end) for day in made]
    doubts = [text for time, text in whole.doubts if any(a <= time < b for a, b in spans)]
    return Diary(person, tuple(made), whole.places, doubts=tuple(doubts))


def _rows_near(rows: Sequence[TimelineEntry], first: str, last: str) -> list[TimelineEntry]:
    """The rows that may lie in the days from one date to another, in any time zone; "" for no limit."""
    start, end = (datetime.fromisoformat(f"{date}T00:00Z").timestamp() if date else np.nan for date in (first, last))
    return [row for row in rows if not (row.end < start - DAY_LENGTH or row.start > end + 2 * DAY_LENGTH)]


@dataclass(frozen=True)
class UnpartedDiary:
    """A person's diary before midnights part it.

    spans: Unix times of the first and last entry of each stored day, by date [s]; rows: as corrected; places: of these;
    track, clock: where the person was, and the local time there; doubts: receipts and photos that do not fit, each with
    a time [s].
    """

    spans: Mapping[str, tuple[float, float]]
    rows: tuple[TimelineEntry, ...]
    places: tuple[Place, ...]
    track: Track
    clock: LocalClock
    doubts: tuple[tuple[float, str], ...] = ()

    @classmethod
    def of(cls, log: Store, person: str, dates: Sequence[str]) -> UnpartedDiary:
        """The diary of some stored days. Raises InputError if the lifelog is damaged."""
        hashes = log.day_hashes(person)
        digests = tuple(digest_of(log, person, date, hashes[date]) for date in dates)
        track = Track.concatenate([digest.track for digest in digests])
        fine = without_overlaps([entry for digest in digests for entry in digest.entries])
        guesses = log.guesses(person)
        corrections = log.corrections(person)
        rows, places = corrected_rows(fine, track, corrections, guesses)
        seen = [(guess.start, guess.longitude, guess.latitude) for guess in guesses if np.isfinite(guess.latitude)]
        where = np.concatenate([np.column_stack([track.time, track.lonlat]), np.reshape(seen, (-1, 3))])
        where = where[np.argsort(where[:, 0], kind="stable")]
        clock = LocalClock(log.setting(ZONE), where[:, 0], where[:, 1:])
        rows, doubts = beside(rows, track, [c for c in corrections if c.kind == VISITED], clock)
        return cls({digest.date: digest.span for digest in digests}, tuple(rows), places, track, clock, doubts)


def corrected_rows(
    fine: Sequence[TimelineEntry],
    track: Track,
    corrections: Sequence[Correction],
    guesses: Sequence[Guess] = (),
) -> tuple[list[TimelineEntry], tuple[Place, ...]]:
    """The rows of a person as corrected, and the places of all. fine: entries of the timeline; track: of these;
    guesses: of other programs, in time order.
    """
    rows = with_likely(rows_of(fine, visits_of(fine, track), track), track)
    rows = apply_to_entries(with_guesses(rows, guesses) if guesses else rows, corrections, track)
    return with_places(rows, place_names(corrections))


def detailed(rows: Iterable[TimelineEntry]) -> Iterator[TimelineEntry]:
    """The finest entries of rows, each with place and guess of its row; a row that the person stated is one entry."""
    for row in rows:
        if row.corrected or not row.parts:
            yield row
            continue
        about = {name: getattr(row, name) for name in ("place", "place_number", "guess", "offset", "end_offset")}
        yield from (replace(part, **about) for part in row.parts)


@dataclass(frozen=True)
class DayDigest:
    """What a diary needs of a stored day. key: hash of its rows; date: of the store; entries: its timeline; track."""

    key: str
    date: str
    entries: tuple[TimelineEntry, ...]
    track: Track

    @property
    def span(self) -> tuple[float, float]:
        """Unix times of its first and last entry [s]."""
        return (self.entries[0].start, self.entries[-1].end) if self.entries else (np.inf, -np.inf)


def digest_of(log: Store, person: str, date: str, rows_hash: str) -> DayDigest:
    """The digest of a stored day, from its file in ``STORE.d`` if it has one. rows_hash: of the stored rows."""
    file, key = digest_file(log.folder, person, date), cache.key_of(rows_hash)
    digest = cache.read(file, lambda blob: decompress(blob, DayDigest))
    if digest is None or digest.key != key:
        day = log.day(person, date)
        assert day is not None, "a stored day"
        digest = DayDigest(key, date, timeline(day), Track.of(day.outings))
        cache.write(file, compress(digest))
    return digest


def digest_file(folder: Path, person: str, date: str) -> Path:
    """The file of the digest of a stored day. folder: ``STORE.d``."""
    return folder / cache.DIGESTS / cache.key_of(person, date)


def without_overlaps(entries: Sequence[TimelineEntry]) -> list[TimelineEntry]:
    """Entries in time order, each from the end of the one before; the gaps between them are entries too."""
    found: list[TimelineEntry] = []
    for entry in sorted(entries, key=lambda entry: entry.start):
        if found and entry.start - found[-1].end > SHORTEST_GAP:
            found.append(TimelineEntry(GAP, found[-1].end, entry.start))
        start = max(entry.start, found[-1].end) if found else entry.start
        if start == entry.start < entry.end:
            found.append(entry)
        elif entry.end - start > 0:
            share = (entry.end - start) / (entry.end - entry.start)
            found.append(replace(entry, start=start, distance=share * entry.distance))
    return found


def with_places(
    rows: Sequence[TimelineEntry], named: Sequence[NamedArea] = ()
) -> tuple[list[TimelineEntry], tuple[Place, ...]]:
    """The rows with the place of each visit, and all places. named: areas that the person gave a name."""
    visits = {  # stays at a place: long enough, or at a named place on a plan
        n: row
        for n, row in enumerate(rows)
        if row.kind == STAY and (plan_name(row) or (row.duration >= SHORTEST_VISIT and np.isfinite(row.latitude)))
    }
    places = places_of(list(visits.values()), named)
    place_of = {id(visit): place for place in places for visit in place.visits}
    found = list(rows)
    for n, row in visits.items():
        found[n] = replace(row, place=place_of[id(row)].name, place_number=place_of[id(row)].number)
    return found, places


def parted(rows: Sequence[TimelineEntry], clock: LocalClock, track: Track) -> dict[str, list[TimelineEntry]]:
    """The rows of each date, cut at the midnights of where the person was, with the offsets of local time."""
    days: dict[str, list[TimelineEntry]] = {}
    for row in rows:
        midnights = [clock.next_midnight(row.start)]
        while midnights[-1] < row.end:
            midnights.append(clock.next_midnight(midnights[-1]))
        for piece in cut(row, midnights[:-1], track):
            begin = clock.at(piece.start)
            offsets = {"offset": clock.offset(piece.start), "end_offset": clock.offset(piece.end)}
            days.setdefault(begin.date().isoformat(), []).append(replace(piece, **offsets))
    return days


def _day(
    person: str,
    date: str,
    entries: Sequence[TimelineEntry],
    whole: UnpartedDiary,
    outings_of: Callable[[str], Sequence[Outing]],
) -> DiaryDay:
    """A day of a diary, with the outings that have a part in it. outings_of: those of a stored day."""
    start, end = whole.clock.midnight_before(entries[0].start), whole.clock.next_midnight(entries[-1].start)
    touching = [date for date, (first, last) in whole.spans.items() if first < end and last > start]
    outings = [outing for date in touching for outing in outings_of(date)]
    own = [o for o in outings if o.epoch < end and o.epoch + o.segments[-1].end > start]
    return DiaryDay.of(person, date, (start, end), entries, own)


def _with_fewer_rows(outing: Outing, tolerance: float) -> Outing:
    """The outing with the rows that lines through its segments need, without covariances; as it is for 0 m."""
    if not tolerance:
        return outing
    import shapely

    time, kept = outing.trajectory.time, list[Index]()
    for segment in (segment for segment in outing.segments if segment.kind not in KINDS_WITHOUT_DATA):
        first = max(int(np.searchsorted(time, segment.start + INSTANT)) - 1, 0)
        rows = np.arange(first, min(int(np.searchsorted(time, segment.end - INSTANT)) + 1, len(time)))
        if len(rows) > 2:
            line = shapely.linestrings(np.column_stack([outing.trajectory.position[rows], rows]))
            line = shapely.simplify(line, tolerance, preserve_topology=False)
            rows = shapely.get_coordinates(line, include_z=True)[:, 2].astype(np.intp)
        kept.append(rows)
    chosen = np.unique(np.concatenate([np.empty(0, np.intp), *kept]))
    return replace(outing, trajectory=replace(outing.trajectory, covariance=None)[chosen])


def _totals(entries: Sequence[TimelineEntry], length: float, steps: int) -> Totals:
    """Totals of the rows of a day of a length [s]."""
    time, distance, at_places = (defaultdict[str, float](float) for _ in range(3))
    for row in entries:
        time[row.kind] += row.duration
        for part in (row.parts or (row,)) if row.kind in KINDS_WITHOUT_DATA else (row,):
            distance[part.kind] += part.distance
        if row.kind == STAY:
            named = row.facing or [(f"place {row.place_number}", row.place_number > 0)]
            for name, probability in [(row.place, 1.0)] if row.place else named:
                at_places[name] += row.duration * probability
    walking, riding, staying = time[WALKING] + time[PASSING], time[VEHICLE], time[STAY] + time[STANDING]
    observed = float(sum(entry.duration * entry.observed for entry in entries if entry.is_known))
    return Totals(
        days=1,
        recorded=int(observed > 0),
        walking=float(walking),
        riding=float(riding),
        staying=float(staying),
        unknown=max(length - (walking + riding + staying), 0.0),
        observed=observed,
        walked=float(distance[WALKING] + distance[PASSING] + distance[STAY] + distance[STANDING]),
        ridden=float(distance[VEHICLE]),
        steps=steps,
        places=tuple(sorted(((n, t) for n, t in at_places.items() if t), key=lambda item: -item[1])),
    )


def totals_of(days: Sequence[DiaryDay], length: int) -> Totals:
    """Sums over days of one person. length: number of days of the period.

    Of several days they are of calendar hours: those that a flight west repeats count once, so that a week has 168.
    """
    every = [day.totals for day in days]
    sums: dict[str, Any] = {name: sum(getattr(own, name) for own in every) for name in SUMMED_FIELDS}
    sums["unknown"] += (length - len(days)) * DAY_LENGTH
    again = repeated(days) if length > 1 else 0.0
    for name in ("riding", "unknown", "staying"):
        less = min(again, sums[name])
        sums[name], again = sums[name] - less, again - less
    return Totals(days=length, **sums)


def repeated(days: Sequence[DiaryDay]) -> float:
    """Time [s] that the clocks of days show twice: after a flight west; the hour of daylight saving time is none."""
    back = (day.entries[0].offset - day.entries[-1].end_offset for day in days if day.entries)
    return float(sum(by for by in back if by > LONGEST_SUMMER_TIME))


LONGEST_SUMMER_TIME = 3600.0  # [s] that clocks repeat in autumn
SUMMED_FIELDS = ("recorded", "walking", "riding", "staying", "unknown", "observed", "walked", "ridden", "steps")


def _steps_between(outing: Outing, start: float, end: float) -> int:
    """Steps of an outing from `start` to `end` [s], by the rows of its trajectory; parts sum to its steps."""
    time = outing.trajectory.time + outing.epoch
    first, last = np.interp([start, end], time, np.linspace(0, outing.steps, len(time))).round().tolist()
    return int(last - first)
