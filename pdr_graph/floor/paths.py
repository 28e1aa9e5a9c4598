"""Ways on foot outdoors as a network, and which of them a walk followed.

The ways are polylines with a class and a width. Which of them a walk followed is a discrete path: a hidden Markov model
over points on the ways, one every few metres, and over the state *off every way*, sought by Viterbi's algorithm as in
Newson & Krumm (*Hidden Markov map matching through noise and sparseness*, GIS 2009). Theirs compares positions with
roads. Here the positions are those of a smoothed walk, whose error is large and the same for a long time, whose shape
is good. So a state is the displacement d of the walk onto the ways, and costs

    |d|² / 2 (σ² + w²) · spacing / correlation   (emission; σ of the walk, w of a walker across the way)
    |d − d'|² / 2 τ²                             (transition: the walk between both points has the shape of the ways)

Two points are joined if the ways between them are about as long as the walk. A walk off the ways has a constant cost
for each point, so that neither a missing way nor a park bends it. How probable other ways are, or none, the
forward-backward algorithm says for each point; that widens the stated region.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import KDTree
from scipy.special import log_ndtr

from pdr_graph.errors import InputError, count
from pdr_graph.floor.cells import DOOR
from pdr_graph.floor.network import Lines
from pdr_graph.frames import Frame, enu
from pdr_graph.geometry import length_along
from pdr_graph.priors import WAYS
from pdr_graph.types import FINEST, Array, Fixes, Index, Mask, OneLineRepr

if TYPE_CHECKING:
    from pdr_graph.floor.building import Building
    from pdr_graph.floor.formats.ways import Found

OUTER_WALL = 0.5  # [m] thickness, at most
POINTS_EVERY = 4.0  # [m] between the points of ways that a walk can be at
SOUGHT_WITHIN, SOUGHT_FARTHEST = 2.5, 120.0  # [σ] of the walk, and [m] at most, within which its ways are sought
SAME_NODE = 0.05  # [m] between ends of ways that meet: OpenStreetMap has 1 cm
LONGEST_MATCHED = 4000.0  # [m] of a walk that is matched at a time: memory grows with its square
SOURCES = 400  # points whose distances to all others are computed at a time
EVERYWHERE = np.array([-180.0, -90.0]), np.array([180.0, 90.0])  # [deg]
NEAR_WALK = 300.0  # [m] around the positions of a walk, within which ways are kept
STRAY = 0.8  # [m/s] by which a walk may leave its positions while it has none: out and back
FARTHEST_FROM_WALK = 5000.0  # [m] the same at most


@dataclass(frozen=True)
class PathNetwork(Lines, OneLineRepr):
    """Ways on foot, in a metric frame.

    lines: ``(m, 2)`` of each way [m]; classes: of each, a value of OpenStreetMap's key ``highway``; notes: of the file;
    frame: of the lines, None for that of the walk; target: into which `around` converts them; building: to whose doors
    they then lead; area: of that building, where its plan takes their place [m], None without.
    """

    lines: tuple[Array, ...]
    classes: tuple[str, ...]
    notes: tuple[str, ...] = field(default=(), compare=False)
    frame: Frame | None = None
    target: Frame | None = None
    building: Building | None = field(default=None, repr=False, compare=False)
    area: shapely.Geometry | None = field(default=None, repr=False, compare=False)

    @classmethod
    def load(cls, path: str | Path, frame: Frame | None = None, fixes: Fixes | None = None) -> PathNetwork:
        """Read the ways within reach of a walk: OpenStreetMap (.osm, .osm.pbf), lines of GeoJSON, GPX routes.

        frame: of the result and of the fixes; without it all ways are read, in a frame about their middle.
        Raises InputError for other files, for a walk without latitude, and if no way is within reach.
        """
        from pdr_graph.floor.formats.ways import read_ways  # it imports readers of several formats

        path = Path(path)
        if frame is None or fixes is None:
            found = read_ways(path, *EVERYWHERE)
            lon, lat = np.median(np.concatenate(found.lines), axis=0).tolist()
            return cls._placed(found, enu(lat, lon))
        if not frame.georeferenced:
            raise InputError(path, "", "a walk without latitude and longitude", "fixes in degrees, or such a plan")
        if not len(fixes):
            raise InputError(path, "", "a walk without any position", "a fix, from which its ways are known")
        reach = reach_of(fixes)
        (left, low), (right, high) = fixes.position.min(axis=0) - reach, fixes.position.max(axis=0) + reach
        degrees = frame.to_lonlat(np.array([[left, low], [left, high], [right, low], [right, high]]))
        found = read_ways(path, degrees.min(axis=0), degrees.max(axis=0))
        if not found.lines:
            apart = np.hypot(*(frame.from_lonlat(found.nearest[None])[0] - fixes.position.mean(axis=0))) / 1000
            what = (
                f"no way within {reach:.0f} m of the walk; the nearest of {count(found.total, 'way')} is {apart:.1f} km"
            )
            raise InputError(path, "ways", f"{what} away", "an extract of the place of the walk")
        return cls._placed(found, frame)

    @classmethod
    def _placed(cls, found: Found, frame: Frame) -> PathNetwork:
        """The ways of a file in a frame."""
        every = frame.from_lonlat(np.concatenate(found.lines))
        ends = np.cumsum([len(line) for line in found.lines])[:-1]
        return cls(tuple(np.split(every, ends)), found.classes, found.notes, frame)

    def seen_from(self, frame: Frame, building: Building | None = None) -> PathNetwork:
        """The network for walks in a frame, which may lead into a building of the same frame."""
        return replace(self, target=frame, building=building)

    def around(self, data: Sequence[Any]) -> PathNetwork | None:
        """The ways within reach of the fixes among the data of a walk, in its frame; None without a fix."""
        fixes = next((table for table in data if isinstance(table, Fixes) and len(table)), None)
        if fixes is None:
            return None
        frame, target = self.frame, self.target
        if frame is None or target is None:
            frame = target = Frame()
        elif not target.georeferenced:
            return None
        places = frame.from_frame(target, fixes.position)
        reach, (low, high) = reach_of(fixes), self._bounds
        near = (high >= places.min(axis=0) - reach) & (low <= places.max(axis=0) + reach)
        which = np.flatnonzero(near.all(axis=1)).tolist()
        lines = tuple(target.from_frame(frame, self.lines[n]) for n in which)
        found = PathNetwork(lines, tuple(self.classes[n] for n in which))
        return found if self.building is None else found.joined(self.building)

    def outside(self, area: shapely.Geometry) -> PathNetwork:
        """The ways without what lies in an area [m]."""
        lines, classes = list[Array](), list[str]()
        shapely.prepare(area)
        for line, name, crosses in zip(
            self.lines, self.classes, shapely.intersects(_lines(self.lines), area).tolist(), strict=True
        ):
            parts = shapely.get_parts(shapely.difference(shapely.linestrings(line), area)) if crosses else [line]
            for part in parts:
                if len(corners := shapely.get_coordinates(part) if crosses else line) > 1:
                    lines.append(corners)
                    classes.append(name)
        return replace(self, lines=tuple(lines), classes=tuple(classes))

    def joined(self, building: Building) -> PathNetwork:
        """The ways outside a building of the same frame, and a footway from each outer door to the nearest of them."""
        if self.area is not None:
            return self
        walkable = shapely.union_all([floor.walkable for floor in building.floors])
        rings = shapely.get_exterior_ring(shapely.get_parts(shapely.buffer(walkable, OUTER_WALL)))
        area = shapely.union_all(shapely.polygons(rings))
        found, (rim, doors) = self.outside(area), (shapely.boundary(area), list[shapely.Geometry]())
        for floor in building.floors:
            doors += [door.shape for door in floor.of_kind(DOOR) if shapely.distance(door.shape, rim) < 2 * OUTER_WALL]
        lines, ways = list(found.lines), list[Array]()
        for door in shapely.centroid(doors).tolist() if lines else []:
            apart = shapely.distance(door, _lines(lines))
            for n in np.argsort(apart)[: np.count_nonzero(apart < WAYS.door)].tolist():
                along = float(shapely.line_locate_point(shapely.linestrings(lines[n]), door))
                foot = shapely.get_coordinates(shapely.line_interpolate_point(shapely.linestrings(lines[n]), along))[0]
                way = np.array([shapely.get_coordinates(door)[0], foot])
                if shapely.length(shapely.intersection(shapely.linestrings(way), area)) < 3 * OUTER_WALL:
                    lines[n] = np.insert(lines[n], int(np.searchsorted(length_along(lines[n]), along)), foot, axis=0)
                    ways.append(way)
                    break
        return replace(found, lines=(*lines, *ways), classes=(*found.classes, *("footway",) * len(ways)), area=area)

    def indoors(self, place: Array, sigma: Array) -> Array:
        """Negative log probability ``(n,)`` that places, with sigma ``(n,)`` [m], lie outside the building. [nats]"""
        if self.area is None:
            return np.zeros(len(place))
        points = shapely.points(place)
        inside = np.where(shapely.contains(self.area, points), -1.0, 1.0)
        return -log_ndtr(inside * shapely.distance(shapely.boundary(self.area), points) / sigma)

    @cached_property
    def _bounds(self) -> tuple[Array, Array]:
        """Least and greatest x and y ``(l, 2)`` of each way [m]."""
        first = np.cumsum([0, *(len(line) for line in self.lines[:-1])])
        every = np.concatenate(self.lines)
        return np.minimum.reduceat(every, first), np.maximum.reduceat(every, first)

    @cached_property
    def sigma(self) -> Array:
        """Sigma ``(l,)`` of a walker across each way, with the error of the map [m]."""
        return np.hypot(WAYS.side * self.width / 2, WAYS.drawn)

    @cached_property
    def width(self) -> Array:
        """Width ``(l,)`` of each way [m]."""
        of_class = dict(WAYS.half_width)
        return 2 * np.array([of_class.get(name, of_class["path"]) for name in self.classes])

    @cached_property
    def points(self) -> WayPoints:
        """Points on the ways, a few metres apart, joined along them."""
        return WayPoints.of(self)

    def _summary(self) -> list[str]:
        return [count(len(self), "way"), f"{sum(length_along(line)[-1] for line in self.lines) / 1000:.1f} km"]


def _lines(lines: Sequence[Array]) -> list[shapely.LineString]:
    """The same as shapely's."""
    return [shapely.LineString(line) for line in lines]


