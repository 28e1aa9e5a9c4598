"""Live steps: samples as they arrive become the steps that `detect_steps` finds in the whole recording."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np

from pdr_graph.gait.signals import GaitSignals
from pdr_graph.gait.step_chunks import concatenate_steps, gap
from pdr_graph.gait.step_segment import STEP_STREAM, SegmentCheckpoint, SegmentStream
from pdr_graph.gait.walker import Walker
from pdr_graph.inertial.attitude import NO_GRAVITY, SHORTEST_WALK
from pdr_graph.inertial.attitude_stream import SENSOR_VALIDATION, GravityRestorer, Health, SensorStream
from pdr_graph.priors import REST
from pdr_graph.types import Array, Steps


@dataclass(frozen=True)
class StepStreamCheckpoint:
    """The state of a `StepStream`.

    has_accelerometer: False while linear acceleration replaces it; end, bias: of the earlier segments.
    """

    accelerometer: SensorStream
    gyroscope: SensorStream
    gravity: GravityRestorer
    segment: SegmentCheckpoint | None
    has_accelerometer: bool
    end: float
    bias: Array


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
    def latest(self) -> float:
        """Time of the latest valid sample [s]; NaN before the first."""
        self._ingest()
        last = max(sensor.last for sensor in self._sensors.values())
        return last if np.isfinite(last) else np.nan

    @property
    def offset(self) -> float:
        """Time that is added to the samples' times since a reset of the clock. [s]"""
        return max(sensor.offset for sensor in self._sensors.values())

    @property
    def health(self) -> dict[str, Health]:
        """Statistics of each sensor's samples."""
        self._ingest()
        return {name: sensor.health for name, sensor in self._sensors.items()}

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
        self._ingest()
        return self._advance(self._usable_until(), last=False), self._provisional

    def finish(self) -> Steps | None:
        """The remaining steps: no more samples follow."""
        self._ingest()
        accelerometer, gyroscope = self._sensors.values()
        alone = gyroscope.last < accelerometer.last - REST.longest_bridged
        until = accelerometer.last if alone else min(accelerometer.last, gyroscope.last)
        return self._advance(until, last=True)

    def checkpoint(self) -> StepStreamCheckpoint:
        """The complete state; after `restore` the results are equal bit by bit."""
        self._ingest()
        return StepStreamCheckpoint(
            **deepcopy(self._sensors),
            gravity=deepcopy(self._gravity),
            segment=None if self._segment is None else self._segment.checkpoint(),
            has_accelerometer=self._has_accelerometer,
            end=self._end,
            bias=self._bias.copy(),
        )

    def restore(self, checkpoint: StepStreamCheckpoint) -> None:
        """Continue from a checkpoint of a stream with the same walker."""
        self._has_accelerometer, self._end = checkpoint.has_accelerometer, checkpoint.end
        self._bias, self._gravity = checkpoint.bias.copy(), deepcopy(checkpoint.gravity)
        self._sensors = {name: deepcopy(getattr(checkpoint, name)) for name in self._sensors}
        self._segment = self._provisional = None
        if checkpoint.segment is not None:
            direction = checkpoint.segment.direction
            self._segment = self._new_segment(direction.origin, direction.period)
            self._segment.restore(checkpoint.segment)
            self._provisional = self._corrected(self._segment.provisional())

    def _is_due(self) -> bool:
        """True if a block of samples, or many packets, wait for processing."""
        sensors = self._sensors.values()
        due = -np.inf if self._segment is None else self._segment.next_time(self._segment.block)
        newest = [sensor.newest for sensor in sensors]
        if min(newest) >= due or max(newest) >= due + STEP_STREAM.lagging:
            return True
        return max(len(sensor.arrived) for sensor in sensors) >= STEP_STREAM.packets

    def _ingest(self) -> None:
        accelerometer, gyroscope = self._sensors.values()
        accelerometer.ingest(gyroscope.offset)
        gyroscope.ingest(accelerometer.offset)
        if gyroscope.last > accelerometer.last + 2 * SENSOR_VALIDATION.longest_packet:  # it runs alone
            gyroscope.drop_until(gyroscope.last - SENSOR_VALIDATION.longest_packet)

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
        self._segment = self._new_segment(origin, max(STEP_STREAM.fastest, period))

    def _new_segment(self, origin: float, period: float) -> SegmentStream:
        return SegmentStream(origin, period, self.walker, self._bias, self.listener)

    def _corrected(self, steps: Steps | None) -> Steps | None:
        """The steps corrected by the walker's profile; ``unknown`` names gravity if the recorder removed it."""
        if steps is not None and self._gravity.used:
            steps = replace(steps, unknown=(NO_GRAVITY, *steps.unknown))
        profile = self.walker.profile
        return profile.corrected(steps) if profile is not None and steps is not None else steps
