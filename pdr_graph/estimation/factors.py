"""The graph's own factors: PDR between two keyframes, walls along the steps between them, and turns.

Each factor is its equation, for any number of keyframe intervals at once. Poses are rows (x, y, θ); derivatives are by
GTSAM's local coordinates of Pose2 (x ⊕ ξ = x Exp ξ: forward, left, turn). The batch smoother evaluates the whole walk
with these lines, a ``gtsam.CustomFactor`` one interval.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import gtsam
import numpy as np

from pdr_graph.estimation.linearised import Linearised
from pdr_graph.estimation.observations import Rows
from pdr_graph.estimation.preintegration import Bridge, Increments, Pieces, preintegrate
from pdr_graph.estimation.turns import Turns
from pdr_graph.floor.distance import DistanceField
from pdr_graph.geometry import pose_rotation, wrap_angle
from pdr_graph.types import Array, Index

BODY, BODY_SIGMA = 0.15, 0.1  # [m] that the middle of a walker keeps from any wall, and how loosely, of the spring's


@dataclass(frozen=True, eq=False)
class Walls:
    """The walls about each piece of a walk.

    fields: signed distances to the walls of a region; of_piece: ``(m,)`` which of them holds for each piece, −1 none.
    price: what it costs that the walk leads through these regions, against half a squared sigma.
    margin: clearance that people keep [m]; sigma: how loosely [m].
    """

    fields: tuple[DistanceField, ...]
    of_piece: Index
    price: float
    margin: float
    sigma: float

    def __eq__(self, other: object) -> bool:
        """True if all pieces are in the same regions."""
        if not isinstance(other, Walls):
            return NotImplemented
        return self.fields == other.fields and np.array_equal(self.of_piece, other.of_piece)

    def only(self, pieces: slice) -> Walls:
        """The walls about some pieces."""
        return replace(self, of_piece=self.of_piece[pieces])

    def distance(self, points: Array) -> tuple[Array, Array]:
        """Signed distance ``(m,)`` [m] of each piece's end to its walls, and its gradient ``(m, 2)``."""
        distance, gradient = np.full(len(points), np.inf), np.zeros((len(points), 2))
        for n, field in enumerate(self.fields):
            here = self.of_piece == n
            distance[here], gradient[here] = field.at(points[here])
        return distance, gradient


@dataclass(frozen=True)
class Evaluation:
    """The own factors at one state, and what they were made of.

    pieces, bridge: of the intervals; pose_i, pose_j: ``(k, 3)``; increments: at c; left_over: of the PDR factor, not
    whitened; observed: the factors of single keyframes.
    """

    pieces: Pieces
    bridge: Bridge
    walls: Walls | None
    turns: Turns | None
    pose_i: Array
    pose_j: Array
    increments: Increments
    left_over: Linearised
    observed: tuple[Rows, ...] = ()

    @cached_property
    def pdr(self) -> Linearised:
        """The PDR factors ``(k, 3)``, whitened."""
        return self.left_over.times(self.bridge.root)

    @cached_property
    def poses(self) -> Linearised:
        """Where every piece ends, ``(m, 3)``."""
        return self.poses_of(np.arange(len(self.pieces.length)))

    def poses_of(self, which: Index) -> Linearised:
        """Where some pieces end ``(n, 3)``."""
        return steps_between(self.pose_i, self.left_over, self.increments, self.bridge, self.pieces, which)

    @cached_property
    def ends(self) -> Array:
        """Where every piece ends ``(m, 3)``, without derivatives: all that a move that is only tried needs."""
        interval = self.pieces.interval
        shared = np.einsum("kqr,kr->kq", self.bridge.gain, self.left_over.value[interval])
        R = pose_rotation(self.pose_i[:, 2])[interval]
        return np.einsum("kqr,kr->kq", R, self.increments.delta + shared) + self.pose_i[interval]

    @cached_property
    def springs(self) -> tuple[Array, Array] | None:
        """What the walls have against the end of each piece ``(m,)``, whitened, and its gradient ``(m, 2)``."""
        return self.walls and springs(self.ends, self.pieces, self.walls)

    @cached_property
    def wall(self) -> Linearised | None:
        """The wall factors, a row ``(m, 1)`` for each piece, whitened; None without walls."""
        return None if self.walls is None else self.wall_of(np.arange(len(self.pieces.length)))

    def wall_of(self, which: Index) -> Linearised:
        """The wall factors of some pieces ``(n, 1)``."""
        assert self.springs is not None, "there are walls"
        (value, gradient), poses = self.springs, self.poses_of(which)
        slope = np.zeros((len(which), 1, 3))
        slope[:, 0, :2] = gradient[which]
        return Linearised(value[which, None], slope @ poses.by_i, slope @ poses.by_j, slope @ poses.by_c)

    @cached_property
    def turned(self) -> tuple[Array, Array]:
        """What each turn turns too much or too little ``(t,)``, whitened, and its derivative by that angle."""
        if self.turns is None:
            return np.empty(0), np.empty(0)
        return self.turns.turned(np.append(self.pose_i[:, 2], self.pose_j[-1:, 2]))

    @cached_property
    def corner(self) -> Linearised | None:
        """How far outside its intersection each turn is, a row ``(t, 4)``, whitened; None without turns."""
        return None if self.turns is None else self.turns.place(self.poses)

    @cached_property
    def cost(self) -> float:
        """Half the sum of squares, as GTSAM counts it."""
        r = np.einsum("kij,kj->ki", self.bridge.root, self.left_over.value)
        others = [self.corner.value] if self.corner is not None else []
        others += [self.springs[0]] if self.springs is not None else []
        squares = float(sum(np.sum(v**2) for v in (r, self.turned[0], *others)))
        return 0.5 * squares + sum(rows.cost for rows in self.observed)


