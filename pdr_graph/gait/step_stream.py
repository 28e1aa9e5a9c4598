"""Live steps: samples as they arrive become the steps that `detect_steps` finds in the whole recording.

A `StepStream` is a sequence of `SegmentStream`s, one for each uninterrupted part of the samples.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from pdr_graph.gait.heading import Direction, HeadingStream
from pdr_graph.gait.step_chunks import concatenate_steps, gap
from pdr_graph.gait.step_detection import Landings, StepDetector, UnrecognisedMovement, decimation
from pdr_graph.gait.steps import GaitSignals, steps_of, with_missing
from pdr_graph.gait.walker import Walker
from pdr_graph.inertial.attitude import NO_GRAVITY, SHORTEST_WALK, AttitudeStream
from pdr_graph.inertial.sensor_stream import SENSOR_VALIDATION, Health, SensorStream
from pdr_graph.inertial.units import GravityRestorer
from pdr_graph.priors import MOVEMENT, REST, STAND, STEP
from pdr_graph.types import STEP_COLUMNS, Array, Recording, Steps

MOST_HELD = 1000  # packets of the first second, if their times do not reach its end


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
    def newest(self) -> float:
        """Time of the newest sample; minus infinity before the first. [s]"""
        return max(sensor.newest for sensor in self._sensors.values())

    @property
    def accelerated(self) -> float:
        """Time of the newest sample of the accelerometer, without which no step is recognised. [s]"""
        return self._sensors["accelerometer"].newest

    @property
    def health(self) -> dict[str, Health]:
        """Statistics of each sensor's samples."""
        sensors = {
            name: replace(sensor, arrived=[*sensor.arrived], left_out=sensor.left_out.copy())
            for name, sensor in self._sensors.items()
        }  # packets are validated together when they are due, whatever is asked before
        _ingest(sensors["accelerometer"], sensors["gyroscope"])
        return {name: sensor.health for name, sensor in sensors.items()}

    @property
    def quiet(self) -> bool:
        """True if nobody can be walking: the acceleration hardly varies within the last second, or is not measured."""
        accelerometer = self._sensors["accelerometer"]
        recent = accelerometer.values[accelerometer.time > accelerometer.last - SENSOR_VALIDATION.history]
        return not len(recent) or bool(np.linalg.norm(recent, axis=1).std() < STAND.quiet)

    @property
    def stepless(self) -> float:
        """Time for which the device has moved lately while no step was recognised [s]; 0 if not for long."""
        lasting = 0.0 if self._segment is None else self._segment.movement.lasting
        return lasting if lasting >= MOVEMENT.longest else 0.0

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
        """The steps that became certain since the last call, and the provisional steps up to the latest sample.

        None if there are none.
        """
        accelerometer, gyroscope = self._sensors.values()
        due, most = -np.inf, 24  # packets, after a reset of a clock
        if self._segment is not None:
            due = self._segment.next_time(self._segment.block)
        elif (first := accelerometer.arrived or gyroscope.arrived) and not (accelerometer.samples or gyroscope.samples):
            due, most = float(first[0][0][0]) + SHORTEST_WALK, MOST_HELD  # no step is so early: how late samples come
        lagging = self.newest >= due + 0.2  # [s]: the other is processed alone
        waiting = max(len(accelerometer.arrived), len(gyroscope.arrived)) >= most
        if min(accelerometer.newest, gyroscope.newest) < due and not lagging and not waiting:
            return None, self._provisional
        _ingest(accelerometer, gyroscope)
        patience = REST.longest_bridged + max(accelerometer.longest_packet, gyroscope.longest_packet)
        stopped = max(gyroscope.last, accelerometer.start) < accelerometer.last - patience
        until = accelerometer.last if stopped else min(accelerometer.last, gyroscope.last)
        return self._advance(until, last=False), self._provisional

    def finish(self) -> Steps | None:
        """The remaining steps: no more samples follow."""
        accelerometer, gyroscope = self._sensors.values()
        _ingest(accelerometer, gyroscope, last=True)
        alone = gyroscope.last < accelerometer.last - REST.longest_bridged
        return self._advance(accelerometer.last if alone else min(accelerometer.last, gyroscope.last), last=True)

    def break_off(self) -> Steps | None:
        """The remaining steps; samples that follow are of other axes, after a gap."""
        last = self.finish()
        for sensor in self._sensors.values():
            sensor.drop_until(sensor.last)
        return last

    def _advance(self, until: float, last: bool) -> Steps | None:
        """Process the samples up to a time [s]; returns the steps that became certain."""
        accelerometer, gyroscope = self._sensors.values()
        chunks, gap_follows = list[Steps](), True
        while gap_follows:
            time = accelerometer.time
            gaps = np.flatnonzero(np.diff(time) > REST.longest_bridged)
            gap_follows = bool(len(gaps) and time[gaps[0]] <= until)
            end = float(time[gaps[0]]) if gap_follows else until
            if self._segment is None and len(time) and end - time[0] >= SHORTEST_WALK:
                origin = gyroscope.segment_start(float(time[0]))
                period = float(np.median(np.diff(time[time <= time[0] + SHORTEST_WALK])))
                period = max(0.005, period)  # [s]: walking has no higher frequencies
                if not np.isnan(self._end):
                    chunks.append(gap(self._end, origin))
                self._segment = SegmentStream(origin, period, self.walker, self._bias, self.listener)
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
        if self._segment is not None:
            for sensor in self._sensors.values():
                sensor.forget(self._segment.next_time(1))
            self._provisional = self._corrected(self._segment.provisional())
            if self.preview is not None and self._provisional is not None:
                self.preview(self._segment.provisional_signals())
        return self._corrected(concatenate_steps(chunks)) if chunks else None

    def _corrected(self, steps: Steps | None) -> Steps | None:
        """The steps corrected by the walker's profile; ``unknown`` names gravity if the recorder removed it."""
        if steps is not None and self._gravity.used:
            steps = replace(steps, unknown=(NO_GRAVITY, *steps.unknown))
        profile = self.walker.profile
        return profile.corrected(steps) if profile is not None and steps is not None else steps


