"""A phone's sensors and radios with their faults: what was felt and where it was becomes what was logged.

Sensors have bias, noise, a scale error, drift with the phone's temperature, a limited range and a finest step; times
have jitter, samples are lost and repeated. Defaults are a middling phone of the 2020s. Radios are satellites, beacons
and access points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pdr_graph.geometry import interpolate, wrap_angle
from pdr_graph.io.validation import RADIUS_68
from pdr_graph.simulation.body import Body
from pdr_graph.simulation.carrying import Motion
from pdr_graph.simulation.pedestrian import autoregressive, slow
from pdr_graph.types import Array, Fixes, Index, Sightings, Signal

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


ACCURACY_SPREAD = 0.25  # of a receiver's reported accuracy about the true one (log-normal)
SYSTEMATIC, SYSTEMATIC_TIME = 0.9, 50.0  # share of the error that stays, and for how long [s]: paths, atmosphere
OUTLIER = 5.0  # of the usual accuracy
FLOOR_LOSS = 15.0  # [dB] per ceiling
WALLS = 3.0  # [dB] standard deviation of what walls and furniture add or take, a fixed pattern
WEAKEST = -97.0  # [dBm] that is heard at all


@dataclass(frozen=True)
class Receiver:
    """A satellite receiver.

    accuracy: the radius that holds 68 % of its errors [m]; period between fixes [s]; latency [s]: a fix says where
    one was; outliers: share of wild fixes; outages: from when to when there are none [s]; hdop: usual.
    """

    accuracy: float = 4.5
    period: float = 1.0
    latency: float = 0.0
    outliers: float = 0.005
    outages: tuple[tuple[float, float], ...] = ()
    hdop: float = 0.9


@dataclass(frozen=True)
class SatelliteFixes:
    """fixes: in the metric frame, time when they were logged; accuracy: 68 % radius as reported [m]; hdop."""

    fixes: Fixes
    accuracy: Array
    hdop: Array


def satellites(body: Body, receiver: Receiver, random: np.random.Generator) -> SatelliteFixes:
    """Positions with an accuracy-dependent error, of which most stays the same for a while."""
    measured = np.arange(body.time[0], body.time[-1], receiver.period)
    at = interpolate(measured, body.time, body.position)
    n = len(measured)
    reported = receiver.accuracy * np.exp(autoregressive(random, n, 0.98, ACCURACY_SPREAD)[:, 0])
    keep = np.exp(-receiver.period / SYSTEMATIC_TIME)
    share = autoregressive(random, n, keep, SYSTEMATIC, 2) + random.normal(0, np.sqrt(1 - SYSTEMATIC**2), (n, 2))
    error = reported[:, None] / RADIUS_68 * share
    wild = random.random(n) < receiver.outliers
    error[wild] += OUTLIER * receiver.accuracy * random.normal(0, 1, (int(wild.sum()), 2))
    logged = measured + receiver.latency
    there = logged <= body.time[-1]
    for begin, end in receiver.outages:
        there &= (measured < begin) | (measured >= end)
    hdop = receiver.hdop * np.exp(random.normal(0, 0.1, n)) * reported / receiver.accuracy
    fixes = Fixes(logged, at + error, reported / RADIUS_68, ("",) * n)
    return SatelliteFixes(fixes[there], reported[there], hdop[there])


@dataclass(frozen=True)
class Transmitter:
    """A beacon or an access point. place: ``(2,)`` where it really is [m]; power: received at 1 m [dBm]."""

    name: str
    place: Array
    floor: str = ""
    power: float = -59.0


@dataclass(frozen=True)
class Air:
    """How signals fade. exponent: of distance; shadow: what the body takes away behind it [dB]; fading [dB];
    period: between two sightings of one transmitter [s]; together: True where all are heard in one scan.
    """

    exponent: float
    shadow: float
    fading: float
    period: float
    together: bool


BLUETOOTH = Air(exponent=2.2, shadow=7.0, fading=4.0, period=0.35, together=False)
WIFI = Air(exponent=2.8, shadow=4.0, fading=3.0, period=3.0, together=True)


def heard(
    body: Body,
    transmitters: Sequence[Transmitter],
    air: Air,
    random: np.random.Generator,
    place: np.random.Generator,
) -> Sightings:
    """Who was heard when and how loud: log-distance path loss, the body's shadow, walls as a fixed pattern, fading.

    place: draws what is the same for all walks at a place, the walls' pattern.
    """
    times, names, levels = [np.empty(0)], list[str](), [np.empty(0)]
    scans = np.arange(random.uniform(0, air.period), body.time[-1], air.period)
    for transmitter in transmitters:
        time = scans if air.together else scans + random.uniform(-0.4, 0.4, len(scans)) * air.period
        time = np.clip(time, 0, body.time[-1])
        at = np.clip(np.searchsorted(body.time, time), 0, len(body.time) - 1)
        level = _level(body, at, transmitter, air) + WALLS * Scatter.drawn(place, 4.0, 1).at(body.position[at])[:, 0]
        level += random.normal(0, air.fading, len(at))
        there = level > WEAKEST
        times.append(time[there])
        levels.append(np.round(level[there]))
        names += [transmitter.name] * int(there.sum())
    time, level = np.concatenate(times), np.concatenate(levels)
    order = np.argsort(time, kind="stable")
    return Sightings(time[order], tuple(names[n] for n in order), level[order])


def _level(body: Body, at: Index, transmitter: Transmitter, air: Air) -> Array:
    """Usual received power ``(n,)`` [dBm] at some of the body's samples."""
    way = transmitter.place - body.position[at]
    distance = np.maximum(np.hypot(*way.T), 0.5)
    level = transmitter.power - 10 * air.exponent * np.log10(distance)
    behind = np.abs(wrap_angle(np.arctan2(way[:, 1], way[:, 0]) - body.heading[at])) / np.pi
    level = level - air.shadow * behind**2
    if transmitter.floor:
        ceilings = np.array([label != transmitter.floor for label in body.floors], float)
        level = level - FLOOR_LOSS * ceilings[body.floor[at]]
    return level
