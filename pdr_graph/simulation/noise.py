"""Random processes that more than one part of the simulator draws."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter

from pdr_graph.types import Array


def slow(random: np.random.Generator, count: int, length: float, sigma: float, columns: int = 1) -> Array:
    """Smooth noise ``(count, columns)`` of standard deviation ``sigma`` that changes over ``length`` samples."""
    width = length / 2
    every = max(1, int(width / 6))  # a long wave needs few points
    points = np.arange(-4, count // every + 6) * every
    white = random.normal(size=(len(points), columns))
    if length < 1:
        return sigma * white[4 : count + 4]
    width = width / every
    # a Gaussian filter of this width leaves white noise with 1/√(2 √π width) of its standard deviation
    waves = gaussian_filter1d(white, width, axis=0, mode="wrap") * np.sqrt(2 * width * np.sqrt(np.pi))
    return sigma * CubicSpline(points, waves)(np.arange(count)) if every > 1 else sigma * waves[4 : count + 4]


def autoregressive(random: np.random.Generator, count: int, keep: float, sigma: float, columns: int = 1) -> Array:
    """First-order autoregressive noise ``(count, columns)`` of standard deviation ``sigma``, stationary from the start.

    keep: correlation of neighbours, 0–1.
    """
    white = random.normal(0, sigma * np.sqrt(1 - keep**2), (count, columns))
    if count:
        white[0] /= np.sqrt(1 - keep**2)
    return np.asarray(lfilter([1.0], [1.0, -keep], white, axis=0))
