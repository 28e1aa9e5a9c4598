"""Ways that lead nowhere: how far a receiver errs where nobody goes anywhere.

Indoors a receiver wanders by tens of metres within minutes, at the speed of a walker, whatever accuracy is stated. But
who goes somewhere gets there: over PATH metres of way a walker or a vehicle comes nearly as far as the crow flies, and
what wanders does not. This *straightness* (Batschelet, Circular Statistics in Biology, 1981: net over gross distance)
needs no threshold of speed or of distance, and knows a walk in a small garden from noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import percentile_filter

from pdr_graph.estimation.receivers import STANDING as CORRELATED
from pdr_graph.geometry import interpolate, length_along
from pdr_graph.types import Array, Index

GRID = 15.0  # [s] between samples of the way: shorter ones add a receiver's noise up
PATH, RIDE = 100.0, 600.0  # [m] of way over which a walk, and a ride, lead somewhere: street corners are about as far
CROOKED = 0.6  # straightness of a way that leads nowhere: half a circle is 0.64
CONTEXT = 600.0  # [s] within which a way leads nowhere
MOSTLY = 65.0  # [%] of them: a third may be turns, errands, or an open window
LAG = 60.0  # [s] over which the wander is measured
WIDEST = 50.0  # [m] per axis: what goes further is not believed to be an error


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
    (walk, lasts), (ride, _) = (_net(at, way, along, gone) for gone in (PATH, RIDE))
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
