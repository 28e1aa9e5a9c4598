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
from functools import lru_cache
from itertools import permutations
from pathlib import Path

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pdr_graph.apps.lifelog import cache
from pdr_graph.apps.lifelog.build import ways_of
from pdr_graph.apps.lifelog.corrections import apply_to_observations
from pdr_graph.apps.lifelog.day import Day, Outing, rows_of
from pdr_graph.apps.lifelog.observation import read_observations
from pdr_graph.apps.lifelog.reconstruct import EstimatedWalk, as_outings, estimate_walk, reconstruct_outings
from pdr_graph.apps.lifelog.store import TOGETHER, Store
from pdr_graph.estimation.fingerprinting import Scans, revisits, scans_of
from pdr_graph.estimation.multi_walk import smooth_together
from pdr_graph.gait.walker import Profile
from pdr_graph.priors import BEACONS
from pdr_graph.types import Array, Closures, Recording, Sightings, Trajectory

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
        limit = 1 if all(other.end < walk.start for other in block) else 2
        steps = sum(other.steps for other in block) + walk.steps
        if block and (len(block) >= limit * MAX_WALKS or steps > limit * MAX_STEPS):
            yield WalkBlock(tuple(sorted([*context, *block])), frozenset(context))
            last = block[-CONTEXT:][::-1]
            number = np.searchsorted(np.cumsum([other.steps for other in last]), MAX_CONTEXT_STEPS, side="right")
            block, context = [], last[: max(int(number), 1)]
        block.append(walk)
    if len(block) + len(context) > 1:
        yield WalkBlock(tuple(sorted([*context, *block])), frozenset(context))


