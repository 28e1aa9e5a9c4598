"""The motion of the phone on the body, in one of six holds: acceleration and angular rate without sensor errors.

The phone hangs by a lever from a hinge on the body: the wrist, the hip above a trouser pocket, the strap of a bag. The
gait moves the body and swings the lever, as harmonics of the stride; each landing causes a shock. Acceleration and
angular rate are the derivatives of that one movement, so that they agree with each other and with the truth. All
amplitudes in this file are fitted so that simulated and real recordings have similar spectra (docs/simulation.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, Slerp

from pdr_graph.geometry import compose
from pdr_graph.lab.simulation.body import HOLD_CHANGE_TIME, Body, Pedestrian, smooth_noise
from pdr_graph.types import STANDARD_GRAVITY, Array, OneLineRepr, Recording, Signal, time_span

USUAL_STEP = 0.72  # [m] at which the amplitudes in this file hold
HIP = 0.53  # height of the body's centre as a share of the stature


@dataclass(frozen=True)
class Hold:
    """A way to carry a phone. Body axes are right, forward, up.

    axes: directions of the device's x, y and z in body axes; spread: of these between people and walks [rad].
    hinge: position relative to the body's centre, as a share of the stature; lever: from the hinge to the phone [m].
    swings: harmonics of the stride: number, axis, amplitude [rad], phase [rad].
    bounce: factor of the body's vertical movement; shock: of a landing [m/s²], its frequency [Hz] and decay [s];
    one_sided: share by which the shock of the other leg is weaker, and its delay [s].
    tremor: fast rotation [rad]; wander: slow rotation about the vertical and the horizontal axes [rad]; roughness: of
    the acceleration between 1 and 8 Hz [m/s²].
    """

    axes: tuple[tuple[float, float, float], ...]
    spread: float
    hinge: tuple[float, float, float]
    lever: tuple[float, float, float] = (0.0, 0.0, 0.0)
    swings: tuple[tuple[int, str, float, float], ...] = ()
    bounce: float = 1.0
    shock: tuple[float, float, float] = (1.0, 9.0, 0.05)
    one_sided: tuple[float, float] = (0.0, 0.0)
    tremor: float = 0.004
    wander: tuple[float, float] = (0.07, 0.04)
    roughness: float = 0.4


RIGHT, FRONT, UP = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
LEFT, BACK, DOWN = (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0)
C, S = np.cos(0.6), np.sin(0.6)  # of 0.6 rad, by which the top of a phone in the hand is raised
HOLDS = {
    "hand": Hold(
        axes=(RIGHT, (0.0, C, S), (0.0, -S, C)),
        spread=0.12,
        hinge=(0.0, 0.18, 0.17),
        swings=((2, "right", 0.034, 0.4), (1, "forward", 0.060, 0.8), (1, "up", 0.055, 0.0), (3, "up", 0.010, 1.0)),
        shock=(4.0, 8.0, 0.05),
        tremor=0.010,
        wander=(0.05, 0.05),
        roughness=0.65,
    ),
    "swinging arm": Hold(
        axes=(UP, FRONT, LEFT),
        spread=0.25,
        hinge=(0.11, 0.0, 0.28),
        lever=(0.02, 0.13, -0.62),
        swings=((1, "right", 0.24, 0.0), (2, "right", 0.002, -2.2), (1, "up", 0.08, 0.7), (1, "forward", 0.04, 0.2)),
        bounce=0.85,
        shock=(2.2, 8.0, 0.05),
        wander=(0.06, 0.06),
    ),
    "trouser pocket": Hold(
        axes=(RIGHT, DOWN, FRONT),
        spread=0.30,
        hinge=(0.06, 0.03, -0.02),
        lever=(0.04, 0.10, -0.22),
        swings=((1, "right", 0.24, 0.3), (2, "right", 0.06, -1.7), (3, "right", 0.06, -0.9), (1, "up", 0.06, 1.0)),
        bounce=1.10,
        shock=(24.0, 7.0, 0.09),
        one_sided=(0.4, 0.08),
        tremor=0.012,
        wander=(0.06, 0.05),
        roughness=1.2,
    ),
    "breast pocket": Hold(
        axes=(LEFT, UP, FRONT),
        spread=0.20,
        hinge=(-0.05, 0.07, 0.22),
        swings=((2, "right", 0.020, 0.0), (1, "forward", 0.030, 0.5), (1, "up", 0.070, 0.0)),
        shock=(5.0, 8.0, 0.05),
        tremor=0.006,
        roughness=0.8,
        wander=(0.03, 0.03),
    ),
    "bag": Hold(
        axes=(FRONT, UP, RIGHT),
        spread=1.5,  # any orientation
        hinge=(0.10, -0.03, 0.25),
        lever=(0.08, 0.0, -0.55),
        swings=((1, "right", 0.05, 0.9), (2, "right", 0.02, -2.2), (1, "forward", 0.05, 0.3), (1, "up", 0.06, 1.5)),
        bounce=1.12,
        shock=(9.0, 7.0, 0.07),
        one_sided=(0.4, 0.03),
        tremor=0.006,
        wander=(0.06, 0.05),
        roughness=1.2,
    ),
    "cart": Hold(
        axes=(RIGHT, FRONT, UP),
        spread=0.0,
        hinge=(0.0, 0.0, 0.0),
        bounce=0.0,
        shock=(0.0, 9.0, 0.05),
        tremor=0.0,
        wander=(0.0, 0.0),
        roughness=0.0,
    ),
}


@dataclass(frozen=True)
class Motion(OneLineRepr):
    """The measurements of a phone with perfect sensors.

    rate [Hz]; time: ``(n,)`` [s]; R_world_device: n rotations; acceleration: ``(n, 3)`` specific force with gravity,
    device axes [m/s²]; angular_rate: ``(n, 3)`` device axes [rad/s]; height: ``(n,)`` [m].
    """

    rate: float
    time: Array
    R_world_device: Rotation = field(repr=False)
    acceleration: Array
    angular_rate: Array
    height: Array

    def _summary(self) -> list[str]:
        return [*time_span(self), f"{self.rate:g} Hz"]


CART_VIBRATION, CART_ROCKING = 0.6, 0.05  # [m/s²], [rad/s] at 0.5 m/s: castors on a floor


def carry(body: Body, walker: Pedestrian, random: np.random.Generator) -> Motion:
    """The motion of the phone that a walker carries."""
    n, rate = len(body.time), body.rate
    stride = _Stride.of(body, walker, random)
    changes = body.events_of("hold")
    holds = [HOLDS[event.what] for event in changes]
    starts = [event.start for event in changes]
    weights = _weights(body.time, starts)

    # Position and rotation in body axes
    swing = sum((w[:, None] * stride.rotation(h.swings) for h, w in zip(holds, weights, strict=True)), np.zeros((n, 3)))
    swing += _unsteadiness(body, holds, weights, stride.vigour, random)
    swing += _shaking(body, random)
    swinging = Rotation.from_rotvec(swing)
    place = np.zeros((n, 3))
    for hold, weight in zip(holds, weights, strict=True):
        hinge = np.array(hold.hinge) * walker.height + hold.bounce * stride.bounce
        place += weight[:, None] * (hinge + swinging.apply(hold.lever))

    # In the world
    to_world = Rotation.from_euler("Z", body.heading[:, None] - np.pi / 2)
    position = np.column_stack([body.position, body.height + HIP * walker.height]) + to_world.apply(place)
    R_world_device = to_world * swinging * _bases(body.time, starts, holds, random)

    # Specific force and angular rate
    force = _second_derivative(position, rate)
    force[:, 2] += STANDARD_GRAVITY
    force += to_world.apply(
        _shocks(body, holds, weights, random) + _roughness(body, holds, weights, stride.vigour, random)
    )
    between = compose(R_world_device[:-1].inv(), R_world_device[1:]).as_rotvec() * rate
    angular_rate = np.concatenate([between[:1], (between[:-1] + between[1:]) / 2, between[-1:]])
    rolling = (np.abs(body.rolling)[:, None] / 0.5) ** 0.3  # vibration sets in at low speeds
    angular_rate += CART_ROCKING * rolling * _vibration(random, n, rate)
    acceleration = R_world_device.inv().apply(force) + CART_VIBRATION * rolling * _vibration(random, n, rate)
    return Motion(rate, body.time, R_world_device, acceleration, angular_rate, position[:, 2])


Harmonics = tuple[tuple[int, str, float, float], ...]  # number, axis, amplitude, phase [rad]
# Of the body's centre, amplitudes in m. Harmonics of the stride; 2, 4, … are harmonics of the step
BOUNCE: Harmonics = (
    (2, "up", 0.0242, np.pi),
    (4, "up", 0.0013, 2.6),
    (6, "up", 0.0004, 1.0),
    (8, "up", 0.0002, 0.0),
    (1, "up", 0.0035, 1.2),  # the legs differ
    (2, "forward", 0.0055, -2.1),  # braking after a landing, pushing before the next
    (4, "forward", 0.0012, 0.5),
    (1, "right", 0.0200, 0.0),
    (3, "right", 0.0015, 0.6),
)
AXES = {"right": 0, "forward": 1, "up": 2}
STRIDE_VARIATION = 0.12  # relative standard deviation of the amplitudes from stride to stride
PERSONAL_SPREAD = 0.45  # log-normal spread of higher harmonics and shocks between people and shoes


@dataclass(frozen=True)
class _Stride:
    """The harmonics of one person's gait.

    phase: ``(n,)`` strides so far; vigour: ``(n,)`` step length over USUAL_STEP, 0 at rest; bounce_factor: of the
    walker; variation: ``(n,)`` factor of all amplitudes; shift, personal: ``(12,)`` phase shift [rad] and amplitude
    factor of each harmonic.
    """

    phase: Array
    vigour: Array
    bounce_factor: float
    variation: Array
    shift: Array
    personal: Array

    @classmethod
    def of(cls, body: Body, walker: Pedestrian, random: np.random.Generator) -> _Stride:
        vigour = body.step_length / USUAL_STEP
        variation = 1 + smooth_noise(random, len(vigour), 1.1 * body.rate, STRIDE_VARIATION)[:, 0]
        personal = np.exp(random.normal(0, PERSONAL_SPREAD, 12))
        personal[0] = 1.0  # the first harmonic is scaled by the walker's bounce
        return cls(body.phase, vigour, walker.bounce, variation, random.normal(0, 0.35, 12), personal)

    @property
    def bounce(self) -> Array:
        """Movement of the body's centre ``(n, 3)``: right, forward, up [m].

        That of an inverted pendulum grows with the square of the step length; in short, shuffling steps it is larger.
        """
        return self.bounce_factor * (self.vigour**1.5)[:, None] * self._sum(BOUNCE, self.personal)

    def rotation(self, swings: Harmonics) -> Array:
        """Rotation vectors ``(n, 3)`` of a lever [rad]."""
        return self.vigour[:, None] * self._sum(swings, self.personal**0.5)

    def _sum(self, harmonics: Harmonics, personal: Array) -> Array:
        """The sum of harmonics ``(n, 3)``, in the unit of their amplitudes."""
        total = np.zeros((len(self.phase), 3))
        for n, (harmonic, axis, amplitude, phase) in enumerate(harmonics):
            angle = 2 * np.pi * harmonic * self.phase + phase + (self.shift[n] if n else 0.0)
            total[:, AXES[axis]] += personal[n] * amplitude * self.variation * np.cos(angle)
        return total


def _weights(time: Array, starts: Sequence[float]) -> list[Array]:
    """The weight of each hold ``(n,)``, 0–1: one blends into the next over HOLD_CHANGE_TIME."""
    ramps = [
        np.clip((time - start) / HOLD_CHANGE_TIME, 0, 1) if k else np.ones(len(time)) for k, start in enumerate(starts)
    ]
    ramps = [r * r * (3 - 2 * r) for r in ramps]
    following = [*ramps[1:], np.zeros(len(time))]
    return [ramp - after for ramp, after in zip(ramps, following, strict=True)]


def _bases(time: Array, starts: Sequence[float], holds: Sequence[Hold], random: np.random.Generator) -> Rotation:
    """Rotations from device to body axes ``(n,)``: constant in each hold, interpolated while it changes."""
    bases = [
        Rotation.from_rotvec(random.normal(0, hold.spread, 3)) * Rotation.from_matrix(np.array(hold.axes).T)
        for hold in holds
    ]
    changes = [t for start in starts[1:] for t in (start, start + HOLD_CHANGE_TIME)]
    times = np.maximum.accumulate([-1.0, *changes, time[-1] + HOLD_CHANGE_TIME + 1])
    keys = [base for base in bases for _ in range(2)]
    later = np.diff(times, prepend=-2.0) > 1e-6
    rotations = Rotation.concatenate([key for key, keep in zip(keys, later, strict=True) if keep])
    return Slerp(times[later], rotations)(time)


def _unsteadiness(
    body: Body, holds: Sequence[Hold], weights: Sequence[Array], vigour: Array, random: np.random.Generator
) -> Array:
    """Rotation vectors ``(n, 3)`` of a hand's tremor and slow wander [rad]."""
    n, rate = len(body.time), body.rate
    tremor = smooth_noise(random, n, 0.12 * rate, 1.0, 3) * (0.25 + 0.75 * vigour)[:, None]
    wander = smooth_noise(random, n, 9.0 * rate, 1.0, 3)
    total = np.zeros((n, 3))
    for hold, weight in zip(holds, weights, strict=True):
        about = np.array([hold.wander[1], hold.wander[1], hold.wander[0]])
        total += weight[:, None] * (hold.tremor * tremor + about * wander)
    return total


