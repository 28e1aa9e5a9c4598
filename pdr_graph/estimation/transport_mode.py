"""Transport mode by positions alone: walking, standing or riding, by speed and straightness.

A hidden Markov model of epochs of ten seconds, solved by Viterbi's algorithm, as is common for transport modes (Reddy
et al., "Using mobile phones to determine transportation modes", ACM TOSN 6(2), 2010). Each epoch has two observations:
the net speed over WINDOW, compared with the receiver's error in that time; and the straightness of the path. Cycling
and running count as rides: positions alone cannot distinguish them.

Indoors a receiver's position wanders by tens of metres within minutes, at the speed of a walker, whatever accuracy is
stated. But over PATH metres along the path a walker or a vehicle covers nearly as much net distance, and a wandering
receiver does not. This *straightness* (Batschelet, Circular Statistics in Biology, 1981: net over gross distance) needs
no threshold of speed or distance, and distinguishes a walk in a small garden from noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.ndimage import maximum_filter1d, percentile_filter

from pdr_graph.estimation.factors.receivers import STANDING as CORRELATED
from pdr_graph.estimation.gps_smoother import GpsKnots
from pdr_graph.geometry import interpolate, length_along, viterbi
from pdr_graph.types import Array, Index, Mask

GRID = 15.0  # [s] between samples of the path: a shorter interval accumulates the receiver's noise
PATH, RIDE_PATH = 100.0, 600.0  # [m] of path for the straightness of walks and rides: about a street block
CROOKED = 0.6  # straightness below which a path leads nowhere: half a circle is 0.64
CONTEXT = 600.0  # [s] window of the percentile below
WANDER_PERCENTILE = 65.0  # [%] of displacements over LAG: a third may be turns, errands, or an open window
LAG = 60.0  # [s] over which the wander is measured
WIDEST = 50.0  # [m] per axis: a larger displacement is movement, not error


@dataclass(frozen=True)
class Straightness:
    """Net over gross distance around times ``(m,)`` [s]: walk over PATH, ride over RIDE_PATH; lasts: time of PATH [s].

    wander: estimated standard deviation of the receiver's error per axis [m].
    """

    time: Array
    walk: Array
    ride: Array
    lasts: Array
    wander: Array


def straightness(time: Array, way: Array, begins: Array, ends: Array) -> Straightness:
    """Straightness of a path ``way (n, 2)`` [m] at ``time (n,)``, in recorded stretches ``(s,)`` [s]."""
    at = np.concatenate([np.arange(a, b, GRID) for a, b in zip(begins, ends, strict=True)])
    way = interpolate(at, time, way)
    along = length_along(way) + 1e-6 * np.arange(len(at))  # strictly increasing even where nobody moves
    (walk, lasts), (ride, _) = (_net(at, way, along, length) for length in (PATH, RIDE_PATH))
    return Straightness(at, walk, ride, lasts, _wander(at, way, walk))


def _net(time: Array, way: Array, along: Array, length: float) -> tuple[Array, Array]:
    """Net over gross distance over ``length`` [m] centred at each sample, and the time of that path [s]."""
    first, last = np.maximum(along - length / 2, 0.0), np.minimum(along + length / 2, along[-1])
    net = np.hypot(*(interpolate(last, along, way) - interpolate(first, along, way)).T)
    return net / np.maximum(last - first, 1.0), np.interp(last, along, time) - np.interp(first, along, time)


def _wander(time: Array, way: Array, straight: Array) -> Array:
    """Standard deviation per axis [m] of the receiver's error; 0 where most of the path leads somewhere.

    The difference over LAG of a Gauss–Markov error of variance σ² is Rayleigh distributed with
    2σ² (1 − e^(−LAG/CORRELATED)).
    """
    index = np.arange(len(time))
    before, after = (np.clip(index + k, 0, len(time) - 1) for k in (-_samples(LAG / 2), _samples(LAG / 2)))
    apart = np.hypot(*(way[after] - way[before]).T)
    nowhere = (straight < CROOKED) & (time[after] - time[before] < LAG + GRID)  # not over a gap
    usual = percentile_filter(apart * nowhere, WANDER_PERCENTILE, 1 + 2 * _samples(CONTEXT / 2), mode="nearest")
    return usual / np.sqrt(2 * np.log(2) * 2 * (1 - np.exp(-LAG / CORRELATED)))


def _samples(span: float) -> int:
    """Number of grid samples in a time span [s]."""
    return int(span / GRID)


def nearest_sample(straight: Straightness, time: Array) -> Index:
    """Index of the last sample before or at each time ``(m,)`` [s]; 0 for earlier times."""
    return np.maximum(np.searchsorted(straight.time, time, side="right") - 1, 0)


STANDS, WALKS, RIDES = STATES = range(3)  # transport modes: the hidden states
EPOCH = 10.0  # [s]
WINDOW, NARROW = 40.0, 15.0  # [s] over which net speeds are computed, for the modes and for the times of their changes
LASTS = 300.0  # [s] usual duration of a mode
SHUFFLING = 0.05  # [m/s] speed while standing
WALK, WALK_VARIES = 1.2, 0.4  # [m/s] net speed of walkers, with turns and stops, and its sigma
RIDE_SPEED, RIDE_VARIES = 7.0, 0.9  # [m/s] net speed from bicycles to cars, and the sigma of its logarithm
DAWDLING = 0.1  # share of a walk with turns and short stops, at any lower net speed
WAITING, CREEPING = 0.15, 0.5  # share of a ride in which it hardly moves, and the speed then [m/s]
OUTLIERS, OUTLIER_SCALE = 0.1, 3.0  # share of larger errors of a receiver, and their scale
BENDS = 0.1  # share of paths of any straightness; the others are distributed as (net / gross)^4
UNLIKELY = 1e-12  # least likelihood
SHORTEST_RIDE = 3  # epochs


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
    lead = _by_straightness(epochs, straight)
    state = _most_probable(_by_speed(epochs, knots, way, WINDOW) + lead, epochs)

    # The times of changes, by speeds over a shorter window around each change
    changed = np.append(False, np.diff(state) != 0) & ~epochs.begins
    open_ = maximum_filter1d(changed, 1 + 2 * round(WINDOW / EPOCH / 2))
    cost = _by_speed(epochs, knots, way, NARROW) + lead
    decided = np.where(np.array(STATES) == state[:, None], 0.0, np.inf)
    state = _without_jumps(_most_probable(np.where(open_[:, None], cost, decided), epochs), epochs)
    at = np.searchsorted(epochs.start, (knots.time[1:] + knots.time[:-1]) / 2, side="right") - 1
    return state[at]


def _most_probable(cost: Array, epochs: Epochs) -> Index:
    """The states ``(e,)`` of least cost; stretches are independent."""
    change = -np.log(EPOCH / LASTS / (len(STATES) - 1)) * (1 - np.eye(len(STATES)))
    return viterbi(cost, change * ~epochs.begins[1:, None, None])[0]


def _without_jumps(state: Index, epochs: Epochs) -> Index:
    """Replace rides shorter than SHORTEST_RIDE by the mode after or before them: they are jumps of the receiver."""
    first = np.flatnonzero(epochs.begins | np.append(True, np.diff(state) != 0))
    runs = [(a, b) for a, b in pairwise([*first, len(state)]) if state[a] == RIDES and b - a < SHORTEST_RIDE]
    state = state.copy()
    for a, b in runs:
        if b < len(state) and not epochs.begins[b]:
            state[a:b] = state[b]
        elif not epochs.begins[a]:
            state[a:b] = state[a - 1]
    return state


def _by_speed(epochs: Epochs, knots: GpsKnots, way: Array, window: float) -> Array:
    """Costs ``(e, 3)`` of the modes by net speed."""
    first = np.maximum(epochs.middle - window / 2, epochs.first)
    last = np.minimum(epochs.middle + window / 2, epochs.last)
    span = np.maximum(last - first, 1.0)
    speed = np.hypot(*(interpolate(last, knots.time, way) - interpolate(first, knots.time, way)).T) / span
    slow, white = (np.interp(epochs.middle, knots.time, error) for error in (knots.slow, knots.white))
    noise = np.sqrt(2 * slow**2 * (1 - np.exp(-span / CORRELATED)) + 2 * white**2) / span  # [m/s] while standing
    likelihood = np.stack(_of_speeds(np.maximum(speed, SHUFFLING), np.hypot(noise, SHUFFLING)), axis=1)
    return -np.log(likelihood + UNLIKELY) * np.minimum(EPOCH / span, 1.0)[:, None]  # windows overlap: each counts once


def _of_speeds(speed: Array, noise: Array) -> tuple[Array, Array, Array]:
    """Likelihoods ``(e,)`` of net speeds [m/s] while standing, walking, riding; noise: of speeds per axis [m/s]."""
    stands = (1 - OUTLIERS) * _rayleigh(speed, noise) + OUTLIERS * _rayleigh(speed, OUTLIER_SCALE * noise)
    walks = (1 - DAWDLING) * _normal(speed - WALK, np.hypot(WALK_VARIES, noise)) + DAWDLING / WALK * (speed < WALK)
    rides = _normal(np.log(speed / RIDE_SPEED), np.hypot(RIDE_VARIES, noise / np.maximum(speed, CREEPING))) / speed
    return stands, walks, (1 - WAITING) * rides + WAITING * _rayleigh(speed, np.hypot(noise, CREEPING))


def _by_straightness(epochs: Epochs, straight: Straightness) -> Array:
    """Costs ``(e, 3)`` of the modes by straightness, which walks and even more rides have."""
    at = nearest_sample(straight, epochs.middle)
    walk, ride = (-np.log(BENDS + (1 - BENDS) * 5 * net[at] ** 4) for net in (straight.walk, straight.ride))
    counts = EPOCH / np.maximum(straight.lasts[at], WINDOW)
    return np.stack([np.zeros(len(at)), walk, walk + ride], axis=1) * counts[:, None]


def _rayleigh(value: Array, sigma: Array) -> Array:
    return value / sigma**2 * np.exp(-((value / sigma) ** 2) / 2)


def _normal(value: Array, sigma: Array) -> Array:
    return np.exp(-((value / sigma) ** 2) / 2) / sigma / np.sqrt(2 * np.pi)
