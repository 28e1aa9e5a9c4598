"""Relative walking direction: forward axis, grip changes and the walker's heading since the first sample.

A gyroscope measures how much a walker turns, not which way they walk. The gait does: every landing brakes the body and
every push-off accelerates it, in phase with its rise and fall. So a straight walk determines which device axis points
ahead. A grip change turns the phone, while the walker turns less or not at all.

A forward-axis method takes an `Attitude`, the walker's heading since the first sample ``(n,)`` (which is removed, so
that the walk need not be straight), the mask of walking samples ``(n,)``, and the typical duration of a step [s]; it
returns a `Forward`. A direction method takes an `Attitude` and the typical duration of a step and returns a
`Direction`. Published methods for comparison are in `papers.heading_methods`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy import fft
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Rotation

from pdr_graph.geometry import wrap_angle
from pdr_graph.inertial.attitude import Attitude, runs
from pdr_graph.priors import FORWARD, GRIP, STEP
from pdr_graph.types import Array, Complex, Mask


@dataclass(frozen=True)
class Forward:
    """Walking direction relative to the input heading: angle and its standard deviation [rad], infinite if unknown."""

    angle: float
    sigma: float

    @property
    def determined(self) -> bool:
        """True if the method determined an angle."""
        return bool(np.isfinite(self.sigma))


UNKNOWN = Forward(0.0, np.inf)


def forward_axis(attitude: Attitude, heading: Array, walking: Mask, step: float) -> Forward:
    """The default: the y axis of a phone that is held for reading, else the axis of the gait.

    If the gait contradicts the y axis, as with a phone held across, the gait decides.
    """
    gait, reading = braking_axis(attitude, heading, walking, step), reading_axis(attitude, heading, walking, step)
    if not reading.determined or not gait.determined:
        return gait if gait.determined else reading
    if abs(wrap_angle(gait.angle - reading.angle)) > FORWARD.opposed:
        return gait
    return Forward(reading.angle, FORWARD.reading_sigma)


def reading_axis(attitude: Attitude, heading: Array, walking: Mask, step: float) -> Forward:
    """The phone's y axis if its screen faces up and it is held steadily, for reading. `step` is not used."""
    x, y, z, w = attitude.R_world_device.as_quat()[walking].T
    if not len(x) or np.mean(1 - 2 * (x * x + y * y)) < FORWARD.facing_up:
        return UNKNOWN
    along = (2 * (x * y - w * z) + 1j * (1 - 2 * (x * x + z * z))) * np.exp(-1j * heading[walking])
    if abs(along.mean()) < FORWARD.steady * np.abs(along).mean():
        return UNKNOWN
    return Forward(float(np.angle(along.mean())), FORWARD.unconfirmed)


def braking_axis(attitude: Attitude, heading: Array, walking: Mask, step: float) -> Forward:
    """The level direction whose acceleration at the step's frequency leads the vertical's by 63°.

    No principal component is needed: people sway sideways once in two steps, so that at the step's frequency almost all
    level motion is forward, and the phase lead distinguishes ahead from back.
    """
    pushes = _pushes(attitude, heading, walking, step, FORWARD.window_steps)
    if len(pushes) < FORWARD.least_windows:
        return UNKNOWN
    mean = pushes.mean()
    if abs(mean) < FORWARD.least_coherence:
        return UNKNOWN
    aside = np.imag(pushes / mean)  # deviation of each window [rad], for small angles
    return Forward(float(np.angle(mean)), float(np.hypot(FORWARD.gait_sigma, np.std(aside) / np.sqrt(len(pushes)))))


def live_forward_axis(attitude: Attitude, heading: Array, walking: Mask, step: float) -> Forward:
    """The forward axis from one window of 8 steps on, while later steps are still to come.

    As `forward_axis`, but if gait and y axis contradict each other, five windows of 16 steps must agree before the gait
    decides: on stairs its axis can be reversed. Until then the axis is unknown. The y axis alone is not enough if the
    screen faces up too little: a breast pocket holds a phone so.
    """
    walked = slice(int(np.argmax(walking)), None)
    reading = reading_axis(attitude, heading, walking, step)
    pushes = _pushes(attitude[walked], heading[walked], walking[walked], step, FORWARD.early_steps)
    mean = complex(pushes.mean()) if len(pushes) else 0.0j
    if abs(mean) < FORWARD.early_coherence:
        x, y = attitude.R_world_device.as_quat()[walking, :2].T
        return reading if np.mean(1 - 2 * (x * x + y * y)) > FORWARD.surely_facing_up else UNKNOWN
    sigma = float(np.hypot(FORWARD.gait_sigma, FORWARD.early_spread / np.sqrt(len(pushes))))
    gait = Forward(float(np.angle(mean)), sigma)
    if not reading.determined:
        return gait
    if abs(wrap_angle(gait.angle - reading.angle)) <= FORWARD.opposed:
        early = len(pushes) * FORWARD.early_steps < FORWARD.least_windows * FORWARD.window_steps
        return Forward(reading.angle, FORWARD.confirmed_sigma if early else FORWARD.reading_sigma)
    agree = bool(np.all(np.real(pushes / mean) > 0.5 * np.abs(pushes / mean)))  # within 60 degrees
    return gait if agree and len(pushes) * FORWARD.early_steps >= FORWARD.overruling_steps else UNKNOWN


