"""A phone's sensors and their faults: what was felt becomes what was logged.

Bias, noise, a scale error, drift with the phone's temperature, a limited range and a finest step for each; times with
jitter, samples lost and repeated. Defaults are a middling phone of the 2020s.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pdr_graph.geometry import interpolate
from pdr_graph.simulation.carrying import Motion
from pdr_graph.simulation.noise import slow
from pdr_graph.types import Array, Index, Signal

WARMING, WARMING_TIME = 8.0, 900.0  # [K] by which a phone that records warms up, and how fast [s]
SEA_LEVEL, LAPSE, EXPONENT = 1013.25, 2.25577e-5, 5.25588  # [hPa], [1/m]: the standard atmosphere
DISTURBANCE_RATE = 10.0  # [Hz] at which a walker's way through a disturbed field is seen
WEATHER, WEATHER_TIME = 0.15, 1200.0  # [hPa] by which the air pressure wanders, over which time [s]
WAVES = 24  # that make a random pattern


@dataclass(frozen=True)
class Faults:
    """One kind of sensor, per axis. Units are the sensor's own, u.

    noise: of one sample at 100 Hz, growing with the root of the rate [u]; bias [u]; per_kelvin: its drift [u/K];
    walk: of the bias in an hour [u]; scale: relative; largest: of its range [u]; finest: step of its numbers [u].
    """

    noise: float
    bias: float
    per_kelvin: float
    walk: float
    scale: float
    largest: float
    finest: float


ACCELEROMETER = Faults(0.018, 0.05, 0.003, 0.01, 0.004, 78.4, 0.0024)  # [m/s²]
GYROSCOPE = Faults(0.0022, 0.003, 0.0002, 0.0006, 0.006, 17.45, 0.0011)  # [rad/s]; the phone has calibrated it
MAGNETOMETER = Faults(0.45, 3.0, 0.05, 0.3, 0.02, 4900.0, 0.06)  # [µT]
BAROMETER = Faults(0.012, 0.8, 0.002, 0.02, 0.0, 1300.0, 0.0012)  # [hPa]


@dataclass(frozen=True)
class Clock:
    """When samples are taken.

    rate [Hz]; jitter: standard deviation of their times [s]; lost, repeated: shares of the samples.
    """

    rate: float = 100.0
    jitter: float = 0.0004
    lost: float = 0.0005
    repeated: float = 0.0002

    def times(self, start: float, end: float, random: np.random.Generator) -> tuple[Array, Index]:
        """When samples were taken ``(n,)`` [s], in order, and how often each was written ``(n,)``: 0, 1 or 2."""
        period = 1 / self.rate
        time = np.arange(start, end, period) + random.uniform(0, period)
        time = time + np.clip(random.normal(0, self.jitter, len(time)), -0.45 * period, 0.45 * period)
        chance = random.random(len(time))
        times_written = np.where(chance < self.lost, 0, np.where(chance > 1 - self.repeated, 2, 1))
        return np.clip(time, start, end), times_written


def imu(motion: Motion, clock: Clock, random: np.random.Generator) -> dict[str, Signal]:
    """Accelerometer and gyroscope, of one chip: they share its clock."""
    time, written = clock.times(motion.time[0], motion.time[-1], random)
    felt = {"accelerometer": (motion.acceleration, ACCELEROMETER), "gyroscope": (motion.angular_rate, GYROSCOPE)}
    signals = {}
    for name, (truth, faults) in felt.items():
        at = interpolate(time, motion.time, truth)
        signals[name] = _logged(time, _faulty(at, time, faults, clock.rate, random), written)
    return signals


def magnetometer(
    motion: Motion, position: Array, field: MagneticField, clock: Clock, random: np.random.Generator
) -> Signal:
    """The field where the phone was [µT]. A case with a magnet (hard iron) is in the bias."""
    time, written = clock.times(motion.time[0], motion.time[-1], random)
    some = slice(None, None, max(1, round(motion.rate / DISTURBANCE_RATE)))
    there = field.at(position[some])
    world = interpolate(motion.time, motion.time[some], there)
    device = motion.R_world_device.inv().apply(world)
    at = interpolate(time, motion.time, device)
    return _logged(time, _faulty(at, time, MAGNETOMETER, clock.rate, random), written)


def barometer(motion: Motion, altitude: float, clock: Clock, random: np.random.Generator) -> Signal:
    """Air pressure [hPa]. altitude: of the floor where the walk began, above the sea [m]."""
    time, written = clock.times(motion.time[0], motion.time[-1], random)
    height = altitude + np.interp(time, motion.time, motion.height)
    pressure = SEA_LEVEL * (1 - LAPSE * height) ** EXPONENT
    weather = slow(random, len(time), WEATHER_TIME * clock.rate, WEATHER)[:, 0] if len(time) else 0.0
    return _logged(time, _faulty((pressure + weather)[:, None], time, BAROMETER, clock.rate, random), written)


@dataclass(frozen=True)
class Scatter:
    """A fixed random pattern over a floor, of unit variance: a sum of plane waves.

    waves: ``(w, 2)`` [rad/m]; phases, sizes: ``(w, k)``.
    """

    waves: Array
    phases: Array
    sizes: Array

    @classmethod
    def drawn(cls, random: np.random.Generator, length: float, values: int) -> Scatter:
        """length: over which it changes [m]; values: how many patterns."""
        return cls(
            random.normal(0, 1 / length, (WAVES, 2)),
            random.uniform(0, 2 * np.pi, (WAVES, values)),
            random.normal(0, np.sqrt(2 / WAVES), (WAVES, values)),
        )

    def at(self, position: Array) -> Array:
        """Values ``(n, k)`` at positions ``(n, 2)`` [m]."""
        total = np.zeros((len(position), self.phases.shape[1]))
        for wave, phase, size in zip(self.waves, self.phases, self.sizes, strict=True):
            total += size * np.cos((position @ wave)[:, None] + phase)
        return total


@dataclass(frozen=True)
class MagneticField:
    """Of a place: the earth's ``(3,)``, east, north, up [µT], and what steel and cables add to each axis.

    disturbance: standard deviation of that [µT]; it changes over 3 m.
    """

    earth: Array
    disturbance: float
    steel: Scatter

    @classmethod
    def drawn(cls, random: np.random.Generator, earth: Array, disturbance: float) -> MagneticField:
        """Some place's."""
        return cls(earth, disturbance, Scatter.drawn(random, 3.0, 3))

    def at(self, position: Array) -> Array:
        """The field ``(n, 3)`` at positions ``(n, 2)``. [µT]"""
        return self.earth + self.disturbance * self.steel.at(position)


def _faulty(truth: Array, time: Array, faults: Faults, rate: float, random: np.random.Generator) -> Array:
    """What a sensor says of the truth ``(n, k)``."""
    count, axes = truth.shape
    warmth = WARMING * (1 - np.exp(-time / WARMING_TIME))
    bias = random.normal(0, faults.bias, axes) + warmth[:, None] * random.normal(0, faults.per_kelvin, axes)
    bias = bias + np.cumsum(random.normal(0, faults.walk / np.sqrt(3600 * rate), (count, axes)), axis=0)
    scale = 1 + random.normal(0, faults.scale, axes)
    said = scale * truth + bias + random.normal(0, faults.noise * np.sqrt(max(rate, 25) / 100), (count, axes))
    return np.clip(np.round(said / faults.finest) * faults.finest, -faults.largest, faults.largest)


def _logged(time: Array, values: Array, written: Index) -> Signal:
    return Signal(np.repeat(time, written), np.repeat(values, written, axis=0))
