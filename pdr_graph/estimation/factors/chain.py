"""The chain of keyframes: steps preintegrated between them, and the poses of the steps at one state of the variables.

A walk is cut into *pieces* at every step's end, at both ends of every pause, and at every keyframe (a fix has its own
time: the step that it falls into is split linearly). The pieces between two keyframes i and j are preintegrated into
one increment in the frame of x_i, exact in the calibration c = (R_s, R_d, b), after k of them:

    Δp_k(c) = Σ_{m≤k} R_s l_m e(R_d turn_m + b time_m)      turn and time from x_i to the middle of piece m
    Δθ_k(c) = R_d turn_k + b time_k                          turn and time from x_i to the end of piece k

which is the papers' recursion ([heading] Sec. 1; [calibration-walk] Eqs. (8), (9)). Everything is one flat array
over the pieces of the whole walk, so that all keyframes are evaluated at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import cos, sin

import numpy as np
from numpy.typing import NDArray

from pdr_graph.estimation.factors.base import CALIBRATION, POSE, FactorBlock, Linearized, Measurement, State, poses_at
from pdr_graph.geometry import nearest, peaks, pose_rotation, rotation, wrap_angle
from pdr_graph.priors import MOTION, RECEIVERS, STEP, TREADS
from pdr_graph.types import INSTANT, Array, Complex, Index, Steps

DECIMALS = 6  # of time [s]: see INSTANT
CLOSE = 2 * INSTANT  # [s] within which two times are the same, since times are rounded to DECIMALS
SIGMA_STILL = 0.002  # [m] of any piece; keeps covariances invertible where nobody moved
VELOCITY_OVER = 2.0  # [s] over which the velocity of the walk is averaged


@dataclass(frozen=True)
class Pieces:
    """The pieces of a walk: ``m`` pieces in ``k`` intervals between ``k + 1`` keyframes.

    length: ``(m,)`` [m].
    to_middle, to_end: ``(2, m)`` turn [rad] and time [s] from the interval's start to the piece's middle and end.
    variance: ``(m, 2)`` of the displacement along, which is that across [m²], and of the turn [rad²].
    interval: ``(m,)`` the interval of each piece; first, last: ``(k,)`` the pieces of each interval.
    keyframe_time: ``(k + 1,)`` [s].
    row_end: ``(n + 1,)`` the piece that ends at each row of the trajectory after the first.
    """

    length: Array
    to_middle: Array
    to_end: Array
    variance: Array
    interval: Index
    first: Index
    last: Index
    keyframe_time: Array
    row_end: Index

    def running(self, per_piece: NDArray[np.floating]) -> Array:
        """Sums ``(…, m)`` of quantities per piece ``(…, m)``, from the interval's start to each piece's end."""
        total = np.cumsum(per_piece, axis=-1)
        before = (total - per_piece)[..., self.first]
        return total - before[..., self.interval]

    def between(self, begin: int, end: int | None = None) -> Pieces:
        """The intervals from number ``begin`` to before ``end``, by default to the last; without the rows' ends."""
        end = len(self.first) if end is None else end
        first, after = np.append(self.first, len(self.length))[[begin, end]]
        here = slice(first, after)
        return Pieces(
            length=self.length[here],
            to_middle=self.to_middle[:, here],
            to_end=self.to_end[:, here],
            variance=self.variance[here],
            interval=self.interval[here] - begin,
            first=self.first[begin:end] - first,
            last=self.last[begin:end] - first,
            keyframe_time=self.keyframe_time[begin : end + 1],
            row_end=np.empty(0, dtype=np.intp),
        )

    @classmethod
    def none(cls, time: float) -> Pieces:
        """No intervals: a single keyframe at a time [s]."""
        none, numbers = np.empty(0), np.empty(0, dtype=np.intp)
        turns = np.empty((2, 0))
        return cls(none, turns, turns, np.empty((0, 2)), numbers, numbers, numbers, np.array([time]), numbers)

    @classmethod
    def together(cls, parts: Sequence[Pieces]) -> Pieces:
        """Concatenate intervals that follow one another; without rows of a trajectory."""
        sizes = np.concatenate([part.last + 1 - part.first for part in parts])
        last = np.cumsum(sizes) - 1
        return cls(
            length=np.concatenate([part.length for part in parts]),
            to_middle=np.concatenate([part.to_middle for part in parts], axis=1),
            to_end=np.concatenate([part.to_end for part in parts], axis=1),
            variance=np.concatenate([part.variance for part in parts]),
            interval=np.repeat(np.arange(len(sizes)), sizes),
            first=last + 1 - sizes,
            last=last,
            keyframe_time=np.concatenate([parts[0].keyframe_time[:1], *(part.keyframe_time[1:] for part in parts)]),
            row_end=np.empty(0, dtype=np.intp),
        )


