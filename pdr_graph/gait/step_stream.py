"""Live steps: samples as they arrive become the steps that `detect_steps` finds in the whole recording.

A `StepStream` is a sequence of `SegmentStream`s, one for each uninterrupted part of the samples.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np

from pdr_graph.gait.heading import Direction, HeadingStream
from pdr_graph.gait.step_chunks import concatenate_steps, gap
from pdr_graph.gait.step_detection import Landings, StepDetector, decimation
from pdr_graph.gait.steps import GaitSignals, steps_of
from pdr_graph.gait.walker import Walker
from pdr_graph.inertial.attitude import (
    NO_GRAVITY,
    SHORTEST_WALK,
    AttitudeStream,
    GravityRestorer,
)
from pdr_graph.inertial.sensor_stream import SENSOR_VALIDATION, Health, SensorStream
from pdr_graph.priors import REST, STEP
from pdr_graph.types import STEP_COLUMNS, Array, Recording, Steps


class StepStream:
    """Steps as samples arrive.

    A step is certain about five seconds after it, and some seconds later if the phone turned and only the following
    steps show whether the walker turned too. The chunks of certain steps follow one another and together are the walk.

    listener: called with the gait signals of each chunk when it becomes certain; preview: called after it with those
    of all later samples, which may still change.
    """

    def __init__(
        self,
        walker: Walker | None = None,
        listener: Callable[[GaitSignals], None] | None = None,
        preview: Callable[[GaitSignals], None] | None = None,
    ):
        self.walker, self.listener, self.preview = walker or Walker(), listener, preview
        self._sensors = {name: SensorStream() for name in ("accelerometer", "gyroscope")}
        self._has_accelerometer, self._gravity = False, GravityRestorer()
        self._segment: SegmentStream | None = None
        self._end, self._bias = np.nan, np.zeros(3)  # of the earlier segments
        self._provisional: Steps | None = None  # corrected by the profile

    @property
    def offset(self) -> float:
        """Time that is added to the samples' times since a reset of the clock. [s]"""
        return max(sensor.offset for sensor in self._sensors.values())

    @property
    def health(self) -> dict[str, Health]:
        """Statistics of each sensor's samples."""
        sensors = deepcopy(self._sensors)  # packets are validated together when they are due, whatever is asked before
        _ingest(*sensors.values())
        return {name: sensor.health for name, sensor in sensors.items()}

    def push(self, sensor: str, time: Array, values: Array) -> None:
        """Add samples of a sensor, by its name in ``Recording.signals``, at times ``(n,)`` [s], as in `Signal`.

        Sensors other than accelerometer and gyroscope are ignored; ``linear_acceleration`` replaces a missing
        accelerometer.
        """
        self._has_accelerometer |= sensor == "accelerometer"
        if sensor == "linear_acceleration" and not self._has_accelerometer:
            sensor, values = "accelerometer", self._gravity.restored(np.asarray(values, dtype=float))
        if sensor in self._sensors:
            self._sensors[sensor].push(time, values)

    def advance(self) -> tuple[Steps | None, Steps | None]:
        """The steps that became certain since the last call, and the provisional ones up to the latest sample.

        None if there are none.
        """
        if not self._is_due():
            return None, self._provisional
        _ingest(*self._sensors.values())
        return self._advance(self._usable_until(), last=False), self._provisional

    def finish(self) -> Steps | None:
        """The remaining steps: no more samples follow."""
        _ingest(*self._sensors.values())
        accelerometer, gyroscope = self._sensors.values()
        alone = gyroscope.last < accelerometer.last - REST.longest_bridged
        until = accelerometer.last if alone else min(accelerometer.last, gyroscope.last)
        return self._advance(until, last=True)

    def _is_due(self) -> bool:
        """True if a block of samples, or many packets, wait for processing."""
        sensors = self._sensors.values()
        due = -np.inf if self._segment is None else self._segment.next_time(self._segment.block)
        newest = [sensor.newest for sensor in sensors]
        if min(newest) >= due or max(newest) >= due + STEP_STREAM.lagging:
            return True
        return max(len(sensor.arrived) for sensor in sensors) >= STEP_STREAM.packets

    def _usable_until(self) -> float:
        """Time up to which both sensors have samples, or the accelerometer if the gyroscope stopped. [s]"""
        accelerometer, gyroscope = self._sensors.values()
        patience = REST.longest_bridged + max(accelerometer.longest_packet, gyroscope.longest_packet)
        if max(gyroscope.last, accelerometer.start) < accelerometer.last - patience:
            return accelerometer.last
        return min(accelerometer.last, gyroscope.last)

    def _advance(self, until: float, last: bool) -> Steps | None:
        """Process the samples up to a time [s]; returns the steps that became certain."""
        chunks: list[Steps] = []
        while self._advance_segment(until, last, chunks):
            pass
        if self._segment is not None:
            for sensor in self._sensors.values():
                sensor.forget(self._segment.next_time(1))
            self._provisional = self._corrected(self._segment.provisional())
            if self.preview is not None and self._provisional is not None:
                self.preview(self._segment.provisional_signals())
        return self._corrected(concatenate_steps(chunks)) if chunks else None

    def _advance_segment(self, until: float, last: bool, chunks: list[Steps]) -> bool:
        """Process uninterrupted samples and append their steps to ``chunks``; True if a gap ended the segment."""
        accelerometer, gyroscope = self._sensors.values()
        end, gap_follows = self._end_of_segment(until)
        if self._segment is None:
            self._start_segment(end, chunks)
        segment = self._segment
        if segment is not None:
            while (count := segment.available(end)) >= segment.block:
                chunks += segment.advance(segment.block, accelerometer, gyroscope)
            if gap_follows or last:
                chunks += segment.advance(count, accelerometer, gyroscope, last=True)
                self._end, self._bias = segment.end, segment.attitude.bias
                self._segment, self._provisional = None, None
        if gap_follows:
            accelerometer.drop_until(end)
        return gap_follows

    def _end_of_segment(self, until: float) -> tuple[float, bool]:
        """Time up to which the accelerometer has no gap [s], and True if a gap follows before ``until``."""
        time = self._sensors["accelerometer"].time
        gaps = np.flatnonzero(np.diff(time) > REST.longest_bridged)
        if len(gaps) and time[gaps[0]] <= until:
            return float(time[gaps[0]]), True
        return until, False

    def _start_segment(self, end: float, chunks: list[Steps]) -> None:
        """Start a segment if there is a second of samples up to ``end`` [s]; append the gap before it to ``chunks``."""
        accelerometer, gyroscope = self._sensors.values()
        time = accelerometer.time
        if not len(time) or end - time[0] < SHORTEST_WALK:
            return
        origin = gyroscope.segment_start(float(time[0]))
        period = float(np.median(np.diff(time[time <= time[0] + SHORTEST_WALK])))
        if not np.isnan(self._end):
            chunks.append(gap(self._end, origin))
        period = max(STEP_STREAM.fastest, period)
        self._segment = SegmentStream(origin, period, self.walker, self._bias, self.listener)

    def _corrected(self, steps: Steps | None) -> Steps | None:
        """The steps corrected by the walker's profile; ``unknown`` names gravity if the recorder removed it."""
        if steps is not None and self._gravity.used:
            steps = replace(steps, unknown=(NO_GRAVITY, *steps.unknown))
        profile = self.walker.profile
        return profile.corrected(steps) if profile is not None and steps is not None else steps