def reach_of(fixes: Fixes) -> float:
    """Distance [m] from the positions of a walk within which its ways are kept: more if it lacks them for long."""
    return float(
        np.clip(
            NEAR_WALK + STRAY / 2 * np.diff(np.sort(fixes.time), prepend=fixes.time[0]).max(), 0, FARTHEST_FROM_WALK
        )
    )


@dataclass(frozen=True, eq=False)
class WayPoints:
    """Points on ways.

    place: ``(p, 2)`` [m]; sigma: ``(p,)`` of a walker about each, across [m]; edges: ``(e, 2)`` neighbours on a way;
    length: ``(e,)`` [m].
    """

    place: Array
    sigma: Array
    edges: Index
    length: Array

    @classmethod
    def of(cls, network: PathNetwork) -> WayPoints:
        """Points every POINTS_EVERY metres; ways that share a corner share its point."""
        lines = shapely.segmentize(_lines(network.lines), POINTS_EVERY)
        place, of_line = shapely.get_coordinates(lines, return_index=True)
        key = np.round(place / SAME_NODE).astype(np.int64)
        _, first, which = np.unique(key, axis=0, return_index=True, return_inverse=True)
        which = which.ravel()
        sigma = np.zeros(len(first))
        np.maximum.at(sigma, which, network.sigma[of_line])
        same = np.flatnonzero((of_line[1:] == of_line[:-1]) & (which[1:] != which[:-1]))
        edges = np.stack([which[same], which[same + 1]], axis=1)
        return cls(place[first], sigma, edges, np.hypot(*(place[same + 1] - place[same]).T))

    def within(self, track: Array, reach: Array) -> WayPoints:
        """The points within distances ``(n,)`` [m] of the places ``(n, 2)`` of a track."""
        groups = KDTree(self.place).query_ball_point(track, reach)
        kept = np.unique(np.concatenate([np.empty(0, np.intp), *map(np.asarray, groups)]).astype(np.intp))
        number = np.full(len(self.place), -1)
        number[kept] = np.arange(len(kept))
        edges = number[self.edges]
        both = (edges >= 0).all(axis=1)
        return WayPoints(self.place[kept], self.sigma[kept], edges[both], self.length[both])

    def moves(self, most: float) -> tuple[Index, Index, Array]:
        """Pairs of points that are joined by ways of up to ``most`` [m]: from, to, and how far along the ways."""
        n = len(self.place)
        graph = coo_array((self.length, (self.edges[:, 0], self.edges[:, 1])), shape=(n, n)).tocsr()
        pairs = list[tuple[Index, Index, Array]]()
        for begin in range(0, n, SOURCES):
            sources = np.arange(begin, min(begin + SOURCES, n))
            distance = dijkstra(graph, directed=False, indices=sources, limit=most)
            row, to = np.nonzero(np.isfinite(distance))
            pairs.append((sources[row], to, distance[row, to]))
        source, to, far = (np.concatenate(column) for column in zip(*pairs, strict=True))
        return source, to, far


