"""The steps of a walk under way, for its dead reckoning."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pdr_graph.estimation.initialization import lay_dead_reckoning
from pdr_graph.gait.step_chunks import concatenate_steps
from pdr_graph.inertial.barometer import with_goings
from pdr_graph.online.interface import trajectory_of_rows
from pdr_graph.priors import FIXES
from pdr_graph.types import Array, Fixes, FixReport, Steps, Trajectory


class StepLog:
    """The steps since `forget` was last called."""

    def __init__(self) -> None:
        self._chunks = list[Steps]()

    def append(self, steps: Steps) -> None:
        """Append the next steps."""
        self._chunks.append(steps)

    def forget(self) -> None:
        """Drop all but the last steps."""
        self._chunks = self._chunks[-1:]

    def set_goings(self, goings: Array) -> None:
        """Give the steps on stairs the length of the treads. goings: ``(k, 3)``, at least one, see `goings_of`."""
        for n in range(len(self._chunks) - 1, -1, -1):
            if self._chunks[n].end < goings[0, 0]:
                return
            self._chunks[n] = with_goings(self._chunks[n], goings)

    def dead_reckoning(self, reports: Sequence[FixReport]) -> Trajectory:
        """Dead reckoning, rigidly aligned with those of the fixes that were used."""
        if not self._chunks:
            return trajectory_of_rows([])
        steps = concatenate_steps(self._chunks)
        begin = steps.start - FIXES.longest_overhang
        used = [fix for fix in reports if fix.weight > 0 and fix.time >= begin]
        place = np.array([(fix.x, fix.y) for fix in used]).reshape(-1, 2)
        time, sigma = np.array([fix.time for fix in used]), np.array([fix.sigma for fix in used])
        return lay_dead_reckoning(steps, Fixes(time, place, sigma, ("",) * len(used)))
