"""Directions of straight runs along the links of a corridor network, and the links that a walk follows.

The association of runs with links is along one walk; it is data, and the factor never searches.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from pdr_graph.estimation.factors.base import FactorBlock, Measurement
from pdr_graph.estimation.factors.heading_prior import heading_block
from pdr_graph.floor.building import FloorSequence
from pdr_graph.floor.network import Network, Segments, segment_costs
from pdr_graph.geometry import length_along, wrap_angle
from pdr_graph.priors import CORRIDOR
from pdr_graph.types import Array, Headings, Index, OneLineRepr

if TYPE_CHECKING:
    from pdr_graph.estimation.factors.chain import Evaluation

LEAST_LENGTH, LEAST_RATIO = 8.0, 3.0  # of a run [m], and in widths of its corridor: a shorter one may cross a plaza


@dataclass(frozen=True)
class Stretch:
    """A straight part of a walk along one link.

    first, last: its places [first, last); bearing: ``(s,)`` of the link at each step, as walked [rad].
    """

    first: int
    last: int
    link: int
    bearing: Array


@dataclass(frozen=True)
class Run(OneLineRepr):
    """A straight run along links.

    first, last: its places [first, last); direction: of the corridor, as walked [rad]; width: of the corridor [m];
    spread: standard deviation of the direction of its links [rad].
    """

    first: int
    last: int
    direction: float
    width: float
    spread: float

    def _summary(self) -> list[str]:
        direction = f"{np.degrees(self.direction):.0f}° ± {np.degrees(self.spread):.1f}°"
        return [f"places {self.first} to {self.last}", direction, f"corridor of {self.width:.1f} m"]


@dataclass(frozen=True)
class Track:
    """A walk on one floor.

    position: ``(n, 2)`` [m] and piece ``(n,)`` of those that moved; keyframe_piece: ``(k + 1,)`` that ends at each
    keyframe; heading: ``(k + 1,)`` there [rad].
    """

    position: Array
    piece: Index
    keyframe_piece: Index
    heading: Array

    @classmethod
    def of(cls, at: Evaluation, begin: int, end: int) -> Track:
        """The walk ``at``, pieces [begin, end)."""
        moved = begin + np.flatnonzero(at.pieces.length[begin:end] > 0)
        return cls(at.ends[moved, :2], moved, np.append(-1, at.pieces.last), at.state.poses[:, 2])

    def keyframe(self, first: int, last: int) -> int | None:
        """The keyframe nearest to the middle of places ``first`` to ``last``; None if there is none between them."""
        nearest = int(np.argmin(np.abs(self.keyframe_piece - self.piece[(first + last + 1) // 2])))
        return nearest if self.piece[first] <= self.keyframe_piece[nearest] <= self.piece[last] else None

    def aside(self, keyframe: int, begin: int, end: int) -> float:
        """Angle [rad] of a keyframe's heading to the left of the line between two places."""
        along = self.position[end] - self.position[begin]
        return float(wrap_angle(self.heading[keyframe] - np.arctan2(along[1], along[0])))


@dataclass(frozen=True, eq=False)
class CorridorFactor(Measurement):
    """Directions of straight runs.

    floor_sequence: the floor of each piece; keyframe: ``(r,)`` in each run; direction: its heading.
    """

    floor_sequence: FloorSequence
    keyframe: Index
    direction: Headings

    name: ClassVar[str] = "corridors"
    on_plan: ClassVar[bool] = True

    @classmethod
    def about(cls, floor_sequence: FloorSequence) -> CorridorFactor:
        """The corridors of the floors that a walk is on, associated with none of its runs yet."""
        return cls(floor_sequence, np.empty(0, dtype=np.intp), Headings.none())

    def associated(self, at: Evaluation, stray: Array | float | None = None, alike: float = 1.0) -> Self:
        """Match the straight runs of the walk ``at``."""
        rows = list[tuple[int, float, float]]()
        for floor, begin, end in self.floor_sequence.spans:
            track = Track.of(at, begin, end)
            rows += [row for run in straight_runs(track.position, floor.network) if (row := _heading(track, run))]
        keyframe, direction, sigma = np.array(rows).reshape(-1, 3).T
        numbers = keyframe.astype(np.intp)
        return replace(self, keyframe=numbers, direction=Headings(at.chain.time[numbers], direction, sigma))

    def factors(self, at: Evaluation) -> Sequence[FactorBlock]:
        """One heading for each run."""
        number = at.state.number("x")[self.keyframe]
        return [heading_block(self.name, at, self.keyframe, self.direction, number)]


