"""Stretches of samples: means of the last so many, and where a condition held."""

from __future__ import annotations

import numpy as np

from pdr_graph.types import Array, Index, Mask


def running_mean(values: Array, count: int) -> Array:
    """Means ``(n - count + 1, k)`` of every ``count`` consecutive rows of ``values (n, k)``."""
    total = np.cumsum(values - values[0], axis=0)
    total[count:] -= total[:-count].copy()
    return values[0] + total[count - 1 :] / count


def runs(mask: Mask) -> tuple[Index, Index]:
    """First samples ``(r,)``, and those after the last ``(r,)``, of each run of True."""
    if not mask.any():
        return np.empty(0, dtype=np.intp), np.empty(0, dtype=np.intp)
    edges = np.diff(mask.astype(np.int8), prepend=0, append=0)
    return np.flatnonzero(edges > 0), np.flatnonzero(edges < 0)
