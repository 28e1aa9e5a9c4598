"""A particle filter on the plan with walls, doors and stairs; batch and live.

As in Woodman & Harle (2008), *Pedestrian localisation for indoor environments*, with the walker's calibration
(R_s, R_d, b) as states, rejuvenated by a kernel (Liu & West 2001); the number of particles adapts to their spread (Fox
2003). Fixes may be outliers, and walls may be wrong.

Walls are local constraints: an optimisation that starts in a wrong aisle ends in that aisle. A `ParticleFilter` has
thousands of particles, weighted by walls and the measurements of all kinds; the ancestors of the survivors are the
possible paths.

A particle that would cross a wall draws its errors again.

By default a kind of measurement weighs poses by its own residuals: its instances at the keyframe are evaluated once for
each pose, as if the poses were a walk. The priors of other variables (the place of an anchor, the path loss) widen the
sigmas. A kind with a shorter formula overrides `pose_costs`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pdr_graph.estimation.factors.base import (
    CALIBRATION,
    POSE,
    FactorBlock,
    Linearized,
    Measurement,
    OnPlan,
    PoseCosts,
    WeighsPoses,
    initial_state,
)
from pdr_graph.estimation.factors.chain import Chain, Evaluation, Increments, Pieces
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.floor.distance_field import DistanceField
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.priors import MOTION, PARTICLES, REGIONS, WALLS
from pdr_graph.types import Array, Index, keyframes_of, repeated

KeyframeMeasurements = Sequence[PoseCosts]  # the measurements at a keyframe, kind by kind


def pose_costs(measurements: Sequence[Measurement], keyframe: int) -> KeyframeMeasurements:
    """The measurements of all kinds at a keyframe."""
    costs = [
        kind.pose_costs(keyframe) if isinstance(kind, WeighsPoses) else _by_residuals(kind, keyframe)
        for kind in measurements
        if not isinstance(kind, OnPlan)
    ]
    return tuple(one for one in costs if one is not None)


def _by_residuals(kind: Measurement, keyframe: int) -> Residuals | None:
    """The instances of a kind at a keyframe; None for kinds whose instances are not bound to one keyframe each."""
    bound = keyframes_of(kind)
    if bound is None:
        return None
    which = np.flatnonzero(bound == keyframe)
    return Residuals(repeated(kind, which, np.zeros_like(which)), len(which)) if len(which) else None


@dataclass(frozen=True)
class Residuals:
    """Costs of poses by the residuals of a kind.

    kind: its instances at the keyframe, bound to keyframe 0; count: their number.
    """

    kind: Measurement
    count: int

    def costs(self, state: Array) -> Iterable[Array]:
        """The sum of the losses of all factors of each pose."""
        n, f = state.shape[1], self.count
        each = repeated(self.kind, np.tile(np.arange(f), n), np.arange(n).repeat(f))
        walk = initial_state(np.ascontiguousarray(state[:3].T), np.ascontiguousarray(state[3:].T), (each,))
        none = np.empty((0, 3))
        increments, nothing = Increments(none, np.empty((0, 3, 3))), Linearized(none, *(np.empty((0, 3, 3)),) * 3)
        at = Evaluation(Chain.keyframe_alone(0.0, 0, 0), walk, (each,), increments, nothing)
        variances = dict[str, Array]()  # (n, 3) of the variables of each symbol, by their priors alone
        for block in at.blocks:
            if block.prior and block.rows_each:
                symbol, rows = block.variables[0]
                J = block.jacobian()[0].reshape(len(block), block.rows_each, 3)
                information = np.zeros((len(at.state[symbol]), 3, 3))
                information[rows] = J.transpose(0, 2, 1) @ J
                inverse = np.linalg.inv(information + 1e-9 * np.eye(3))
                variances[symbol] = np.diagonal(inverse, axis1=1, axis2=2).astype(float)
        for block in at.blocks:
            poses = [rows for symbol, rows in block.variables if symbol == POSE]
            if len(poses) == 1 and not block.prior:
                cost = block.loss.cost(block.deviation / _widening(block, variances))
                capped = np.minimum(cost, PARTICLES.outlier_price)
                yield np.asarray(np.bincount(poses[0], capped, n), dtype=np.float64)

    def place_sought(self, state: Array) -> None:
        """Residuals determine no single place."""


def _widening(block: FactorBlock, priors: dict[str, Array]) -> Array:
    """Factors ``(n,)`` by which sigmas are wider, by the errors of other variables and by PARTICLES.least_sigma."""
    variance, slope = np.ones(len(block.residual)), np.zeros(len(block.residual))
    for (symbol, rows), by in zip(block.variables, block.jacobian(), strict=True):
        if symbol == POSE:
            slope = by[:, 0] ** 2 + by[:, 1] ** 2
        elif symbol in priors and symbol != CALIBRATION:
            variance += np.einsum("mi,mi->m", by**2, priors[symbol][rows[block.row_of]])
    widest = np.zeros(len(block))
    np.maximum.at(widest, block.row_of, np.maximum(variance, PARTICLES.least_sigma**2 * slope))
    return np.sqrt(np.maximum(widest, 1.0))


MOST_LOOKS = 100  # points of a step that are tested against walls, however long it is
FURTHER_DRAWS = 4  # of a step that would cross a wall
FREE_ODDS = np.log((FURTHER_DRAWS + 1) / np.maximum(np.arange(FURTHER_DRAWS + 1), 1))  # by how many of them are free
ONE_TURNED = 4  # of so many particles, one draws any direction where a turn or the start is open
ONE_SOUGHT = 5  # of so many particles, one moves to a place that is sought
PARTICLE_BINS = np.array([1.0, 1.0, np.pi / 8])[:, None]  # [m, m, rad] of which some particles each are needed


class Walls(NamedTuple):
    """The walls of a floor; at_once, tiles: see `DistanceField.approximate`."""

    field: DistanceField
    at_once: int | None = None
    tiles: Index | None = None

    def distance(self, places: Array) -> Array:
        """Distance ``(…)`` [m] of places ``(2, …)`` from the nearest wall."""
        return self.field.approximate(places, self.at_once, self.tiles)


def stepped(
    state: Array, length: float, turn: float, time: float, sigma: Array, walls: Walls, random: np.random.Generator
) -> tuple[Array, Array]:
    """States ``(6, n)`` after a step, and its cost ``(n,)`` for each particle.

    A particle that would cross a wall draws its errors again, up to FURTHER_DRAWS times, at the cost of the log-odds.
    state: ``(6, n)`` x, y [m], θ [rad], R_s, R_d, b; sigma: ``(3,)`` along, across [m] and of the turn [rad].
    """
    looks = float(min(np.ceil(length / (2 * WALLS.body)), MOST_LOOKS))
    after, way = _moved(state, _errors(state.shape[1], sigma, random), length, turn, time)
    clear = _clearances(state, way, looks, walls)
    price = PARTICLES.clear_price * np.square(np.maximum(0.0, 1 - clear[-1] / WALLS.margin))
    price[clear[-1] < WALLS.body] = REGIONS.outside_price
    stopped = np.flatnonzero(clear.min(axis=0) < WALLS.body)
    if len(stopped):
        stopped = stopped[walls.distance(state[:2, stopped]) >= WALLS.body]  # those inside a wall may leave it
    if not len(stopped):
        return after, price
    before = np.repeat(state[:, stopped], FURTHER_DRAWS, axis=1)
    others, way = _moved(before, _errors(before.shape[1], sigma, random), length, turn, time)
    free = (_clearances(before, way, looks, walls).min(axis=0) >= WALLS.body).reshape(-1, FURTHER_DRAWS)
    ways = free.sum(axis=1)
    got = ways > 0
    after[:, stopped[got]] = others[:, (np.arange(len(stopped)) * FURTHER_DRAWS + free.argmax(axis=1))[got]]
    price[stopped] = np.where(got, FREE_ODDS[ways], REGIONS.wall_cost)
    return after, price


def stood(state: Array, turn: float, time: float, sigma: Array, random: np.random.Generator) -> Array:
    """States ``(6, n)`` after a pause, in which the phone may have turned."""
    return _moved(state, _errors(state.shape[1], sigma, random), 0.0, turn, time)[0]


def _errors(count: int, sigma: Array, random: np.random.Generator) -> Array:
    """Random errors ``(3, count)`` along, across [m] and of the turn [rad].

    Where the turn may be the phone's, one in PARTICLES.rare gets any turn.
    """
    errors = random.standard_normal((3, count))
    errors *= sigma[:, None]
    if sigma[2] > PARTICLES.doubted:
        any_turn = errors[2, ::ONE_TURNED]
        any_turn[:] = random.uniform(-np.pi, np.pi, len(any_turn))
    return errors


def _moved(state: Array, errors: Array, length: float, turn: float, time: float) -> tuple[Array, Array]:
    """States ``(6, n)`` after a piece with errors ``(3, n)``, and the displacement ``(2, n)`` [m]."""
    forward, left = errors[0] + state[3] * length, errors[1]
    turned = errors[2] + (state[4] * turn + state[5] * time)
    course = (state[2] + 0.5 * turned).astype(np.float32)  # to 1e-6 of a turn; six times as fast
    cos, sin = np.cos(course).astype(float), np.sin(course).astype(float)
    way = np.stack([forward * cos - left * sin, forward * sin + left * cos])
    after = state.copy()
    after[:2] += way
    after[2] += turned
    return after, way


def _clearances(state: Array, way: Array, looks: float, walls: Walls) -> Array:
    """Distance ``(looks, n)`` [m] from the walls along displacements ``way (2, n)`` [m]."""
    places = (np.arange(1, looks + 1)[:, None] / looks) * way[:, None]
    places += state[:2, None]
    return walls.distance(places)


LEAST_STRIDE = 0.1  # least R_s, since its logarithm is used


@dataclass(frozen=True)
class Paths:
    """The ancestors of the last particles.

    state: ``(k + 1, 6, n)`` x, y [m], θ [rad], R_s, R_d, b at each keyframe; weight: ``(n,)``, sum 1.
    """

    state: Array
    weight: Array


class ParticleFilter:
    """Particles ``(6, n)`` x, y [m], θ [rad], R_s, R_d, b, and their ancestors at the stored keyframes.

    prior: of (R_s, R_d, b); fewest, most: limits of the number of particles, which adapts; per_bin: of them in each
    bin; at_once: most tiles of wall distances that one step computes, by default all; live steps have no time for that.
    """

    def __init__(
        self,
        prior: Prior,
        seed: int,
        *,
        fewest: int,
        most: int,
        at_once: int | None = None,
        per_bin: float | None = None,
    ):
        self.prior, self.fewest, self.most, self.at_once = prior, fewest, most, at_once
        self.per_bin = PARTICLES.per_bin * most / PARTICLES.most if per_bin is None else per_bin
        self.evidence = 0.0  # logarithm of the measurements' probability
        self.random = np.random.default_rng(seed)
        self.state, self.weight = np.empty((6, 0)), np.empty(0)  # weight: its logarithm ``(n,)``
        self._change = np.array(prior.change)[:, None]
        self._wide = prior.covariance * np.outer(PARTICLES.wide, PARTICLES.wide)
        self._steps = 0  # since the last keyframe
        self._tiles = dict[int, Index]()  # by field
        self._states, self._origins = list[Array](), list[Index]()

    def begin(
        self,
        place: Array,
        sigma: float,
        heading: float,
        sigma_heading: float,
        way: complex = 0j,
        measured: KeyframeMeasurements = (),
    ) -> None:
        """Start at the first keyframe, with particles whose steps lead to ``place``.

        place: ``(2,)``, with sigma [m]; heading: at the keyframe, with sigma_heading [rad]; way: dead-reckoned
        displacement from the keyframe to the place, for that heading, complex [m]; measured: at the keyframe.
        """
        n, random = self.most, self.random
        spread = max(sigma_heading, 0.1)
        turned = spread * random.standard_normal(n)
        anyhow = slice(None) if spread > np.pi / 2 else slice(None, None, ONE_TURNED)  # fixes lay a walk as a whole
        turned[anyhow] = 2 * np.pi * np.arange(n)[anyhow] / n
        c = _calibrated(random.multivariate_normal(np.zeros(3), self._wide, n).T, self.prior)
        led = way * c[0] * np.exp(1j * turned)
        start = place[:, None] + sigma * random.standard_normal((2, n)) - [led.real, led.imag]
        self.begin_at(np.concatenate([start, [heading + turned], c]))
        self.weight = _likelihood(measured, self.state)

    def begin_anywhere(self, floor: FloorPlan, measured: KeyframeMeasurements = ()) -> None:
        """Start at the first keyframe all over a floor, in all directions. measured: at the keyframe."""
        n, random = self.most, self.random
        c = _calibrated(random.multivariate_normal(np.zeros(3), self.prior.covariance, n).T, self.prior)
        heading = random.uniform(-np.pi, np.pi, (1, n))
        self.begin_at(np.concatenate([floor.random_places(n, random).T, heading, c]))
        self.weight += _likelihood(measured, self.state)

    def begin_at(self, state: Array) -> None:
        """Start at the first keyframe with particles ``(6, n)``."""
        n = state.shape[1]
        self.state, self.weight, self._steps = state, np.full(n, -np.log(n)), 0
        self._states, self._origins = [state], [np.arange(n)]

    def advance(
        self,
        pieces: Pieces,
        fields: Sequence[DistanceField],
        ways: Mapping[int, Sequence[DistanceField]] | None = None,
        measured: KeyframeMeasurements = (),
    ) -> None:
        """Move to the next keyframe, through an interval of ``pieces``.

        fields: of the floor of each piece; ways: by piece that starts on another floor than the one before, the stairs
        and lifts between; measured: at the next keyframe.
        """
        turn, time = 2 * (pieces.to_end - pieces.to_middle)
        for m, floor in enumerate(fields):
            if ways and m in ways:
                self.change_floor(ways[m])
            self.step(float(pieces.length[m]), turn[m], time[m], pieces.variance[m], floor)
        self.close(measured)

    def change_floor(self, ways: Sequence[DistanceField]) -> None:
        """Change the floor, by stairs or lifts with these fields."""
        if ways:
            outside = -np.max([way.approximate(self.state[:2]) for way in ways], axis=0)
            cost = 0.5 * np.square(np.maximum(0.0, outside) / PARTICLES.stairs_sigma)
            self.weight = self.weight - np.minimum(cost, REGIONS.wall_cost)

    def step(self, length: float, turn: float, time: float, variance: Array, floor: DistanceField) -> None:
        """Move by a piece [m, rad, s], with the walls of a floor. variance: ``(2,)`` as of ``Pieces``."""
        sigma = np.array(PARTICLES.calm) * np.sqrt(variance[[0, 0, 1]])
        if length > 0:
            # Of the tiles, those that this filter has asked for: others may compute some at any time, in a thread
            asked = None if self.at_once is None else self._tiles.setdefault(id(floor), floor.no_tiles())
            walls = Walls(floor, self.at_once, asked)
            self.state, price = stepped(self.state, length, turn, time, sigma, walls, self.random)
            self.weight = self.weight - price
            self._steps += 1
        else:
            self.state = stood(self.state, turn, time, sigma, self.random)

    def close(self, measured: KeyframeMeasurements = ()) -> None:
        """Close a keyframe: weight by the measurements there, resample."""
        state, random = self.state, self.random
        state[3:] += (
            np.sqrt(self._steps / MOTION.steps_per_segment) * self._change * random.standard_normal(state[3:].shape)
        )
        np.maximum(state[3], LEAST_STRIDE, out=state[3])
        for kind in measured:
            if (sought := kind.place_sought(state)) is not None:
                self._seek(*sought)
        weight = self.weight + _likelihood(measured, self.state)
        largest = weight.max()
        share = np.exp(weight - largest)
        total = largest + np.log(share.sum())
        self.evidence += total
        weight -= total
        origin = np.arange(len(weight))
        if share.sum() ** 2 < 0.5 * len(weight) * (share @ share):
            origin = resampled(weight, self._needed(), random)
            self.state, weight = self.state.take(origin, axis=1), np.full(len(origin), -np.log(len(origin)))
            self.state[3:] = self._varied()
        self.weight, self._steps = weight, 0
        self._states.append(self.state)
        self._origins.append(origin)

    def paths(self, most: int | None = None) -> Paths:
        """The ancestors of the present particles at all stored keyframes. most: of so many, drawn by their weights."""
        which, weight = np.arange(len(self.weight)), np.exp(self.weight)
        if most is not None and len(which) > most:
            which, weight = resampled(self.weight, most, self.random), np.full(most, 1.0 / most)
        paths = np.empty((len(self._states), 6, len(which)))
        for k in range(len(paths) - 1, -1, -1):
            self._states[k].take(which, axis=1, out=paths[k], mode="clip")
            which = self._origins[k].take(which)
        return Paths(paths, weight)

    def forget(self, count: int) -> None:
        """Drop the first ``count`` stored keyframes."""
        del self._states[:count], self._origins[:count]

    def _seek(self, position: Array, sigma: float) -> None:
        """Move one in ONE_SOUGHT particles to a place [m] at a price; later measurements decide if they stay."""
        state, weight, n = self.state.copy(), self.weight.copy(), self.state.shape[1]
        put = np.arange(0, n, ONE_SOUGHT)
        place = self.random.standard_normal((2, len(put))) * sigma
        state[:2, put] = position[:, None] + place
        state[2, put] += self.random.uniform(-np.pi, np.pi, len(put))
        weight[put] = np.logaddexp.reduce(weight) - np.log(n) - PARTICLES.outlier_price / 2
        self.state, self.weight = state, weight

    def _varied(self) -> Array:
        """Calibrations ``(3, n)`` after a Metropolis move with the kernel, which the prior accepts or rejects."""
        c, (stride, turn, drift), information = self.state[3:], self.prior.mean, np.linalg.inv(self._wide).astype(float)
        before = np.stack([np.log(c[0] / stride), c[1] - turn, c[2] - drift])  # the inverse of `_calibrated`
        apart = before - before.mean(axis=1, keepdims=True)
        covariance = apart @ apart.T.copy() * (1 / (len(apart.T) - 1))  # np.cov's to the last bit, in half its time
        root = np.linalg.cholesky(covariance + 1e-12 * np.eye(3))
        after = before + 0.2 * root @ self.random.standard_normal(c.shape)
        rise = 0.5 * (np.sum(after * (information @ after), axis=0) - np.sum(before * (information @ before), axis=0))
        return np.where(self.random.exponential(size=c.shape[1]) > rise, _calibrated(after, self.prior), c)

    def _needed(self) -> int:
        """Number of particles needed: some for each bin of place and direction that they occupy."""
        x, y, angle = np.floor(self.state[:3] / PARTICLE_BINS).astype(np.int64)
        bins = np.sort((x << 40) + (y << 16) + angle)
        occupied = 1 + np.count_nonzero(bins[1:] != bins[:-1])
        return int(min(max(self.per_bin * occupied, self.fewest), self.most))


def _likelihood(measured: KeyframeMeasurements, state: Array) -> Array:
    """Log-likelihood ``(n,)`` of the measurements; an outlier costs PARTICLES.outlier_price at most."""
    total = np.zeros(state.shape[1])
    for kind in measured:
        for cost in kind.costs(state):
            total -= cost
    return total


def resampled(weight: Array, n: int, random: np.random.Generator) -> Index:
    """Indices of the surviving particles ``(n,)`` by systematic resampling."""
    share = np.cumsum(np.exp(weight))
    return np.minimum(np.searchsorted(share, share[-1] * (np.arange(n) + random.uniform()) / n), len(weight) - 1)


def _calibrated(errors: Array, prior: Prior) -> Array:
    """(R_s, R_d, b) ``(3, n)`` from errors about the prior's mean; R_s by its logarithm, or walls would favour walkers
    who hardly move.
    """
    stride, turn, drift = prior.mean
    return np.stack([stride * np.exp(errors[0]), turn + errors[1], drift + errors[2]])


def particle_filter(graph: WalkGraph, seed: int = 0, times: int = 1) -> Paths:
    """The possible paths by plan and measurements.

    graph: with walls, and at least one used fix. times: multiple of the usual number of particles.
    """
    particles = ParticleFilter(graph.prior, seed, fewest=times * PARTICLES.fewest, most=times * PARTICLES.most)
    _begin(particles, graph)
    advance_through(particles, graph, 0)
    return particles.paths()


def particles_from(graph: WalkGraph, keyframe: int, state: Array) -> Paths:
    """As `particle_filter`, from a keyframe with particles ``state (6, n)``."""
    particles = ParticleFilter(graph.prior, 0, fewest=PARTICLES.fewest, most=PARTICLES.most)
    particles.begin_at(state)
    advance_through(particles, graph, keyframe)
    return particles.paths()


def advance_through(particles: ParticleFilter, graph: WalkGraph, begin: int) -> None:
    """Move particles from keyframe ``begin`` to the end of a walk."""
    floor_sequence, pieces = graph.floor_sequence, graph.pieces
    assert floor_sequence is not None, "asked for with a plan"
    ways = {piece: [way.field for way in others] for piece, others in floor_sequence.changes.items()}
    for interval in range(begin, len(pieces.first)):
        first = int(pieces.first[interval])
        here = range(first, int(pieces.last[interval]) + 1)
        particles.advance(
            _pieces(graph, interval),
            [floor_sequence.field(m) for m in here],
            {m - first: ways[m] for m in here if m in ways},
            pose_costs(graph.measurements, interval + 1),
        )


def _pieces(graph: WalkGraph, interval: int) -> Pieces:
    """The pieces of an interval; where a kind says that the walker stood, they err no more."""
    pieces = graph.pieces.between(interval, interval + 1)
    limits = [kind.standing_variance(interval) for kind in graph.measurements if isinstance(kind, WeighsPoses)]
    stood = min(limits, default=np.inf)
    if not np.isfinite(stood):
        return pieces
    return replace(pieces, variance=np.minimum(pieces.variance, [stood, np.inf]))


def _begin(particles: ParticleFilter, graph: WalkGraph) -> None:
    """Start the particles so that the steps lead to the first fix."""
    fixes, (track, _) = graph.positions, graph.chain.track
    used = np.flatnonzero(fixes.used)
    first = used[np.argmin(fixes.keyframe[used])]
    particles.begin(
        fixes.fixes.position[first],
        float(fixes.independent_sigma[first]),
        float(graph.start.poses[0, 2]),
        graph.sigma_direction,
        complex(track[fixes.keyframe[first]]),
        pose_costs(graph.measurements, 0),
    )
