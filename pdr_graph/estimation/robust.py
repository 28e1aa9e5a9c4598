"""How a measurement that lies many sigmas off is believed."""

from __future__ import annotations

import numpy as np

from pdr_graph.types import Array

HUBER_WIDTH = 2.45  # [σ] 95 % of honest fixes lie within, at full weight
WILD_WIDTH = 2.45  # [σ] Geman–McClure: a wild fix has a quarter of its weight there, and next to none far off


def gripping(sigmas: Array, width: float) -> Array:
    """Huber's weight ``(n,)`` of what is ``sigmas (n,)`` off, full up to ``width``: it never lets go."""
    return np.minimum(1.0, width / np.maximum(sigmas, 1e-9))


def outside(sigmas: Array, flat: float) -> Array:
    """Weight ``(n,)`` of what says nothing within ``flat`` sigmas, as GTSAM's L2WithDeadZone has it."""
    return np.maximum(0.0, 1 - flat / np.maximum(sigmas, 1e-9))


def slipping(sigmas: Array, width: float = WILD_WIDTH) -> Array:
    """Geman and McClure's weight ``(n,)``: it lets go of what is far off."""
    return (width**2 / (width**2 + sigmas**2)) ** 2
