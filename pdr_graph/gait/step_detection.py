"""The step detector: landings from an accelerometer in hand, pocket, bag or on a swinging arm.

A stride resembles the last stride. Where |a| repeats itself from stride to stride, the period of the repetition is the
duration of a step, and |a| at that frequency rises and falls once per step. This holds even if a loose phone is thrown
about several times within a step, or if one leg hardly moves the arm that holds the phone. The sway from foot to foot,
which comes back after a stride and not after a step, counts as well. The walk itself teaches the walker's rhythm and
amplitude, by which single steps at doors are steps and weak shuffles are not. Motion that does not repeat
itself, tilts the phone to and fro, or lifts it higher than a walking body bobs is not a step: shaking, gestures,
vehicles, standing.

There is one detector, `StepDetector`, for samples as they arrive. It computes the candidates of the last seconds anew
with each block of samples. A whole recording is a few long blocks.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache
from math import log

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d, uniform_filter1d

from pdr_graph.gait.rhythm import CORRELATED, DURATIONS, USUAL, lengths_of, rhythm_of
from pdr_graph.priors import BOUT, CANDIDATE, CONFIDENCE, IRREGULARITY, MOVEMENT, STAND, STEP
from pdr_graph.types import Array, Index, Mask


@dataclass(frozen=True)
class Landings:
    """The landings of the feet.

    time: ``(n,)`` [s]; period: ``(n,)`` duration of each step [s]; amplitude: ``(n,)`` of |a|, peak to peak [m/s²];
    rhythm: ``(n,)`` duration of a step around it [s]; confidence: ``(n,)`` probability that it is a step.
    irregularity: ``(n,)`` mean change of the duration from step to step [log].
    """

    time: Array
    period: Array
    amplitude: Array
    rhythm: Array
    confidence: Array
    irregularity: Array

    @classmethod
    def at(cls, found: Array, start: float) -> Landings:
        """Landings ``(n, 5)`` of a recording that starts at ``start`` [s]: the columns of `Bout.steps`.

        The first step, and each step after a stop, takes the duration of its neighbours.
        """
        time, *others = found.T
        intervals = np.diff(time, prepend=start)
        walking = np.clip(intervals, STEP.shortest, STEP.longest)
        walking[:1] = walking[:2][-1:]
        beside = np.clip(np.arange(len(walking))[:, None] + np.arange(-2, 3), 0, len(walking) - 1)
        usual = np.median(walking[beside], axis=1) if len(walking) else walking
        stopped = intervals > STEP.pause * np.maximum(usual, STEP.usual)
        stopped[:1] = True
        intervals[stopped] = usual[stopped]
        return cls(time, intervals, *others)

    def __getitem__(self, which: slice) -> Landings:
        """A part of the landings."""
        return Landings(**{name: values[which] for name, values in vars(self).items()})

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


@dataclass(frozen=True)
class Candidates:
    """Candidate landings ``(n,)``.

    time: since the first sample [s]; step: duration of a step at that time [s]; amplitude: peak to peak [m/s²];
    regularity: correlation with the step or the stride before, and of the sway with the stride before; bodily: True if
    a walking body can move so.
    """

    time: Array
    step: Array
    amplitude: Array
    regularity: Array
    bodily: Mask

    def __getitem__(self, which: Mask) -> Candidates:
        """The candidates that a mask ``(n,)`` selects."""
        return Candidates(**{name: values[which] for name, values in vars(self).items()})


SHORTEST = 2.5  # [s] of samples in which steps are sought
COARSEST = 0.14  # [s] longest interval between their samples: four in a usual step
NEEDED_BEFORE, NEEDED_AFTER = 9.0, 4.5  # [s] of samples around a landing, and its look-ahead, on which it may depend
TOO_LATE = 6.0  # [s] after a landing, when it is too late to report its step
NO_CANDIDATES = Candidates(*(np.empty(0) for _ in range(4)), bodily=np.empty(0, dtype=bool))


def candidates(acceleration: Array, period: float, look_ahead: float) -> Candidates:
    """Maxima of |a| at the frequency of the steps.

    acceleration ``(n, 3)`` [m/s²], one sample per period [s]; look_ahead: duration of the samples after a landing that
    are used for it [s].
    """
    stride = decimation(period)
    sampling = period * stride
    if sampling > COARSEST or len(acceleration) * period < SHORTEST:
        return NO_CANDIDATES
    signals = np.vstack([acceleration.T, lengths_of(acceleration.T)])
    *gravity, smooth = gaussian_filter1d(signals, CANDIDATE.smoothing / period, axis=1)[:, ::stride]
    width = np.sqrt(0.2**2 - CANDIDATE.smoothing**2)  # [s] 0.2 with what the samples are smoothed by
    steady = gaussian_filter1d(np.stack(gravity), width / sampling, axis=1)
    mean = np.vstack([steady, lengths_of(steady)])
    mean = uniform_filter1d(mean, max(1, round(1.5 / sampling)), axis=1)
    steadiness = lengths_of(mean[:3]) / np.maximum(mean[3], 1e-9)  # 1 if the device does not tilt

    # Without the sway of a stride, below four times that Gaussian. Slow steps are soft: both are twice as wide for them
    softer = gaussian_filter1d(smooth, np.sqrt(2**2 - 1) * CANDIDATE.smoothing / sampling)
    level = smooth - gaussian_filter1d(smooth, 4 * CANDIDATE.smoothing / sampling)
    slow_level = softer - gaussian_filter1d(softer, 8 * CANDIDATE.smoothing / sampling)
    which, regularity = rhythm_of(level, slow_level, steady, sampling)
    jar = _jar(signals[3], period)[::stride]
    available = np.maximum(np.arange(len(smooth)) - round((CANDIDATE.look_ahead - look_ahead) / sampling), 0)
    which, regularity, jar = which[available], regularity[available], jar[available]

    # The maxima of the analytic signal at the frequency of the steps: samples before them, and interpolated times
    wave = _wave(level, slow_level, which, sampling)
    before, after = wave.imag[:-1], wave.imag[1:]
    peaks = np.flatnonzero((before < 0) & (after >= 0) & (wave.real[1:] > 0))
    time = (peaks + before[peaks] / (before[peaks] - after[peaks])) * sampling

    # Those that are high enough, and whether a walking body can move so: it hardly tilts, and bobs little
    amplitude = 2 * np.abs(wave)
    past, future = round(CANDIDATE.look_ahead / sampling), round(look_ahead / sampling)
    shift = (past + future + 1) // 2 - future
    around = maximum_filter1d(amplitude, past + future + 1, mode="nearest", origin=shift)
    strong = (amplitude > CANDIDATE.weakest) & (amplitude > CANDIDATE.weakest_share * around)
    peaks, time = peaks[strong[peaks]], time[strong[peaks]]
    step = DURATIONS[which[peaks]]
    bodily = around[peaks] * (step / (2 * np.pi)) ** 2 < CANDIDATE.highest_bounce
    bodily &= steadiness[peaks] > CANDIDATE.steadiest_tilt
    jar = jar[peaks]
    bodily &= jar > CANDIDATE.least_jar  # who waves or swings an arm moves smoothly
    bodily &= jar > CANDIDATE.jar_share * amplitude[peaks]
    return Candidates(time, step, amplitude[peaks], regularity[peaks], bodily)


def _jar(magnitude: Array, period: float) -> Array:
    """Root mean square ``(n,)`` of |a| above the frequencies of walking, in which landings jar [m/s²].

    Infinite if the samples have no such frequencies.
    """
    if period > CANDIDATE.smoothing:
        return np.full(len(magnitude), np.inf)
    above = gaussian_filter1d(magnitude, 0.3 * CANDIDATE.smoothing / period)
    for _ in range(2):  # once lets a sixteenth of the bounce itself through, which an arm that swings has too
        above -= gaussian_filter1d(above, CANDIDATE.smoothing / period)
    return np.sqrt(np.maximum(uniform_filter1d(above * above, max(1, round(CORRELATED / period))), 0))


def decimation(period: float) -> int:
    """Number of samples per evaluation of the rhythm, for one sample per ``period`` [s]."""
    return max(1, int(CANDIDATE.sampling / period + 1e-6))


def _wave(level: Array, slow_level: Array, which: Index, sampling: float) -> Array:
    """The analytic signal of |a| ``(n,)`` at the durations of a step with the indices ``which (n,)`` in DURATIONS."""
    wave = np.zeros(len(which), dtype=complex)
    kernels = _kernels(sampling, CANDIDATE.kernel, CANDIDATE.slow_kernel)
    for number in np.flatnonzero(np.bincount(which)):
        rows, kernel = np.flatnonzero(which == number), kernels[number]
        padded = np.pad(level if number < len(USUAL) else slow_level, kernel.shape[1] // 2)
        padded = padded[rows[0] : rows[-1] + kernel.shape[1]]
        real, imaginary = (np.correlate(padded, part)[rows - rows[0]] for part in kernel)
        wave[rows] = real + 1j * imaginary
    return wave


@lru_cache(maxsize=64)
def _kernels(sampling: float, usual: float, slow: float) -> list[Array]:
    """Gabor kernels ``(2, 2 reach + 1)`` at the frequency of each of DURATIONS, real and imaginary part.

    usual, slow: widths for usual and slow steps, in steps.
    """
    kernels = []
    for number, duration in enumerate(DURATIONS.tolist()):
        width = usual if number < len(USUAL) else slow
        reach = round(2.5 * width * duration / sampling)
        at = np.arange(-reach, reach + 1) * sampling / duration
        window = np.exp(-((at / width) ** 2) / 2)
        kernel = 2 / window.sum() * window * np.exp(2j * np.pi * at)
        kernels.append(np.stack([kernel.real, -kernel.imag]))
    return kernels


@dataclass
class Bout:
    """A bout of walking: it starts with regular steps, and then every candidate is a step until the walker stops.

    The walker's rhythm and amplitude are learned on the way. For some seconds after steps that were regular, a single
    step in the same rhythm continues the walk, as at doors; and a candidate much weaker than the walker's steps must
    be regular, as shuffles and rides are not.

    walking: True within a bout; last: time of the last candidate [s]; waiting: times, amplitudes, durations of a step
    and regularities of the candidates before the bout starts. landed: time of the last step [s]; duration: of that
    step [s]; irregularity: mean change of the duration from step to step [log]. amplitude, rhythm:
    mean logarithms of the amplitude [m/s²] and of the duration [s] of the last regular steps; learned: number of these;
    regular: time of the last of them [s].
    """

    walking: bool = False
    last: float = -np.inf
    waiting: list[tuple[float, float, float, float]] = field(default_factory=list)
    landed: float = -np.inf
    duration: float = 0.0
    irregularity: float = field(default_factory=lambda: IRREGULARITY.usual)
    amplitude: float = 0.0
    rhythm: float = 0.0
    learned: int = 0
    regular: float = -np.inf

    def steps(self, following: Candidates) -> Array:
        """The steps ``(m, 5)`` among the next candidates: time [s], amplitude [m/s²], rhythm [s], confidence and
        irregularity.
        """
        certain = list[tuple[float, float, float, float]]()
        columns = (values.tolist() for values in vars(following).values())
        for time, step, amplitude, regularity, bodily in zip(*columns, strict=True):
            if not bodily:
                self.walking, self.waiting, self.last = False, [], -np.inf
                continue
            weak = log(amplitude) < self.amplitude + log(BOUT.weak_share)
            needed = BOUT.weak_regularity if weak else BOUT.go_on
            if regularity < needed or time - self.last < BOUT.closest_share * step:
                continue
            if time - self.last > STEP.pause * max(step, STEP.usual):
                self.walking, self.waiting = False, []
            self.last = time
            self.waiting = [w for w in self.waiting if w[0] > time - TOO_LATE] + [(time, amplitude, step, regularity)]
            recently = time - self.regular < BOUT.remembered
            if not self.walking and recently and abs(log(step) - self.rhythm) < CANDIDATE.usual_spread:
                self.walking = True
            last = [regular for *_, regular in self.waiting[-BOUT.fewest :]]
            if not self.walking and len(last) == BOUT.fewest and sum(last) > BOUT.start * len(last):
                usual = float(np.median([a for _, a, *_ in self.waiting]))
                self.waiting = self.waiting[int(self.waiting[0][1] < BOUT.push_off * usual) :]
                self.walking = True
            if self.walking:
                for landing in self.waiting:
                    self._learn(*landing)
                certain += self.waiting
                self.waiting = []
        time, amplitude, rhythm, regularity = np.array(certain).reshape(-1, 4).T
        irregularity = np.array([self._irregularity(*landing) for landing in zip(time, rhythm, strict=True)])
        return np.stack([time, amplitude, rhythm, confidence_of(regularity), irregularity], axis=1)

    def _learn(self, time: float, amplitude: float, step: float, regularity: float) -> None:
        """Learn the walker's amplitude [m/s²] and duration of a step [s] from a regular step."""
        if regularity > BOUT.start:
            self.regular, self.learned = time, min(self.learned + 1, BOUT.memory)
            self.amplitude += (log(amplitude) - self.amplitude) / self.learned
            self.rhythm += (log(step) - self.rhythm) / self.learned

    def _irregularity(self, time: float, rhythm: float) -> float:
        """The irregularity up to a step that lands at ``time`` [s]: exponentially weighted."""
        duration = time - self.landed
        if duration > STEP.pause * max(rhythm, STEP.usual):  # a stop
            duration = rhythm
        change = min(abs(log(duration / (self.duration or duration))), IRREGULARITY.largest)
        self.irregularity += (change - self.irregularity) / IRREGULARITY.steps
        self.landed, self.duration = time, duration
        return self.irregularity


