"""The live smoother: estimates a walk step by step, along the path that explains its measurements best.

Steps come in order. A keyframe closes after ten pieces, at each measurement and at gaps; a late measurement splits the
interval that it falls into. Four objects share the work: the graph over the window and its search (`LiveGraph`), what
is open about the walk and asked beside it (`LiveAmbiguity`), and the output (`LiveOutput`); this class says in which
order they act.

Until the direction of the walk is certain there is no estimate to linearise at: the batch solves the whole window at
intervals (`solve_batch`), and no keyframe leaves the window.
"""

from __future__ import annotations

from concurrent.futures import Executor
from typing import TYPE_CHECKING, Any

import numpy as np

from pdr_graph.estimation.ambiguity.bank import Findings
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.estimation.linear_system import one_thread
from pdr_graph.estimation.live.live_ambiguity import LiveAmbiguity
from pdr_graph.estimation.live.live_graph import UPDATES, LiveGraph
from pdr_graph.estimation.live.live_output import LiveOutput
from pdr_graph.estimation.live.review import SOURCE
from pdr_graph.estimation.smoother import smooth
from pdr_graph.floor.building import Building
from pdr_graph.types import Array, Drifts, Estimate, Headings, Sightings, Steps

if TYPE_CHECKING:
    from pdr_graph.floor.paths import PathNetwork


class LiveSmoother:
    """Estimates a walk under way from all its measurements; arguments as of ``LiveGraph``.

    executor: answers questions beside the walk; by default `review` does, or a push that needs the answer.
    graph, ambiguity, output: see the module; final: the batch's estimate of the whole walk if it ended with all of it
    in the window, else None.
    """

    def __init__(
        self,
        prior: Prior | None = None,
        lag: float = np.inf,
        plan: Building | None = None,
        floor: str = "",
        executor: Executor | None = None,
        paths: PathNetwork | None = None,
    ):
        self.graph = LiveGraph(prior, lag, plan, floor, paths)
        self.output = LiveOutput(self.graph)
        self.ambiguity = LiveAmbiguity(self.graph, self.output, executor)
        self.final: Estimate | None = None

    @property
    def sure(self) -> bool:
        """True if position and direction of the walk are certain."""
        return self.output.sure

    @one_thread
    def extend(self, steps: Steps, floor: str | None = None, tail: Steps | None = None) -> None:
        """Append the next steps of the walk.

        floor: label of their floor, by default that of the steps before; tail: the provisional steps after them.
        """
        self.ambiguity.tail = tail
        window = self.graph.window
        pieces = window.steps.append(steps)
        self.ambiguity.history.extend(steps)
        window.floor = window.floor if floor is None else floor
        if not window.keyframes:
            self.graph.begin()
        self.ambiguity.open_direction(pieces)
        busy = self._close()
        self.ambiguity.follow_modes()
        self.ambiguity.move_particles(busy)

    @one_thread
    def preview(self, tail: Steps | None) -> None:
        """Take the provisional steps, for the search while the direction of the walk is open."""
        self.ambiguity.tail = tail
        if not self.sure and self.graph.window.keyframes:
            self.ambiguity.show_batch()
            self.ambiguity.ask_batch()

    def rewind(self, to: float) -> float:
        """Drop the steps after ``to`` [s], as far as they are in the window; returns when those that are left end."""
        self.graph.rewind(to)
        self.ambiguity.rewind(self.graph.window.steps.end)
        return self.graph.window.steps.end

    def set_goings(self, goings: Array) -> None:
        """Give the steps on stairs the length of the treads. goings: ``(k, 3)``, see `goings_of`."""
        self.ambiguity.history.set_goings(goings)
        if self.graph.window.set_goings(goings):
            self.graph.log.version += 1

    @one_thread
    def append(self, data: Any) -> None:
        """Append measurements of any type in `KINDS`; those from before the window are dropped and counted as late."""
        times, window = self.graph.append(data), self.graph.window
        if window.keyframes and (times <= window.steps.end).any():
            self._close()
            self.ambiguity.follow_modes()

    def collect(self, received: Sightings, radio: str) -> None:
        """Pass receptions of a radio, "bluetooth" or "wifi", to the collectors."""
        for collector in self.graph.collectors:
            collector.collect(received, radio)

    def set_heading(self, number: int, time: float, heading: float, sigma: float) -> None:
        """Set or replace heading ``number`` (time [s], heading and sigma [rad]); an infinite sigma removes it."""
        self._set(Headings, number, time, heading, sigma)

    def set_drift(self, number: int, time: float, drift: float, sigma: float) -> None:
        """Set or replace drift ``number`` (time [s], drift and sigma [rad/s]); an infinite sigma removes it."""
        self._set(Drifts, number, time, drift, sigma)

    def _set(self, table: type[Headings | Drifts], number: int, *row: float) -> None:
        if np.isfinite(row[-1]):
            self.graph.append(table(*np.array(row)[:, None]), np.array([number]))
        else:
            self.graph.log.remove(table, number)

    @one_thread
    def finish(self) -> None:
        """End the walk.

        If the window still holds the whole walk, the batch solves it; else the window moves to the optimum nearby.
        """
        graph, ambiguity = self.graph, self.ambiguity
        if not graph.window.keyframes:
            return
        self._close(at_end=True)
        for question in ambiguity.questions:
            question.cancel()
        ambiguity.tail = None
        if not self.sure and graph.has_position:
            ambiguity.adopt_batch(ambiguity.batch_question()())
        if graph.window.complete:
            self.final = smooth(graph.batch_graph(decided=False, but=SOURCE)())
            return
        ambiguity.next_comparison = -np.inf
        ambiguity.compare_sources(0.0, Findings())
        graph.solve(30)

    def review(self) -> None:
        """Answer the open questions in an idle moment; else the push that needs an answer does, with equal results."""
        self.ambiguity.work()

    def _close(self, at_end: bool = False) -> bool:
        """Close the keyframes due after new steps and measurements, and solve; False if none was due."""
        graph, ambiguity = self.graph, self.ambiguity
        unexpected = ambiguity.unexpected_fixes()
        new, reached = graph.close_keyframes(at_end)
        if not (new or reached):
            return False
        contradicted = reached and ambiguity.contradicted(unexpected)
        if contradicted and self.sure:
            ambiguity.restart()
        ambiguity.search_plan()
        if not ambiguity.solve_by_batch():
            graph.approach()
        ambiguity.adopt_alternative()
        if reached and self.sure:
            ambiguity.reclassify()
            ambiguity.doubt_new_fixes()
        ambiguity.compare_sources(2.0)
        graph.solve(UPDATES)
        if ambiguity.solved and graph.walls_changed(60):  # no walls before the batch has solved it
            graph.solve(UPDATES)
        ambiguity.follow(new)
        return True
