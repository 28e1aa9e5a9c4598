"""Steps of an uninterrupted stretch of samples, as they come in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from pdr_graph.gait.detection import StepDetector
from pdr_graph.gait.direction import Direction
from pdr_graph.gait.gait import Gait
from pdr_graph.gait.landings import LONGEST_STEP, Landings
from pdr_graph.gait.live_direction import LiveDirection
from pdr_graph.gait.pdr import UNSEEN_TURN, steps_of
from pdr_graph.gait.rhythm import every
from pdr_graph.gait.walker import Walker
from pdr_graph.inertial.attitude import NO_GYROSCOPE
from pdr_graph.inertial.online import OnlineAttitude
from pdr_graph.inertial.stream import SensorStream
from pdr_graph.types import Array, Recording, Steps

BLOCK = 0.5  # [s] of samples that are looked at together
CONTEXT = 4  # certain landings that the duration of the next depends on
USUAL = 40  # of the last steps' durations are the usual one's
CHANGED = 0.08  # of it, by which it must differ to count
MARGIN = 3.0  # [s] before the first step that its features see
STANDING = 1.0  # [s] of it that are worth a chunk
NOBODY = Recording("live", 0.0, None)


class LivePart:
    """From sample 0 at ``origin`` [s], every ``period`` [s]. end: of what is certain [s].

    listener: is handed the samples of each chunk of certain steps, and its landings.
    """

    kept = ("attitude", "detector", "direction", "end", "count", "landed", "rows", "durations")

    def __init__(
        self, origin: float, period: float, walker: Walker, bias: Array, listener: Callable[[Gait], None] | None = None
    ):
        self.walker, self.listener = walker, listener
        self.attitude = OnlineAttitude(period, bias)
        self.detector = StepDetector(period, origin)
        self.direction = LiveDirection(origin, period)
        self.end = origin
        self.count = 0  # of samples taken in
        self.landed = np.empty((0, 2))  # times and amplitudes of the last that are certain, CONTEXT of them rows
        self.rows = 0  # of landed, that were returned
        self.durations = np.empty(0)
        self._open: Steps | None = None
        stride = every(period)
        self.block = max(1, round(BLOCK / period / stride)) * stride

    @property
    def origin(self) -> float:
        """[s]"""
        return self.direction.origin

    @property
    def period(self) -> float:
        """[s]"""
        return self.direction.period

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
            acceleration, seen = accelerometer.at(time), gyroscope.seen(time)
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
        gait = Gait(NOBODY, attitude, landings, Direction(course.course[part], course.doubt[part]))
        steps = steps_of(gait, self.walker, self.end)
        if course.blind[-1] == course.blind[first]:
            return steps
        blind = np.diff(np.interp(np.append(self.end, steps.time), attitude.time, course.blind[part])) > 0
        if not blind.any():
            return steps
        return replace(steps, sigma_turn=np.where(blind, UNSEEN_TURN, steps.sigma_turn), unknown=(NO_GYROSCOPE,))

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

    def _felt(self, steps: Steps) -> Gait:
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
        return Gait(NOBODY, attitude, landings, Direction(course.course[part], course.doubt[part]))

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
