"""Steps while a person walks: the front end of the live navigator, `detect_steps` as the samples come in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from pdr_graph.gait.gait import Gait
from pdr_graph.gait.gaps import gap, joined_chunks
from pdr_graph.gait.live_part import LivePart
from pdr_graph.gait.walker import Walker
from pdr_graph.inertial.attitude import NO_GRAVITY
from pdr_graph.inertial.online import Gravity
from pdr_graph.inertial.samples import LONGEST_BRIDGED, SHORTEST_WALK
from pdr_graph.inertial.stream import Health, SensorStream
from pdr_graph.state import restore, state_of
from pdr_graph.types import Array, Steps

MOST_PACKETS = 24  # that wait to be looked at, as those of a clock that was put back
LAGGING = 0.2  # [s] of one sensor behind the other
FASTEST = 0.005  # [s] between samples; more often tells nothing more of a walk


class LiveGait:
    """Steps as the samples come in.

    A step is certain about five seconds after it, a few later where the phone turned and it must be known whether its
    walker did. The chunks of certain steps follow one another: together they are the walk.

    listener: is handed the samples of each chunk as they become certain, with attitude, heading and landings.
    """

    def __init__(self, walker: Walker | None = None, listener: Callable[[Gait], None] | None = None):
        self.walker, self.listener = walker or Walker(), listener
        self._sensors = {name: SensorStream() for name in ("accelerometer", "gyroscope")}
        self._real, self._gravity = False, Gravity()  # whether there is an accelerometer, and what stands in for it
        self._part: LivePart | None = None
        self._end, self._bias = np.nan, np.zeros(3)  # of the parts before
        self._tail: Steps | None = None  # as the profile has it

    @property
    def latest(self) -> float:
        """Time of the latest usable sample [s]; NaN before any."""
        self._take_in()
        last = max(sensor.last for sensor in self._sensors.values())
        return last if np.isfinite(last) else np.nan

    @property
    def offset(self) -> float:
        """By how much its times are later now than those given, since a clock was put back. [s]"""
        return max(sensor.offset for sensor in self._sensors.values())

    @property
    def health(self) -> dict[str, Health]:
        """How each sensor is by now."""
        self._take_in()
        return {name: sensor.health for name, sensor in self._sensors.items()}

    def push(self, sensor: str, time: Array, values: Array) -> None:
        """Samples of a sensor, named as of ``Recording.signals``, at times ``(n,)`` [s]; as of `Signal`.

        Others than accelerometer and gyroscope tell nothing of steps. ``linear_acceleration`` stands in for an
        accelerometer until there is one.
        """
        self._real |= sensor == "accelerometer"
        if sensor == "linear_acceleration" and not self._real:
            sensor, values = "accelerometer", self._gravity.added(np.asarray(values, dtype=float))
        if sensor in self._sensors:
            self._sensors[sensor].push(time, values)

    def advance(self) -> tuple[Steps | None, Steps | None]:
        """The steps that became certain since the last call, and those that may follow up to the latest sample.

        None if there are none, and where there is nothing between the certain and the latest.
        """
        if not self._enough():
            return None, self._tail
        self._take_in()
        return self._advance(self._until(), last=False), self._tail

    def finish(self) -> Steps | None:
        """The rest, when no more samples come."""
        self._take_in()
        accelerometer, gyroscope = self._sensors.values()
        alone = gyroscope.last < accelerometer.last - LONGEST_BRIDGED
        until = accelerometer.last if alone else min(accelerometer.last, gyroscope.last)
        return self._advance(until, last=True)

    def state(self) -> dict[str, Any]:
        """All that it knows, as numbers and arrays; what follows a `restore` is the same to the bit."""
        self._take_in()
        parts = {**self._sensors, "gravity": self._gravity, "part": self._part}
        inner = {f"{n}.{k}": v for n, part in parts.items() if part is not None for k, v in state_of(part).items()}
        grid = {} if self._part is None else {"origin": self._part.origin, "period": self._part.period}
        return {"end": self._end, "bias": self._bias, "real": self._real, **grid, **inner}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a `state`, of the same walker."""
        self._end, self._bias = float(state["end"]), np.array(state["bias"], dtype=float)
        self._real = bool(state["real"])
        restore(self._gravity, state, "gravity.")
        for name, sensor in self._sensors.items():
            restore(sensor, state, f"{name}.")
            sensor.arrived.clear()
        self._part = self._tail = None
        if "period" in state:
            self._part = self._new_part(float(state["origin"]), float(state["period"]))
            restore(self._part, state, "part.")
            self._tail = self._corrected(self._part.tail())

    def _enough(self) -> bool:
        """Whether samples came that are worth a look."""
        sensors = self._sensors.values()
        due = -np.inf if self._part is None else float(self._part.time(self._part.block)[-1])
        newest = [sensor.newest for sensor in sensors]
        if min(newest) >= due or max(newest) >= due + LAGGING:
            return True
        return max(len(sensor.arrived) for sensor in sensors) >= MOST_PACKETS

    def _take_in(self) -> None:
        accelerometer, gyroscope = self._sensors.values()
        accelerometer.take_in(gyroscope.offset)
        gyroscope.take_in(accelerometer.offset)

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
        return self._corrected(joined_chunks(chunks)) if chunks else None

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
        origin = gyroscope.from_where(float(time[0]))
        period = float(np.median(np.diff(time[time <= time[0] + SHORTEST_WALK])))
        if not np.isnan(self._end):
            chunks.append(gap(self._end, origin))
        self._part = self._new_part(origin, max(FASTEST, period))

    def _new_part(self, origin: float, period: float) -> LivePart:
        return LivePart(origin, period, self.walker, self._bias, self.listener)

    def _corrected(self, steps: Steps | None) -> Steps | None:
        """As the walker's profile has it, and what the recorder kept back."""
        if steps is not None and self._gravity.needed:
            steps = replace(steps, unknown=(NO_GRAVITY, *steps.unknown))
        profile = self.walker.profile
        return profile.corrected(steps) if profile is not None and steps is not None else steps
