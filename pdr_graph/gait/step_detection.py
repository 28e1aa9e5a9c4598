"""The step detector: landings from an accelerometer in hand, pocket, bag or on a swinging arm; batch and live.

A stride resembles the one before. Where |a| repeats itself from stride to stride, the period of the repetition is the
duration of a step, and |a| at that frequency rises and falls once per step. This holds even if a loose phone is thrown
about several times within a step, or if one leg hardly moves the arm that holds the phone. Motion that does not repeat
itself, tilts the phone to and fro, or lifts it higher than a walking body bobs is not a step: shaking, gestures,
vehicles, standing.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d, median_filter, uniform_filter1d

from pdr_graph.types import Array, Complex, Index, Mask

SHORTEST_STEP = 0.25  # [s]
LONGEST_STEP = 1.2  # [s]; a longer interval between landings is a stop
USUAL_STEP = 0.54  # [s] typical duration of a step


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
        return float(np.median(self.period)) if len(self) else USUAL_STEP

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
    walking = np.clip(intervals, SHORTEST_STEP, LONGEST_STEP)
    walking[0] = walking[min(1, len(walking) - 1)]
    typical = median_filter(walking, size=5, mode="nearest")
    alone = intervals >= LONGEST_STEP
    alone[0] = True
    return np.where(alone, typical, intervals)


@dataclass(frozen=True)
class CandidateSettings:
    """Constants by which candidate landings are found in |a|.

    One set for all phones and grips; ``scripts/reproduce steps`` scores it. Chosen by hand unless a source is stated.

    sampling: longest interval at which the rhythm is evaluated [s]: 25 Hz; slowest: longest interval between samples
        [s]: four samples in a usual step.
    usual_spread: spread of the logarithm of a step's duration over people and paces; usual_weight: weight of that prior
        in units of a correlation.
    smoothing, level: Gaussians between which |a| is gait [s]: neither a knock nor the sway of a stride.
    window: over which |a| is correlated with itself [s]; look_ahead: the part of it after a landing [s].
    kernel: width of the Gaussian at the frequency of the steps, as a share of a step's duration.
    weakest: least amplitude of a step, peak to peak [m/s²]: a phone in a standing person's hand stays below it;
    weakest_share: least amplitude as a share of the steps around it: feet shuffle while turning.
    highest_bounce: largest vertical motion, peak to peak [m]: walkers bob by 0.02 to 0.10, arms that shake a phone move
        it by 0.15.
    tilt_smoothing, tilt_window, steadiest_tilt: the direction of gravity is smoothed by a Gaussian [s] and averaged
        over a window [s]; the length of the mean must be larger, or the phone tilts to and fro.
    """

    sampling: float = 0.04
    slowest: float = 0.14
    usual_spread: float = 0.25
    usual_weight: float = 0.3
    smoothing: float = 0.05
    level: float = 0.2
    window: float = 4.0
    look_ahead: float = 2.0
    kernel: float = 0.7
    weakest: float = 0.35
    weakest_share: float = 0.23
    highest_bounce: float = 0.14
    tilt_smoothing: float = 0.2
    tilt_window: float = 1.5
    steadiest_tilt: float = 0.96

    @property
    def reach(self) -> float:
        """Time to either side of a sample on which its smoothed |a| and tilt depend. [s]"""
        return 4 * self.tilt_smoothing + self.tilt_window / 2 + 0.1


CANDIDATE = CandidateSettings()
DURATIONS: Array = 0.36 * 1.1 ** np.arange(12, dtype=float)  # [s] durations of a step that are tried, up to 1.03 s


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


def candidates(acceleration: Array, period: float, look_ahead: float) -> Candidates:
    """Maxima of |a| at the frequency of the steps.

    acceleration ``(n, 3)`` [m/s²], one sample per period [s]; look_ahead: duration of the samples after a landing that
    are used for it [s].
    """
    smooth, steadiness = smoothed_magnitude(acceleration, period)
    return candidates_in_magnitude(smooth, steadiness, period * decimation(period), look_ahead)


def smoothed_magnitude(acceleration: Array, period: float) -> tuple[Array, Array]:
    """Smoothed |a| [m/s²] and steadiness of the vertical [0–1], both ``(m,)``, at every `decimation`-th sample."""
    stride = decimation(period)
    smooth = gaussian_filter1d(np.linalg.norm(acceleration, axis=1), CANDIDATE.smoothing / period)
    return smooth[::stride], _tilt_steadiness(acceleration, period)[::stride]


def candidates_in_magnitude(smooth: Array, steadiness: Array, sampling: float, look_ahead: float) -> Candidates:
    """`candidates` from the output of `smoothed_magnitude` ``(n,)``, one sample per ``sampling`` [s]."""
    if sampling > CANDIDATE.slowest or len(smooth) * sampling < 2.5 * DURATIONS[-1]:
        return Candidates(*(np.empty(0) for _ in range(4)), bodily=np.empty(0, dtype=bool))
    level = smooth - gaussian_filter1d(smooth, CANDIDATE.level / sampling)
    which, regularity = _rhythm(level, sampling, look_ahead)
    wave = _at_frequency(level, which, sampling)
    peaks, time = _maxima(wave, sampling)
    amplitude = 2 * np.abs(wave)
    past, future = round(CANDIDATE.look_ahead / sampling), round(look_ahead / sampling)
    shift = (past + future + 1) // 2 - future
    around = maximum_filter1d(amplitude, past + future + 1, mode="nearest", origin=shift)
    strong = (amplitude > CANDIDATE.weakest) & (amplitude > CANDIDATE.weakest_share * around)
    peaks, time = peaks[strong[peaks]], time[strong[peaks]]
    step = DURATIONS[which[peaks]]
    bodily = around[peaks] * (step / (2 * np.pi)) ** 2 < CANDIDATE.highest_bounce
    bodily &= steadiness[peaks] > CANDIDATE.steadiest_tilt
    return Candidates(time, step, amplitude[peaks], regularity[peaks], bodily)


def _rhythm(level: Array, sampling: float, look_ahead: float) -> tuple[Index, Array]:
    """The index in DURATIONS that fits best at each sample ``(n,)``, and the correlation of |a| with itself ``(n,)``.

    The signal must repeat itself after a stride, and fits better if it repeats itself after a step too: this excludes
    half and double the true duration. An unusual duration must fit better.
    """
    once, twice = (_correlations(level, durations, sampling) for durations in (DURATIONS, 2 * DURATIONS))
    unusual = (np.log(DURATIONS / USUAL_STEP) / CANDIDATE.usual_spread) ** 2 / 2
    which = np.argmax(twice + once / 2 - CANDIDATE.usual_weight * unusual[:, None], axis=0)
    samples = np.arange(len(level))
    regularity = np.maximum(once[which, samples], twice[which, samples])
    available = np.maximum(samples - round((CANDIDATE.look_ahead - look_ahead) / sampling), 0)
    return which[available], regularity[available]


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


def _at_frequency(level: Array, which: Index, sampling: float) -> Complex:
    """The analytic signal ``(n,)`` at the frequency of the steps, whose index in DURATIONS is ``which (n,)``."""
    wave = np.zeros(len(level), dtype=complex)
    for n in np.unique(which).tolist():
        here, kernel = which == n, _kernel(n, sampling)
        filtered = np.convolve(level, np.real(kernel)) + 1j * np.convolve(level, np.imag(kernel))
        wave[here] = filtered[len(kernel) // 2 :][: len(level)][here]
    return wave


@lru_cache(maxsize=256)
def _kernel(which: int, sampling: float) -> Complex:
    """Gabor kernel ``(2 reach + 1,)`` at the frequency of a step."""
    reach = round(2.5 * CANDIDATE.kernel * DURATIONS[which] / sampling)
    at = np.arange(-reach, reach + 1) * sampling / DURATIONS[which]
    window = np.exp(-((at / CANDIDATE.kernel) ** 2) / 2)
    return 2 / window.sum() * window * np.exp(2j * np.pi * at)


def _maxima(wave: Complex, sampling: float) -> tuple[Index, Array]:
    """The samples before the maxima of an analytic signal, and the interpolated times of the maxima [s]."""
    before, after = wave.imag[:-1], wave.imag[1:]
    top = np.flatnonzero((before < 0) & (after >= 0) & (wave.real[1:] > 0))
    return top, (top + before[top] / (before[top] - after[top])) * sampling


def _tilt_steadiness(acceleration: Array, period: float) -> Array:
    """Length ``(n,)`` of the mean direction of gravity in the device: 1 if the device does not tilt."""
    gravity = gaussian_filter1d(np.ascontiguousarray(acceleration.T), CANDIDATE.tilt_smoothing / period, axis=1)
    window = max(1, round(CANDIDATE.tilt_window / period))
    mean = np.linalg.norm(uniform_filter1d(gravity, window, axis=1), axis=0)
    return mean / np.maximum(uniform_filter1d(np.linalg.norm(gravity, axis=0), window), 1e-9)


def decimation(period: float) -> int:
    """Number of samples per evaluation of the rhythm, for one sample per ``period`` [s]."""
    return max(1, int(CANDIDATE.sampling / period + 1e-6))


@dataclass(frozen=True)
class BoutSettings:
    """Constants by which candidates become steps. Chosen by hand with `CandidateSettings`.

    closest_share: least interval between two landings, as a share of a step's duration.
    start, go_on: least correlation with the step or stride before, to start walking and to go on.
    vigorous, vigorous_start: from this amplitude on [m/s²] a lower correlation is enough to start: people who browse
        walk irregularly.
    push_off: a first landing weaker than this share of the following ones is none yet.
    fewest: least number of steps; fewer are a gesture.
    late: time after which it is too late to report a step [s].
    past, future: duration of the samples that a landing may depend on [s], before it and, beyond the look-ahead, after.
    """

    closest_share: float = 0.55
    start: float = 0.7
    go_on: float = 0.1
    vigorous: float = 1.5
    vigorous_start: float = 0.5
    push_off: float = 0.6
    fewest: int = 4
    late: float = 6.0
    past: float = 8.0
    future: float = 3.0


BOUT = BoutSettings()


def walking_steps(time: Array, acceleration: Array, look_ahead: float = CANDIDATE.look_ahead) -> Landings:
    """The landings of a whole recording.

    time ``(n,)`` [s] uniform; acceleration ``(n, 3)`` with gravity [m/s²]; look_ahead: see `StepDetector`.
    """
    start, period = float(time[0]), float(time[-1] - time[0]) / (len(time) - 1)
    landed, amplitude = Bout().steps(candidates(acceleration, period, look_ahead))
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
        if time - self.last > LONGEST_STEP:
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


@dataclass
class StepDetector:
    """Detects steps as samples arrive; the result equals that of `walking_steps` on the whole recording.

    period: between samples [s]; start: time of the first sample [s]; look_ahead: duration of the samples after a
    landing that are used for its rhythm and amplitude [s]. A step is certain 3 s after that. A shorter look-ahead than
    the default misses or adds a step now and then.

    decided: time since the start up to which steps are certain [s]; samples ``(n, 3)``: the last ones, the first of
    which is number ``first`` of ``count``; smoothed ``(m, 2)``: output of `smoothed_magnitude` from number
    ``smoothed_first`` on, final before number ``smoothed_final``; pending ``(c, 5)``: candidates after ``decided``.
    """

    period: float
    start: float = 0.0
    look_ahead: float = CANDIDATE.look_ahead
    decided: float = -np.inf
    bout: Bout = field(default_factory=Bout)
    samples: Array = field(default_factory=lambda: np.empty((0, 3)))
    first: int = 0
    count: int = 0
    smoothed: Array = field(default_factory=lambda: np.empty((0, 2)))
    smoothed_first: int = 0
    smoothed_final: int = 0
    pending: Array = field(default_factory=lambda: np.empty((0, 5)))

    def update(self, acceleration: Array) -> tuple[Array, Array]:
        """Add samples ``(n, 3)``; returns times ``(m,)`` [s] and amplitudes of newly certain steps."""
        self.samples = np.concatenate([self.samples, acceleration])
        self.count += len(acceleration)
        self._smooth()
        return self._decide(self.count * self.period - BOUT.future - self.look_ahead)

    def finish(self) -> tuple[Array, Array]:
        """Times [s] and amplitudes of the last steps: no more samples follow."""
        return self._decide(np.inf)

    def provisional(self) -> tuple[Array, Array]:
        """Times [s] and amplitudes of the steps after the certain ones, which later samples may still change."""
        *columns, bodily = self.pending.T
        landed, amplitude = replace(self.bout).steps(Candidates(*columns, bodily=bodily > 0))
        return self.start + landed, amplitude

    @property
    def earliest(self) -> float:
        """Earliest time at which a new landing can still be found. [s]"""
        late = [time for time, _ in self.bout.waiting if time > self.decided - BOUT.late]
        return self.start + min([self.decided, *late])

    def _smooth(self) -> None:
        """Smooth the new samples, and the last ones again: their smoothed values depend on later samples."""
        if not len(self.samples):
            return
        stride = decimation(self.period)
        reach = int(CANDIDATE.reach / self.period / stride) + 1
        fresh = np.stack(smoothed_magnitude(self.samples, self.period), axis=1)
        first = self.first // stride
        final = self.smoothed[: self.smoothed_final - self.smoothed_first]
        self.smoothed = np.concatenate([final, fresh[self.smoothed_final - first :]])
        self.smoothed_final = max(self.smoothed_final, first + len(fresh) - reach)
        drop = max(0, self.smoothed_final - reach - first)
        self.samples, self.first = self.samples[drop * stride :], self.first + drop * stride

    def _decide(self, until: float) -> tuple[Array, Array]:
        """Times and amplitudes of the steps between ``decided`` and ``until`` [s] after the start."""
        sampling = self.period * decimation(self.period)
        found = candidates_in_magnitude(self.smoothed[:, 0], self.smoothed[:, 1], sampling, self.look_ahead)
        found = replace(found, time=found.time + self.smoothed_first * sampling)
        landed, amplitude = self.bout.steps(found[(found.time > self.decided) & (found.time <= until)])
        self.decided = max(self.decided, until)
        self.pending = np.stack([values[found.time > self.decided] for values in vars(found).values()], axis=1)
        if np.isfinite(until):  # no later step depends on earlier samples
            drop = max(0, int((until - BOUT.past) / sampling) - self.smoothed_first)
            self.smoothed, self.smoothed_first = self.smoothed[drop:], self.smoothed_first + drop
        return self.start + landed, amplitude