# Chosen by hand
MIN_RSSI = BEACONS.path_loss[0]  # [dBm] at a metre; from weaker levels walks contract, see docs/results/seeds.md
ENCOUNTER_SIGMA = 3.0  # [m] per axis of the distance of two people who meet: 3.3 in a simulated crowd
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

    phones: owner of each phone or tag, by its name in the logs of others. People met where a level is that of a metre
    or more, by the path loss of a typical phone.
    """
    rows, which = list[tuple[float, float, float]](), list[tuple[int, int]]()
    for (n, one), (m, other) in permutations(enumerate(walks), 2):
        if one.person == other.person or one.received is None:
            continue
        time, rssi, later = one.received.time, one.received.rssi, one.epoch - other.epoch
        theirs = np.array([phones.get(name) == other.person for name in one.received.transmitter], dtype=bool)
        during = (time >= max(one.start, other.start - later)) & (time <= min(one.end, other.end - later))
        near = np.flatnonzero(theirs & during & (rssi >= MIN_RSSI))
        loudest = near[np.argsort(-rssi[near], kind="stable")]
        for row in loudest[np.unique(time[loudest] // ENCOUNTER_PERIOD, return_index=True)[1]]:
            rows.append((float(time[row]), float(time[row]) + later, ENCOUNTER_SIGMA))
            which.append((n, m))
    return Closures.of(rows, which)


AREA_RADIUS = 10_000.0  # [m] from an area's centre within which walks without a plan share a frame; chosen by hand


Outings = Sequence[EstimatedWalk | Outing]


def bound_walks(
    walks: Sequence[WalkPlace], outings_of: Callable[[int], Outings], people: Sequence[str], phones: Mapping[str, str]
) -> Iterator[tuple[WalkPlace, EstimatedWalk]]:
    """Estimate the walks of an area, block by block; yields each walk that closures connect, with its new estimate.

    outings_of: returns the outings of a day, each estimated by itself; people: who walked on each day; phones: owner of
    each Bluetooth transmitter.
    """
    for block in blocks(walks):
        # All walks in the frame of the first
        alone = [walk for at in block.walks if isinstance(walk := outings_of(at.day)[at.outing], EstimatedWalk)]
        frame = alone[0].joined.frame
        alone = [
            walk if walk.joined.frame == frame else estimate_walk(walk.session, None, walk.profile, frame, walk.ways)
            for walk in alone
        ]

        # Closures by radio scans and encounters
        carried, tracks = list[CarriedPhone](), list[tuple[Trajectory, Scans]]()
        for at, walk in zip(block.walks, alone, strict=True):
            own, steps = walk.joined, walk.graph.steps
            carried.append(CarriedPhone(people[at.day], own.epoch, steps.start, steps.end, own.bluetooth))
            source = walk.session.parts[0][1].source
            scans = scans_of(Recording(source, 0.0, own.epoch, bluetooth=own.bluetooth, wifi=own.wifi))
            tracks.append((walk.estimate.trajectory, scans))
        closures = Closures.concatenate([revisits(tracks), encounters(carried, phones)])

        # A graph for each group of connected walks
        pairs = coo_array((np.ones(len(closures)), closures.walk.T), shape=(len(alone), len(alone)))
        _, group_of = connected_components(pairs, directed=False)
        for group in np.unique(group_of[closures.walk[:, 0]]):
            numbers, rows = np.flatnonzero(group_of == group), group_of[closures.walk[:, 0]] == group
            bound = Closures(closures.time[rows], closures.sigma[rows], np.searchsorted(numbers, closures.walk[rows]))
            chosen = [alone[n] for n in numbers]
            found = smooth_together([walk.graph for walk in chosen], [walk.estimate for walk in chosen], bound)
            for n, walk, estimate in zip(numbers.tolist(), chosen, found, strict=True):
                if block.walks[n] not in block.context:
                    yield block.walks[n], replace(walk, estimate=estimate)


def walks_by_area(days: Iterable[Outings]) -> list[list[WalkPlace]]:
    """The walks on each plan, and walks without a plan whose starts are within AREA_RADIUS; groups of two or more.

    Walks without an absolute position or plan are left out, and walks whose sources contradict each other: the radio
    scans on them are at wrong places.
    """
    areas: defaultdict[object, list[WalkPlace]] = defaultdict(list)
    centres: list[Array] = []  # longitude and latitude [deg]
    for d, outings in enumerate(days):
        for n, walk in enumerate(outings):
            if not isinstance(walk, EstimatedWalk) or not walk.may_bind:
                continue
            area: object = walk.session.parts[0][1].plan
            frame, begin = walk.joined.frame, walk.estimate.trajectory.position[:1]
            if not area and frame.georeferenced:
                far = [np.hypot(*(frame.from_lonlat(centre) - begin)[0]) for centre in centres]
                area = next((number for number, distance in enumerate(far) if distance < AREA_RADIUS), len(centres))
                centres += [frame.to_lonlat(begin)] if area == len(centres) else []
            if area != "":
                start, steps = walk.joined.epoch, walk.graph.steps
                areas[area].append(WalkPlace(d, n, start + steps.start, start + steps.end, len(steps)))
    return [walks for walks in areas.values() if len(walks) > 1]


def estimate_together(store: Path, progress: Callable[[str, int, int], None] = lambda stage, done, total: None) -> int:
    """Estimate all walks of a lifelog that places or encounters connect in common graphs; returns the number of days.

    progress: called with the name of a stage, the days or walks done, and all. Returns 0 if nothing has changed since
    the last time. Raises InputError if the lifelog cannot be used, or an observation is missing.
    """
    with Store(store.resolve()) as log:
        built, phones = log.days(), log.phones()
        key = cache.key_of([[*own, day.key] for own, day in built.items()], sorted(phones.items()))
        if log.setting(TOGETHER) == key:
            return 0
        log.put_setting(TOGETHER, "")
        ways = ways_of(log)
        owners, hashes = list(built), {entry.hash: entry.observation for entry in log.entries()}

        @lru_cache(maxsize=CONTEXT)  # days of the context of the next block
        def estimated(number: int) -> tuple[Outings, Profile | None]:
            """The outings of a day, each estimated by itself, and the profile after it."""
            person, date = owners[number]
            recordings = [(name, hashes[name]) for name in built[person, date].recordings]
            observations = apply_to_observations(read_observations(log.folder, recordings), log.corrections(person))
            before = [
                day.profile for (who, when), day in built.items() if who == person and when < date and day.profile
            ]
            return reconstruct_outings(observations, before[-1] if before else None, ways)

        def put(day: Day) -> None:
            own = built[day.person, day.date]
            log.put_day(rows_of(day, own.key, own.recordings))

        def days_alone() -> Iterator[Outings]:
            """The outings of each day, estimated by themselves and stored so."""
            for number, own in enumerate(owners):
                outings, profile = estimated(number)
                put(Day(*own, as_outings(outings), profile))
                progress("days alone", number + 1, len(owners))
                yield outings

        areas = walks_by_area(days_alone())
        done, total, people = 0, sum(map(len, areas)), [person for person, _ in owners]
        for walks in areas:
            for at, walk in bound_walks(walks, lambda number: estimated(number)[0], people, phones):
                day = log.day(*owners[at.day])
                assert day is not None, "it was stored before"
                put(replace(day, outings=(*day.outings[: at.outing], walk.outing, *day.outings[at.outing + 1 :])))
                progress("walks together", done := done + 1, total)
        log.put_setting(TOGETHER, key)
    return len(owners)
