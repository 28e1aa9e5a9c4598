"""Walking, standing or in a vehicle, by positions alone: speed and straightness.

A hidden Markov model of epochs of ten seconds, solved by Viterbi's algorithm, as transport modes commonly are (Reddy et
al., "Using mobile phones to determine transportation modes", ACM TOSN 6(2), 2010). It sees two things of each epoch:
the speed at which one got away over WINDOW, beside what the receiver errs in that time; and whether the way led
anywhere. Cycling is a ride like any other, and so is running: positions alone cannot tell them.

Indoors a receiver wanders by tens of metres within minutes, at the speed of a walker, whatever accuracy is stated. But
who goes somewhere gets there: over PATH metres of way a walker or a vehicle comes nearly as far as the crow flies, and
what wanders does not. This *straightness* (Batschelet, Circular Statistics in Biology, 1981: net over gross distance)
needs no threshold of speed or of distance, and knows a walk in a small garden from noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.ndimage import maximum_filter1d, percentile_filter

from pdr_graph.estimation.factors.fixes import STANDING as CORRELATED
from pdr_graph.estimation.gps_smoother import GpsKnots
from pdr_graph.geometry import interpolate, length_along, viterbi
from pdr_graph.types import Array, Index, Mask

GRID = 15.0  # [s] between samples of the way: shorter ones add a receiver's noise up
PATH, RIDE_PATH = (
    100.0,
    600.0,
)  # [m] of way over which a walk, and a ride, lead somewhere: street corners are about as far
CROOKED = 0.6  # straightness of a way that leads nowhere: half a circle is 0.64
CONTEXT = 600.0  # [s] within which a way leads nowhere
MOSTLY = 65.0  # [%] of them: a third may be turns, errands, or an open window
LAG = 60.0  # [s] over which the wander is measured
WIDEST = 50.0  # [m] per axis: what goes further is movement, not error


@dataclass(frozen=True)
class Straightness:
    """Net over gross distance about some times ``(m,)`` [s]: walk over PATH, ride over RIDE; lasts: time PATH took [s].

    wander: standard deviation of the receiver's error per axis [m], as far as it is seen.
    """

    time: Array
    walk: Array
    ride: Array
    lasts: Array
    wander: Array


def straightness(time: Array, way: Array, begins: Array, ends: Array) -> Straightness:
    """Of a way ``(n, 2)`` at ``time (n,)``, in stretches ``(s,)`` from when to when it was recorded [s]."""
    at = np.concatenate([np.arange(a, b, GRID) for a, b in zip(begins, ends, strict=True)])
    way = interpolate(at, time, way)
    along = length_along(way) + 1e-6 * np.arange(len(at))  # where nobody moves it is to increase as well
    (walk, lasts), (ride, _) = (_net(at, way, along, gone) for gone in (PATH, RIDE_PATH))
    return Straightness(at, walk, ride, lasts, _wander(at, way, walk))


def _net(time: Array, way: Array, along: Array, gone: float) -> tuple[Array, Array]:
    """Net over gross distance, centred, and how long that way took [s]."""
    first, last = np.maximum(along - gone / 2, 0.0), np.minimum(along + gone / 2, along[-1])
    net = np.hypot(*(interpolate(last, along, way) - interpolate(first, along, way)).T)
    return net / np.maximum(last - first, 1.0), np.interp(last, along, time) - np.interp(first, along, time)


def _wander(time: Array, way: Array, straight: Array) -> Array:
    """Standard deviation per axis [m] of what leads nowhere; 0 where most of the way leads somewhere.

    Of a Gauss–Markov error of variance σ² the difference over LAG is Rayleigh's of 2σ² (1 − e^(−LAG/CORRELATED)).
    """
    index = np.arange(len(time))
    before, after = (np.clip(index + k, 0, len(time) - 1) for k in (-_samples(LAG / 2), _samples(LAG / 2)))
    apart = np.hypot(*(way[after] - way[before]).T)
    nowhere = (straight < CROOKED) & (time[after] - time[before] < LAG + GRID)  # not over a gap
    usual = percentile_filter(apart * nowhere, MOSTLY, 1 + 2 * _samples(CONTEXT / 2), mode="nearest")
    return usual / np.sqrt(2 * np.log(2) * 2 * (1 - np.exp(-LAG / CORRELATED)))


def _samples(span: float) -> int:
    """How many of the grid are in a time [s]."""
    return int(span / GRID)


def nearest_sample(straight: Straightness, time: Array) -> Index:
    """The sample before or at each time ``(m,)``, the first for what is earlier."""
    return np.maximum(np.searchsorted(straight.time, time, side="right") - 1, 0)


STANDS, WALKS, RIDES = STATES = range(3)  # what somebody does, as the hidden states and in what is made of them
EPOCH = 10.0  # [s]
WINDOW, NARROW = 40.0, 15.0  # [s] over which speeds are taken: to tell what was done, and when that changed
LASTS = 300.0  # [s] that people usually do one thing
SHUFFLING = 0.05  # [m/s] of who stands
WALK, WALK_VARIES = 1.2, 0.4  # [m/s] of walkers, with their turns and stops
RIDE_SPEED, RIDE_VARIES = 7.0, 0.9  # [m/s] of bicycles to cars, on a logarithmic scale
DAWDLING = 0.1  # share of a walk, of turns and short stops, in which one gets away at any lesser speed
WAITING, CREEPING = 0.15, 0.5  # share of a ride in which it hardly moves, and how fast then [m/s]
WILD, WILDER = 0.1, 3.0  # share of a receiver's errors that are so many times as large
BENDS = 0.1  # share of ways that lead anywhere or nowhere; the rest are distributed as (net / gross)^4
UNLIKELY = 1e-12
SHORTEST_RIDE = 3  # epochs


@dataclass(frozen=True)
class Epochs:
    """Equal parts of stretches that were recorded.

    start, middle: ``(e,)`` [s]; first, last: ``(e,)`` when the stretch of each began and ended [s]; begins: ``(e,)``
    True of the first one of a stretch.
    """

    start: Array
    middle: Array
    first: Array
    last: Array
    begins: Mask

    @classmethod
    def of(cls, begins: Array, ends: Array) -> Epochs:
        """Of stretches ``(s,)`` [s]."""
        count = np.maximum(np.round((ends - begins) / EPOCH), 1).astype(int)
        within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        first, last = np.repeat(begins, count), np.repeat(ends, count)
        each = (last - first) / np.repeat(count, count)
        return cls(first + each * within, first + each * (within + 0.5), first, last, within == 0)


def moves(seen: GpsKnots, way: Array, begins: Array, ends: Array, straight: Straightness) -> Index:
    """What was done from each knot to the next ``(n - 1,)``: STANDS, WALKS or RIDES; nonsense in gaps.

    way: ``(n, 2)`` [m], smooth; begins, ends: of stretches ``(s,)`` [s].
    """
    epochs = Epochs.of(begins, ends)
    lead = _by_straightness(epochs, straight)
    state = _most_probable(_by_speed(epochs, seen, way, WINDOW) + lead, epochs)

    # When it changed, by speeds over a shorter time about each change
    changed = np.append(False, np.diff(state) != 0) & ~epochs.begins
    open_ = maximum_filter1d(changed, 1 + 2 * round(WINDOW / EPOCH / 2))
    cost = _by_speed(epochs, seen, way, NARROW) + lead
    decided = np.where(np.array(STATES) == state[:, None], 0.0, np.inf)
    state = _without_jumps(_most_probable(np.where(open_[:, None], cost, decided), epochs), epochs)
    at = np.searchsorted(epochs.start, (seen.time[1:] + seen.time[:-1]) / 2, side="right") - 1
    return state[at]


def _most_probable(cost: Array, epochs: Epochs) -> Index:
    """States ``(e,)`` of the least cost; one stretch tells nothing of the next."""
    change = -np.log(EPOCH / LASTS / (len(STATES) - 1)) * (1 - np.eye(len(STATES)))
    return viterbi(cost, change * ~epochs.begins[1:, None, None])[0]


def _without_jumps(state: Index, epochs: Epochs) -> Index:
    """Rides too short to be any are what came after them in the stretch, or before: a receiver found its place."""
    first = np.flatnonzero(epochs.begins | np.append(True, np.diff(state) != 0))
    runs = [(a, b) for a, b in pairwise([*first, len(state)]) if state[a] == RIDES and b - a < SHORTEST_RIDE]
    state = state.copy()
    for a, b in runs:
        if b < len(state) and not epochs.begins[b]:
            state[a:b] = state[b]
        elif not epochs.begins[a]:
            state[a:b] = state[a - 1]
    return state


def _by_speed(epochs: Epochs, seen: GpsKnots, way: Array, window: float) -> Array:
    """Costs ``(e, 3)`` of the speeds at which one got away."""
    first = np.maximum(epochs.middle - window / 2, epochs.first)
    last = np.minimum(epochs.middle + window / 2, epochs.last)
    span = np.maximum(last - first, 1.0)
    speed = np.hypot(*(interpolate(last, seen.time, way) - interpolate(first, seen.time, way)).T) / span
    slow, white = (np.interp(epochs.middle, seen.time, error) for error in (seen.slow, seen.white))
    seems = np.sqrt(2 * slow**2 * (1 - np.exp(-span / CORRELATED)) + 2 * white**2) / span  # [m/s] of who stands
    likelihood = np.stack(_of_speeds(np.maximum(speed, SHUFFLING), np.hypot(seems, SHUFFLING)), axis=1)
    return -np.log(likelihood + UNLIKELY) * np.minimum(EPOCH / span, 1.0)[:, None]  # windows overlap: each counts once


def _of_speeds(speed: Array, seems: Array) -> tuple[Array, Array, Array]:
    """Likelihoods ``(e,)`` of speeds [m/s] of who stands, walks or rides; seems: the speed of noise per axis [m/s]."""
    stands = (1 - WILD) * _rayleigh(speed, seems) + WILD * _rayleigh(speed, WILDER * seems)
    walks = (1 - DAWDLING) * _normal(speed - WALK, np.hypot(WALK_VARIES, seems)) + DAWDLING / WALK * (speed < WALK)
    rides = _normal(np.log(speed / RIDE_SPEED), np.hypot(RIDE_VARIES, seems / np.maximum(speed, CREEPING))) / speed
    return stands, walks, (1 - WAITING) * rides + WAITING * _rayleigh(speed, np.hypot(seems, CREEPING))


def _by_straightness(epochs: Epochs, straight: Straightness) -> Array:
    """Costs ``(e, 3)`` of how straight the ways were: those of walks, and rides still more so, lead somewhere."""
    at = nearest_sample(straight, epochs.middle)
    walk, ride = (-np.log(BENDS + (1 - BENDS) * 5 * net[at] ** 4) for net in (straight.walk, straight.ride))
    counts = EPOCH / np.maximum(straight.lasts[at], WINDOW)
    return np.stack([np.zeros(len(at)), walk, walk + ride], axis=1) * counts[:, None]


def _rayleigh(value: Array, sigma: Array) -> Array:
    return value / sigma**2 * np.exp(-((value / sigma) ** 2) / 2)


def _normal(value: Array, sigma: Array) -> Array:
    return np.exp(-((value / sigma) ** 2) / 2) / sigma / np.sqrt(2 * np.pi)
