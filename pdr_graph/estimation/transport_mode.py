"""Transport mode by positions alone: walking, standing or riding, by speed and straightness.

A hidden Markov model of epochs of ten seconds, solved by Viterbi's algorithm, as is common for transport modes (Reddy
et al., "Using mobile phones to determine transportation modes", ACM TOSN 6(2), 2010). Each epoch has two observations:
the net speed over TRAVEL.window, compared with the receiver's error in that time; and the straightness of the path.
Cycling and running count as rides: positions alone cannot distinguish them.

Indoors a receiver's position wanders by tens of metres within minutes, at the speed of a walker, whatever accuracy is
stated. But over TRAVEL.path metres along the path a walker or a vehicle covers nearly as much net distance, and a
wandering receiver does not. This *straightness* (Batschelet, Circular Statistics in Biology, 1981: net over gross
distance) needs no threshold of speed or distance, and distinguishes a walk in a small garden from noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.ndimage import maximum_filter1d, percentile_filter

from pdr_graph.estimation.gps_smoother import GpsKnots
from pdr_graph.geometry import interpolate, length_along, viterbi
from pdr_graph.priors import RECEIVERS, TRAVEL
from pdr_graph.types import Array, Index, Mask


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


def straightness(time: Array, way: Array, begins: Array, ends: Array) -> Straightness:
    """Straightness of a path ``way (n, 2)`` [m] at ``time (n,)``, in recorded stretches ``(s,)`` [s]."""
    at = np.concatenate([np.arange(a, b, TRAVEL.grid) for a, b in zip(begins, ends, strict=True)])
    way = interpolate(at, time, way)
    along = length_along(way) + 1e-6 * np.arange(len(at))  # strictly increasing even where nobody moves
    (walk, lasts), (ride, _) = (_net(at, way, along, length) for length in (TRAVEL.path, TRAVEL.ride_path))
    return Straightness(at, walk, ride, lasts, _wander(at, way, walk))


def _net(time: Array, way: Array, along: Array, length: float) -> tuple[Array, Array]:
    """Net over gross distance over ``length`` [m] centred at each sample, and the time of that path [s]."""
    first, last = np.maximum(along - length / 2, 0.0), np.minimum(along + length / 2, along[-1])
    net = np.hypot(*(interpolate(last, along, way) - interpolate(first, along, way)).T)
    return net / np.maximum(last - first, 1.0), np.interp(last, along, time) - np.interp(first, along, time)


def _wander(time: Array, way: Array, straight: Array) -> Array:
    """Standard deviation per axis [m] of the receiver's error; 0 where most of the path leads somewhere.

    The difference over TRAVEL.lag of a Gauss–Markov error of variance σ² is Rayleigh distributed with
    2σ² (1 − e^(−TRAVEL.lag/CORRELATED)).
    """
    index = np.arange(len(time))
    before, after = (
        np.clip(index + k, 0, len(time) - 1) for k in (-_samples(TRAVEL.lag / 2), _samples(TRAVEL.lag / 2))
    )
    apart = np.hypot(*(way[after] - way[before]).T)
    nowhere = (straight < TRAVEL.crooked) & (time[after] - time[before] < TRAVEL.lag + TRAVEL.grid)  # not over a gap
    usual = percentile_filter(apart * nowhere, TRAVEL.percentile, 1 + 2 * _samples(TRAVEL.context / 2), mode="nearest")
    return usual / np.sqrt(2 * np.log(2) * 2 * (1 - np.exp(-TRAVEL.lag / RECEIVERS.standing)))


def _samples(span: float) -> int:
    """Number of grid samples in a time span [s]."""
    return int(span / TRAVEL.grid)


def nearest_sample(straight: Straightness, time: Array) -> Index:
    """Index of the last sample before or at each time ``(m,)`` [s]; 0 for earlier times."""
    return np.maximum(np.searchsorted(straight.time, time, side="right") - 1, 0)


STANDS, WALKS, RIDES = STATES = range(3)  # transport modes: the hidden states
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
        count = np.maximum(np.round((ends - begins) / TRAVEL.epoch), 1).astype(int)
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
    state = _most_probable(_by_speed(epochs, knots, way, TRAVEL.window) + lead, epochs)

    # The times of changes, by speeds over a shorter window around each change
    changed = np.append(False, np.diff(state) != 0) & ~epochs.begins
    open_ = maximum_filter1d(changed, 1 + 2 * round(TRAVEL.window / TRAVEL.epoch / 2))
    cost = _by_speed(epochs, knots, way, TRAVEL.narrow) + lead
    decided = np.where(np.array(STATES) == state[:, None], 0.0, np.inf)
    state = _without_jumps(_most_probable(np.where(open_[:, None], cost, decided), epochs), epochs)
    at = np.searchsorted(epochs.start, (knots.time[1:] + knots.time[:-1]) / 2, side="right") - 1
    return state[at]


def _most_probable(cost: Array, epochs: Epochs) -> Index:
    """The states ``(e,)`` of least cost; stretches are independent."""
    change = -np.log(TRAVEL.epoch / TRAVEL.lasts / (len(STATES) - 1)) * (1 - np.eye(len(STATES)))
    return viterbi(cost, change * ~epochs.begins[1:, None, None])[0]


def _without_jumps(state: Index, epochs: Epochs) -> Index:
    """Replace rides shorter than TRAVEL.shortest_ride by the mode after or before them: they are jumps of the
    receiver.
    """
    first = np.flatnonzero(epochs.begins | np.append(True, np.diff(state) != 0))
    runs = [(a, b) for a, b in pairwise([*first, len(state)]) if state[a] == RIDES and b - a < TRAVEL.shortest_ride]
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
    # [m/s] while standing
    noise = np.sqrt(2 * slow**2 * (1 - np.exp(-span / RECEIVERS.standing)) + 2 * white**2) / span
    likelihood = np.stack(_of_speeds(np.maximum(speed, TRAVEL.shuffling), np.hypot(noise, TRAVEL.shuffling)), axis=1)
    # Windows overlap: each counts once
    return -np.log(likelihood + UNLIKELY) * np.minimum(TRAVEL.epoch / span, 1.0)[:, None]


def _of_speeds(speed: Array, noise: Array) -> tuple[Array, Array, Array]:
    """Likelihoods ``(e,)`` of net speeds [m/s] while standing, walking, riding; noise: of speeds per axis [m/s]."""
    stands = (1 - TRAVEL.outliers) * _rayleigh(speed, noise) + TRAVEL.outliers * _rayleigh(
        speed, TRAVEL.outlier_scale * noise
    )
    walks = (1 - TRAVEL.dawdling) * _normal(
        speed - TRAVEL.walk, np.hypot(TRAVEL.walk_spread, noise)
    ) + TRAVEL.dawdling / TRAVEL.walk * (speed < TRAVEL.walk)
    rides = (
        _normal(np.log(speed / TRAVEL.ride), np.hypot(TRAVEL.ride_spread, noise / np.maximum(speed, TRAVEL.creeping)))
        / speed
    )
    return (
        stands,
        walks,
        (1 - TRAVEL.waiting) * rides + TRAVEL.waiting * _rayleigh(speed, np.hypot(noise, TRAVEL.creeping)),
    )


def _by_straightness(epochs: Epochs, straight: Straightness) -> Array:
    """Costs ``(e, 3)`` of the modes by straightness, which walks and even more rides have."""
    at = nearest_sample(straight, epochs.middle)
    walk, ride = (
        -np.log(TRAVEL.bends + (1 - TRAVEL.bends) * 5 * net[at] ** 4) for net in (straight.walk, straight.ride)
    )
    counts = TRAVEL.epoch / np.maximum(straight.lasts[at], TRAVEL.window)
    return np.stack([np.zeros(len(at)), walk, walk + ride], axis=1) * counts[:, None]


def _rayleigh(value: Array, sigma: Array) -> Array:
    return value / sigma**2 * np.exp(-((value / sigma) ** 2) / 2)


def _normal(value: Array, sigma: Array) -> Array:
    return np.exp(-((value / sigma) ** 2) / 2) / sigma / np.sqrt(2 * np.pi)
