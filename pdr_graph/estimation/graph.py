"""The factor graph of one walk: which variables, which factors, and their linearisation.

x_0 ──PDR── x_1 ──PDR── x_2 ── … ── x_k         x_i  Pose2 at keyframe i
 │   ╲c_0╱   ╲  c_0 ╱    │                      c_s  (R_s, R_d, b) of segment s, a random walk
fix          wall       fix                     g_m  offset and lag of a receiver, slowly varying
 ╰── g_0 ───── g_1 ──────╯                      b_m  place and power of a beacon; q  (P, n, k) of their path loss
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, C, G, Q, X

from pdr_graph.errors import expect
from pdr_graph.estimation import native
from pdr_graph.estimation.as_gtsam import as_gtsam
from pdr_graph.estimation.beacons import LOSS, Levels
from pdr_graph.estimation.closures import Closures
from pdr_graph.estimation.corridors import Corridors, Use, corridors_along
from pdr_graph.estimation.factors import Evaluation, Walls, evaluate
from pdr_graph.estimation.initial import align, as_complex, sigma_direction
from pdr_graph.estimation.observations import Rows
from pdr_graph.estimation.preintegration import DECIMALS, Pieces, bridge, cut, preintegrate
from pdr_graph.estimation.reach import within_reach
from pdr_graph.estimation.receivers import Receivers, receivers, repeated, together, velocities
from pdr_graph.estimation.robust import HUBER_WIDTH, gripping, outside, slipping
from pdr_graph.estimation.turns import Turns
from pdr_graph.floor.building import Building
from pdr_graph.floor.ground import Ground
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.floor.regions import STRAY
from pdr_graph.geometry import ANY_HEADING, nearest, rotation, wrap_angle
from pdr_graph.types import Array, Complex, Fixes, Headings, Index, Mask, Steps

STEPS_PER_SEGMENT = 100
LONGEST_OVERHANG = 5.0  # [s] by which a fix may lie outside the recording
WALKING_SPEED = 1.4  # [m/s] at which an overhanging fix grows stale
AMBIGUOUS = 0.35  # [rad] of uncertain direction above which the fixes' scale is not believed, and more starts are tried
LONGER, BEYOND = 1.5, 20.0  # times as far as strides and sigmas say, and [m], that a walk may lead from its fixes
LOOSELY = 5.0  # times its sigma a fix holds where all places are about as likely
FIRM, DOUBTED, UNBOUND = "firm", "doubted", "unbound"  # how closures hold
FRAME_SIGMA = 1e-3  # [m, rad] of a start that defines the frame


@dataclass(frozen=True)
class Prior:
    """What is believed of walker, gyro and walls before the walk.

    mean, sigma: of R_s [-], R_d [-], b [rad/s] (design section 3: a tighter R_s bends walks instead of scaling them).
    correlation: of (R_s, R_d), (R_s, b), (R_d, b).
    change: standard deviation of their change from one segment to the next.
    wall_margin: clearance that people keep from walls [m]; wall_sigma: how loosely [m]; corridors: see ``Use``.
    fix_flat: within so many sigmas of a fix all places are about as likely, for receivers that tell a radius and no
        more; what fixes of one source have in common is then left out.
    """

    mean: tuple[float, float, float] = (1.0, 1.0, 0.0)
    sigma: tuple[float, float, float] = (0.15, 0.03, 0.002)
    change: tuple[float, float, float] = (0.03, 0.005, 0.0005)
    correlation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    wall_margin: float = 0.8
    wall_sigma: float = 1.0
    corridors: Use = field(default_factory=Use)
    fix_flat: float = 0.0

    def __post_init__(self) -> None:
        """Raise ValueError on what no factor can be made of."""
        for name in ("sigma", "change"):
            if not all(np.isfinite(s) and s > 0 for s in getattr(self, name)):
                raise ValueError(f"Prior.{name}: found {getattr(self, name)}, needed standard deviations above 0")

    @property
    def covariance(self) -> Array:
        """Of (R_s, R_d, b) ``(3, 3)``."""
        correlation = np.eye(3)
        correlation[np.triu_indices(3, 1)] = correlation.T[np.triu_indices(3, 1)] = self.correlation
        return correlation * np.outer(self.sigma, self.sigma)


@dataclass(frozen=True)
class State:
    """All variables as arrays: poses ``(k + 1, 3)`` x, y, θ; c ``(s, 3)``; g, b, q ``(…, 3)``."""

    poses: Array
    c: Array
    g: Array = field(default_factory=lambda: np.empty((0, 3)))
    b: Array = field(default_factory=lambda: np.empty((0, 3)))
    q: Array = field(default_factory=lambda: np.empty((0, 3)))

    def to_values(self) -> gtsam.Values:
        """As ``gtsam.Values``, keys x0…, c0… and so on."""
        values = gtsam.Values()
        for key, (x, y, theta) in enumerate(self.poses.tolist(), X(0)):
            values.insert(key, gtsam.Pose2(x, y, theta))
        for symbol, vectors in ((C, self.c), (G, self.g), (B, self.b), (Q, self.q)):
            for key, vector in enumerate(vectors, symbol(0)):
                values.insert(key, vector)
        return values

    def turned(self, angle: float, pivot: Array) -> State:
        """All poses turned by ``angle`` [rad] about ``pivot (2,)`` [m]."""
        position = (self.poses[:, :2] - pivot) @ rotation(angle).T + pivot
        return replace(self, poses=np.column_stack([position, self.poses[:, 2] + angle]))

    @classmethod
    def of(cls, values: gtsam.Values) -> State:
        """From ``gtsam.Values``."""
        vectors = (gtsam.utilities.extractVectors(values, name).reshape(-1, 3) for name in "cgbq")
        return cls(gtsam.utilities.extractPose2(values), *vectors)


class WalkGraph:
    """Every measurement of one walk as a factor.

    steps: the walk as the front end saw it; fixes: in the frame of ``floor`` (or any metric frame without one);
    headings: walking directions in that frame; floor: whose walls are factors, optional, or a building; floors: the
    floor's label for each row of the trajectory ``(n + 2,)``, needed with a building of several; levels: of beacons
    that were heard; closures: moments that were spent at one place; prior: see ``Prior``; others: of further walks in
    the same steps, when they begin, in order [s], and what is believed of their walkers.

    The batch smoother evaluates the own factors of all keyframes at once (``evaluate``, ``linearize``). The same graph
    as GTSAM knows it, own factors as ``CustomFactor``, is ``to_gtsam()``.

    Raises TypeError, or ValueError where fixes are not in metres or nothing tells the floors of a building.
    """

    def __init__(
        self,
        steps: Steps,
        fixes: Fixes | None = None,
        *,
        headings: Headings | None = None,
        floor: FloorPlan | Building | None = None,
        floors: Sequence[str] | None = None,
        levels: Levels | None = None,
        closures: Closures | None = None,
        prior: Prior | None = None,
        others: Sequence[tuple[float, Prior]] = (),
    ):
        _check(steps, fixes, headings, floor, prior)
        self.steps = steps
        self.given = self.fixes = Fixes.none() if fixes is None else fixes
        self.floor = floor
        self.prior = prior or Prior()
        self.closures = Closures.of([]) if closures is None else closures

        # Variables: a pose per keyframe, a calibration per segment
        self.levels = levels if levels is not None and len(levels) else None
        fresh, self.fix_sigma = _freshness(self.fixes, steps)
        self.by_proximity = self.levels is not None and not fresh.any()
        if self.levels is not None and self.by_proximity:
            self.fixes = self.levels.proximity()
            fresh, self.fix_sigma = _freshness(self.fixes, steps)
        self.fix_repeats = repeated(self.fixes)
        self.fix_used = fresh & ~self.fix_repeats
        self.fix_run, self.fix_believed = within_reach(steps, self.fixes, self.fix_sigma, self.fix_used)
        self.fix_sigma_together = together(self.fixes, self.fix_sigma, self.fix_believed, steps)
        lost = steps.length == 0
        gap_ends = np.append(steps.time[lost] - steps.duration[lost], steps.time[lost])
        self.headings = _within(Headings.none() if headings is None else headings, steps)
        at = [self.fixes.time[self.fix_used], self.headings.time, gap_ends, self.levels.time if self.levels else []]
        at += [self.closures.time.ravel()]
        self.pieces = cut(steps, np.concatenate(at))
        row = np.searchsorted(self.pieces.row_end, np.arange(len(self.pieces.length))) + 1
        self.floors = _labels(floor, floors, len(steps) + 2)
        self.ground = None if floor is None else Ground.of(floor, [self.floors[r] for r in row.tolist()])
        self.fix_keyframe = nearest(self.pieces.keyframe_time, self.fixes.time)
        self.heading_keyframe = nearest(self.pieces.keyframe_time, self.headings.time)
        self.level_keyframe = nearest(self.pieces.keyframe_time, self.levels.time) if self.levels else np.empty(0, int)
        self.closure_keyframe, self.closure_hold = nearest(self.pieces.keyframe_time, self.closures.time), DOUBTED
        self.segment = _segments(self.pieces, steps)
        self.priors = self._priors(others)
        self.keys = [X(i) for i in range(len(self.segment))], [C(s) for s in self.segment.tolist()]

        # How steps add up, where to start, what a receiver's fixes have in common, and GTSAM's own factors
        c = self._usual_c()
        increments = preintegrate(self.pieces, c[self.segment])
        self.bridge = bridge(self.pieces, increments)
        self.track, heading = _track(increments.delta[self.pieces.last])
        self.velocity = velocities(self.track, heading, self.pieces.keyframe_time)
        self.start, self.sigma_direction = self._pointed(*self._lay_on_fixes(heading))
        self.fix_wild, self.fix_held = np.zeros(len(self.fixes), dtype=bool), self.fix_believed
        self.corridors: Corridors | None = None
        self.receivers: Receivers | None = None
        if self.levels is not None:
            self._place_beacons(self.levels)
        self.native = self._native_factors()

        # Walls say nothing of a walk that could be anywhere, or is elsewhere
        self.walled = False
        if self.ground is not None and self.ground.near(self.fixes.position[self.fix_used]).any():
            self.ground, self.walled = self.ground.within(*self._reach()), True

    def evaluate(self, values: gtsam.Values) -> Evaluation:
        """The own factors at ``values``."""
        state = State.of(values)
        return replace(self._evaluated(state, self.walls, self.turns), observed=self._observed(state))

    @cached_property
    def walls(self) -> Walls | None:
        """The walls about the steps where they lead along the start; None where none are known or asked for."""
        return self._walls_along(self._evaluated(self.start)) if self.walled else None

    def observed(self, values: gtsam.Values) -> tuple[Rows, ...]:
        """The own factors at ``values`` but for steps, walls and turns: receivers, beacons, closures."""
        return self._observed(State.of(values))

    @property
    def turns(self) -> Turns | None:
        """The turns that were matched to intersections."""
        return self.corridors and self.corridors.turns

    @property
    def keyframe_time(self) -> Array:
        """When the poses x0, x1, … are ``(k + 1,)``. [s]"""
        return self.pieces.keyframe_time

    def initial_values(self) -> gtsam.Values:
        """Where the optimiser starts, as GTSAM has it: x0… of Pose2, c0… of (R_s, R_d, b), and the rest."""
        return self.start.to_values()

    @property
    def segment_first(self) -> Index:
        """The first interval of each calibration segment ``(s,)``."""
        return np.flatnonzero(np.diff(self.segment, prepend=-1))

    def error(self, values: gtsam.Values) -> float:
        """The cost at ``values``: half the sum of squared, robustly weighted errors, as GTSAM counts it."""
        return self.evaluate(values).cost + self.native.error(values)

    def linearize(self, values: gtsam.Values, own: Evaluation | None = None) -> gtsam.GaussianFactorGraph:
        """All factors at ``values``, whitened, as GTSAM's linear graph; ``own`` if already evaluated there."""
        own = own or self.evaluate(values)
        graph = self.native.linearize(values)
        noise = gtsam.noiseModel.Unit.Create(3)
        pdr = own.pdr
        for x, c, by_i, by_j, by_c, b in zip(*self.keys, pdr.by_i, pdr.by_j, pdr.by_c, -pdr.value, strict=True):
            graph.add(x, by_i, x + 1, by_j, c, by_c, b, noise)
        for rows in own.observed:
            rows.add_to(graph)
        if own.turns is not None:
            self._linearize_turns(graph, own, own.turns)
        if own.springs is not None:
            self._linearize_walls(graph, own, np.flatnonzero(own.springs[0]))
        return graph

    def to_gtsam(self) -> gtsam.NonlinearFactorGraph:
        """The whole graph for GTSAM's own optimisers, with a guarded ``CustomFactor`` for each own factor."""
        return as_gtsam(self)

    def _linearize_walls(self, graph: gtsam.GaussianFactorGraph, own: Evaluation, pressed: Index) -> None:
        """Of the pieces that walls press, one factor for each interval."""
        wall = own.wall_of(pressed)
        error, by_i, by_j, by_c = -wall.value[:, 0], wall.by_i[:, 0], wall.by_j[:, 0], wall.by_c[:, 0]
        interval, first = np.unique(self.pieces.interval[pressed], return_index=True)
        ends = [*first[1:].tolist(), len(pressed)]
        for i, a, b in zip(interval.tolist(), first.tolist(), ends, strict=False):
            x, c, noise = self.keys[0][i], self.keys[1][i], gtsam.noiseModel.Unit.Create(b - a)
            graph.add(x, by_i[a:b], x + 1, by_j[a:b], c, by_c[a:b], error[a:b], noise)

    def _linearize_turns(self, graph: gtsam.GaussianFactorGraph, own: Evaluation, turns: Turns) -> None:
        """Of turns beyond their range, and of those outside their intersection."""
        (value, slope), corner = own.turned, own.corner
        assert corner is not None
        noise = gtsam.noiseModel.Unit.Create(1)
        for n in np.flatnonzero(value):
            by_after = np.array([[0.0, 0.0, slope[n]]])
            graph.add(X(int(turns.before[n])), -by_after, X(int(turns.after[n])), by_after, -value[n : n + 1], noise)
        noise = gtsam.noiseModel.Unit.Create(4)
        for n in np.flatnonzero(corner.value.any(axis=1)):
            x, c = (keys[self.pieces.interval[turns.piece[n]]] for keys in self.keys)
            graph.add(x, corner.by_i[n], x + 1, corner.by_j[n], c, corner.by_c[n], -corner.value[n], noise)

    def turned(self, angle: float) -> WalkGraph:
        """The same measurements, started ``angle`` [rad] further round the fixes and loosely held there."""
        other = copy(self)
        other.start = self.start.turned(angle, self._pivot(self.start))
        other.native = other._native_factors()
        return other

    def following(self, start: State, stray: Array | float = STRAY, alike: float = 1.0) -> WalkGraph:
        """The same measurements, started at ``start``: its rooms and corridors are those of the walk.

        stray: by how much it errs, everywhere or at each piece's end ``(m,)`` [m]; alike: pieces in a row that do.
        """
        other = copy(self)
        other.start, way = start, self._evaluated(start)
        if self.walled:
            other.walls = self._walls_along(way, stray, alike)
            other.corridors = self._corridors_along(way, start)
        other.native = other._native_factors()
        return other

    def without_walls(self) -> WalkGraph:
        """The same measurements without the plan."""
        other = copy(self)
        other.walled, other.walls, other.corridors = False, None, None
        if self.corridors:
            other.native = other._native_factors()
        return other

    def with_loose_walls(self, times: float) -> WalkGraph:
        """The same measurements, walls ``times`` as loose."""
        assert self.walls is not None, "there is a plan"
        other = copy(self)
        other.walls = replace(self.walls, sigma=times * self.walls.sigma)
        return other

    def with_closures(self, hold: str) -> WalkGraph:
        """The same measurements; closures are right (FIRM), may be mistaken (DOUBTED), or are left out (UNBOUND)."""
        other = copy(self)
        other.closure_hold = hold
        return other

    def with_offsets(self, wild: Mask, held: Mask) -> WalkGraph:
        """The same measurements; fixes in the mask ``wild (f,)`` lose their hold the further off they are, those not
        in ``held (f,)`` have none, and those of one source share an offset, instead of each counting for less. Fixes
        that only told where to start are let go.
        """
        other = copy(self)
        other.fix_wild = wild
        other.fix_held = held & (not self.by_proximity)
        shared, sigma = other.fix_held & (self.prior.fix_flat == 0), self.fix_sigma
        other.receivers = receivers(self.fixes, shared, sigma, self.fix_keyframe, self.velocity, self.steps)
        nodes = 0 if other.receivers is None else len(other.receivers.keep)
        other.start = replace(self.start, g=np.zeros((nodes, 3)))
        other.native = other._native_factors()
        return other

    def with_beacons_elsewhere(self, which: list[int]) -> WalkGraph:
        """The same measurements; nobody knows where those beacons are."""
        assert self.levels is not None, "there are beacons"
        other = copy(self)
        other._place_beacons(self.levels.elsewhere(which))
        return other

    def fix_distance(self, values: gtsam.Values) -> Array:
        """Distance ``(f,)`` [m] of each fix from the walk at its time."""
        return np.hypot(*(State.of(values).poses[self.fix_keyframe, :2] - self.fixes.position).T)

    def fix_weight(self, values: gtsam.Values) -> Array:
        """The share ``(f,)`` of each fix's information that is used."""
        sigmas = self.fix_distance(values) / self.fix_sigma
        flat = self.prior.fix_flat
        gripped = outside(sigmas, flat) if flat else gripping(sigmas, HUBER_WIDTH)
        weight = np.where(self.fix_wild, slipping(sigmas), gripped)
        if self.receivers is not None:
            weight[self.receivers.fix] = self.observed(values)[0].weight
        return np.where(self.fix_held, weight, 0.0)

    def _priors(self, others: Sequence[tuple[float, Prior]]) -> dict[int, Prior]:
        """What is believed of the segments with which a walk begins."""
        time = np.array([time for time, _ in others])
        first = self.segment[np.searchsorted(self.pieces.keyframe_time[:-1], np.round(time, DECIMALS))]
        return {0: self.prior, **dict(zip(first.tolist(), (prior for _, prior in others), strict=True))}

    def _usual_c(self) -> Array:
        """The calibration of each segment ``(s, 3)`` as it is believed to be."""
        begins = np.array(sorted(self.priors))
        means = np.array([self.priors[s].mean for s in begins.tolist()])
        return means[np.searchsorted(begins, np.arange(self.segment[-1] + 1), side="right") - 1]

    def _place_beacons(self, levels: Levels) -> None:
        """Start with the beacons where they are believed to be."""
        self.levels = levels
        self.believed = levels.prior(self.start.poses[self.level_keyframe, :2])
        self.start = replace(self.start, b=self.believed, q=LOSS[None])

    def _lay_on_fixes(self, heading: Array) -> tuple[State, float]:
        """The start: the dead-reckoned track, of headings ``(k + 1,)``, laid on the fixes; and how well these determine
        its direction [rad].
        """
        track, used = self.track, self.fix_believed
        at, sigma = self.fix_keyframe[used], self.fix_sigma_together[used]
        fix = as_complex(self.fixes.position[used])
        uncertain = sigma_direction(track[at], sigma, float(np.sum(self.pieces.length)))

        c = self._usual_c()
        if len(fix) < 2:
            track = track + (fix - track[at] if len(fix) else 0.0)
            return State(np.stack([track.real, track.imag, heading], axis=1), c), uncertain
        laid = align(track, np.append(self.segment[:1], self.segment), at, fix, sigma, *self._gaps())
        if uncertain < AMBIGUOUS:
            c[:, 0] = np.clip(laid.scale, *(c[:, 0] + np.array([[-2], [2]]) * self.prior.sigma[0]))
        poses = np.stack([laid.position.real, laid.position.imag, heading + laid.turned], axis=1)
        return State(poses, c), uncertain

    def _pointed(self, start: State, uncertain: float) -> tuple[State, float]:
        """The start turned as the headings say, if they know the direction better than the fixes; how well then."""
        if not len(self.headings):
            return start, uncertain
        weight = self.headings.sigma**-2.0
        sigma = float(weight.sum() ** -0.5)
        if sigma > uncertain:
            return start, uncertain
        apart = wrap_angle(self.headings.heading - start.poses[self.heading_keyframe, 2])
        turn = float(np.angle(np.sum(weight * np.exp(1j * apart))))
        return start.turned(turn, self._pivot(start)), sigma

    def _reach(self) -> tuple[Array, Array]:
        """South-west and north-east corner ``(2,)`` [m] of where the walk can have been."""
        place, at = self.fixes.position[self.fix_used], np.append(self.pieces.first, len(self.pieces.length))
        walked = np.append(0.0, np.cumsum(self.pieces.length))[at]
        at_fixes = np.sort(walked[self.fix_keyframe[self.fix_used]])
        to_fix = np.abs(walked - at_fixes[nearest(at_fixes, walked)])
        gaps = float(np.sum(self.steps.sigma_length[self.steps.length == 0]))
        reach = LONGER * (to_fix.max() + gaps + self.fix_sigma[self.fix_used].max()) + BEYOND
        return place.min(axis=0) - reach, place.max(axis=0) + reach

    def _pivot(self, start: State) -> Array:
        """The point ``(2,)`` about which the fixes let a start be turned. [m]"""
        held = self.fix_keyframe[self.fix_believed] if self.fix_used.any() else [0]
        return start.poses[held, :2].mean(axis=0)

    def _gaps(self) -> tuple[Array, Array]:
        """How far the walker may have gone unrecorded from each segment to the next ``(s - 1,)`` [m], and how little is
        known of their turn meanwhile [rad].
        """
        lost = np.flatnonzero(self.steps.length == 0)
        begins = self.pieces.keyframe_time[self.segment_first[1:]]
        after = np.searchsorted(begins, np.round(self.steps.time[lost], DECIMALS))
        inside = after < len(begins)  # after a gap with which the recording ends there is no segment
        gap, turn = np.zeros((2, len(begins)))
        for total, sigma in ((gap, self.steps.sigma_length), (turn, self.steps.sigma_turn)):
            np.maximum.at(total, after[inside], sigma[lost[inside]])
        return gap, turn

    def _walls_along(self, way: Evaluation, stray: Array | float = STRAY, alike: float = 1.0) -> Walls:
        """The walls about the steps where they lead along a way."""
        assert self.ground is not None, "there is a plan"
        walls = self.ground.walls_along(way.ends[:, :2], self.pieces.length > 0, stray, alike)
        return Walls(*walls, self.prior.wall_margin, self.prior.wall_sigma)

    def _corridors_along(self, way: Evaluation, state: State) -> Corridors | None:
        """The turns and straight runs of the steps along a way, that of ``state``."""
        assert self.ground is not None, "there is a plan"
        use = self.prior.corridors
        if not (use.turns or use.directions):
            return None
        return corridors_along(self.ground, self.pieces, way.poses.value, state.poses[:, 2], use)

    def _evaluated(self, state: State, walls: Walls | None = None, turns: Turns | None = None) -> Evaluation:
        ends = state.poses[:-1], state.poses[1:]
        return evaluate(self.pieces, self.bridge, *ends, state.c[self.segment], walls, turns)

    def _observed(self, state: State) -> tuple[Rows, ...]:
        """The own factors of keyframes, but for steps and walls."""
        rows: list[Rows] = []
        if self.receivers is not None:
            rows += [self.receivers.seen(state.poses, state.g, self.fix_wild), *self.receivers.kept(state.g)]
        if self.levels is not None:
            rows += [self.levels.heard(self.level_keyframe, state.poses, state.b, state.q[0])]
            rows += self.levels.believed(self.believed, state.b, state.q[0])
        if len(self.closures) and self.closure_hold != UNBOUND:
            rows += [self.closures.seen(self.closure_keyframe, state.poses, self.closure_hold == FIRM)]
        return tuple(rows)

    def _native_factors(self) -> gtsam.NonlinearFactorGraph:
        """Fixes, headings, calibration, and a loose hold on the first heading for when nothing else determines it."""
        graph, prior, flat = gtsam.NonlinearFactorGraph(), self.prior, self.prior.fix_flat
        alone, sigma = self.fix_held.copy(), self.fix_sigma if flat else self.fix_sigma_together
        if self.receivers is not None:
            alone[self.receivers.fix] = False
        for n in np.flatnonzero(alone):
            keyframe, position = int(self.fix_keyframe[n]), self.fixes.position[n]
            graph.add(native.fix_factor(keyframe, position, sigma[n], bool(self.fix_wild[n]), flat))
            if flat:  # or nothing would hold a walk of which all fixes are near enough
                loosely = gtsam.noiseModel.Isotropic.Sigma(2, LOOSELY * self.fix_sigma_together[n])
                graph.add(gtsam.PoseTranslationPrior2D(X(keyframe), position, loosely))

        for s in range(int(self.segment[-1]) + 1):
            own = self.priors.get(s)
            believed = own and native.calibration_factor(s, np.array(own.mean), own.covariance)
            graph.add(believed or native.change_factor(s, prior.change))

        told = [(self.heading_keyframe, self.headings)]
        told += [(self.corridors.keyframe, self.corridors.direction)] if self.corridors else []
        for at, headings in told:
            for k, heading, sigma in zip(at.tolist(), headings.heading, headings.sigma, strict=True):
                graph.add(native.heading_factor(k, heading, sigma))

        heading = float(self.start.poses[0, 2])
        if self.fix_used.any():
            graph.add(native.hold_factor(0, heading, ANY_HEADING))
        else:
            size = FRAME_SIGMA if self.ground is None else self.ground.size
            turn = FRAME_SIGMA if self.ground is None and not len(self.headings) else ANY_HEADING
            graph.add(native.start_factor(0, np.array([0.0, 0.0, heading]), (size, size, turn)))
        return graph


