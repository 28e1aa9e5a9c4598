"""The magnetometer: its calibration, and two tests of whether it tells north."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from pdr_graph.geometry import interpolate, nearest
from pdr_graph.inertial.attitude import Attitude
from pdr_graph.inertial.samples import LONGEST_BRIDGED
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
