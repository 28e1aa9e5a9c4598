"""Where north is in the attitude's world: a Kalman filter of gyroscope and magnetometer, [gps-dr] Sec. 3."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import numpy as np

from pdr_graph.earth import EarthField
from pdr_graph.inertial.attitude import Attitude
from pdr_graph.inertial.magnetometer import dip_error, field_in_world, prediction_error
from pdr_graph.types import Array

EVERY = 1.0  # [s] between observations
GYRO_WANDER = 0.004  # [rad] per root second: of the attitude's heading, bias removed
UNDISTURBED = 0.12  # [rad] by which a field that passes both tests may still point elsewhere
ALIKE_FOR = 2.5  # [s] a walker sees the same disturbance: about three metres
DISTURBED = 0.35  # [rad] of an error in either test: such an observation is left out
WEAKEST = 0.3  # of the earth's level field: less points anywhere, and a dead sensor's nowhere
HUBER = 2.0  # [σ] beyond which an observation is held to be no further off
HONEST_SHARE = 0.3  # of the observations that must pass; otherwise nothing is believed of the others either


@dataclass(frozen=True)
class North:
    """True north over time.

    time: ``(m,)`` [s]; direction: ``(m,)`` of true north in the attitude's world, counter-clockwise from x, not wrapped
    [rad]; sigma: ``(m,)`` [rad]. Empty where the magnetometer tells nothing.
    """

    time: Array
    direction: Array
    sigma: Array

    def __len__(self) -> int:
        return len(self.time)


def magnetic_north(attitude: Attitude, field: Array, earth: EarthField) -> North:
    """North by the heading filter of [gps-dr] Sec. 3, run both ways.

    The paper filters the heading itself, driven by the gyroscope; in the attitude's world, which the gyroscope holds,
    that is a filter of a constant direction. Both validity scores set the observation's variance: a disturbance that
    tilts the field by so much turns it by as much over the cosine of the dip. The paper lets them set the process's
    variance too; a field that turns against the gyroscope is on real walks the building's (its turn rate against the
    gyroscope's has a spread of ±70°/min), so that the process has the gyroscope's own.

    field: ``(n, 3)`` in device axes, hard and soft iron removed [µT].
    """
    every = max(1, round(EVERY / attitude.period))
    world = field_in_world(attitude, field)
    scores = np.stack([dip_error(world, earth.dip), prediction_error(world, attitude.period)])[:, ::every]
    world, time = world[::every], attitude.time[::every]
    level = np.hypot(world[:, 0], world[:, 1])
    valid = np.all(scores < DISTURBED, axis=0) & (level > WEAKEST * earth.magnitude * np.cos(earth.dip))
    if np.mean(valid) < HONEST_SHARE:
        return North(np.empty(0), np.empty(0), np.empty(0))
    seen = np.arctan2(world[:, 1], world[:, 0]) + earth.declination
    variance = UNDISTURBED**2 + np.sum(scores**2, axis=0) / np.cos(earth.dip) ** 2
    variance = np.where(valid, variance * (1 + 2 * ALIKE_FOR / EVERY), np.inf)
    return North(time, *_smoothed(*_filtered(seen, variance)))


def _filtered(seen: Array, variance: Array) -> tuple[Array, Array]:
    """State and variance ``(n,)`` after each observation [rad, rad²]; before the first valid one they are its own."""
    first = int(np.argmin(np.isinf(variance)))
    state, doubt = float(seen[first]), float(variance[first])
    states, doubts = np.full(len(seen), state), np.full(len(seen), doubt)
    doubts[:first] += GYRO_WANDER**2 * EVERY * np.arange(first, 0, -1)
    for k, (one, spread) in enumerate(zip(seen[first + 1 :].tolist(), variance[first + 1 :].tolist(), strict=True)):
        doubt += GYRO_WANDER**2 * EVERY
        gain = doubt / (doubt + spread)
        surprise = (one - state + np.pi) % (2 * np.pi) - np.pi
        widest = HUBER * sqrt(doubt + spread)
        state += gain * min(max(surprise, -widest), widest)
        doubt *= 1 - gain
        states[first + 1 + k], doubts[first + 1 + k] = state, doubt
    return states, doubts


def _smoothed(state: Array, variance: Array) -> tuple[Array, Array]:
    """State and standard deviation ``(n,)`` given all observations: Rauch, Tung and Striebel's backward pass."""
    state, variance = state.copy(), variance.copy()
    for k in range(len(state) - 2, -1, -1):
        predicted = variance[k] + GYRO_WANDER**2 * EVERY
        gain = variance[k] / predicted
        state[k] += gain * (state[k + 1] - state[k])
        variance[k] += gain**2 * (variance[k + 1] - predicted)
    return state, np.sqrt(variance)
