"""Steps from samples as they arrive: the front end of the live navigator, `detect_steps` step by step."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np

from pdr_graph import storage
from pdr_graph.gait.heading import Direction
from pdr_graph.gait.heading_stream import HeadingStream
from pdr_graph.gait.signals import GaitSignals, concatenate_steps, gap
from pdr_graph.gait.step_detection import LONGEST_STEP, Landings, StepDetector, decimation
from pdr_graph.gait.steps import SIGMA_UNMEASURED_TURN, steps_of
from pdr_graph.gait.walker import Walker
from pdr_graph.inertial.attitude import LONGEST_BRIDGED, NO_GRAVITY, NO_GYROSCOPE, SHORTEST_WALK
from pdr_graph.inertial.attitude_stream import AttitudeCheckpoint, AttitudeStream, GravityRestorer, Health, SensorStream
from pdr_graph.types import Array, Recording, Steps

BLOCK = 0.5  # [s] of samples that are looked at together
CONTEXT = 4  # certain landings that the duration of the next depends on
USUAL = 40  # of the last steps' durations are the usual one's
CHANGED = 0.08  # of it, by which it must differ to count
MARGIN = 3.0  # [s] before the first step that its features see
STANDING = 1.0  # [s] of it that are worth a chunk
EMPTY_RECORDING = Recording("live", 0.0, None)


@dataclass(frozen=True)
class SegmentCheckpoint:
    """What a `SegmentStream` knows."""

    attitude: AttitudeCheckpoint
    detector: StepDetector
    direction: HeadingStream
    end: float
    count: int
    landed: Array
    rows: int
    durations: Array


class SegmentStream:
    """From sample 0 at ``origin`` [s], every ``period`` [s]. end: of what is certain [s].

    listener: is handed the samples of each chunk of certain steps, and its landings.
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
        self.count = 0  # of samples taken in
        self.landed = np.empty((0, 2))  # times and amplitudes of the last that are certain, CONTEXT of them rows
        self.rows = 0  # of landed, that were returned
        self.durations = np.empty(0)
        self._open: Steps | None = None
        stride = decimation(period)
        self.block = max(1, round(BLOCK / period / stride)) * stride

    @property
    def origin(self) -> float:
        """[s]"""
        return self.direction.origin

    @property
    def period(self) -> float:
        """[s]"""
        return self.direction.period

    def checkpoint(self) -> SegmentCheckpoint:
        """All that it knows."""
        return SegmentCheckpoint(
            attitude=storage.checkpoint(self.attitude, AttitudeCheckpoint),
            detector=deepcopy(self.detector),
            direction=deepcopy(self.direction),
            end=self.end,
            count=self.count,
            landed=self.landed.copy(),
            rows=self.rows,
            durations=self.durations.copy(),
        )

    def restore(self, checkpoint: SegmentCheckpoint) -> None:
        """Go on from a checkpoint, of the same walker."""
        storage.restore(self.attitude, checkpoint.attitude)
        self.detector, self.direction = deepcopy(checkpoint.detector), deepcopy(checkpoint.direction)
        self.end, self.count, self.rows = checkpoint.end, checkpoint.count, checkpoint.rows
        self.landed, self.durations = checkpoint.landed.copy(), checkpoint.durations.copy()

    def time(self, count: int) -> Array:
        """Of the next samples. [s]"""
        return self.origin + self.period * np.arange(self.count, self.count + count, dtype=float)

    def available(self, until: float) -> int:
        """Samples up to a time [s] that were not taken in."""
        return int((until - self.origin) / self.period + 1e-6) + 1 - self.count

    def take(self, count: int, accelerometer: SensorStream, gyroscope: SensorStream, last: bool = False) -> list[Steps]:
        """The next samples; what became certain with them, none or one. last: True if no more follow."""
        if count:
            time = self.time(count)
            acceleration, seen = accelerometer.at(time), gyroscope.covers(time)
            rate = gyroscope.at(time) if seen.any() else np.zeros((count, 3))
            quaternion, rate = self.attitude.update(acceleration, rate, seen)
            self._land(*self.detector.update(acceleration))
            self.direction.update(quaternion, acceleration, rate, seen)
            self.count += count
        if last:
            self._land(*self.detector.finish())
            self.direction.finish()
        return self._certain(last)

    def tail(self) -> Steps | None:
        """The steps that are not certain yet, to the last sample; None where that is the end of the certain ones."""
        if self._open is None and self.now > self.end:
            self._open = self._steps()
        return self._open

    @property
    def now(self) -> float:
        """Time of the last sample. [s]"""
        return self.origin + self.period * (self.count - 1)

    def _certain(self, last: bool) -> list[Steps]:
        self._open = None
        until = self.now if last else self.direction.certain_until
        count = int(np.searchsorted(self.landed[self.rows :, 0], until, side="right"))
        end = self.now if last else self._sure(until, count)
        if self.now <= self.end or not (count or last or end > self.end + STANDING):
            return []
        first, self._open = self._split(self._steps(), count, end)
        if self.listener is not None:
            self.listener(self._felt(first))
        self._commit(count, end, first)
        return [first]

    def _land(self, time: Array, amplitude: Array) -> None:
        if len(time):
            self.landed = np.concatenate([self.landed, np.stack([time, amplitude], axis=1)])

    def _sure(self, until: float, count: int) -> float:
        """The end of the certain: the last landing, or, while standing, before any step that may yet appear. [s]"""
        landed = self.landed[self.rows :, 0].tolist()
        earliest = min([until, self.detector.earliest, *landed[count:]]) - LONGEST_STEP
        return max(landed[count - 1] if count else self.end, earliest)

    def _steps(self) -> Steps:
        """All rows from the end of the certain ones."""
        found = np.concatenate([self.landed, np.stack(self.detector.provisional(), axis=1)])
        landings = Landings.at(found[:, 0], found[:, 1], self.origin)
        rows = slice(self.rows, None)
        landings = Landings(landings.time[rows], landings.period[rows], landings.amplitude[rows])
        first = max(0, int((self.end - MARGIN - self.origin) / self.period) - self.direction.first)
        part, course = slice(first, None), self.direction
        attitude = course.attitude(part)
        gait = GaitSignals(EMPTY_RECORDING, attitude, landings, Direction(course.course[part], course.doubt[part]))
        steps = steps_of(gait, self.walker, self.end)
        if course.blind[-1] == course.blind[first]:
            return steps
        blind = np.diff(np.interp(np.append(self.end, steps.time), attitude.time, course.blind[part])) > 0
        if not blind.any():
            return steps
        return replace(
            steps, sigma_turn=np.where(blind, SIGMA_UNMEASURED_TURN, steps.sigma_turn), unknown=(NO_GYROSCOPE,)
        )

    def _split(self, steps: Steps, count: int, end: float) -> tuple[Steps, Steps | None]:
        """The first rows, up to a time ``end`` [s] before the next, and the others."""
        turned = self._course(end) - self._course(float(steps.time[count - 1]) if count else self.end)
        names = ("time", "duration", "length", "turn", "pause_turn", "sigma_length", "sigma_turn")
        first = replace(steps, end=end, final_turn=turned, **{n: getattr(steps, n)[:count] for n in names})
        if steps.end <= end:
            return first, None
        rest = {n: getattr(steps, n)[count:].copy() for n in names}
        if len(steps) > count:
            rest["turn"][0] -= turned
            rest["pause_turn"][0] -= turned
        final = steps.final_turn if len(steps) > count else steps.final_turn - turned
        return first, replace(steps, start=end, final_turn=final, **rest)

    def _felt(self, steps: Steps) -> GaitSignals:
        """The samples after the certain ones, to the end of the next certain steps."""
        course = self.direction
        first, after = (
            int((t - self.origin) / self.period + 1e-6) + 1 - course.first for t in (steps.start, steps.end)
        )
        part = slice(first, after)
        attitude = course.attitude(part)
        if np.any(np.diff(course.blind[max(0, first - 1) : after]) > 0):
            attitude = replace(attitude, unknown=(NO_GYROSCOPE,))
        amplitude = self.landed[self.rows : self.rows + len(steps), 1]
        landings = Landings(steps.time, steps.duration, amplitude)
        return GaitSignals(EMPTY_RECORDING, attitude, landings, Direction(course.course[part], course.doubt[part]))

    def _course(self, time: float) -> float:
        return float(np.interp(time, self.direction.time, self.direction.course))

    def _commit(self, count: int, end: float, steps: Steps) -> None:
        self.end = end
        keep = max(0, self.rows + count - CONTEXT)
        self.rows += count - keep
        self.landed = self.landed[keep:]
        if count:
            self.durations = np.append(self.durations, steps.duration)[-USUAL:]
            usual = float(np.median(self.durations))
            if abs(usual / self.direction.step - 1) > CHANGED:
                self.direction.step = usual
        self.direction.forget(end)