def _shaking(body: Body, random: np.random.Generator) -> Array:
    """Rotation vectors ``(n, 3)`` while the phone is waved [rad]."""
    on = np.zeros(len(body.time))
    for event in body.events_of("shake"):
        on[(body.time >= event.start) & (body.time < event.end)] = 1.0
    if not on.any():
        return np.zeros((len(on), 3))
    on = gaussian_filter1d(on, 0.3 * body.rate)
    return on[:, None] * smooth_noise(random, len(on), 0.5 * body.rate, 0.9, 3)


RECOIL = 0.12  # [s] standard deviation of the filter that removes the mean force of a shock


def _shocks(body: Body, holds: Sequence[Hold], weights: Sequence[Array], random: np.random.Generator) -> Array:
    """Acceleration ``(n, 3)`` in body axes from the landings [m/s²]."""
    n, total = len(body.time), np.zeros((len(body.time), 3))
    strength = np.minimum(body.lengths / USUAL_STEP, 1.5) ** 1.5 * np.exp(random.normal(0, 0.3, len(body.lengths)))
    strength = strength * np.exp(random.normal(0, PERSONAL_SPREAD))
    other = np.arange(len(body.landings)) % 2
    for hold, weight in zip(holds, weights, strict=True):
        size, frequency, decay = hold.shock
        if size == 0 or not len(other):
            continue
        weaker, later = hold.one_sided
        at = np.clip(np.round((body.landings + later * other) * body.rate).astype(int), 0, n - 1)
        train = np.zeros(n)
        np.add.at(train, at, size * strength * (1 - weaker * other))
        t = np.arange(round(5 * decay * body.rate)) / body.rate
        ring = np.exp(-t / decay) * np.sin(2 * np.pi * frequency * t + 0.3)
        along = np.array([0.25, -0.5, 1.0]) + random.normal(0, 0.15, 3)
        total += (weight * np.convolve(train, ring)[:n])[:, None] * along
    return total - gaussian_filter1d(total, RECOIL * body.rate, axis=0)  # recoil: a shock does not lift the phone


