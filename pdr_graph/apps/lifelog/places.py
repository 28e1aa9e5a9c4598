"""Places: what was visited, with visits, a name, and the hours at which somebody usually comes and leaves.

Visits within VISIT_RADIUS of one another are at one place: leader clustering, the most certain visits first, each place
at the weighted mean of its visits. A name is what the person or a floor plan says; nothing is guessed.

A stay that continues after midnight is one visit. The start of a stay counts as an arrival only if it was observed: not
after a time without data.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from datetime import date
from functools import cached_property
from itertools import product, zip_longest

import numpy as np

from pdr_graph.apps.lifelog.day import KINDS_WITHOUT_DATA
from pdr_graph.apps.lifelog.local_time import LocalClock, zone_at
from pdr_graph.apps.lifelog.stays_and_legs import HALT_SIGMA, VISIT_RADIUS, lonlat_of, on_sphere
from pdr_graph.apps.lifelog.timeline import STAY, TimelineEntry, duration_text, place_label
from pdr_graph.errors import count
from pdr_graph.types import DAY_LENGTH, Array, OneLineRepr

NIGHT_END, FEWEST_NIGHTS = 6 * 3600.0, 3  # [s] after midnight; nights of which a home is guessed
WEEKDAYS = ("Monday", "Tuesday", "Wednesday", "Thursday", "Friday", "Saturday", "Sunday")
EVERY_DAY = "every day"  # instead of a weekday
FEWEST_HOURS = 3  # times of a spread
# Chosen by hand
MODES_APART = 2.0  # [h] of two usual hours, at least
UNOBSERVED_TIME = 900.0  # [s] of no data before a stay, below which its start counts as an arrival; departures likewise

NamedArea = tuple[float, float, float, str]  # latitude, longitude [deg], radius [m], name


@dataclass(frozen=True)
class UsualHours:
    """When somebody first comes to a place on a day, and last leaves it: quartiles of local time [h].

    Each is a time that was observed; NaN where fewer than FEWEST_HOURS are known.

    weekday: of the arrival or the departure, or EVERY_DAY; arrivals, departures: how many were observed.
    """

    weekday: str
    arrivals: int
    arrival: tuple[float, float, float]
    departures: int
    departure: tuple[float, float, float]


@dataclass(frozen=True)
class Place(OneLineRepr):
    """A visited place. number: in the order of the first visits, from 1, -1 if it has none; name: "" if it has none.

    latitude, longitude: [deg], NaN if unknown; sigma: standard deviation per axis of its position [m];
    visits: in order.
    """

    number: int
    name: str
    latitude: float
    longitude: float
    sigma: float
    visits: tuple[TimelineEntry, ...]

    @property
    def duration(self) -> float:
        """Time spent there [s]."""
        return float(sum(visit.duration for visit in self.visits))

    @property
    def label(self) -> str:
        """Its name, or its number."""
        return place_label(self.name, self.number)

    @property
    def first(self) -> str:
        """Local date of the start of the first visit."""
        return local_date(self.visits[0].start + self.visits[0].offset).isoformat()

    @property
    def last(self) -> str:
        """Local date of the end of the last visit."""
        return local_date(self.visits[-1].end + self.visits[-1].end_offset).isoformat()

    @cached_property
    def hours(self) -> tuple[UsualHours, ...]:
        """Usual hours of every day, then of each weekday on which somebody arrived or left, a row for each mode.

        Of each date the first arrival and the last departure, if they were observed.
        """
        first, last = dict[date, TimelineEntry](), dict[date, TimelineEntry]()
        for visit in self.visits:
            first.setdefault(local_date(visit.start + visit.offset), visit)
            last[local_date(visit.end + visit.end_offset)] = visit
        come = np.array([v.start + v.offset for v in first.values() if v.arrived])
        gone = np.array([v.end + v.end_offset for v in last.values() if v.left])
        found = []
        for weekday in (-1, *range(7)):
            # Monday is 0; 1 January 1970 was a Thursday
            own = [t[(weekday < 0) | ((np.floor(t / DAY_LENGTH) + 3) % 7 == weekday)] for t in (come, gone)]
            if weekday < 0 or any(len(time) for time in own):
                name = EVERY_DAY if weekday < 0 else WEEKDAYS[weekday]
                for came, left in zip_longest(*(clock_modes(time / 3600 % 24) for time in own), fillvalue=np.empty(0)):
                    found.append(UsualHours(name, len(came), clock_quartiles(came), len(left), clock_quartiles(left)))
        return tuple(found)

    def _summary(self) -> list[str]:
        return [self.label, count(len(self.visits), "visit"), duration_text(self.duration)]


def places_of(visits: Sequence[TimelineEntry], named: Sequence[NamedArea] = ()) -> tuple[Place, ...]:
    """The places of visits, in the order of their first visits. named: areas that the person gave a name."""
    clusters, numbers = list[_Cluster](), defaultdict[str, list[int]](list)  # of each name on a plan, "" for none
    points = on_sphere(np.array([[visit.longitude, visit.latitude] for visit in visits]).reshape(-1, 2))
    located, middles = list(zip(visits, points, strict=True)), np.empty((len(visits), 3))  # of the clusters
    for visit, point in sorted(located, key=lambda pair: (_sigma(pair[0]), pair[0].start)):
        name = plan_name(visit)
        own = numbers[name]
        far = np.nan_to_num(np.linalg.norm(middles[own] - point, axis=1))  # 0 if unknown: of one name on a plan
        # widest place [m] between visits of one name on a plan
        widest = 500.0 if name else VISIT_RADIUS + min(_sigma(visit), VISIT_RADIUS)
        if far.min(initial=np.inf) > widest:
            own.append(len(clusters))
            clusters.append(_Cluster())
        n = own[-1] if len(own) > len(far) else own[int(far.argmin())]
        clusters[n].visits.append((visit, point))
        clusters[n].weight += _weight(visit)
        clusters[n].total = clusters[n].total + _weight(visit) * point
        middles[n] = clusters[n].total / clusters[n].weight
    ordered = sorted(clusters, key=lambda own: min(visit.start for visit, _ in own.visits))
    return tuple(own.place(number, named) for number, own in enumerate(ordered, start=1))


def plan_name(visit: TimelineEntry) -> str:
    """The most probable place on a plan; "" if it is not probable enough."""
    # least name probability of a place on a plan that names a visit; chosen by hand
    return visit.facing[0][0] if visit.facing and visit.facing[0][1] >= 0.5 else ""


@dataclass
class _Cluster:
    """Visits of one place with their middles ``(3,)`` on the sphere [m], and the sums for their weighted mean place."""

    visits: list[tuple[TimelineEntry, Array]] = field(default_factory=list)
    weight: float = 0.0
    total: Array = field(default_factory=lambda: np.zeros(3))

    def place(self, number: int, named: Sequence[NamedArea]) -> Place:
        """The place of the visits, with the name of the nearest area that it is in; the last name given counts."""
        ordered = sorted(self.visits, key=lambda pair: pair[0].start)
        visits, middles = [visit for visit, _ in ordered], np.array([middle for _, middle in ordered])
        weight, sigma = (np.array([f(visit) for visit in visits]) for f in (_weight, _sigma))
        middle = weight @ middles / weight.sum()
        variance = weight @ (sigma**2 / len(visits) + ((middles - middle) ** 2).sum(axis=1) / 2)
        longitude, latitude = lonlat_of(middle)
        areas = list[tuple[float, int, str]]()
        for n, (lat, lon, radius, name) in enumerate(named):
            far = float(np.linalg.norm(on_sphere(np.array([[lon, lat]]))[0] - middle))
            areas += [(far, -n, name)] if far <= radius else []
        name = min(areas)[2] if areas else plan_name(visits[0])
        return Place(number, name, latitude, longitude, float(np.sqrt(variance / weight.sum())), tuple(visits))


def _sigma(visit: TimelineEntry) -> float:
    """Standard deviation per axis of a visit [m], 0 if unknown."""
    return 0.0 if math.isnan(visit.sigma) else float(visit.sigma)


def _weight(visit: TimelineEntry) -> float:
    """Weight of a visit in the mean of its place [s/m²]."""
    return visit.duration / (HALT_SIGMA**2 + _sigma(visit) ** 2)


def likely_home(places: Sequence[Place]) -> Place | None:
    """The place with most time from midnight to NIGHT_END of its own time zone; None before FEWEST_NIGHTS of it.

    A guess, for those who ask for one: nights are spent at home more often than anywhere else.
    """
    best, most = None, 0.0
    for place in places:
        clock = LocalClock(zone_at(place.latitude, place.longitude), np.empty(0), np.empty((0, 2)))
        total = 0.0
        for visit in place.visits if np.isfinite(place.latitude) else ():
            midnight = clock.midnight_before(visit.start)
            while midnight < visit.end:
                total += max(min(visit.end, midnight + NIGHT_END) - max(visit.start, midnight), 0.0)
                midnight = clock.next_midnight(midnight)
        best, most = (place, total) if total > most else (best, most)
    return best if most >= FEWEST_NIGHTS * NIGHT_END else None


@dataclass(frozen=True)
class Dwell:
    """Time of all persons at a place on a plan, by the probability of each stay that it was there.

    name; floor: its labels; persons, stops: expected numbers; time: expected time [s]; sigma: its standard deviation,
    since each stay was at one place alone [s]; median: of the duration of a stop [s]; hours: expected time in each hour
    of the day ``(24,)``, local [s].
    """

    name: str
    floor: str
    persons: float
    stops: float
    time: float
    sigma: float
    median: float
    hours: Array

    @property
    def hour(self) -> int:
        """The hour of the day in which most time was spent there."""
        return int(self.hours.argmax())


def dwells(rows: Iterable[tuple[str, TimelineEntry]]) -> list[Dwell]:
    """The time at each place that some persons faced, longest first. rows: persons with entries of their days."""
    stays = defaultdict[tuple[str, str], list[tuple[str, float, TimelineEntry]]](list)
    for person, row in rows:
        for part in (part for part in row.parts or (row,) if part.kind == STAY):
            for name, probability in part.facing:
                stays[name, " > ".join(part.floor)].append((person, probability, replace(part, offset=row.offset)))
    found = list[Dwell]()
    for (name, floor), own in stays.items():
        p, lasted = np.array([p for _, p, _ in own]), np.array([part.duration for _, _, part in own])
        absent, hours = defaultdict[str, float](lambda: 1.0), np.zeros(24)
        for person, probability, part in own:
            absent[person] *= 1 - probability
            hours += probability * _hours_of(part)
        order = np.argsort(lasted)
        half = np.searchsorted(np.cumsum(p[order]), p.sum() / 2)
        spread = float(np.sqrt((p * (1 - p) * lasted**2).sum()))
        persons, median = sum(1 - none for none in absent.values()), float(lasted[order][half])
        found.append(Dwell(name, floor, persons, float(p.sum()), float(p @ lasted), spread, median, hours))
    return sorted(found, key=lambda dwell: (-dwell.time, dwell.name))


def _hours_of(part: TimelineEntry) -> Array:
    """Time of an entry in each local hour of the day ``(24,)`` [s]."""
    start, end = part.start + part.offset, part.end + part.offset
    edge = 3600.0 * np.arange(start // 3600, end // 3600 + 2)
    hours = np.zeros(24)
    np.add.at(hours, (edge[:-1] // 3600 % 24).astype(int), np.diff(np.clip(edge, start, end)))
    return hours


@dataclass(frozen=True)
class Flow:
    """How often persons went from one place on a plan to the next, by the probabilities of their stays.

    origin, target: names; origin_floor, target_floor: labels; number: expected; sigma: its standard deviation.
    """

    origin: str
    origin_floor: str
    target: str
    target_floor: str
    number: float
    sigma: float


def flows(days: Iterable[Sequence[TimelineEntry]]) -> list[Flow]:
    """The flows between the places that persons faced, largest first. days: entries of each day of each person.

    Stays are independent: the last place before a stay is one that an earlier stay was at, if none since was at any.
    """
    found = defaultdict[tuple[str, str, str, str], list[float]](list)
    for entries in days:
        last = dict[tuple[str, str], float]()
        for part in (part for row in entries for part in row.parts or (row,) if part.kind == STAY):
            here = {(name, " > ".join(part.floor)): probability for name, probability in part.facing}
            nowhere = max(1 - sum(here.values()), 0.0)
            for (origin, p), (target, q) in product(last.items(), here.items()):
                if origin != target:
                    found[*origin, *target].append(p * q)
            last = {name: nowhere * last.get(name, 0.0) + here.get(name, 0.0) for name in last | here}
    made = [Flow(*names, sum(p), float(np.sqrt(sum(x * (1 - x) for x in p)))) for names, p in found.items()]
    return sorted(made, key=lambda flow: (-flow.number, flow.origin, flow.target))


def is_place(text: str, name: str, number: int) -> bool:
    """True if a text is the name, in any case, or the number of a place."""
    plain = text.strip().casefold()
    return bool(plain) and (plain == name.strip().casefold() or plain in (str(number), f"place {number}"))


def joined_visits(entries: Sequence[TimelineEntry]) -> list[TimelineEntry]:
    """The visits of a person, over midnights too. entries: of all days, in time order."""
    joined: list[list[TimelineEntry]] = []
    for entry in entries:
        if joined and _continues(joined[-1][-1], entry):
            joined[-1].append(entry)
        else:
            joined.append([entry])
    found = list[TimelineEntry]()
    for before, parts, after in zip([[], *joined], joined, [*joined[1:], []], strict=False):
        first, last, longest = parts[0], parts[-1], max(parts, key=lambda entry: entry.duration)
        if first.kind != STAY:
            continue
        seen = [[p for e in beside for p in e.parts or (e,) if p.is_seen] for beside in (before[-1:], after[:1])]
        arrived = bool(before) and first.start - max((p.end for p in seen[0]), default=-np.inf) < UNOBSERVED_TIME
        left = bool(after) and min((p.start for p in seen[1]), default=np.inf) - last.end < UNOBSERVED_TIME
        observed = sum(entry.duration * entry.observed for entry in parts) / max(last.end - first.start, 1e-9)
        at = {"latitude": longest.latitude, "longitude": longest.longitude, "sigma": longest.sigma}
        whole = replace(first, end=last.end, end_offset=last.end_offset, observed=float(observed), **at)
        found.append(replace(whole, arrived=arrived, left=left))
    return found


def _continues(before: TimelineEntry, after: TimelineEntry) -> bool:
    """True if two entries are one, divided at midnight."""
    same = before.place_number == after.place_number and before.place == after.place
    unplaced = before.place_number < 0 and (before.x, before.y) != (after.x, after.y)
    kinds = before.kind == after.kind and after.kind in (STAY, *KINDS_WITHOUT_DATA)
    # same instant [s] between two parts of a stay, before and after midnight
    return kinds and abs(after.start - before.end) < 1.0 and same and not (after.kind == STAY and unplaced)


def places_of_visits(visits: Sequence[TimelineEntry], known: Sequence[Place]) -> tuple[Place, ...]:
    """The places of some visits of a person, most time first. known: all places of the person."""
    by_place: dict[tuple[int, str], list[TimelineEntry]] = {}
    for visit in visits:
        if visit.label:
            by_place.setdefault((visit.place_number, visit.place), []).append(visit)
    at, found = {place.number: place for place in known}, list[Place]()
    for (number, name), own in by_place.items():
        where = at.get(number) or max(own, key=lambda visit: visit.duration)
        found.append(Place(number, name, where.latitude, where.longitude, where.sigma, tuple(own)))
    return tuple(sorted(found, key=lambda place: (-place.duration, place.number)))


def local_date(local: float) -> date:
    """The date of a local time [s]."""
    return date.fromisoformat(str(np.datetime64(int(local), "s"))[:10])


def clock_quartiles(hours: Array) -> tuple[float, float, float]:
    """Lower quartile, median and upper quartile of times of day [h]; 23:30 is near 0:30. NaN for few.

    Each is one of the times: the order is that of the distances, up to 12 h, from the circular mean.
    """
    if len(hours) < FEWEST_HOURS:
        return np.nan, np.nan, np.nan
    angle = np.asarray(hours) * np.pi / 12
    mean = np.arctan2(np.sin(angle).mean(), np.cos(angle).mean()) * 12 / np.pi
    away = (np.asarray(hours) - mean + 12) % 24 - 12
    low, middle, high = ((mean + np.quantile(away, [0.25, 0.5, 0.75], method="inverted_cdf")) % 24).tolist()
    return low, middle, high


def clock_modes(hours: Array) -> list[Array]:
    """Times of day [h] parted into their modes of FEWEST_HOURS times or more; one of all if there are not several.

    Two modes are farther apart than MODES_APART, and than four times their common spread; either half of a uniform
    distribution is 3.5 of its spread from the other (Ashman's D: Ashman, Bird and Zepf, Astron. J. 108, 1994).
    """
    hours = np.sort(hours)
    if len(hours) < 2 * FEWEST_HOURS:
        return [hours]
    first = int(np.argmax(np.diff(hours, prepend=hours[-1] - 24)))  # after the longest time without any
    time = np.concatenate([hours[first:], hours[:first] + 24])
    cuts = np.arange(FEWEST_HOURS, len(time) - FEWEST_HOURS + 1)
    spread = [
        np.sqrt((len(a) * a.var() + len(b) * b.var()) / len(time)) for a, b in (np.split(time, [k]) for k in cuts)
    ]
    parts = np.split(time, [cuts[np.argmin(spread)]])
    if parts[1].mean() - parts[0].mean() <= max(MODES_APART, 4 * min(spread)):
        return [hours]
    return [mode for part in parts for mode in clock_modes(part % 24)]
