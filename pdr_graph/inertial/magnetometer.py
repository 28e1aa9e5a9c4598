"""The magnetometer: calibration, two tests of its field, and a filter for the direction of north.

`magnetic_north` is the Kalman filter of gyroscope and magnetometer of [gps-dr] Sec. 3. The live field and the phone's
own iron are estimated as the samples arrive.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import sqrt

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from pdr_graph.frames import EarthField
from pdr_graph.geometry import interpolate, nearest
from pdr_graph.inertial.attitude import LONGEST_BRIDGED, Attitude
from pdr_graph.inertial.attitude_stream import SensorStream
from pdr_graph.types import Array, Signal

SMOOTHING = 0.5  # [s] of the Gaussian over the field's noise and the gait
PREDICTED_OVER = 1.0  # [s] over which the gyroscope predicts the field
MOST_SAMPLES, MOST_EVALUATIONS = 600, 60  # of a fit; where the turns tell little it would go on and on
USUAL_HARD, USUAL_SOFT = 300.0, 0.1  # [µT], [-] standard deviations of a phone's own, before any calibration
WELL_KNOWN = 3.0  # [µT] standard deviation of a hard iron that is worth taking away
TILTED = 0.8  # length of the mean of the vertical in the device; a phone that was hardly tilted knows not its iron
INDEPENDENT = 100  # of the samples in a building
UPPER = np.triu_indices(3)
USUAL_SPREAD = 3.0  # [µT] of the field's size about the ellipsoid, in a building: the width of the fit's robust loss


@dataclass(frozen=True)
class Iron:
    """What the phone itself does to the field.

    hard: ``(3,)`` added by magnets [µT]; soft: ``(3, 3)`` symmetric, takes away what iron bends; sigma: ``(3,)``
    standard deviations of ``hard``. field = soft (measured − hard).
    """

    hard: Array
    soft: Array
    sigma: Array

    @property
    def known(self) -> bool:
        """True if the phone was turned enough ways to tell."""
        return bool(np.all(self.sigma < WELL_KNOWN))

    def corrected(self, measured: Array) -> Array:
        """The field ``(n, 3)`` around the phone of the measured ``(n, 3)``. [µT]"""
        return (measured - self.hard) @ self.soft


def fit_iron(measured: Array, magnitude: float) -> Iron:
    """Hard and soft iron of samples ``(n, 3)`` that were taken while the phone was turned all ways. [µT]

    In one place the field has one size, so that the samples lie on an ellipsoid; a robust least squares finds the one
    that the sphere of ``magnitude`` [µT] becomes. Its covariance says what the turns did not tell.
    """
    from scipy.optimize import least_squares  # here, since few walks need it and it takes time to load

    some = measured[:: max(1, -(-len(measured) // MOST_SAMPLES))]
    spread = np.concatenate([np.full(3, USUAL_HARD), np.full(6, USUAL_SOFT)])
    usual = np.concatenate([np.zeros(3), np.eye(3)[UPPER]])
    # a building's field is the same over many samples in a row: they do not count as so many
    share = np.sqrt(min(1.0, INDEPENDENT / len(some)))

    def residuals(x: Array) -> Array:
        length = np.linalg.norm((some - x[:3]) @ _symmetric(x[3:]), axis=1)
        return np.concatenate([share * (length - magnitude) / USUAL_SPREAD, (x - usual) / spread])

    start = np.concatenate([np.median(some, axis=0), usual[3:]])
    fit = least_squares(residuals, start, loss="cauchy", f_scale=share, max_nfev=MOST_EVALUATIONS)
    sigma = np.sqrt(np.diag(np.linalg.inv(fit.jac.T @ fit.jac))[:3]) if fit.success else np.full(3, np.inf)
    return Iron(fit.x[:3], _symmetric(fit.x[3:]), sigma)


def unknown_iron(measured: Array) -> Iron:
    """A phone's before any fit to samples ``(n, 3)``, from which one sets out."""
    return Iron(np.median(measured, axis=0), np.eye(3), np.full(3, USUAL_HARD))


