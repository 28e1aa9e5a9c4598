"""The walking direction for samples as they arrive: `walking_direction` over the last seconds."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Rotation

from pdr_graph.gait.heading import (
    STEPS_BESIDE,
    WITHIN,
    GripChange,
    Spans,
    confirmed_grip_changes,
    possible_grip_changes,
    without_grip_changes,
)
from pdr_graph.gait.step_detection import USUAL_STEP
from pdr_graph.inertial.attitude import Attitude
from pdr_graph.types import Array, Mask

LONGEST_DOUBT = 14.0  # [s] after the begin of a turn, by which it is decided whether the phone or the walker turned
EDGE = 3  # steps at the end of the samples, where the filter at the step frequency is not accurate yet
STEPS_KEPT = 2 * STEPS_BESIDE + EDGE  # before the first sample that is not final


SERIES = ("quaternion", "acceleration", "blind", "rate_integral", "up", "turned", "heading", "course", "doubt")


@dataclass
class HeadingStream:
    """The samples of the last seconds and the walker's heading at them.

    origin: time of sample 0 [s]; period [s]; first: number of the first stored sample; step: typical duration [s].
    quaternion ``(n, 4)`` and acceleration ``(n, 3)``; blind: ``(n,)`` number of samples so far without a gyroscope.
    up: ``(n, 3)`` vertical in the device, gait removed; heading: ``(n,)`` ignoring grip changes [rad]; both are final
        for the first ``settled`` samples.
    course, doubt: ``(n,)`` the walker's heading [rad] and its variance [rad²], final for the first ``certain`` samples.
    """

    origin: float
    period: float
    first: int = 0
    step: float = USUAL_STEP
    settled: int = 0
    certain: int = 0
    quaternion: Array = field(default_factory=lambda: np.empty((0, 4)))
    acceleration: Array = field(default_factory=lambda: np.empty((0, 3)))
    blind: Array = field(default_factory=lambda: np.empty(0))
    rate_integral: Array = field(default_factory=lambda: np.empty(0))
    up: Array = field(default_factory=lambda: np.empty((0, 3)))
    turned: Array = field(default_factory=lambda: np.empty(0))
    heading: Array = field(default_factory=lambda: np.empty(0))
    course: Array = field(default_factory=lambda: np.empty(0))
    doubt: Array = field(default_factory=lambda: np.empty(0))

    @property
    def time(self) -> Array:
        """Times ``(n,)`` of the stored samples. [s]"""
        return self.origin + self.period * np.arange(self.first, self.first + len(self.quaternion), dtype=float)

    @property
    def certain_until(self) -> float:
        """Time of the last sample whose heading is final. [s]"""
        return self.origin + self.period * (self.first + self.certain - 1)

    def attitude(self, part: slice) -> Attitude:
        """The attitude of a part of the stored samples; its angular rates are 0: no later stage uses them."""
        level, acceleration = Rotation.from_quat(self.quaternion[part]), self.acceleration[part]
        return Attitude(self.time[part], self.period, level, acceleration, np.zeros_like(acceleration))

    def update(self, quaternion: Array, acceleration: Array, angular_rate: Array, seen: Mask) -> None:
        """Add samples: quaternions ``(m, 4)``, accelerations and rates ``(m, 3)``; seen: ``(m,)`` True if the rate is
        measured.
        """
        self._append(quaternion, acceleration, angular_rate, seen)
        self._smooth()
        self._correct(last=False)

    def finish(self) -> None:
        """Make all headings final: no more samples follow."""
        self.settled = len(self.quaternion)
        self._correct(last=True)

    def forget(self, before: float) -> None:
        """Drop samples that no later step depends on; steps before time `before` [s] are final."""
        sure = min(self.certain, int((before - self.origin) / self.period) - self.first)
        drop = max(0, sure - round(STEPS_KEPT * self.step / self.period))
        self.first, self.settled, self.certain = self.first + drop, self.settled - drop, self.certain - drop
        for name in SERIES:
            setattr(self, name, getattr(self, name)[drop:])

    def _append(self, quaternion: Array, acceleration: Array, angular_rate: Array, seen: Mask) -> None:
        x, y, z, w = quaternion.T
        up = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)
        rate = np.sum(up * angular_rate, axis=1) * seen * self.period
        blind, turned = (self.blind[-1], self.rate_integral[-1]) if len(self.blind) else (0.0, -rate[0])
        before = self.quaternion[-1] if len(self.quaternion) else quaternion[0]
        same = np.sum(quaternion * np.concatenate([before[None], quaternion[:-1]]), axis=1) >= 0
        quaternion = quaternion * np.cumprod(np.where(same, 1.0, -1.0))[:, None]
        self.quaternion = np.concatenate([self.quaternion, quaternion])
        self.acceleration = np.concatenate([self.acceleration, acceleration])
        self.blind = np.append(self.blind, blind + np.cumsum(~seen, dtype=float))
        self.rate_integral = np.append(self.rate_integral, turned + np.cumsum(rate))

    def _smooth(self) -> None:
        """Update heading and vertical without gait, as `walking_direction` does."""
        samples = max(1, round(self.step / self.period))
        known = max(0, self.settled - 1)
        begin = max(0, known - 2 * samples)
        steady = uniform_filter1d(self.quaternion[begin:], 2 * samples, axis=0, mode="nearest")[known - begin :]
        x, y, z, w = (steady / np.linalg.norm(steady, axis=1, keepdims=True)).T
        up = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)
        turn = _turns_about_vertical(x, y, z, w) * (np.diff(self.blind[known:]) == 0)
        start = self.turned[known] if len(self.turned) else 0.0
        turned = start + np.concatenate([[0.0], np.cumsum(turn)])
        of_step, of_stride = (uniform_filter1d(self.rate_integral[begin:], n * samples, mode="nearest") for n in (1, 2))
        new = self.settled - known  # 0 or 1: the last that was settled stays
        keep = self.settled
        self.up = np.concatenate([self.up[:keep], up[new:]])
        self.turned = np.concatenate([self.turned[:keep], turned[new:]])
        self.heading = np.concatenate([self.heading[:keep], (turned + (of_step - of_stride)[known - begin :])[new:]])
        self.settled = max(self.settled, len(self.quaternion) - samples)

    def _correct(self, last: bool) -> None:
        """Update the walker's heading; it is final up to the first undecided grip change."""
        begin, end = max(0, self.certain - 1), max(1, self.settled)
        tilted, fast = self._possible(begin, end)
        until, sure = self._known(tilted, fast, last)
        found = self._confirmed(*sure)
        found += [GripChange(*span, 0.0) for span in tilted if span[0] >= until]
        turn, doubt = without_grip_changes(self.heading, found)
        course, variance = (self.course[begin], self.doubt[begin]) if len(self.course) else (self.heading[0], 0.0)
        new = self.certain - begin
        self.course = np.append(self.course[: self.certain], (course + _added(turn[begin:]))[new:])
        self.doubt = np.append(self.doubt[: self.certain], (variance + _added(doubt[begin:]))[new:])
        self.certain = max(self.certain, until)

    def _possible(self, begin: int, end: int) -> tuple[Spans, Spans]:
        if end - begin < 3:
            return [], []
        tilted, fast = possible_grip_changes(self.up[begin:end], self.heading[begin:end], self.step, self.period)
        return _later(tilted, begin), _later(fast, begin)

    def _known(self, tilted: Spans, fast: Spans, last: bool) -> tuple[int, tuple[Spans, Spans]]:
        """The first sample whose grip changes are undecided, and the spans before it."""
        now = len(self.quaternion)
        if last:
            return now, (tilted, fast)
        step = self.step / self.period
        until = self.settled - round(WITHIN / self.period) - round(step) - 2
        spans = [(*span, 2 * STEPS_BESIDE + EDGE) for span in tilted] + [(*span, STEPS_BESIDE + EDGE) for span in fast]
        for begin, end, steps in sorted(spans, reverse=True):
            open_ = end >= self.settled - 2 or end + steps * step > now
            if open_ or end >= until:
                until = min(until, begin)
        until = max(until, now - round(LONGEST_DOUBT / self.period), self.certain)
        return until, ([s for s in tilted if s[1] < until], [s for s in fast if s[1] < until])

    def _confirmed(self, tilted: Spans, fast: Spans) -> list[GripChange]:
        if not tilted and not fast:
            return []
        begin = max(0, min(span[0] for span in tilted + fast) - round(STEPS_KEPT * self.step / self.period))
        attitude, heading = self.attitude(slice(begin, None)), self.heading[begin:]
        found = confirmed_grip_changes(attitude, heading, self.step, _later(tilted, -begin), _later(fast, -begin))
        return [GripChange(one.first + begin, one.last + begin, one.turn) for one in found]


def _turns_about_vertical(x: Array, y: Array, z: Array, w: Array) -> Array:
    """The z parts in the world ``(n - 1,)`` of the rotation vectors from each quaternion ``(n,)`` to the next. [rad]"""
    real = w[1:] * w[:-1] + x[1:] * x[:-1] + y[1:] * y[:-1] + z[1:] * z[:-1]
    i = x[1:] * w[:-1] - w[1:] * x[:-1] - y[1:] * z[:-1] + z[1:] * y[:-1]
    j = y[1:] * w[:-1] - w[1:] * y[:-1] - z[1:] * x[:-1] + x[1:] * z[:-1]
    k = z[1:] * w[:-1] - w[1:] * z[:-1] - x[1:] * y[:-1] + y[1:] * x[:-1]
    sine = np.sqrt(i * i + j * j + k * k)
    return k * np.where(sine > 1e-12, 2 * np.arctan2(sine, real) / np.maximum(sine, 1e-12), 2.0)


def _later(spans: Spans, samples: int) -> Spans:
    return [(first + samples, last + samples) for first, last in spans]


def _added(values: Array) -> Array:
    """Cumulative sums ``(n,)`` from 0, without the first value."""
    return np.concatenate([[0.0], np.cumsum(values[1:])])
