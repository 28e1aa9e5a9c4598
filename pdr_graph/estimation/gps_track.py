"""A smoothed track from positions alone: a GPX track, a watch, a log without an accelerometer.

It is smoothed twice: first with a loose motion model, to classify the transport mode, then with the motion model of
that mode. While standing, the track stays in place however far the receiver's positions wander; gaps have a wide
covariance.

The smoother is a Kalman smoother, solved as one banded system (Barfoot, Tong and Särkkä, "Batch continuous-time
trajectory estimation as exactly sparse Gaussian process regression", 2014). The motion is a continuous-time correlated
random walk, as in

    Johnson, London, Lea and Durban, "Continuous-time correlated random walk model for animal telemetry data",
    Ecology 89(5), 2008, Eqs. (1)–(5):      dp = v dt,      dv = −v/τ dt + s √(2/τ) dw

with speed s and time τ of the transport mode. Over long gaps the covariance grows accordingly. The error of a fix is
white noise plus a slowly varying offset, as in `gnss_bias`:

    z = p + σ g + n,        g a Gauss–Markov process of unit variance that is correlated over STANDING

The transport mode is walking, standing or riding, by speed and straightness: a hidden Markov model of epochs of ten
seconds, solved by Viterbi's algorithm, as is common (Reddy et al., "Using mobile phones to determine transportation
modes", ACM TOSN 6(2), 2010). Each epoch has two observations: the net speed over TRAVEL.window, compared with the
receiver's error in that time; and the straightness of the path. Between fixes that are farther apart both are those of
the whole interval and count once, and a change may be at any time in it. Cycling and running count as rides: positions
alone cannot distinguish them. Indoors a receiver's position wanders by tens of metres within minutes, at the speed of a
walker, whatever accuracy is stated. But over TRAVEL.path metres along the path a walker or a vehicle covers nearly as
much net distance, and a wandering receiver does not. This *straightness* (Batschelet, Circular Statistics in Biology,
1981: net over gross distance) needs no threshold of speed or distance, and distinguishes a walk in a small garden from
noise. Where there are steps too, `detect_rides` compares the track with them, see `rides`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.ndimage import maximum_filter1d, median_filter, percentile_filter
from scipy.special import i0e

from pdr_graph.estimation.factors.base import geman_mcclure_weight
from pdr_graph.estimation.factors.fixes import longest_consistent_chain
from pdr_graph.estimation.results import REPEATED
from pdr_graph.estimation.rides import farthest_lengths, is_ride, on_way
from pdr_graph.geometry import ANY_HEADING, distance_walked, interpolate, length_along, without
from pdr_graph.priors import FIXES, RECEIVERS, REPORTS, RIDING, TRACK, TRAVEL
from pdr_graph.types import INSTANT, Array, Estimate, Fixes, FixReport, Index, Mask, Steps, Trajectory

SHORTEST_INTERVAL = 0.1  # [s] least interval between knots: shorter ones make the information matrix ill-conditioned
PATH_EVERY = 15.0  # [s] between samples of the path, and least window of a speed: shorter ones add up noise
EPOCH = 10.0  # [s] of the hidden Markov model
FIRST_INFORMATION = 1e-12  # [1/m²] prior information on the position of the first knot
P, V, G = range(3)  # position, velocity, offset of the receiver: the state of a knot, for each axis alike
BLOCK_ROW, BLOCK_COLUMN = np.indices((3, 3)).reshape(2, 9)  # of a block
LOWER_ROW, LOWER_COLUMN = np.tril_indices(3)


@dataclass(frozen=True)
class GpsKnots:
    """The ``n`` knots of a track; most are fixes, and the first is one.

    time: ``(n,)`` [s]; position: ``(n, 2)`` [m], NaN where there is no fix; slow, white: ``(n,)`` standard deviations
    of a fix's error per axis [m].
    """

    time: Array
    position: Array
    slow: Array
    white: Array


@dataclass(frozen=True)
class Motion:
    """Motion model from knot to knot ``(n - 1,)``: speed per axis s [m/s], tau: correlation time τ [s].

    changed: True where the transport mode changes, so that the velocity is independent of the velocity before.
    """

    speed: Array
    tau: Array
    changed: Mask

    def of(self, which: Index) -> Motion:
        """The motion for subdivided intervals; which: ``(m,)`` original interval of each part, in order."""
        first = np.diff(which, prepend=-1) > 0
        return Motion(self.speed[which], self.tau[which], self.changed[which] & first)


@dataclass(frozen=True)
class SmoothTrack:
    """The track at every knot: position ``(n, 2)`` [m], velocity ``(n, 2)`` [m/s].

    weight: ``(n,)`` of each fix, 0–1; root: banded Cholesky factor of the information.
    """

    position: Array
    velocity: Array
    weight: Array
    root: Array

    def variances(self) -> Array:
        """Variances of position [m²] and velocity [m²/s²] per axis ``(n, 2)``, by Takahashi's sparse inverse."""
        knots = self.root.shape[1] // 3
        root, diagonal, next_ = self.root.reshape(6, knots, 3), np.zeros((knots, 3, 3)), np.zeros((knots - 1, 3, 3))
        diagonal[:, LOWER_ROW, LOWER_COLUMN] = root[LOWER_ROW - LOWER_COLUMN, :, LOWER_COLUMN].T
        next_[:, BLOCK_ROW, BLOCK_COLUMN] = root[3 + BLOCK_ROW - BLOCK_COLUMN, :-1, BLOCK_COLUMN].T
        inverse = np.linalg.inv(diagonal)
        alone = inverse.transpose(0, 2, 1) @ inverse
        gain = next_ @ inverse[:-1]
        result, block = np.empty((knots, 2)), alone[-1]
        result[-1] = block[P, P], block[V, V]
        for k in range(knots - 2, -1, -1):
            block = alone[k] + gain[k].T @ block @ gain[k]
            result[k] = block[P, P], block[V, V]
        return result