def refined(iron: Iron, measured: Array, magnitude: float) -> Iron:
    """One round of the fit of `fit_iron`, by Gauss and Newton, weighted: for samples ``(n, 3)`` that go on coming."""
    share = np.sqrt(min(1.0, INDEPENDENT / len(measured)))
    apart = measured - iron.hard
    corrected = apart @ iron.soft
    length = np.linalg.norm(corrected, axis=1)
    towards = corrected / np.maximum(length, 1e-9)[:, None]
    i, j = UPPER
    by_soft = towards[:, i] * apart[:, j] + np.where(i == j, 0.0, towards[:, j] * apart[:, i])
    by = np.concatenate([-towards @ iron.soft, by_soft], axis=1) / USUAL_SPREAD
    error = (length - magnitude) / USUAL_SPREAD
    spread = np.concatenate([np.full(3, USUAL_HARD), np.full(6, USUAL_SOFT)])
    now = np.concatenate([iron.hard, iron.soft[UPPER]])
    unusual = (now - np.concatenate([np.zeros(3), np.eye(3)[UPPER]])) / spread
    weighted = by * (share**2 / (1 + error**2))[:, None]
    information = weighted.T @ by + np.diag(spread**-2.0)
    now = now - np.linalg.solve(information, weighted.T @ error + unusual / spread)
    curved = np.maximum((1 - error**2) / (1 + error**2) ** 2, 0.0)  # the loss's second derivative
    certain = (by * (share**2 * curved)[:, None]).T @ by + np.diag(spread**-2.0)
    return Iron(now[:3], _symmetric(now[3:]), np.sqrt(np.diag(np.linalg.inv(certain))[:3]))


def measured_field(magnetometer: Signal, time: Array) -> Array:
    """The field ``(n, 3)`` in device axes at times ``(n,)`` [s]; 0, which tells no north, where none was measured."""
    field = interpolate(time, magnetometer.time, magnetometer.values)
    apart = np.abs(magnetometer.time[nearest(magnetometer.time, time)] - time)
    return np.where((apart > LONGEST_BRIDGED)[:, None], 0.0, field)


def predicted(field: Array, angular_rate: Array, period: float) -> Array:
    """[gps-dr] Eqs. (1)–(3): the field ``(n, 3)`` that the gyroscope expects next, m' = m − (ω × m) Δt. [µT]

    field ``(n, 3)`` [µT] and angular_rate ``(n, 3)`` [rad/s] in device axes; row k is expected at sample k + 1.
    """
    return field - np.cross(angular_rate, field) * period


def dip_error(field: Array, dip: float) -> Array:
    """[gps-dr] Sec. 3, first test: by how much ``(n,)`` the field dips otherwise than the earth's. [rad]

    field: ``(n, 3)`` in the attitude's world, z up; dip: below the horizon [rad]. The angle between the field and
    gravity, which points down, is 90° − dip.
    """
    return np.abs(np.arctan2(-field[:, 2], np.hypot(field[:, 0], field[:, 1])) - dip)


def prediction_error(field: Array, period: float) -> Array:
    """[gps-dr] Sec. 3, second test: the angle ``(n,)`` between the field and the one that the gyroscope predicts. [rad]

    field: ``(n, 3)`` in the attitude's world. The paper predicts one sample by `predicted`; there the sensor's noise
    is larger than any disturbance, so that we let the attitude predict a second: in the world, the field of a second
    before.
    """
    lag = min(max(1, round(PREDICTED_OVER / period)), len(field) - 1)
    one, other = field[lag:], field[:-lag]
    angle = np.arctan2(np.linalg.norm(np.cross(one, other), axis=1), np.sum(one * other, axis=1))
    return np.concatenate([np.repeat(angle[:1], lag), angle])


def field_in_world(attitude: Attitude, device: Array) -> Array:
    """The field ``(n, 3)`` in the attitude's world, without the sensor's noise, of device axes ``(n, 3)``. [µT]"""
    world = attitude.R_world_device.apply(device)
    return gaussian_filter1d(world, SMOOTHING / attitude.period, axis=0, mode="nearest")


def _symmetric(upper: Array) -> Array:
    """The symmetric matrix ``(3, 3)`` of its upper triangle ``(6,)``."""
    matrix = np.zeros((3, 3))
    matrix[UPPER] = upper
    return matrix + np.triu(matrix, 1).T


NORTH_INTERVAL = 1.0  # [s] between observations
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
    every = max(1, round(NORTH_INTERVAL / attitude.period))
    world = field_in_world(attitude, field)
    scores = np.stack([dip_error(world, earth.dip), prediction_error(world, attitude.period)])[:, ::every]
    world, time = world[::every], attitude.time[::every]
    level = np.hypot(world[:, 0], world[:, 1])
    valid = np.all(scores < DISTURBED, axis=0) & (level > WEAKEST * earth.magnitude * np.cos(earth.dip))
    if np.mean(valid) < HONEST_SHARE:
        return North(np.empty(0), np.empty(0), np.empty(0))
    seen = np.arctan2(world[:, 1], world[:, 0]) + earth.declination
    variance = UNDISTURBED**2 + np.sum(scores**2, axis=0) / np.cos(earth.dip) ** 2
    variance = np.where(valid, variance * (1 + 2 * ALIKE_FOR / NORTH_INTERVAL), np.inf)
    return North(time, *_smoothed(*_filtered(seen, variance)))