def _check(
    steps: Steps,
    fixes: Fixes | None,
    headings: Headings | None,
    floor: FloorPlan | Building | None,
    prior: Prior | None,
) -> None:
    """Raise on arguments of other kinds, and on fixes that are not in metres."""
    expect("WalkGraph, steps", steps, Steps, instead="detect_steps(recording)")
    expect("WalkGraph, fixes", fixes, Fixes, None, instead="read_fixes(path, recording, frame)")
    expect("WalkGraph, headings", headings, Headings, None, instead="magnetic_headings(recording, frame, near)")
    expect("WalkGraph, floor", floor, FloorPlan, Building, None, instead="FloorPlan.load(path)")
    expect("WalkGraph, prior", prior, Prior, None)
    if fixes is not None and fixes.epsg is not None and len(fixes):
        needed = "metres: floor.frame.place(fixes), or frame_of(fixes).place(fixes) without a plan"
        raise ValueError(f"WalkGraph, fixes: found those of EPSG:{fixes.epsg}, needed {needed}")


def _track(delta: Array) -> tuple[Complex, Array]:
    """Keyframes ``(k + 1,)`` as complex numbers [m] and their headings [rad], of the increments between ``(k, 3)``."""
    heading = np.concatenate([[0.0], np.cumsum(delta[:, 2])])
    moves = (delta[:, 0] + 1j * delta[:, 1]) * np.exp(1j * heading[:-1])
    return np.concatenate([[0.0], np.cumsum(moves)]), heading


