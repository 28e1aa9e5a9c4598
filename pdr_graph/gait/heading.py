"""Relative walking direction: forward axis, grip changes and the walker's heading since the first sample.

A gyroscope measures how much a walker turns, not where they walk. The gait does: every landing brakes the body and
every push-off accelerates it, in phase with its rise and fall. So a straight walk determines which device axis points
ahead. A grip change turns the phone, while the walker turns less or not at all.

A forward-axis method takes an `Attitude`, the walker's heading since the first sample ``(n,)`` (which is removed, so
that the walk need not be straight), the mask of walking samples ``(n,)``, and the typical duration of a step [s]; it
returns a `Forward`. A direction method takes an `Attitude` and the typical duration of a step and returns a
`Direction`. Published methods for comparison are in `papers.gait_methods`.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from scipy import fft
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Rotation

from pdr_graph.geometry import wrap_angle
from pdr_graph.inertial.attitude import Attitude, runs
from pdr_graph.priors import CANDIDATE, FORWARD, GRIP, MOTION, STEP
from pdr_graph.types import INSTANT, Array, Complex, Index, Mask


@dataclass(frozen=True)
class Forward:
    """Walking direction relative to the input heading: angle and its standard deviation [rad], infinite if unknown."""

    angle: float
    sigma: float

    @property
    def determined(self) -> bool:
        """True if the method determined an angle."""
        return bool(np.isfinite(self.sigma))


UNKNOWN_AXIS = Forward(0.0, np.inf)


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
        return UNKNOWN_AXIS
    along = (2 * (x * y - w * z) + 1j * (1 - 2 * (x * x + z * z))) * np.exp(-1j * heading[walking])
    if abs(along.mean()) < FORWARD.steady * np.abs(along).mean():
        return UNKNOWN_AXIS
    return Forward(float(np.angle(along.mean())), FORWARD.unconfirmed)


def braking_axis(attitude: Attitude, heading: Array, walking: Mask, step: float) -> Forward:
    """The level direction whose acceleration at the step's frequency leads the vertical's by 63°.

    No principal component is needed: people sway sideways once in two steps, so that at the step's frequency almost all
    level motion is forward, and the phase lead distinguishes ahead from back.
    """
    pushes = _pushes(attitude, heading, walking, step, FORWARD.window_steps)
    if len(pushes) < FORWARD.least_windows:
        return UNKNOWN_AXIS
    mean = pushes.mean()
    if abs(mean) < FORWARD.least_coherence:
        return UNKNOWN_AXIS
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
    pushes = _pushes(attitude[walked], heading[walked], walking[walked], step, FORWARD.half_window)
    mean = complex(pushes.mean()) if len(pushes) else 0.0j
    if abs(mean) < FORWARD.early_coherence:
        x, y = attitude.R_world_device.as_quat()[walking, :2].T
        return reading if np.mean(1 - 2 * (x * x + y * y)) > FORWARD.surely_facing_up else UNKNOWN_AXIS
    sigma = float(np.hypot(FORWARD.gait_sigma, FORWARD.early_spread / np.sqrt(len(pushes))))
    gait = Forward(float(np.angle(mean)), sigma)
    if not reading.determined:
        return gait
    if abs(wrap_angle(gait.angle - reading.angle)) <= FORWARD.opposed:
        early = len(pushes) * FORWARD.half_window < FORWARD.least_windows * FORWARD.window_steps
        return Forward(reading.angle, FORWARD.confirmed_sigma if early else FORWARD.reading_sigma)
    agree = bool(np.all(np.real(pushes / mean) > 0.5 * np.abs(pushes / mean)))  # within 60 degrees
    return gait if agree and len(pushes) * FORWARD.half_window >= 5 * FORWARD.window_steps else UNKNOWN_AXIS


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
    return harmonic(*level_and_vertical(attitude, heading), step / attitude.period)


def harmonic(level: Complex, up: Array, step: float) -> tuple[Complex, Complex]:
    """Level and vertical acceleration ``(…, n)`` at the step frequency, the latter analytic. step: in samples."""
    count = fft.next_fast_len(up.shape[-1]) or up.shape[-1]
    ratio = np.fft.fftfreq(count) * step
    window = np.cos(np.pi / 2 * np.clip((np.abs(ratio) - 1) / 0.5, -1, 1)) ** 2

    def filtered(signal: Complex | Array, response: Array) -> Complex:
        spectrum = np.asarray(fft.fft(signal - signal.mean(axis=-1, keepdims=True), count))
        return np.asarray(fft.ifft(response * spectrum))[..., : signal.shape[-1]]

    return filtered(level, window), filtered(up, 2 * window * (ratio > 0))


def level_and_vertical(attitude: Attitude, heading: Array) -> tuple[Complex, Array]:
    """Level (complex, real along ``heading (n,)``) and vertical acceleration, both ``(n,)``. [m/s²]"""
    world = attitude.R_world_device.apply(attitude.acceleration)
    return (world[:, 0] + 1j * world[:, 1]) * np.exp(-1j * heading), world[:, 2]


def forward_acceleration(attitude: Attitude, heading: Array, forward: Forward) -> Array:
    """Acceleration along the walking direction ``(n,)``. [m/s²]"""
    return (level_and_vertical(attitude, heading)[0] * np.exp(-1j * forward.angle)).real


@dataclass(frozen=True)
class Direction:
    """The walking direction over time.

    heading: ``(n,)`` since the first sample, not wrapped [rad].
    variance: ``(n,)`` cumulative variance of the method's own errors [rad²], never falling; the difference of two is
        the variance of the turn between them, in addition to the errors of gyroscope and walker.
    """

    heading: Array
    variance: Array


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


FILTER_EDGE = 3  # [steps] before a window, from which the filter at the step frequency is accurate
AT_ONCE = 200  # windows of samples that are filtered together
SERIES = ("quaternion", "acceleration", "measured", "rate_integral", "up", "turned", "heading")
SERIES += ("straight", "doubt", "course", "variance")


class HeadingStream:
    """The samples of the last seconds and the walker's heading at them.

    The turn of the phone's attitude, averaged over a stride, is the walker's turn: an elliptic swing changes the
    integrated rate about gravity by its solid angle (coning), but not the attitude from one stride to the next. Within
    a stride the rate about gravity is more accurate: a centred mean over one step removes most of the sway and does not
    lag. While the phone is tilted it does not measure the walker, whose turn then is 0 ± 0.35 rad, or ± 1.2 where they
    stand meanwhile, until the gait shows it.

    Who walks sideways or backwards, or turns the phone in the hand, turns the phone and not the walk. The gait shows
    it: its axis in the device (`push`) deviates from that of the last minute by the angle of the turn. The walk takes
    over a clear deviation, at the moment at which the phone turns or is tilted.

    origin: time of sample 0 [s]; period [s]; first: number of the first stored sample; step: typical duration [s].
    quaternion ``(n, 4)``, of signs that do not jump, and acceleration ``(n, 3)``; measured: ``(n,)`` True where the
    gyroscope ran.
    rate_integral, turned: ``(n,)`` integrated rate about the vertical, and turn of the mean attitude [rad].
    up: ``(n, 3)`` vertical in the device, gait removed; heading: ``(n,)`` turned as the phone [rad]; both are final for
        the first ``heading_final`` samples.
    straight, doubt: ``(n,)`` that heading if nobody turns while the phone is tilted [rad], and its variance [rad²],
        final for the first ``straight_final`` samples.
    course, variance: ``(n,)`` the walker's heading [rad] and its variance [rad²], final for the first ``course_final``
        samples; aside: its last deviation from `straight` [rad].
    axis: mean push of the last minute, of so many windows; next_window: number of the first sample of the next.
    """

    def __init__(self, origin: float, period: float, step: float = STEP.usual):
        self.origin, self.period, self.step = origin, period, step
        self.first = self.heading_final = self.straight_final = self.course_final = self.next_window = 0
        self.aside, self.axis, self.windows = 0.0, 0.0j, 0
        self._beyond = 0.0  # variance of the deviations so far [rad²]
        self.asides = deque[float](maxlen=2 * FORWARD.half_window)  # of the last windows [rad]
        self.quaternion, self.acceleration, self.up = (np.empty((0, columns)) for columns in (4, 3, 3))
        self.rate_integral, self.turned, self.heading = (np.empty(0) for _ in range(3))
        self.straight, self.doubt, self.course, self.variance = (np.empty(0) for _ in range(4))
        self.measured = np.empty(0, dtype=bool)

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
        # Integrate the rate about the vertical
        rate = np.sum(vertical_in_device(quaternion.T) * angular_rate, axis=1) * self.period
        measured = np.isfinite(rate)
        rate = np.where(measured, rate, 0.0)
        start = self.rate_integral[-1] if len(self.rate_integral) else -rate[0]
        joined = np.concatenate([self.quaternion[-1:], quaternion])
        signs = np.cumprod(np.where(np.sum(joined[1:] * joined[:-1], axis=1) < 0, -1.0, 1.0))
        self.quaternion = np.concatenate([self.quaternion[:-1], joined * np.append(1.0, signs)[:, None]])
        self.acceleration = np.concatenate([self.acceleration, acceleration])
        self.measured = np.append(self.measured, measured)
        self.rate_integral = np.append(self.rate_integral, start + np.cumsum(rate))

        # Heading and vertical, gait removed. Means of quaternions are those of attitudes for swings of less than 90°
        samples, keep = max(1, round(self.step / self.period)), self.heading_final
        final = max(0, keep - 1)  # the last final sample stays
        begin, new = max(0, final - 2 * samples), keep - final
        mean = np.ascontiguousarray(self.quaternion[begin:].T)
        mean = uniform_filter1d(mean, 2 * samples, axis=1, mode="nearest")
        steady = (mean / np.linalg.norm(mean, axis=0))[:, final - begin :]
        turn = turns_about_vertical(steady) * self.measured[final + 1 :]
        turned = (self.turned[final] if len(self.turned) else 0.0) + np.concatenate([[0.0], np.cumsum(turn)])
        of_step, of_stride = (uniform_filter1d(self.rate_integral[begin:], n * samples, mode="nearest") for n in (1, 2))
        heading = turned + (of_step - of_stride)[final - begin :]
        self.up = np.concatenate([self.up[:keep], vertical_in_device(steady)[new:]])
        self.turned = np.concatenate([self.turned[:keep], turned[new:]])
        self.heading = np.concatenate([self.heading[:keep], heading[new:]])
        self.heading_final = max(keep, len(self.quaternion) - samples)
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
        drop = max(0, final - round((2 * FORWARD.half_window + FILTER_EDGE) * self.step / self.period))
        self.first += drop
        self.heading_final -= drop
        self.straight_final -= drop
        self.course_final -= drop
        for name in SERIES:
            setattr(self, name, getattr(self, name)[drop:])

    def _correct(self, last: bool) -> None:
        """Update the heading without grip changes; it is final up to the first that lasts."""
        now, beside = len(self.quaternion), max(1, round(self.step / self.period))
        begin, end = max(0, self.straight_final - 1), max(1, self.heading_final)

        # Spans, first and last samples, after which the vertical has another direction in the device
        tilted, up = list[tuple[int, int]](), self.up[begin:end]
        if end - begin >= 3:
            tilting = np.linalg.norm(np.gradient(up, axis=0), axis=1) > GRIP.tilting * self.period
            for first, after in np.transpose(runs(tilting)).tolist():
                before, behind = max(0, first - beside), min(len(up) - 1, after - 1 + beside)
                if np.arccos(np.clip(up[before] @ up[behind], -1, 1)) > GRIP.new_tilt:
                    tilted.append((begin + before, begin + behind))

        # The first sample at which grip changes are undecided: they last, or it is not known who walks on
        until, two = now, 2 * beside
        if not last:
            until = self.heading_final - beside - 2
            until = min([until, *(first for first, after in tilted if after + two > until)])
            until = max(until, now - 2 * FORWARD.half_window * beside, self.straight_final)

        # The walker's turn during each is unknown
        turn, variances = np.diff(self.heading, prepend=self.heading[:1]), np.zeros(len(self.heading))
        for first, final in tilted:
            walks = self._walks(first - two, first) and self._walks(final, final + two)
            turn[first + 1 : final + 1] = 0.0
            variances[first + 1 : final + 1] = (GRIP.sigma if walks else MOTION.gap_turn) ** 2 / (final - first)

        kept, known = self.straight_final, bool(len(self.straight))
        straight = (self.straight[begin] if known else 0.0) + np.append(0.0, np.cumsum(turn[begin + 1 :]))
        doubt = (self.doubt[begin] if known else 0.0) + np.append(0.0, np.cumsum(variances[begin + 1 :]))
        self.straight = np.append(self.straight[:kept], straight[kept - begin :])
        self.doubt = np.append(self.doubt[:kept], doubt[kept - begin :])
        self.straight_final = max(kept, until)
        self._follow_gait(last)

    def _follow_gait(self, last: bool) -> None:
        """Update how far the walking direction deviates from the usual one in the device.

        It is taken over between two windows that show it, in proportion to the turn of the phone meanwhile, and the
        doubt of a grip change there ends. Without a clear window the last deviation goes on; where the phone turned or
        was tilted, it waits for a landing.
        """
        step = max(1, round(self.step / self.period))
        size, kept, now = FORWARD.half_window * step, self.course_final, len(self.straight)
        begins = np.arange(self.next_window - self.first, self.straight_final - size + 1, step)
        course, variance = (np.append(each[:kept], np.empty(now - kept)) for each in (self.course, self.variance))
        gripped = np.diff(self.doubt, prepend=self.doubt[:1])
        turned = np.abs(np.diff(self.straight, prepend=self.straight[:1])) + gripped / GRIP.sigma**2 + INSTANT
        for begin, shown in zip(begins.tolist(), self._pushes(begins, size).tolist(), strict=True):
            middle, first = begin + size // 2, self.course_final
            change, known = 0.0, 0.0
            until = middle if shown or turned[first:middle].sum() < GRIP.fast else middle - 2 * size
            part = slice(first, max(until, first))
            course[part], variance[part] = self.straight[part] + self.aside, self.doubt[part] + self._beyond
            if shown:
                lately = slice(max(middle - 2 * size, 0), middle)
                turn = float(self.straight[middle] - self.straight[lately.start])
                off = self._deviation(shown, None if gripped[lately].any() else turn)
                change, known = float(wrap_angle(off - self.aside)), gripped[part].sum()
            if change or known:
                along = np.cumsum(turned[part]) / turned[part].sum() if part.stop > first else np.empty(0)
                doubt = (GRIP.off_sigma * (1.0 if known else min(1.0, abs(change) / GRIP.clear))) ** 2
                course[part] += change * along
                variance[part] = (variance[first - 1] if first else 0.0) + doubt * along
                self.aside, self._beyond = self.aside + change, self._beyond + doubt - known
            self.course_final = part.stop
        rest = slice(self.course_final, now)
        course[rest], variance[rest] = self.straight[rest] + self.aside, self.doubt[rest] + self._beyond
        self.next_window += len(begins) * step
        self.course, self.variance = course, variance
        self.course_final = now if last else self.course_final

    def _deviation(self, shown: complex, turn: float | None) -> float:
        """The deviation of a window's push from the usual one, which it updates. [rad]

        It counts if it is no noise, and if the phone has turned lately as far the other way; else the last goes on: on
        stairs the gait has another phase, and no turn comes with it. turn: of the phone [rad], None if it was tilted.
        """
        self.axis = self.axis or shown
        off = float(np.angle(shown * np.conj(self.axis)))
        off *= 1 - np.exp(-((off / GRIP.clear) ** 4)) if abs(off) > GRIP.noise else 0.0
        change = float(wrap_angle(off - (self.asides[0] if self.asides else 0.0)))
        if turn is not None and -np.sign(change) * turn < abs(change) - GRIP.sigma:
            off = self.aside
        self.asides.append(off)
        self.windows += 1
        share = max(1 / self.windows, 1 / 60)  # of the last sixty windows, a step apart
        self.axis = (1 - share) * self.axis + share * shown * np.exp(-1j * off)
        return off

    def _walks(self, begin: int, end: int) -> bool:
        """True if the gait is seen between two samples, or if none of them is stored."""
        begin, end = max(0, begin), min(end, len(self.heading))
        if end - begin < self.step / self.period:
            return True
        _, up = level_and_vertical(self.attitude(slice(begin, end)), self.heading[begin:end])
        return float(np.ptp(up)) > 2 * CANDIDATE.weakest

    def _pushes(self, begins: Index, size: int) -> Complex:
        """The `push` of the windows of ``size`` samples from ``begins (k,)`` on; 0 where the gait does not show it."""
        if len(begins) > AT_ONCE:
            return np.concatenate([self._pushes(begins[n : n + AT_ONCE], size) for n in range(0, len(begins), AT_ONCE)])
        if not len(begins):
            return np.empty(0, dtype=complex)
        edge = FILTER_EDGE * size // FORWARD.half_window
        rows = np.maximum(begins[:, None] + np.arange(-edge, size), 0)
        part = slice(int(rows.min()), int(rows.max()) + 1)
        level, up = level_and_vertical(self.attitude(part), self.straight[part])
        rows = rows - part.start
        ahead, vertical = (each[:, edge:] for each in harmonic(level[rows], up[rows], self.step / self.period))
        found = push(ahead, vertical)
        horizontal, high = (np.median(np.abs(each), axis=1) for each in (ahead, vertical))
        clear = (np.abs(found) > GRIP.coherent) & (horizontal > GRIP.weak * high) & (2 * high > CANDIDATE.weakest)
        held = self.doubt[begins + size - 1] == self.doubt[begins]  # the grip does not change meanwhile
        return np.where(clear & held & self.measured[part][rows].all(axis=1), found, 0.0)


def walking_direction(attitude: Attitude, step: float) -> Direction:
    """The default: for a phone in any grip, and with grip changes in mid-walk (`HeadingStream`)."""
    stream = HeadingStream(float(attitude.time[0]), attitude.period, step)
    stream.update(attitude.R_world_device.as_quat(), attitude.acceleration, attitude.angular_rate, last=True)
    return Direction(stream.course, stream.variance)
