"""Absolute walking directions by the magnetometer: a few per walk with honest sigmas, or none.

`fit_iron` calibrates the magnetometer. `magnetic_north` is the Kalman filter of gyroscope and magnetometer of [gps-dr]
Sec. 3, with its two tests of the field. `LiveCompass` adds the phone's forward axis; a recording uses it too.

All headings of a walk share most of their error (the phone's own iron, the forward axis, a plan's axis), and their
number is not known in advance. The walk is divided into stretches; each gets a heading as soon as it is informative,
and better headings replace it as the stretch grows. A heading carries only the information that it adds: if the earlier
stretches determine the direction with variance P (which has grown by that of the turns since), and this stretch alone
would with variance S, then the heading gets the variance v of 1/v = 1/S − 1/P. So all headings together never determine
the present direction better than the best of them alone.

The headings of a recording are the last headings of its stretches.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import pi, sqrt

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.spatial.transform import Rotation

from pdr_graph.errors import expect
from pdr_graph.frames import EarthField, Frame, earth_field
from pdr_graph.gait.heading import live_forward_axis
from pdr_graph.gait.steps import GaitSignals, gait_signals
from pdr_graph.gait.walker import Walker
from pdr_graph.geometry import gaussian_weights, interpolate, nearest, wrap_angle
from pdr_graph.inertial.attitude import Attitude, runs
from pdr_graph.inertial.sensor_stream import SensorStream
from pdr_graph.inertial.units import BY_DIP
from pdr_graph.priors import COMPASS, FORWARD, LIVE_COMPASS, MAGNETOMETER, MOTION, NORTH, REST, WALKER
from pdr_graph.types import Array, Drifts, Headings, Index, Recording, Signal


def magnetic_headings(recording: Recording | list[GaitSignals], frame: Frame, near: Array) -> Headings:
    """Walking directions where the magnetic field passes its tests and the forward axis is known.

    recording: or its `gait_signals`; frame: of the headings; near: ``(2,)`` a position of the walk in it [m], for the
    World Magnetic Model. Returns 0 rows in a frame that is not georeferenced, or without accelerometer, gyroscope and
    magnetometer.
    """
    return compass_measurements(recording, frame, near)[0]


def compass_measurements(
    recording: Recording | list[GaitSignals], frame: Frame, near: Array, compass: LiveCompass | None = None
) -> tuple[Headings, Drifts]:
    """The `magnetic_headings`, and the drifts of the gyroscope against the magnetic field. compass: that finds them."""
    expect("magnetic_headings, recording", recording, Recording, list, instead="load(path)")
    expect("magnetic_headings, frame", frame, Frame, instead="FloorPlan.frame or frame_of(fixes)")
    expect("magnetic_headings, near", near, np.ndarray, instead="fixes.position[0]")
    whole = recording if isinstance(recording, Recording) else recording[0].recording
    field = whole.magnetometer
    if not frame.georeferenced or field is None or whole.accelerometer is None or whole.gyroscope is None:
        return Headings.none(), Drifts(*np.empty((3, 0)))
    compass, used = compass or LiveCompass(reach=2 * COMPASS.longest_stretch), 0
    compass.locate(frame, near, whole.epoch)
    headings, drifts = dict[int, StretchValue](), dict[int, StretchValue]()
    for gait in gait_signals(recording):
        for piece in gait.pieces(EVALUATION_INTERVAL):
            before, used = used, int(np.searchsorted(field.time, piece.attitude.time[-1], side="right")) + 1
            compass.push(field.time[before:used], field.values[before:used])
            compass.update(piece)
            headings |= {found.stretch: found for found in compass.advance()}
            drifts |= {found.stretch: found for found in compass.advance_drifts()}
    (time, heading, sigma), drifted = (
        np.array([(of.time, of.value, of.sigma) for of in found.values() if np.isfinite(of.sigma)]).reshape(-1, 3).T
        for found in (headings, drifts)
    )
    return Headings(time, heading, sigma), Drifts(*drifted)


def straightest(heading: Array, among: Index, reach: int) -> int:
    """The sample among ``among (k,)`` with the smallest turn from ``reach`` samples before to as many after."""
    turned = heading[np.minimum(among + reach, len(heading) - 1)] - heading[np.maximum(among - reach, 0)]
    return int(among[np.argmin(np.abs(turned))])


EVALUATION_INTERVAL = 30.0  # [s] of a recording between evaluations
ATTITUDE, ACCELERATION, FIELD = slice(0, 4), slice(4, 7), slice(10, 13)
HEADING, IS_WALKING, VARIANCE_OF_TURNS = 7, 8, 9  # columns of samples; the variance is that of all turns so far
SAMPLE_COLUMNS = 13
DRIFT_PARTS = 5  # of the time of the observations of a drift
STORED = 0.04  # [s] interval of the stored samples
FIRST_STEPS, EVALUATED = (8, 12, 16, 24), 10.0  # [steps] of a stretch at its first evaluations; [s] between later ones
MOST_FITTED = 600  # samples of a fit of iron
OUTLYING = 2.0  # [σ] of an observation of north, from which it counts less
FEWEST_FIELDS = 50  # stored samples, of two seconds, by whose field the sign of the accelerations is judged


@dataclass(frozen=True)
class StretchValue:
    """What the compass measures of a stretch, at a time [s]: its walking direction, or the gyroscope's drift.

    stretch: its number; a value replaces earlier ones of the same stretch. value, sigma: of the walking direction,
    counter-clockwise from +x [rad], or of the drift b [rad/s]; sigma is infinite to retract them.
    """

    stretch: int
    time: float
    value: float
    sigma: float


@dataclass(frozen=True)
class _Known:
    """The direction of the walk at a time [s].

    variance: by all stretches up to it [rad²]; turn_variance: of all turns up to it [rad²].
    """

    time: float
    variance: float
    turn_variance: float


class LiveCompass:
    """Headings while magnetometer samples are pushed and a `StepStream`, whose listener is `update`, advances.

    walker: whose ``sigma_turn`` the graph uses for the steps; reach: age at which a heading is of no more use [s]: it
    has left the estimator's window. There are no headings before `locate`.
    """

    def __init__(self, walker: Walker | None = None, reach: float = 40.0):
        self.sigma_turn = (walker or Walker()).sigma_turn
        self.reach = reach
        self.field = MagnetometerStream()
        self.stretch = 0
        self.samples = np.empty((0, SAMPLE_COLUMNS))  # of the stretch
        self.field_count = 0  # number of samples whose magnetic field is filled in
        self.incomplete = np.empty((0, FIELD.start))  # too few for a stored sample
        self.turn_variance = 0.0  # of all turns so far [rad²]
        self.begin, self.end = np.nan, np.nan  # times of the first stored and of the last sample [s]
        self.period = np.nan
        self.direction_variance = 0.0  # of the `Direction` at the end [rad²]
        self.durations = np.empty(0)  # of the stretch's steps [s]
        self.evaluated = 0.0  # time of walking in the stretch at its last evaluation [s]
        self.offsets = np.empty(0)  # of heading 0 from true east, by the last evaluations of the stretch [rad]
        self.current: _Known | None = None  # with the stretch's heading, if it has one
        self.previous = _Known(-np.inf, np.inf, 0.0)  # by the earlier stretches
        self._earth: EarthField | None = None
        self._east = 0.0
        self._found: list[StretchValue] = []
        self._drifts: list[StretchValue] = []
        self._drift_at = np.nan  # time of the stretch's drift, if it has one [s]
        self.dips = np.zeros(3)  # samples of the field: all, with the earth's dip, and with its opposite

    def locate(self, frame: Frame, near: Array, epoch: float | None = None) -> None:
        """Set the location: near ``(2,)`` in the frame of the headings [m]; epoch: Unix time of time 0 [s]."""
        if frame.georeferenced and np.isfinite(near).all():
            lon, lat = frame.to_lonlat(near[None])[0].tolist()
            self._earth, self._east = earth_field(lat, lon, epoch), frame.bearing_of_east(near)

    def push(self, time: Array, values: Array) -> None:
        """Add samples of the magnetometer at times ``(n,)`` [s], as in `Signal`."""
        self.field.push(time, values)

    def advance(self) -> list[StretchValue]:
        """The headings since the last call."""
        found, self._found = self._found, []
        return found

    def advance_drifts(self) -> list[StretchValue]:
        """The drifts of the gyroscope since the last call."""
        drifts, self._drifts = self._drifts, []
        return drifts

    def update(self, gait: GaitSignals) -> None:
        """Add the next samples of the walk that are certain."""
        attitude, variance = gait.attitude, gait.direction.variance
        time = attitude.time
        if not len(time):
            return
        if not (attitude.period == self.period and time[0] - self.end < 1.5 * self.period):
            self._start_stretch()
            self.turn_variance += MOTION.gap_turn**2
            self.period, self.direction_variance = attitude.period, float(variance[0])
        rows = self._rows(gait)
        steady = ~(np.diff(variance, prepend=self.direction_variance) > 0) & np.isfinite(attitude.angular_rate[:, 0])
        self.durations = np.append(self.durations, gait.landings.period)
        for first, after in np.transpose(runs(steady)).tolist():
            if first > 0:
                self._start_stretch()
            self._extend(rows[first:after], float(time[first]))
        if not steady[-1]:
            self._start_stretch()
        self.turn_variance += self.sigma_turn**2 * len(gait.landings) + float(variance[-1]) - self.direction_variance
        self.direction_variance, self.end = float(variance[-1]), float(time[-1])
        self._evaluate_if_due()

    def _rows(self, gait: GaitSignals) -> Array:
        """The samples ``(n, 10)``, without the magnetic field."""
        attitude, direction = gait.attitude, gait.direction
        steps = np.searchsorted(gait.landings.time, attitude.time, side="right")
        variance = self.turn_variance + self.sigma_turn**2 * steps + direction.variance - self.direction_variance
        columns = (direction.heading, gait.walking.astype(float), variance)
        return np.hstack([attitude.R_world_device.as_quat(), attitude.acceleration, np.stack(columns, axis=1)])

    @property
    def stride(self) -> int:
        """Number of the phone's samples per stored sample."""
        return max(1, round(STORED / self.period))

    def _extend(self, rows: Array, begin: float) -> None:
        """Add rows to the stretch, averaged over `stride` rows each."""
        if not len(self.samples) + len(self.incomplete):
            self.begin = self._first_time(begin)
        new, self.incomplete = self._averaged(np.concatenate([self.incomplete, rows]))
        self.samples = np.concatenate([self.samples, new])

    def _first_time(self, begin: float) -> float:
        """Time of the first stored sample if the phone's first is at ``begin``. [s]"""
        return begin + (self.stride - 1) / 2 * self.period

    def _averaged(self, rows: Array) -> tuple[Array, Array]:
        """Samples ``(k, 13)``, means over `stride` rows each, without the magnetic field; and the rows left over."""
        stride = self.stride
        whole = len(rows) // stride * stride
        samples = np.zeros((whole // stride, SAMPLE_COLUMNS))
        for k in range(stride):
            samples[:, : FIELD.start] += rows[k:whole:stride]
        samples /= stride
        return samples, rows[whole:]

    def _start_stretch(self) -> None:
        """Start a new stretch; the heading of the last stretch counts as earlier information from now on."""
        if self.current is not None or np.isfinite(self._drift_at):
            self.previous, self.current, self.stretch = self.current or self.previous, None, self.stretch + 1
        self._drift_at = np.nan
        self.samples, self.incomplete, self.field_count = self.samples[:0], self.incomplete[:0], 0
        self.durations, self.evaluated = self.durations[:0], 0.0
        self.offsets = self.offsets[:0]

    def _evaluate_if_due(self) -> None:
        """Evaluate the stretch if it has grown enough; end it if it is long or its heading is out of reach."""
        if len(self.samples) - self.field_count > 20.0 / self.spacing:
            self._fill_field()
        if self._earth is not None and len(self.samples):
            walked, step = self._walked(self.samples), self._usual_step(self.durations)
            if walked >= self._due(step):
                self._fill_field()
                self._evaluate(self._earth, step, self.samples, self.begin, walked)
        long = len(self.samples) * self.spacing >= COMPASS.longest_stretch
        first = min([self.current.time] if self.current is not None else [], default=self._drift_at)
        if long or self.end - first > self.reach:
            self._start_stretch()

    @property
    def spacing(self) -> float:
        """Interval between stored samples. [s]"""
        return self.period * self.stride

    def _walked(self, samples: Array) -> float:
        """Time of walking among samples. [s]"""
        return float(samples[:, IS_WALKING].sum()) * self.spacing

    def _due(self, step: float) -> float:
        """Time of walking in the stretch at which the next evaluation is due [s]; step: duration of a step [s]."""
        early = [count * step for count in FIRST_STEPS]
        return next((time for time in early if time > 1.05 * self.evaluated), self.evaluated + EVALUATED)

    def _count_dips(self, samples: Array) -> None:
        """Compare the dip of the field in samples with the earth's."""
        known = samples[np.any(samples[:, FIELD], axis=1)]
        if self._earth is None or abs(self._earth.dip) < 2 * NORTH.disturbed or not len(known):
            return
        world = Rotation.from_quat(known[:, ATTITUDE]).apply(known[:, FIELD])
        earths, opposite = (dip_error(world, sign * self._earth.dip) < NORTH.disturbed for sign in (1, -1))
        self.dips += np.array([len(known), earths.sum(), opposite.sum()])

    @property
    def mirrored(self) -> float:
        """Log-odds that the accelerations have the wrong sign, by the dip of the field; 0 before two seconds of it."""
        number, earths, opposite = self.dips.tolist()
        return BY_DIP * (opposite - earths) / number if number >= FEWEST_FIELDS else 0.0

    @staticmethod
    def _usual_step(durations: Array) -> float:
        return float(np.median(durations)) if len(durations) else np.inf

    def preview(self, gait: GaitSignals) -> None:
        """Evaluate the first steps of the stretch with the samples after the certain steps, which may still change."""
        variance = gait.direction.variance
        step = self._usual_step(np.append(self.durations, gait.landings.period))
        if self._earth is None or self.evaluated >= FIRST_STEPS[-1] * step or not np.isfinite(step):
            return
        follows = gait.attitude.period == self.period and gait.attitude.time[0] - self.end < 1.5 * self.period
        if not follows or variance[-1] > self.direction_variance or np.isnan(gait.attitude.angular_rate).any():
            return
        begin = self.begin
        if not len(self.samples) + len(self.incomplete):
            begin = self._first_time(float(gait.attitude.time[0]))
        new = self._averaged(np.concatenate([self.incomplete, self._rows(gait)]))[0]
        samples = np.concatenate([self.samples, new])
        walked = self._walked(samples)
        if walked < self._due(step):
            return
        self._fill_field()
        known = self.field_count
        samples[:known] = self.samples
        samples[known:, FIELD] = self.field.measured(begin + self.spacing * np.arange(known, len(samples), dtype=float))
        self._evaluate(self._earth, step, samples, begin, walked)

    def _evaluate(self, earth: EarthField, step: float, samples: Array, begin: float, walked: float) -> None:
        """Report the heading of the stretch with the information that it adds, or retract an earlier heading.

        step: duration of a step [s]; samples: of the stretch, with the magnetic field, from time ``begin`` [s] on;
        walked: time of walking among them [s].
        """
        self.evaluated, spacing = walked, self.spacing
        stood = max(0, int(np.argmax(samples[:, IS_WALKING] > 0.5)) - round(NORTH.alike / spacing))  # one disturbance
        samples, begin = samples[stood:], begin + stood * spacing
        attitude = Rotation.from_quat(samples[:, ATTITUDE])
        time = begin + spacing * np.arange(len(samples), dtype=float)
        part = Attitude(time, spacing, attitude, samples[:, ACCELERATION], np.zeros((len(samples), 3)))
        heading, walking = samples[:, HEADING], samples[:, IS_WALKING] > 0.5

        # The direction by this stretch alone
        north = magnetic_north(part, self.field.without_iron(samples[:, FIELD], earth.magnitude), earth)
        late = np.flatnonzero(walking)[-round(self.reach / 2 / spacing) : -round(2.0 / spacing)]
        if not len(north) or not len(late):
            if np.isfinite(self._drift_at):
                self._drifts.append(StretchValue(self.stretch, self._drift_at, 0.0, np.inf))
                self._drift_at = np.nan
            return self._retract()
        sample = straightest(heading, late, round(2.0 / spacing))
        ahead = live_forward_axis(part, heading, walking, step)
        moment = float(time[sample])
        self._drift_at = min(moment, self.end)  # within certain steps
        self._drifts.append(StretchValue(self.stretch, self._drift_at, north.drift, north.drift_sigma))
        north_sigma = float(np.interp(moment, north.time, north.sigma))
        if not max(ahead.sigma, north_sigma) < COMPASS.least_certain:
            return self._retract()
        course = heading[sample] + ahead.angle - np.interp(moment, north.time, north.direction) + np.pi / 2
        ahead_sigma = LIVE_COMPASS.unconfirmed if ahead.sigma == FORWARD.unconfirmed else ahead.sigma

        # The information that it adds to the earlier stretches
        offset, turn_variance = float(wrap_angle(course - heading[sample])), float(samples[sample, VARIANCE_OF_TURNS])
        changed = wrap_angle(offset - self.offsets)
        self.offsets = np.append(self.offsets, offset)[-3:]
        earlier = 1 / (self.previous.variance + turn_variance - self.previous.turn_variance)
        shared = 1 / max(1 / (ahead_sigma**2 + COMPASS.sigma**2) - earlier, 1e-9)
        variance = north_sigma**2 + shared + float(np.sum(changed**2)) / max(1, len(changed))
        if variance > LIVE_COMPASS.least_added**2:
            return self._retract()
        if moment > self.end:  # of certain steps; how far a turn has come within a pause between them is unknown
            certain = time[walking & (time <= self.end)]
            moment = float(certain[-1]) if len(certain) else self.end
        self.current = _Known(moment, 1 / (earlier + 1 / variance), turn_variance)
        direction = float(wrap_angle(offset + np.interp(moment, time, heading) + self._east))
        self._found.append(StretchValue(self.stretch, moment, direction, float(np.sqrt(variance))))

    def _retract(self) -> None:
        if self.current is not None:
            self._found.append(StretchValue(self.stretch, self.current.time, 0.0, np.inf))
            self.current = None

    def _fill_field(self) -> None:
        """Fill in the magnetic field of the new samples."""
        new = slice(self.field_count, len(self.samples))
        time = self.begin + self.spacing * np.arange(new.start, new.stop, dtype=float)
        self.samples[new, FIELD] = self.field.at(time, Rotation.from_quat(self.samples[new, ATTITUDE]))
        self.field_count = len(self.samples)
        self._count_dips(self.samples[new])


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


def fit_iron(measured: Array, magnitude: float, iron: Iron | None = None, rounds: int = 30) -> Iron:
    """Hard and soft iron from samples ``(n, 3)`` of a phone in changing orientations. [µT]

    The field has a constant magnitude [µT], so that the samples lie on an ellipsoid: robust least squares finds the one
    into which iron deforms the sphere. The sigmas are large where the orientations do not determine it.

    iron: start of the search; rounds: of Gauss–Newton steps with Cauchy's loss, enough from any start by default.
    """
    samples = measured[:: max(1, -(-len(measured) // MOST_FITTED))]
    if iron is None:
        iron = Iron(np.median(samples, axis=0), np.eye(3), np.full(3, MAGNETOMETER.hard_spread))
    i, j = np.triu_indices(3)
    usual = np.concatenate([np.zeros(3), np.eye(3)[i, j]])  # of any phone: hard iron and upper triangle of soft iron
    spread = np.repeat([MAGNETOMETER.hard_spread, MAGNETOMETER.soft_spread], [3, 6])
    share = np.sqrt(min(1.0, MAGNETOMETER.independent / len(samples)))
    for _ in range(rounds):
        apart = samples - iron.hard
        corrected = apart @ iron.soft
        length = np.linalg.norm(corrected, axis=1)
        towards = corrected / np.maximum(length, 1e-9)[:, None]
        by_soft = towards[:, i] * apart[:, j] + np.where(i == j, 0.0, towards[:, j] * apart[:, i])
        jacobian = np.concatenate([-towards @ iron.soft, by_soft], axis=1) / MAGNETOMETER.field_spread
        error = (length - magnitude) / MAGNETOMETER.field_spread
        state = np.concatenate([iron.hard, iron.soft[i, j]])
        weighted = jacobian * (share**2 / (1 + error**2))[:, None]
        information = weighted.T @ jacobian + np.diag(spread**-2.0)
        state = state - np.linalg.solve(information, weighted.T @ error + (state - usual) / spread**2)
        curvature = np.maximum((1 - error**2) / (1 + error**2) ** 2, 0.0)  # second derivative of the Cauchy loss
        certain = (jacobian * (share**2 * curvature)[:, None]).T @ jacobian + np.diag(spread**-2.0)
        soft = np.empty((3, 3))
        soft[i, j] = soft[j, i] = state[3:]
        iron = Iron(state[:3], soft, np.sqrt(np.diag(np.linalg.inv(certain))[:3]))
    return iron


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
    """[gps-dr] Sec. 3, second test: the angle ``(n,)`` between the field and the gyroscope's prediction of it. [rad]

    field: ``(n, 3)`` in the attitude's world. The paper predicts the next sample by `predicted_field`; over so
    short a time the sensor's noise exceeds any disturbance. Here the attitude predicts over a second: the prediction is
    the field in the world a second earlier.
    """
    lag = min(max(1, round(1.0 / period)), len(field) - 1)
    later, earlier = field[lag:], field[: len(field) - lag]
    angle = np.arctan2(np.linalg.norm(np.cross(later, earlier), axis=1), np.sum(later * earlier, axis=1))
    return np.concatenate([np.repeat(angle[:1], lag), angle])


def field_in_world(attitude: Attitude, device: Array, every: int = 1) -> Array:
    """The smoothed field in the attitude's world, at every so many samples, from that in device axes ``(n, 3)``. [µT]

    Only the rows that are returned are smoothed: an observation of north per second needs one of a hundred.
    """
    weights = gaussian_weights(0.5 / attitude.period)
    reach = len(weights) // 2
    world = np.pad(attitude.R_world_device.apply(device), ((reach, reach), (0, 0)), mode="edge")
    return sliding_window_view(world, len(weights), axis=0)[::every] @ weights


@dataclass(frozen=True)
class North:
    """True north over time.

    time: ``(m,)`` [s]; direction: ``(m,)`` of true north in the attitude's world, counter-clockwise from x, not wrapped
    [rad]; sigma: ``(m,)`` [rad]. 0 rows if the field is too disturbed.
    drift, drift_sigma: b of the gyroscope by which the attitude's world turns against the field [rad/s].
    """

    time: Array
    direction: Array
    sigma: Array
    drift: float = 0.0
    drift_sigma: float = np.inf

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
    every = max(1, round(1.0 / attitude.period))
    world, time = field_in_world(attitude, field, every), attitude.time[::every]
    errors = np.stack([dip_error(world, earth.dip), prediction_error(world, every * attitude.period)])
    level = np.hypot(world[:, 0], world[:, 1])
    valid = np.all(errors < NORTH.disturbed, axis=0) & (level > NORTH.weakest * earth.magnitude * np.cos(earth.dip))
    if np.mean(valid) < NORTH.least_valid:
        return North(np.empty(0), np.empty(0), np.empty(0))
    observed = np.arctan2(world[:, 1], world[:, 0]) + earth.declination
    variance = NORTH.undisturbed**2 + np.sum(errors**2, axis=0) / np.cos(earth.dip) ** 2
    drift, drift_sigma = gyro_drift(time[valid], observed[valid], 1 / variance[valid])
    turned = -expected_drift(drift, drift_sigma) * (time - time[0])
    variance = np.where(valid, variance * (1 + 2 * NORTH.alike), np.inf)
    direction, sigma = _smoothed(observed - turned, variance)
    return North(time, direction + turned, sigma, drift, drift_sigma)


def gyro_drift(time: Array, north: Array, weight: Array) -> tuple[float, float]:
    """The gyroscope's drift b and its standard deviation [rad/s], by directions of north in the attitude's world.

    b is the rate at which all observations agree best: the largest resultant of exp(i (north + b t)), refined by robust
    least squares. Observations whose residuals (rms) exceed NORTH.disagree measure no drift: a frozen or mirrored field
    of a walker who turns. Residuals are alike for twice NORTH.alike, and at least as large as those of a field without
    disturbances. The sigma is at least that of a jackknife: the drifts without one of DRIFT_PARTS parts of the time.

    time: ``(n,)`` [s]; north: ``(n,)`` [rad]; weight: ``(n,)`` relative.
    """
    alike = 2 * NORTH.alike  # observations with the same disturbance
    if len(time) < 2 * alike * DRIFT_PARTS:
        return 0.0, np.inf
    weight = weight / weight.sum()
    apart = time - weight @ time
    spread = float(np.sqrt(weight @ apart**2))
    rates = np.arange(-REST.largest_bias, REST.largest_bias, 0.5 / spread)
    resultant = np.exp(1j * (north + rates[:, None] * apart)) @ weight
    best = int(np.argmax(np.abs(resultant)))
    drift, towards = float(rates[best]), float(np.angle(resultant[best]))
    residual, inlying = np.zeros(len(time)), weight
    for _ in range(5):
        residual = wrap_angle(north + drift * apart - towards)
        rms = float(np.sqrt(weight @ residual**2)) + NORTH.undisturbed
        inlying = weight * np.minimum(1.0, OUTLYING * rms / np.maximum(np.abs(residual), 1e-9))
        slope, offset = np.polyfit(apart, residual, 1, w=np.sqrt(inlying)).tolist()
        drift, towards = drift - slope, towards + offset
    if not weight @ residual**2 < NORTH.disagree**2:
        return 0.0, np.inf
    variance = (weight @ residual**2 + NORTH.undisturbed**2) / (len(time) / alike) / spread**2
    part = np.arange(len(time)) * DRIFT_PARTS // len(time)
    others = [part != k for k in range(DRIFT_PARTS)]
    slopes = [np.polyfit(apart[rest], residual[rest], 1, w=np.sqrt(inlying[rest]))[0] for rest in others]
    jackknife = (DRIFT_PARTS - 1) * np.var(slopes)
    return drift, float(np.sqrt(max(variance, jackknife)))


def expected_drift(drift: float, sigma: float) -> float:
    """The mean of a drift that was measured with this sigma, by the prior of all gyroscopes. [rad/s]"""
    if not np.isfinite(sigma):
        return 0.0
    share = np.array([1 - WALKER.drifting, WALKER.drifting])
    variance = np.array([WALKER.sigma[2], WALKER.far]) ** 2
    total = variance + sigma**2
    logarithm = np.log(share) - 0.5 * np.log(total) - 0.5 * drift**2 / total
    probability = np.exp(logarithm - logarithm.max())
    return float(drift * (probability @ (variance / total)) / probability.sum())


def _smoothed(observed: Array, variance: Array) -> tuple[Array, Array]:
    """Direction and standard deviation ``(n,)`` [rad] given all observations and their variances ``(n,)`` [rad²].

    A Kalman filter with clipped innovations, then the backward pass of Rauch, Tung and Striebel. Observations before
    the first valid one have no effect.
    """
    grows, first = NORTH.drift**2, int(np.argmin(np.isinf(variance)))
    state, uncertainty = float(observed[first]), float(variance[first])
    states, uncertainties = [state] * (first + 1), [uncertainty + grows * k for k in range(first, -1, -1)]
    for measured, spread in zip(observed[first + 1 :].tolist(), variance[first + 1 :].tolist(), strict=True):
        uncertainty += grows
        gain = uncertainty / (uncertainty + spread)
        innovation = (measured - state + pi) % (2 * pi) - pi
        widest = OUTLYING * sqrt(uncertainty + spread)
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
        if len(self.stream.arrived) >= 20:  # packets that are validated together
            self.ingest()

    def ingest(self) -> None:
        """Validate the samples that were pushed, and drop those older than a minute."""
        self.stream.ingest(self.stream.offset)
        self.stream.forget(self.stream.last - 60.0)

    def measured(self, time: Array) -> Array:
        """The field ``(n, 3)`` in device axes at times ``(n,)`` [s]; 0 without samples. [µT]"""
        self.ingest()
        if not len(self.stream.time) or not len(time):
            return np.zeros((len(time), 3))
        if abs(self.stream.last - time[-1]) > 120.0:  # [s]: it stopped, or its first times were wrong
            self.stream = SensorStream()
            return np.zeros((len(time), 3))
        return measured_field(Signal(self.stream.time, self.stream.values), time)

    def at(self, time: Array, R_world_device: Rotation) -> Array:
        """The same, at evenly spaced times; adds the samples to those for the fit of iron."""
        field = self.measured(time)
        if not len(time):
            return field
        every = max(1, round(0.5 * len(time) / (time[-1] - time[0] + 1e-9)))  # two samples a second
        up = R_world_device.inv().apply([0.0, 0.0, 1.0])
        selected = np.flatnonzero(np.any(field, axis=1))[::every]
        self.calibration = np.concatenate([self.calibration, field[selected]])[-MOST_FITTED:]
        self.up = np.concatenate([self.up, up[selected]])[-MOST_FITTED:]
        return field

    def without_iron(self, field: Array, magnitude: float) -> Array:
        """The field around the phone ``(n, 3)``; the measured field if the phone was not tilted enough. [µT]"""
        if not len(self.up) or np.linalg.norm(self.up.mean(axis=0)) >= MAGNETOMETER.tilted:
            return field
        self.iron = iron = fit_iron(self.calibration, magnitude, self.iron, rounds=3)
        return np.where(np.any(field, axis=1)[:, None], iron.corrected(field), 0.0) if iron.reliable else field
