"""Published step detectors and walking directions, for comparison with those of `gait`.

A step detector takes an `Attitude` and returns `Landings`. Some also take the forward acceleration ``(n,)`` [m/s²] of
`heading.forward_acceleration`. The others have the signatures of `gait.heading`: a forward-axis method returns a
`Forward`, a direction method a `Direction`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib import resources
from itertools import pairwise

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d

from pdr_graph.errors import InputError, install
from pdr_graph.gait.heading import UNKNOWN_AXIS, Direction, Forward, at_step_frequency, level_and_vertical, push
from pdr_graph.gait.step_detection import Landings
from pdr_graph.inertial.attitude import Attitude
from pdr_graph.lab.papers.attitude_filters import running_mean
from pdr_graph.priors import FORWARD, IRREGULARITY, STEP
from pdr_graph.types import Array, Index, Mask

# [s] standard deviation of the Gaussian over |a|: half power at 1.9 Hz, where people walk; heel strikes ring at 10 Hz
SMOOTHING = 0.07


def peak_pairs(attitude: Attitude, threshold: float = 1.0) -> Landings:
    """[map-matching] Sec. 3.2: steps are maxima of smoothed |a| whose height over the minima beside them is large.

    threshold: of the height [m/s²]; the paper states no value.
    """
    smooth, peaks = _peaks_of_magnitude(attitude)
    before, after = _lowest_beside(smooth, peaks)
    height = smooth[peaks] - (smooth[before] + smooth[after]) / 2
    return _landings(attitude, peaks[height > threshold], height[height > threshold])


LONGEST = 1.2  # [s] interval between the landings of a walk
RISE = 0.7  # [m/s²] of |a| from a trough; [calibration-walk] states no value


def trough_to_peak(attitude: Attitude, threshold: float = RISE) -> Landings:
    """Candidates of [calibration-walk] Sec. 3.1: |a| falls, then rises by more than a threshold [m/s²]."""
    smooth, peaks = _peaks_of_magnitude(attitude)
    trough = smooth[_lowest_beside(smooth, peaks)[0]]
    height = smooth[peaks] - trough
    on = (height > threshold) & (trough < np.median(smooth) - 0.3)
    return _landings(attitude, peaks[on], height[on])


def without_closing(attitude: Attitude, forward: Array, threshold: float = RISE) -> Landings:
    """[calibration-walk] Sec. 3.1: candidates except those that only bring the feet together.

    Unlike in the paper, only candidates that no other follows are compared. Requires the extra ``gait``, else
    InputError.
    """
    candidates = trough_to_peak(attitude, threshold)
    on = ~closing(candidates, attitude, forward)
    return _landings_at(candidates.time[on], candidates.amplitude[on], attitude)


def closing(landings: Landings, attitude: Attitude, forward: Array, every: bool = False) -> Mask:
    """``(n,)`` True for landings that only bring the feet together: [calibration-walk] Sec. 3.1, Eqs. (2) to (5).

    The forward acceleration of a landing is compared by dynamic time warping with two templates: of walking, where it
    falls strongly after its rise, since the other foot moves on; and of closing feet, where it only rises.

    every: compare every landing, as the paper does, instead of those that no other follows within `LONGEST`. Requires
    the extra ``gait``, else InputError.
    """
    try:
        from dtaidistance import dtw
    except ImportError:
        raise InputError("dtaidistance", "", "it is not installed", install("gait")) from None
    compared = np.full(len(landings), True) if every else np.diff(landings.time, append=np.inf) >= LONGEST
    shapes = forward_shapes(attitude, forward, landings)
    walking, together = templates().T
    closes = np.zeros(len(landings), dtype=bool)
    for n in np.flatnonzero(compared):  # one shape may be ahead of the other by two points
        to_walking, to_closing = (
            dtw.distance(shapes[n], template, window=2, use_c=True) for template in (walking, together)
        )
        closes[n] = to_walking > to_closing
    return closes


def vertical_forward(attitude: Attitude, forward: Array) -> Landings:
    """[gps-dr] Sec. 2.2: a positive, then a negative peak of the vertical acceleration; in the forward acceleration a
    negative, then a positive peak, with a slope between these above a threshold.

    The paper states no thresholds; here 0.5 m/s² and 1 m/s³, and the second peak of a pair follows within 0.4 s.
    """
    sigma = SMOOTHING / attitude.period
    vertical = gaussian_filter1d(attitude.R_world_device.apply(attitude.acceleration)[:, 2], sigma)
    along = gaussian_filter1d(forward, sigma)
    reach = max(1, round(0.4 / attitude.period))
    landed, height = list[int](), list[float]()
    for peak in _peaks(vertical, attitude.period).tolist():
        low = peak + int(np.argmin(vertical[peak : peak + reach]))
        brake = peak + int(np.argmin(along[peak : peak + reach]))
        rise = brake + int(np.argmax(along[brake : brake + reach]))
        slope = (along[rise] - along[brake]) / max((rise - brake) * attitude.period, 1e-9)
        if vertical[peak] - vertical[low] > 0.5 and rise > brake and slope > 1.0:
            landed.append(peak)
            height.append(float(vertical[peak] - vertical[low]))
    return _landings(attitude, np.array(landed, dtype=int), np.array(height))


POINTS = 21  # that are compared, over half a step to either side of a peak


def forward_shapes(attitude: Attitude, forward: Array, landings: Landings) -> Array:
    """The forward acceleration around each landing ``(n, POINTS)``, normalised to zero mean and unit variance."""
    smooth = gaussian_filter1d(forward, SMOOTHING / 2 / attitude.period)
    at = landings.time[:, None] + np.linspace(-0.5, 0.5, POINTS) * landings.usual_step
    shapes = np.interp(at, attitude.time, smooth)
    size = np.maximum(shapes.std(axis=1, keepdims=True), 1e-9)
    return (shapes - shapes.mean(axis=1, keepdims=True)) / size


@cache
def templates() -> Array:
    """The templates of walking and of closing feet ``(POINTS, 2)`` (``scripts/templates`` at commit 7d5000e)."""
    with resources.files("pdr_graph.lab.papers").joinpath("templates.csv").open() as file:
        return np.loadtxt(file, delimiter=",", skiprows=1)


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
    return _landings_at(attitude.time[peaks], height, attitude)


def _landings_at(time: Array, amplitude: Array, attitude: Attitude) -> Landings:
    """Landings without a rhythm and without doubt, as regular as usual."""
    columns = np.broadcast_arrays(time, amplitude, STEP.usual, 1.0, IRREGULARITY.usual)
    return Landings.at(np.stack(columns, axis=1), float(attitude.time[0]))


PRINCIPAL_WINDOW = 2.6  # [s] of the principal components: [heading] has N = 65 samples at 25 Hz


@dataclass(frozen=True)
class PrincipalDirection(Direction):
    """A direction by a principal component. axis: heading of the first sample in the world, modulo π [rad]."""

    axis: float


def principal_axis(attitude: Attitude, heading: Array, walking: Mask, step: float) -> Forward:
    """[gps-dr] Sec. 2: the first principal component of the level acceleration over a short straight walk.

    Its half turn, which the paper does not mention, is resolved by the step pattern of its Sec. 2.2 (after the
    vertical + → − the forward − → +), by the lead as in `braking_axis`.
    """
    if not walking.any():
        return UNKNOWN_AXIS
    level = level_and_vertical(attitude, heading)[0][walking]
    level = level - level.mean()
    doubled = np.mean(level**2)  # the axis of the largest variance, at twice its angle
    roundness = 1 - np.abs(doubled) / np.mean(np.abs(level) ** 2)  # 1 if the variance is equal in all directions
    axis = np.exp(0.5j * np.angle(doubled))
    harmonic, vertical = (signal[walking] for signal in at_step_frequency(attitude, heading, step))
    ahead = np.real(push(harmonic, vertical) / axis)
    angle = np.angle(axis * (1 if ahead > 0 else -1))
    return Forward(float(angle), float(np.hypot(FORWARD.gait_sigma, roundness * np.pi / 4)))


def accumulate_turn(attitude: Attitude, step: float) -> Direction:
    """Integrate the angular rate about gravity: [heading] Sec. 4.3, Eq. (1): θ_i = θ_{i-1} + ω_{z,i} ΔT_i.

    As in the paper it includes the sway of the gait; `step` is not used.
    """
    heading = np.cumsum(attitude.R_world_device.apply(attitude.angular_rate)[:, 2]) * attitude.period
    return Direction(heading - heading[0], np.zeros(len(heading)))


def acceleration_axis(
    attitude: Attitude, step: float, window: float = PRINCIPAL_WINDOW, axes: int = 2
) -> PrincipalDirection:
    """[heading] Sec. 4.1, [gps-dr] Sec. 2: the first principal component of the last seconds' acceleration.

    Its half-turn ambiguity is resolved towards the sample before, so that one wrong side persists. It lags by half the
    window; `step` is not used.

    window [s]; axes: 2 for level components, as in [gps-dr] and in the figure of [heading]; 3 as in the text of
    [heading], with which the first component of most walks is their bounce.
    """
    samples = attitude.R_world_device.apply(attitude.acceleration)
    return _principal(samples[:, :axes], 0, round(window / attitude.period))


def angular_rate_axis(
    attitude: Attitude, step: float, window: float = PRINCIPAL_WINDOW, axes: int = 2
) -> PrincipalDirection:
    """[heading] Sec. 4.2: the second principal component of the last seconds' angular rate; as `acceleration_axis`."""
    samples = attitude.R_world_device.apply(attitude.angular_rate)
    return _principal(samples[:, :axes], 1, round(window / attitude.period))


def _principal(samples: Array, component: int, window: int) -> PrincipalDirection:
    """The horizontal direction of a principal component of trailing windows of samples ``(n, 2 or 3)``."""
    axes, window = samples.shape[1], max(2, min(window, len(samples)))
    products = np.einsum("ni,nj->nij", samples, samples).reshape(-1, axes**2)
    full = (running_mean(values, window) for values in (samples, products))  # before it is full, the first window's
    mean, square = (np.concatenate([np.repeat(values[:1], window - 1, axis=0), values]) for values in full)
    covariance = square.reshape(-1, axes, axes) - np.einsum("ni,nj->nij", mean, mean)
    axis = np.linalg.eigh(covariance)[1][:, :, axes - 1 - component]
    course = np.unwrap(np.arctan2(axis[:, 1], axis[:, 0]), period=np.pi)
    return PrincipalDirection(course - course[0], np.zeros(len(course)), float(course[0]))