def _ingest(accelerometer: SensorStream, gyroscope: SensorStream, last: bool = False) -> None:
    """Validate the queued samples of both sensors; last: none follow."""
    accelerometer.ingest(gyroscope.offset, last)
    gyroscope.ingest(accelerometer.offset, last)
    if gyroscope.last > accelerometer.last + 2 * SENSOR_VALIDATION.longest_packet:  # it runs alone
        gyroscope.drop_until(gyroscope.last - SENSOR_VALIDATION.longest_packet)


EMPTY_RECORDING = Recording("live", 0.0, None)


class SegmentStream:
    """The steps of an uninterrupted part of the samples.

    origin: time of sample 0 [s]; period: between samples [s]; bias: ``(3,)`` start value of the gyroscope's bias
    [rad/s]; end: of the certain steps [s]; listener: called with the gait signals of each chunk of certain steps.
    block: number of samples that are processed together, half a second.
    """

    def __init__(
        self,
        origin: float,
        period: float,
        walker: Walker,
        bias: Array,
        listener: Callable[[GaitSignals], None] | None = None,
    ):
        self.origin, self.period, self.walker, self.listener = origin, period, walker, listener
        self.attitude = AttitudeStream(period, bias)
        self.detector = StepDetector(period, origin)
        self.direction = HeadingStream(origin, period)
        self.movement = UnrecognisedMovement(period)
        self.end = origin
        self.count = 0  # of samples so far
        self.landed = np.empty((0, 5))  # the last certain landings, see `Bout.steps`
        self.reported = 0  # number of these landings whose steps were returned
        self.durations = np.empty(0)  # of the last steps [s]
        self._provisional: Steps | None = None
        stride = decimation(period)
        self.block = max(1, round(0.5 / period / stride)) * stride

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
            time = self.origin + self.period * np.arange(self.count, self.count + count, dtype=float)
            acceleration = accelerometer.at(time)
            quaternion, rate = self.attitude.update(acceleration, gyroscope.sampled(time))
            self._add_landings(self.detector.update(acceleration))
            self.direction.update(quaternion, acceleration, rate)
            self.count += count
        if last:
            self._add_landings(self.detector.finish())
            self.direction.finish()
        self._provisional = None

        # What is certain: up to the last landing, or, while standing, before any step that may still appear
        now, landed = self.next_time(0), self.landed[self.reported :, 0].tolist()
        until = now if last else self.direction.final_until
        count = int(np.searchsorted(landed, until, side="right"))
        earliest = min([until, self.detector.earliest, *landed[count:]]) - STEP.longest
        end = now if last else max(landed[count - 1] if count else self.end, earliest)
        begins = self.end == self.origin and now > self.origin
        if begins and not last and end <= self.origin:  # the walk begins at once: all else is provisional
            end = self._begun
        standing = end > self.end + 1.0  # [s] of standing that is reported before the next step
        if now <= self.end or not (begins or count or last or standing):
            return []

        # Split the steps there
        steps = self._steps()
        course, time = self.direction.course, self.direction.time
        before, after = np.interp([steps.time[count - 1] if count else self.end, end], time, course).tolist()
        turned = after - before
        first = replace(steps, end=end, final_turn=turned, **{n: getattr(steps, n)[:count] for n in STEP_COLUMNS})
        if steps.end > end:
            rest = {n: getattr(steps, n)[count:].copy() for n in STEP_COLUMNS}
            for name in ("turn", "pause_turn"):
                rest[name][:1] -= turned
            final = steps.final_turn if len(steps) > count else steps.final_turn - turned
            self._provisional = replace(steps, start=end, final_turn=final, **rest)
        part = slice(*(self._sample_after(moment) for moment in (first.start, first.end)))
        landings = self.landed[self.reported : self.reported + count, 1:].T
        signals = self._signals(part, Landings(first.time, first.duration, *landings))
        stepless, missed = self.movement.update(signals.attitude.acceleration, signals.walking)
        first = with_missing(replace(first, stepless=stepless), self.origin + missed)
        if self.listener is not None:
            self.listener(signals)

        # Drop what later steps do not depend on: four landings determine the duration of the next step
        self.end = end
        drop = max(0, self.reported + count - 4)
        self.reported += count - drop
        self.landed = self.landed[drop:]
        if count:
            self.durations = np.append(self.durations, first.duration)[-40:]
            usual = float(np.median(self.durations))
            if abs(usual / self.direction.step - 1) > 0.08:
                self.direction.step = usual
        self.direction.forget(end)
        return [first]

    def provisional(self) -> Steps | None:
        """The provisional steps, up to the last sample; None if there are no samples after the certain steps."""
        if self._provisional is None and self.next_time(0) > self.end:
            self._provisional = self._steps()
        return self._provisional

    def provisional_signals(self) -> GaitSignals:
        """Gait signals of the samples after the certain steps."""
        return self._signals(slice(self._sample_after(self.end), None), self._landings())

    @property
    def _begun(self) -> float:
        """Time until which the walk is certain from its first samples on: no step lands earlier. [s]"""
        return self.origin + self.period

    def _add_landings(self, found: Array) -> None:
        self.landed = np.concatenate([self.landed, found[found[:, 0] > self._begun]])

    def _steps(self) -> Steps:
        """All provisional steps; their features use up to 3 s before them."""
        first = max(0, int((self.end - 3.0 - self.origin) / self.period) - self.direction.first)
        return steps_of(self._signals(slice(first, None), self._landings()), self.walker, self.end)

    def _landings(self) -> Landings:
        """All provisional landings."""
        provisional = self.detector.provisional()
        provisional = provisional[provisional[:, 0] > self._begun]
        return Landings.at(np.concatenate([self.landed, provisional]), self.origin)[self.reported :]

    def _signals(self, part: slice, landings: Landings) -> GaitSignals:
        """Gait signals of a part of the stored samples."""
        direction = Direction(self.direction.course[part], self.direction.variance[part])
        return GaitSignals(EMPTY_RECORDING, self.direction.attitude(part), landings, direction)

    def _sample_after(self, time: float) -> int:
        """Index of the first stored sample after a time [s]."""
        return int((time - self.origin) / self.period + 1e-6) + 1 - self.direction.first
