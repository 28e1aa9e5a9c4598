"""Trial of an alternative path: optimised on a copy of the window, and compared with the present path there.

The copy is made when the alternative is found; the comparison is computed beside the walk (`Deferred`), so that the
window moves only if the alternative costs less.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pdr_graph.estimation.live.live_graph import LiveGraph
from pdr_graph.estimation.live.measurement_log import Decisions
from pdr_graph.estimation.live.particles import AlternativePath
from pdr_graph.estimation.live.step_buffer import CLOSE
from pdr_graph.estimation.live.window import ALL, Window
from pdr_graph.priors import LIVE_PATHS


@dataclass(frozen=True)
class Trial:
    """A compared alternative.

    accepted: it clearly costs less than the path that was present; path: at its optimum; decisions: about
    measurements, on it.
    """

    accepted: bool
    path: AlternativePath
    decisions: Decisions


@dataclass(frozen=True)
class TrialQuestion:
    """A comparison that is due.

    graph: a copy of the walk's, which `answer` changes; alternative: the path, and decisions about measurements on it;
    rounds: most steps of the search.
    """

    graph: LiveGraph
    alternative: Callable[[], tuple[AlternativePath, Decisions]]
    rounds: int

    def answer(self) -> Trial:
        """The alternative at its optimum, and whether it costs less than the present path."""
        graph, (path, decisions) = self.graph, self.alternative()
        if not len(path.within(graph.window.times)):
            return Trial(False, path, {})  # it has left the window: the particles are behind
        before = self._optimized()
        graph.decide(graph.decisions | decisions)
        place_on(graph, path)
        return Trial(self._optimized() < before - LIVE_PATHS.least_gain, _path_of(graph.window), decisions)

    def _optimized(self) -> float:
        """The cost of the path at its optimum, with the price of the regions that it leads through."""
        price = self.graph.associate_walls(ALL)
        self.graph.solve(self.rounds)
        return self.graph.total_cost + price


def move_to(graph: LiveGraph, path: AlternativePath) -> None:
    """Move the window to a path, with the walls there."""
    place_on(graph, path)
    graph.associate_walls(ALL)  # or the walls of the path that is left would pull at the first solution
    graph.solve()


def place_on(graph: LiveGraph, path: AlternativePath) -> None:
    """Move the window to a path, without a solution there; keyframes after its end are dead-reckoned."""
    window = graph.window
    within = path.within(window.times)
    window.pose[within] = path.poses(np.array(window.times)[within])
    window.dead_reckon(int(within[-1]), path.state[-1, 3:])
    for interval in window.intervals:
        if interval.begin >= path.time[0] - CLOSE:
            window.c[interval.segment] = path.calibration(interval.end)
    graph.moved()


def _path_of(window: Window) -> AlternativePath:
    """The estimate of a window, with the calibration of the interval before each keyframe."""
    c = np.array([window.c[interval.segment] for interval in (window.intervals[0], *window.intervals)])
    return AlternativePath(np.array(window.times), np.column_stack([window.pose, c]))