def smooth_track(
    knots: GpsKnots, motion: Motion, scales: tuple[float, ...], weight: Array | None = None
) -> SmoothTrack:
    """The most probable track, with small weights for outliers.

    scales: widths of the robust loss in units of the white noise, from wide to narrow, so that the result does not
    depend on the start (graduated non-convexity). weight: initial weights ``(n,)``, 1 by default.
    """
    fixed = np.isfinite(knots.position[:, 0])
    information, offset = _prior(knots, motion)
    way = _solved(knots, information, offset, fixed * (1.0 if weight is None else weight))
    for scale in scales:
        off = np.hypot(*(knots.position - way[0].position - knots.slow[:, None] * way[1]).T)
        weight = np.where(fixed, geman_mcclure_weight(np.nan_to_num(off) / knots.white / scale), 0.0)
        way = _solved(knots, information, offset, weight)
    return way[0]


def _solved(gps: GpsKnots, prior_information: Array, to_next: Array, weight: Array) -> tuple[SmoothTrack, Array]:
    """The track with weights ``(n,)``, and the receiver's offset ``(n, 2)`` in units of ``slow``.

    prior_information, to_next: see `_prior`.
    """
    knots, trust = len(weight), weight / gps.white**2
    design = np.stack([np.ones(knots), np.zeros(knots), gps.slow], axis=1)
    information = prior_information + trust[:, None, None] * design[:, :, None] * design[:, None, :]
    origin = gps.position[0]  # the first knot is a fix; digits are lost far from it
    right = (trust[:, None] * design)[:, :, None] * np.nan_to_num(gps.position - origin)[:, None, :]
    band = np.zeros((6, knots, 3))
    band[LOWER_ROW - LOWER_COLUMN, :, LOWER_COLUMN] = information[:, LOWER_ROW, LOWER_COLUMN].T
    band[3 + BLOCK_ROW - BLOCK_COLUMN, :-1, BLOCK_COLUMN] = to_next[:, BLOCK_ROW, BLOCK_COLUMN].T
    root = cholesky_banded(band.reshape(6, -1), lower=True)
    state = cho_solve_banded((root, True), right.reshape(-1, 2)).reshape(knots, 3, 2)
    return SmoothTrack(origin + state[:, P], state[:, V], weight, root), state[:, G]


def _prior(gps: GpsKnots, motion: Motion) -> tuple[Array, Array]:
    """Information of motion and offset: of each knot ``(n, 3, 3)``, and of each with the knot before."""
    span = np.maximum(np.diff(gps.time), SHORTEST_INTERVAL)
    tau, variance, changed = motion.tau, motion.speed**2, motion.changed
    kept, along = np.exp(-span / tau), span / tau
    leads = tau * (1 - kept)  # displacement per velocity [s]
    far = 2 * along - 3 + 4 * kept - kept**2
    far = np.where(along < 1e-2, 2 / 3 * along**3, far)  # its digits cancel
    first = np.where(changed, variance, 0.0)  # of a velocity that begins with the interval
    pp = variance * tau**2 * far + first * leads**2
    pv, vv = variance * leads**2 / tau + first * leads * kept, variance * (1 - kept**2) + first * kept**2
    noise = np.array([[pp, pv], [pv, vv]]).transpose(2, 0, 1)
    still = np.exp(-span / RECEIVERS.standing)
    F, inverse = np.zeros((2, len(span), 3, 3))
    F[:, P, P], F[:, G, G] = 1.0, still
    F[:, P, V], F[:, V, V] = np.where(changed, 0.0, leads), np.where(changed, 0.0, kept)
    inverse[:, :2, :2] = np.linalg.inv(noise)
    inverse[:, G, G] = 1 / (1 - still**2)
    back = F.transpose(0, 2, 1) @ inverse
    diagonal = np.zeros((len(gps.time), 3, 3))
    diagonal[1:] += inverse
    diagonal[:-1] += back @ F
    diagonal[0] += np.diag([FIRST_INFORMATION, np.append(motion.speed, TRACK.speed[LOST])[0] ** -2, 1.0])
    return diagonal, -back.transpose(0, 2, 1)


@dataclass(frozen=True)
class Straightness:
    """Net over gross distance around times ``(m,)`` [s]: walk over TRAVEL.path, ride over TRAVEL.ride_path; lasts:
    time of TRAVEL.path [s].

    wander: estimated standard deviation of the receiver's error per axis [m].
    """

    time: Array
    walk: Array
    ride: Array
    lasts: Array
    wander: Array