@dataclass(frozen=True, eq=False)
class WayMatch:
    """The ways that a walk followed, and how probable others are.

    on: ``(n,)`` True where it was on a way; displacement: ``(n, 2)`` from each place of the walk to the way [m];
    others: ``(n, 6)`` of other ways and of none, where it is on one: their probability P, and their moments about the
    place of the walk P E[x], P E[y] [m], P E[x²], P E[xy], P E[y²] [m²]; price: of the discrete path: of being off all
    ways, and of another shape than theirs [nats].
    """

    on: Mask
    displacement: Array
    others: Array
    price: float

    @classmethod
    def nowhere(cls, size: int, price: float) -> WayMatch:
        """Off every way."""
        return cls(np.zeros(size, dtype=bool), np.zeros((size, 2)), np.zeros((size, 6)), price)


def match(network: PathNetwork, track: Array, sigma: Array, askew: Array) -> WayMatch:
    """The ways that a walk through places ``track (n, 2)`` [m] most probably followed.

    sigma: ``(n,)`` of each place, per axis [m]; askew: ``(n,)`` of the direction of the walk there [rad]. The walk is
    cut where it jumps (a gap, a ride), and every LONGEST_MATCHED.
    """
    apart = np.hypot(*np.diff(track, axis=0).T)
    walked = length_along(track)
    jumps = np.flatnonzero(apart > WAYS.station) + 1
    number = np.cumsum(np.bincount(jumps, minlength=len(track))) + (walked - walked[0]) // LONGEST_MATCHED
    bounds = [0, *(np.flatnonzero(np.diff(number)) + 1).tolist(), len(track)]
    parts = [_matched(network, track[a:b], sigma[a:b], askew[a:b]) for a, b in pairwise(bounds)]
    columns = [np.concatenate(rows) for rows in zip(*((m.on, m.displacement, m.others) for m in parts), strict=True)]
    return WayMatch(*columns, price=sum(part.price for part in parts))