def _filtered(seen: Array, variance: Array) -> tuple[Array, Array]:
    """State and variance ``(n,)`` after each observation [rad, rad²]; before the first valid one they are its own."""
    first = int(np.argmin(np.isinf(variance)))
    state, doubt = float(seen[first]), float(variance[first])
    states, doubts = np.full(len(seen), state), np.full(len(seen), doubt)
    doubts[:first] += GYRO_WANDER**2 * NORTH_INTERVAL * np.arange(first, 0, -1)
    for k, (one, spread) in enumerate(zip(seen[first + 1 :].tolist(), variance[first + 1 :].tolist(), strict=True)):
        doubt += GYRO_WANDER**2 * NORTH_INTERVAL
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
        predicted = variance[k] + GYRO_WANDER**2 * NORTH_INTERVAL
        gain = variance[k] / predicted
        state[k] += gain * (state[k + 1] - state[k])
        variance[k] += gain**2 * (variance[k + 1] - predicted)
    return state, np.sqrt(variance)


PACKETS, KEPT = 20, 60.0  # that wait to be looked at, and [s] of samples that are kept for who asks late
LONGEST_APART = 120.0  # [s] between the latest sample and what is asked for
SAMPLES, IRON_INTERVAL = 600, 0.5  # the last ones that tell of iron, and [s] between them
ROUNDS = 3  # of the fit each time, which goes on from where it was


@dataclass
class MagnetometerStream:
    """What a magnetometer measured in the last minute.

    some, up: ``(n, 3)`` some samples in the device [µT], and the vertical in it; iron: rows of hard, soft and sigma,
    once there is a fit.
    """

    stream: SensorStream = field(default_factory=SensorStream)
    some: Array = field(default_factory=lambda: np.empty((0, 3)))
    up: Array = field(default_factory=lambda: np.empty((0, 3)))
    iron: Array = field(default_factory=lambda: np.empty((0, 3)))

    def push(self, time: Array, values: Array) -> None:
        """Samples at times ``(n,)`` [s], as of `Signal`."""
        self.stream.push(time, values)
        if len(self.stream.arrived) >= PACKETS:
            self.ingest()

    def ingest(self) -> None:
        """Look at what was pushed."""
        self.stream.ingest(self.stream.offset)
        self.stream.forget(self.stream.last - KEPT)

    def at(self, time: Array, R_world_device: Rotation) -> Array:
        """The field ``(n, 3)`` in device axes at the next times ``(n,)``, evenly spaced; 0 where there is none. [µT]"""
        self.ingest()
        if not len(self.stream.time) or not len(time):
            return np.zeros((len(time), 3))
        if abs(self.stream.last - time[-1]) > LONGEST_APART:  # it stopped, or what came first had a wild time
            self.stream = SensorStream()
            return np.zeros((len(time), 3))
        field = measured_field(Signal(self.stream.time, self.stream.values), time)
        few = max(1, round(IRON_INTERVAL * len(time) / (time[-1] - time[0] + 1e-9)))
        up = R_world_device.inv().apply([0.0, 0.0, 1.0])
        some = np.flatnonzero(np.any(field, axis=1))[::few]
        self.some = np.concatenate([self.some, field[some]])[-SAMPLES:]
        self.up = np.concatenate([self.up, up[some]])[-SAMPLES:]
        return field

    def without_iron(self, field: Array, magnitude: float) -> Array:
        """The field ``(n, 3)`` around the phone of a measured one, where its tilt has told of iron. [µT]"""
        if not len(self.up) or np.linalg.norm(self.up.mean(axis=0)) >= TILTED:
            return field
        iron = Iron(self.iron[0], self.iron[1:4], self.iron[4]) if len(self.iron) else unknown_iron(self.some)
        for _ in range(ROUNDS):
            iron = refined(iron, self.some, magnitude)
        self.iron = np.vstack([iron.hard, iron.soft, iron.sigma])
        return np.where(np.any(field, axis=1)[:, None], iron.corrected(field), 0.0) if iron.known else field
