"""The recent past of a walk under way: its steps and measurements, for longer than the window holds them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from pdr_graph.estimation.factors.start import Prior
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.live.measurement_log import Decisions, MeasurementLog, TableCheckpoint
from pdr_graph.estimation.live.review import Findings, Question
from pdr_graph.estimation.live.step_buffer import later_steps
from pdr_graph.gait.stair_steps import with_goings
from pdr_graph.gait.step_chunks import concatenate_steps
from pdr_graph.types import Array, Steps

SPAN = 120.0  # [s] of the walk in which sources are compared: twice the usual lag; chosen by hand


@dataclass(frozen=True)
class HistoryCheckpoint:
    """State of a `History`."""

    steps: Steps | None
    tables: list[TableCheckpoint]


class History:
    """The steps and measurements of the last SPAN seconds; log: gets the rows of the window's log."""

    def __init__(self) -> None:
        self.log = MeasurementLog()
        self._chunks = list[Steps]()

    def extend(self, steps: Steps) -> None:
        """Append the next steps. What no question asks for, while nothing measures positions, is dropped in time."""
        self._chunks.append(steps)
        if steps.end - self._chunks[0].start > 3 * SPAN:
            self._forget(steps.end - 2 * SPAN)

    def set_goings(self, goings: Array) -> None:
        """Give the steps on stairs the length of the treads, see `with_goings`."""
        self._chunks = [with_goings(steps, goings) for steps in self._chunks]

    def has_position(self, now: float) -> bool:
        """True if a measurement of the last SPAN seconds before ``now`` [s] determines a position."""
        times = self.log.position_times()
        return bool(((times > now - SPAN) & (times <= now)).any())

    def question(self, now: float, prior: Prior, before: Findings, decisions: Decisions, walled: bool) -> Question:
        """The review of the last SPAN seconds before ``now`` [s]; older data are dropped. Arguments: of `Question`."""
        steps = self._forget(now - SPAN)
        graph = partial(WalkGraph.of, steps, self.log.until(steps.end), prior=prior)
        kept = {name: self.log.renumbered(name, rows) for name, rows in decisions.items() if name in before.kinds}
        return Question(graph, before, kept, walled, self.log.all_numbers(steps.end))

    def _forget(self, before: float) -> Steps:
        """Drop what is from before a moment [s]; returns the steps that are left."""
        steps = later_steps(concatenate_steps(self._chunks), before)
        self._chunks = [steps]
        self.log.forget(steps.start - max(self.log.overhangs.values(), default=0.0))
        return steps

    def checkpoint(self) -> HistoryCheckpoint:
        """Return the state."""
        return HistoryCheckpoint(concatenate_steps(self._chunks) if self._chunks else None, self.log.checkpoint())

    def restore(self, checkpoint: HistoryCheckpoint) -> None:
        """Set the state to a checkpoint."""
        self._chunks = [] if checkpoint.steps is None else [checkpoint.steps]
        self.log.restore(checkpoint.tables)
