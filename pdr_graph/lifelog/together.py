"""One graph for many days and a group of people: their walks bound by places seen again and by encounters."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pdr_graph.estimation.closures import Closures
from pdr_graph.estimation.fingerprints import Scans, scans_of
from pdr_graph.estimation.revisits import revisits
from pdr_graph.estimation.together import smooth_together
from pdr_graph.gait.profile import Profile
from pdr_graph.lifelog.day import Day, Outing
from pdr_graph.lifelog.days import outings_of
from pdr_graph.lifelog.encounters import Carried, encounters
from pdr_graph.lifelog.observation import Observation
from pdr_graph.lifelog.walks import Walked, walked
from pdr_graph.types import Index, Recording

FARTHEST = 10_000.0  # [m] from one another that walks without a plan begin in one frame


@dataclass(frozen=True)
class PersonDay:
    """What a day is made of, as of `days.reconstruct`."""

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

    phones: whose phone or tag a Bluetooth transmitter is. Raises InputError as `days.reconstruct` does.
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
    closures = Closures.together([seen_again, encounters(carried, phones)])
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
