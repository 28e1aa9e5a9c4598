"""Absolute walking directions by the magnetometer: a few per walk with honest sigmas, or none.

All headings of a walk share most of their error (the phone's own iron, the forward axis, a plan's axis), and their
number is not known in advance. The walk is divided into stretches; each gets a heading as soon as it is informative,
and better ones replace it as the stretch grows. A heading carries only the information that it adds: if the earlier
stretches determine the direction with variance P (which has grown by that of the turns since), and this stretch alone
would with variance S, then the heading gets the variance v of 1/v = 1/S − 1/P. So all headings together never determine
the present direction better than the best of them alone.

The headings of a recording are the last ones of its stretches.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from pdr_graph.errors import expect
from pdr_graph.frames import EarthField, Frame, earth_field
from pdr_graph.gait.heading import live_forward_axis
from pdr_graph.gait.steps import GaitSignals, gait_signals
from pdr_graph.gait.walker import Walker
from pdr_graph.geometry import wrap_angle
from pdr_graph.inertial.attitude import Attitude, runs
from pdr_graph.inertial.magnetometer import LIVE_MAGNETOMETER, MagnetometerStream, magnetic_north
from pdr_graph.priors import COMPASS, FORWARD, LIVE_COMPASS, MOTION, NORTH
from pdr_graph.types import Array, Headings, Index, Recording


def magnetic_headings(recording: Recording | list[GaitSignals], frame: Frame, near: Array) -> Headings:
    """Walking directions where the magnetic field passes its tests and the forward axis is known.

    recording: or its `gait_signals`; frame: of the headings; near: ``(2,)`` a position of the walk in it [m], for the
    World Magnetic Model. Returns 0 rows in a frame that is not georeferenced, or without accelerometer, gyroscope and
    magnetometer.
    """
    expect("magnetic_headings, recording", recording, Recording, list, instead="load(path)")
    expect("magnetic_headings, frame", frame, Frame, instead="FloorPlan.frame or frame_of(fixes)")
    expect("magnetic_headings, near", near, np.ndarray, instead="fixes.position[0]")
    whole = recording if isinstance(recording, Recording) else recording[0].recording
    field = whole.magnetometer
    if not frame.georeferenced or field is None or whole.accelerometer is None or whole.gyroscope is None:
        return Headings.none()
    compass, used = LiveCompass(reach=2 * COMPASS.longest_stretch), 0
    compass.locate(frame, near, whole.epoch)
    of_stretch: dict[int, LiveHeading] = {}
    for gait in gait_signals(recording):
        for piece in gait.pieces(EVALUATION_INTERVAL):
            before, used = used, int(np.searchsorted(field.time, piece.attitude.time[-1], side="right")) + 1
            compass.push(field.time[before:used], field.values[before:used])
            compass.update(piece)
            of_stretch |= {found.stretch: found for found in compass.advance()}
    rows = [(found.time, found.heading, found.sigma) for found in of_stretch.values() if np.isfinite(found.sigma)]
    time, heading, sigma = np.array(rows).reshape(-1, 3).T
    return Headings(time, heading, sigma)


def straightest(heading: Array, among: Index, reach: int) -> int:
    """The sample among ``among (k,)`` with the smallest turn from ``reach`` samples before to as many after."""
    turned = heading[np.minimum(among + reach, len(heading) - 1)] - heading[np.maximum(among - reach, 0)]
    return int(among[np.argmin(np.abs(turned))])


EVALUATION_INTERVAL = 30.0  # [s] of a recording between evaluations
ATTITUDE, ACCELERATION, FIELD = slice(0, 4), slice(4, 7), slice(10, 13)
HEADING, IS_WALKING, TURN_VARIANCE = 7, 8, 9  # columns of samples; the variance is that of all turns so far
SAMPLE_COLUMNS = 13


@dataclass(frozen=True)
class LiveHeading:
    """The walking direction at a time [s], counter-clockwise from +x, and its standard deviation [rad].

    stretch: its number; a heading replaces earlier ones of the same stretch. sigma is infinite to retract them.
    """

    stretch: int
    time: float
    heading: float
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

    def __init__(self, walker: Walker | None = None, reach: float | None = None):
        self.sigma_turn = (walker or Walker()).sigma_turn
        self.reach = LIVE_COMPASS.out_of_reach if reach is None else reach
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
        self._found: list[LiveHeading] = []

    def locate(self, frame: Frame, near: Array, epoch: float | None = None) -> None:
        """Set the location: near ``(2,)`` in the frame of the headings [m]; epoch: Unix time of time 0 [s]."""
        if frame.georeferenced and np.isfinite(near).all():
            lon, lat = frame.to_lonlat(near[None])[0].tolist()
            self._earth, self._east = earth_field(lat, lon, epoch), frame.bearing_of_east(near)

    def push(self, time: Array, values: Array) -> None:
        """Add samples of the magnetometer at times ``(n,)`` [s], as in `Signal`."""
        self.field.push(time, values)

    def advance(self) -> list[LiveHeading]:
        """The headings since the last call."""
        found, self._found = self._found, []
        return found

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
        return max(1, round(LIVE_COMPASS.sampling / self.period))

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
        """Start a new stretch; the heading of the last one counts as earlier information from now on."""
        if self.current is not None:
            self.previous, self.current, self.stretch = self.current, None, self.stretch + 1
        self.samples, self.incomplete, self.field_count = self.samples[:0], self.incomplete[:0], 0
        self.durations, self.evaluated = self.durations[:0], 0.0
        self.offsets = self.offsets[:0]

    def _evaluate_if_due(self) -> None:
        """Evaluate the stretch if it has grown enough; end it if it is long or its heading is out of reach."""
        if len(self.samples) - self.field_count > LIVE_MAGNETOMETER.history / 3 / self.spacing:
            self._fill_field()
        if self._earth is not None and len(self.samples):
            walked, step = self._walked(self.samples), self._usual_step(self.durations)
            if walked >= self._due(step):
                self._fill_field()
                self._evaluate(self._earth, step, self.samples, self.begin, walked)
        long = len(self.samples) * self.spacing >= COMPASS.longest_stretch
        if long or (self.current is not None and self.end - self.current.time > self.reach):
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
        early = [count * step for count in LIVE_COMPASS.early_steps]
        return next((time for time in early if time > 1.05 * self.evaluated), self.evaluated + LIVE_COMPASS.evaluation)

    @staticmethod
    def _usual_step(durations: Array) -> float:
        return float(np.median(durations)) if len(durations) else np.inf

    def preview(self, gait: GaitSignals) -> None:
        """Evaluate the first steps of the stretch with the samples after the certain ones, which may still change."""
        variance = gait.direction.variance
        step = self._usual_step(np.append(self.durations, gait.landings.period))
        if self._earth is None or self.evaluated >= LIVE_COMPASS.early_steps[-1] * step or not np.isfinite(step):
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
        """Report the heading of the stretch with the information that it adds, or retract an earlier one.

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
        late = np.flatnonzero(walking)[-round(self.reach / 2 / spacing) : -round(COMPASS.straight / spacing)]
        if not len(north) or not len(late):
            return self._retract()
        sample = straightest(heading, late, round(COMPASS.straight / spacing))
        ahead = live_forward_axis(part, heading, walking, step)
        moment = float(time[sample])
        north_sigma = float(np.interp(moment, north.time, north.sigma))
        if not max(ahead.sigma, north_sigma) < COMPASS.least_certain:
            return self._retract()
        course = heading[sample] + ahead.angle - np.interp(moment, north.time, north.direction) + np.pi / 2
        ahead_sigma = LIVE_COMPASS.unconfirmed if ahead.sigma == FORWARD.unconfirmed else ahead.sigma

        # The information that it adds to the earlier stretches
        offset, turn_variance = float(wrap_angle(course - heading[sample])), float(samples[sample, TURN_VARIANCE])
        changed = wrap_angle(offset - self.offsets)
        self.offsets = np.append(self.offsets, offset)[-LIVE_COMPASS.offsets :]
        earlier = 1 / (self.previous.variance + turn_variance - self.previous.turn_variance)
        shared = 1 / max(1 / (ahead_sigma**2 + COMPASS.sigma**2) - earlier, 1e-9)
        variance = north_sigma**2 + shared + float(np.sum(changed**2)) / max(1, len(changed))
        if variance > LIVE_COMPASS.least_added**2:
            return self._retract()
        moment = min(moment, self.end)  # of certain steps
        self.current = _Known(moment, 1 / (earlier + 1 / variance), turn_variance)
        direction = float(wrap_angle(offset + np.interp(moment, time, heading) + self._east))
        self._found.append(LiveHeading(self.stretch, moment, direction, float(np.sqrt(variance))))

    def _retract(self) -> None:
        if self.current is not None:
            self._found.append(LiveHeading(self.stretch, self.current.time, 0.0, np.inf))
            self.current = None

    def _fill_field(self) -> None:
        """Fill in the magnetic field of the new samples."""
        new = slice(self.field_count, len(self.samples))
        time = self.begin + self.spacing * np.arange(new.start, new.stop, dtype=float)
        self.samples[new, FIELD] = self.field.at(time, Rotation.from_quat(self.samples[new, ATTITUDE]))
        self.field_count = len(self.samples)
