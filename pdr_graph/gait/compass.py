"""Absolute walking directions by the magnetometer: a few for a walk, with honest sigmas, or none; batch and live.

Live, a stretch of the walk gets a heading as soon as it is worth something, and better ones in its place as it grows.
All headings of a walk share most of their error (the phone's own iron, the forward axis, a plan's axis). In batch that
variance is multiplied by the number of headings; live nobody knows how many will come. So a live heading carries only
what it adds: the earlier stretches told the direction with some variance P, which has grown by that of the turns since.
The next, of variance S alone, gets v with 1/v = 1/S − 1/P. However many there are, together they never tell the present
direction better than the best of them would alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from pdr_graph import storage
from pdr_graph.errors import expect
from pdr_graph.frames import EarthField, Frame, earth_field
from pdr_graph.gait.heading import UNCONFIRMED, Direction, forward_axis
from pdr_graph.gait.signals import GAP_SIGMA_TURN, GaitSignals, gait_signals
from pdr_graph.gait.walker import Walker
from pdr_graph.geometry import wrap_angle
from pdr_graph.inertial.attitude import Attitude, runs
from pdr_graph.inertial.magnetometer import TILTED, MagnetometerStream, North, fit_iron, magnetic_north, measured_field
from pdr_graph.types import Array, Headings, Index, Mask, Recording

STRETCH = 150.0  # [s] that one heading speaks for: a gyroscope that drifts by 0.002 rad/s is as unsure then
ABOUT = 2.0  # [s] to either side of it, in which a walker should not turn
LEAST_STEPS = 24  # in a stretch; a few may be none
COMPASS_SIGMA = 0.2  # [rad] that stays for a whole walk: the phone's own iron, a building's axis, a plan's
LEAST_CERTAIN = 0.7  # [rad] of north or of what is ahead; beyond it a heading tells nothing


def magnetic_headings(recording: Recording | list[GaitSignals], frame: Frame, near: Array) -> Headings:
    """Walking directions where the magnetometer can be believed, and gait or grip tell what is ahead.

    Headings of one walk share most of their error. So that many do not pretend to know it better than one, the shared
    variance is counted as often as there are headings: all together weigh what one would.

    recording: or its `gait_signals`; frame: of the headings; near: ``(2,)`` a position of the walk in it [m], for the
    World Magnetic Model. Returns 0 rows in a frame that is not georeferenced, or without accelerometer, gyroscope and
    magnetometer.
    """
    expect("magnetic_headings, recording", recording, Recording, list, instead="load(path)")
    expect("magnetic_headings, frame", frame, Frame, instead="FloorPlan.frame or frame_of(fixes)")
    expect("magnetic_headings, near", near, np.ndarray, instead="fixes.position[0]")
    whole = recording if isinstance(recording, Recording) else recording[0].recording
    if not frame.georeferenced or None in (whole.accelerometer, whole.gyroscope, whole.magnetometer):
        return Headings.none()
    lon, lat = frame.to_lonlat(near[None])[0].tolist()
    earth = earth_field(lat, lon, whole.epoch)
    found = [row for gait in gait_signals(recording) for row in _uninterrupted_headings(gait, earth)]
    time, from_east, own, ahead = np.array(found).reshape(-1, 4).T
    heading = wrap_angle(from_east + frame.bearing_of_east(near))
    return Headings(time, heading, np.sqrt(own**2 + len(time) * (ahead**2 + COMPASS_SIGMA**2)))


def _uninterrupted_headings(gait: GaitSignals, earth: EarthField) -> list[tuple[float, float, float, float]]:
    """Rows of time, heading from true east, and the sigmas of north and of what is ahead."""
    attitude, walking, step = gait.attitude, gait.walking, gait.landings.usual_step
    north = _north(attitude, gait.recording, earth)
    if not len(north) or len(gait.landings) < LEAST_STEPS:
        return []
    rows = []
    for stretch in _stretches(gait.direction, attitude.time):
        held, heading, here = attitude[stretch], gait.direction.heading[stretch], walking[stretch]
        if np.sum(here) * attitude.period < LEAST_STEPS * step:
            continue
        walked = np.flatnonzero(here)
        middle = walked[len(walked) // 4 : max(1, len(walked) - len(walked) // 4)]
        straight = straightest(heading, middle, round(ABOUT / attitude.period))
        found = course_from_east(held, heading, here, step, north, straight)
        if found is not None:
            rows.append((float(held.time[straight]), *found))
    return rows


def course_from_east(
    held: Attitude, heading: Array, walking: Mask, step: float, north: North, sample: int
) -> tuple[float, float, float] | None:
    """Where a walker went at a sample, from true east, and the sigmas of north and of what is ahead; None if unsure.

    held, heading, walking, step: as of `forward_axis`. [rad]
    """
    ahead, moment = forward_axis(held, heading, walking, step), float(held.time[sample])
    sigma = float(np.interp(moment, north.time, north.sigma))
    if not max(ahead.sigma, sigma) < LEAST_CERTAIN:
        return None
    east = np.interp(moment, north.time, north.direction) - np.pi / 2
    return float(wrap_angle(heading[sample] + ahead.angle - east)), sigma, ahead.sigma


def straightest(heading: Array, among: Index, reach: int) -> int:
    """Of some samples that about which the heading turns least: a heading is of one moment."""
    turned = heading[np.minimum(among + reach, len(heading) - 1)] - heading[np.maximum(among - reach, 0)]
    return int(among[np.argmin(np.abs(turned))])


def _north(attitude: Attitude, recording: Recording, earth: EarthField) -> North:
    assert recording.magnetometer is not None, "asked for by magnetic_headings"
    field = measured_field(recording.magnetometer, attitude.time)
    up = attitude.R_world_device.inv().apply([0.0, 0.0, 1.0])
    measured = np.any(field, axis=1)
    if np.linalg.norm(up.mean(axis=0)) < TILTED and measured.any():
        iron = fit_iron(field[measured], earth.magnitude)
        field[measured] = iron.corrected(field[measured]) if iron.known else field[measured]
    return magnetic_north(attitude, field, earth)


def _stretches(direction: Direction, time: Array) -> list[slice]:
    """Parts of a walk, of equal duration up to STRETCH, in which the phone was not held otherwise."""
    reheld = np.diff(direction.variance, prepend=direction.variance[0]) > 0
    stretches = []
    for first, after in zip(*runs(~reheld), strict=True):
        count = max(1, int(np.ceil((time[after - 1] - time[first]) / STRETCH)))
        cuts = np.linspace(first, after, count + 1).round().astype(int).tolist()
        stretches += [slice(*span) for span in pairwise(cuts)]
    return stretches


SAMPLING = 0.04  # [s] of the samples that are kept
EVERY = 10.0  # [s] of walking until a stretch is looked at again
RECENT = 20.0  # [s] of walking before its end, in which its heading is: a graph of the last minute has it still
REPLACED = 40.0  # [s] after which a heading is out of such a graph's reach: what follows is another stretch
NOT_YET = 0.6  # [rad] of what is ahead, until gait confirms it: a phone in a bag may lie as one is read
LEAST_ADDED = 1.0  # [rad] beyond which a heading adds nothing
ANSWERS = 3  # of a stretch before, by whose differences from the next that is unsure: stairs, or steel where it began
ATTITUDE, ACCELERATION, FIELD = slice(0, 4), slice(4, 7), slice(10, 13)
HEADING, WALKING, DOUBT = 7, 8, 9  # columns of samples; doubt: variance of all turns so far, as the graph believes it
COLUMNS = 13


@dataclass(frozen=True)
class LiveHeading:
    """Where the walker went at a time [s], counter-clockwise from +x [rad], within sigma [rad].

    stretch: its number; a later one takes the place of that of the same stretch. sigma is infinite where what was said
    of it has turned out to be worth nothing.
    """

    stretch: int
    time: float
    heading: float
    sigma: float


@dataclass(frozen=True)
class CompassCheckpoint:
    """What a `LiveCompass` knows but for where the walk is."""

    field: MagnetometerStream
    stretch: int
    samples: Array
    fielded: int
    open: Array
    doubt: float
    begin: float
    end: float
    period: float
    reheld: float
    durations: Array
    looked: float
    answers: Array
    said: Array
    told: Array


class LiveCompass:
    """Headings as magnetometer samples are pushed and a `StepStream`, whose listener is `take`, goes on.

    walker: whose turns are as unsure as the graph believes. It says nothing before it is `locate`-d.
    """

    def __init__(self, walker: Walker | None = None):
        self.sigma_turn = (walker or Walker()).sigma_turn
        self.field = MagnetometerStream()
        self.stretch = 0
        self.samples = np.empty((0, COLUMNS))  # of the stretch
        self.fielded = 0  # so many of which have their field
        self.open = np.empty((0, FIELD.start))  # not enough for a sample
        self.doubt = 0.0  # [rad²]
        self.begin, self.end = np.nan, np.nan  # of the samples, and of what was taken [s]
        self.period = np.nan
        self.reheld = 0.0  # variance of the direction by the end [rad²]
        self.durations = np.empty(0)  # of the stretch's steps [s]
        self.looked = 0.0  # [s] walked in the stretch when it was looked at
        self.answers = np.empty(0)  # the last of the stretch: directions from east where its heading is 0 [rad]
        self.said = np.empty((0, 3))  # time, variance and doubt of the stretch's heading, if there is one
        self.told = np.array([np.inf, 0.0])  # variance by the stretches before, and the doubt then
        self._earth: EarthField | None = None
        self._east = 0.0
        self._found: list[LiveHeading] = []

    def locate(self, frame: Frame, near: Array, epoch: float | None = None) -> None:
        """Say where the walk is: near ``(2,)`` in a frame [m], that of the headings; epoch: Unix time of time 0 [s]."""
        if frame.georeferenced and np.isfinite(near).all():
            lon, lat = frame.to_lonlat(near[None])[0].tolist()
            self._earth, self._east = earth_field(lat, lon, epoch), frame.bearing_of_east(near)

    def push(self, time: Array, values: Array) -> None:
        """Samples of the magnetometer at times ``(n,)`` [s], as of `Signal`."""
        self.field.push(time, values)

    def advance(self) -> list[LiveHeading]:
        """What was found since the last call."""
        found, self._found = self._found, []
        return found

    def checkpoint(self) -> CompassCheckpoint:
        """All that it knows but for where the walk is, after an `advance`."""
        self.field.ingest()
        return storage.checkpoint(self, CompassCheckpoint)

    def restore(self, checkpoint: CompassCheckpoint) -> None:
        """Go on from a checkpoint, of the same walker."""
        storage.restore(self, checkpoint)
        self._found.clear()

    def take(self, gait: GaitSignals) -> None:
        """The next samples of the walk that are certain."""
        attitude, variance = gait.attitude, gait.direction.variance
        time = attitude.time
        if not len(time):
            return
        if not (attitude.period == self.period and time[0] - self.end < 1.5 * self.period):
            self._begin_anew()
            self.doubt += GAP_SIGMA_TURN**2  # of the gap
            self.period, self.reheld = attitude.period, float(variance[0])
        rows = self._rows(gait)
        carried = ~(np.diff(variance, prepend=self.reheld) > 0) & (not attitude.unknown)
        self.durations = np.append(self.durations, gait.landings.period)
        for first, after in np.transpose(runs(carried)).tolist():
            if first > 0:
                self._begin_anew()
            self._extend(rows[first:after], float(time[first]))
        if not carried[-1]:
            self._begin_anew()
        self.doubt += self.sigma_turn**2 * len(gait.landings) + float(variance[-1]) - self.reheld
        self.reheld, self.end = float(variance[-1]), float(time[-1])
        self._look()

    def _rows(self, gait: GaitSignals) -> Array:
        """The samples, without a field."""
        attitude, direction = gait.attitude, gait.direction
        steps = np.searchsorted(gait.landings.time, attitude.time, side="right")
        doubt = self.doubt + self.sigma_turn**2 * steps + direction.variance - self.reheld
        columns = (direction.heading, gait.walking.astype(float), doubt)
        return np.hstack([attitude.R_world_device.as_quat(), attitude.acceleration, np.stack(columns, axis=1)])

    @property
    def stride(self) -> int:
        """Samples of the phone in one that is kept."""
        return max(1, round(SAMPLING / self.period))

    def _extend(self, rows: Array, begin: float) -> None:
        """More of the stretch: means over a stride of them."""
        stride = self.stride
        if not len(self.samples) + len(self.open):
            self.begin = begin + (stride - 1) / 2 * self.period
        rows = np.concatenate([self.open, rows])
        whole = len(rows) // stride * stride
        mean = rows[:whole].reshape(-1, stride, rows.shape[1]).mean(axis=1)
        self.open = rows[whole:]
        self.samples = np.concatenate([self.samples, np.pad(mean, ((0, 0), (0, COLUMNS - mean.shape[1])))])

    def _begin_anew(self) -> None:
        """Another stretch."""
        if len(self.said):
            (_, variance, doubt), self.stretch = self.said[0], self.stretch + 1
            self.told = np.array([variance, doubt])
        self.samples, self.open, self.fielded = self.samples[:0], self.open[:0], 0
        self.durations, self.looked = self.durations[:0], 0.0
        self.answers, self.said = self.answers[:0], self.said[:0]

    def _look(self) -> None:
        """Say what the stretch tells if it has grown enough; end it where it is long, or out of reach."""
        spacing = self.period * self.stride
        if len(self.samples) - self.fielded > RECENT / spacing:
            self._fill()
        walked = float(self.samples[:, WALKING].sum()) * spacing
        step = float(np.median(self.durations)) if len(self.durations) else np.inf
        due = self.looked + EVERY if self.looked else LEAST_STEPS * step
        if self._earth is not None and walked >= due and len(self.samples):
            self.looked = walked
            self._fill()
            self._say(self._earth, step, spacing)
        long = len(self.samples) * spacing >= STRETCH
        if long or (len(self.said) and self.end - self.said[0, 0] > REPLACED):
            self._begin_anew()

    def _say(self, earth: EarthField, step: float, spacing: float) -> None:
        """The heading of the stretch, less what is known already."""
        attitude = Rotation.from_quat(self.samples[:, ATTITUDE])
        time = self.begin + spacing * np.arange(len(self.samples), dtype=float)
        held = Attitude(time, spacing, attitude, self.samples[:, ACCELERATION], None)
        heading, walking = self.samples[:, HEADING], self.samples[:, WALKING] > 0.5

        # What the stretch tells
        north = magnetic_north(held, self.field.without_iron(self.samples[:, FIELD], earth.magnitude), earth)
        late = np.flatnonzero(walking)[-round(RECENT / spacing) : -round(ABOUT / spacing)]
        if not len(north) or not len(late):
            return self._take_back()
        sample = straightest(heading, late, round(ABOUT / spacing))
        found = course_from_east(held, heading, walking, step, north, sample)
        if found is None:
            return self._take_back()
        course, own, ahead = found
        ahead = NOT_YET if ahead == UNCONFIRMED else ahead

        # What that adds
        answer, doubt = course - heading[sample], float(self.samples[sample, DOUBT])
        changed = wrap_angle(answer - self.answers)
        self.answers = np.append(self.answers, answer)[-ANSWERS:]
        known = 1 / (self.told[0] + doubt - self.told[1])
        shared = 1 / max(1 / (ahead**2 + COMPASS_SIGMA**2) - known, 1e-9)
        variance = own**2 + shared + float(np.sum(changed**2)) / max(1, len(changed))
        if variance > LEAST_ADDED**2:
            return self._take_back()
        self.said = np.array([[time[sample], 1 / (known + 1 / variance), doubt]])
        direction = float(wrap_angle(course + self._east))
        self._found.append(LiveHeading(self.stretch, float(time[sample]), direction, float(np.sqrt(variance))))

    def _take_back(self) -> None:
        if len(self.said):
            self._found.append(LiveHeading(self.stretch, float(self.said[0, 0]), 0.0, np.inf))
            self.said = self.said[:0]

    def _fill(self) -> None:
        """Give the samples their field."""
        spacing = self.period * self.stride
        new = slice(self.fielded, len(self.samples))
        time = self.begin + spacing * np.arange(new.start, new.stop, dtype=float)
        self.samples[new, FIELD] = self.field.at(time, Rotation.from_quat(self.samples[new, ATTITUDE]))
        self.fielded = len(self.samples)
