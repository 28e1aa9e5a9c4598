"""The magnetometer: calibration, two tests of its field, and a filter for the direction of north; batch and live.

`magnetic_north` is the Kalman filter of gyroscope and magnetometer of [gps-dr] Sec. 3.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import sqrt

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.spatial.transform import Rotation

from pdr_graph.frames import EarthField
from pdr_graph.geometry import gaussian_weights, interpolate, nearest
from pdr_graph.inertial.attitude import Attitude
from pdr_graph.inertial.sensor_stream import SensorStream
from pdr_graph.priors import MAGNETOMETER, NORTH, REST
from pdr_graph.types import Array, Signal

UPPER = np.triu_indices(3)


@dataclass(frozen=True)
class Iron:
    """Hard and soft iron of a phone: field = soft (measured − hard).

    hard: ``(3,)`` field of its magnets [µT]; soft: ``(3, 3)`` symmetric, corrects the distortion by its iron [-];
    sigma: ``(3,)`` standard deviations of ``hard`` [µT].
    """

    hard: Array
    soft: Array
    sigma: Array

    @property
    def reliable(self) -> bool:
        """True if the phone was turned enough to determine its hard iron to 3 µT."""
        return bool(np.all(self.sigma < MAGNETOMETER.hard_sigma))

    def corrected(self, measured: Array) -> Array:
        """The field around the phone ``(n, 3)`` from the measured one ``(n, 3)``. [µT]"""
        return (measured - self.hard) @ self.soft


def fit_iron(measured: Array, magnitude: float, iron: Iron | None = None, rounds: int | None = None) -> Iron:
    """Hard and soft iron from samples ``(n, 3)`` of a phone in changing orientations. [µT]

    The field has a constant magnitude [µT], so that the samples lie on an ellipsoid: robust least squares finds the one
    into which iron deforms the sphere. The sigmas are large where the orientations do not determine it.

    iron: start of the search; rounds: of Gauss–Newton steps with Cauchy's loss, enough from any start by default.
    """
    samples = measured[:: max(1, -(-len(measured) // MAGNETOMETER.fit_samples))]
    if iron is None:
        iron = Iron(np.median(samples, axis=0), np.eye(3), np.full(3, MAGNETOMETER.hard_spread))
    for _ in range(rounds or MAGNETOMETER.fit_rounds):
        iron = _refined(iron, samples, magnitude)
    return iron


def _refined(iron: Iron, measured: Array, magnitude: float) -> Iron:
    """Iron after one Gauss–Newton iteration."""
    share = np.sqrt(min(1.0, MAGNETOMETER.independent / len(measured)))
    apart = measured - iron.hard
    corrected = apart @ iron.soft
    length = np.linalg.norm(corrected, axis=1)
    towards = corrected / np.maximum(length, 1e-9)[:, None]
    i, j = UPPER
    by_soft = towards[:, i] * apart[:, j] + np.where(i == j, 0.0, towards[:, j] * apart[:, i])
    jacobian = np.concatenate([-towards @ iron.soft, by_soft], axis=1) / MAGNETOMETER.field_spread
    error = (length - magnitude) / MAGNETOMETER.field_spread
    usual, spread = _iron_prior()
    state = np.concatenate([iron.hard, iron.soft[UPPER]])
    unusual = (state - usual) / spread
    weighted = jacobian * (share**2 / (1 + error**2))[:, None]
    information = weighted.T @ jacobian + np.diag(spread**-2.0)
    state = state - np.linalg.solve(information, weighted.T @ error + unusual / spread)
    curvature = np.maximum((1 - error**2) / (1 + error**2) ** 2, 0.0)  # second derivative of the Cauchy loss
    certain = (jacobian * (share**2 * curvature)[:, None]).T @ jacobian + np.diag(spread**-2.0)
    return Iron(state[:3], _symmetric(state[3:]), np.sqrt(np.diag(np.linalg.inv(certain))[:3]))


def _iron_prior() -> tuple[Array, Array]:
    """Mean and standard deviation ``(9,)`` of hard iron [µT] and upper triangle of the soft iron, of any phone."""
    mean = np.concatenate([np.zeros(3), np.eye(3)[UPPER]])
    return mean, np.concatenate([np.full(3, MAGNETOMETER.hard_spread), np.full(6, MAGNETOMETER.soft_spread)])


def _symmetric(upper: Array) -> Array:
    """The symmetric matrix ``(3, 3)`` from its upper triangle ``(6,)``."""
    matrix = np.zeros((3, 3))
    matrix[UPPER] = upper
    return matrix + np.triu(matrix, 1).T


def measured_field(magnetometer: Signal, time: Array) -> Array:
    """The field ``(n, 3)`` in device axes at times ``(n,)`` [s]; 0 more than a second from any sample. [µT]"""
    field = interpolate(time, magnetometer.time, magnetometer.values)
    apart = np.abs(magnetometer.time[nearest(magnetometer.time, time)] - time)
    return np.where((apart > REST.longest_bridged)[:, None], 0.0, field)


def predicted_field(field: Array, angular_rate: Array, period: float) -> Array:
    """[gps-dr] Eqs. (1)–(3): the field ``(n, 3)`` that the gyroscope predicts, m' = m − (ω × m) Δt. [µT]

    field ``(n, 3)`` [µT] and angular_rate ``(n, 3)`` [rad/s] in device axes; row k is the prediction for sample k + 1.
    """
    return field - np.cross(angular_rate, field) * period


def dip_error(field: Array, dip: float) -> Array:
    """[gps-dr] Sec. 3, first test: difference ``(n,)`` between the dip of the field and that of the earth's. [rad]

    field: ``(n, 3)`` in the attitude's world, z up; dip: below the horizon [rad]. The angle between the field and
    gravity, which points down, is 90° − dip.
    """
    return np.abs(np.arctan2(-field[:, 2], np.hypot(field[:, 0], field[:, 1])) - dip)


def prediction_error(field: Array, period: float) -> Array:
    """[gps-dr] Sec. 3, second test: the angle ``(n,)`` between the field and the one that the gyroscope predicts. [rad]

    field: ``(n, 3)`` in the attitude's world. The paper predicts the next sample by `predicted_field`; over so
    short a time the sensor's noise exceeds any disturbance. Here the attitude predicts over a second: the prediction is
    the field in the world a second earlier.
    """
    lag = min(max(1, round(MAGNETOMETER.prediction / period)), len(field) - 1)
    later, earlier = field[lag:], field[: len(field) - lag]
    angle = np.arctan2(np.linalg.norm(np.cross(later, earlier), axis=1), np.sum(later * earlier, axis=1))
    return np.concatenate([np.repeat(angle[:1], lag), angle])


def field_in_world(attitude: Attitude, device: Array, every: int = 1) -> Array:
    """The smoothed field in the attitude's world, at every so many samples, from that in device axes ``(n, 3)``. [µT]

    Only the rows that are returned are smoothed: an observation of north per second needs one of a hundred.
    """
    weights = gaussian_weights(MAGNETOMETER.smoothing / attitude.period)
    reach = len(weights) // 2
    world = np.pad(attitude.R_world_device.apply(device), ((reach, reach), (0, 0)), mode="edge")
    return sliding_window_view(world, len(weights), axis=0)[::every] @ weights


@dataclass(frozen=True)
class North:
    """True north over time.

    time: ``(m,)`` [s]; direction: ``(m,)`` of true north in the attitude's world, counter-clockwise from x, not wrapped
    [rad]; sigma: ``(m,)`` [rad]. 0 rows if the field is too disturbed.
    """

    time: Array
    direction: Array
    sigma: Array

    def __len__(self) -> int:
        return len(self.time)


def magnetic_north(attitude: Attitude, field: Array, earth: EarthField) -> North:
    """North by the heading filter of [gps-dr] Sec. 3, run forwards and backwards.

    field: ``(n, 3)`` in device axes, hard and soft iron removed [µT].

    The paper filters the heading, driven by the gyroscope. The gyroscope already stabilises the attitude's world, so
    that this is a filter of a constant direction. Both test errors widen the observation's sigma: a disturbance that
    tilts the field by an angle turns it by that angle over the cosine of the dip. The paper lets them widen the
    process noise too. On real walks a field that turns against the gyroscope is the building's (its turn rate against
    the gyroscope's has a spread of ±70°/min), so that here the process noise is the gyroscope's own.
    """
    every = max(1, round(NORTH.interval / attitude.period))
    world, time = field_in_world(attitude, field, every), attitude.time[::every]
    errors = np.stack([dip_error(world, earth.dip), prediction_error(world, every * attitude.period)])
    level = np.hypot(world[:, 0], world[:, 1])
    valid = np.all(errors < NORTH.disturbed, axis=0) & (level > NORTH.weakest * earth.magnitude * np.cos(earth.dip))
    if np.mean(valid) < NORTH.least_valid:
        return North(np.empty(0), np.empty(0), np.empty(0))
    observed = np.arctan2(world[:, 1], world[:, 0]) + earth.declination
    variance = NORTH.undisturbed**2 + np.sum(errors**2, axis=0) / np.cos(earth.dip) ** 2
    variance = np.where(valid, variance * (1 + 2 * NORTH.alike / NORTH.interval), np.inf)
    return North(time, *_smoothed(observed, variance))


def _smoothed(observed: Array, variance: Array) -> tuple[Array, Array]:
    """Direction and standard deviation ``(n,)`` [rad] given all observations and their variances ``(n,)`` [rad²].

    A Kalman filter with clipped innovations, then the backward pass of Rauch, Tung and Striebel. Observations before
    the first valid one have no effect.
    """
    grows, first = NORTH.drift**2 * NORTH.interval, int(np.argmin(np.isinf(variance)))
    state, uncertainty = float(observed[first]), float(variance[first])
    states, uncertainties = [state] * (first + 1), [uncertainty + grows * k for k in range(first, -1, -1)]
    for measured, spread in zip(observed[first + 1 :].tolist(), variance[first + 1 :].tolist(), strict=True):
        uncertainty += grows
        gain = uncertainty / (uncertainty + spread)
        innovation = (measured - state + np.pi) % (2 * np.pi) - np.pi
        widest = NORTH.huber * sqrt(uncertainty + spread)
        state += gain * min(max(innovation, -widest), widest)
        uncertainty *= 1 - gain
        states.append(state)
        uncertainties.append(uncertainty)
    for k in range(len(states) - 2, -1, -1):
        predicted = uncertainties[k] + grows
        gain = uncertainties[k] / predicted
        states[k] += gain * (states[k + 1] - states[k])
        uncertainties[k] += gain**2 * (uncertainties[k + 1] - predicted)
    return np.array(states), np.sqrt(uncertainties)


@dataclass(frozen=True)
class LiveMagnetometerSettings:
    """Constants of the live magnetometer, chosen by hand.

    packets: number of packets that are ingested together; history: duration of the stored samples [s], for late
        requests; furthest: between the latest sample and a requested time [s], else the samples are discarded.
    interval: between the samples to which iron is fitted [s]; rounds: iterations per fit.
    """

    packets: int = 20
    history: float = 60.0
    furthest: float = 120.0
    interval: float = 0.5
    rounds: int = 3


LIVE_MAGNETOMETER = LiveMagnetometerSettings()


@dataclass
class MagnetometerStream:
    """The magnetometer's samples of the last minute, and the phone's iron.

    calibration, up: ``(n, 3)`` samples in device axes for the fit of iron [µT], and the vertical in the device at
    them; iron: None before the first fit.
    """

    stream: SensorStream = field(default_factory=SensorStream)
    calibration: Array = field(default_factory=lambda: np.empty((0, 3)))
    up: Array = field(default_factory=lambda: np.empty((0, 3)))
    iron: Iron | None = None

    def push(self, time: Array, values: Array) -> None:
        """Add samples at times ``(n,)`` [s], as in `Signal`."""
        self.stream.push(time, values)
        if len(self.stream.arrived) >= LIVE_MAGNETOMETER.packets:
            self.ingest()

    def ingest(self) -> None:
        """Validate the samples that were pushed, and drop those older than a minute."""
        self.stream.ingest(self.stream.offset)
        self.stream.forget(self.stream.last - LIVE_MAGNETOMETER.history)

    def measured(self, time: Array) -> Array:
        """The field ``(n, 3)`` in device axes at times ``(n,)`` [s]; 0 without samples. [µT]"""
        self.ingest()
        if not len(self.stream.time) or not len(time):
            return np.zeros((len(time), 3))
        if abs(self.stream.last - time[-1]) > LIVE_MAGNETOMETER.furthest:  # it stopped, or its first times were wrong
            self.stream = SensorStream()
            return np.zeros((len(time), 3))
        return measured_field(Signal(self.stream.time, self.stream.values), time)

    def at(self, time: Array, R_world_device: Rotation) -> Array:
        """The same, at evenly spaced times; adds the samples to those for the fit of iron."""
        field = self.measured(time)
        if not len(time):
            return field
        every = max(1, round(LIVE_MAGNETOMETER.interval * len(time) / (time[-1] - time[0] + 1e-9)))
        up = R_world_device.inv().apply([0.0, 0.0, 1.0])
        selected = np.flatnonzero(np.any(field, axis=1))[::every]
        self.calibration = np.concatenate([self.calibration, field[selected]])[-MAGNETOMETER.fit_samples :]
        self.up = np.concatenate([self.up, up[selected]])[-MAGNETOMETER.fit_samples :]
        return field

    def without_iron(self, field: Array, magnitude: float) -> Array:
        """The field around the phone ``(n, 3)``; the measured one if the phone was not tilted enough. [µT]"""
        if not len(self.up) or np.linalg.norm(self.up.mean(axis=0)) >= MAGNETOMETER.tilted:
            return field
        self.iron = iron = fit_iron(self.calibration, magnitude, self.iron, LIVE_MAGNETOMETER.rounds)
        return np.where(np.any(field, axis=1)[:, None], iron.corrected(field), 0.0) if iron.reliable else field