def straightness(knots: GpsKnots, way: Array, begins: Array, ends: Array) -> Straightness:
    """Straightness of a path ``way (n, 2)`` [m] through knots, in recorded stretches ``(s,)`` [s]."""
    time, error = knots.time, np.hypot(knots.slow, knots.white)
    at = np.concatenate([np.arange(a, b, PATH_EVERY) for a, b in zip(begins, ends, strict=True)])
    way = interpolate(at, time, way)
    along = length_along(way) + 1e-6 * np.arange(len(at))  # strictly increasing even where nobody moves
    # A line between two fixes is straight by construction: a path leads at least over the intervals beside it too
    fix = time[(np.searchsorted(time[1:-1], at, side="right") + np.array([[-1], [2]])).clip(0, len(time) - 1)]
    least = np.interp(fix, at, along)
    error = TRAVEL.errors * np.interp(at, time, error)
    (walk, lasts), (ride, _) = (
        _net(at, way, along, np.maximum(length, error), least) for length in (TRAVEL.path, TRAVEL.ride_path)
    )
    # The difference over TRAVEL.lag of a Gauss–Markov error of variance σ² is Rayleigh distributed with
    # 2σ² (1 − e^(−TRAVEL.lag/RECEIVERS.standing)); where most of the path leads somewhere, no error is seen
    half, context = int(TRAVEL.lag / 2 / PATH_EVERY), int(TRAVEL.context / 2 / PATH_EVERY)
    before, after = (np.clip(np.arange(len(at)) + k, 0, len(at) - 1) for k in (-half, half))
    nowhere = (walk < TRAVEL.crooked) & (at[after] - at[before] < TRAVEL.lag + PATH_EVERY)  # not over a gap
    apart = np.hypot(*(way[after] - way[before]).T) * nowhere
    usual = percentile_filter(apart, TRAVEL.percentile, 1 + 2 * context, mode="nearest")
    wander = usual / np.sqrt(2 * np.log(2) * 2 * (1 - np.exp(-TRAVEL.lag / RECEIVERS.standing)))
    return Straightness(at, walk, ride, lasts, wander)


def _net(time: Array, way: Array, along: Array, length: Array, least: Array) -> tuple[Array, Array]:
    """Net over gross distance over ``length`` [m] centred at each sample, and the time of that path [s].

    least: ``(2, m)`` start and end of the shortest path of each sample [m].
    """
    first, last = np.maximum(along - length / 2, 0.0), np.minimum(along + length / 2, along[-1])
    first, last = np.minimum(first, least[0]), np.maximum(last, least[1])
    net = np.hypot(*(interpolate(last, along, way) - interpolate(first, along, way)).T)
    return net / np.maximum(last - first, 1.0), np.interp(last, along, time) - np.interp(first, along, time)


STANDS, WALKS, RIDES = MODES = range(3)  # transport modes: the hidden states
UNLIKELY = 1e-12  # least likelihood


@dataclass(frozen=True)
class Epochs:
    """Equal parts of recorded stretches.

    start, middle: ``(e,)`` [s]; first, last: ``(e,)`` start and end of the stretch of each [s]; begins: ``(e,)`` True
    for the first epoch of a stretch.
    """

    start: Array
    middle: Array
    first: Array
    last: Array
    begins: Mask

    @classmethod
    def of(cls, begins: Array, ends: Array) -> Epochs:
        """The epochs of stretches from ``begins (s,)`` to ``ends (s,)`` [s]."""
        count = np.maximum(np.round((ends - begins) / EPOCH), 1).astype(int)
        within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        first, last = np.repeat(begins, count), np.repeat(ends, count)
        each = (last - first) / np.repeat(count, count)
        return cls(first + each * within, first + each * (within + 0.5), first, last, within == 0)


def moves(knots: GpsKnots, way: Array, begins: Array, ends: Array, straight: Straightness) -> Index:
    """The transport mode from each knot to the next ``(n - 1,)``: STANDS, WALKS or RIDES; undefined in gaps.

    way: smoothed path ``(n, 2)`` [m]; begins, ends: of recorded stretches ``(s,)`` [s].
    """
    epochs = Epochs.of(begins, ends)
    lead, change = _by_straightness(epochs, straight), _changes(epochs, knots.time)
    state = _most_probable(_by_speed(epochs, knots, way, TRAVEL.window) + lead, change)

    # The times of changes, by speeds over a shorter window around each change
    changed = np.append(False, np.diff(state) != 0) & ~epochs.begins
    open_ = maximum_filter1d(changed, 1 + 2 * round(TRAVEL.window / EPOCH / 2))
    cost = _by_speed(epochs, knots, way, PATH_EVERY) + lead
    decided = np.where(np.array(MODES) == state[:, None], 0.0, np.inf)
    state = _most_probable(np.where(open_[:, None], cost, decided), change)

    # Short rides are jumps of the receiver: they get the mode after or before them
    first = np.flatnonzero(epochs.begins | np.append(True, np.diff(state) != 0))
    runs = [(a, b) for a, b in pairwise([*first, len(state)]) if state[a] == RIDES and b - a < TRAVEL.shortest_ride]
    for a, b in runs:
        if b < len(state) and not epochs.begins[b]:
            state[a:b] = state[b]
        elif not epochs.begins[a]:
            state[a:b] = state[a - 1]
    at = np.searchsorted(epochs.start, (knots.time[1:] + knots.time[:-1]) / 2, side="right") - 1
    return state[at]


def _most_probable(cost: Array, change: Array) -> Index:
    """The states ``(e,)`` of least cost; change: ``(e - 1,)`` cost of another state than before.

    As `viterbi`, but faster: since all changes cost the same, a state follows itself or the cheapest one.
    """
    prices, totals = change.tolist(), [tuple(cost[0].tolist())]
    stands, walks, rides = totals[0]
    for (standing, walking, riding), price in zip(cost[1:].tolist(), prices, strict=True):
        moved = min(stands, walks, rides) + price
        stands = min(stands, moved) + standing
        walks = min(walks, moved) + walking
        rides = min(rides, moved) + riding
        totals.append((stands, walks, rides))
    states = [totals[-1].index(min(totals[-1]))]
    for total, price in zip(totals[-2::-1], reversed(prices), strict=True):
        own, cheapest = states[-1], total.index(min(total))
        stays = (total[own], own) < (total[cheapest] + price, cheapest)
        states.append(own if stays else cheapest)
    return np.array(states[::-1])


