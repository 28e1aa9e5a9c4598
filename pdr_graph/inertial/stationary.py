"""When the phone is at rest, and what its gyroscope says then: its bias."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import uniform_filter1d

from pdr_graph.geometry import interpolate
from pdr_graph.inertial.windows import runs
from pdr_graph.types import Array, Mask

WINDOW = 0.5  # [s] over which the spread of the samples is taken
STILL_RATE, STILL_ACCELERATION = 0.012, 0.10  # [rad/s], [m/s²] spread on a table: twice the noise of cheap sensors
SHORTEST_REST = 1.5  # [s]; for a moment anything is at rest
LARGEST_BIAS = 0.2  # [rad/s]; a phone that turns as evenly as a table stands is on a turntable, or in a car
DRIFT_TIME = 60.0  # [s] over which a bias is the mean of what was seen of it: it follows the temperature


def at_rest(angular_rate: Array, acceleration: Array, period: float) -> Mask:
    """Rest ``(n,)`` without any calibration: neither sensor's samples spread more than on a table.

    A phone in a standing person's hand is not at rest. The level of neither sensor is used, so that a bias or a
    scale error does not matter; what turns evenly by more than LARGEST_BIAS is not at rest either.

    angular_rate ``(n, 3)`` [rad/s], acceleration ``(n, 3)`` [m/s²], period: between samples [s].
    """
    samples = max(3, round(WINDOW / period))
    still = _spread(angular_rate, samples) < STILL_RATE
    still &= _spread(acceleration, samples) < STILL_ACCELERATION
    still &= np.linalg.norm(uniform_filter1d(angular_rate, samples, axis=0), axis=1) < LARGEST_BIAS
    return _lasting(still, max(1, round(SHORTEST_REST / period)))


def learnt_threshold(angular_rate: Array) -> float:
    """λ [rad/s] of [stationary-switch] Sec. 2.5: the largest |ω| of samples ``(n, 3)`` that were taken at rest."""
    return float(np.linalg.norm(angular_rate, axis=1).max())


def below_threshold(angular_rate: Array, threshold: float, samples: int = 1) -> Mask:
    """Rest ``(n,)`` as [stationary-switch] Sec. 2.5 has it: |ω| ≤ λ, for at least so many samples in a row.

    The paper has one; a rattling cart is below λ for single samples now and then.
    """
    below = np.linalg.norm(angular_rate, axis=1) <= threshold
    return _lasting(below, max(1, samples))


def bias_from_rests(angular_rate: Array, rest: Mask, period: float) -> Array:
    """Bias ``(n, 3)`` of a gyroscope [rad/s]: what it says at rest, followed linearly between rests; 0 without one."""
    if not rest.any():
        return np.zeros_like(angular_rate)
    samples, seen = max(1, round(DRIFT_TIME / period)), np.flatnonzero(rest)
    weight = uniform_filter1d(rest.astype(float), samples, mode="constant")
    weighted = uniform_filter1d(angular_rate * rest[:, None], samples, axis=0, mode="constant")
    said = weighted[seen] / weight[seen, None]
    return interpolate(np.arange(float(len(rest))), seen.astype(float), said)


def _lasting(mask: Mask, samples: int) -> Mask:
    """The runs of True that are at least so long."""
    lasting = np.zeros(len(mask), dtype=bool)
    for first, after in zip(*runs(mask), strict=True):
        lasting[first:after] = after - first >= samples
    return lasting


def _spread(values: Array, samples: int) -> Array:
    """Standard deviation ``(n,)`` over a moving window, of all axes together."""
    level = values - np.median(values, axis=0)
    mean = uniform_filter1d(level, samples, axis=0, mode="nearest")
    square = uniform_filter1d(level**2, samples, axis=0, mode="nearest")
    return np.sqrt(np.maximum(square - mean**2, 0).sum(axis=1))