def _roughness(
    body: Body, holds: Sequence[Hold], weights: Sequence[Array], vigour: Array, random: np.random.Generator
) -> Array:
    """Acceleration noise ``(n, 3)`` beside the harmonics [m/s²]."""
    size = sum((h.roughness * w for h, w in zip(holds, weights, strict=True)), np.zeros(len(body.time)))
    rough = smooth_noise(random, len(body.time), 0.05 * body.rate, 1.0, 3)
    rough -= gaussian_filter1d(rough, 0.08 * body.rate, axis=0)
    return (size * vigour)[:, None] * rough


def _vibration(random: np.random.Generator, count: int, rate: float) -> Array:
    """Noise ``(count, 3)`` of unit variance around 8 Hz, whose integral stays small: it does not move a cart."""
    place = gaussian_filter1d(random.normal(size=(count, 3)), rate / (2 * np.pi * 8.0), axis=0)
    speed = np.gradient(place, axis=0)
    return speed / speed.std()


def _second_derivative(position: Array, rate: float) -> Array:
    """Acceleration ``(n, 3)`` of positions ``(n, 3)`` [m] at a rate [Hz], in m/s²."""
    inside = (position[2:] - 2 * position[1:-1] + position[:-2]) * rate**2
    return np.concatenate([inside[:1], inside, inside[-1:]])


GRIP_CHANGE_TIME = 0.7  # [s] of a turn by the wrist; chosen by hand


def with_grip_change(recording: Recording, up: Array, begin: float, angle: float) -> Recording:
    """The recording as if a hand had turned the phone by ``angle`` [rad], starting at ``begin`` [s].

    up: ``(3,)`` the vertical in device axes at that time. Only accelerometer and gyroscope are changed.
    """

    def turned(signal: Signal | None, rate_factor: float) -> Signal | None:
        if signal is None:
            return None
        share = (signal.time - begin) / GRIP_CHANGE_TIME
        values = Rotation.from_rotvec(-angle * np.clip(share, 0, 1)[:, None] * up).apply(signal.values)
        turning = rate_factor * angle / GRIP_CHANGE_TIME * ((share > 0) & (share < 1))
        return Signal(signal.time, values + turning[:, None] * up)

    return replace(
        recording, accelerometer=turned(recording.accelerometer, 0.0), gyroscope=turned(recording.gyroscope, 1.0)
    )