def _changes(epochs: Epochs, time: Array) -> Array:
    """Cost of a change from each epoch to the next, ``(e - 1,)``; stretches are independent.

    A Markov chain in continuous time, each mode of which lasts TRAVEL.lasts. A change at a fix may have happened at any
    time since the fix before it, or until the fix after it. time: ``(n,)`` of the fixes [s].
    """
    after = np.searchsorted(time[1:-1], epochs.middle, side="right")
    since, fix = np.diff(time)[after], np.diff(after) > 0
    since = np.where(fix, np.maximum(since[1:], since[:-1]), EPOCH)
    states = len(MODES)
    kept = np.exp(-np.maximum(since, EPOCH) / TRAVEL.lasts * states / (states - 1))
    return np.log((1 + (states - 1) * kept) / (1 - kept)) * ~epochs.begins[1:]


def _by_speed(epochs: Epochs, knots: GpsKnots, way: Array, window: float) -> Array:
    """Costs ``(e, 3)`` of the modes by net speed over a window, or from fix to fix where these are farther apart.

    Each mode is a distribution of velocities in the plane with the receiver's error added, so that a large error makes
    the modes alike and favours none.
    """
    slow, white = (np.interp(epochs.middle, knots.time, error) for error in (knots.slow, knots.white))
    first = np.maximum(epochs.middle - window / 2, epochs.first)
    last = np.minimum(epochs.middle + window / 2, epochs.last)
    speed = np.hypot(*(interpolate(last, knots.time, way) - interpolate(first, knots.time, way)).T)
    after = np.searchsorted(knots.time[1:-1], epochs.middle, side="right")
    span = np.maximum(np.maximum(last - first, 1.0), np.diff(knots.time)[after])
    shuffling = TRAVEL.shuffling * np.minimum(TRAVEL.lasts / span, 1.0)  # within a place, however long
    speed = np.maximum(speed / np.maximum(last - first, 1.0), shuffling)
    # [m/s] while standing
    noise = np.sqrt(2 * slow**2 * (1 - np.exp(-span / RECEIVERS.standing)) + 2 * white**2) / span
    noise, moving = np.hypot(noise, shuffling), np.exp(-np.maximum(span - window, 0.0) / TRAVEL.lasts)
    rare = TRAVEL.exceptions
    # The speed is that of a person who moves all the time, or part of it as in a long interval
    partly = [_rayleigh(speed, np.hypot(whole / 2, noise)) for whole in (TRAVEL.walk, TRAVEL.ride)]
    walks = (1 - rare) * moving * _rice(speed, TRAVEL.walk, TRAVEL.walk_spread, noise)
    walks += (1 - (1 - rare) * moving) * partly[0]
    rides = (1 - TRAVEL.waiting) * (moving * _of_rides(speed, noise) + (1 - moving) * partly[1])
    rides += TRAVEL.waiting * _rayleigh(speed, np.hypot(TRAVEL.creeping, noise))
    usual = np.stack([_rayleigh(speed, noise), walks, rides], axis=1)
    large = np.hypot(TRAVEL.outlier_scale * noise[:, None], [0.0, TRAVEL.walk, TRAVEL.ride])
    density = (1 - rare) * usual + rare * _rayleigh(speed[:, None], large)
    # Windows overlap: each counts once
    return -np.log(density + UNLIKELY) * np.minimum(EPOCH / span, 1.0)[:, None]


def _of_rides(speed: Array, noise: Array) -> Array:
    """Density of a speed whose true value is log-normal about TRAVEL.ride, with the noise of a velocity.

    A mixture of normal velocities, whose logarithm of speed has the mean ln(scale) + 0.058 and the variance π²/24, by
    Gauss–Hermite quadrature of the scales.
    """
    spread = np.sqrt(3 * (TRAVEL.ride_spread**2 - np.pi**2 / 24))
    scales = TRAVEL.ride * np.exp(spread * np.array([-1.0, 0.0, 1.0]) - 0.058)
    parts = (w * _rayleigh(speed, np.hypot(c, noise)) for w, c in zip((1 / 6, 2 / 3, 1 / 6), scales, strict=True))
    return np.sum(list(parts), axis=0)


def _by_straightness(epochs: Epochs, straight: Straightness) -> Array:
    """Costs ``(e, 3)`` of the modes by straightness, which walks and even more rides have."""
    at = np.maximum(np.searchsorted(straight.time, epochs.middle, side="right") - 1, 0)  # the last sample before
    walk, ride = (
        -np.log(TRAVEL.exceptions + (1 - TRAVEL.exceptions) * 5 * net[at] ** 4)
        for net in (straight.walk, straight.ride)
    )
    counts = EPOCH / np.maximum(straight.lasts[at], TRAVEL.window)
    return np.stack([np.zeros(len(at)), walk, walk + ride], axis=1) * counts[:, None]


def _rayleigh(value: Array, sigma: Array) -> Array:
    return value / sigma**2 * np.exp(-((value / sigma) ** 2) / 2)


