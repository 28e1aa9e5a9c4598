"""The rhythm of gait in |a|: when a foot may have landed, however a phone is carried.

A stride is like the one before. Where |a| repeats itself from stride to stride, its rhythm tells how long a step takes;
|a| at that frequency then rises and falls once a step, however often a loose phone is thrown within a step, and however
little one leg moves the arm that holds it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d, uniform_filter1d

from pdr_graph.gait.landings import USUAL_STEP
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
    smooth, upright = felt(acceleration, period)
    return candidates_of(smooth, upright, period * every(period), look_ahead)


def felt(acceleration: Array, period: float) -> tuple[Array, Array]:
    """At `every` sample, by what is within REACH: |a| without knocks [m/s²], and how steadily the device was held."""
    stride = every(period)
    smooth = gaussian_filter1d(np.linalg.norm(acceleration, axis=1), SMOOTH / period)
    return smooth[::stride], _upright(acceleration, period)[::stride]


def candidates_of(smooth: Array, upright: Array, sampling: float, look_ahead: float) -> Candidates:
    """`candidates`, of what was `felt` ``(n,)``, every ``sampling`` [s]."""
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


def every(period: float) -> int:
    """At which samples, one in so many, the rhythm is looked at."""
    return max(1, int(SAMPLING / period + 1e-6))