def confidence_of(regularity: Array) -> Array:
    """Probability ``(n,)`` that what is accepted with such a regularity is a step: a logistic regression."""
    irregular = np.maximum(CONFIDENCE.regular - regularity, 0)
    return 1 / (1 + np.exp(CONFIDENCE.irregular * irregular - CONFIDENCE.usual))


@dataclass
class StepDetector:
    """Detects steps as samples arrive.

    period: between samples [s]; start: time of the first sample [s]; look_ahead: duration of the samples after a
    landing that are used for its rhythm and amplitude [s]. A step is certain 4.5 s after that. A shorter look-ahead
    than the default misses or adds a step now and then.

    samples: ``(n, 3)`` the last samples; first: number of the first of them; decided: time since the start up to which
    steps are certain [s]; pending: candidates after it.
    """

    period: float
    start: float = 0.0
    look_ahead: float = CANDIDATE.look_ahead
    bout: Bout = field(default_factory=Bout)
    samples: Array = field(default_factory=lambda: np.empty((0, 3)))
    first: int = 0
    decided: float = -np.inf
    pending: Candidates = NO_CANDIDATES

    def update(self, acceleration: Array) -> Array:
        """Add samples ``(n, 3)``; returns the newly certain steps ``(m, 5)``, see `Bout.steps`."""
        needed = int(max(0.0, self.decided - NEEDED_BEFORE) / self.period)
        grid = 4 * decimation(self.period)  # of the sway of slow steps
        drop = needed // grid * grid - self.first
        self.samples, self.first = np.concatenate([self.samples[drop:], acceleration]), self.first + drop
        found = candidates(self.samples, self.period, self.look_ahead)
        found = replace(found, time=found.time + self.first * self.period)
        self.pending = found[found.time > self.decided]
        return self._decide((self.first + len(self.samples)) * self.period - NEEDED_AFTER - self.look_ahead)

    def finish(self) -> Array:
        """The last steps ``(m, 5)``: no more samples follow."""
        return self._decide(np.inf)

    def provisional(self) -> Array:
        """The steps ``(m, 5)`` after the certain steps, which later samples may still change."""
        return self._since_start(replace(self.bout).steps(self.pending))

    @property
    def earliest(self) -> float:
        """Earliest time at which a new landing can still be found. [s]"""
        late = [time for time, *_ in self.bout.waiting if time > self.decided - TOO_LATE]
        return self.start + min([self.decided, *late])

    def _decide(self, until: float) -> Array:
        """The steps ``(m, 5)`` up to ``until`` [s] after the start among the pending candidates."""
        self.decided = max(self.decided, until)
        certain = self.pending.time <= until
        found = self.bout.steps(self.pending[certain])
        self.pending = self.pending[~certain]
        return self._since_start(found)

    def _since_start(self, found: Array) -> Array:
        found[:, 0] += self.start
        return found