def _rice(value: Array, mean: float, spread: float, noise: Array) -> Array:
    """Density of a speed whose true value is normal about a mean, with the noise of a velocity per axis [m/s].

    That of a Rice distribution with the most probable true speed of the value, exact without noise or without spread;
    at most the density without a direction of the noise, so that noise alone is no sign of a walk.
    """
    true = (value / noise**2 + mean / spread**2) / (1 / noise**2 + 1 / spread**2)
    far = true * value / noise**2
    normal = np.exp(-(((value - mean) / np.hypot(spread, noise)) ** 2) / 2) / np.hypot(spread, noise)
    return normal * np.minimum(np.sqrt(value / true) * np.sqrt(far) * i0e(far), (2 * np.pi) ** -0.5)


LOST = len(MODES)  # transport mode where there is no data
BRIDGE = 4  # parts of a gap: with linear interpolation between their ends, the variance is a seventh too low at most


@dataclass(frozen=True)
class Way:
    """A smoothed track with covariance: a row per used fix and some in gaps, ``n`` of them.

    kind: ``(n - 1,)`` transport mode from row to row: STANDS, WALKS, RIDES, LOST; used: ``(m,)`` indices of the fixes
    used, in order of time, and weight: ``(m,)`` of each, 0–1.
    """

    trajectory: Trajectory
    kind: Index
    used: Index
    weight: Array


def way_through(fixes: Fixes, mode: int | None = None) -> Way:
    """The smoothed track of fixes: at least one, in a metric frame. mode: the transport mode throughout, if known."""
    used = plausible(fixes)
    fixes = fixes[used]
    knots, lost = scaled(_knots(fixes)), _lost(fixes)

    # First pass: everything is a ride, and the loss is as wide as eight sigmas at first
    kind = np.where(lost, LOST, RIDES)
    first = smooth_track(knots, _motion(knots, kind), (8.0, 2.0, 1.0))

    # Second pass: the motion model of each transport mode, with rows in gaps
    kind, knots = _classified(knots, first.position, lost)
    kind = kind if mode is None else np.where(kind == LOST, LOST, mode)
    rows, of = _with_rows_in_gaps(knots, kind)
    weight = np.interp(rows.time, knots.time, first.weight)
    way = smooth_track(rows, _motion(knots, kind).of(of), (1.0, 1.0), weight)
    floor = tuple(fixes.floor[k] for k in (*of, len(fixes) - 1))
    return Way(_trajectory(rows.time, way, floor), kind[of], used, way.weight[np.isfinite(rows.position[:, 0])])


def plausible(fixes: Fixes) -> Index:
    """Indices of the best fix at each time, without jumps faster than TRACK.fastest and back, and without strays.

    Most of a receiver's error is constant from epoch to epoch, and the rest is small, so jumps are outliers. Fast
    trains are none, and flights are left out.
    """
    order = np.lexsort((fixes.sigma, fixes.time))
    order = order[np.append(True, np.diff(fixes.time[order]) > INSTANT)]
    first = fixes[order]
    far = np.hypot(*np.diff(first.position, axis=0).T) * _by_fast_train(first)
    way = np.cumsum(np.append(0.0, np.maximum(TRACK.fastest * np.diff(first.time), far)))
    error = FIXES.outlier * _knots(first).white
    order = order[longest_consistent_chain(first.position, error, way, TRACK.jump)[1]]
    return order[~_strays(fixes[order])]


def _strays(fixes: Fixes) -> Mask:
    """True ``(n,)`` for a single place between two fixes before and two after at one place: nobody turns so.

    One who walks may have been there and turned at once; there and back by a vehicle would have been seen.
    """
    time, place, found = fixes.time, fixes.position, np.zeros(len(fixes), dtype=bool)
    first = np.flatnonzero(np.append(True, np.any(np.diff(place, axis=0), axis=1)))
    after = np.append(first[1:], len(fixes))
    inner = (first >= 2) & (after <= len(fixes) - 2)
    first, after = first[inner], after[inner]
    far = np.minimum(*(np.hypot(*(place[first] - place[k]).T) for k in (first - 1, after)))
    near = np.max([np.hypot(*(place[k] - place[first - 1]).T) for k in (first - 2, after, after + 1)], axis=0)
    stray = (far > TRAVEL.outlier_scale * fixes.sigma[first]) & (near < RIDING.beside * far)
    stray &= 2 * far > TRAVEL.walk * (time[after] - time[first - 1])
    for a, b in zip(first[stray], after[stray], strict=True):
        found[a:b] = True
    return found


def _by_fast_train(fixes: Fixes) -> Mask:
    """True ``(n - 1,)`` between two fixes of a run faster than TRACK.fastest that keeps its velocity, as no jump does.

    A run that exceeds TRACK.rails is a flight.
    """
    velocity = np.diff(fixes.position, axis=0) / np.diff(fixes.time)[:, None]
    speed, found = np.hypot(*velocity.T), np.zeros(len(velocity), dtype=bool)
    fast = speed > TRACK.fastest
    parted = (fast[1:] != fast[:-1]) | (np.hypot(*np.diff(velocity, axis=0).T) > 0.5 * speed[:-1])
    edge = np.concatenate([[0], np.flatnonzero(parted) + 1, [len(fast)]])
    for run in np.flatnonzero(np.diff(edge) >= TRAVEL.shortest_ride):
        a, b = edge[run : run + 2]
        found[a:b] = fixes.time[b] - fixes.time[a] >= TRACK.longest and fast[a] and speed[a:b].max() <= TRACK.rails
    return found


def _knots(fixes: Fixes) -> GpsKnots:
    """Knots at the fixes; fixes with a source have a slowly varying error, others are independent."""
    independent = np.where(np.array(fixes.source, dtype=str) == "", 1.0, RECEIVERS.white)
    return GpsKnots(fixes.time, fixes.position, fixes.sigma * np.sqrt(1 - independent**2), independent * fixes.sigma)


