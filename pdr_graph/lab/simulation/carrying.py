"""The motion of the phone on the body, in one of six holds: acceleration and angular rate without sensor errors.

The phone hangs by a lever from a hinge on the body: the wrist, the hip above a trouser pocket, the strap of a bag. The
gait moves the body and swings the lever, as harmonics of the stride; each landing causes a shock. Acceleration and
angular rate are the derivatives of that one movement, so that they agree with each other and with the truth. All
amplitudes (``holds.toml``) are fitted so that simulated and real recordings have similar spectra (docs/simulation.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, Slerp

from pdr_graph.errors import read_toml
from pdr_graph.geometry import compose
from pdr_graph.lab.simulation.body import HOLD_CHANGE_TIME, Body, Pedestrian, smooth_noise
from pdr_graph.types import STANDARD_GRAVITY, Array, OneLineRepr, Recording, Signal, time_span

USUAL_STEP = 0.72  # [m] at which the amplitudes hold


Harmonics = Sequence[tuple[int, str, float, float]]  # number, axis, amplitude, phase [rad]


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
    swings: Harmonics = ()
    bounce: float = 1.0
    shock: tuple[float, float, float] = (1.0, 9.0, 0.05)
    one_sided: tuple[float, float] = (0.0, 0.0)
    tremor: float = 0.004
    wander: tuple[float, float] = (0.07, 0.04)
    roughness: float = 0.4


FITTED = read_toml(Path(__file__).with_name("holds.toml"))
HOLDS = {name: Hold(**table) for name, table in FITTED["holds"].items()}


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


AXES = ("right", "forward", "up")
PERSONAL_SPREAD = 0.45  # log-normal spread of higher harmonics and shocks between people and shoes


def carry(body: Body, walker: Pedestrian, random: np.random.Generator) -> Motion:
    """The motion of the phone that a walker carries."""
    n, rate, time = len(body.time), body.rate, body.time

    # The walker's gait: amplitudes vary from stride to stride, and higher harmonics between people
    vigour = body.step_length / USUAL_STEP
    variation = 1 + smooth_noise(random, n, 1.1 * rate, 0.12)[:, 0]
    personal = np.exp(random.normal(0, PERSONAL_SPREAD, 12))
    personal[0] = 1.0  # the first harmonic is scaled by the walker's bounce
    shift = np.append(0.0, random.normal(0, 0.35, 12)[1:])  # of the phases [rad]

    def harmonics(of: Harmonics, factors: Array) -> Array:
        """The sum of harmonics ``(n, 3)``, in the unit of their amplitudes."""
        total = np.zeros((n, 3))
        for k, (number, axis, amplitude, phase) in enumerate(of):
            angle = 2 * np.pi * number * body.phase + phase + shift[k]
            total[:, AXES.index(axis)] += factors[k] * amplitude * variation * np.cos(angle)
        return total

    # That of an inverted pendulum grows with the square of the step length; in short, shuffling steps it is larger
    bounce = walker.bounce * (vigour**1.5)[:, None] * harmonics(FITTED["bounce"], personal)
    running = np.clip(body.flight / 0.2, 0, 1)
    if running.any():
        steady = np.minimum(vigour, 1.0)[:, None] ** 1.5 * harmonics(FITTED["bounce"], personal)
        steady[:, 2] = walker.bounce**0.3 * _bounce_of_runs(body) * variation
        bounce += running[:, None] * (steady - bounce)

    # Each hold blends into the next while it changes
    changes = body.events_of("hold")
    holds = [HOLDS[event.what] for event in changes]
    ramps = [np.clip((time - event.start) / HOLD_CHANGE_TIME, 0, 1) for event in changes]
    ramps = [np.ones(n), *(r * r * (3 - 2 * r) for r in ramps[1:]), np.zeros(n)]
    weights = [before - after for before, after in pairwise(ramps)]

    # Rotation in body axes: the swing of the lever, a hand's tremor and slow wander, waving
    tremor = smooth_noise(random, n, 0.12 * rate, 1.0, 3) * (0.25 + 0.75 * vigour)[:, None]
    wander = smooth_noise(random, n, 9.0 * rate, 1.0, 3)
    swing, unsteady = np.zeros((n, 3)), np.zeros((n, 3))
    for hold, weight in zip(holds, weights, strict=True):
        swing += weight[:, None] * (np.minimum(vigour, 1.5)[:, None] * harmonics(hold.swings, personal**0.5))
        about = np.array([hold.wander[1], hold.wander[1], hold.wander[0]])
        unsteady += weight[:, None] * (hold.tremor * tremor + about * wander)
    swing += unsteady
    if shakes := body.events_of("shake"):
        shaken = np.any([(time >= event.start) & (time < event.end) for event in shakes], axis=0).astype(float)
        swing += gaussian_filter1d(shaken, 0.3 * rate)[:, None] * smooth_noise(random, n, 0.5 * rate, 0.9, 3)
    swinging = Rotation.from_rotvec(swing)

    # Position in body axes, and both in the world
    place = np.zeros((n, 3))
    for hold, weight in zip(holds, weights, strict=True):
        hinge = np.array(hold.hinge) * walker.height + hold.bounce * bounce
        place += weight[:, None] * (hinge + swinging.apply(hold.lever))
    to_world = Rotation.from_euler("Z", body.heading[:, None] - np.pi / 2)
    centre = 0.53 * walker.height  # height of the body's centre
    position = np.column_stack([body.position, body.height + centre]) + to_world.apply(place)
    R_world_device = to_world * swinging * _bases(time, [event.start for event in changes], holds, random)

    # Specific force and angular rate: derivatives of this movement, shocks, and roughness beside the harmonics
    force = (position[2:] - 2 * position[1:-1] + position[:-2]) * rate**2
    force = np.concatenate([force[:1], force, force[-1:]])
    force[:, 2] += STANDARD_GRAVITY
    shocks = _shocks(body, holds, weights, random)
    rough = smooth_noise(random, n, 0.05 * rate, 1.0, 3)
    rough -= gaussian_filter1d(rough, 0.08 * rate, axis=0)
    size = sum((hold.roughness * weight for hold, weight in zip(holds, weights, strict=True)), np.zeros(n))
    force += to_world.apply(shocks + (size * vigour)[:, None] * rough)
    between = compose(R_world_device[:-1].inv(), R_world_device[1:]).as_rotvec() * rate
    angular_rate = np.concatenate([between[:1], (between[:-1] + between[1:]) / 2, between[-1:]])

    # The castors of a cart: 0.05 rad/s and 0.6 m/s² at 0.5 m/s; vibration sets in at low speeds
    rolling = (np.abs(body.rolling)[:, None] / 0.5) ** 0.3
    angular_rate += 0.05 * rolling * _vibration(random, n, rate)
    acceleration = R_world_device.inv().apply(force) + 0.6 * rolling * _vibration(random, n, rate)
    return Motion(rate, time, R_world_device, acceleration, angular_rate, position[:, 2])


def _bounce_of_runs(body: Body) -> Array:
    """Height of a runner's centre ``(n,)`` about its mean. [m]

    The leg is a spring: the vertical force is half a sine while a foot is on the ground, 0 in flight, and the weight on
    average (Alexander 1989; Cavagna et al. 1988). Its peak is thus π/2 of the weight by the share of contact.
    """
    contact = 1 - np.maximum(body.flight, 0.1)
    walked = np.gradient(2 * body.phase, 1 / body.rate)  # steps a second
    frequency = np.maximum(gaussian_filter1d(walked, 0.2 * body.rate), 1.0)
    height = np.zeros(len(body.time))
    for k in range(1, 6):
        share = 2 * k * contact
        force = 2 * np.where(np.abs(share - 1) < 1e-3, np.pi / 4, np.cos(np.pi * share / 2) / (1 - share**2))
        angle = 2 * np.pi * k * (2 * body.phase - contact / 2)
        height -= STANDARD_GRAVITY * force * np.cos(angle) / (2 * np.pi * k * frequency) ** 2
    return height


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
    return total - gaussian_filter1d(total, 0.12 * body.rate, axis=0)  # recoil: a shock does not lift the phone


def _vibration(random: np.random.Generator, count: int, rate: float) -> Array:
    """Noise ``(count, 3)`` of unit variance around 8 Hz, whose integral stays small: it does not move a cart."""
    place = gaussian_filter1d(random.normal(size=(count, 3)), rate / (2 * np.pi * 8.0), axis=0)
    speed = np.gradient(place, axis=0)
    return speed / speed.std()


def with_grip_change(recording: Recording, up: Array, begin: float, angle: float) -> Recording:
    """The recording as if a hand had turned the phone by ``angle`` [rad] within 0.7 s, from ``begin`` [s] on.

    up: ``(3,)`` the vertical in device axes at that time. Only accelerometer and gyroscope are changed.
    """
    seconds, signals = 0.7, {}
    for name in ("accelerometer", "gyroscope"):
        signal = recording.signals[name]
        share = (signal.time - begin) / seconds
        values = Rotation.from_rotvec(-angle * np.clip(share, 0, 1)[:, None] * up).apply(signal.values)
        if name == "gyroscope":
            values += angle / seconds * ((share > 0) & (share < 1))[:, None] * up
        signals[name] = Signal(signal.time, values)
    return replace(recording, **signals)