def _matched(network: PathNetwork, track: Array, sigma: Array, askew: Array) -> WayMatch:
    """The ways that a part of a walk followed, as of `match`."""
    walked, size = length_along(track), len(track)
    stations = np.unique(np.searchsorted(walked, np.arange(0.0, walked[-1] + WAYS.station, WAYS.station)))
    stations = stations[stations < size]
    n = len(stations)
    place, stray = track[stations], np.minimum(sigma[stations], SOUGHT_FARTHEST / SOUGHT_WITHIN)
    reach = SOUGHT_WITHIN * np.hypot(stray, WAYS.drawn) + POINTS_EVERY
    points = network.points.within(place, reach)
    if n < 2 or not len(points.place):
        return WayMatch.nowhere(size, WAYS.off * n)
    indoors = network.indoors(place, np.hypot(stray, WAYS.drawn))
    lattice = _Lattice.of(points, place, np.diff(walked[stations]), stray, askew[stations], reach, indoors)
    states, cost = lattice.path()
    on = states >= 0
    if not on.any():
        return WayMatch.nowhere(size, WAYS.off * n)
    shift = points.place[states] - place
    known = walked[stations][on]
    displacement = np.stack([np.interp(walked, known, shift[on, axis]) for axis in (0, 1)], axis=1)
    after = np.clip(np.searchsorted(stations, np.arange(size)), 1, n - 1)
    pulled = float(lattice.emission[np.flatnonzero(on), states[on]].sum())  # by the sources of the walk
    columns = lattice.others(states).T
    others = np.stack([np.interp(walked, walked[stations], column) for column in columns], axis=1)
    return WayMatch(on[after] & on[after - 1], displacement, others, cost - pulled)