def scaled(knots: GpsKnots) -> GpsKnots:
    """The knots, all of which are fixes, with smaller errors where their positions scatter less than is stated.

    What a receiver states may be too large by any factor. Second differences over EPOCH hardly contain the motion of a
    person, and have an exponential distribution in units of their variance. The lower quartile around each is robust
    against turns, stops and rides; the stated accuracy counts as one more observation (a unit information prior: Kass
    and Wasserman, J. Am. Stat. Assoc. 90, 1995). Repeated positions are one.
    """
    moved = np.flatnonzero(np.append(True, np.any(np.diff(knots.position, axis=0), axis=1))).tolist()
    chosen = moved[:1]
    for k in moved[1:]:
        if knots.time[k] - knots.time[chosen[-1]] >= EPOCH - INSTANT:
            chosen.append(k)
    if len(chosen) < 3:
        return knots
    time, place, slow, white = (of[chosen] for of in (knots.time, knots.position, knots.slow, knots.white))
    share = np.diff(time)[:-1] / (time[2:] - time[:-2])
    weights = (share - 1, np.ones(len(share)), -share)  # of the position before, of itself and of that after
    parts = [(weight, slice(n, len(time) - 2 + n)) for n, weight in enumerate(weights)]
    apart = np.sum([weight[:, None] * place[rows] for weight, rows in parts], axis=0)
    variance = np.sum([(weight * white[rows]) ** 2 for weight, rows in parts], axis=0)
    for (weight, rows), (other, columns) in product(parts, parts):
        alike = np.exp(-np.abs(time[rows] - time[columns]) / RECEIVERS.standing)
        variance += weight * other * slow[rows] * slow[columns] * alike
    ratio = np.sum(apart**2, axis=1) / (2 * variance)
    number = round(TRAVEL.scatter / EPOCH)
    quartile = percentile_filter(ratio, 25, number + 1, mode="nearest") / -np.log(0.75)
    number = min(number, len(ratio)) / 2  # neighbours share positions
    scale = np.sqrt(np.minimum((1 + number * quartile) / (1 + number), 1.0))
    scale = np.interp(knots.time, time[1:-1], scale)
    return replace(knots, slow=scale * knots.slow, white=scale * knots.white)


def without_data(time: Array) -> Mask:
    """True ``(n - 1,)`` between two times of fixes ``(n,)`` [s] with a gap.

    A phone asks less often while it lies still: what is usual is that of the intervals around each.
    """
    span = np.diff(time)
    if not len(span):
        return np.zeros(0, dtype=bool)
    window = 2 * round(TRACK.usual_intervals) + 1
    usual = TRACK.usual_intervals * median_filter(span, window, mode="constant", cval=np.median(span))
    return span > np.clip(usual, TRACK.longest, TRACK.silence)


def _lost(fixes: Fixes) -> Mask:
    """True ``(n - 1,)`` between two fixes with a gap, a flight, or a stretch shorter than an epoch."""
    time, span = fixes.time, np.diff(fixes.time)
    # Shorter jumps are receivers'
    flown = np.hypot(*np.diff(fixes.position, axis=0).T) > TRACK.fastest * (span + TRACK.longest)
    lost = (flown & ~_by_fast_train(fixes)) | without_data(fixes.time)
    for begin, end in _stretches(lost):
        if time[end] - time[begin] < EPOCH:
            lost[begin:end] = True
    return lost


def _stretches(lost: Mask) -> Index:
    """First and last fix ``(s, 2)`` of each recorded stretch, which has at least two fixes."""
    edge = np.diff(np.concatenate([[True], lost, [True]]).astype(int))
    return np.column_stack([np.flatnonzero(edge < 0), np.flatnonzero(edge > 0)])


def _classified(knots: GpsKnots, way: Array, lost: Mask) -> tuple[Index, GpsKnots]:
    """The transport mode from fix to fix ``(n - 1,)``, and the knots with sigmas widened by the receiver's wander."""
    begins, ends = knots.time[_stretches(lost)].T
    if not len(begins):
        return np.full(len(lost), LOST), knots
    straight = straightness(knots, way, begins, ends)
    wander = np.interp(knots.time, straight.time, straight.wander)
    more = np.maximum(wander / np.hypot(knots.slow, knots.white), 1.0)
    knots = replace(knots, slow=np.maximum(knots.slow, wander), white=knots.white * more)
    kind = np.where(lost, LOST, moves(knots, way, begins, ends, straight))
    for begin, end in _stretches((kind != STANDS) | lost):
        for first, last in _walks_between_places(knots, int(begin), int(end)):
            kind[first:last] = WALKS
    return kind, knots


