"""One graph for many days and a group of people: walks bound by place recognition and by encounters.

Two people whose phones heard each other were near each other then ([calibration-walk] Sec. 2). The days are built
already, each by itself. What was observed of all of them is read again and estimated together; so this costs as much as
the whole history, and is done when it is asked for.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pdr_graph.estimation.factors.beacon_rssi import PATH_LOSS
from pdr_graph.estimation.fingerprinting import Scans, revisits, scans_of
from pdr_graph.estimation.multi_walk import smooth_together
from pdr_graph.gait.walker import Profile
from pdr_graph.lifelog import cache, observation
from pdr_graph.lifelog.day import Day, Outing
from pdr_graph.lifelog.observation import Observation
from pdr_graph.lifelog.reconstruct import Walked, outings_of, walked
from pdr_graph.lifelog.store import TOGETHER, Built, Store, rows_of
from pdr_graph.measurements import Closures
from pdr_graph.types import Index, Recording, Sightings

FAINTEST = -85.0  # [dBm] beyond which bodies and reflections say more than the distance, some ten metres
NEAREST = 1.5  # [m] per axis: nobody is told apart nearer than that
EVERY = 15.0  # [s] in which one encounter counts: what shades two people stays for as long


@dataclass(frozen=True)
class Carried:
    """A phone on a walk. person: whose; epoch: Unix time at 0 [s]; start, end: of the walk [s]; heard: by Bluetooth."""

    person: str
    epoch: float
    start: float
    end: float
    heard: Sightings | None


def encounters(walks: Sequence[Carried], phones: Mapping[str, str]) -> Closures:
    """Moments at which people met, on walks of any days.

    phones: whose phone or tag a transmitter is, by the name that others' logs have of it. Where it is heard loudly, its
    owner is as far as a usual phone's path loss says.
    """
    rows, which = list[tuple[float, float, float]](), list[tuple[int, int]]()
    for (n, one), (m, other) in permutations(enumerate(walks), 2):
        if one.person != other.person and one.heard is not None:
            met = list(_met(one, one.heard, other, phones))
            rows += met
            which += [(n, m)] * len(met)
    return Closures.of(rows, which)


def _met(
    one: Carried, heard: Sightings, other: Carried, phones: Mapping[str, str]
) -> Iterator[tuple[float, float, float]]:
    """Both moments and a sigma [m] of each time at which one phone heard the other, the loudest of a while."""
    own = np.array([phones.get(name) == other.person for name in heard.transmitter], dtype=bool)
    later = one.epoch - other.epoch
    during = (heard.time + later >= other.start) & (heard.time + later <= other.end)
    rows = np.flatnonzero(own & during & (heard.rssi >= FAINTEST) & (heard.time >= one.start) & (heard.time <= one.end))
    loudest = rows[np.argsort(-heard.rssi[rows], kind="stable")]
    for row in loudest[np.unique(heard.time[loudest] // EVERY, return_index=True)[1]]:
        time, distance = float(heard.time[row]), 10 ** ((PATH_LOSS[0] - heard.rssi[row]) / (10 * PATH_LOSS[1]))
        yield time, time + later, max(NEAREST, distance / np.sqrt(2))


FARTHEST = 10_000.0  # [m] from one another that walks without a plan begin in one frame


@dataclass(frozen=True)
class PersonDay:
    """What a day is made of, as of `reconstruct.reconstruct`."""

    person: str
    date: str
    observations: Mapping[str, Observation]
    profile: Profile | None


@dataclass(frozen=True)
class _Place:
    """Where a walk stands among the days: of which day, which outing."""

    day: int
    outing: int


def reconstruct_together(days: Sequence[PersonDay], phones: Mapping[str, str]) -> list[Day]:
    """Days of any people, each as it is by itself but for the walks that closures bind: these are of one graph.

    phones: whose phone or tag a Bluetooth transmitter is. Raises InputError as `reconstruct.reconstruct` does.
    """
    made = [outings_of(day.observations, day.profile) for day in days]
    outings: list[list[Walked | Outing]] = [list(own) for own, _ in made]
    for places in _on_common_ground(outings):
        walks = _in_one_frame([_walk(outings, place) for place in places])
        people = [days[place.day].person for place in places]
        for number, walk in _bound(walks, people, phones):
            outings[places[number].day][places[number].outing] = walk
    return [
        Day(day.person, day.date, tuple(one if isinstance(one, Outing) else one.outing for one in own), profile)
        for day, own, (_, profile) in zip(days, outings, made, strict=True)
    ]


def _on_common_ground(outings: Sequence[Sequence[Walked | Outing]]) -> Iterator[list[_Place]]:
    """The walks on each plan, and those without a plan that are not far from one another."""
    grounds: defaultdict[object, list[_Place]] = defaultdict(list)
    centres: list[np.ndarray] = []
    for d, own in enumerate(outings):
        for n, one in enumerate(own):
            if isinstance(one, Walked):
                ground: object = one.group.parts[0][1].plan or _neighbourhood(one, centres)
                if ground is not None:
                    grounds[ground].append(_Place(d, n))
    yield from (places for places in grounds.values() if len(places) > 1)


def _neighbourhood(walk: Walked, centres: list[np.ndarray]) -> int | None:
    """Which of the centres (longitude, latitude) a walk begins near, a new one if none; None if it is nowhere."""
    frame = walk.joined.frame
    if not frame.georeferenced:
        return None
    begin = walk.estimate.trajectory.position[:1]
    for number, centre in enumerate(centres):
        if np.hypot(*(frame.from_lonlat(centre[None]) - begin)[0]) < FARTHEST:
            return number
    centres.append(frame.to_lonlat(begin)[0])
    return len(centres) - 1


def _walk(outings: Sequence[Sequence[Walked | Outing]], place: _Place) -> Walked:
    found = outings[place.day][place.outing]
    assert isinstance(found, Walked), "chosen for being one"
    return found


def _in_one_frame(walks: Sequence[Walked]) -> list[Walked]:
    """Walks that are not in the first one's frame are estimated again in it."""
    frame = walks[0].joined.frame
    return [walk if walk.joined.frame == frame else walked(walk.group, None, walk.profile, frame) for walk in walks]