def _pushes(attitude: Attitude, heading: Array, walking: Mask, step: float, window_steps: int) -> Complex:
    """The `push` of each window of so many steps in which the walker walks ``(k,)``."""
    level, vertical = at_step_frequency(attitude, heading, step)
    size = max(1, round(window_steps * step / attitude.period))
    used = len(level) // size * size
    walked = walking[:used].reshape(-1, size).mean(axis=1) > 0.9
    return push(level[:used].reshape(-1, size)[walked], vertical[:used].reshape(-1, size)[walked])


def push(level: Complex, vertical: Complex) -> Complex:
    """Coherence ``(…,)`` of level and vertical acceleration ``(…, n)``: vectors ahead, of length 0 to 1.

    The vertical acceleration is shifted by the lead.
    """
    ahead = np.real(vertical.conj() * np.exp(-1j * FORWARD.lead))
    power = np.mean(np.abs(level) ** 2, axis=-1) * np.mean(ahead**2, axis=-1)
    return np.mean(level * ahead, axis=-1) / np.sqrt(power + 1e-12)


def at_step_frequency(attitude: Attitude, heading: Array, step: float) -> tuple[Complex, Complex]:
    """Level (complex, ahead real) and analytic vertical acceleration at the step frequency, both ``(n,)``. [m/s²]"""
    level, up = level_and_vertical(attitude, heading)
    count = fft.next_fast_len(len(up)) or len(up)
    ratio = np.fft.fftfreq(count, attitude.period) * step
    window = np.cos(np.pi / 2 * np.clip((np.abs(ratio) - 1) / FORWARD.band, -1, 1)) ** 2

    def filtered(signal: Complex | Array, response: Array) -> Complex:
        spectrum = np.asarray(fft.fft(signal - signal.mean(), count))
        return np.asarray(fft.ifft(response * spectrum))[: len(signal)]

    return filtered(level, window), filtered(up, 2 * window * (ratio > 0))


def level_and_vertical(attitude: Attitude, heading: Array) -> tuple[Complex, Array]:
    """Level (complex, real along ``heading (n,)``) and vertical acceleration, both ``(n,)``. [m/s²]"""
    world = attitude.R_world_device.apply(attitude.acceleration)
    return _level(world) * np.exp(-1j * heading), world[:, 2]


def _level(vectors: Array) -> Complex:
    """The level part of vectors ``(n, 3)`` as x + iy ``(n,)``; without BLAS, whose threads cost more than they save."""
    return vectors[:, 0] + 1j * vectors[:, 1]


def forward_acceleration(attitude: Attitude, heading: Array, forward: Forward) -> Array:
    """Acceleration along the walking direction ``(n,)``. [m/s²]"""
    return (level_and_vertical(attitude, heading)[0] * np.exp(-1j * forward.angle)).real


@dataclass(frozen=True)
class GripChange:
    """A change of how the phone is held: first, last sample; turn: the walker's own turn meanwhile [rad]."""

    first: int
    last: int
    turn: float


Spans = list[tuple[int, int]]  # first and last samples


def possible_grip_changes(up: Array, heading: Array, step: float, period: float) -> tuple[Spans, Spans]:
    """Spans in which the device changes its tilt, and other spans of turns as fast as a wrist's."""
    tilted = _to_another_tilt(up, step, period)
    return tilted, [span for span in _fast_turns(heading, period) if not _overlaps(span, tilted)]


def confirmed_grip_changes(
    attitude: Attitude, heading: Array, step: float, tilted: Spans, fast: Spans
) -> list[GripChange]:
    """The grip changes among candidate spans, with the turn of the walker, judged by the steps before and after."""
    if not tilted and not fast:
        return []
    gait = _StepHarmonic(*at_step_frequency(attitude, heading, step), round(step / attitude.period))
    found = [GripChange(*span, _walkers_turn(gait, heading, span)) for span in tilted]
    return found + [
        GripChange(*span, _walkers_turn(gait, heading, span)) for span in fast if _phone_turned(gait, heading, span)
    ]


