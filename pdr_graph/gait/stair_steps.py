"""Steps on stairs are as long as the treads; batch and live.

Stride models are fitted on level ground and overestimate steps on stairs by half.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pdr_graph.inertial.barometer import STAIRS, Climbs
from pdr_graph.priors import TREADS
from pdr_graph.types import Array, Mask, Steps

ALIKE = 0.02  # [m] a smaller change of a length is not reported, live


def with_stair_lengths(steps: Steps, climbs: Climbs, kinds: tuple[str, ...]) -> Steps:
    """Shorten the steps on stairs to the depth of a tread: 0.63 m less twice the rise of a step (Blondel's rule).

    climbs, kinds: height changes and their kinds from `climb_kinds`.
    """
    return with_goings(steps, goings_of(steps, climbs, kinds), alike=0.0)


def goings_of(steps: Steps, climbs: Climbs, kinds: tuple[str, ...]) -> Array:
    """The goings of the climbs on stairs ``(k, 3)``: start and end of the climb [s], depth of a tread [m]."""
    rows = []
    for start, end, height, kind in zip(climbs.start, climbs.end, climbs.height, kinds, strict=True):
        count = np.count_nonzero(_during(steps, start, end))
        if kind == STAIRS and count:
            rows.append(
                (
                    start,
                    end,
                    np.clip(TREADS.blondel - 2 * abs(height) / count, TREADS.shortest_going, TREADS.longest_going),
                )
            )
    return np.array(rows).reshape(-1, 3)


def with_goings(steps: Steps, goings: Array, alike: float = ALIKE) -> Steps:
    """The steps with those on stairs as long as the treads, unless they are within ``alike`` [m]: then the same object.

    goings: ``(k, 3)``, see `goings_of`.
    """
    if not len(goings):
        return steps
    length, sigma = steps.length.copy(), steps.sigma_length.copy()
    for start, end, going in goings.tolist():
        on = _during(steps, start, end)
        on &= (np.abs(length - going) > alike) | (sigma != TREADS.sigma)
        length[on], sigma[on] = going, TREADS.sigma
    if np.array_equal(length, steps.length) and np.array_equal(sigma, steps.sigma_length):
        return steps
    return replace(steps, length=length, sigma_length=sigma)


def _during(steps: Steps, start: float, end: float) -> Mask:
    """``(n,)`` True for steps between two times [s]."""
    return (steps.time > start) & (steps.time - steps.duration < end) & ~steps.is_gap
