"""The step detector: landings from an accelerometer in hand, pocket, bag or on a swinging arm.

A stride resembles the one before. Where |a| repeats itself from stride to stride, the period of the repetition is the
duration of a step, and |a| at that frequency rises and falls once per step. This holds even if a loose phone is thrown
about several times within a step, or if one leg hardly moves the arm that holds the phone. Motion that does not repeat
itself, tilts the phone to and fro, or lifts it higher than a walking body bobs is not a step: shaking, gestures,
vehicles, standing. `live_steps` has the same detector for samples as they arrive.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d, uniform_filter1d

from pdr_graph.priors import BOUT, CANDIDATE, STEP
from pdr_graph.types import Array, Complex, Index, Mask


@dataclass(frozen=True)
class Landings:
    """The landings of the feet.

    time: ``(n,)`` [s]; period: ``(n,)`` duration of each step [s]; amplitude: ``(n,)`` of |a|, peak to peak [m/s²].
    """

    time: Array
    period: Array
    amplitude: Array

    @classmethod
    def at(cls, time: Array, amplitude: Array, start: float) -> Landings:
        """Landings at times ``(n,)`` of a recording that starts at ``start`` [s]."""
        return cls(time, _step_durations(time, start), amplitude)

    def __len__(self) -> int:
        return len(self.time)

    @property
    def usual_step(self) -> float:
        """Median duration of a step. [s]"""
        return float(np.median(self.period)) if len(self) else STEP.usual

    def under_way(self, time: Array) -> Mask:
        """``(m,)`` True at times ``(m,)`` [s] during a step."""
        if not len(self):
            return np.zeros(len(time), dtype=bool)
        leads_to = np.searchsorted(self.time, time)
        within = np.minimum(leads_to, len(self) - 1)
        return (leads_to < len(self)) & (time >= self.time[within] - self.period[within])


def _step_durations(landed: Array, start: float) -> Array:
    """Duration ``(n,)`` of each step [s]; the first step, and each step after a stop, takes that of its neighbours."""
    if not len(landed):
        return np.empty(0)
    intervals = np.diff(landed, prepend=start)
    walking = np.clip(intervals, STEP.shortest, STEP.longest)
    walking[0] = walking[min(1, len(walking) - 1)]
    alone = intervals >= STEP.longest
    alone[0] = True
    rows = np.flatnonzero(alone)
    beside = np.clip(rows[:, None] + np.arange(-2, 3), 0, len(walking) - 1)
    intervals[rows] = np.sort(walking[beside], axis=1)[:, 2]
    return intervals


DURATIONS: Array = 0.36 * 1.1 ** np.arange(12, dtype=float)  # [s] durations of a step that are tried, up to 1.03 s
LAGS: Array = np.concatenate([DURATIONS, 2 * DURATIONS])  # [s] at which |a| is correlated with itself
WINDOWS_AT_ONCE = 2_000  # copied to be correlated with a kernel
SHORTEST_SIGNAL = 2.5 * float(DURATIONS[-1])  # [s] in which the rhythm can be found


@dataclass(frozen=True)
class Candidates:
    """Candidate landings ``(n,)``.

    time: since the first sample [s]; step: duration of a step at that time [s]; amplitude: peak to peak [m/s²];
    regularity: correlation with the step or the stride before; bodily: True if a walking body can move so.
    """

    time: Array
    step: Array
    amplitude: Array
    regularity: Array
    bodily: Mask

    def __getitem__(self, which: Mask) -> Candidates:
        """The candidates that a mask ``(n,)`` selects."""
        return Candidates(*(values[which] for values in vars(self).values()))


NO_CANDIDATES = Candidates(*(np.empty(0) for _ in range(4)), bodily=np.empty(0, dtype=bool))


def candidates(acceleration: Array, period: float, look_ahead: float) -> Candidates:
    """Maxima of |a| at the frequency of the steps.

    acceleration ``(n, 3)`` [m/s²], one sample per period [s]; look_ahead: duration of the samples after a landing that
    are used for it [s].
    """
    smooth, steady = smoothed_magnitude(acceleration, period)
    return candidates_in_magnitude(smooth, steady, period * decimation(period), look_ahead)


def smoothed_magnitude(acceleration: Array, period: float) -> tuple[Array, Array]:
    """Smoothed |a| [m/s²] and steadiness of the vertical [0–1], both ``(m,)``, at every `decimation`-th sample."""
    stride = decimation(period)
    smooth = gaussian_filter1d(np.linalg.norm(acceleration, axis=1), CANDIDATE.smoothing / period)
    return smooth[::stride], _tilt_steadiness(acceleration, period)[::stride]


def candidates_in_magnitude(smooth: Array, steady: Array, sampling: float, look_ahead: float) -> Candidates:
    """`candidates` from the output of `smoothed_magnitude` ``(n,)``, one sample per ``sampling`` [s]."""
    if sampling > CANDIDATE.slowest or len(smooth) * sampling < SHORTEST_SIGNAL:
        return NO_CANDIDATES
    level = smooth - gaussian_filter1d(smooth, CANDIDATE.level / sampling)
    which, regularity = _rhythm(level, sampling, look_ahead)
    wave = at_frequency(np.pad(level, longest_reach(sampling)), which, sampling)
    return strong_maxima(wave, which, regularity, steady, sampling, look_ahead)


def strong_maxima(
    wave: Complex,
    which: Index,
    regularity: Array,
    steady: Array,
    sampling: float,
    look_ahead: float,
    first: int = 0,
) -> Candidates:
    """The maxima of an analytic signal ``(n,)`` that are high enough, and whether a walking body can move so.

    first: number of the first sample.
    """
    peaks, time = maxima(wave, sampling, first)
    amplitude = 2 * np.abs(wave)
    past, future = round(CANDIDATE.look_ahead / sampling), round(look_ahead / sampling)
    shift = (past + future + 1) // 2 - future
    around = maximum_filter1d(amplitude, past + future + 1, mode="nearest", origin=shift)
    high = amplitude[peaks], around[peaks]
    strong = (high[0] > CANDIDATE.weakest) & (high[0] > CANDIDATE.weakest_share * high[1])
    peaks, time = peaks[strong], time[strong]
    step = DURATIONS[which[peaks]]
    bodily = around[peaks] * (step / (2 * np.pi)) ** 2 < CANDIDATE.highest_bounce
    bodily &= steady[peaks] > CANDIDATE.steadiest_tilt
    return Candidates(time, step, amplitude[peaks], regularity[peaks], bodily)


def _rhythm(level: Array, sampling: float, look_ahead: float) -> tuple[Index, Array]:
    """The index in DURATIONS that fits best at each sample, and the correlation of |a| with itself, both ``(n,)``."""
    which, regularity = best_duration(*(_correlations(level, lags, sampling) for lags in (DURATIONS, 2 * DURATIONS)))
    available = np.maximum(np.arange(len(level)) - round((CANDIDATE.look_ahead - look_ahead) / sampling), 0)
    return which[available], regularity[available]


def best_duration(once: Array, twice: Array) -> tuple[Index, Array]:
    """The index in DURATIONS that fits best ``(n,)``, and its correlation ``(n,)``.

    once, twice: ``(k, n)`` correlation with the signal a step and a stride earlier. The signal must repeat itself after
    a stride, and fits better if it repeats itself after a step too: this excludes half and double the true duration. An
    unusual duration must fit better.
    """
    unusual = CANDIDATE.usual_weight * (np.log(DURATIONS / STEP.usual) / CANDIDATE.usual_spread) ** 2 / 2
    which = np.argmax(twice + once / 2 - unusual[:, None], axis=0)
    samples = np.arange(len(which))
    return which, np.maximum(once[which, samples], twice[which, samples])


def _correlations(level: Array, lags: Array, sampling: float) -> Array:
    """Correlation ``(k, n)`` of a signal with itself each of ``lags (k,)`` [s] earlier, in a moving window."""
    product, power = np.zeros((2, len(lags), len(level)))
    square = level**2 / 2
    for row, apart in enumerate(np.maximum(1, np.round(lags / sampling)).astype(int).tolist()):
        middle = slice(apart // 2, len(level) - (apart - apart // 2))
        np.multiply(level[:-apart], level[apart:], out=product[row, middle])
        np.add(square[:-apart], square[apart:], out=power[row, middle])
    window = max(1, round(CANDIDATE.window / sampling))
    product = uniform_filter1d(product, window, axis=1, mode="constant")
    return product / (uniform_filter1d(power, window, axis=1, mode="constant") + 1e-4)


def at_frequency(level: Array, which: Index, sampling: float) -> Complex:
    """The analytic signal ``(n,)`` at the frequency of the steps, whose index in DURATIONS is ``which (n,)``.

    level: the signal, with `longest_reach` more samples at either end.
    """
    wave, longest = np.empty(len(which), dtype=complex), longest_reach(sampling)
    for n in np.flatnonzero(np.bincount(which)).tolist():
        kernel = _kernel(n, sampling)
        around = np.arange(kernel.shape[1]) + longest - kernel.shape[1] // 2
        here = np.flatnonzero(which == n)
        for first in range(0, len(here), WINDOWS_AT_ONCE):
            part = here[first : first + WINDOWS_AT_ONCE]
            wave[part] = np.vecdot(level[part[:, None, None] + around], kernel).view(complex)[:, 0]
    return wave


def longest_reach(sampling: float) -> int:
    """Number of samples on either side of one on which its analytic signal depends."""
    return _kernel(len(DURATIONS) - 1, sampling).shape[1] // 2


@lru_cache(maxsize=256)
def _kernel(which: int, sampling: float) -> Array:
    """Gabor kernel ``(2, 2 reach + 1)`` at the frequency of a step, real and imaginary part, to correlate with."""
    reach = round(2.5 * CANDIDATE.kernel * DURATIONS[which] / sampling)
    at = np.arange(-reach, reach + 1) * sampling / DURATIONS[which]
    window = np.exp(-((at / CANDIDATE.kernel) ** 2) / 2)
    kernel = 2 / window.sum() * window * np.exp(2j * np.pi * at)
    return np.ascontiguousarray([kernel.real[::-1], kernel.imag[::-1]])


def maxima(wave: Complex, sampling: float, first: int = 0) -> tuple[Index, Array]:
    """The samples before the maxima of an analytic signal, and the interpolated times of the maxima [s].

    first: number of its first sample.
    """
    before, after = wave.imag[:-1], wave.imag[1:]
    top = np.flatnonzero((before < 0) & (after >= 0) & (wave.real[1:] > 0))
    return top, (top + first + before[top] / (before[top] - after[top])) * sampling


def _tilt_steadiness(acceleration: Array, period: float) -> Array:
    """Length ``(n,)`` of the mean direction of gravity in the device: 1 if the device does not tilt."""
    return steadiness(gaussian_filter1d(acceleration.T.copy(), CANDIDATE.tilt_smoothing / period, axis=1), period)


def steadiness(gravity: Array, period: float) -> Array:
    """Length ``(n,)`` of the mean direction of gravity, which is ``(3, n)`` in device axes."""
    window = max(1, round(CANDIDATE.tilt_window / period))
    length = _lengths(gravity)
    mean = uniform_filter1d(np.vstack([gravity, length]), window, axis=1)
    return _lengths(mean[:3]) / np.maximum(mean[3], 1e-9)


def _lengths(vectors: Array) -> Array:
    """Lengths ``(n,)`` of vectors ``(3, n)``; `np.linalg.norm` takes three times as long for a few of them."""
    x, y, z = vectors
    return np.sqrt(x * x + y * y + z * z)


def decimation(period: float) -> int:
    """Number of samples per evaluation of the rhythm, for one sample per ``period`` [s]."""
    return max(1, int(CANDIDATE.sampling / period + 1e-6))


def walking_steps(time: Array, acceleration: Array, look_ahead: float | None = None) -> Landings:
    """The landings of a whole recording.

    time ``(n,)`` [s] uniform; acceleration ``(n, 3)`` with gravity [m/s²]; look_ahead: see `StepDetector`.
    """
    start, period = float(time[0]), float(time[-1] - time[0]) / (len(time) - 1)
    landed, amplitude = Bout().steps(
        candidates(acceleration, period, CANDIDATE.look_ahead if look_ahead is None else look_ahead)
    )
    return Landings.at(start + landed, amplitude, start)


_Steps = list[tuple[float, float]]  # times and amplitudes


@dataclass
class Bout:
    """A bout of walking: it starts with regular steps, and then every candidate is a step until the walker stops.

    walking: True within a bout; last: time of the last candidate [s]; waiting: candidates before the bout starts.
    """

    walking: bool = False
    last: float = -np.inf
    waiting: _Steps = field(default_factory=list)

    def steps(self, following: Candidates) -> tuple[Array, Array]:
        """Times ``(m,)`` [s] and amplitudes ``(m,)`` [m/s²] of the steps among the next candidates."""
        columns = (values.tolist() for values in vars(following).values())
        certain = [step for candidate in zip(*columns, strict=True) for step in self._add(*candidate)]
        time, amplitude = np.array(certain).reshape(-1, 2).T
        return time, amplitude

    def _add(self, time: float, step: float, amplitude: float, regularity: float, bodily: bool) -> _Steps:
        """Add a candidate; returns the steps that it confirms."""
        if not bodily:
            self.walking, self.waiting, self.last = False, [], -np.inf
            return []
        if regularity < BOUT.go_on or time - self.last < BOUT.closest_share * step:
            return []
        if time - self.last > STEP.longest:
            self.walking, self.waiting = False, []
        self.last = time
        self.waiting = [(t, a) for t, a in self.waiting if t > time - BOUT.late] + [(time, amplitude)]
        if not self.walking and regularity > (BOUT.vigorous_start if amplitude > BOUT.vigorous else BOUT.start):
            self._start_if_long_enough()
        if not self.walking:
            return []
        certain, self.waiting = self.waiting, []
        return certain

    def _start_if_long_enough(self) -> None:
        if len(self.waiting) >= BOUT.fewest:
            usual = float(np.median([amplitude for _, amplitude in self.waiting]))
            self.waiting = self.waiting[int(self.waiting[0][1] < BOUT.push_off * usual) :]
            self.walking = True