def _ingest(accelerometer: SensorStream, gyroscope: SensorStream) -> None:
    """Validate the queued samples of both sensors."""
    accelerometer.ingest(gyroscope.offset)
    gyroscope.ingest(accelerometer.offset)
    if gyroscope.last > accelerometer.last + 2 * SENSOR_VALIDATION.longest_packet:  # it runs alone
        gyroscope.drop_until(gyroscope.last - SENSOR_VALIDATION.longest_packet)


@dataclass(frozen=True)
class StreamSettings:
    """Constants of the live steps, chosen by hand.

    block: duration of the samples that are processed together [s].
    context: number of certain landings on which the duration of the next step depends.
    usual: number of the last steps whose median duration is the usual one; changed: relative change of it that counts.
    margin: time before the first step that its features use [s].
    standing: least time of standing that is reported before the next step [s].
    packets: most packets that wait for processing, as after a reset of a clock.
    lagging: delay of one sensor behind the other after which the other is processed alone [s].
    fastest: shortest interval between samples [s]: walking has no higher frequencies.
    """

    block: float = 0.5
    context: int = 4
    usual: int = 40
    changed: float = 0.08
    margin: float = 3.0
    standing: float = 1.0
    packets: int = 24
    lagging: float = 0.2
    fastest: float = 0.005


