"""The step detector: from an accelerometer alone, in hand, pocket, bag or on a swinging arm; batch and live.

A stride is like the one before. Where |a| repeats itself from stride to stride, its rhythm tells how long a step takes;
|a| at that frequency then rises and falls once a step, however often a loose phone is thrown within a step, and however
little one leg moves the arm that holds it. Whatever does not repeat itself so, tilts the phone to and fro, or lifts it
higher than a body bobs, is no step: shaking, gestures, vehicles, standing about.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d, median_filter, uniform_filter1d

from pdr_graph.types import Array, Complex, Index, Mask

SHORTEST_STEP = 0.25  # [s]
LONGEST_STEP = 1.2  # [s]; a longer interval between landings is a stop
USUAL_STEP = 0.54  # [s] most people's


@dataclass(frozen=True)
class Landings:
    """The landings of the feet.

    time: ``(n,)`` [s]; period: ``(n,)`` time that each step took [s]; amplitude: ``(n,)`` of |a|, peak to peak [m/s²].
    """

    time: Array
    period: Array
    amplitude: Array

    @classmethod
    def at(cls, time: Array, amplitude: Array, start: float) -> Landings:
        """Landings at these times of a recording that starts at ``start`` [s]."""
        return cls(time, _periods(time, start), amplitude)

    def __len__(self) -> int:
        return len(self.time)

    @property
    def usual_step(self) -> float:
        """[s]"""
        return float(np.median(self.period)) if len(self) else USUAL_STEP

    def under_way(self, time: Array) -> Mask:
        """At which of the times ``(m,)`` the walker was taking a step."""
        if not len(self):
            return np.zeros(len(time), dtype=bool)
        leads_to = np.searchsorted(self.time, time)
        within = np.minimum(leads_to, len(self) - 1)
        return (leads_to < len(self)) & (time >= self.time[within] - self.period[within])


def _periods(landed: Array, start: float) -> Array:
    """The time each step took. For the first step and after a stop, where no landing came before: its neighbours'."""
    if not len(landed):
        return np.empty(0)
    intervals = np.diff(landed, prepend=start)
    walking = np.clip(intervals, SHORTEST_STEP, LONGEST_STEP)
    walking[0] = walking[min(1, len(walking) - 1)]
    typical = median_filter(walking, size=5, mode="nearest")
    alone = intervals >= LONGEST_STEP
    alone[0] = True
    return np.where(alone, typical, intervals)


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
HIGHEST_BOUNCE = 0.14  # [m] peak to peak; walkers bob by 0.02–0.10, arms that shake a phone move it by 0.15
UPRIGHT_SMOOTH, UPRIGHT_WINDOW, UPRIGHT = 0.2, 1.5, 0.96  # [s], [s], and the length of the mean direction of gravity
REACH = 4 * UPRIGHT_SMOOTH + UPRIGHT_WINDOW / 2 + 0.1  # [s] to either side of a sample on which what was felt depends


@dataclass(frozen=True)
class Candidates:
    """Moments ``(n,)`` at which a foot may have landed. time [s] from the first sample; step: duration of a step then.

    amplitude [m/s²], peak to peak; regular: correlation with the step or stride before; bodily: moved as bodies move.
    """

    time: Array
    step: Array
    amplitude: Array
    regular: Array
    bodily: Mask

    def __getitem__(self, which: Mask) -> Candidates:
        """Some of them."""
        return Candidates(*(values[which] for values in vars(self).values()))


def candidates(acceleration: Array, period: float, look_ahead: float) -> Candidates:
    """The moments at which |a| at the frequency of steps is highest.

    acceleration ``(n, 3)`` [m/s²], period [s] between samples; look_ahead [s] of samples after a moment that count.
    """
    smooth, upright = smoothed_magnitude(acceleration, period)
    return candidates_of(smooth, upright, period * decimation(period), look_ahead)


def smoothed_magnitude(acceleration: Array, period: float) -> tuple[Array, Array]:
    """Smoothed |a| [m/s²] and steadiness of the vertical [0–1], both ``(m,)``, at every `decimation`-th sample."""
    stride = decimation(period)
    smooth = gaussian_filter1d(np.linalg.norm(acceleration, axis=1), SMOOTH / period)
    return smooth[::stride], _upright(acceleration, period)[::stride]


def candidates_of(smooth: Array, upright: Array, sampling: float, look_ahead: float) -> Candidates:
    """`candidates`, of what was `smoothed_magnitude` ``(n,)``, every ``sampling`` [s]."""
    if sampling > SLOWEST or len(smooth) * sampling < 2.5 * STEPS[-1]:
        return Candidates(*(np.empty(0) for _ in range(4)), bodily=np.empty(0, dtype=bool))
    level = smooth - gaussian_filter1d(smooth, LEVEL / sampling)
    which, regular = _rhythm(level, sampling, look_ahead)
    wave = _at_frequency(level, which, sampling)
    peaks, time = _crossings(wave, sampling)
    amplitude = 2 * np.abs(wave)
    past, future = round(LOOK_AHEAD / sampling), round(look_ahead / sampling)
    shift = (past + future + 1) // 2 - future
    around = maximum_filter1d(amplitude, past + future + 1, mode="nearest", origin=shift)
    strong = (amplitude > WEAKEST) & (amplitude > WEAKEST_SHARE * around)
    peaks, time = peaks[strong[peaks]], time[strong[peaks]]
    step = STEPS[which[peaks]]
    bodily = around[peaks] * (step / (2 * np.pi)) ** 2 < HIGHEST_BOUNCE
    bodily &= upright[peaks] > UPRIGHT
    return Candidates(time, step, amplitude[peaks], regular[peaks], bodily)


