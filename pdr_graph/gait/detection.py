"""Our own step detector: from an accelerometer alone, in hand, pocket, bag or on a swinging arm, live or afterwards.

Gait is regular: a stride is like the one before. Where |a| repeats itself from stride to stride, its rhythm tells how
long a step takes; |a| at that frequency then rises and falls once a step, however often a loose phone is thrown within
a step, and however little one leg moves the arm that holds it. Whatever does not repeat itself, tilts the phone to and
fro, or lifts it higher than a body bobs, is no gait: shaking, gestures, vehicles, standing about.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d, uniform_filter1d
from scipy.signal import oaconvolve

from pdr_graph.gait.landings import LONGEST_STEP, USUAL_STEP, Landings
from pdr_graph.types import Array, Complex, Index, Mask

SAMPLING = 0.04  # [s] at which the rhythm is looked at, at most: 25 Hz
STEPS: Array = 0.36 * 1.1 ** np.arange(12, dtype=float)  # [s] durations of a step that are looked for, to 1.03 s
USUAL_SPREAD = 0.25  # of the logarithm of a step's duration, over people and paces
USUAL_WEIGHT = 0.3  # of that, in units of a correlation
SLOWEST = 0.14  # [s] between samples: four in a usual step
SMOOTH, LEVEL = 0.05, 0.2  # [s] Gaussians between which |a| is gait, not a knock nor a stride's sway
RHYTHM = 4.0  # [s] over which |a| is compared with itself
LOOK_AHEAD = 2.0  # [s] of that after a landing
SHAPE = 0.7  # of a step's duration: the Gaussian under which a step is seen
WEAKEST = 0.35  # [m/s²] peak to peak; a phone in a standing person's hand stays below
WEAKEST_SHARE = 0.23  # of the steps about it; feet shuffle while turning
CLOSEST_SHARE = 0.55  # of a step's duration, between two
HIGHEST_BOUNCE = 0.14  # [m] peak to peak; walkers bob by 0.02–0.10, arms that shake a phone move it by 0.15
UPRIGHT_SMOOTH, UPRIGHT_WINDOW, UPRIGHT = 0.2, 1.5, 0.96  # [s], [s], and the length of the mean direction of gravity
REGULAR, STILL_REGULAR = 0.7, 0.1  # correlation with the step or stride before: to set out, and to go on
VIGOROUS, VIGOROUS_REGULAR = 1.5, 0.5  # [m/s²] from which on less is enough to set out: who browses is irregular
PUSH_OFF = 0.6  # of the steps that follow: a weaker first one is no landing yet
FEWEST = 4  # steps; less is a gesture
LATE = 6.0  # [s] after which it is too late to say that somebody walked
PAST, FUTURE = 8.0, 3.0  # [s] of samples before a landing that it may depend on; and after it, beyond the look-ahead


def walking_steps(time: Array, acceleration: Array, look_ahead: float = LOOK_AHEAD) -> Landings:
    """The landings of a whole recording.

    time ``(n,)`` [s] uniform; acceleration ``(n, 3)`` with gravity [m/s²]; look_ahead: see `StepDetector`.
    """
    detector = StepDetector(float(time[-1] - time[0]) / (len(time) - 1), float(time[0]), look_ahead)
    candidates = _candidates(acceleration, detector.period, look_ahead)
    landed, amplitude = detector.accept(candidates, detector.start)
    return Landings.at(landed, amplitude, detector.start)


class StepDetector:
    """Steps as the samples come in, the same as of the whole recording.

    period: between samples [s]; start: time of the first [s]; look_ahead: [s] after a landing whose rhythm and vigour
    count too; a step is certain FUTURE later than that. Less than the default costs a step here and there.
    """

    def __init__(self, period: float, start: float = 0.0, look_ahead: float = LOOK_AHEAD):
        self.period, self.start, self.look_ahead = period, start, look_ahead
        self._samples, self._first, self._decided = np.empty((0, 3)), 0, -np.inf
        self._bout = _Bout()

    def update(self, acceleration: Array) -> tuple[Array, Array]:
        """Take in samples ``(n, 3)``; times ``(m,)`` [s] and amplitudes ``(m,)`` of the steps that are certain now."""
        self._samples = np.concatenate([self._samples, acceleration])
        return self._decide((self._first + len(self._samples)) * self.period - FUTURE - self.look_ahead)

    def finish(self) -> tuple[Array, Array]:
        """The last steps, when no more samples come."""
        return self._decide(np.inf)

    def accept(self, candidates: _Candidates, begin: float) -> tuple[Array, Array]:
        """Times and amplitudes of those candidates that are steps. begin: what their times are counted from [s]."""
        rows = [row for n in range(len(candidates.time)) for row in self._bout.take(candidates.row(n, begin))]
        return np.array([time for time, _ in rows]), np.array([amplitude for _, amplitude in rows])

    def _decide(self, until: float) -> tuple[Array, Array]:
        """What lies before ``until`` [s] after the start, and was not decided before."""
        begin = self._first * self.period
        found = _candidates(self._samples, self.period, self.look_ahead)
        new = (found.time + begin > self._decided) & (found.time + begin <= until)
        self._decided = max(self._decided, until)
        keep = max(0, int((until - PAST) / self.period) - self._first) if np.isfinite(until) else 0
        keep -= keep % _stride(self.period)
        self._samples, self._first = self._samples[keep:], self._first + keep
        return self.accept(found[new], self.start + begin)


@dataclass(frozen=True)
class _Candidates:
    """Moments ``(n,)`` at which a foot may have landed. time [s] from the first sample; step: duration of a step then.

    amplitude [m/s²]; regular: correlation with the step or stride before; bodily: moved as a body moves it.
    """

    time: Array
    step: Array
    amplitude: Array
    regular: Array
    bodily: Mask

    def __getitem__(self, which: Mask) -> _Candidates:
        return _Candidates(*(values[which] for values in vars(self).values()))

    def row(self, n: int, begin: float) -> _Candidate:
        """One of them."""
        time, amplitude, step = float(self.time[n]) + begin, float(self.amplitude[n]), float(self.step[n])
        return _Candidate(time, step, amplitude, float(self.regular[n]), bool(self.bodily[n]))


@dataclass(frozen=True)
class _Candidate:
    time: float
    step: float
    amplitude: float
    regular: float
    bodily: bool


@dataclass
class _Bout:
    """Who sets out is believed once their steps are regular; then every step counts until they stop."""

    walking: bool = False
    last: float = -np.inf
    waiting: list[_Candidate] = field(default_factory=list)

    def take(self, candidate: _Candidate) -> list[tuple[float, float]]:
        """The next candidate in time; times and amplitudes of the steps that are certain with it."""
        apart = candidate.time - self.last
        if not candidate.bodily:
            self.walking, self.waiting, self.last = False, [], -np.inf
            return []
        if candidate.regular < STILL_REGULAR:
            return []
        if apart < CLOSEST_SHARE * candidate.step:
            return []
        if apart > LONGEST_STEP:
            self.walking, self.waiting = False, []
        self.last = candidate.time
        self.waiting = [one for one in self.waiting if one.time > candidate.time - LATE] + [candidate]
        regular = VIGOROUS_REGULAR if candidate.amplitude > VIGOROUS else REGULAR
        if not self.walking and len(self.waiting) >= FEWEST and candidate.regular > regular:
            self.walking, usual = True, float(np.median([one.amplitude for one in self.waiting]))
            self.waiting = self.waiting[int(self.waiting[0].amplitude < PUSH_OFF * usual) :]
        if not self.walking:
            return []
        certain, self.waiting = self.waiting, []
        return [(one.time, one.amplitude) for one in certain]


def _candidates(acceleration: Array, period: float, look_ahead: float) -> _Candidates:
    """Where |a| at the frequency of steps is highest."""
    stride, steps = _stride(period), STEPS
    if period > SLOWEST or len(acceleration) * period < 2.5 * steps[-1]:
        return _Candidates(*(np.empty(0) for _ in range(4)), bodily=np.empty(0, dtype=bool))
    smooth = gaussian_filter1d(np.linalg.norm(acceleration, axis=1), SMOOTH / period)[::stride]
    sampling = period * stride
    level = smooth - gaussian_filter1d(smooth, LEVEL / sampling)
    which, regular = _rhythm(level, steps, sampling, look_ahead)
    wave = _at_frequency(level, steps, which, sampling)
    peaks, time = _crossings(wave, sampling)
    amplitude = 2 * np.abs(wave)
    past, future = round(LOOK_AHEAD / sampling), round(look_ahead / sampling)
    shift = (past + future + 1) // 2 - future
    around = maximum_filter1d(amplitude, past + future + 1, mode="nearest", origin=shift)
    strong = (amplitude > WEAKEST) & (amplitude > WEAKEST_SHARE * around)
    peaks, time = peaks[strong[peaks]], time[strong[peaks]]
    step = steps[which[peaks]]
    bodily = around[peaks] * (step / (2 * np.pi)) ** 2 < HIGHEST_BOUNCE
    bodily &= _upright(acceleration, period)[::stride][peaks] > UPRIGHT
    return _Candidates(time, step, amplitude[peaks], regular[peaks], bodily)


def _rhythm(level: Array, steps: Array, sampling: float, look_ahead: float) -> tuple[Index, Array]:
    """Which duration of a step fits at each sample ``(n,)``, and how well |a| repeats itself then ``(n,)``.

    It must repeat itself after a stride, and the better if after a step too: no duration but the right one, its half
    and its double does. An unusual one has to fit better.
    """
    once, twice = (np.array([_correlation(level, s, sampling) for s in d]) for d in (steps, 2 * steps))
    unusual = (np.log(steps / USUAL_STEP) / USUAL_SPREAD) ** 2 / 2
    which = np.argmax(twice + once / 2 - USUAL_WEIGHT * unusual[:, None], axis=0)
    samples = np.arange(len(level))
    regular = np.maximum(once[which, samples], twice[which, samples])
    seen = np.maximum(samples - round((LOOK_AHEAD - look_ahead) / sampling), 0)
    return which[seen], regular[seen]


def _correlation(level: Array, lag: float, sampling: float) -> Array:
    """Correlation ``(n,)`` of a signal with itself ``lag`` [s] earlier, over RHYTHM."""
    apart = max(1, round(lag / sampling))
    product, power = np.zeros(len(level)), np.zeros(len(level))
    middle = slice(apart // 2, len(level) - (apart - apart // 2))
    product[middle] = level[:-apart] * level[apart:]
    power[middle] = (level[:-apart] ** 2 + level[apart:] ** 2) / 2
    window = max(1, round(RHYTHM / sampling))
    return uniform_filter1d(product, window, mode="constant") / (
        uniform_filter1d(power, window, mode="constant") + 1e-4
    )


def _at_frequency(level: Array, steps: Array, which: Index, sampling: float) -> Complex:
    """What of a signal has the frequency of the steps ``which (n,)``, under a Gaussian of SHAPE steps. ``(n,)``"""
    wave = np.zeros(len(level), dtype=complex)
    for n, step in enumerate(steps):
        here = which == n
        if here.any():
            reach = round(2.5 * SHAPE * step / sampling)
            at = np.arange(-reach, reach + 1) * sampling / step
            window = np.exp(-((at / SHAPE) ** 2) / 2)
            kernel = 2 / window.sum() * window * np.exp(2j * np.pi * at)
            wave[here] = oaconvolve(level, kernel)[reach : reach + len(level)][here]
    return wave


def _crossings(wave: Complex, sampling: float) -> tuple[Index, Array]:
    """The samples after which a wave is at its top, and the times of that [s]."""
    before, after = wave.imag[:-1], wave.imag[1:]
    top = np.flatnonzero((before < 0) & (after >= 0) & (wave.real[1:] > 0))
    return top, (top + before[top] / (before[top] - after[top])) * sampling


def _upright(acceleration: Array, period: float) -> Array:
    """Length ``(n,)`` of the mean of gravity's direction in the device: 1 if it does not tilt."""
    gravity = gaussian_filter1d(acceleration, UPRIGHT_SMOOTH / period, axis=0)
    window = max(1, round(UPRIGHT_WINDOW / period))
    mean = np.linalg.norm(uniform_filter1d(gravity, window, axis=0), axis=1)
    return mean / np.maximum(uniform_filter1d(np.linalg.norm(gravity, axis=1), window), 1e-9)


def _stride(period: float) -> int:
    """Every how many samples the rhythm is looked at."""
    return max(1, int(SAMPLING / period + 1e-6))