def walking_steps(time: Array, acceleration: Array, look_ahead: float = CANDIDATE.look_ahead) -> Landings:
    """The landings of a whole recording.

    time ``(n,)`` [s] uniform; acceleration ``(n, 3)`` with gravity [m/s²]; look_ahead: see `StepDetector`.
    """
    start, period = float(time[0]), float(time[-1] - time[0]) / (len(time) - 1)
    detector = StepDetector(period, start, look_ahead)
    size = round(300.0 / period)  # five minutes at once are quickest, and the memory does not grow
    blocks = [detector.update(acceleration[first : first + size]) for first in range(0, len(time), size)]
    return Landings.at(np.concatenate([*blocks, detector.finish()]), start)


PARTS = 10  # of a second, whose means are compared: vehicles and taps shake a device faster


@dataclass
class UnrecognisedMovement:
    """Finds movement without a step: long ones of any kind, and seconds that move like the walker's steps.

    A step ends a long movement, and so do `STAND.seconds` of rest.

    period: between samples [s]; lasting: time for which the present movement without a step has lasted [s]; rest: time
    since it was last seen [s]; magnitude, walking: ``(m,)`` the samples that do not fill a second yet. usual: mean
    spread of |a| within the seconds of steps [m/s²]; stepped: number of these; seconds: number of all seconds so far.
    """

    period: float
    lasting: float = 0.0
    rest: float = 0.0
    usual: float = 0.0
    stepped: int = 0
    seconds: int = 0
    magnitude: Array = field(default_factory=lambda: np.empty(0))
    walking: Mask = field(default_factory=lambda: np.empty(0, dtype=bool))

    def update(self, acceleration: Array, walking: Mask) -> tuple[float, Array]:
        """Add samples ``(n, 3)`` [m/s²]; returns the time that long movements without a step gained [s], and the ends
        ``(k,)`` of seconds that moved like steps without one, since the first sample [s].

        walking: ``(n,)`` True during a step.
        """
        magnitude = np.append(self.magnitude, np.linalg.norm(acceleration, axis=1))
        walking = np.append(self.walking, walking)
        size = PARTS * max(1, round(1.0 / PARTS / self.period))
        whole, second = len(magnitude) // size * size, size * self.period
        spread = magnitude[:whole].reshape(-1, PARTS, size // PARTS).mean(axis=2).std(axis=1)
        stepped = walking[:whole].reshape(-1, size).any(axis=1)
        self.magnitude, self.walking = magnitude[whole:], walking[whole:]
        gained, missed = 0.0, list[float]()
        for strength, steps in np.column_stack([spread, stepped]).tolist():
            self.seconds, self.stepped = self.seconds + 1, self.stepped + int(steps)
            self.usual += (strength - self.usual) / self.stepped if steps else 0.0
            moves = strength > STAND.quiet
            if moves and not steps and self.stepped and strength > MOVEMENT.like_steps * self.usual:
                missed.append(self.seconds * second)
            before, self.rest = self.lasting, 0.0 if moves else self.rest + second
            goes_on = not steps and self.rest < STAND.seconds and (moves or before > 0)
            self.lasting = before + second if goes_on else 0.0
            if self.lasting >= MOVEMENT.longest:
                gained += self.lasting - (before if before >= MOVEMENT.longest else 0.0)
        return gained, np.array(missed)
