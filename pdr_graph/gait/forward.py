"""The forward axis: which way of the phone's attitude is the walker's ahead, from a straight walk.

A gyroscope tells by how much a walker turned, not which way they went. Gait does: every landing brakes the body and
every push drives it on, in step with its rise and fall. A method takes an `Attitude`, the walker's heading since the
first sample ``(n,)`` (which is taken out, so that the walk need not be straight), when they walked ``(n,)``, and the
usual duration of a step; it returns a `Forward`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft
from scipy.spatial.transform import Rotation

from pdr_graph.geometry import wrap_angle
from pdr_graph.inertial.attitude import Attitude
from pdr_graph.types import Array, Complex, Mask

BAND = 0.5  # of the step's frequency to either side: a stride's, half of it, and the next, one and a half, stay out
# The forward acceleration leads the vertical by this: 33–119° in sixteen of eighteen real walks with the phone in hand,
# 51–106° or half a turn from it with the phone in hand, pocket, bag and swinging arm (docs/accuracy.md)
LEAD = 1.1  # [rad]
STEPS_PER_WINDOW = 16
LEAST_WINDOWS = 3
LEAST_COHERENCE = 0.3  # of forward and vertical in a usual window; less is no gait, or no carried phone
GAIT_SIGMA = 0.3  # [rad] between what brakes and where people go: hands sway with their arm
EYES_SIGMA = 0.17  # [rad] between where people go and look, and where the phone that they read points
UNCONFIRMED = 0.35  # [rad] where gait does not say that the phone is held so
FACING_UP = 0.4  # of the screen's normal: held to be read
STEADY = 0.95  # length of the mean of its directions, against the walker's; a phone that is waved about has none
OPPOSED = 0.6  # [rad] between gait and the phone's y axis: it is held otherwise


@dataclass(frozen=True)
class Forward:
    """angle: from the heading given to the walking direction in the attitude's world; sigma: infinite if unknown."""

    angle: float
    sigma: float

    @property
    def known(self) -> bool:
        """True if anything was found out."""
        return bool(np.isfinite(self.sigma))


UNKNOWN = Forward(0.0, np.inf)


def forward_axis(attitude: Attitude, heading: Array, walking: Mask, step: float) -> Forward:
    """The default: a phone that is held to be read points where its walker goes; any other says what braked it.

    Where gait contradicts the first, as with a phone held across, gait is believed.
    """
    gait, eyes = braking_axis(attitude, heading, walking, step), reading_axis(attitude, heading, walking, step)
    if not eyes.known or not gait.known:
        return gait if gait.known else eyes
    if abs(wrap_angle(gait.angle - eyes.angle)) > OPPOSED:
        return gait
    return Forward(eyes.angle, EYES_SIGMA)


def reading_axis(attitude: Attitude, heading: Array, walking: Mask, step: float) -> Forward:
    """The phone's y axis, where its screen faces up and it is held still: so people look at it. `step` is not used."""
    if not walking.any():
        return UNKNOWN
    held = Rotation.from_quat(attitude.R_world_device.as_quat()[walking])
    if held.apply([0.0, 0.0, 1.0])[:, 2].mean() < FACING_UP:
        return UNKNOWN
    along = _level(held.apply([0.0, 1.0, 0.0])) * np.exp(-1j * heading[walking])
    if abs(along.mean()) < STEADY * np.abs(along).mean():
        return UNKNOWN
    return Forward(float(np.angle(along.mean())), UNCONFIRMED)