MOST_PACKETS = 24  # that wait to be looked at, as those of a clock that was put back
LAGGING = 0.2  # [s] of one sensor behind the other
FASTEST = 0.005  # [s] between samples; more often tells nothing more of a walk


@dataclass(frozen=True)
class StepStreamCheckpoint:
    """What a `StepStream` knows. real: there is an accelerometer; end, bias: of the parts before the present one."""

    accelerometer: SensorStream
    gyroscope: SensorStream
    gravity: GravityRestorer
    part: SegmentCheckpoint | None
    real: bool
    end: float
    bias: Array


class StepStream:
    """Steps as the samples come in.

    A step is certain about five seconds after it, a few later where the phone turned and it must be known whether its
    walker did. The chunks of certain steps follow one another: together they are the walk.

    listener: is handed the samples of each chunk as they become certain, with attitude, heading and landings.
    """

    def __init__(self, walker: Walker | None = None, listener: Callable[[GaitSignals], None] | None = None):
        self.walker, self.listener = walker or Walker(), listener
        self._sensors = {name: SensorStream() for name in ("accelerometer", "gyroscope")}
        self._real, self._gravity = (
            False,
            GravityRestorer(),
        )  # whether there is an accelerometer, and what stands in for it
        self._part: SegmentStream | None = None
        self._end, self._bias = np.nan, np.zeros(3)  # of the parts before
        self._tail: Steps | None = None  # as the profile has it

    @property
    def latest(self) -> float:
        """Time of the latest usable sample [s]; NaN before any."""
        self._ingest()
        last = max(sensor.last for sensor in self._sensors.values())
        return last if np.isfinite(last) else np.nan

    @property
    def offset(self) -> float:
        """By how much its times are later now than those given, since a clock was put back. [s]"""
        return max(sensor.offset for sensor in self._sensors.values())

    @property
    def health(self) -> dict[str, Health]:
        """How each sensor is by now."""
        self._ingest()
        return {name: sensor.health for name, sensor in self._sensors.items()}

    def push(self, sensor: str, time: Array, values: Array) -> None:
        """Samples of a sensor, named as of ``Recording.signals``, at times ``(n,)`` [s]; as of `Signal`.

        Others than accelerometer and gyroscope tell nothing of steps. ``linear_acceleration`` stands in for an
        accelerometer until there is one.
        """
        self._real |= sensor == "accelerometer"
        if sensor == "linear_acceleration" and not self._real:
            sensor, values = "accelerometer", self._gravity.restored(np.asarray(values, dtype=float))
        if sensor in self._sensors:
            self._sensors[sensor].push(time, values)

    def advance(self) -> tuple[Steps | None, Steps | None]:
        """The steps that became certain since the last call, and those that may follow up to the latest sample.

        None if there are none, and where there is nothing between the certain and the latest.
        """
        if not self._enough():
            return None, self._tail
        self._ingest()
        return self._advance(self._until(), last=False), self._tail

    def finish(self) -> Steps | None:
        """The rest, when no more samples come."""
        self._ingest()
        accelerometer, gyroscope = self._sensors.values()
        alone = gyroscope.last < accelerometer.last - LONGEST_BRIDGED
        until = accelerometer.last if alone else min(accelerometer.last, gyroscope.last)
        return self._advance(until, last=True)

    def checkpoint(self) -> StepStreamCheckpoint:
        """All that it knows; what follows a `restore` is the same to the bit."""
        self._ingest()
        return StepStreamCheckpoint(
            **deepcopy(self._sensors),
            gravity=deepcopy(self._gravity),
            part=None if self._part is None else self._part.checkpoint(),
            real=self._real,
            end=self._end,
            bias=self._bias.copy(),
        )

    def restore(self, checkpoint: StepStreamCheckpoint) -> None:
        """Go on from a checkpoint, of the same walker."""
        self._real, self._end, self._bias = checkpoint.real, checkpoint.end, checkpoint.bias.copy()
        self._gravity = deepcopy(checkpoint.gravity)
        self._sensors = {name: deepcopy(getattr(checkpoint, name)) for name in self._sensors}
        self._part = self._tail = None
        if checkpoint.part is not None:
            direction = checkpoint.part.direction
            self._part = self._new_part(direction.origin, direction.period)
            self._part.restore(checkpoint.part)
            self._tail = self._corrected(self._part.tail())

    def _enough(self) -> bool:
        """Whether samples came that are worth a look."""
        sensors = self._sensors.values()
        due = -np.inf if self._part is None else float(self._part.time(self._part.block)[-1])
        newest = [sensor.newest for sensor in sensors]
        if min(newest) >= due or max(newest) >= due + LAGGING:
            return True
        return max(len(sensor.arrived) for sensor in sensors) >= MOST_PACKETS

    def _ingest(self) -> None:
        accelerometer, gyroscope = self._sensors.values()
        accelerometer.ingest(gyroscope.offset)
        gyroscope.ingest(accelerometer.offset)

    def _until(self) -> float:
        """Up to where samples can be used: of both sensors, unless the gyroscope stopped. [s]"""
        accelerometer, gyroscope = self._sensors.values()
        patience = LONGEST_BRIDGED + max(accelerometer.longest_packet, gyroscope.longest_packet)
        if max(gyroscope.last, accelerometer.began) < accelerometer.last - patience:
            return accelerometer.last
        return min(accelerometer.last, gyroscope.last)

    def _advance(self, until: float, last: bool) -> Steps | None:
        """Take in what can be used; what became certain."""
        chunks: list[Steps] = []
        while self._stretch(until, last, chunks):
            pass
        if self._part is not None:
            for sensor in self._sensors.values():
                sensor.forget(float(self._part.time(1)[0]))
            self._tail = self._corrected(self._part.tail())
        return self._corrected(concatenate_steps(chunks)) if chunks else None

    def _stretch(self, until: float, last: bool, chunks: list[Steps]) -> bool:
        """Go on with the uninterrupted samples; True if a gap ended them, and others follow."""
        accelerometer, gyroscope = self._sensors.values()
        end, gap_follows = self._end_of_stretch(until)
        if self._part is None:
            self._begin(end, chunks)
        part = self._part
        if part is not None:
            while (count := part.available(end)) >= part.block:
                chunks += part.take(part.block, accelerometer, gyroscope)
            if gap_follows or last:
                chunks += part.take(count, accelerometer, gyroscope, last=True)
                self._end, self._bias, self._part, self._tail = part.end, part.attitude.bias, None, None
        if gap_follows:
            accelerometer.cut(end)
        return gap_follows

    def _end_of_stretch(self, until: float) -> tuple[float, bool]:
        """Up to where the accelerometer ran without a gap [s], and whether one follows before ``until``."""
        time = self._sensors["accelerometer"].time
        gaps = np.flatnonzero(np.diff(time) > LONGEST_BRIDGED)
        if len(gaps) and time[gaps[0]] <= until:
            return float(time[gaps[0]]), True
        return until, False

    def _begin(self, end: float, chunks: list[Steps]) -> None:
        """A new part, once there is enough of it."""
        accelerometer, gyroscope = self._sensors.values()
        time = accelerometer.time
        if not len(time) or end - time[0] < SHORTEST_WALK:
            return
        origin = gyroscope.segment_start(float(time[0]))
        period = float(np.median(np.diff(time[time <= time[0] + SHORTEST_WALK])))
        if not np.isnan(self._end):
            chunks.append(gap(self._end, origin))
        self._part = self._new_part(origin, max(FASTEST, period))

    def _new_part(self, origin: float, period: float) -> SegmentStream:
        return SegmentStream(origin, period, self.walker, self._bias, self.listener)

    def _corrected(self, steps: Steps | None) -> Steps | None:
        """As the walker's profile has it, and what the recorder kept back."""
        if steps is not None and self._gravity.used:
            steps = replace(steps, unknown=(NO_GRAVITY, *steps.unknown))
        profile = self.walker.profile
        return profile.corrected(steps) if profile is not None and steps is not None else steps
