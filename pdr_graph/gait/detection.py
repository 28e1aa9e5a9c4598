"""When the feet landed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d, median_filter

from pdr_graph.types import Array, Index

SMOOTHING = (
    0.07  # [s] of the Gaussian over |a|: half power at 1.9 Hz, where people walk; the heel strike rings at 10 Hz
)
SHORTEST_STEP = 0.25  # [s]
LONGEST_STEP = 1.0  # [s]; a longer interval between landings is a stop
WEAKEST_STEP = 1.0  # [m/s²] peak to peak; a phone in a standing person's hand stays below
WEAKEST_SHARE = 0.3  # of the steps around it; foot shuffles while turning are weaker


@dataclass(frozen=True)
class Landings:
    """The landings of the feet.

    time: ``(n,)`` [s]; period: ``(n,)`` time that each step took [s]; amplitude: ``(n,)`` of |a|, peak to peak [m/s²].
    """

    time: Array
    period: Array
    amplitude: Array


def peak_pairs(time: Array, acceleration: Array) -> Landings:
    """Steps as peak pairs of the smoothed magnitude of acceleration ([map-matching] Sec. 3.2).

    A landing is a maximum of |a| together with the minimum before or after it. Where the paper has one fixed
    threshold, the pair must exceed both a floor and a share of the pairs around it, so that a soft walker counts and
    a hard walker's shuffling does not.

    time ``(n,)`` [s] uniform; acceleration ``(n, 3)`` with gravity [m/s²].
    """
    rate = (len(time) - 1) / (time[-1] - time[0])
    smooth = gaussian_filter1d(np.linalg.norm(acceleration, axis=1), SMOOTHING * rate)
    highest = maximum_filter1d(smooth, 2 * round(SHORTEST_STEP / 2 * rate) + 1) == smooth
    peaks = 1 + np.flatnonzero(highest[1:-1] & (np.diff(smooth)[:-1] > 0))
    reach = round(LONGEST_STEP / 2 * rate)
    peaks = peaks[_peak_to_peak(smooth, peaks, reach) > WEAKEST_STEP]
    amplitude = _peak_to_peak(smooth, peaks, reach)
    peaks = peaks[amplitude > WEAKEST_SHARE * median_filter(amplitude, size=9, mode="nearest")]
    amplitude = _peak_to_peak(smooth, peaks, reach)
    return Landings(time[peaks], _periods(time[peaks], start=time[0]), amplitude)


def _peak_to_peak(smooth: Array, peaks: Index, reach: int) -> Array:
    """Height of each peak over the mean of the lowest samples before and after it, no further than its neighbours."""
    ends = np.concatenate([[0], peaks, [len(smooth) - 1]])
    before, after = np.maximum(ends[:-2], peaks - reach), np.minimum(ends[2:], peaks + reach)
    troughs = [
        (smooth[b : p + 1].min() + smooth[p : a + 1].min()) / 2 for b, p, a in zip(before, peaks, after, strict=True)
    ]
    return smooth[peaks] - np.asarray(troughs)


def _periods(landings: Array, start: float) -> Array:
    """The time each step took. For the first step and after a stop, where no landing came before: its neighbours'."""
    if not len(landings):
        return np.empty(0)
    intervals = np.diff(landings, prepend=start)
    walking = np.clip(intervals, SHORTEST_STEP, LONGEST_STEP)
    walking[0] = walking[min(1, len(walking) - 1)]
    typical = median_filter(walking, size=5, mode="nearest")
    alone = intervals >= LONGEST_STEP
    alone[0] = True
    return np.where(alone, typical, intervals)
