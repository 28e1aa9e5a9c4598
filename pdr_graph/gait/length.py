"""How long a step was. One published model, one function, each returning length and its standard deviation."""

from __future__ import annotations

import numpy as np

from pdr_graph.types import Array

REFERENCE_HEIGHT = 1.70  # [m] stature at which a model without it was fitted


def inverted_pendulum(amplitude: Array, period: Array, height: float = REFERENCE_HEIGHT) -> tuple[Array, Array]:
    """Step length from the bounce of the body (Zijlstra & Hof 2003: a leg is an inverted pendulum).

    A body that bounces with peak-to-peak acceleration A over a step of duration T rises by h ≈ A T² / (2π)², and
    the pendulum's chord grows with √h: L = k₀ + k₁ √A T. k₁ is fitted between the surveyed waypoints of 15 walks in
    two malls (``scripts/reproduce stride``). k₀ is half a step, more than the fit's own 0.22: how hard a foot lands
    depends on shoes, floor and pocket too, and is trusted by half. Both scale with stature.

    amplitude: ``(n,)`` of ``peak_pairs`` [m/s²]; period: ``(n,)`` [s]; height: stature [m].
    Returns length ``(n,)`` and its standard deviation ``(n,)`` [m], beyond the walker's own scale R_s.
    """
    length = (0.34 + 0.27 * np.sqrt(amplitude) * period) * height / REFERENCE_HEIGHT
    length = np.clip(length, 0.2, 1.2)
    return length, 0.3 * length