STEP_STREAM = StreamSettings()
EMPTY_RECORDING = Recording("live", 0.0, None)


class SegmentStream:
    """The steps of an uninterrupted part of the samples.

    origin: time of sample 0 [s]; period: between samples [s]; bias: ``(3,)`` start value of the gyroscope's bias
    [rad/s]; end: of the certain steps [s]; listener: called with the gait signals of each chunk of certain steps.
    """

    def __init__(
        self,
        origin: float,
        period: float,
        walker: Walker,
        bias: Array,
        listener: Callable[[GaitSignals], None] | None = None,
    ):
        self.walker, self.listener = walker, listener
        self.attitude = AttitudeStream(period, bias)
        self.detector = StepDetector(period, origin)
        self.direction = HeadingStream(origin, period)
        self.end = origin
        self.count = 0  # of samples so far
        self.landed = np.empty((0, 2))  # times and amplitudes of the last certain landings
        self.reported = 0  # number of these landings whose steps were returned
        self.durations = np.empty(0)  # of the last steps [s]
        self._provisional: Steps | None = None
        stride = decimation(period)
        self.block = max(1, round(STEP_STREAM.block / period / stride)) * stride

    @property
    def origin(self) -> float:
        """Time of sample 0. [s]"""
        return self.direction.origin

    @property
    def period(self) -> float:
        """Interval between samples. [s]"""
        return self.direction.period

    def next_times(self, count: int) -> Array:
        """Times ``(count,)`` of the next samples. [s]"""
        return self.origin + self.period * np.arange(self.count, self.count + count, dtype=float)

    def next_time(self, number: int) -> float:
        """Time of the sample that is so many after the last. [s]"""
        return self.origin + self.period * (self.count + number - 1)

    def available(self, until: float) -> int:
        """Number of further samples up to a time [s]."""
        return int((until - self.origin) / self.period + 1e-6) + 1 - self.count

    def advance(
        self, count: int, accelerometer: SensorStream, gyroscope: SensorStream, last: bool = False
    ) -> list[Steps]:
        """Process the next ``count`` samples; returns the steps that became certain, none or one chunk.

        last: True if no more samples follow.
        """
        if count:
            time = self.next_times(count)
            acceleration = accelerometer.at(time)
            quaternion, rate = self.attitude.update(acceleration, gyroscope.sampled(time))
            self._add_landings(*self.detector.update(acceleration))
            self.direction.update(quaternion, acceleration, rate)
            self.count += count
        if last:
            self._add_landings(*self.detector.finish())
            self.direction.finish()
        return self._certain_steps(last)

    def provisional(self) -> Steps | None:
        """The steps after the certain ones, up to the last sample; None if there are no samples after them."""
        if self._provisional is None and self.now > self.end:
            self._provisional = self._steps()
        return self._provisional

    @property
    def now(self) -> float:
        """Time of the last sample. [s]"""
        return self.origin + self.period * (self.count - 1)

    @property
    def _begun(self) -> float:
        """Time until which the walk is certain from its first samples on: no step lands earlier. [s]"""
        return self.origin + self.period

    def _certain_steps(self, last: bool) -> list[Steps]:
        self._provisional = None
        until = self.now if last else self.direction.final_until
        count = int(np.searchsorted(self.landed[self.reported :, 0], until, side="right"))
        end = self.now if last else self._certain_until(until, count)
        begins = self.end == self.origin and self.now > self.origin
        if begins and not last and end <= self.origin:  # the walk begins at once: all else is provisional
            end = self._begun
        if self.now <= self.end or not (begins or count or last or end > self.end + STEP_STREAM.standing):
            return []
        first, self._provisional = self._split(self._steps(), count, end)
        if self.listener is not None:
            self.listener(self._signals_of(first))
        self._commit(count, end, first)
        return [first]

    def _add_landings(self, time: Array, amplitude: Array) -> None:
        landings = np.stack([time, amplitude], axis=1)[time > self._begun]
        self.landed = np.concatenate([self.landed, landings])

    def _certain_until(self, until: float, count: int) -> float:
        """End of the certain time: the last landing, or, while standing, before any step that may still appear. [s]"""
        landed = self.landed[self.reported :, 0].tolist()
        earliest = min([until, self.detector.earliest, *landed[count:]]) - STEP.longest
        return max(landed[count - 1] if count else self.end, earliest)

    def _steps(self) -> Steps:
        """All steps after the certain ones."""
        landings = self._landings()
        first = max(0, int((self.end - STEP_STREAM.margin - self.origin) / self.period) - self.direction.first)
        return steps_of(self._signals(slice(first, None), landings), self.walker, self.end)

    def _signals(self, part: slice, landings: Landings) -> GaitSignals:
        """Gait signals of a part of the stored samples."""
        direction = Direction(self.direction.course[part], self.direction.variance[part])
        return GaitSignals(EMPTY_RECORDING, self.direction.attitude(part), landings, direction)

    def _split(self, steps: Steps, count: int, end: float) -> tuple[Steps, Steps | None]:
        """The first ``count`` steps, up to a time ``end`` [s] before the next one, and the others."""
        turned = self._heading_at(end) - self._heading_at(float(steps.time[count - 1]) if count else self.end)
        first = replace(steps, end=end, final_turn=turned, **{n: getattr(steps, n)[:count] for n in STEP_COLUMNS})
        if steps.end <= end:
            return first, None
        rest = {n: getattr(steps, n)[count:].copy() for n in STEP_COLUMNS}
        if len(steps) > count:
            rest["turn"][0] -= turned
            rest["pause_turn"][0] -= turned
        final = steps.final_turn if len(steps) > count else steps.final_turn - turned
        return first, replace(steps, start=end, final_turn=final, **rest)

    def _signals_of(self, steps: Steps) -> GaitSignals:
        """Gait signals of newly certain steps, for the listener."""
        course = self.direction
        first, after = (
            int((t - self.origin) / self.period + 1e-6) + 1 - course.first for t in (steps.start, steps.end)
        )
        amplitude = self.landed[self.reported : self.reported + len(steps), 1]
        return self._signals(slice(first, after), Landings(steps.time, steps.duration, amplitude))

    def provisional_signals(self) -> GaitSignals:
        """Gait signals of the samples after the certain steps."""
        first = int((self.end - self.origin) / self.period + 1e-6) + 1 - self.direction.first
        return self._signals(slice(first, None), self._landings())

    def _landings(self) -> Landings:
        """All landings after the certain ones."""
        provisional = np.stack(self.detector.provisional(), axis=1)
        provisional = provisional[provisional[:, 0] > self._begun]
        time, amplitude = np.concatenate([self.landed, provisional]).T
        landings, rows = Landings.at(time, amplitude, self.origin), slice(self.reported, None)
        return Landings(landings.time[rows], landings.period[rows], landings.amplitude[rows])

    def _heading_at(self, time: float) -> float:
        return float(np.interp(time, self.direction.time, self.direction.course))

    def _commit(self, count: int, end: float, steps: Steps) -> None:
        """Drop what the steps after ``end`` [s] do not depend on, and update the usual duration of a step."""
        self.end = end
        drop = max(0, self.reported + count - STEP_STREAM.context)
        self.reported += count - drop
        self.landed = self.landed[drop:]
        if count:
            self.durations = np.append(self.durations, steps.duration)[-STEP_STREAM.usual :]
            usual = float(np.median(self.durations))
            if abs(usual / self.direction.step - 1) > STEP_STREAM.changed:
                self.direction.step = usual
        self.direction.forget(end)
