"""The factors of a walk under way: those of the batch, over a window.

Measurements are the same objects as the batch's, made from the rows in the window.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gtsam
import numpy as np

from pdr_graph.estimation.factors import corridors_of
from pdr_graph.estimation.factors.base import Measurement
from pdr_graph.estimation.factors.chain import Evaluation
from pdr_graph.estimation.factors.start import CalibrationFactor, Prior, StartFactor
from pdr_graph.estimation.factors.steps_and_walls import StepFactor
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.live.isam import TransactionalISAM
from pdr_graph.estimation.live.measurement_log import (
    Collector,
    Decisions,
    MeasurementLog,
    merged_decisions,
    same_decisions,
)
from pdr_graph.estimation.live.step_buffer import CLOSE
from pdr_graph.estimation.live.window import ALL, Part, Window
from pdr_graph.floor.building import Building, FloorSequence
from pdr_graph.measurements import take
from pdr_graph.types import Array

RECENT = 150  # intervals that each update evaluates, chosen by hand


class WindowGraph:
    """The factors of the window; base class of `LiveGraph`.

    prior, plan: as of ``WalkGraph``; lag: keyframes older than this leave the window [s]; floor: label of the first
    floor.
    c_prior: mean and covariance of the first calibration in the window; decisions: about measurements, by kind; never
    changed in place, since copies and open questions have them too.
    """

    def __init__(self, prior: Prior | None = None, lag: float = np.inf, plan: Building | None = None, floor: str = ""):
        self.prior, self.lag = prior or Prior(), lag
        if plan is not None and len(plan.labels) == 1:
            floor = plan.labels[0]
        self.window, self.log = Window(self.prior, plan, floor), MeasurementLog()
        self.isam, self.collectors = TransactionalISAM(lag), list[Collector]()
        self.c_prior = np.array(self.prior.mean), self.prior.covariance
        self.decisions: Decisions = {}
        self._begins, self._hold = 0, (0, StartFactor.fixed(np.zeros(3)))
        self._current: tuple[Part, list[Measurement]] | None = None
        self._outdated, self._version = False, 0  # True if rows or intervals are newer than `_current`
        self._measurements, self._measured_at = list[Measurement](), (-1, 0.0, False)  # not bound to a chain
        self._last: tuple[Any, gtsam.Values, Evaluation] | None = None  # the latest evaluation, and its input

    @property
    def has_position(self) -> bool:
        """True if a measurement in the window determines a position."""
        times = self.log.position_times()
        return bool(len(times)) and bool(self.window.times) and float(times.min()) <= self.window.times[-1] + CLOSE

    def current(self, everything: bool = False) -> tuple[Part, list[Measurement]]:
        """The last RECENT intervals, or all, and the measurements bound to them."""
        if everything and len(self.window.intervals) > RECENT:
            return self._measured(self.window.part(ALL))
        if self._current is None or self._outdated or self._version != self.log.version:
            self._current, self._outdated = self._measured(self.window.part(RECENT)), False
            self._version = self.log.version
        return self._current

    def evaluate(self, everything: bool = False) -> Evaluation:
        """The window's factors at the estimate."""
        return self._evaluate(self.current(everything))

    def _evaluate(self, current: tuple[Part, list[Measurement]]) -> Evaluation:
        values = self.isam.values
        if self._last is None or self._last[0] is not current or self._last[1] is not values:
            part, measurements = current
            at = part.chain.evaluate(part.state(values, measurements), measurements)
            self._last = current, values, at
        return self._last[2]

    @property
    def cost(self) -> float:
        """Half the sum of squared, robustly weighted residuals of the window."""
        return self.evaluate(everything=True).cost

    @property
    def total_cost(self) -> float:
        """Cost of the window plus that of the marginal, to compare estimates."""
        return self.cost + self.isam.marginal_cost()

    def _measured(self, part: Part) -> tuple[Part, list[Measurement]]:
        window, chain = self.window, part.chain
        state = self.log.version, chain.time[0] if part.first else -np.inf, window.finished
        if self._measured_at != state:
            end = np.inf if window.finished else window.times[-1]
            measurements = list[Measurement]()
            if window.steps.chunks:
                measurements = self.log.measurements(window.steps.steps, self.prior, chain.time[0], end, self.decisions)
            self._measured_at, self._measurements = state, measurements
        measured = [measurement.bind(chain) for measurement in self._measurements]
        return part, [StepFactor(), *measured, *self._priors(part), *self._on_plan(part)]

    def _priors(self, part: Part) -> list[Measurement]:
        """Priors of calibration and first pose, while these are in the window."""
        row = {number: n for n, number in enumerate(part.segments.tolist())}
        begins = {row[self._begins]: self.c_prior} if self._begins in row else {}
        keyframe, hold = self._hold
        held = [hold] if part.chain.number[0] == keyframe else []
        return [CalibrationFactor(begins, self.prior.change), *held]

    def _on_plan(self, part: Part) -> list[Measurement]:
        """Factors of walls and corridors, if the plan is used."""
        walls, plan = part.walls(), self.window.located_plan
        evidence: list[Measurement] = [] if walls is None else [walls]
        if plan is not None and self.prior.corridors and part.intervals:
            labels = [interval.label for interval in part.intervals for _ in interval.fields]
            at = part.chain.evaluate(part.state(self.isam.values, ()))
            corridors = corridors_of(FloorSequence.of(plan, labels), self.prior)
            evidence += [kind.associated(at) for kind in corridors]
        return evidence

    def store_decisions(self, measurements: Sequence[Measurement]) -> bool:
        """Store the decisions about measurements; True if any has changed."""
        changed = False
        for measurement in measurements:
            if decided := measurement.decisions():
                stored = self.decisions.get(measurement.name, {})
                merged = merged_decisions(stored, decided)
                changed |= not same_decisions(stored, merged)
                self.decisions = self.decisions | {measurement.name: merged}
        return changed

    def decide(self, decisions: Decisions) -> None:
        """Replace the decisions about measurements."""
        self.decisions = decisions
        self.log.version += 1

    def batch_graph(self, decided: bool = True, c: Array | None = None, but: str = "") -> Callable[[], WalkGraph]:
        """A function that builds the batch's graph of the present window, at any later time and in any thread.

        decided: with the decisions about whole kinds (relocated beacons).
        c: mean ``(3,)`` of the calibration, by default that of `c_prior`; but: source of fixes and headings left out.
        """
        window, steps = self.window, self.window.steps.steps
        raw = [data for collector in self.collectors for data in collector.complete(steps)]
        data = [rows for rows in self.log.until(window.covered) if type(rows) not in map(type, raw)]
        data = [take(d, np.flatnonzero(np.array(d.source) != but)) if but and hasattr(d, "source") else d for d in data]
        prior = Prior(**{**vars(self.prior), "mean": tuple((self.c_prior[0] if c is None else c).tolist())})
        plan, labels = window.located_plan, None if window.located_plan is None else window.row_labels()
        of_kinds = {name: rows for name, rows in self.decisions.items() if decided and "number" not in rows}

        def build() -> WalkGraph:
            return WalkGraph.of(steps, [*data, *raw], floor=plan, floors=labels, prior=prior).decided(of_kinds)

        return build