def _walks_between_places(knots: GpsKnots, begin: int, end: int) -> Iterator[tuple[int, int]]:
    """First and last knot of each walk within a stand, from knot `begin` to `end`, that was at two places.

    Coarse positions of a short walk are no evidence of movement each; those of some minutes before and after it are:
    their means are farther apart than their errors allow, and the move between them took as long as a walk. The mean of
    a Gauss–Markov error over its correlation time has 2/e of its variance.
    """
    time, place = knots.time[begin : end + 1], knots.position[begin : end + 1]
    slow, white = (error[begin : end + 1] ** 2 for error in (knots.slow, knots.white))
    if time[-1] - time[0] < 3 * (lasts := TRAVEL.lasts):
        return
    sums = np.concatenate([np.zeros((1, 4)), np.cumsum(np.column_stack([place, slow, white]), axis=0)])

    def means(start: Array, stop: Array) -> tuple[Array, Array, Array]:
        """Mean place of the knots between times, its variance, and that of a single knot."""
        first, after = np.searchsorted(time, start - INSTANT), np.searchsorted(time, stop + INSTANT)
        number = after - first
        mean = (sums[after] - sums[first]) / np.maximum(number, 1)[:, None]
        mean[number < 3] = np.nan
        return mean[:, :2], 2 / np.e * mean[:, 2] + mean[:, 3] / np.maximum(number, 1), mean[:, 2] + mean[:, 3]

    middle = np.arange(time[0] + lasts, time[-1] - lasts, EPOCH)
    before, error, scatter = means(middle - 1.5 * lasts, middle - 0.5 * lasts)
    after, other, scattered = means(middle + 0.5 * lasts, middle + 1.5 * lasts)
    apart = after - before
    gain = np.einsum("ij,ij->i", apart, apart) / (2 * (error + other))
    price = 2 * np.log(lasts / EPOCH) + np.log((time[-1] - time[0]) / lasts)
    taken = list[int]()
    for k in np.argsort(-np.nan_to_num(gain)).tolist():
        # Windows beside a change end at 1.5 of their length from it
        if not gain[k] > price or any(abs(middle[k] - middle[t]) < 1.5 * lasts for t in taken):
            continue
        taken.append(k)
        length = float(np.hypot(*apart[k]))
        share = (place - before[k]) @ apart[k] / length**2  # of the way between both places
        at = int(np.searchsorted(time, middle[k]))
        here = np.flatnonzero(share[:at] * length <= np.sqrt(scatter[k]))
        there = at + np.flatnonzero((1 - share[at:]) * length <= np.sqrt(scattered[k]))
        first, last = int(np.append(0, here)[-1]), int(np.append(there, len(time) - 1)[0])
        lasted, off = time[last] - time[first], np.sqrt(scatter[k] + scattered[k])
        if abs(length - TRAVEL.walk * lasted) <= 2 * np.hypot(TRAVEL.walk_spread * lasted, off):
            yield begin + first, begin + last


def _motion(knots: GpsKnots, kind: Index) -> Motion:
    """The motion model per interval ``(n - 1,)`` of a mode; over a gap, its speed is at least that required."""
    takes = np.hypot(*np.diff(knots.position, axis=0).T) / np.diff(knots.time) / np.sqrt(2)
    speed = np.where(kind == LOST, np.maximum(np.array(TRACK.speed)[LOST], takes), np.array(TRACK.speed)[kind])
    changed = np.append(False, (kind[1:] != kind[:-1]) | (kind[1:] == LOST))[: len(kind)]
    return Motion(speed, np.array(TRACK.keeps)[kind], changed)


def _with_rows_in_gaps(knots: GpsKnots, kind: Index) -> tuple[GpsKnots, Index]:
    """The knots with BRIDGE - 1 more in each gap, and the original interval of each new interval."""
    of = np.repeat(np.arange(len(kind)), np.where(kind == LOST, BRIDGE, 1))
    within = np.arange(len(of)) - np.searchsorted(of, of)
    time = knots.time[of] + np.diff(knots.time)[of] * within / np.where(kind == LOST, BRIDGE, 1)[of]
    is_fix = np.append(within == 0, True)
    position = np.full((len(is_fix), 2), np.nan)
    position[is_fix] = knots.position
    of_all = np.append(of, len(kind))
    return GpsKnots(np.append(time, knots.time[-1]), position, knots.slow[of_all], knots.white[of_all]), of


def _trajectory(time: Array, way: SmoothTrack, floor: tuple[str, ...]) -> Trajectory:
    """The trajectory of a smoothed track, with the heading of its velocity."""
    variance = way.variances()
    speed = np.hypot(*way.velocity.T)
    covariance = np.zeros((len(time), 3, 3))
    covariance[:, 0, 0] = covariance[:, 1, 1] = variance[:, 0]
    sigma = np.minimum(ANY_HEADING, np.sqrt(variance[:, 1]) / np.maximum(speed, 1e-9))
    covariance[:, 2, 2] = sigma**2
    return Trajectory(time, way.position, np.arctan2(way.velocity[:, 1], way.velocity[:, 0]), floor, covariance)


TOO_FAST = "too far to be reached in time: not used"  # reason in reports


def follow(fixes: Fixes) -> Estimate:
    """The smoothed track with a report of each fix; jumps faster than TRACK.fastest and back are not used.

    fixes: at least one, in order of time, in the output frame.
    """
    way = way_through(fixes)
    track, weight = way.trajectory, np.zeros(len(fixes))
    weight[way.used] = way.weight
    residual = np.hypot(*(fixes.position - interpolate(fixes.time, track.time, track.position)).T)
    reason = np.where(np.isin(fixes.time, fixes.time[way.used]), REPEATED, TOO_FAST).astype(object)
    for n, sigmas, share in zip(way.used, (residual / fixes.sigma)[way.used], way.weight, strict=True):
        trust = "full weight" if share > 1 - REPORTS.rejected else "reduced weight"
        reason[n] = f"{sigmas:.1f} sigma from the smoothed track: {trust if share >= REPORTS.rejected else 'outlier'}"
    passed, doubted = int((reason == TOO_FAST).sum()), int((way.weight < REPORTS.rejected).sum())
    lasts = np.diff(track.time)
    still, recorded = (float(lasts[which].sum()) for which in (way.kind == STANDS, way.kind != LOST))
    minutes = f"{still / 60:.0f} of {recorded / 60:.0f} min"
    warned = {
        f"{passed} of {len(fixes)} fixes are too far to be reached in time and were not used": passed,
        f"{doubted} of {len(fixes)} fixes contradict those around them and have weight 0": doubted,
        f"the positions lead nowhere for {minutes}: classified as standing": still > recorded / 2,
    }
    columns = (fixes.time, *fixes.position.T, fixes.sigma, residual, weight)
    return Estimate(
        trajectory=track,
        dead_reckoning=track,
        calibration=None,
        reports={"fixes": tuple(map(FixReport, *(column.tolist() for column in columns), reason))},
        iterations=0,
        cost=0.0,
        converged=True,
        warnings=tuple(text for text, holds in warned.items() if holds),
    )


