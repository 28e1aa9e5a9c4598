"""Which link a walk is on, and where it turns from one into another: [map-matching] Secs. 3.2, 3.3."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pdr_graph.floor.network import Network
from pdr_graph.geometry import turn_between, wrap_angle
from pdr_graph.types import Array, Index, Steps

FAR, ASKEW = 3.0, np.radians(30)  # [m], [rad] from a link at which either counts 1: a corridor's width, a zigzag
LOST = 4.0  # the most that a distance counts: less than a right angle
TURNING = np.radians(10)  # heading change of a step above which the walker is turning: gait sways by up to 7°
AROUND = 8  # steps before and after a turn that tell the links: the length of a zigzag
BESIDE = 3  # steps before and after one that turns, which may turn too: a zigzag is straight only in passing
HALF_TURN = 3  # steps that a turn takes, on either side of its middle
LEAST_TURN = np.radians(25)  # between two links, or they are one way


@dataclass(frozen=True)
class Turn:
    """A turn from one link into another.

    first, last: steps [first, last) that turn; node: where; before, after: the links; into, out_of: unit vectors
    ``(2,)`` of the links towards the node and away from it.
    """

    first: int
    last: int
    node: int
    before: int
    after: int
    into: Array
    out_of: Array


@dataclass(frozen=True)
class Segments:
    """The links of a network as segments. start, along: ``(s, 2)`` [m]; link: ``(s,)``."""

    start: Array
    along: Array
    link: Index

    @classmethod
    def of(cls, network: Network) -> Segments:
        """Of all links, in their order."""
        starts = [line[:-1] for line in network.lines]
        link = np.repeat(np.arange(len(network)), [len(s) for s in starts])
        empty = np.empty((0, 2))
        return cls(
            np.concatenate([*starts, empty]),
            np.concatenate([*(np.diff(li, axis=0) for li in network.lines), empty]),
            link,
        )

    def projected(self, points: Array) -> Array:
        """The nearest point on each segment ``(n, s, 2)`` to points ``(n, 2)``. [m]"""
        to = points[:, None] - self.start
        share = np.sum(to * self.along, axis=2) / np.maximum(np.sum(self.along**2, axis=1), 1e-12)
        return self.start + np.clip(share, 0, 1)[..., None] * self.along

    def nearest(self, point: Array) -> tuple[int, float]:
        """The link nearest to a point ``(2,)``, and how far it is. [m]"""
        apart = np.hypot(*(self.projected(point[None])[0] - point).T)
        return int(self.link[np.argmin(apart)]), float(apart.min())


def costs(segments: Segments, start: Array, end: Array) -> Array:
    """How badly each link fits the vector of each step, from ``start (n, 2)`` to ``end (n, 2)``: ``(n, l)``.

    [map-matching] Sec. 3.3 scores by distance and by angle and gives no formula; here both are counted in what is
    usual of them, and squared; beyond two corridors' widths, where the track is lost, a distance says no more. A link
    has no direction of its own. Of a bent link its best segment counts.
    """
    apart = np.linalg.norm(segments.projected(end) - end[:, None], axis=2)
    step, along = np.arctan2(*(end - start).T[::-1]), np.arctan2(*segments.along.T[::-1])
    askew = np.abs(wrap_angle(2 * (step[:, None] - along))) / 2
    off = (apart / FAR) ** 2
    fit = off / (1 + off / LOST) + (askew / ASKEW) ** 2
    begins = np.flatnonzero(np.diff(segments.link, prepend=-1))
    return np.minimum.reduceat(fit, begins, axis=1)


def straightened(steps: Steps) -> Steps:
    """The steps as the paper's dead reckoning has them, straight on where nobody turns: [map-matching] Sec. 3.2.

    What a gyroscope drifts and hips sway between turns then counts 0. So does a corridor that bends slowly. The paper
    drops each heading change under a threshold; a slow one in the midst of a turn is part of it, and stays.
    """
    turning = np.abs(steps.turn) > TURNING
    near = np.convolve(turning, np.ones(2 * BESIDE + 1), "full")[BESIDE:-BESIDE] > 0 if len(steps) else turning
    return replace(steps, turn=np.where(near, steps.turn, 0.0), pause_turn=np.where(near, steps.pause_turn, 0.0))


def turning_periods(steps: Steps) -> Index:
    """Runs of steps ``(p, 2)``, [first, last), that turn the same way by more than TURNING each: Sec. 3.2.

    One step that turns less does not end a run. A zigzag is one run to either side after the other, not one.
    """
    side = np.where(np.abs(steps.turn) > TURNING, np.sign(steps.turn), 0)
    gap = np.flatnonzero((side[1:-1] == 0) & (side[:-2] == side[2:])) + 1
    side[gap] = side[gap - 1]
    begins = np.flatnonzero(np.diff(side, prepend=0))
    ends = np.append(begins, len(side))[1:]
    turning = side[begins] != 0
    return np.stack([begins[turning], ends[turning]], axis=1)


def following(network: Network, fit: Array, link: int) -> int:
    """The link after some steps of ``fit (n, l)``, of which none is a turn: the best of the present and those that
    meet it, as the last AROUND steps say together.
    """
    for n in range(AROUND, len(fit) + 1):
        near = _meeting(network, link)
        link = int(near[np.argmin(fit[n - AROUND : n, near].sum(axis=0))])
    return link


def find_turn(network: Network, steps: Steps, track: Array, link: int, since: int = 0) -> Turn | None:
    """The first turn of a track ``(n + 1, 2)`` [m] that is on ``link`` at step ``since``; None without one: Sec. 3.3.

    A turn is a turning period after which the walk is on another link; the AROUND steps after it tell that together.
    Unlike the paper, which asks all links, one can only turn into a link that begins where one is, and to its side.
    """
    fit = costs(Segments.of(network), track[:-1], track[1:])
    for first, last in turning_periods(steps).tolist():
        if first < since or last >= len(steps):
            continue
        link = following(network, fit[since:first], link)
        near = _meeting(network, link)
        after = int(near[np.argmin(fit[last : last + AROUND, near].sum(axis=0))])
        bend = _Bend.between(network, link, after)
        if bend is not None and bend.angle * np.sum(steps.turn[first:last]) > 0:
            at = bend.sharpest(track, max(first - AROUND, since), min(last + AROUND, len(steps)))
            return Turn(
                max(at - HALF_TURN, since),
                min(at + HALF_TURN, len(steps)),
                bend.node,
                link,
                after,
                bend.into,
                bend.out_of,
            )
        since = max(since, first)
    return None


@dataclass(frozen=True)
class _Bend:
    """Two links that meet. into, out_of: unit vectors ``(2,)`` towards their node and away; angle between these."""

    node: int
    into: Array
    out_of: Array
    angle: float

    @classmethod
    def between(cls, network: Network, before: int, after: int) -> _Bend | None:
        """None of a link and itself, or of two that are one way."""
        if before == after:
            return None
        node = min(set(network.links[before].tolist()) & set(network.links[after].tolist()))
        into, out_of = -_direction(network.leaving(before, node)), _direction(network.leaving(after, node))
        angle = turn_between(into, out_of)
        return cls(node, into, out_of, angle) if abs(angle) > LEAST_TURN else None

    def sharpest(self, track: Array, begin: int, end: int) -> int:
        """The step of [begin, end) before which a track goes most into the node, and after which most away from it."""
        moves = np.diff(track[begin : end + 1], axis=0)
        return begin + int(np.argmax(np.cumsum(moves @ (self.into - self.out_of)))) + 1


def _direction(line: Array) -> Array:
    """Of a line as it begins: a unit vector ``(2,)``."""
    ahead = line[1] - line[0]
    return ahead / np.hypot(*ahead)


def _meeting(network: Network, link: int) -> Index:
    """A link and all that share a node with it."""
    return np.flatnonzero(np.isin(network.links, network.links[link]).any(axis=1))
