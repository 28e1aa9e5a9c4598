"""Live walking direction: `walking_direction` on the samples of the last seconds."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Rotation

from pdr_graph.gait.heading import (
    GripChange,
    Spans,
    confirmed_grip_changes,
    mean_attitude,
    possible_grip_changes,
    turns_about_vertical,
    vertical_in_device,
    without_grip_changes,
)
from pdr_graph.inertial.attitude import Attitude
from pdr_graph.priors import GRIP, STEP
from pdr_graph.types import Array, Mask

FILTER_EDGE = 3  # [steps] at the end of the samples, where the filter at the step frequency is inaccurate
SERIES = ("quaternion", "acceleration", "unmeasured", "rate_integral", "up", "turned", "heading", "course", "variance")


def _context_steps() -> int:
    """Number of steps before the first sample that is not final."""
    return 2 * GRIP.steps_beside + FILTER_EDGE


@dataclass
class HeadingStream:
    """The samples of the last seconds and the walker's heading at them.

    origin: time of sample 0 [s]; period [s]; first: number of the first stored sample; step: typical duration [s].
    quaternion ``(n, 4)`` and acceleration ``(n, 3)``.
    unmeasured: ``(n,)`` number of samples so far at which the gyroscope did not run.
    rate_integral, turned: ``(n,)`` integrated rate about the vertical, and turn of the mean attitude [rad].
    up: ``(n, 3)`` vertical in the device, gait removed; heading: ``(n,)`` ignoring grip changes [rad]; both are final
        for the first ``heading_final`` samples.
    course, variance: ``(n,)`` the walker's heading [rad] and its variance [rad²], final for the first ``course_final``
        samples.
    """

    origin: float
    period: float
    first: int = 0
    step: float = STEP.usual
    heading_final: int = 0
    course_final: int = 0
    quaternion: Array = field(default_factory=lambda: np.empty((0, 4)))
    acceleration: Array = field(default_factory=lambda: np.empty((0, 3)))
    unmeasured: Array = field(default_factory=lambda: np.empty(0))
    rate_integral: Array = field(default_factory=lambda: np.empty(0))
    up: Array = field(default_factory=lambda: np.empty((0, 3)))
    turned: Array = field(default_factory=lambda: np.empty(0))
    heading: Array = field(default_factory=lambda: np.empty(0))
    course: Array = field(default_factory=lambda: np.empty(0))
    variance: Array = field(default_factory=lambda: np.empty(0))

    @property
    def time(self) -> Array:
        """Times ``(n,)`` of the stored samples. [s]"""
        return self.origin + self.period * np.arange(self.first, self.first + len(self.quaternion), dtype=float)

    @property
    def final_until(self) -> float:
        """Time of the last sample whose heading is final. [s]"""
        return self.origin + self.period * (self.first + self.course_final - 1)

    def attitude(self, part: slice) -> Attitude:
        """The attitude of a part of the stored samples; its angular rates are 0: no later stage uses them."""
        level, acceleration = Rotation.from_quat(self.quaternion[part]), self.acceleration[part]
        return Attitude(self.time[part], self.period, level, acceleration, np.zeros_like(acceleration))

    def update(self, quaternion: Array, acceleration: Array, angular_rate: Array, measured: Mask) -> None:
        """Add samples: quaternions ``(m, 4)``, accelerations and angular rates ``(m, 3)``.

        measured: ``(m,)`` True while the gyroscope runs.
        """
        self._append(quaternion, acceleration, angular_rate, measured)
        self._smooth()
        self._correct(last=False)

    def finish(self) -> None:
        """Make all headings final: no more samples follow."""
        self.heading_final = len(self.quaternion)
        self._correct(last=True)

    def forget(self, before: float) -> None:
        """Drop samples that no later step depends on; steps before the time ``before`` [s] are final."""
        final = min(self.course_final, int((before - self.origin) / self.period) - self.first)
        drop = max(0, final - round(_context_steps() * self.step / self.period))
        self.first += drop
        self.heading_final -= drop
        self.course_final -= drop
        for name in SERIES:
            setattr(self, name, getattr(self, name)[drop:])

    def _append(self, quaternion: Array, acceleration: Array, angular_rate: Array, measured: Mask) -> None:
        rate = np.sum(vertical_in_device(quaternion.T) * angular_rate, axis=1) * measured * self.period
        unmeasured, turned = (self.unmeasured[-1], self.rate_integral[-1]) if len(self.unmeasured) else (0.0, -rate[0])
        before = self.quaternion[-1] if len(self.quaternion) else quaternion[0]
        same = np.sum(quaternion * np.concatenate([before[None], quaternion[:-1]]), axis=1) >= 0
        quaternion = quaternion * np.cumprod(np.where(same, 1.0, -1.0))[:, None]
        self.quaternion = np.concatenate([self.quaternion, quaternion])
        self.acceleration = np.concatenate([self.acceleration, acceleration])
        self.unmeasured = np.append(self.unmeasured, unmeasured + np.cumsum(~measured, dtype=float))
        self.rate_integral = np.append(self.rate_integral, turned + np.cumsum(rate))

    def _smooth(self) -> None:
        """Update heading and vertical, gait removed, as `walking_direction` does."""
        samples = max(1, round(self.step / self.period))
        last = max(0, self.heading_final - 1)
        begin = max(0, last - 2 * samples)
        steady = mean_attitude(self.quaternion[begin:], 2 * samples)[:, last - begin :]
        up = vertical_in_device(steady)
        turn = turns_about_vertical(steady) * (np.diff(self.unmeasured[last:]) == 0)
        start = self.turned[last] if len(self.turned) else 0.0
        turned = start + np.concatenate([[0.0], np.cumsum(turn)])
        of_step, of_stride = (uniform_filter1d(self.rate_integral[begin:], n * samples, mode="nearest") for n in (1, 2))
        new = self.heading_final - last  # 0 or 1: the last final sample stays
        keep = self.heading_final
        self.up = np.concatenate([self.up[:keep], up[new:]])
        self.turned = np.concatenate([self.turned[:keep], turned[new:]])
        self.heading = np.concatenate([self.heading[:keep], (turned + (of_step - of_stride)[last - begin :])[new:]])
        self.heading_final = max(self.heading_final, len(self.quaternion) - samples)

    def _correct(self, last: bool) -> None:
        """Update the walker's heading; it is final up to the first undecided grip change."""
        begin, end = max(0, self.course_final - 1), max(1, self.heading_final)
        tilted, fast = self._possible_changes(begin, end)
        until, decided = self._decided_changes(tilted, fast, last)
        found = self._confirmed_changes(*decided)
        found += [GripChange(*span, 0.0) for span in tilted if span[0] >= until]
        turn, variances = without_grip_changes(self.heading, found)
        course, variance = (self.course[begin], self.variance[begin]) if len(self.course) else (self.heading[0], 0.0)
        new = self.course_final - begin
        self.course = np.append(self.course[: self.course_final], (course + _cumulative(turn[begin:]))[new:])
        self.variance = np.append(self.variance[: self.course_final], (variance + _cumulative(variances[begin:]))[new:])
        self.course_final = max(self.course_final, until)

    def _possible_changes(self, begin: int, end: int) -> tuple[Spans, Spans]:
        """Spans of changed tilt and of fast turns among the samples [begin, end)."""
        if end - begin < 3:
            return [], []
        tilted, fast = possible_grip_changes(self.up[begin:end], self.heading[begin:end], self.step, self.period)
        return _later(tilted, begin), _later(fast, begin)

    def _decided_changes(self, tilted: Spans, fast: Spans, last: bool) -> tuple[int, tuple[Spans, Spans]]:
        """The first sample at which grip changes are undecided, and the spans before it."""
        now = len(self.quaternion)
        if last:
            return now, (tilted, fast)
        step = self.step / self.period
        until = self.heading_final - round(GRIP.within / self.period) - round(step) - 2
        spans = [(*span, 2 * GRIP.steps_beside + FILTER_EDGE) for span in tilted]
        spans += [(*span, GRIP.steps_beside + FILTER_EDGE) for span in fast]
        for begin, end, steps in sorted(spans, reverse=True):
            undecided = end >= self.heading_final - 2 or end + steps * step > now
            if undecided or end >= until:
                until = min(until, begin)
        until = max(until, now - round(GRIP.longest_undecided / self.period), self.course_final)
        return until, ([s for s in tilted if s[1] < until], [s for s in fast if s[1] < until])

    def _confirmed_changes(self, tilted: Spans, fast: Spans) -> list[GripChange]:
        """The grip changes among decided spans."""
        if not tilted and not fast:
            return []
        begin = max(0, min(span[0] for span in tilted + fast) - round(_context_steps() * self.step / self.period))
        attitude, heading = self.attitude(slice(begin, None)), self.heading[begin:]
        found = confirmed_grip_changes(attitude, heading, self.step, _later(tilted, -begin), _later(fast, -begin))
        return [GripChange(change.first + begin, change.last + begin, change.turn) for change in found]


def _later(spans: Spans, samples: int) -> Spans:
    return [(first + samples, last + samples) for first, last in spans]


def _cumulative(values: Array) -> Array:
    """Cumulative sums ``(n,)`` from 0, without the first value."""
    return np.concatenate([[0.0], np.cumsum(values[1:])])
