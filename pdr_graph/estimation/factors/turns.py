"""Turns from one link of a corridor network into another.

A turn has two bounds: [map-matching] Eq. (6) limits its angle, from one corridor into the other; and it happens in the
intersection, between the walls of both corridors. The residual is zero within the bounds and linear outside. Turns are
associated with intersections along one walk; the association is data, and the factor never searches.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np
import shapely

from pdr_graph.estimation.factors.base import FactorBlock, Linearized, Measurement
from pdr_graph.estimation.factors.corridor import Track, stretches_along
from pdr_graph.floor.building import FloorSequence
from pdr_graph.floor.network import Network
from pdr_graph.geometry import length_along, turn_between, wrap_angle
from pdr_graph.priors import TURNS
from pdr_graph.types import Array, Index

if TYPE_CHECKING:
    from pdr_graph.estimation.factors.chain import Evaluation


@dataclass(frozen=True)
class Turn:
    """A turn between two links.

    first, at, last: places of the walk where it enters the link before the turn, turns, and leaves the link after it;
    into, out_of: unit vectors ``(2,)`` along the links, towards the intersection and away from it; corners: ``(4, 2)``
    of the intersection, counter-clockwise [m].
    """

    first: int
    at: int
    last: int
    into: Array
    out_of: Array
    corners: Array


@dataclass(frozen=True, eq=False)
class TurnFactor(Measurement):
    """Turns of a walk at intersections, ``t`` of them.

    floor_sequence: the floor of each piece; before, after: ``(t,)`` keyframes on either side; least, most: ``(t,)``
    heading change from the one to the other, counter-clockwise [rad]; piece: ``(t,)`` of the walk that ends where it
    turns; normal: ``(t, 4, 2)`` outward of the sides of the intersection; edge: ``(t, 4)`` how far along these the
    sides are [m].
    """

    floor_sequence: FloorSequence
    before: Index
    after: Index
    least: Array
    most: Array
    piece: Index
    normal: Array
    edge: Array

    name: ClassVar[str] = "turns"
    on_plan: ClassVar[bool] = True

    @classmethod
    def about(cls, floor_sequence: FloorSequence) -> Self:
        """The networks of the floors that a walk is on, associated with none of its turns yet."""
        none, numbers = np.empty(0), np.empty(0, dtype=np.intp)
        return cls(floor_sequence, numbers, numbers, none, none, numbers, np.empty((0, 4, 2)), np.empty((0, 4)))

    def __len__(self) -> int:
        return len(self.piece)

    def associated(self, at: Evaluation, stray: Array | float | None = None, alike: float = 1.0) -> Self:
        """Match the turns of the walk ``at``."""
        rows = list[tuple[int, int, float, float, int, Array, Array]]()
        for floor, begin, end in self.floor_sequence.spans:
            track = Track.of(at, begin, end)
            rows += [row for turn in turns_along(track.position, floor.network) if (row := _bounds(track, turn))]
        if not rows:
            return self.about(self.floor_sequence)
        before, after, least, most, piece, normal, edge = (np.array(column) for column in zip(*rows, strict=True))
        return replace(self, before=before, after=after, least=least, most=most, piece=piece, normal=normal, edge=edge)

    def heading_change(self, heading: Array) -> tuple[Array, Array]:
        """Residual ``(t,)`` of the heading change between keyframes ``(k + 1,)``, and its derivative:

            r = [ max(0, δ − β) − max(0, α − δ) ] / σ,      δ = θ_after − θ_before

        The derivative is by θ_after; by θ_before it is the opposite.
        """
        off = wrap_angle(heading[self.after] - heading[self.before] - (self.least + self.most) / 2)
        beyond = np.maximum(np.abs(off) - (self.most - self.least) / 2, 0.0)
        return np.sign(off) * beyond / TURNS.turned, (beyond > 0) / TURNS.turned

    def outside(self, turning: Linearized) -> Linearized:
        """Residual ``(t, 4)`` of each turn beyond the sides of its intersection: r = max(0, n p − e) / σ.

        For a rectangular intersection the squares add up to that of the distance. turning: poses of the pieces that
        turn.
        """
        beyond = np.einsum("tsk,tk->ts", self.normal, turning.value[:, :2]) - self.edge
        slope = np.zeros((*beyond.shape, 3))
        slope[:, :, :2] = self.normal * (beyond > 0)[:, :, None] / TURNS.place
        value = np.maximum(beyond, 0.0) / TURNS.place
        return Linearized(value, slope @ turning.by_i, slope @ turning.by_j, slope @ turning.by_c)

    def factors(self, at: Evaluation) -> Sequence[FactorBlock]:
        """Factors of the heading changes, and of the places of the turns."""
        if not len(self):
            return []
        value, slope = self.heading_change(at.state.poses[:, 2])
        place, interval = self.outside(at.poses_of(self.piece)), at.pieces.interval[self.piece]
        number = at.chain.number[self.after]

        def by_headings() -> list[Array]:
            by = np.zeros((len(self), 1, 3))
            by[:, 0, 2] = slope
            return [-by, by]

        return [
            FactorBlock.uniform(
                f"{self.name}.angle",
                value[:, None],
                [("x", self.before), ("x", self.after)],
                by_headings,
                number,
            ),
            FactorBlock.uniform(
                f"{self.name}.place",
                place.value,
                [("x", interval), ("x", interval + 1), ("c", at.chain.segment[interval])],
                lambda: [place.by_i, place.by_j, place.by_c],
                number,
            ),
        ]


def turns_along(track: Array, network: Network) -> Iterator[Turn]:
    """The turns of a walk through places ``track (n, 2)`` [m], at intersections that have corners."""
    walked = length_along(track)
    for before, after in pairwise(stretches_along(track, network)):
        shared = np.intersect1d(network.links[before.link], network.links[after.link])
        for node in shared[~np.isnan(network.corners[shared, 0, 0])].tolist():
            into, out_of = -network.direction(before.link, node), network.direction(after.link, node)
            low, high = max(before.last - TURNS.overlap, before.first), min(after.first + TURNS.overlap, after.last)
            at = low + int(np.argmax(track[low:high] @ (into - out_of)))  # the sharpest
            turned, around = abs(turn_between(into, out_of)), walked[after.first] - walked[before.last - 1]
            apart = shapely.distance(shapely.polygons(network.corners[node]), shapely.Point(track[at]))
            if (
                before.link != after.link
                and TURNS.least < turned < TURNS.most
                and around < TURNS.longest
                and apart < TURNS.at_node
            ):
                yield Turn(before.first, at, after.last - 1, into, out_of, network.corners[node])


def range_of_turn(into: Array, out_of: Array, corners: Array, before: float, after: float) -> tuple[float, float]:
    """α and β of [map-matching] Eq. (6): least and greatest angle of a turn, counter-clockwise, the lower first. [rad]

    into, out_of: unit vectors ``(2,)`` along the links; corners: ``(4, 2)`` of the intersection; before, after: length
    of the walk along the links before and after the turn [m]; the paper uses the whole corridor from one intersection
    to the next. α is that of a path out-in-out: from the outer wall past the inner corner to the outer wall. β is that
    of a path in-out-in.
    """
    bearing = (corners - corners.mean(axis=0)) @ (out_of - into)
    inner, outer = corners[np.argmax(bearing)], corners[np.argmin(bearing)]

    def wall(side: Array, along: Array, reach: float) -> Array:
        return side + (inner - side) @ along * along + reach * along

    def turned(side: Array, by: Array) -> float:
        return turn_between(by - wall(side, into, -before), wall(side, out_of, after) - by)

    least, most = sorted((turned(outer, inner), turned(inner, outer)))
    return least, most


def _bounds(track: Track, turn: Turn) -> tuple[int, int, float, float, int, Array, Array] | None:
    """The bounds of one turn, by [map-matching] Eq. (6) along the stretches before and after it.

    None if a stretch has no keyframe.
    """
    i, j = track.keyframe(turn.first, turn.at), track.keyframe(turn.at, turn.last)
    if i is None or j is None:
        return None
    come, gone = (float(np.hypot(*(track.position[turn.at] - track.position[n]))) for n in (turn.first, turn.last))
    aside = track.aside(j, turn.at, turn.last) - track.aside(i, turn.first, turn.at)
    least, most = np.array(range_of_turn(turn.into, turn.out_of, turn.corners, come, gone)) + aside
    side = np.roll(turn.corners, -1, axis=0) - turn.corners
    normal = np.stack([side[:, 1], -side[:, 0]], axis=1) / np.hypot(*side.T)[:, None]
    return i, j, float(least), float(most), int(track.piece[turn.at]), normal, np.sum(normal * turn.corners, axis=1)