@dataclass(frozen=True, eq=False)
class _Lattice:
    """The hidden Markov model of one walk: ``s`` stations, ``p`` points and the state off every way, the last.

    place: ``(p, 2)`` [m]; emission: ``(s, p)`` [nats], infinite out of reach; source, to: ``(m,)`` moves; far: ``(m,)``
    along ways [m]; track: ``(s, 2)`` the walk [m]; stray: ``(s,)`` its sigma [m]; longest, sigma: ``(s - 1,)`` of moves
    [m].
    """

    place: Array
    emission: Array
    source: Index
    to: Index
    far: Array
    track: Array
    stray: Array
    longest: Array
    sigma: Array

    @classmethod
    def of(
        cls, points: WayPoints, place: Array, walked: Array, stray: Array, askew: Array, reach: Array, indoors: Array
    ) -> _Lattice:
        """The model of a walk through stations ``place``, which has walked so far from one to the next [m].

        indoors: ``(s,)`` cost of any way there [nats].
        """
        off = points.place - place[:, None]
        square = np.sum(off**2, axis=2)
        variance = 2 * (stray[:, None] ** 2 + points.sigma**2)
        emission = np.where(
            square < reach[:, None] ** 2, square / variance * WAYS.station / WAYS.alike + indoors[:, None], np.inf
        )
        source, to, far = points.moves(WAYS.detour * float(walked.max()) + WAYS.slack)
        turn = np.minimum((askew[1:] + askew[:-1]) / 2, WAYS.askew)
        longest = WAYS.detour * walked + WAYS.slack
        return cls(points.place, emission, source, to, far, place, stray, longest, np.hypot(WAYS.moved, walked * turn))

    @cached_property
    def _moves(self) -> list[tuple[Index, Index, Array]]:
        """From each station to the next: the points from and to, and the cost of the move [nats]."""
        within, found = np.isfinite(self.emission), list[tuple[Index, Index, Array]]()
        for t, step in enumerate(np.diff(self.track, axis=0)):
            near = within[t, self.source] & within[t + 1, self.to] & (self.far <= self.longest[t])
            source, to = self.source[near], self.to[near]
            off = self.place[to] - self.place[source] - step
            found.append((source, to, np.sum(off * off, axis=1) / (2 * self.sigma[t] ** 2)))
        return found

    @property
    def _costs(self) -> Array:
        """Costs ``(s, p + 1)`` of all states. [nats]"""
        return np.append(self.emission, np.full((len(self.emission), 1), WAYS.off), axis=1)

    def path(self) -> tuple[Index, float]:
        """The best path ``(s,)`` of points, −1 off every way, and its cost."""
        s, p = self.emission.shape
        cost, neighbour = self._costs, np.full((s, p + 1), p)
        for t, (source, to, moved) in enumerate(self._moves, start=1):
            last, best = cost[t - 1], np.full(p, cost[t - 1, p] + WAYS.leave)
            total = moved + last[source]
            order = np.lexsort([total, to])
            least = order[np.flatnonzero(np.diff(to[order], prepend=-1))]
            least = least[total[least] <= best[to[least]]]
            best[to[least]], neighbour[t, to[least]] = total[least], source[least]
            nearest = int(np.argmin(last[:p]))
            if (left := last[nearest] + WAYS.leave) < last[p]:
                neighbour[t, p] = nearest
            cost[t] += np.append(best, min(left, last[p]))
        path = np.full(s, int(np.argmin(cost[-1])))
        for n in range(s - 1, 0, -1):
            path[n - 1] = neighbour[n, path[n]]
        return np.where(path < p, path, -1), float(cost[-1].min())

    def probability(self) -> Array:
        """Probability ``(s, p + 1)`` of all states, by the forward-backward algorithm.

        Its sums are over places along a way, so each point counts as the share spacing / √(2 π) σ of the places that
        are possible; else three points on a way would be more probable than the walk off it.
        """
        p, leave, likely = len(self.place), np.exp(-WAYS.leave), np.exp(-self._costs)
        share, entered = (POINTS_EVERY / (np.sqrt(2 * np.pi) * sigma) for sigma in (self.sigma, self.stray))
        entered = np.minimum(entered, 1.0)
        moves = [(source, to, np.exp(-cost) * k) for (source, to, cost), k in zip(self._moves, share, strict=True)]
        before, after = likely.copy(), np.ones_like(likely)
        before[0, :p] *= entered[0]
        for t, (source, to, moved) in enumerate(moves, start=1):
            last = before[t - 1] / before[t - 1].sum()
            before[t, :p] *= np.bincount(to, moved * last[source], p) + leave * entered[t] * last[p]
            before[t, p] *= last[p] + leave * last[:p].sum()
        for t, (source, to, moved) in reversed(list(enumerate(moves))):
            last = after[t + 1] / after[t + 1].max() * likely[t + 1]
            after[t, :p] = np.bincount(source, moved * last[to], p) + leave * last[p]
            after[t, p] = last[p] + leave * entered[t + 1] * last[:p].sum()
        both = before * after
        return both / both.sum(axis=1, keepdims=True)

    def others(self, path: Index) -> Array:
        """Of all states that are beside a path ``(s,)`` of points, the columns ``(s, 6)`` of `WayMatch.others`.

        What is ahead or behind on the same way is not beside it: the graph knows the place along a way.
        """
        ahead = np.gradient(self.track, axis=0)
        left = (
            np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
            / np.maximum(np.hypot(ahead[:, 0], ahead[:, 1]), FINEST)[:, None]
        )
        aside = np.einsum("spk,sk->sp", self.place - self.place[path][:, None], left)
        weight = self.probability() * (path >= 0)[:, None]
        weight[:, :-1] *= np.abs(aside) > WAYS.apart
        x, y = (self.place - self.track[:, None]).transpose(2, 0, 1)
        off, ways = weight[:, -1], weight[:, :-1]
        moments = [np.sum(ways * each, axis=1) for each in (x, y, x * x, x * y, y * y)]
        moments[2], moments[4] = moments[2] + off * self.stray**2, moments[4] + off * self.stray**2
        return np.stack([weight.sum(axis=1), *moments], axis=1)
