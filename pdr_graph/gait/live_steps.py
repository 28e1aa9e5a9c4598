"""Live step detector: the landings of `walking_steps` as samples arrive.

Every stage of `candidates_in_magnitude` depends on samples to either side. Up to some second before the last sample its
output is final and is stored; after that it is computed at each update as for a recording that ends there.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import correlate1d

from pdr_graph.gait.step_detection import (
    DURATIONS,
    LAGS,
    NO_CANDIDATES,
    SHORTEST_SIGNAL,
    Bout,
    Candidates,
    at_frequency,
    best_duration,
    decimation,
    longest_reach,
    maxima,
    steadiness,
    strong_maxima,
)
from pdr_graph.geometry import gaussian_weights
from pdr_graph.priors import BOUT, CANDIDATE
from pdr_graph.types import Array, Index


class StepDetector:
    """Detects steps as samples arrive; the result equals that of `walking_steps` on the whole recording.

    period: between samples [s]; start: time of the first sample [s]; look_ahead: duration of the samples after a
    landing that are used for its rhythm and amplitude [s]. A step is certain 3 s after that. A shorter look-ahead than
    the default misses or adds a step now and then.

    Candidates are evaluated only when one of them may have become certain, and for `provisional`.
    """

    def __init__(self, period: float, start: float = 0.0, look_ahead: float | None = None):
        self.period, self.start = period, start
        self.look_ahead = CANDIDATE.look_ahead if look_ahead is None else look_ahead
        self.decided = -np.inf  # time since the start up to which steps are certain [s]
        self.bout = Bout()
        self.samples, self.first, self.count = np.empty((0, 3)), 0, 0  # the last ones, number of the first, and of all
        self.smoothed = np.empty((0, 2))  # as `smoothed_magnitude`, from number `smoothed_first` on
        self.smoothed_first, self.smoothed_final = 0, 0  # samples before the latter are final
        self.pending = np.empty((0, 5))  # candidates after `decided`
        self._origin = 0  # number of the smoothed sample from which the times of candidates are counted
        self._evaluated = 0  # number of samples at the last evaluation
        self._stream: CandidateStream | None = None
        self._gravity, self._gravity_first = np.empty((3, 0)), 0  # smoothed and final, and number of the first sample

    def update(self, acceleration: Array) -> tuple[Array, Array]:
        """Add samples ``(n, 3)``; returns times ``(m,)`` [s] and amplitudes of newly certain steps."""
        self.samples = np.concatenate([self.samples, acceleration])
        self.count += len(acceleration)
        until = self.count * self.period - BOUT.future - self.look_ahead
        self._origin = max(0, int((self.decided - BOUT.past) / self._sampling)) if self.decided > 0 else 0
        if until > 0 and (self._stream is None or self._stream.is_due(self.decided, until)):
            self._evaluate()
        return self._decide(until)

    def finish(self) -> tuple[Array, Array]:
        """Times [s] and amplitudes of the last steps: no more samples follow."""
        self._evaluate()
        return self._decide(np.inf)

    def provisional(self) -> tuple[Array, Array]:
        """Times [s] and amplitudes of the steps after the certain ones, which later samples may still change."""
        self._evaluate()
        landed, amplitude = replace(self.bout).steps(_candidates(self.pending))
        return self.start + landed, amplitude

    @property
    def earliest(self) -> float:
        """Earliest time at which a new landing can still be found. [s]"""
        late = [time for time, _ in self.bout.waiting if time > self.decided - BOUT.late]
        return self.start + min([self.decided, *late])

    @property
    def _sampling(self) -> float:
        """Interval between smoothed samples. [s]"""
        return self.period * decimation(self.period)

    def _decide(self, until: float) -> tuple[Array, Array]:
        """Times and amplitudes of the steps up to ``until`` [s] after the start among the pending candidates."""
        self.decided = max(self.decided, until)
        if not len(self.pending) or self.pending[0, 0] > until:
            return np.empty(0), np.empty(0)
        certain = self.pending[:, 0] <= until
        landed, amplitude = self.bout.steps(_candidates(self.pending[certain]))
        self.pending = self.pending[~certain]
        return self.start + landed, amplitude

    def _evaluate(self) -> None:
        """Find the candidates after the certain time among all samples, unless none are new."""
        if self._evaluated == self.count or self._sampling > CANDIDATE.slowest:
            return
        self._evaluated = self.count
        self._smooth()
        if self._stream is None:
            self._stream = CandidateStream(self._sampling, self.look_ahead, self.smoothed_first)
        smooth, steady = self.smoothed.T
        self._stream.update(smooth, self._smooth_final)
        found = self._stream.candidates(steady, self.decided, self._origin)
        self.pending = np.stack(list(vars(found).values()), axis=1)
        drop = self._origin - self.smoothed_first  # no later step depends on earlier samples
        self.smoothed, self.smoothed_first = self.smoothed[drop:], self._origin
        self._stream.forget(self._origin)

    @property
    def _smooth_final(self) -> int:
        """Number of the first smoothed |a| that later samples may change."""
        reach = len(gaussian_weights(CANDIDATE.smoothing / self.period)) // 2
        return max(self.smoothed_first, (self.count - 1 - reach) // decimation(self.period) + 1)

    def _smooth(self) -> None:
        """Smooth the new samples, and the last ones again: their smoothed values depend on later samples."""
        stride = decimation(self.period)
        reach = int(CANDIDATE.reach / self.period / stride) + 1
        final = self.smoothed[: self.smoothed_final - self.smoothed_first]
        fresh = np.stack([self._magnitude(self.smoothed_final), self._steadiness(self.smoothed_final)], axis=1)
        self.smoothed = np.concatenate([final, fresh])
        self.smoothed_final = max(self.smoothed_final, self.smoothed_first + len(self.smoothed) - reach)
        drop = max(0, self.smoothed_final - reach - self.first // stride) * stride
        self.samples, self.first = self.samples[drop:], self.first + drop

    def _magnitude(self, begin: int) -> Array:
        """Smoothed |a| ``(m,)`` from smoothed sample ``begin`` on. [m/s²]"""
        weights, stride = gaussian_weights(CANDIDATE.smoothing / self.period), decimation(self.period)
        first = max(self.first, begin * stride - len(weights) // 2)
        smooth = correlate1d(np.linalg.norm(self.samples[first - self.first :], axis=1), weights)
        return smooth[begin * stride - first :: stride]

    def _steadiness(self, begin: int) -> Array:
        """Steadiness of the vertical ``(m,)`` from smoothed sample ``begin`` on."""
        weights, stride = gaussian_weights(CANDIDATE.tilt_smoothing / self.period), decimation(self.period)
        reach, known = len(weights) // 2, self._gravity_first + self._gravity.shape[1]
        first = max(self.first, known - reach)
        fresh = correlate1d(self.samples[first - self.first :].T.copy(), weights, axis=1)[:, known - first :]
        gravity = np.concatenate([self._gravity, fresh], axis=1)
        drop = max(0, begin * stride - round(CANDIDATE.tilt_window / self.period) - self._gravity_first)
        self._gravity_first += drop
        self._gravity = gravity[:, drop : max(drop, self.count - reach - self._gravity_first + drop)]
        return steadiness(gravity[:, drop:], self.period)[begin * stride - self._gravity_first :: stride]


def _candidates(rows: Array) -> Candidates:
    """Candidates of rows ``(c, 5)``."""
    *columns, bodily = rows.T
    return Candidates(*columns, bodily=bodily > 0)


MARGIN = 1e-6  # [s] rounding of a time that is counted from another sample


class WindowSums:
    """Sums of the products of a signal with itself and of its squares, in windows as those of `_correlations`."""

    def __init__(self, sampling: float):
        self.lags = np.maximum(1, np.round(LAGS / sampling)).astype(int)
        self.size = max(1, round(CANDIDATE.window / sampling))
        self.after = self.lags - self.lags // 2  # from the middle of a product to its later sample
        self.first = 0  # number of the sample before which `sums` begin
        self.sums = np.zeros((2 * len(LAGS), 1))  # of all samples before one

    @property
    def reach(self) -> int:
        """Number of samples after one on which its correlations depend."""
        return self.size - self.size // 2 + int(self.after.max())

    def extend(self, level: Array, begin: int) -> None:
        """Add samples, of which the first has number ``begin``; level: these after the longest lag of earlier ones."""
        past = int(self.lags[-1])
        now, at = level[past:], past + np.arange(len(level) - past)
        earlier = level[at - self.lags[:, None]]
        power = earlier**2 / 2 + now**2 / 2
        if begin < past:
            power[begin + at - past < self.lags[:, None]] = 0.0  # there is no earlier sample
        kept = self.sums[:, : begin - self.first + 1]
        new = np.cumsum(np.concatenate([earlier * now, power]), axis=1)
        self.sums = np.concatenate([kept, kept[:, -1:] + new], axis=1)

    def correlations(self, begin: int, end: int) -> tuple[Array, Array]:
        """Correlation ``(k, n)`` with the signal a step and a stride earlier, at the samples [begin, end)."""
        low = np.arange(begin, end) - self.size // 2 - self.first + self.after[:, None]
        last, rows = self.sums.shape[1] - 1, np.arange(len(LAGS))[:, None] * self.sums.shape[1]
        high = rows + np.minimum(low + self.size, last)
        low = rows + np.clip(low, 0, last)
        flat = self.sums.reshape(-1)
        products, powers = flat[: flat.size // 2], flat[flat.size // 2 :]
        product, power = products[high] - products[low], powers[high] - powers[low]
        correlation = product / (power + 1e-4 * self.size)
        return correlation[: len(DURATIONS)], correlation[len(DURATIONS) :]

    def forget(self, before: int) -> None:
        """Drop the sums that no correlation at a sample from ``before`` on depends on."""
        drop = before - self.size // 2 - self.first
        if drop > 0:
            self.first += drop
            self.sums = self.sums[:, drop:] - self.sums[:, drop : drop + 1]


class CandidateStream:
    """The candidates among the last samples of the smoothed |a|.

    sampling: between samples [s]; look_ahead: as of `candidates`; first: number of the first stored sample.
    level, which, regularity, wave: of the stored samples, as in `candidates_in_magnitude`; they are final before the
    samples ``level_final``, ``which_final`` and ``wave_final``. certain: times of final maxima before ``certain_from``.
    """

    def __init__(self, sampling: float, look_ahead: float, first: int):
        self.sampling, self.look_ahead, self.first = sampling, look_ahead, first
        self.windowed = WindowSums(sampling)
        self.windowed.first = first
        self.past = int(self.windowed.lags[-1])
        self.reach = longest_reach(sampling)
        self.late = round((CANDIDATE.look_ahead - look_ahead) / sampling)
        self.level = np.zeros(self.past)  # begins so many samples before `first`
        self.which, self.regularity = np.empty(0, dtype=np.intp), np.empty(0)
        self.wave = np.empty(0, dtype=complex)
        self.level_final = self.which_final = self.wave_final = self.certain_from = first
        self.certain: list[float] = []  # times [s] of final maxima since sample 0

    def update(self, smooth: Array, final: int) -> None:
        """Compute all stages anew that depend on new samples.

        smooth: all stored samples and the new ones; final: number of the first that later samples may change.
        """
        end = self.first + len(smooth)
        self._update_level(smooth)
        self._update_rhythm(end)
        which = self.available(self.wave_final, end)
        level = np.append(self.level[self.wave_final - self.first + self.past - self.reach :], np.zeros(self.reach))
        fresh = at_frequency(level, self.which[which - self.first], self.sampling)
        self.wave = np.concatenate([self.wave[: self.wave_final - self.first], fresh])

        smoothing = len(gaussian_weights(CANDIDATE.level / self.sampling)) // 2
        self.level_final = max(self.level_final, final - smoothing)
        self.which_final = max(self.which_final, self.level_final - self.windowed.reach)
        self.wave_final = max(self.wave_final, min(self.which_final + self.late, self.level_final - self.reach))
        self._update_certain()

    def _update_level(self, smooth: Array) -> None:
        weights = gaussian_weights(CANDIDATE.level / self.sampling)
        known = self.level_final - self.first
        begin = max(0, known - len(weights) // 2)
        fresh = smooth[begin:] - correlate1d(smooth[begin:], weights)
        self.level = np.concatenate([self.level[: self.past + known], fresh[known - begin :]])
        self.windowed.extend(self.level[known:], self.level_final)

    def _update_rhythm(self, end: int) -> None:
        which, regularity = best_duration(*self.windowed.correlations(self.which_final, end))
        known = self.which_final - self.first
        self.which = np.concatenate([self.which[:known], which])
        self.regularity = np.concatenate([self.regularity[:known], regularity])

    def available(self, begin: int, end: int) -> Index:
        """Numbers of the samples whose rhythm is used at the samples [begin, end): so early is it known there."""
        return np.maximum(np.arange(begin, end) - self.late, self.first)

    def candidates(self, steadiness: Array, after: float, origin: int) -> Candidates:
        """The candidates after a time [s] since sample 0. steadiness: ``(n,)`` of the stored samples.

        origin: number of the sample from which their times are counted first.
        """
        end = self.first + len(self.wave)
        if (end - origin) * self.sampling < SHORTEST_SIGNAL:
            return NO_CANDIDATES
        begin = max(origin, self._sample(after) - round(CANDIDATE.look_ahead / self.sampling) - 1)
        rhythm, rows = self.available(begin, end) - self.first, slice(begin - self.first, None)
        signals = self.wave[rows], self.which[rhythm], self.regularity[rhythm], steadiness[rows]
        found = strong_maxima(*signals, self.sampling, self.look_ahead, begin - origin)
        found = replace(found, time=found.time + origin * self.sampling)
        return found[found.time > after]

    def is_due(self, after: float, until: float) -> bool:
        """False if it is certain that no candidate lies between two times [s] since sample 0."""
        if until > (self.wave_final - 1) * self.sampling:
            return True
        return any(after - MARGIN < time <= until + MARGIN for time in self.certain)

    def _update_certain(self) -> None:
        """Update the times of the maxima that are final and may become candidates."""
        known = self.certain_from - self.first
        peaks, time = maxima(self.wave[known : self.wave_final - self.first], self.sampling, self.certain_from)
        high = 2 * np.abs(self.wave[known + peaks]) > CANDIDATE.weakest
        self.certain = [t for t in self.certain if t >= self.first * self.sampling] + time[high].tolist()
        self.certain_from = max(self.certain_from, self.wave_final - 1)

    def _sample(self, time: float) -> int:
        """Number of the last sample before a time [s]."""
        return max(self.first, int(time / self.sampling)) if time > 0 else self.first

    def forget(self, first: int) -> None:
        """Drop the samples before number ``first``."""
        drop = first - self.first
        if drop > 0:
            self.first = first
            self.level, self.wave = self.level[drop:], self.wave[drop:]
            self.which, self.regularity = self.which[drop:], self.regularity[drop:]
            self.windowed.forget(self.which_final)
