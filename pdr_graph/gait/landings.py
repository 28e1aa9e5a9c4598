"""When the feet landed: what every step detector returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter

from pdr_graph.types import Array, Mask

SHORTEST_STEP = 0.25  # [s]
LONGEST_STEP = 1.2  # [s]; a longer interval between landings is a stop
USUAL_STEP = 0.54  # [s] most people's


@dataclass(frozen=True)
class Landings:
    """The landings of the feet.

    time: ``(n,)`` [s]; period: ``(n,)`` time that each step took [s]; amplitude: ``(n,)`` of |a|, peak to peak [m/s²].
    """

    time: Array
    period: Array
    amplitude: Array

    @classmethod
    def at(cls, time: Array, amplitude: Array, start: float) -> Landings:
        """Landings at these times of a recording that starts at ``start`` [s]."""
        return cls(time, _periods(time, start), amplitude)

    def __len__(self) -> int:
        return len(self.time)

    @property
    def usual_step(self) -> float:
        """[s]"""
        return float(np.median(self.period)) if len(self) else USUAL_STEP

    def under_way(self, time: Array) -> Mask:
        """At which of the times ``(m,)`` the walker was taking a step."""
        if not len(self):
            return np.zeros(len(time), dtype=bool)
        leads_to = np.searchsorted(self.time, time)
        within = np.minimum(leads_to, len(self) - 1)
        return (leads_to < len(self)) & (time >= self.time[within] - self.period[within])


def _periods(landed: Array, start: float) -> Array:
    """The time each step took. For the first step and after a stop, where no landing came before: its neighbours'."""
    if not len(landed):
        return np.empty(0)
    intervals = np.diff(landed, prepend=start)
    walking = np.clip(intervals, SHORTEST_STEP, LONGEST_STEP)
    walking[0] = walking[min(1, len(walking) - 1)]
    typical = median_filter(walking, size=5, mode="nearest")
    alone = intervals >= LONGEST_STEP
    alone[0] = True
    return np.where(alone, typical, intervals)
