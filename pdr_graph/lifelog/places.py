"""Places: what was visited, over all days, with visits and a name.

Visits within PLACE_RADIUS of one another are at one place: leader clustering, the most certain visits first, each place
at the weighted mean of its visits. A name is what the person or a floor plan says; nothing is guessed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pdr_graph.errors import count
from pdr_graph.lifelog.local_time import LocalClock, zone_at
from pdr_graph.lifelog.timeline import duration_text
from pdr_graph.lifelog.visits import SURE, VISIT_RADIUS, Visit, lonlat_of, on_sphere
from pdr_graph.types import Array, OneLineRepr

PLACE_RADIUS = VISIT_RADIUS  # [m] between visits of one place
NIGHT_END, FEWEST_NIGHTS = 6 * 3600.0, 3  # [s] after midnight; nights of which a home is guessed

NamedArea = tuple[float, float, float, str]  # latitude, longitude [deg], radius [m], name


@dataclass(frozen=True)
class Place(OneLineRepr):
    """A visited place. number: in the order of the first visits, from 1; name: "" if it has none.

    latitude, longitude: [deg], NaN if unknown; sigma: standard deviation per axis of its position [m];
    visits: in order.
    """

    number: int
    name: str
    latitude: float
    longitude: float
    sigma: float
    visits: tuple[Visit, ...]

    @property
    def duration(self) -> float:
        """Time spent there [s]."""
        return float(sum(visit.duration for visit in self.visits))

    @property
    def label(self) -> str:
        """Its name, or its number."""
        return self.name or f"place {self.number}"

    def _summary(self) -> list[str]:
        return [self.label, count(len(self.visits), "visit"), duration_text(self.duration)]


def places_of(visits: Sequence[Visit], named: Sequence[NamedArea] = ()) -> tuple[Place, ...]:
    """The places of visits, in the order of their first visits. named: areas that the person gave a name."""
    clusters: list[_Cluster] = []
    for visit in sorted(visits, key=lambda v: (v.sigma, v.start)):
        near = [(distance, n) for n, own in enumerate(clusters) if (distance := own.distance(visit)) is not None]
        if near:
            clusters[min(near)[1]].append(visit)
        else:
            clusters.append(_Cluster(visit))
    ordered = sorted((sorted(own.visits, key=lambda v: v.start) for own in clusters), key=lambda own: own[0].start)
    return tuple(_place(number, own, named) for number, own in enumerate(ordered, start=1))


def likely_home(places: Sequence[Place]) -> Place | None:
    """The place with most time from midnight to NIGHT_END of its own time zone; None before FEWEST_NIGHTS of it.

    A guess, for those who ask for one: nights are spent at home more often than anywhere else.
    """
    nights = {place.number: _nights(place) for place in places if np.isfinite(place.latitude)}
    best = max(places, key=lambda place: nights.get(place.number, 0.0), default=None)
    enough = best is not None and nights.get(best.number, 0.0) >= FEWEST_NIGHTS * NIGHT_END
    return best if enough else None


def _nights(place: Place) -> float:
    """Time spent at a place between midnight and NIGHT_END [s]."""
    clock = LocalClock(zone_at(place.latitude, place.longitude), np.empty(0), np.empty((0, 2)))
    total = 0.0
    for visit in place.visits:
        midnight = clock.midnight_before(visit.start)
        while midnight < visit.end:
            total += max(min(visit.end, midnight + NIGHT_END) - max(visit.start, midnight), 0.0)
            midnight = clock.next_midnight(midnight)
    return total


class _Cluster:
    """Visits of one place, with their weighted mean place."""

    def __init__(self, visit: Visit):
        self.visits: list[Visit] = []
        self._weight, self._sum = 0.0, np.zeros(3)
        self.append(visit)

    def append(self, visit: Visit) -> None:
        """Add a visit."""
        self.visits.append(visit)
        self._weight += _weight(visit)
        self._sum = self._sum + _weight(visit) * visit.middle

    def distance(self, visit: Visit) -> float | None:
        """Distance of a visit at this place [m], by its name on a plan 0 if unknown; None if it is elsewhere."""
        off = visit.middle - self._sum / self._weight
        far = float(np.sqrt(off @ off))
        if visit.name or self.visits[0].name:
            # widest place [m] between visits of one name on a plan
            return float(np.nan_to_num(far)) if self._has_name(visit.name) and not far > 500.0 else None
        return far if far <= PLACE_RADIUS + min(visit.sigma, PLACE_RADIUS) else None

    def _has_name(self, name: str) -> bool:
        return self.visits[0].name == name


def _middle(cluster: Sequence[Visit]) -> Array:
    """Weighted mean place ``(3,)`` of visits."""
    weight = np.array([_weight(visit) for visit in cluster])
    return weight @ np.array([visit.middle for visit in cluster]) / weight.sum()


def _weight(visit: Visit) -> float:
    return visit.duration / (SURE**2 + visit.sigma**2)


def _place(number: int, visits: Sequence[Visit], named: Sequence[NamedArea]) -> Place:
    """The place of a cluster of visits."""
    middle = _middle(visits)
    longitude, latitude = lonlat_of(middle)
    weight = np.array([_weight(visit) for visit in visits])
    off = np.array([visit.middle for visit in visits]) - middle
    variance = weight @ (np.array([v.sigma for v in visits]) ** 2 / len(visits) + (off**2).sum(axis=1) / 2)
    sigma = float(np.sqrt(variance / weight.sum()))
    return Place(number, _name(middle, named) or visits[0].name, latitude, longitude, sigma, tuple(visits))


def _name(middle: Array, named: Sequence[NamedArea]) -> str:
    """The name of the nearest area that a place is in; "" if there is none. The last name given counts."""
    inside: list[tuple[float, int]] = []
    for n, (latitude, longitude, radius, _) in enumerate(named):
        far = float(np.linalg.norm(on_sphere(np.array([[longitude, latitude]]))[0] - middle))
        inside += [(far, -n)] if far <= radius else []
    return named[-min(inside)[1]][3] if inside else ""
