"""Published step detectors, for comparison; the rest of the package uses `step_detection.walking_steps`.

Each takes an `Attitude` and returns `Landings`. Some also take the forward acceleration ``(n,)`` [m/s²] of
`heading.forward_acceleration`.
"""

from __future__ import annotations

from functools import cache
from importlib import resources
from itertools import pairwise

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d

from pdr_graph.errors import InputError, install
from pdr_graph.gait.step_detection import Landings
from pdr_graph.inertial.attitude import Attitude
from pdr_graph.priors import STEP
from pdr_graph.types import Array, Index

# [s] standard deviation of the Gaussian over |a|: half power at 1.9 Hz, where people walk; heel strikes ring at 10 Hz
SMOOTHING = 0.07
PEAK_PAIR = 1.0  # [m/s²] from trough to peak of |a|; [map-matching] states no value, chosen by hand


def peak_pairs(attitude: Attitude, threshold: float = PEAK_PAIR) -> Landings:
    """[map-matching] Sec. 3.2: steps are maxima of smoothed |a| whose height over the minima beside them is large.

    threshold: of the height [m/s²].
    """
    smooth, peaks = _peaks_of_magnitude(attitude)
    before, after = _lowest_beside(smooth, peaks)
    height = smooth[peaks] - (smooth[before] + smooth[after]) / 2
    return _landings(attitude, peaks[height > threshold], height[height > threshold])


FALL, RISE = 0.3, 0.7  # [m/s²] of |a|: below its median, and up from there; [calibration-walk] states no values


def trough_to_peak(attitude: Attitude, threshold: float = RISE) -> Landings:
    """Candidates of [calibration-walk] Sec. 3.1: |a| falls, then rises by more than a threshold [m/s²]."""
    smooth, peaks = _peaks_of_magnitude(attitude)
    trough = smooth[_lowest_beside(smooth, peaks)[0]]
    height = smooth[peaks] - trough
    on = (height > threshold) & (trough < np.median(smooth) - FALL)
    return _landings(attitude, peaks[on], height[on])


def without_closing(attitude: Attitude, forward: Array, threshold: float = RISE) -> Landings:
    """[calibration-walk] Sec. 3.1, Eqs. (2) to (5): candidates except those that only bring the feet together.

    The forward acceleration of a candidate is compared by dynamic time warping with two templates: of walking, where
    it falls strongly after its rise, since the other foot moves on; and of closing feet, where it only rises. Unlike
    in the paper, only candidates that no other follows are compared. Requires the extra ``gait``, else InputError.
    """
    candidates = trough_to_peak(attitude, threshold)
    shapes = forward_shapes(attitude, forward, candidates)
    walking, together = templates().T
    on = np.diff(candidates.time, append=np.inf) < STEP.longest
    for n in np.flatnonzero(~on):
        on[n] = _warped_distance(shapes[n], walking) <= _warped_distance(shapes[n], together)
    return Landings.at(candidates.time[on], candidates.amplitude[on], float(attitude.time[0]))


VERTICAL_PAIR, FORWARD_SLOPE = 0.5, 1.0  # [m/s²], [m/s³]; [gps-dr] states no values, chosen by hand
FOLLOWS = 0.4  # [s] within which the second peak of a pair follows


def vertical_forward(attitude: Attitude, forward: Array) -> Landings:
    """[gps-dr] Sec. 2.2: a positive, then a negative peak of the vertical acceleration; in the forward acceleration a
    negative, then a positive peak, with a slope between these above a threshold.
    """
    sigma = SMOOTHING / attitude.period
    vertical = gaussian_filter1d(attitude.R_world_device.apply(attitude.acceleration)[:, 2], sigma)
    along = gaussian_filter1d(forward, sigma)
    reach = max(1, round(FOLLOWS / attitude.period))
    landed, height = list[int](), list[float]()
    for peak in _peaks(vertical, attitude.period).tolist():
        low = peak + int(np.argmin(vertical[peak : peak + reach]))
        brake = peak + int(np.argmin(along[peak : peak + reach]))
        push = brake + int(np.argmax(along[brake : brake + reach]))
        slope = (along[push] - along[brake]) / max((push - brake) * attitude.period, 1e-9)
        if vertical[peak] - vertical[low] > VERTICAL_PAIR and push > brake and slope > FORWARD_SLOPE:
            landed.append(peak)
            height.append(float(vertical[peak] - vertical[low]))
    return _landings(attitude, np.array(landed, dtype=int), np.array(height))


REACH, POINTS = 0.5, 21  # steps to either side of a peak that are compared; number of points


def forward_shapes(attitude: Attitude, forward: Array, landings: Landings) -> Array:
    """The forward acceleration around each landing ``(n, POINTS)``, normalised to zero mean and unit variance."""
    smooth = gaussian_filter1d(forward, SMOOTHING / 2 / attitude.period)
    at = landings.time[:, None] + np.linspace(-REACH, REACH, POINTS) * landings.usual_step
    shapes = np.interp(at, attitude.time, smooth)
    size = np.maximum(shapes.std(axis=1, keepdims=True), 1e-9)
    return (shapes - shapes.mean(axis=1, keepdims=True)) / size


@cache
def templates() -> Array:
    """The templates of walking and of closing feet ``(POINTS, 2)``: means of 40 simulated walks.

    ``scripts/templates`` at commit 7d5000e made them.
    """
    with resources.files("pdr_graph.lab.papers").joinpath("templates.csv").open() as file:
        return np.loadtxt(file, delimiter=",", skiprows=1)


WARP = 2  # points by which one shape may be ahead of the other


def _warped_distance(shape: Array, template: Array) -> float:
    """The distance of two shapes by dynamic time warping."""
    try:
        from dtaidistance import dtw
    except ImportError:
        raise InputError("dtaidistance", "", "it is not installed", install("gait")) from None
    return float(dtw.distance(shape, template, window=WARP, use_c=True))


def _peaks_of_magnitude(attitude: Attitude) -> tuple[Array, Index]:
    """The smoothed magnitude of the acceleration ``(n,)`` [m/s²] and the samples of its peaks."""
    smooth = gaussian_filter1d(np.linalg.norm(attitude.acceleration, axis=1), SMOOTHING / attitude.period)
    return smooth, _peaks(smooth, attitude.period)


def _peaks(smooth: Array, period: float) -> Index:
    """Maxima that are the highest for half the shortest step to either side."""
    highest = maximum_filter1d(smooth, 2 * round(STEP.shortest / 2 / period) + 1) == smooth
    return 1 + np.flatnonzero(highest[1:-1] & (np.diff(smooth)[:-1] > 0))


def _lowest_beside(smooth: Array, peaks: Index) -> tuple[Index, Index]:
    """The lowest samples before and after each peak, up to the peaks beside it."""
    ends = [0, *peaks.tolist(), len(smooth) - 1]
    lowest = np.array([a + np.argmin(smooth[a : b + 1]) for a, b in pairwise(ends)], dtype=int)
    return lowest[:-1], lowest[1:]


def _landings(attitude: Attitude, peaks: Index, height: Array) -> Landings:
    """Landings at the samples `peaks`, with their amplitudes [m/s²]."""
    return Landings.at(attitude.time[peaks], height, float(attitude.time[0]))
