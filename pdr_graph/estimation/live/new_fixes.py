"""Fixes that a walk under way does not expect: each is an outlier first, and the batch is asked for another way."""

from __future__ import annotations

import numpy as np

from pdr_graph.estimation.factors.base import poses_at
from pdr_graph.estimation.factors.fixes import FixFactor
from pdr_graph.estimation.factors.receivers import sourced
from pdr_graph.estimation.live.alternative_paths import AlternativePaths
from pdr_graph.estimation.live.measurement_log import Decisions
from pdr_graph.estimation.live.prediction import beyond_gate, predict
from pdr_graph.estimation.live.step_buffer import CLOSE
from pdr_graph.priors import SCHEDULE
from pdr_graph.types import Fixes, Index, Mask

DOUBTED, DOUBTED_BEHIND_WALL = 3.0, 1.0  # [σ] of a fix from the walk, beyond which the batch is asked; chosen by hand


class NewFixes(AlternativePaths):
    """The tests of fixes when they arrive; base class of `LiveSmoother`."""

    def _unexpected_fixes(self) -> Index:
        """Numbers of the fixes since the last keyframe that are beyond the gate of the predicted position.

        The errors of a receiver's fixes are common: its jumps are for `GnssBias`.
        """
        window, fixes, numbers = self.graph.window, self.graph.log.rows(Fixes), self.graph.log.numbers("fixes")
        if not self.sure or fixes is None or numbers is None:
            return np.empty(0, dtype=np.intp)
        new = (fixes.time > window.times[-1] + CLOSE) & (fixes.time <= window.steps.end) & ~sourced(fixes)
        return numbers[[n for n in np.flatnonzero(new).tolist() if self._is_beyond_gate(fixes[n])]]

    def _is_beyond_gate(self, fix: Fixes) -> bool:
        """True if a fix after the last keyframe is beyond the gate of the position predicted from there."""
        steps, begin = self.graph.window.steps, self.graph.window.times[-1]
        way = predict(self.keyframe_belief(), steps.whole, steps.start, begin, float(fix.time[0]), ())
        return beyond_gate(way, fix.position[0], float(fix.sigma[0]))

    def _doubt_new_fixes(self) -> None:
        """Ask the batch for another way if a new fix is far from the present one, or behind a wall."""
        graph, window = self.graph, self.graph.window
        now, fixes, numbers = window.times[-1], graph.log.rows(Fixes), graph.log.numbers("fixes")
        if not self.sure or fixes is None or numbers is None or not self._trial.idle or now < self.next_batch:
            return
        within = (fixes.time >= window.times[0]) & (fixes.time <= now + CLOSE)
        new = np.flatnonzero(within & ~np.isin(numbers, self._asked.get("fixes", ())))
        self._asked = graph.log.all_numbers(now)
        if len(new) and self._is_elsewhere(fixes[new]).any():
            self._ask_batch_for_alternative()
            self.next_batch = now + SCHEDULE.batch_delay(now - window.times[0])

    def _is_elsewhere(self, fixes: Fixes) -> Mask:
        """``(f,)`` True for fixes that the present way passes at over DOUBTED sigmas, or in an area beyond a wall.

        A fix where nobody can walk counts as the nearest place where one can: in a corridor, most fixes are beyond its
        walls, and no other way leads there.
        """
        window = self.graph.window
        there = poses_at(fixes.time, np.array(window.times), window.pose)[:, :2]
        sigmas = np.hypot(*(fixes.position - there).T) / fixes.sigma
        elsewhere, plan = sigmas > DOUBTED, window.located_plan
        if plan is not None:
            floor = plan[window.floor]
            begin, end = (np.array([floor.nearest_walkable(p) for p in places]) for places in (there, fixes.position))
            elsewhere |= (sigmas > DOUBTED_BEHIND_WALL) & floor.crosses_wall(begin, end)
        return elsewhere


def were_rejected(before: Decisions, adopted: Decisions) -> bool:
    """True if the adopted decisions are about fixes alone, and those now wrong had no weight before either."""
    if set(adopted) != {FixFactor.name} or FixFactor.name not in before:
        return False
    old, new = before[FixFactor.name], adopted[FixFactor.name]
    rejected = old["number"][~old["held"].astype(bool) | old["outlier"].astype(bool)]
    return bool(np.isin(new["number"][new["wrong"].astype(bool)], rejected).all())