def cut(steps: Steps, whole: Array, at: Array) -> Pieces:
    """Cut a walk into pieces, with a keyframe at the start, the end and each of the times ``at`` [s] within.

    whole: `whole_pieces` of the steps. Between these keyframes, one follows at least every
    ``MOTION.steps_per_keyframe`` pieces.
    """
    start = round(steps.start, DECIMALS)
    required = np.round(np.clip(np.append(at, steps.end), start, steps.end), DECIMALS)
    required = np.unique(required[required > start]).astype(float)

    end = np.union1d(whole[:, 0], required).astype(float)
    interval, first = _intervals(np.searchsorted(required, end))
    row_end = np.searchsorted(end, np.round(np.append(steps.time, steps.end), DECIMALS))
    return parts_of(whole, start, end, interval, first, row_end)


def pace_changes(whole: Array, start: float, begins: bool = True) -> tuple[Array, Array]:
    """Times ``(k,)`` [s] at which the walker changes pace, and logarithms ``(k,)`` of how much longer steps last then.

    whole: ``(m, ≥4)``, see `whole_pieces`; start: of the first piece [s]. Stairs change the pace, but not the length of
    their treads. Between walk and run the change counts several times as much; begins: True if a run there is one too.
    """
    n, duration = MOTION.pace_steps, np.diff(whole[:, 0], prepend=start)
    step = np.flatnonzero((whole[:, 1] > 0) & (whole[:, 3] != TREADS.sigma**2))
    if len(step) < 2 * n:
        return np.empty(0), np.empty(0)
    windows = np.arange(len(step) - n + 1)[:, None] + np.arange(n)
    ordered = np.sort(np.array([np.log(duration[step]), whole[step, 1] / duration[step]])[:, windows], axis=2)
    pace, speed = (ordered[:, :, (n - 1) // 2] + ordered[:, :, n // 2]) / 2  # medians
    runs = speed > MOTION.run_speed
    change = pace[n:] - pace[:-n]  # between steps n - 1 and n, n and n + 1, …
    at = peaks(np.abs(change), MOTION.pace_change, n)
    change = np.where(runs[n:] != runs[:-n], MOTION.run_change, 1.0) * change
    at, change = n + at, change[at]
    if begins and runs[0] and n not in at:
        at, change = np.append(n, at), np.append(MOTION.run_change * (pace[0] - np.log(STEP.usual)), change)
    return np.append(start, whole[:, 0])[step[at]], change


def intervals(whole: Array, start: float, begin: float, ends: Array) -> Pieces:
    """The parts of the pieces ``whole`` between keyframes at ``begin`` and ``ends (k,)`` [s], in order.

    start: start of the first whole piece [s].
    """
    within = whole[(whole[:, 0] > begin) & (whole[:, 0] < ends[-1]), 0]
    end = np.union1d(within, ends).astype(float)
    interval = np.searchsorted(ends, end)
    first = np.flatnonzero(np.diff(interval, prepend=-1))
    return parts_of(whole, start, end, interval, first, np.empty(0, dtype=np.intp), begin)


def parts_of(
    whole: Array, start: float, end: Array, interval: Index, first: Index, row_end: Index, begin: float | None = None
) -> Pieces:
    """Pieces that end at ``end (m,)`` [s], each a share of one whole piece; the first from ``begin``, or ``start``."""
    begins = np.append(start if begin is None else begin, end[:-1])
    of = np.searchsorted(whole[:, 0], end)
    share = (end - begins) / np.diff(whole[:, 0], prepend=start)[of]
    length, turn = whole[of, 1] * share, whole[of, 2] * share
    last = np.append(first[1:], len(end)) - 1
    empty, keyframe_time = np.empty((2, 0)), np.append(begins[0], end[last])
    variance = whole[of, 3:5] * share[:, None]
    pieces = Pieces(length, empty, empty, variance, interval, first, last, keyframe_time, row_end)
    turn_and_time = np.stack([turn, end - begins])
    to_end = pieces.running(turn_and_time)
    return replace(pieces, to_end=to_end, to_middle=to_end - turn_and_time / 2)


def whole_pieces(steps: Steps) -> Array:
    """Pauses and steps before any split ``(m, 5)``; the last row is the pause until the end of the recording.

    Columns: end [s], length [m], turn [rad], variances of the displacement along, which is that across [m²], and of the
    turn [rad²].
    """
    n = len(steps)
    rows = np.zeros((2 * n + 1, 5))
    pauses, moves = rows[0:-1:2], rows[1::2]
    pauses[:, 0], pauses[:, 2] = steps.time - steps.duration, steps.pause_turn
    moves[:, :3] = np.stack([steps.time, steps.length, steps.turn - steps.pause_turn], axis=1)
    moves[:, 3:] = np.stack([steps.sigma_length, steps.sigma_turn], axis=1) ** 2
    rows[-1, :3] = steps.end, 0.0, steps.final_turn
    rows[0::2, 4] = MOTION.standing_turn**2
    rows[:, 0] = np.round(rows[:, 0], DECIMALS)
    return rows[np.diff(rows[:, 0], prepend=round(steps.start, DECIMALS)) > 0]


def _intervals(gap: Index) -> tuple[Index, Index]:
    """Split the pieces between required keyframes into equal intervals: interval of each piece, first pieces.

    gap: ``(m,)`` number of the span between required keyframes that each piece lies in, 0, 0, 1, …
    """
    size = np.bincount(gap)
    starts = np.concatenate([[0], np.cumsum(size)[:-1]])
    parts = -(-size // MOTION.steps_per_keyframe)
    offset = np.concatenate([[0], np.cumsum(parts)[:-1]])
    within = np.arange(len(gap)) - starts[gap]
    interval = offset[gap] + within * parts[gap] // size[gap]
    return interval, np.flatnonzero(np.diff(interval, prepend=-1))


def dead_reckoned(delta: Array) -> tuple[Complex, Array]:
    """Keyframes ``(k + 1,)`` as complex numbers [m], and headings ``(k + 1,)`` [rad], of the moves ``(k, 3)``."""
    heading = np.concatenate([[0.0], np.cumsum(delta[:, 2])])
    moves = (delta[:, 0] + 1j * delta[:, 1]) * np.exp(1j * heading[:-1])
    return np.concatenate([[0.0], np.cumsum(moves)]), heading


@dataclass(frozen=True)
class Increments:
    """Partial sums Δ_k(c) to the end of each piece, in the frame of its interval's start.

    delta: ``(m, 3)`` x, y [m], heading [rad]; by_c: ``(m, 3, 3)`` derivative by (R_s, R_d, b).
    """

    delta: Array
    by_c: Array


def preintegrate(pieces: Pieces, c: Array) -> Increments:
    """Δ_k(c) of every piece. c: ``(k, 3)`` R_s, R_d, b of each interval."""
    R_s, R_d, b = c[pieces.interval].T
    turn, time = pieces.to_middle
    course = R_d * turn + b * time
    per_piece = np.empty((2, 3, len(course)))  # of x and y, derivatives by R_s, R_d and b
    per_piece[0, 0], per_piece[1, 0] = pieces.length * np.cos(course), pieces.length * np.sin(course)
    per_piece[:, 1] = R_s * per_piece[::-1, 0]
    per_piece[0, 1] *= -1
    per_piece[:, 2] = per_piece[:, 1] * time
    per_piece[:, 1] *= turn
    turn, time = pieces.to_end
    by_c = np.zeros((len(course), 3, 3))
    by_c[:, :2] = pieces.running(per_piece).transpose(2, 0, 1)
    by_c[:, 2, 1], by_c[:, 2, 2] = turn, time
    delta = R_s[:, None] * by_c[:, :, 0]
    delta[:, 2] = R_d * turn + b * time
    return Increments(delta, by_c)


@dataclass(frozen=True)
class Bridge:
    """How the error of an interval is distributed over its pieces.

    root: ``(k, 3, 3)`` W with WᵀW = Q⁻¹, Q the covariance of the whole increment.
    gain: ``(m, 3, 3)`` G_k = Cov(Δ_k, Δ_K) Q⁻¹: the expected share of the whole interval's error after piece k.
    spread: ``(m, 3, 3)`` covariance of Δ_k given both ends.
    """

    root: Array
    gain: Array
    spread: Array

    @classmethod
    def none(cls) -> Bridge:
        """The bridge of a chain without intervals."""
        return cls(*(np.empty((0, 3, 3)) for _ in range(3)))

    @classmethod
    def together(cls, parts: Sequence[Bridge]) -> Bridge:
        """Concatenate the bridges of intervals that follow one another."""
        columns = zip(*((part.root, part.gain, part.spread) for part in parts), strict=True)
        return cls(*(np.concatenate(column) for column in columns))


def bridge(pieces: Pieces, increments: Increments) -> Bridge:
    """Covariances of the partial sums, by first-order propagation of each piece's displacement and turn.

    A turn error δθ made half-way through a piece, at u, swings all that follows: δp_k = J (Δp_k − u) δθ, J = +90°.
    Hence with s the turn's variance and A_k the sum of the displacements' variances, times the unit matrix,

        Cov(p_k, p_o) = A_k + J [ Σs p_k p_oᵀ − p_k Σ(s u)ᵀ − Σ(s u) p_oᵀ + Σ(s u uᵀ) ] Jᵀ
        Cov(p_k, θ) = J [ Σs p_k − Σ(s u) ],      Cov(θ, θ) = Σs

    with all sums over the pieces up to k, for any o that ends no earlier.
    """
    x, y = increments.delta[:, :2].T
    covariance = _covariance_with(pieces, x, y)
    at_piece = covariance(x, y)
    end = pieces.last[pieces.interval]
    cross = covariance(x[end], y[end])
    inverse = np.linalg.inv(at_piece[pieces.last])
    gain = cross @ inverse[pieces.interval]
    return Bridge(
        root=np.linalg.cholesky(inverse).transpose(0, 2, 1).astype(float),
        gain=gain,
        spread=at_piece - gain @ cross.transpose(0, 2, 1),
    )


def increment_covariance(pieces: Pieces, increments: Increments) -> Array:
    """Covariance ``(k, 3, 3)`` of the whole increment of each interval, see `bridge`."""
    x, y = increments.delta[:, :2].T
    return _covariance_with(pieces, x, y)(x, y)[pieces.last]


def increment(whole: Array, start: float, begin: float, end: float, c: Array) -> tuple[Array, Array, Array]:
    """The increment of the parts of pieces ``whole`` between two times [s], by plain numbers: for a few pieces.

    start: of the first whole piece [s]; c: ``(3,)``. Returns Δ ``(3,)``, its derivative by c ``(3, 3)`` and its
    covariance ``(3, 3)``, as `preintegrate` and `increment_covariance` do.
    """
    R_s, R_d, b = c.tolist()
    first, last = np.searchsorted(whole[:, 0], (begin, end), side="right").tolist()
    rows = whole[first : last + (last == first or whole[last - 1, 0] < end) * (last < len(whole))].tolist()
    before = float(whole[first - 1, 0]) if first else start
    x = y = by_turn_x = by_turn_y = by_time_x = by_time_y = turned = elapsed = xx = xy = 0.0
    swings = list[tuple[float, float, float]]()  # position half-way through each piece, and the variance of its turn
    for until, length, turn, of_displacement, of_turn, *_ in rows:
        if until <= before:  # ends with the piece before it
            continue
        share = (min(until, end) - max(before, begin)) / (until - before)
        seconds = min(until, end) - max(before, begin)
        before, moved, turn = until, length * share, turn * share
        middle_turn, middle_time = turned + turn / 2, elapsed + seconds / 2
        course = R_d * middle_turn + b * middle_time
        move_x, move_y = moved * cos(course), moved * sin(course)
        swings.append((R_s * (x + move_x / 2), R_s * (y + move_y / 2), of_turn * share))
        x, y, turned, elapsed = x + move_x, y + move_y, turned + turn, elapsed + seconds
        by_turn_x, by_turn_y = by_turn_x - middle_turn * move_y, by_turn_y + middle_turn * move_x
        by_time_x, by_time_y = by_time_x - middle_time * move_y, by_time_y + middle_time * move_x
        xx += of_displacement * share + SIGMA_STILL**2
    yy, x_theta, y_theta, theta = xx, 0.0, 0.0, 0.0
    for middle_x, middle_y, of_turn in swings:
        left, ahead = R_s * y - middle_y, R_s * x - middle_x  # a turn moves the end by (−left, ahead)
        xx, xy, yy = xx + of_turn * left * left, xy - of_turn * left * ahead, yy + of_turn * ahead * ahead
        x_theta, y_theta, theta = x_theta - of_turn * left, y_theta + of_turn * ahead, theta + of_turn
    by_c = np.array(
        [[x, R_s * by_turn_x, R_s * by_time_x], [y, R_s * by_turn_y, R_s * by_time_y], [0, turned, elapsed]]
    )
    covariance = np.array([[xx, xy, x_theta], [xy, yy, y_theta], [x_theta, y_theta, theta]])
    return np.array([R_s * x, R_s * y, R_d * turned + b * elapsed]), by_c, covariance


def _covariance_with(pieces: Pieces, x: Array, y: Array) -> Callable[[Array, Array], Array]:
    """The function that returns Cov(Δ_k, Δ_o) ``(m, 3, 3)`` of each piece k, at x, y, with a piece at ``o``."""
    move_x, move_y = x.copy(), y.copy()
    move_x[1:] -= x[:-1]
    move_y[1:] -= y[:-1]
    move_x[pieces.first], move_y[pieces.first] = x[pieces.first], y[pieces.first]
    u_x, u_y = x - move_x / 2, y - move_y / 2
    s = pieces.variance[:, 1]
    swings = (s, s * u_x, s * u_y, s * u_x * u_x, s * u_x * u_y, s * u_y * u_y)
    A, S, Su_x, Su_y, Su_xx, Su_xy, Su_yy = pieces.running(np.array([pieces.variance[:, 0] + SIGMA_STILL**2, *swings]))

    def covariance(o_x: Array, o_y: Array) -> Array:
        """Cov(Δ_k, Δ_o) ``(m, 3, 3)`` of each piece k with a piece at ``o`` that ends no earlier."""
        xx = A + S * y * o_y - y * Su_y - Su_y * o_y + Su_yy
        xy = y * Su_x + Su_y * o_x - S * y * o_x - Su_xy
        yx = x * Su_y + Su_x * o_y - S * x * o_y - Su_xy
        yy = A + S * x * o_x - x * Su_x - Su_x * o_x + Su_xx
        columns = [xx, xy, Su_y - S * y, yx, yy, S * x - Su_x, Su_y - S * o_y, S * o_x - Su_x, S]
        return np.ascontiguousarray(np.array(columns).T).reshape(-1, 3, 3)

    return covariance


Priors = frozenset[tuple[str, int]]  # names of blocks, and numbers of the factors in them


@dataclass(frozen=True)
class Chain:
    """Keyframes, and the steps between them, cut into pieces.

    pieces, bridge: of the ``k`` intervals; delta: ``(k, 3)`` displacement of each, x, y [m], heading [rad], with the
    prior mean of the calibration; segment: ``(k,)`` the calibration of each, as row of the state.
    number: ``(k + 1,)`` of each keyframe, segment_number: ``(s,)`` of each calibration, in GTSAM's keys; begins,
    ends: True if the walk begins or ends with this chain; led, came: `lead` [m] and `velocity` [m/s] of its first
    keyframe, x forward;
    heading: ``(k + 1,)`` of the keyframes by an estimate [rad], None before there is one; pace: ``(s,)`` by how much
    longer steps last from the beginning of each segment on, see `pace_changes`.
    """

    pieces: Pieces
    bridge: Bridge
    delta: Array
    segment: Index
    number: Index
    segment_number: Index
    pace: Array
    begins: bool = True
    ends: bool = True
    led: complex = 0.0
    came: complex = 0.0
    heading: Array | None = None

    @classmethod
    def of(cls, pieces: Pieces, segment: Index, c: Array, pace: Array) -> Chain:
        """A chain whose variables are numbered 0, 1, …; c: ``(s, 3)`` prior means."""
        increments = preintegrate(pieces, c[segment])
        delta = increments.delta[pieces.last]
        numbers = np.arange(len(segment) + 1), np.arange(segment[-1] + 1)
        return cls(pieces, bridge(pieces, increments), delta, segment, *numbers, pace)

    @classmethod
    def keyframe_alone(cls, time: float, number: int, segment: int) -> Chain:
        """A chain of a single keyframe at a time [s], with no steps; segment: number of its calibration."""
        numbers = np.array([number]), np.array([segment])
        return cls(
            Pieces.none(time), Bridge.none(), np.empty((0, 3)), np.empty(0, dtype=np.intp), *numbers, np.zeros(1)
        )

    def after(self, first: int) -> Chain:
        """The part of the chain from keyframe ``first`` on, by its place in order."""
        m = self.pieces.first[first] if first < len(self.segment) else len(self.pieces.length)
        row = self.segment[first] if first < len(self.segment) else max(len(self.segment_number) - 1, 0)
        led, came = self.led, self.came
        if first:
            led, came = (complex(of[first] * np.exp(-1j * self.direction[first])) for of in (self.lead, self.velocity))
        return Chain(
            pieces=self.pieces.between(first),
            bridge=Bridge(self.bridge.root[first:], self.bridge.gain[m:], self.bridge.spread[m:]),
            delta=self.delta[first:],
            segment=self.segment[first:] - row,
            number=self.number[first:],
            segment_number=self.segment_number[row:],
            pace=self.pace[row:],
            begins=self.begins and first == 0,
            ends=self.ends,
            led=led,
            came=came,
            heading=None if self.heading is None else self.heading[first:],
        )

    @property
    def time(self) -> Array:
        """Times of the keyframes ``(k + 1,)``. [s]"""
        return self.pieces.keyframe_time

    @property
    def numbers(self) -> dict[str, Index]:
        """Numbers of the keyframes and the calibrations in their GTSAM keys, by symbol."""
        return {POSE: self.number, CALIBRATION: self.segment_number}

    @property
    def segment_first(self) -> Index:
        """The first interval of each calibration segment ``(s,)``."""
        return np.flatnonzero(np.diff(self.segment, prepend=-1))

    @cached_property
    def track(self) -> tuple[Complex, Array]:
        """Dead-reckoned keyframes ``(k + 1,)`` as complex numbers [m], and their headings ``(k + 1,)`` [rad]."""
        return dead_reckoned(self.delta)

    @cached_property
    def lead(self) -> Complex:
        """How far each keyframe ``(k + 1,)`` is ahead of its receiver, were that as slow as can be [m].

        Such a receiver states the mean of where it was, with weights exp(−Δt / STANDING). In the axes of `heading`.
        """
        turned, past = np.exp(1j * self.direction), np.diff(self.time) / RECEIVERS.standing
        weight = -np.expm1(-past) / np.maximum(past, INSTANT)
        moves, lead = (self.delta[:, 0] + 1j * self.delta[:, 1]) * turned[:-1] * weight, [self.led * turned[0]]
        for kept, moved in zip(np.exp(-past).tolist(), moves.tolist(), strict=True):
            lead.append(kept * lead[-1] + moved)
        return np.array(lead)

    @cached_property
    def velocity(self) -> Complex:
        """Mean velocity ``(k + 1,)`` over the VELOCITY_OVER before each keyframe, in the axes of `heading`. [m/s]

        Before the chain it is `came`: from a standstill, every part of a walk under way would begin without a lag.
        """
        turned = np.exp(1j * self.direction)
        moves = (self.delta[:, 0] + 1j * self.delta[:, 1]) * turned[:-1]
        way = np.cumsum(np.concatenate([[0.0, VELOCITY_OVER * self.came * turned[0]], moves]))
        time = np.append(self.time[0] - VELOCITY_OVER, self.time)
        return (way[1:] - np.interp(self.time - VELOCITY_OVER, time, way)) / VELOCITY_OVER

    @property
    def direction(self) -> Array:
        """Headings of the keyframes ``(k + 1,)`` by an estimate, else by dead reckoning. [rad]"""
        return self.track[1] if self.heading is None else self.heading

    def keyframe(self, time: Array) -> Index:
        """The keyframe nearest to each time [s]; −1 for times outside, unless the walk begins or ends there."""
        inside = self.begins | (time >= self.time[0] - 2 * INSTANT)
        inside = inside & (self.ends | (time <= self.time[-1] + 2 * INSTANT))
        return np.where(inside, nearest(self.time, time), -1)

    def evaluate(
        self, state: State, measurements: Sequence[Measurement] = (), priors: Priors | None = None
    ) -> Evaluation:
        """All factors at one state. priors: see `Evaluation`."""
        increments = preintegrate(self.pieces, state.c[self.segment])
        residual = step_residuals(state.poses[:-1], state.poses[1:], increments, self.pieces)
        return Evaluation(self, state, tuple(measurements), increments, residual, priors)


@dataclass(frozen=True)
class Path:
    """A path of the walk: pose ``(k, 3)`` at time ``(k,)`` [s]; c ``(s, 3)``: calibrations from ``begin (s,)`` on."""

    time: Array
    pose: Array
    begin: Array
    c: Array

    @classmethod
    def of(cls, chain: Chain, state: State) -> Path:
        """The path of the keyframes of a chain."""
        first = chain.segment_first
        return cls(chain.time, state.poses, chain.time[first], state.c[chain.segment[first]])

    def within(self, time: Sequence[float] | Array) -> Index:
        """Indices of the times [s], ascending, that it covers."""
        begin, end = np.searchsorted(time, (self.time[0] - CLOSE, self.time[-1] + CLOSE))
        return np.arange(begin, end)

    def poses(self, time: Array) -> Array:
        """Poses ``(n, 3)`` at times ``(n,)`` [s]."""
        return poses_at(time, self.time, self.pose)

    def calibration(self, time: float) -> Array:
        """(R_s, R_d, b) ``(3,)`` at a time [s]."""
        return self.c[max(int(np.searchsorted(self.begin, time)) - 1, 0)]

    @property
    def uniform(self) -> Path:
        """The path with its last calibration everywhere, which is the best informed."""
        return replace(self, begin=self.time[:1], c=self.c[-1:])

    def placed(self, chain: Chain, state: State) -> State:
        """The state of a chain with its keyframes on the path; those after its end are dead-reckoned."""
        within, poses, c = self.within(chain.time), state.poses.copy(), state.c.copy()
        poses[within] = self.poses(chain.time[within])
        moves = preintegrate(chain.pieces, np.tile(self.c[-1], (len(chain.segment), 1))).delta[chain.pieces.last]
        for n in range(int(within[-1]), len(moves)):
            poses[n + 1] = after(poses[n], moves[n])
        for n in np.flatnonzero(chain.time[:-1] >= self.time[0] - CLOSE).tolist():
            c[chain.segment[n]] = self.calibration(float(chain.time[n + 1]))
        return state.replaced(**{POSE: poses, CALIBRATION: c})


def after(pose: Array, move: Array) -> Array:
    """The pose ``(3,)`` after a displacement ``(3,)`` in its axes."""
    return pose + np.append(rotation(pose[2]) @ move[:2], move[2])


@dataclass(frozen=True)
class Evaluation:
    """The walk and its factors at one state.

    increments: of the pieces, at c; step_residual: of each interval, in metres and radians; see `step_residuals`.
    priors: those of variables that measurements add which hold, None for all of them: a window has those of variables
    that were new in it.
    """

    chain: Chain
    state: State
    measurements: tuple[Measurement, ...]
    increments: Increments
    step_residual: Linearized
    priors: Priors | None = None

    @property
    def pieces(self) -> Pieces:
        """The pieces of the walk."""
        return self.chain.pieces

    @property
    def pose_i(self) -> Array:
        """Poses ``(k, 3)`` at the start of each interval."""
        return self.state.poses[:-1]

    @cached_property
    def blocks(self) -> list[FactorBlock]:
        """All factors, kind by kind."""
        blocks = [block for measurement in self.measurements for block in measurement.factors(self)]
        if self.priors is None:
            return blocks
        priors = self.priors

        def held(block: FactorBlock) -> Index:
            return np.flatnonzero([(block.name, number) in priors for number in block.number.tolist()])

        return [block.only(held(block)) if block.prior else block for block in blocks]

    def forget_blocks(self) -> None:
        """Free the factors: their derivatives refer to this evaluation, and such circles would stay in memory."""
        vars(self).pop("blocks", None)

    def blocks_of(self, name: str) -> list[FactorBlock]:
        """The factors of one kind."""
        return [block for block in self.blocks if block.name == name]

    @cached_property
    def cost(self) -> float:
        """Half the sum of squared, robustly weighted residuals, as GTSAM counts it."""
        return sum(block.cost for block in self.blocks)

    @property
    def surprise(self) -> float:
        """The negative log posterior: the cost plus the price of the rooms and paths."""
        return self.cost + sum(kind.price for kind in self.measurements)

    @cached_property
    def ends(self) -> Array:
        """Poses ``(m, 3)`` at the end of every piece."""
        interval = self.pieces.interval
        shared = np.einsum("kqr,kr->kq", self.chain.bridge.gain, self.step_residual.value[interval])
        R = pose_rotation(self.pose_i[:, 2])[interval]
        return np.einsum("kqr,kr->kq", R, self.increments.delta + shared) + self.pose_i[interval]

    def poses_of(self, which: Index) -> Linearized:
        """Poses ``(n, 3)`` at the ends of some pieces, with derivatives by x_i, x_j and c.

        This is the one place where sub-steps are placed. The residual r of the steps is shared out by the conditional
        mean of a Gaussian walk whose two ends are known,

            s_k = Δ_k(c) + G_k r,      (p_k, θ_k) = (p_i + R_i s_k,xy,  θ_i + s_k,θ)

        with G_k of ``Bridge``; the last piece ends exactly at x_j, so the track has no jump at a keyframe.
        """
        interval = self.pieces.interval[which]
        shared = self.step_residual.take(interval).times(self.chain.bridge.gain[which])
        s = self.increments.delta[which] + shared.value
        by_i = shared.by_i + np.eye(3)
        by_i[:, 0, 2] -= s[:, 1]
        by_i[:, 1, 2] += s[:, 0]
        in_frame_of_i = Linearized(s, by_i, shared.by_j, self.increments.by_c[which] + shared.by_c)
        placed = in_frame_of_i.times(pose_rotation(self.pose_i[interval, 2]))
        return replace(placed, value=placed.value + self.pose_i[interval])


def step_residuals(pose_i: Array, pose_j: Array, increments: Increments, pieces: Pieces) -> Linearized:
    """Residuals ``(k, 3)`` of the steps between keyframes, in metres and radians, with derivatives.

    r = [ R_iᵀ (p_j − p_i) − Δp_K(c),  wrap(θ_j − θ_i − Δθ_K(c)) ]
    """
    x, y, turn = (pose_j - pose_i).T
    cos, sin = np.cos(pose_i[:, 2]), np.sin(pose_i[:, 2])
    way_x, way_y = cos * x + sin * y, cos * y - sin * x
    r = np.array([way_x, way_y, turn]).T - increments.delta[pieces.last]
    r[:, 2] = wrap_angle(r[:, 2])

    by_i = np.full((len(r), 3, 3), -np.eye(3))
    by_i[:, 0, 2], by_i[:, 1, 2] = way_y, -way_x
    return Linearized(r, by_i, pose_rotation(turn), -increments.by_c[pieces.last])
