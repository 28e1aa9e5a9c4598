"""A phone's sensors and radios: true motion and positions become measurements with errors.

Sensors have bias, noise, a scale error, drift with the phone's temperature, a limited range and resolution; times have
jitter, samples are lost and repeated. The numbers are chosen by hand for an average phone of the 2020s. Radios are
GNSS, Bluetooth beacons and Wi-Fi access points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.signal import lfilter

from pdr_graph.geometry import as_complex, interpolate, wrap_angle
from pdr_graph.io.validation import RADIUS_68
from pdr_graph.lab.simulation.body import Body, autoregressive_noise, smooth_noise
from pdr_graph.lab.simulation.carrying import Motion
from pdr_graph.types import Array, Complex, Fixes, Index, OneLineRepr, Sightings, Signal, Trajectory


@dataclass(frozen=True)
class SensorErrors:
    """Standard deviations of the errors of one sensor, per axis, in the unit u of the sensor.

    noise: of one sample at 100 Hz, growing with the root of the rate [u]; bias [u]; per_kelvin: drift of the bias
    [u/K]; walk: random walk of the bias in an hour [u]; scale: relative; maximum: of the range [u]; resolution [u].
    """

    noise: float
    bias: float
    per_kelvin: float
    walk: float
    scale: float
    maximum: float
    resolution: float


ACCELEROMETER_ERRORS = SensorErrors(0.018, 0.05, 0.003, 0.01, 0.004, 78.4, 0.0024)  # [m/s²]
GYROSCOPE_ERRORS = SensorErrors(0.0022, 0.003, 0.0002, 0.0006, 0.006, 17.45, 0.0011)  # [rad/s]; calibrated by the phone
MAGNETOMETER_ERRORS = SensorErrors(0.45, 3.0, 0.05, 0.3, 0.02, 4900.0, 0.06)  # [µT]
BAROMETER_ERRORS = SensorErrors(0.012, 0.8, 0.002, 0.02, 0.0, 1300.0, 0.0012)  # [hPa]


def setting(default: Any, *accepted: Any) -> Any:
    """A dataclass field that is a key of a scenario; accepted: least, most and unit of a number, else the texts."""
    return field(default=default, metadata={"accepted": accepted})


@dataclass(frozen=True)
class SampleClock:
    """The sample times of a sensor.

    rate [Hz]; jitter: standard deviation of the times [s]; lost, repeated: shares of the samples.
    """

    rate: float = setting(100.0, 20, 1000, "Hz")
    jitter: float = setting(0.0004, 0, 1, "s")
    lost: float = setting(0.0005, 0, 0.9, "of all samples")
    repeated: float = setting(0.0002, 0, 0.9, "of all samples")

    def times(self, start: float, end: float, random: np.random.Generator) -> tuple[Array, Index]:
        """Sorted sample times ``(n,)`` [s], and how often each sample is written ``(n,)``: 0, 1 or 2 times."""
        period = 1 / self.rate
        time = np.arange(start, end, period) + random.uniform(0, period)
        time = time + np.clip(random.normal(0, self.jitter, len(time)), -0.45 * period, 0.45 * period)
        chance = random.random(len(time))
        copies = np.where(chance < self.lost, 0, np.where(chance > 1 - self.repeated, 2, 1))
        return np.clip(time, start, end), copies


def imu(motion: Motion, clock: SampleClock, random: np.random.Generator) -> dict[str, Signal]:
    """Measurements of accelerometer [m/s²] and gyroscope [rad/s], which are on one chip and share its clock."""
    time, copies = clock.times(motion.time[0], motion.time[-1], random)
    axes = {
        "accelerometer": (motion.acceleration, ACCELEROMETER_ERRORS),
        "gyroscope": (motion.angular_rate, GYROSCOPE_ERRORS),
    }
    signals = {}
    for name, (truth, errors) in axes.items():
        at = interpolate(time, motion.time, truth)
        signals[name] = _written(time, _measured(at, time, errors, clock.rate, random), copies)
    return signals


def magnetometer(
    motion: Motion, position: Array, field: MagneticField, clock: SampleClock, random: np.random.Generator
) -> Signal:
    """Measurements of the magnetic field [µT] at positions ``(n, 2)``. Hard iron, as of a case, is part of the bias."""
    time, copies = clock.times(motion.time[0], motion.time[-1], random)
    every = slice(None, None, max(1, round(motion.rate / 10.0)))  # at 10 Hz, interpolated between
    world = interpolate(motion.time, motion.time[every], field.at(position[every]))
    device = motion.R_world_device.inv().apply(world)
    at = interpolate(time, motion.time, device)
    return _written(time, _measured(at, time, MAGNETOMETER_ERRORS, clock.rate, random), copies)


def standard_pressure(height: Array) -> Array:
    """Air pressure ``(n,)`` [hPa] at heights ``(n,)`` above the sea [m], by the standard atmosphere."""
    return 1013.25 * (1 - 2.25577e-5 * height) ** 5.25588


def barometer(motion: Motion, altitude: float, clock: SampleClock, random: np.random.Generator) -> Signal:
    """Measurements of the air pressure [hPa]. altitude: of the floor where the walk begins, above the sea [m].

    Weather changes the pressure by 0.15 hPa over 20 minutes.
    """
    time, copies = clock.times(motion.time[0], motion.time[-1], random)
    pressure = standard_pressure(altitude + np.interp(time, motion.time, motion.height))
    weather = smooth_noise(random, len(time), 1200.0 * clock.rate, 0.15)[:, 0] if len(time) else 0.0
    truth = (pressure + weather)[:, None]
    return _written(time, _measured(truth, time, BAROMETER_ERRORS, clock.rate, random), copies)


@dataclass(frozen=True)
class RandomPattern(OneLineRepr):
    """A random pattern over a floor, of zero mean and unit variance: a sum of ``w`` plane waves for each of k values.

    waves: ``(w, 2)`` wave vectors [rad/m]; phases [rad], sizes: ``(w, k)``.
    """

    waves: Array
    phases: Array
    sizes: Array

    @classmethod
    def sample(cls, random: np.random.Generator, length: float, values: int) -> RandomPattern:
        """Draw a pattern. length: over which it changes [m]; values: number k of values at each position."""
        waves = 24  # enough for a Gaussian distribution of the sums
        return cls(
            random.normal(0, 1 / length, (waves, 2)),
            random.uniform(0, 2 * np.pi, (waves, values)),
            random.normal(0, np.sqrt(2 / waves), (waves, values)),
        )

    def _summary(self) -> list[str]:
        return [f"{len(self.waves)} waves", f"{self.phases.shape[1]} values"]

    def at(self, position: Array) -> Array:
        """Values ``(n, k)`` at positions ``(n, 2)`` [m]."""
        total = np.zeros((len(position), self.phases.shape[1]))
        for wave, phase, size in zip(self.waves, self.phases, self.sizes, strict=True):
            total += size * np.cos((position @ wave)[:, None] + phase)
        return total


@dataclass(frozen=True)
class MagneticField(OneLineRepr):
    """The magnetic field of a place.

    earth: ``(3,)`` east, north, up [µT]; disturbance: standard deviation per axis of the field of steel and cables
    [µT], whose pattern `steel` changes over 3 m.
    """

    earth: Array
    disturbance: float
    steel: RandomPattern

    @classmethod
    def sample(cls, random: np.random.Generator, earth: Array, disturbance: float) -> MagneticField:
        """Draw the field of a place. earth: ``(3,)`` [µT]; disturbance: standard deviation per axis [µT]."""
        return cls(earth, disturbance, RandomPattern.sample(random, 3.0, 3))

    def _summary(self) -> list[str]:
        return [f"earth {np.linalg.norm(self.earth):.1f} µT", f"disturbance {self.disturbance:g} µT"]

    def at(self, position: Array) -> Array:
        """The field ``(n, 3)`` [µT] at positions ``(n, 2)`` [m]."""
        return self.earth + self.disturbance * self.steel.at(position)


def _measured(truth: Array, time: Array, errors: SensorErrors, rate: float, random: np.random.Generator) -> Array:
    """Measurements ``(n, k)`` of a sensor from true values ``(n, k)``."""
    count, axes = truth.shape
    warmth = 8.0 * (1 - np.exp(-time / 900.0))  # [K] by which a phone warms up while recording
    bias = random.normal(0, errors.bias, axes) + warmth[:, None] * random.normal(0, errors.per_kelvin, axes)
    bias = bias + np.cumsum(random.normal(0, errors.walk / np.sqrt(3600 * rate), (count, axes)), axis=0)
    scale = 1 + random.normal(0, errors.scale, axes)
    values = scale * truth + bias + random.normal(0, errors.noise * np.sqrt(max(rate, 25) / 100), (count, axes))
    return np.clip(np.round(values / errors.resolution) * errors.resolution, -errors.maximum, errors.maximum)


def _written(time: Array, values: Array, copies: Index) -> Signal:
    """The signal with each sample repeated ``copies (n,)`` times."""
    return Signal(np.repeat(time, copies), np.repeat(values, copies, axis=0))


@dataclass(frozen=True)
class Receiver:
    """A GNSS receiver; the fields are the keys of ``[gnss]`` in a scenario.

    accuracy: radius of 68 % of its errors [m]; period: between fixes [s]; latency: of a fix behind the position [s];
    correlation: time for which nine tenths of its errors stay [s]; smoothing: time constant of its own filter [s];
    outliers: share of the fixes; outages: intervals without fixes, start and end [s]; hdop: median.
    """

    accuracy: float = setting(4.5, 0.01, 10_000, "m")
    period: float = setting(1.0, 0.01, 86_400, "s")
    latency: float = setting(0.0, 0, 3600, "s")
    correlation: float = setting(50.0, 0.01, 86_400, "s")
    smoothing: float = setting(0.0, 0, 3600, "s")
    outliers: float = setting(0.005, 0, 1, "of all fixes")
    outages: tuple[tuple[float, float], ...] = ()
    hdop: float = setting(0.9, 0.1, 100)


@dataclass(frozen=True)
class SatelliteFixes(OneLineRepr):
    """GNSS fixes. fixes: in the metric frame, at the time of logging; accuracy: reported 68 % radius [m]; hdop: [-]."""

    fixes: Fixes
    accuracy: Array
    hdop: Array

    def _summary(self) -> list[str]:
        return self.fixes._summary()


def gnss_fixes(body: Body | Trajectory, receiver: Receiver, random: np.random.Generator) -> SatelliteFixes:
    """Fixes whose errors follow a varying accuracy; nine tenths of them stay for a while: multipath, atmosphere.

    An outlier's standard deviation per axis is five times the accuracy of the receiver.
    """
    measured = np.arange(body.time[0], body.time[-1], receiver.period)
    body = replace(body, position=_smoothed(body, receiver.smoothing)) if receiver.smoothing else body
    at = interpolate(measured, body.time, body.position)
    n = len(measured)
    reported = receiver.accuracy * np.exp(autoregressive_noise(random, n, 0.98, 0.25)[:, 0])
    keep, systematic = np.exp(-receiver.period / receiver.correlation), 0.9
    share = autoregressive_noise(random, n, keep, systematic, 2) + random.normal(0, np.sqrt(1 - systematic**2), (n, 2))
    error = reported[:, None] / RADIUS_68 * share
    outlier = random.random(n) < receiver.outliers
    error[outlier] += 5.0 * receiver.accuracy * random.normal(0, 1, (int(outlier.sum()), 2))
    logged = measured + receiver.latency
    available = logged <= body.time[-1]
    for begin, end in receiver.outages:
        available &= (measured < begin) | (measured >= end)
    hdop = receiver.hdop * np.exp(random.normal(0, 0.1, n)) * reported / receiver.accuracy
    velocity = _doppler(body, measured, reported, random.spawn(1)[0])
    fixes = Fixes(
        logged,
        at + error,
        reported / RADIUS_68,
        source=("",) * n,
        speed=np.abs(velocity),
        course=np.angle(velocity),
    )
    return SatelliteFixes(fixes[available], reported[available], hdop[available])


def _smoothed(body: Body | Trajectory, smoothing: float) -> Array:
    """Positions ``(n, 2)`` [m] by a receiver's filter of a constant velocity, critically damped in `smoothing` [s].

    It goes on straight in a turn and comes back: a second after a right angle its course has turned by half or less.
    """
    keep = np.exp(-np.median(np.diff(body.time)) / smoothing)
    tracked = lfilter(
        [1 - keep**2, 2 * keep * (keep - 1)], [1, -2 * keep, keep**2], body.position - body.position[0], 0
    )
    return body.position[0] + tracked


def _doppler(body: Body | Trajectory, measured: Array, reported: Array, random: np.random.Generator) -> Complex:
    """Velocities ``(n,)`` [m/s] by a receiver's filter: the mean of two seconds, and noise that lasts for 2.5 s.

    Errors of 0.1 m/s per axis at an accuracy of 5 m, as on a campus (NJU).
    """
    past = measured[:, None] - np.array([2.0, 0.0])
    places = interpolate(past.ravel(), body.time, body.position).reshape(-1, 2, 2)
    keep = np.exp(-np.median(np.diff(measured, append=measured[-1:] + 1.0)) / 2.5)
    noise = 0.1 * (reported / 5.0)[:, None] * autoregressive_noise(random, len(measured), keep, 1.0, 2)
    return as_complex((places[:, 1] - places[:, 0]) / 2.0 + noise)


@dataclass(frozen=True)
class Transmitter:
    """A beacon or an access point. place: ``(2,)`` true position [m]; power: received at 1 m [dBm]."""

    name: str
    place: Array
    floor: str = ""
    power: float = -59.0


@dataclass(frozen=True)
class RadioChannel:
    """Propagation and scanning of one radio.

    exponent: of the path loss; shadow: loss behind the body [dB]; fading: standard deviation [dB]; period: between two
    receptions of one transmitter [s]; together: True if all transmitters are received in one scan.
    """

    exponent: float
    shadow: float
    fading: float
    period: float
    together: bool


BLUETOOTH = RadioChannel(exponent=2.2, shadow=7.0, fading=4.0, period=0.35, together=False)
WIFI = RadioChannel(exponent=2.8, shadow=4.0, fading=3.0, period=3.0, together=True)


def receptions(
    body: Body,
    transmitters: Sequence[Transmitter],
    channel: RadioChannel,
    random: np.random.Generator,
    place: np.random.Generator,
) -> Sightings:
    """Receptions with signal strength: log-distance path loss, shadow of the body, walls as a fixed pattern, fading.

    Walls and furniture change the level by 3 dB, each ceiling between two floors by 15 dB; levels up to −97 dBm are
    not received.

    place: generator of the walls' pattern, which is the same for all walks at one place.
    """
    times, names, levels = [np.empty(0)], list[str](), [np.empty(0)]
    scans = np.arange(random.uniform(0, channel.period), body.time[-1], channel.period)
    for transmitter in transmitters:
        time = scans if channel.together else scans + random.uniform(-0.4, 0.4, len(scans)) * channel.period
        time = np.clip(time, 0, body.time[-1])
        at = np.clip(np.searchsorted(body.time, time), 0, len(body.time) - 1)
        vector = transmitter.place - body.position[at]
        level = transmitter.power - 10 * channel.exponent * np.log10(np.maximum(np.hypot(*vector.T), 0.5))
        behind = np.abs(wrap_angle(np.arctan2(vector[:, 1], vector[:, 0]) - body.heading[at])) / np.pi
        level = level - channel.shadow * behind**2
        if transmitter.floor:
            level -= 15.0 * np.array([label != transmitter.floor for label in body.floors])[body.floor[at]]
        level += 3.0 * RandomPattern.sample(place, 4.0, 1).at(body.position[at])[:, 0]
        level += random.normal(0, channel.fading, len(at))
        received = level > -97.0
        times.append(time[received])
        levels.append(np.round(level[received]))
        names += [transmitter.name] * int(received.sum())
    time, level = np.concatenate(times), np.concatenate(levels)
    order = np.argsort(time, kind="stable")
    return Sightings(time[order], tuple(names[n] for n in order), level[order])