def _labels(floor: FloorPlan | Building | None, floors: Sequence[str] | None, rows: int) -> tuple[str, ...]:
    """The floor's label of each row."""
    if floors is not None:
        return tuple(floors)
    known = () if floor is None else Building.around(floor).labels
    if len(known) > 1:
        found = f"none, with the floors {', '.join(known)[:80]}"
        raise ValueError(f"WalkGraph, floors: found {found}, needed a label for each row, as of floors_of(…)")
    return (known[0] if len(known) == 1 else "",) * rows


def _freshness(fixes: Fixes, steps: Steps) -> tuple[Mask, Array]:
    """Which fixes are used, and their sigma: one shortly outside the recording holds at its end, less exactly."""
    overhang = np.maximum(np.maximum(steps.start - fixes.time, fixes.time - steps.end), 0.0)
    return overhang <= LONGEST_OVERHANG, np.hypot(fixes.sigma, WALKING_SPEED * overhang)


def _within(headings: Headings, steps: Steps) -> Headings:
    """The headings that were measured while the recording ran."""
    inside = (headings.time >= steps.start) & (headings.time <= steps.end)
    return Headings(headings.time[inside], headings.heading[inside], headings.sigma[inside])


def _segments(pieces: Pieces, steps: Steps) -> Index:
    """The calibration segment of each keyframe interval: equal shares of about a hundred steps, cut at gaps."""
    walked = np.searchsorted(steps.time, pieces.keyframe_time[:-1])
    count = max(1, round(len(steps) / STEPS_PER_SEGMENT))
    segment = np.minimum(walked * count // max(len(steps), 1), count - 1)
    gaps = np.searchsorted(np.round(steps.time[steps.length == 0], DECIMALS), pieces.keyframe_time[:-1], side="right")
    return np.unique(segment + gaps, return_inverse=True)[1]