@dataclass(frozen=True)
class _StepHarmonic:
    """Accelerations at the step frequency: level, vertical ``(n,)`` as of `at_step_frequency`; step: its samples."""

    level: Complex
    vertical: Complex
    step: int

    def moved(self, first: int, last: int, steps: int, coherent: float) -> float:
        """Rotation of the forward axis in the device from before to after a span; NaN if unclear. [rad]

        steps: number of steps to either side; coherent: least coherence with the gait.
        """
        before, after = slice(max(0, first - steps * self.step), first), slice(last, last + steps * self.step)
        if first < GRIP.steps_beside * self.step or last + GRIP.steps_beside * self.step > len(self.level):
            return np.nan
        ahead = [push(self.level[s], self.vertical[s]) for s in (before, after)]
        if np.min(np.abs(ahead)) < coherent:
            return np.nan
        return float(np.angle(ahead[1] * np.conj(ahead[0])))


def _to_another_tilt(up: Array, step: float, period: float) -> Spans:
    """Spans after which the vertical has another direction in the device."""
    samples = max(1, round(step / period))
    found = []
    tilting = np.linalg.norm(np.gradient(up, axis=0), axis=1) > GRIP.tilting * period
    for first, after in np.transpose(runs(tilting)).tolist():
        begin, end = max(0, first - samples), min(len(up) - 1, after - 1 + samples)
        if np.arccos(np.clip(up[begin] @ up[end], -1, 1)) > GRIP.new_tilt:
            found.append((begin, end))
    return found


def _walkers_turn(gait: _StepHarmonic, heading: Array, span: tuple[int, int]) -> float:
    """The walker's turn during a grip change, from the gait before and after; 0 unless the gait shows a turn. [rad]"""
    turned, moved = heading[span[1]] - heading[span[0]], gait.moved(*span, 2 * GRIP.steps_beside, GRIP.less_coherent)
    turn = float(wrap_angle(turned + moved))
    return turn if abs(turn) > GRIP.turned else 0.0


def _fast_turns(heading: Array, period: float) -> Spans:
    """Spans of turns that a wrist could have made."""
    samples = max(1, round(GRIP.within / period))
    fast = runs(np.abs(heading[samples:] - heading[:-samples]) > GRIP.fast)
    return [(first, after - 1 + samples) for first, after in np.transpose(fast).tolist()]


def _phone_turned(gait: _StepHarmonic, heading: Array, span: tuple[int, int]) -> bool:
    """True if the forward axis rotates in the device by the angle of the turn: the phone turned, not the walker.

    At a corner the gait may be misread, but seldom by just the angle of the corner.
    """
    turned, moved = heading[span[1]] - heading[span[0]], gait.moved(*span, GRIP.steps_beside, GRIP.coherent)
    return -moved * np.sign(turned) > GRIP.clear_change and abs(turned + moved) < GRIP.turned


def _overlaps(span: tuple[int, int], others: Spans) -> bool:
    return any(span[0] < other[1] and other[0] < span[1] for other in others)


@dataclass(frozen=True)
class Direction:
    """The walking direction over time.

    heading: ``(n,)`` since the first sample, not wrapped [rad].
    variance: ``(n,)`` cumulative variance of the method's own errors [rad²], never falling; the difference of two is
        the variance of the turn between them, in addition to the errors of gyroscope and walker.
    """

    heading: Array
    variance: Array


def mean_attitude(quaternion: Array, samples: int) -> Array:
    """Unit quaternions ``(4, n)`` of attitudes ``(n, 4)`` averaged over a window of samples.

    Means of quaternions `with_continuous_signs` are those of the attitudes for swings of less than 90°.
    """
    mean = uniform_filter1d(np.ascontiguousarray(quaternion.T), samples, axis=1, mode="nearest")
    return mean / np.linalg.norm(mean, axis=0)


def vertical_in_device(quaternion: Array) -> Array:
    """The vertical ``(n, 3)`` in device axes, from unit quaternions ``(4, n)``."""
    x, y, z, w = quaternion
    return np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)


def turns_about_vertical(quaternion: Array) -> Array:
    """The vertical component ``(n - 1,)`` of the rotation from each unit quaternion ``(4, n)`` to the next. [rad]"""
    (x, y, z, w), (a, b, c, d) = quaternion[:, 1:], quaternion[:, :-1]
    real = w * d + x * a + y * b + z * c
    i = x * d - w * a - y * c + z * b
    j = y * d - w * b - z * a + x * c
    k = z * d - w * c - x * b + y * a
    sine = np.sqrt(i * i + j * j + k * k)
    return k * np.where(sine > 1e-12, 2 * np.arctan2(sine, real) / np.maximum(sine, 1e-12), 2.0)