def stretches_along(track: Array, network: Network) -> list[Stretch]:
    """The links that a walk through places ``track (n, 2)`` [m] follows, in order of time."""
    if len(track) < 2 or not len(network):
        return []
    segments, step, walked = Segments.of(network), np.diff(track, axis=0), length_along(track)
    cost = segment_costs(segments, track[:-1], track[1:])
    nearest = cost.argmin(axis=1)
    along = segments.along[nearest]
    bearing = np.arctan2(*(along * np.where(np.sum(step * along, axis=1) < 0, -1, 1)[:, None]).T[::-1])
    link = np.where(cost.min(axis=1) < CORRIDOR.on_link, segments.link[nearest], -1)
    bends = np.abs(wrap_angle(np.diff(bearing))) > CORRIDOR.straight
    parts = np.split(np.arange(len(link)), np.flatnonzero(bends | (np.diff(link) != 0)) + 1)
    return [
        Stretch(int(part[0]), int(part[-1]) + 2, int(link[part[0]]), bearing[part])
        for part in parts
        if link[part[0]] >= 0 and walked[part[-1] + 1] - walked[part[0]] > CORRIDOR.shortest
    ]


def straight_runs(track: Array, network: Network) -> list[Run]:
    """The long straight runs of a walk through places ``track (n, 2)`` [m] along the links of a network."""
    stretches, walked = stretches_along(track, network), length_along(track)
    ends = [n + 1 for n, (before, after) in enumerate(pairwise(stretches)) if not _continues(before, after, walked)]
    runs = [_run(stretches[i:j], network) for i, j in pairwise([0, *ends, len(stretches)]) if j > i]
    return [run for run in runs if _is_corridor(run, track)]


def _continues(before: Stretch, after: Stretch, walked: Array) -> bool:
    """True if two stretches are parts of one run."""
    bend = abs(float(wrap_angle(after.bearing[0] - before.bearing[-1])))
    return bend < CORRIDOR.straight and walked[after.first] - walked[before.last - 1] < CORRIDOR.bridged


def _run(parts: Sequence[Stretch], network: Network) -> Run:
    bearing = np.concatenate([part.bearing for part in parts])
    mean = float(np.angle(np.mean(np.exp(1j * bearing))))
    spread = float(np.sqrt(np.mean(wrap_angle(bearing - mean) ** 2)))
    width = float(np.median(network.width[[part.link for part in parts]]))
    return Run(parts[0].first, parts[-1].last, mean, width, spread)


def _is_corridor(run: Run, track: Array) -> bool:
    """True if a run is long enough, and its links are straight enough, for a corridor."""
    length = float(np.hypot(*(track[run.last - 1] - track[run.first])))
    return length > max(LEAST_LENGTH, LEAST_RATIO * run.width) and run.spread < CORRIDOR.spread


def _heading(track: Track, run: Run) -> tuple[int, float, float] | None:
    """Keyframe, heading and sigma [rad] of a straight run, which leads along its corridor from end to end.

    None if the run has no keyframe.
    """
    first, last = run.first, run.last - 1
    keyframe = track.keyframe(first, last)
    if keyframe is None:
        return None
    length = float(np.hypot(*(track.position[last] - track.position[first])))
    sigma = np.hypot(np.sqrt(2) * CORRIDOR.side * run.width / length, np.hypot(CORRIDOR.ahead, run.spread))
    return keyframe, float(wrap_angle(run.direction + track.aside(keyframe, first, last))), float(sigma)