def braking_axis(attitude: Attitude, heading: Array, walking: Mask, step: float) -> Forward:
    """The level direction whose acceleration at the step's frequency leads the vertical's by LEAD.

    It needs no principal component: people sway to the side once in two steps, so that at the step's frequency hardly
    anything moves but forward, and the lead tells ahead from back.
    """
    level, vertical = at_step_frequency(attitude, heading, step)
    size = max(1, round(STEPS_PER_WINDOW * step / attitude.period))
    windows = [
        slice(k, k + size) for k in range(0, len(level) - size + 1, size) if np.mean(walking[k : k + size]) > 0.9
    ]
    if len(windows) < LEAST_WINDOWS:
        return UNKNOWN
    pushes = np.array([push(level[w], vertical[w]) for w in windows])
    mean = pushes.mean()
    if abs(mean) < LEAST_COHERENCE:
        return UNKNOWN
    aside = np.imag(pushes / mean)  # of each window's share, in radians for small angles
    return Forward(float(np.angle(mean)), float(np.hypot(GAIT_SIGMA, np.std(aside) / np.sqrt(len(windows)))))


def principal_axis(attitude: Attitude, heading: Array, walking: Mask, step: float) -> Forward:
    """[gps-dr] Sec. 2: the first principal component of the level acceleration over a short straight walk.

    Its half turn, which the paper does not mention, is resolved by the step pattern of its Sec. 2.2 (after the
    vertical + → − the forward − → +), by the lead as in `braking_axis`.
    """
    if not walking.any():
        return UNKNOWN
    level = _acceleration(attitude, heading)[0][walking]
    level = level - level.mean()
    doubled = np.mean(level**2)  # the axis of the largest variance, at twice its angle
    round_ = 1 - np.abs(doubled) / np.mean(np.abs(level) ** 2)  # 1 where no direction has more than another
    axis = np.exp(0.5j * np.angle(doubled))
    harmonic, vertical = (signal[walking] for signal in at_step_frequency(attitude, heading, step))
    ahead = np.real(push(harmonic, vertical) / axis)
    angle = np.angle(axis * (1 if ahead > 0 else -1))
    return Forward(float(angle), float(np.hypot(GAIT_SIGMA, round_ * np.pi / 4)))


def push(level: Complex, vertical: Complex) -> complex:
    """What of a level acceleration leads the vertical one: towards ahead, 1 if all of both."""
    ahead = np.real(vertical.conj() * np.exp(-1j * LEAD))
    return complex(np.mean(level * ahead) / np.sqrt(np.mean(np.abs(level) ** 2) * np.mean(ahead**2) + 1e-12))


def at_step_frequency(attitude: Attitude, heading: Array, step: float) -> tuple[Complex, Complex]:
    """Level acceleration (complex, ahead real) and the analytic vertical one, both ``(n,)``. [m/s²]"""
    level, up = _acceleration(attitude, heading)
    count = fft.next_fast_len(len(up)) or len(up)
    ratio = np.fft.fftfreq(count, attitude.period) * step
    window = np.cos(np.pi / 2 * np.clip((np.abs(ratio) - 1) / BAND, -1, 1)) ** 2

    def filtered(signal: Complex | Array, response: Array) -> Complex:
        spectrum = np.asarray(fft.fft(signal - signal.mean(), count))
        return np.asarray(fft.ifft(response * spectrum))[: len(signal)]

    return filtered(level, window), filtered(up, 2 * window * (ratio > 0))


def _acceleration(attitude: Attitude, heading: Array) -> tuple[Complex, Array]:
    """Level (complex, ahead real) and vertical, both ``(n,)``. [m/s²]"""
    world = attitude.R_world_device.apply(attitude.acceleration)
    return _level(world) * np.exp(-1j * heading), world[:, 2]


def _level(vectors: Array) -> Complex:
    """What of vectors ``(n, 3)`` is level, ``(n,)``: BLAS would set threads to work for it, and wait for them."""
    return vectors[:, 0] + 1j * vectors[:, 1]


def forward_acceleration(attitude: Attitude, heading: Array, forward: Forward) -> Array:
    """Acceleration along the walking direction ``(n,)``. [m/s²]"""
    return (_acceleration(attitude, heading)[0] * np.exp(-1j * forward.angle)).real