def detect_rides(steps: Steps, fixes: Fixes) -> Array:
    """Start and end ``(r, 2)`` [s] of the rides of the walker of these steps, in order.

    fixes: in order of time, in a metric frame.
    """
    fixes = fixes[(fixes.time >= steps.start) & (fixes.time <= steps.end)]
    every, fixes = fixes.time, fixes[on_way(fixes.time, fixes.position, fixes.sigma)]
    if len(fixes) < 2:
        return np.empty((0, 2))
    way = way_through(fixes, RIDES)
    time, place = way.trajectory.time, way.trajectory.position
    along = length_along(place)

    # Times in which the positions move farther than the steps can have led, and not by one jump of a receiver
    led = distance_walked(steps, time, farthest_lengths(steps))
    moved, reach = np.diff(along), FIXES.stretched * np.diff(led)
    excess, noise = moved - reach - RIDING.slowest * np.diff(time), FIXES.outlier * float(np.median(fixes.sigma))
    rows = largest_sums(excess, max(noise, RIDING.gradual))
    score, jump = (np.array([of(part[a:b]) for a, b in rows]) for of, part in ((np.sum, excess), (np.max, moved)))
    rows = np.array(rows, dtype=np.intp).reshape(-1, 2)
    spans = time[rows[is_ride(score, jump, noise, (rows[:, 0] > 0) & (rows[:, 1] < len(time) - 1))]]
    spans = spans[2 * _count(fixes.time, spans) > _count(every, spans)]

    # One ride where the walker does not leave the place of a stop
    if len(spans) > 1:
        leave, board = spans[:-1, 1], spans[1:, 0]
        walked = distance_walked(steps, board) - distance_walked(steps, leave)
        apart = (board - leave > RIDING.longest_stop) | (walked > RIDING.at_stop)
        spans = np.column_stack([spans[np.append(True, apart), 0], spans[np.append(apart, True), 1]])

    # Rides without the bouts of walking that lead as far as the positions move: between two buses, or at either end
    begins, ends = steps.time - steps.duration, steps.time
    first = np.flatnonzero(np.append(np.inf, begins[1:] - ends[:-1])[: len(steps)] > RIDING.pause)
    after = np.append(first[1:], len(steps))[: len(first)]
    walks = np.column_stack([begins[first], ends[after - 1]])
    gone, led = (
        np.diff(np.interp(walks, time, along), axis=1)[:, 0],
        np.diff(distance_walked(steps, walks), axis=1)[:, 0],
    )
    agrees = (gone < FIXES.stretched * led) & (led < FIXES.stretched * gone)
    walks = walks[agrees & (after - first >= RIDING.fewest_steps)]
    spans = np.array([part for span in spans for part in without(span, walks)]).reshape(-1, 2)
    spans = spans[np.diff(np.interp(spans, time, along), axis=1)[:, 0] > RIDING.gradual]

    # Extended to the steps before and after
    ends, begins = np.append(steps.start, steps.time), np.append(begins, steps.end)
    last = ends[np.searchsorted(ends, spans[:, 0], side="right") - 1]
    next_ = begins[np.minimum(np.searchsorted(begins, spans[:, 1]), len(begins) - 1)]
    return np.column_stack(
        [np.maximum(last, spans[:, 0] - RIDING.boarding), np.minimum(next_, spans[:, 1] + RIDING.boarding)]
    )


def _count(time: Array, spans: Array) -> Index:
    """Number of times within each span ``(r, 2)``, both ends included."""
    first, after = np.searchsorted(time, spans - [INSTANT, -INSTANT]).T
    return after - first


def largest_sums(values: Array, least: float) -> list[tuple[int, int]]:
    """The parts of values ``(n,)`` that have the largest sums, disjoint, above ``least``: their bounds, in order."""
    total = np.append(0.0, np.cumsum(values))
    rise = total - np.minimum.accumulate(total)
    end = int(np.argmax(rise))
    if rise[end] <= least:
        return []
    begin = int(np.argmin(total[:end]))
    after = [(a + end, b + end) for a, b in largest_sums(values[end:], least)]
    return [*largest_sums(values[:begin], least), (begin, end), *after]


Stated = Sequence[tuple[float, float, int]]  # start and end [s] of a transport mode that is known


def with_stated_rides(rides: Array, steps: Steps, stated: Stated) -> Array:
    """The rides ``(r, 2)`` [s] of a walk, with those that are stated and without times of other stated modes."""
    for start, end, kind in stated:
        start, end = max(start, steps.start), min(end, steps.end)
        if start >= end:
            continue
        before, after = np.minimum(rides, start), np.maximum(rides, end)
        rides = np.concatenate([before, after])
        rides = rides[rides[:, 1] - rides[:, 0] > INSTANT]
        if kind == RIDES:
            rides = np.append(rides, [[start, end]], axis=0)
        rides = rides[np.argsort(rides[:, 0])]
    return rides