def _bound(walks: Sequence[Walked], people: Sequence[str], phones: Mapping[str, str]) -> Iterator[tuple[int, Walked]]:
    """The walks that closures bind to others, each as all that are bound together have it."""
    carried = [
        Carried(person, walk.joined.epoch, walk.graph.steps.start, walk.graph.steps.end, walk.joined.bluetooth)
        for person, walk in zip(people, walks, strict=True)
    ]
    seen_again = revisits([(walk.estimate.trajectory, _scans(walk)) for walk in walks])
    closures = Closures.concatenate([seen_again, encounters(carried, phones)])
    for group in _connected(closures, len(walks)):
        own = np.isin(closures.walk[:, 0], group)
        number = np.searchsorted(group, closures.walk[own])
        bound = Closures(closures.time[own], closures.sigma[own], number)
        chosen = [walks[n] for n in group]
        found = smooth_together([walk.graph for walk in chosen], [walk.estimate for walk in chosen], bound)
        for n, walk, estimate in zip(group.tolist(), chosen, found, strict=True):
            yield n, replace(walk, estimate=estimate)


def _connected(closures: Closures, walks: int) -> Iterator[Index]:
    """The walks that are bound, directly or by others, by what binds them, in order."""
    one, other = closures.walk.T
    _, group = connected_components(
        coo_array((np.ones(len(closures)), (one, other)), shape=(walks, walks)), directed=False
    )
    bound = np.unique(group[one])
    yield from (np.flatnonzero(group == number) for number in bound)


def _scans(walk: Walked) -> Scans:
    """What a walk heard."""
    own = walk.joined
    return scans_of(Recording(walk.group.parts[0][1].source, 0.0, own.epoch, bluetooth=own.bluetooth, wifi=own.wifi))


def bind(store: Path) -> int:
    """Put all walks of a lifelog that places or encounters bind into one graph; how many days have such walks now.

    Nothing is done where nothing has changed since the last time. Raises InputError if the lifelog cannot be used, or
    something that was observed is not there.
    """
    with Store(store.resolve()) as log:
        built, phones = log.days(), log.phones()
        key = cache.key_of([[*own, day.key] for own, day in built.items()], sorted(phones.items()))
        if log.setting(TOGETHER) == key:
            return 0
        keys = {entry.hash: entry.observation for entry in log.entries()}
        days = [_day(log.folder, built, keys, *own) for own in built]
        made = reconstruct_together(days, phones)
        for day in made:
            own = built[day.person, day.date]
            log.take(rows_of(day, own.key, own.recordings))
        log.set(TOGETHER, key)
    return len(made)


def _day(
    folder: Path, days: Mapping[tuple[str, str], Built], keys: Mapping[str, str], person: str, date: str
) -> PersonDay:
    """What a day was made of. keys: by recording, of what was observed of it."""
    recordings = [(name, keys[name]) for name in days[person, date].recordings]
    observations = observation.observations_in(folder, recordings)
    before = [day.profile for (who, when), day in days.items() if who == person and when < date]
    known = [profile for profile in before if profile is not None]
    return PersonDay(person, date, observations, known[-1] if known else None)
