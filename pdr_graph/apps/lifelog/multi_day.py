"""One graph for many days and a group of people: walks bound by place recognition and by encounters.

Two people whose phones received each other were near each other at that time ([calibration-walk] Sec. 2). The days are
built before, each by itself. Their observations are read again and estimated together, in blocks by place and time:
memory is bounded, and the time proportional to the length of the history. Each block also contains the last walks of
the block before it, whose estimates are not used: they bind the block to the same radio scans, so that both agree.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pdr_graph.apps.lifelog import cache, observation
from pdr_graph.apps.lifelog.corrections import apply_to_observations
from pdr_graph.apps.lifelog.day import Day, Outing, rows_of
from pdr_graph.apps.lifelog.facts import Correction
from pdr_graph.apps.lifelog.observation import Observation
from pdr_graph.apps.lifelog.reconstruct import EstimatedWalk, as_outings, estimate_walk, reconstruct_outings
from pdr_graph.apps.lifelog.store import TOGETHER, Store, StoredDay
from pdr_graph.errors import count
from pdr_graph.estimation.fingerprinting import Scans, revisits, scans_of
from pdr_graph.estimation.multi_walk import smooth_together
from pdr_graph.gait.walker import Profile
from pdr_graph.priors import BEACONS
from pdr_graph.types import Closures, Index, OneLineRepr, Recording, Sightings

# Chosen by hand: a block takes seconds and less than a gigabyte
MAX_WALKS = 30
MAX_STEPS = 60_000  # in the walks of a block
CONTEXT = 10  # walks of the block before
MAX_CONTEXT_STEPS = 20_000


@dataclass(frozen=True, order=True)
class WalkPlace:
    """A walk in a history. day, outing: its numbers; start, end: Unix times [s]; steps: number of steps."""

    day: int
    outing: int
    start: float
    end: float
    steps: int


@dataclass(frozen=True)
class WalkBlock:
    """Walks to estimate in one graph. walks: in the order of the history; context: those of the block before."""

    walks: tuple[WalkPlace, ...]
    context: frozenset[WalkPlace]


def blocks(walks: Sequence[WalkPlace]) -> Iterator[WalkBlock]:
    """Part the walks at one place into blocks of at most MAX_WALKS and MAX_STEPS, with the context of each.

    Walks of the same time, whose people may meet, are in one block, unless it would have twice as many.
    """
    block, context = list[WalkPlace](), list[WalkPlace]()
    for walk in sorted(walks, key=lambda walk: (walk.start, walk)):
        if block and _is_full([*block, walk], all(other.end < walk.start for other in block)):
            yield WalkBlock(tuple(sorted([*context, *block])), frozenset(context))
            block, context = [], _last(block)
        block.append(walk)
    if len(block) + len(context) > 1:
        yield WalkBlock(tuple(sorted([*context, *block])), frozenset(context))


def _is_full(block: Sequence[WalkPlace], may_part: bool) -> bool:
    """True if a block is too large. may_part: nobody in it walked at the time of its last walk."""
    allowed = 1 if may_part else 2
    return len(block) > allowed * MAX_WALKS or sum(walk.steps for walk in block) > allowed * MAX_STEPS


def _last(block: Sequence[WalkPlace]) -> list[WalkPlace]:
    """The last walks of a block, as context of the next."""
    steps, found = 0, list[WalkPlace]()
    for walk in reversed(block[-CONTEXT:]):
        steps += walk.steps
        if found and steps > MAX_CONTEXT_STEPS:
            break
        found.append(walk)
    return found


# Chosen by hand
MIN_RSSI = -85.0  # [dBm] about ten metres; weaker levels depend more on bodies and reflections than on the distance
MIN_SIGMA = 1.5  # [m] per axis of the distance of two people who meet
ENCOUNTER_PERIOD = 15.0  # [s] with one encounter at most: the shadowing by bodies is the same for as long


@dataclass(frozen=True)
class CarriedPhone:
    """A phone on a walk. person: its owner; epoch: Unix time at 0 [s]; start, end: of the walk [s]; received: Bluetooth
    receptions, None if there are none.
    """

    person: str
    epoch: float
    start: float
    end: float
    received: Sightings | None


def encounters(walks: Sequence[CarriedPhone], phones: Mapping[str, str]) -> Closures:
    """Loop closures between walks of people who met, on any days.

    phones: owner of each phone or tag, by its name in the logs of others. The distance of a strong reception follows
    from the path loss of a typical phone.
    """
    rows, which = list[tuple[float, float, float]](), list[tuple[int, int]]()
    for (n, one), (m, other) in permutations(enumerate(walks), 2):
        if one.person != other.person and one.received is not None:
            met = list(_pair_encounters(one, one.received, other, phones))
            rows += met
            which += [(n, m)] * len(met)
    return Closures.of(rows, which)


def _pair_encounters(
    one: CarriedPhone, received: Sightings, other: CarriedPhone, phones: Mapping[str, str]
) -> Iterator[tuple[float, float, float]]:
    """Both times and a sigma [m] of the strongest reception of the other's phone in each ENCOUNTER_PERIOD."""
    theirs = np.array([phones.get(name) == other.person for name in received.transmitter], dtype=bool)
    later, time = one.epoch - other.epoch, received.time
    during = (time + later >= other.start) & (time + later <= other.end) & (time >= one.start) & (time <= one.end)
    rows = np.flatnonzero(theirs & during & (received.rssi >= MIN_RSSI))
    loudest = rows[np.argsort(-received.rssi[rows], kind="stable")]
    power, exponent, _ = BEACONS.path_loss
    for row in loudest[np.unique(time[loudest] // ENCOUNTER_PERIOD, return_index=True)[1]]:
        moment, distance = float(time[row]), 10 ** ((power - received.rssi[row]) / (10 * exponent))
        yield moment, moment + later, max(MIN_SIGMA, distance / np.sqrt(2))


AREA_RADIUS = 10_000.0  # [m] from an area's centre within which walks without a plan share a frame; chosen by hand


@dataclass(frozen=True)
class PersonDay(OneLineRepr):
    """The inputs of a day, as of `reconstruct.reconstruct`."""

    person: str
    date: str
    observations: Mapping[str, Observation]
    profile: Profile | None

    def _summary(self) -> list[str]:
        return [repr(self.person), self.date, count(len(self.observations), "recording")]


Outings = Sequence[EstimatedWalk | Outing]


def reconstruct_together(days: Sequence[PersonDay], phones: Mapping[str, str]) -> list[Day]:
    """Reconstruct days of any people: walks that closures connect in one graph, all others by themselves.

    phones: owner of each Bluetooth transmitter. Raises InputError as `reconstruct.reconstruct` does.
    """
    made = [reconstruct_outings(day.observations, day.profile) for day in days]
    outings: list[list[EstimatedWalk | Outing]] = [list(own) for own, _ in made]
    people = [day.person for day in days]
    for walks in walks_by_area(own for own, _ in made):
        for place, walk in bound_walks(walks, lambda day: made[day][0], people, phones):
            outings[place.day][place.outing] = walk
    return [
        Day(day.person, day.date, as_outings(own), profile)
        for day, own, (_, profile) in zip(days, outings, made, strict=True)
    ]


def bound_walks(
    walks: Sequence[WalkPlace], outings_of: Callable[[int], Outings], people: Sequence[str], phones: Mapping[str, str]
) -> Iterator[tuple[WalkPlace, EstimatedWalk]]:
    """Estimate the walks of an area, block by block; yields each walk that closures connect, with its new estimate.

    outings_of: returns the outings of a day, each estimated by itself; people: who walked on each day.
    """
    for block in blocks(walks):
        found = [outings_of(place.day)[place.outing] for place in block.walks]
        alone = _in_one_frame([walk for walk in found if isinstance(walk, EstimatedWalk)])
        for number, walk in _estimate_bound(alone, [people[place.day] for place in block.walks], phones):
            if block.walks[number] not in block.context:
                yield block.walks[number], walk


def walks_by_area(days: Iterable[Outings]) -> list[list[WalkPlace]]:
    """The walks on each plan, and walks without a plan whose starts are within AREA_RADIUS; groups of two or more.

    Walks whose sources contradict each other are left out: the radio scans on them are at wrong places.
    """
    grounds: defaultdict[object, list[WalkPlace]] = defaultdict(list)
    centres: list[np.ndarray] = []
    for d, own in enumerate(days):
        for n, one in enumerate(own):
            if isinstance(one, EstimatedWalk) and one.may_bind:
                ground: object = one.session.parts[0][1].plan or _area_of(one, centres)
                if ground is not None:
                    start, steps = one.joined.epoch, one.graph.steps
                    grounds[ground].append(WalkPlace(d, n, start + steps.start, start + steps.end, len(steps)))
    return [walks for walks in grounds.values() if len(walks) > 1]


def _area_of(walk: EstimatedWalk, centres: list[np.ndarray]) -> int | None:
    """Number of the area in which a walk begins; None without an absolute position.

    centres: longitude and latitude of each area [deg], to which a new area is appended.
    """
    frame = walk.joined.frame
    if not frame.georeferenced:
        return None
    begin = walk.estimate.trajectory.position[:1]
    for number, centre in enumerate(centres):
        if np.hypot(*(frame.from_lonlat(centre[None]) - begin)[0]) < AREA_RADIUS:
            return number
    centres.append(frame.to_lonlat(begin)[0])
    return len(centres) - 1


def _in_one_frame(walks: Sequence[EstimatedWalk]) -> list[EstimatedWalk]:
    """The walks in the frame of the first; those in another frame are estimated again."""
    frame = walks[0].joined.frame
    return [
        walk if walk.joined.frame == frame else estimate_walk(walk.session, None, walk.profile, frame) for walk in walks
    ]


def _estimate_bound(
    walks: Sequence[EstimatedWalk], people: Sequence[str], phones: Mapping[str, str]
) -> Iterator[tuple[int, EstimatedWalk]]:
    """Estimate connected walks together; yields the number and the new estimate of each walk that closures connect."""
    carried = [
        CarriedPhone(person, walk.joined.epoch, walk.graph.steps.start, walk.graph.steps.end, walk.joined.bluetooth)
        for person, walk in zip(people, walks, strict=True)
    ]
    seen_again = revisits([(walk.estimate.trajectory, _scans(walk)) for walk in walks])
    closures = Closures.concatenate([seen_again, encounters(carried, phones)])
    for group in _connected_walks(closures, len(walks)):
        own = np.isin(closures.walk[:, 0], group)
        number = np.searchsorted(group, closures.walk[own])
        bound = Closures(closures.time[own], closures.sigma[own], number)
        chosen = [walks[n] for n in group]
        found = smooth_together([walk.graph for walk in chosen], [walk.estimate for walk in chosen], bound)
        for n, walk, estimate in zip(group.tolist(), chosen, found, strict=True):
            yield n, replace(walk, estimate=estimate)


def _connected_walks(closures: Closures, walks: int) -> Iterator[Index]:
    """The numbers of the walks in each connected component of two or more walks, in increasing order."""
    one, other = closures.walk.T
    _, group = connected_components(
        coo_array((np.ones(len(closures)), (one, other)), shape=(walks, walks)), directed=False
    )
    bound = np.unique(group[one])
    yield from (np.flatnonzero(group == number) for number in bound)


def _scans(walk: EstimatedWalk) -> Scans:
    """The radio scans of a walk."""
    own = walk.joined
    return scans_of(Recording(walk.session.parts[0][1].source, 0.0, own.epoch, bluetooth=own.bluetooth, wifi=own.wifi))


class _StoredDays:
    """The days of a lifelog, each reconstructed by itself when it is asked for; the last ones are kept in memory."""

    KEPT_STEPS = MAX_STEPS

    def __init__(self, log: Store):
        self.built, self._log = log.days(), log
        self.keys = list(self.built)
        self._observations = {entry.hash: entry.observation for entry in log.entries()}
        self._kept: dict[int, tuple[Outings, Profile | None]] = {}

    def outings(self, number: int) -> Outings:
        """The outings of a day, each estimated by itself."""
        return self.reconstructed(number)[0]

    def reconstructed(self, number: int) -> tuple[Outings, Profile | None]:
        """The outings of a day, each estimated by itself, and the profile after it."""
        if number not in self._kept:
            own = self.keys[number]
            corrections = self._log.corrections(own[0])
            day = _inputs_of_day(self._log.folder, self.built, self._observations, *own, corrections)
            self._kept[number] = reconstruct_outings(day.observations, day.profile)
            while len(self._kept) > 1 and sum(map(_steps, self._kept.values())) > self.KEPT_STEPS:
                del self._kept[next(iter(self._kept))]
        return self._kept[number]

    def put(self, day: Day) -> None:
        """Store a day."""
        own = self.built[day.person, day.date]
        self._log.put_day(rows_of(day, own.key, own.recordings))


def _steps(reconstructed: tuple[Outings, Profile | None]) -> int:
    """Number of steps of a day."""
    return sum(len(one.graph.steps) for one in reconstructed[0] if isinstance(one, EstimatedWalk))


def estimate_together(store: Path, progress: Callable[[str, int, int], None] = lambda stage, done, total: None) -> int:
    """Estimate all walks of a lifelog that places or encounters connect in common graphs; returns the number of days.

    progress: called with the name of a stage, the days or walks done, and all. Returns 0 if nothing has changed since
    the last time. Raises InputError if the lifelog cannot be used, or an observation is missing.
    """
    with Store(store.resolve()) as log:
        days, phones = _StoredDays(log), log.phones()
        key = cache.key_of([[*own, day.key] for own, day in days.built.items()], sorted(phones.items()))
        if log.setting(TOGETHER) == key:
            return 0
        log.put_setting(TOGETHER, "")
        areas = walks_by_area(_alone(days, progress))
        done, total, people = 0, sum(map(len, areas)), [person for person, _ in days.keys]
        for walks in areas:
            for place, walk in bound_walks(walks, days.outings, people, phones):
                day = log.day(*days.keys[place.day])
                assert day is not None, "it was stored before"
                outings = [*day.outings[: place.outing], walk.outing, *day.outings[place.outing + 1 :]]
                days.put(replace(day, outings=tuple(outings)))
                progress("walks together", done := done + 1, total)
        log.put_setting(TOGETHER, key)
    return len(days.keys)


def _alone(days: _StoredDays, progress: Callable[[str, int, int], None]) -> Iterator[Outings]:
    """The outings of each day, estimated by themselves and stored so."""
    for number, own in enumerate(days.keys):
        outings, profile = days.reconstructed(number)
        days.put(Day(*own, as_outings(outings), profile))
        progress("days alone", number + 1, len(days.keys))
        yield outings


def _inputs_of_day(
    folder: Path,
    days: Mapping[tuple[str, str], StoredDay],
    keys: Mapping[str, str],
    person: str,
    date: str,
    corrections: Sequence[Correction],
) -> PersonDay:
    """The inputs of a stored day. keys: of the observation, by content hash; corrections: of the person."""
    recordings = [(name, keys[name]) for name in days[person, date].recordings]
    observations = apply_to_observations(observation.read_observations(folder, recordings), corrections)
    before = [day.profile for (who, when), day in days.items() if who == person and when < date]
    known = [profile for profile in before if profile is not None]
    return PersonDay(person, date, observations, known[-1] if known else None)
