"""Steps on stairs: as long as the treads are deep, whoever walks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pdr_graph.gait.climbing import STAIRS
from pdr_graph.inertial.barometer import Climbs
from pdr_graph.types import Steps

STRIDE = 0.63  # [m] two rises and one going
SHALLOWEST, DEEPEST = 0.22, 0.38  # [m] goings that are built
SIGMA = 0.1  # [m] of a step: landings are among them


def on_treads(steps: Steps, climbs: Climbs, kinds: tuple[str, ...]) -> Steps:
    """The steps, those on stairs as long as a tread: 0.63 m less twice what a step rises (Blondel's rule).

    A stride model knows of walking on the level only, and takes stairs for half as long again as they are.
    """
    length, sigma = steps.length.copy(), steps.sigma_length.copy()
    for start, end, height, kind in zip(climbs.start, climbs.end, climbs.height, kinds, strict=True):
        on = (steps.time > start) & (steps.time - steps.duration < end) & (steps.length > 0)
        if kind == STAIRS and on.any():
            length[on] = np.clip(STRIDE - 2 * abs(height) / np.count_nonzero(on), SHALLOWEST, DEEPEST)
            sigma[on] = SIGMA
    return replace(steps, length=length, sigma_length=sigma)