def _rhythm(level: Array, sampling: float, look_ahead: float) -> tuple[Index, Array]:
    """Which duration of a step fits at each sample ``(n,)``, and how well |a| repeats itself then ``(n,)``.

    It must repeat itself after a stride, and the better if after a step too: no duration but the right one, its half
    and its double does. An unusual one has to fit better.
    """
    once, twice = (_correlations(level, durations, sampling) for durations in (STEPS, 2 * STEPS))
    unusual = (np.log(STEPS / USUAL_STEP) / USUAL_SPREAD) ** 2 / 2
    which = np.argmax(twice + once / 2 - USUAL_WEIGHT * unusual[:, None], axis=0)
    samples = np.arange(len(level))
    regular = np.maximum(once[which, samples], twice[which, samples])
    seen = np.maximum(samples - round((LOOK_AHEAD - look_ahead) / sampling), 0)
    return which[seen], regular[seen]


def _correlations(level: Array, lags: Array, sampling: float) -> Array:
    """Correlation ``(k, n)`` of a signal with itself each of ``lags (k,)`` [s] earlier, over RHYTHM."""
    product, power = np.zeros((2, len(lags), len(level)))
    square = level**2 / 2
    for row, apart in enumerate(np.maximum(1, np.round(lags / sampling)).astype(int).tolist()):
        middle = slice(apart // 2, len(level) - (apart - apart // 2))
        np.multiply(level[:-apart], level[apart:], out=product[row, middle])
        np.add(square[:-apart], square[apart:], out=power[row, middle])
    window = max(1, round(RHYTHM / sampling))
    product = uniform_filter1d(product, window, axis=1, mode="constant")
    return product / (uniform_filter1d(power, window, axis=1, mode="constant") + 1e-4)


def _at_frequency(level: Array, which: Index, sampling: float) -> Complex:
    """What of a signal has the frequency of the steps ``which (n,)``, under a Gaussian of SHAPE steps. ``(n,)``"""
    wave = np.zeros(len(level), dtype=complex)
    for n in np.unique(which).tolist():
        here, kernel = which == n, _kernel(n, sampling)
        filtered = np.convolve(level, np.real(kernel)) + 1j * np.convolve(level, np.imag(kernel))
        wave[here] = filtered[len(kernel) // 2 :][: len(level)][here]
    return wave


@lru_cache(maxsize=256)
def _kernel(which: int, sampling: float) -> Complex:
    """Of a step's frequency. ``(2 reach + 1,)``"""
    reach = round(2.5 * SHAPE * STEPS[which] / sampling)
    at = np.arange(-reach, reach + 1) * sampling / STEPS[which]
    window = np.exp(-((at / SHAPE) ** 2) / 2)
    return 2 / window.sum() * window * np.exp(2j * np.pi * at)


def _crossings(wave: Complex, sampling: float) -> tuple[Index, Array]:
    """The samples after which a wave is at its top, and the times of that [s]."""
    before, after = wave.imag[:-1], wave.imag[1:]
    top = np.flatnonzero((before < 0) & (after >= 0) & (wave.real[1:] > 0))
    return top, (top + before[top] / (before[top] - after[top])) * sampling


def _upright(acceleration: Array, period: float) -> Array:
    """Length ``(n,)`` of the mean of gravity's direction in the device: 1 if it does not tilt."""
    gravity = gaussian_filter1d(np.ascontiguousarray(acceleration.T), UPRIGHT_SMOOTH / period, axis=1)
    window = max(1, round(UPRIGHT_WINDOW / period))
    mean = np.linalg.norm(uniform_filter1d(gravity, window, axis=1), axis=0)
    return mean / np.maximum(uniform_filter1d(np.linalg.norm(gravity, axis=0), window), 1e-9)


def decimation(period: float) -> int:
    """At which samples, one in so many, the rhythm is looked at."""
    return max(1, int(SAMPLING / period + 1e-6))


CLOSEST_SHARE = 0.55  # of a step's duration, between two
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
    start, period = float(time[0]), float(time[-1] - time[0]) / (len(time) - 1)
    landed, amplitude = Bout().steps(candidates(acceleration, period, look_ahead))
    return Landings.at(start + landed, amplitude, start)


_Steps = list[tuple[float, float]]  # times and amplitudes


@dataclass
class Bout:
    """Who sets out is believed once their steps are regular; then every step counts until they stop."""

    walking: bool = False
    last: float = -np.inf
    waiting: _Steps = field(default_factory=list)

    def steps(self, found: Candidates) -> tuple[Array, Array]:
        """Times ``(m,)`` and amplitudes ``(m,)`` of the steps among the next candidates."""
        columns = (values.tolist() for values in vars(found).values())
        certain = [one for candidate in zip(*columns, strict=True) for one in self._take(*candidate)]
        time, amplitude = np.array(certain).reshape(-1, 2).T
        return time, amplitude

    def _take(self, time: float, step: float, amplitude: float, regular: float, bodily: bool) -> _Steps:
        """The next candidate; the steps that are certain with it."""
        if not bodily:
            self.walking, self.waiting, self.last = False, [], -np.inf
            return []
        if regular < STILL_REGULAR or time - self.last < CLOSEST_SHARE * step:
            return []
        if time - self.last > LONGEST_STEP:
            self.walking, self.waiting = False, []
        self.last = time
        self.waiting = [one for one in self.waiting if one[0] > time - LATE] + [(time, amplitude)]
        if not self.walking and regular > (VIGOROUS_REGULAR if amplitude > VIGOROUS else REGULAR):
            self._set_out()
        if not self.walking:
            return []
        certain, self.waiting = self.waiting, []
        return certain

    def _set_out(self) -> None:
        if len(self.waiting) >= FEWEST:
            usual = float(np.median([amplitude for _, amplitude in self.waiting]))
            self.waiting = self.waiting[int(self.waiting[0][1] < PUSH_OFF * usual) :]
            self.walking = True


@dataclass
class StepDetector:
    """Steps as the samples come in, the same as of the whole recording.

    period: between samples [s]; start: time of the first [s]; look_ahead: [s] after a landing whose rhythm and vigour
    count too; a step is certain FUTURE later than that. Less than the default costs a step here and there.

    decided: [s] after the start, up to which steps are certain; samples ``(n, 3)``: the last ones, the first of which
    is sample number ``first`` of ``taken``; smoothed ``(m, 2)``: from number ``smoothed_first`` on, final before
    ``settled``; open ``(c, 5)``: candidates after what is decided.
    """

    period: float
    start: float = 0.0
    look_ahead: float = LOOK_AHEAD
    decided: float = -np.inf
    bout: Bout = field(default_factory=Bout)
    samples: Array = field(default_factory=lambda: np.empty((0, 3)))
    first: int = 0
    taken: int = 0
    smoothed: Array = field(default_factory=lambda: np.empty((0, 2)))
    smoothed_first: int = 0
    settled: int = 0
    open: Array = field(default_factory=lambda: np.empty((0, 5)))

    def update(self, acceleration: Array) -> tuple[Array, Array]:
        """Take in samples ``(n, 3)``; times ``(m,)`` [s] and amplitudes ``(m,)`` of the steps that are certain now."""
        self.samples = np.concatenate([self.samples, acceleration])
        self.taken += len(acceleration)
        self._smooth()
        return self._decide(self.taken * self.period - FUTURE - self.look_ahead)

    def finish(self) -> tuple[Array, Array]:
        """The last steps, when no more samples come."""
        return self._decide(np.inf)

    def provisional(self) -> tuple[Array, Array]:
        """Times and amplitudes of the steps after those that are certain, as far as can be said by now."""
        *columns, bodily = self.open.T
        landed, amplitude = replace(self.bout).steps(Candidates(*columns, bodily=bodily > 0))
        return self.start + landed, amplitude

    @property
    def earliest(self) -> float:
        """Before this no landing can be found any more. [s]"""
        late = [time for time, _ in self.bout.waiting if time > self.decided - LATE]
        return self.start + min([self.decided, *late])

    def _smooth(self) -> None:
        """What is felt of the new samples, and of the last ones anew: it changes with those that follow them."""
        if not len(self.samples):
            return
        stride = decimation(self.period)
        reach = int(REACH / self.period / stride) + 1
        fresh = np.stack(smoothed_magnitude(self.samples, self.period), axis=1)
        first = self.first // stride
        self.smoothed = np.concatenate(
            [self.smoothed[: self.settled - self.smoothed_first], fresh[self.settled - first :]]
        )
        self.settled = max(self.settled, first + len(fresh) - reach)
        drop = max(0, self.settled - reach - first)
        self.samples, self.first = self.samples[drop * stride :], self.first + drop * stride

    def _decide(self, until: float) -> tuple[Array, Array]:
        """What lies before ``until`` [s] after the start, and was not decided before."""
        sampling = self.period * decimation(self.period)
        found = candidates_of(self.smoothed[:, 0], self.smoothed[:, 1], sampling, self.look_ahead)
        found = replace(found, time=found.time + self.smoothed_first * sampling)
        landed, amplitude = self.bout.steps(found[(found.time > self.decided) & (found.time <= until)])
        self.decided = max(self.decided, until)
        self.open = np.stack([values[found.time > self.decided] for values in vars(found).values()], axis=1)
        if np.isfinite(until):  # no later step depends on more than PAST
            drop = max(0, int((until - PAST) / sampling) - self.smoothed_first)
            self.smoothed, self.smoothed_first = self.smoothed[drop:], self.smoothed_first + drop
        return self.start + landed, amplitude