def without_grip_changes(heading: Array, changes: list[GripChange]) -> tuple[Array, Array]:
    """The walker's turn since the previous sample ``(n,)`` [rad], and its variance ``(n,)`` [rad²]."""
    turn, variance = np.diff(heading, prepend=heading[:1]), np.zeros(len(heading))
    for change in changes:
        during = slice(change.first + 1, change.last + 1)
        count = change.last - change.first
        turn[during] = change.turn / count
        variance[during] = GRIP.sigma**2 / count
    return turn, variance


def with_continuous_signs(quaternion: Array) -> Array:
    """Quaternions ``(n, 4)`` of the same attitudes, with signs that do not jump from sample to sample."""
    turned_round = np.cumprod(np.where(np.sum(quaternion[1:] * quaternion[:-1], axis=1) < 0, -1.0, 1.0))
    return quaternion * np.concatenate([[1.0], turned_round])[:, None]


FILTER_EDGE = 3  # [steps] at the end of the samples, where the filter at the step frequency is inaccurate
SERIES = ("quaternion", "acceleration", "measured", "rate_integral", "up", "turned", "heading", "course", "variance")


def _context_steps() -> int:
    """Number of steps before the first sample that is not final."""
    return 2 * GRIP.steps_beside + FILTER_EDGE


@dataclass
class HeadingStream:
    """The samples of the last seconds and the walker's heading at them.

    The turn of the phone's attitude, averaged over a stride, is the walker's turn: an elliptic swing changes the
    integrated rate about gravity by its solid angle (coning), but not the attitude from one stride to the next. Within
    a stride the rate about gravity is more accurate: a centred mean over one step removes most of the sway and does not
    lag. During a grip change the phone does not measure the walker, whose turn then comes from the gait, or is
    0 ± 0.35 rad.

    origin: time of sample 0 [s]; period [s]; first: number of the first stored sample; step: typical duration [s].
    quaternion ``(n, 4)`` and acceleration ``(n, 3)``; measured: ``(n,)`` True where the gyroscope ran.
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
    measured: Mask = field(default_factory=lambda: np.empty(0, dtype=bool))
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
        """The attitude of a part of the stored samples; its angular rates are 0, or NaN: no later stage uses them."""
        level, acceleration = Rotation.from_quat(self.quaternion[part]), self.acceleration[part]
        rate = np.where(self.measured[part, None], 0.0, np.full(3, np.nan))
        return Attitude(self.time[part], self.period, level, acceleration, rate)

    def update(self, quaternion: Array, acceleration: Array, angular_rate: Array, last: bool = False) -> None:
        """Add samples: quaternions ``(m, 4)``, accelerations ``(m, 3)`` and angular rates ``(m, 3)``, as in `Attitude`.

        last: True if no more samples follow.
        """
        self._append(quaternion, acceleration, angular_rate)
        self._smooth()
        if last:
            self.finish()
        else:
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

    def _append(self, quaternion: Array, acceleration: Array, angular_rate: Array) -> None:
        rate = np.sum(vertical_in_device(quaternion.T) * angular_rate, axis=1) * self.period
        measured = np.isfinite(rate)
        rate = np.where(measured, rate, 0.0)
        start = self.rate_integral[-1] if len(self.rate_integral) else -rate[0]
        joined = with_continuous_signs(np.concatenate([self.quaternion[-1:], quaternion]))
        self.quaternion = np.concatenate([self.quaternion[:-1], joined])
        self.acceleration = np.concatenate([self.acceleration, acceleration])
        self.measured = np.append(self.measured, measured)
        self.rate_integral = np.append(self.rate_integral, start + np.cumsum(rate))

    def _smooth(self) -> None:
        """Update heading and vertical, gait removed."""
        samples = max(1, round(self.step / self.period))
        last = max(0, self.heading_final - 1)
        begin = max(0, last - 2 * samples)
        steady = mean_attitude(self.quaternion[begin:], 2 * samples)[:, last - begin :]
        up = vertical_in_device(steady)
        turn = turns_about_vertical(steady) * self.measured[last + 1 :]
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
        course, variance = (self.course[begin], self.variance[begin]) if len(self.course) else (0.0, 0.0)
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


def walking_direction(attitude: Attitude, step: float) -> Direction:
    """The default: for a phone in any grip, and with grip changes in mid-walk (`HeadingStream`)."""
    stream = HeadingStream(float(attitude.time[0]), attitude.period, step=step)
    stream.update(attitude.R_world_device.as_quat(), attitude.acceleration, attitude.angular_rate, last=True)
    return Direction(stream.course, stream.variance)