def evaluate(
    pieces: Pieces,
    bridge: Bridge,
    pose_i: Array,
    pose_j: Array,
    c: Array,
    walls: Walls | None = None,
    turns: Turns | None = None,
) -> Evaluation:
    """The own factors of every interval. pose_i, pose_j, c: ``(k, 3)`` at both ends of, and in, each interval."""
    increments = preintegrate(pieces, c)
    left_over = pdr(pose_i, pose_j, increments, pieces)
    return Evaluation(pieces, bridge, walls, turns, pose_i, pose_j, increments, left_over)


def pdr(pose_i: Array, pose_j: Array, increments: Increments, pieces: Pieces) -> Linearised:
    """What is left of the way from x_i to x_j when the preintegrated steps are taken off it (not yet whitened).

    r = [ R_iᵀ (p_j − p_i) − Δp_K(c),  wrap(θ_j − θ_i − Δθ_K(c)) ]
    """
    x, y, turn = (pose_j - pose_i).T
    cos, sin = np.cos(pose_i[:, 2]), np.sin(pose_i[:, 2])
    way_x, way_y = cos * x + sin * y, cos * y - sin * x
    r = np.stack([way_x, way_y, turn], axis=1) - increments.delta[pieces.last]
    r[:, 2] = wrap_angle(r[:, 2])

    zero, one, cos, sin = np.zeros_like(turn), np.ones_like(turn), np.cos(turn), np.sin(turn)
    by_i = np.stack([-one, zero, way_y, zero, -one, -way_x, zero, zero, -one], axis=1).reshape(-1, 3, 3)
    by_j = np.stack([cos, -sin, zero, sin, cos, zero, zero, zero, one], axis=1).reshape(-1, 3, 3)
    return Linearised(r, by_i, by_j, -increments.by_c[pieces.last])


def steps_between(
    pose_i: Array, left_over: Linearised, increments: Increments, bridge: Bridge, pieces: Pieces, which: Index
) -> Linearised:
    """Where each of some pieces between two keyframes ends, given both: the one place where sub-steps are placed.

    The PDR factor's left-over r is shared out by the conditional mean of a Gaussian walk whose two ends are known,

        s_k = Δ_k(c) + G_k r,      (p_k, θ_k) = (p_i + R_i s_k,xy,  θ_i + s_k,θ)

    with G_k of ``Bridge``; the last piece ends exactly at x_j, so the track has no jump at a keyframe.

    Returns poses ``(n, 3)`` of the pieces ``which (n,)``, with derivatives of (x, y, θ) by x_i, x_j and c;
    ``Evaluation.ends`` has the same poses without.
    """
    interval = pieces.interval[which]
    shared = left_over.take(interval).times(bridge.gain[which])
    s = increments.delta[which] + shared.value
    by_i = shared.by_i + np.eye(3)
    by_i[:, 0, 2] -= s[:, 1]
    by_i[:, 1, 2] += s[:, 0]
    in_frame_of_i = Linearised(s, by_i, shared.by_j, increments.by_c[which] + shared.by_c)
    placed = in_frame_of_i.times(pose_rotation(pose_i[:, 2])[interval])
    return Linearised(placed.value + pose_i[interval], placed.by_i, placed.by_j, placed.by_c)


def springs(pose: Array, pieces: Pieces, walls: Walls) -> tuple[Array, Array]:
    """A spring that keeps steps clear of walls, and a stiff one that keeps bodies out of them, whitened:

        r = max(0, margin − d(p)) / σ + max(0, BODY − d(p)) / σ_body

    d is the signed distance to the walls of the piece's own region, so that it is negative behind the thinnest. A piece
    in which nobody moved adds no evidence. Returns r ``(m,)`` at poses ``(m, 3)``, and its gradient ``(m, 2)``.
    """
    distance, gradient = walls.distance(pose[:, :2])
    moved = pieces.length > 0
    r, steepness = np.zeros(len(distance)), np.zeros(len(distance))
    for keep, sigma in ((walls.margin, walls.sigma), (BODY, BODY_SIGMA * walls.sigma)):
        pressed = moved & (distance < keep)
        r[pressed] += (keep - distance[pressed]) / sigma
        steepness[pressed] += 1 / sigma
    return r, -gradient * steepness[:, None]


class FactorError(RuntimeError):
    """A factor's callback went wrong. GTSAM itself would crash or go on in silence."""


def guarded(
    name: str,
    noise: gtsam.noiseModel.Base,
    keys: Sequence[int],
    linearised: Callable[[gtsam.Values], tuple[Array, list[Array]]],
) -> gtsam.CustomFactor:
    """A ``gtsam.CustomFactor`` whose callback cannot corrupt the solver.

    linearised: values → error ``(r,)`` and one block ``(r, 3)`` per key. The guard checks shapes and finiteness and
    fills every block: an unset block crashes the process, a wrong shape is accepted in silence, and a NaN ends the
    optimiser without a word (gtsam 4.3.0).
    """
    rows = noise.dim()

    def callback(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        error, blocks = linearised(values)
        shapes = [error.shape, *(b.shape for b in blocks)]
        if shapes != [(rows,)] + [(rows, 3)] * len(keys):
            raise FactorError(f"{name} factor: shapes {shapes} for {rows} rows and {len(keys)} keys")
        if not all(np.isfinite(a).all() for a in (error, *blocks)):
            raise FactorError(f"{name} factor: not finite at {[gtsam.DefaultKeyFormatter(k) for k in keys]}")
        if jacobians is not None:
            for n, block in enumerate(blocks):
                jacobians[n] = np.asfortranarray(block)
        return error

    return gtsam.CustomFactor(noise, list(keys), callback)
