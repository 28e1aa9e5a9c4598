"""The rhythm of a walk or run: the duration of a step at each moment, 0.27 to 2 s, and how regular the steps are.

Usual steps, up to 0.7 s, repeat |a| from stride to stride; those of a run are shorter and stronger. Slow steps are
weak, soft and less regular: their filters are twice as long.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import uniform_filter1d

from pdr_graph.priors import CANDIDATE, STEP
from pdr_graph.types import Array, Index

USUAL: Array = 0.36 * 1.1 ** np.arange(-3.0, 8.0)  # [s] durations of usual steps that are tried, 0.27 to 0.70 s
RUNNING = USUAL < 0.35  # [s] steps of a run
OCTAVE = 6  # number of durations of slow steps in a factor of two
SLOW: Array = 0.78 * 2 ** (np.arange(9, dtype=float) / OCTAVE)  # [s] those of slow steps, up to 1.97 s
DURATIONS: Array = np.concatenate([USUAL, SLOW])
FLAT = 0.01  # [m/s²] |a| that varies less is constant
CORRELATED = 4.0  # [s] window over which |a| is correlated with itself, and its power taken


def rhythm_of(level: Array, slow_level: Array, steady: Array, sampling: float) -> tuple[Index, Array]:
    """Index in DURATIONS of the duration of a step at each sample, and regularity of the steps, both ``(n,)``.

    level, slow_level ``(n,)``: |a| about its mean, filtered for usual and for slow steps [m/s²]; steady ``(3, n)``:
    smooth acceleration [m/s²]; sampling: between the samples [s].
    """
    every = min(2, max(1, int(2 * CANDIDATE.sampling / sampling + 1e-6)))  # slow steps need fewer samples
    sway = _sway(steady[:, :: 2 * every], 2 * every * sampling)
    score, usual, regularity, repeated = _usual_rhythm(level, sampling, sway, 2 * every * sampling)
    slow = _slow_rhythm(slow_level[::every], sway, every * sampling)
    slow_score, slow, slow_regularity = (np.repeat(values, every)[: len(level)] for values in slow)
    slower = slow_score - CANDIDATE.sway_weight * np.maximum(repeated, 0) > score
    return np.where(slower, len(USUAL) + slow, usual), np.where(slower, slow_regularity, regularity)


def _usual_rhythm(level: Array, sampling: float, sway: Array, between: float) -> tuple[Array, Index, Array, Array]:
    """Score of the best of USUAL at each sample, its index, the regularity, and the correlation after a step ``(n,)``.

    The signal must repeat itself after a stride, and fits better if it repeats itself after a step too: this excludes
    half and double the true duration. An unusual duration must fit better, and so must a bounce too small for a walk.
    The stronger |a| varies, the shorter are usual steps: no body bobs more than a runner. The ``sway (3, k)``
    of the body, or of the limb that carries the phone, repeats itself after a stride and not after a step [m/s²];
    between: its samples [s].
    """
    lags = np.concatenate([USUAL, 2 * USUAL])
    once, twice = np.split(_correlation(level[None], lags, sampling, FLAT), 2)
    above = np.log(_bounce(level, np.array(STEP.usual), sampling) / CANDIDATE.run_bounce)
    longer = np.log(USUAL / STEP.usual)[:, None] + np.maximum(above, 0) / 2
    score = twice + once / 2 - 0.3 * (longer / CANDIDATE.usual_spread) ** 2 / 2  # a prior worth 0.3 at one spread
    bobbing = np.maximum(2 * longer, 0) * (above > 0)
    swayed = np.repeat(_correlation(sway, lags, between, CANDIDATE.sway_noise), round(between / sampling), 1)
    after_step, after_stride = np.split(swayed[:, : len(level)], 2)
    swaying = CANDIDATE.sway_weight * (after_stride - after_step) / 2
    score += swaying
    flying = _bounce(level, USUAL[RUNNING][:, None], sampling) / CANDIDATE.usual_bounce
    score[RUNNING] += np.log(np.minimum(flying, 1.0))
    which, at = np.argmax(score - bobbing, axis=0), np.arange(len(level))
    regularity = np.maximum(once[which, at], twice[which, at])
    bounce = _bounce(level, np.maximum(USUAL[which], STEP.usual), sampling)
    too_small = (1 - regularity) * np.log(np.minimum(bounce / CANDIDATE.usual_bounce, 1.0))
    score = score[which, at] + CANDIDATE.bounce_weight * too_small
    return score, which, regularity + np.maximum(swaying[which, at], 0), once[which, at]


def _slow_rhythm(level: Array, sway: Array, sampling: float) -> tuple[Array, Index, Array]:
    """Score of the best of SLOW at each sample, its index, and the regularity of the steps, all ``(n,)``.

    The body sways from foot to foot: the horizontal acceleration ``sway (3, n / 2)`` repeats itself after a stride, and
    not after a step. If it repeats itself after a "step" too, that is the stride of a usual walk, with the phone on a
    swinging arm or leg.
    """
    lags = SLOW[0] * 2 ** (np.arange(len(SLOW) + OCTAVE) / OCTAVE)  # a step to two of the longest
    rhythm = _correlation(level[None], lags, sampling, FLAT)
    once, twice = rhythm[: len(SLOW)], rhythm[OCTAVE:]
    swayed = _correlation(sway, lags, 2 * sampling, CANDIDATE.sway_noise)
    swayed = np.repeat(swayed, 2, axis=1)[:, : len(level)]
    after_step, after_stride = swayed[: len(SLOW)], swayed[OCTAVE:]
    swaying = CANDIDATE.sway_weight * (after_stride - after_step) / 2
    bounce = _bounce(level, SLOW[:, None], sampling)
    unusual = np.abs(np.log(bounce / CANDIDATE.slow_bounce)) - CANDIDATE.bounce_spread
    score = CANDIDATE.rhythm_weight * (once + twice) + swaying - CANDIDATE.slow_penalty
    score -= CANDIDATE.sway_weight * np.maximum(after_step, 0) + CANDIDATE.bounce_weight * np.maximum(unusual, 0)
    which, at = np.argmax(score, axis=0), np.arange(len(level))
    regularity = CANDIDATE.rhythm_weight * np.maximum(once, twice) + swaying
    return score[which, at], which, regularity[which, at]


def _bounce(level: Array, duration: Array, sampling: float) -> Array:
    """Vertical motion of the body, peak to peak, if |a| varies as ``level (n,)`` [m/s²] and steps last so long. [m]"""
    window = max(1, round(CORRELATED / sampling))
    swing = np.sqrt(8 * uniform_filter1d(level * level, window, mode="constant") + FLAT**2)
    return swing * (duration / (2 * np.pi)) ** 2


def _sway(steady: Array, sampling: float) -> Array:
    """Horizontal part ``(3, n)`` of smooth accelerations about their mean over 3 s, in axes of the device. [m/s²]"""
    window = max(1, round(3.0 / sampling))
    mean = uniform_filter1d(steady, window, axis=1)
    up = mean / np.maximum(lengths_of(mean), 1e-9)
    sway = steady - mean
    return sway - up * np.sum(sway * up, axis=0)


def _correlation(signals: Array, lags: Array, sampling: float, noise: float) -> Array:
    """Correlation ``(k, n)`` of signals ``(m, n)`` with themselves at lags ``(k,)`` [s], within a window.

    noise: standard deviation below which the signals count as noise [m/s²].
    """
    count = signals.shape[1]
    power = np.einsum("ij,ij->j", signals, signals) / 2
    sums = np.zeros((2, len(lags), count))
    for row, apart in enumerate(np.maximum(1, np.round(lags / sampling)).astype(int).tolist()):
        if apart < count:
            between = slice(apart // 2, count - (apart - apart // 2))
            np.einsum("ij,ij->j", signals[:, :-apart], signals[:, apart:], out=sums[0, row, between])
            np.add(power[:-apart], power[apart:], out=sums[1, row, between])
    window = max(1, round(CORRELATED / sampling))
    uniform_filter1d(sums, window, axis=2, mode="constant", output=sums)
    return sums[0] / (sums[1] + noise**2)


def lengths_of(vectors: Array) -> Array:
    """Lengths ``(n,)`` of vectors ``(3, n)``; `np.linalg.norm` takes three times as long for a few of them."""
    x, y, z = vectors
    return np.sqrt(x * x + y * y + z * z)
