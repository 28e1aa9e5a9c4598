"""The factor graph of a walk under way: the batch's factors over a window, and the marginal of finalised variables.

Measurements are the same objects as the batch's, made from the rows in the window. The incremental solver receives
their factors linearised at the estimate, and again when a variable has moved.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from pdr_graph.estimation.factors.base import Measurement, insert
from pdr_graph.estimation.factors.chain import Evaluation
from pdr_graph.estimation.factors.corridor import CorridorFactor
from pdr_graph.estimation.factors.start import CalibrationFactor, Prior, StartFactor
from pdr_graph.estimation.factors.steps_and_walls import StepFactor, WallFactor
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.live.finalization import COVARIANCE_INTERVAL, FinalizedCheckpoint, FinalizedTrajectory
from pdr_graph.estimation.live.isam import IsamCheckpoint, Linear, Name, TransactionalISAM
from pdr_graph.estimation.live.measurement_log import (
    WAITING,
    Collector,
    Decisions,
    MeasurementLog,
    TableCheckpoint,
    merged_decisions,
    same_decisions,
)
from pdr_graph.estimation.live.review import Excess
from pdr_graph.estimation.live.step_buffer import CLOSE, Interval
from pdr_graph.estimation.live.window import ALL, Part, Window, WindowCheckpoint
from pdr_graph.floor.building import Building, FloorSequence
from pdr_graph.geometry import pose_rotation, wrap_angle
from pdr_graph.measurements import take
from pdr_graph.types import Array, Index

RECENT = 150  # intervals that each update evaluates, chosen by hand
FULL_CHECK = 25  # keyframes after which a relinearisation evaluates all intervals, chosen by hand
UNMOVED = np.array([0.05, 0.05, 0.005])  # [m, m, rad] a move below the tolerance of every factor


@dataclass(frozen=True)
class LiveGraphCheckpoint:
    """State of a `LiveGraph`.

    brought: names and numbers of the priors of variables that measurements add, while these variables are alive.
    """

    window: WindowCheckpoint
    past: FinalizedCheckpoint
    isam: IsamCheckpoint
    tables: list[TableCheckpoint]
    collectors: list[dict[str, Array]]
    decisions: Decisions
    brought: list[tuple[str, int]]
    c_mean: Array
    c_covariance: Array
    begins: int
    hold_keyframe: int
    hold_pose: Array
    hold_sigmas: Array
    arrivals: list[float]
    too_late: int


class LiveGraph:
    """The factors of a walk under way, and the solver that they go to.

    prior, plan: as of ``WalkGraph``; lag: keyframes older than this leave the window [s]; floor: label of the first
    floor.
    c_prior: mean and covariance of the first calibration in the window; decisions: about measurements, by kind;
    too_late: number of measurements from before the window; excess: what the stated covariance has beside the solver's.
    """

    def __init__(self, prior: Prior | None = None, lag: float = np.inf, plan: Building | None = None, floor: str = ""):
        self.prior, self.lag = prior or Prior(), lag
        if plan is not None and len(plan.labels) == 1:
            floor = plan.labels[0]
        self.window, self.log, self.finalized = Window(self.prior, plan, floor), MeasurementLog(), FinalizedTrajectory()
        self.isam, self.collectors = TransactionalISAM(lag), list[Collector]()
        self.c_prior = np.array(self.prior.mean), self.prior.covariance
        self.decisions: Decisions = {}
        self.too_late, self.excess = 0, Excess.none()
        self._arrivals = list[float]()
        self._begins, self._hold = 0, (0, StartFactor.fixed(np.zeros(3)))
        self._current: tuple[Part, list[Measurement]] | None = None
        self._outdated, self._version = False, 0  # True if rows or intervals are newer than `_current`
        self._measurements, self._measured_at = list[Measurement](), (-1, 0.0, False)  # not bound to a chain
        self._last: tuple[Any, gtsam.Values, Evaluation] | None = None  # the latest evaluation, and its input
        self._leaving = 0  # keyframes still in the window that the solver has marginalised or is about to
        self._checked_poses: Array | None = None  # where the factors were last checked for relinearisation

    def begin(self) -> None:
        """Set the first keyframe, at the start of the steps."""
        self.window.begin()
        self.finalized.edge = self.window.times[0], self.finalized.edge[1]
        self.log.forget(self.window.times[0] - max(self.overhangs.values(), default=0.0))
        self.update()

    def append(self, data: Any, number: Index | None = None) -> None:
        """Append measurements; those from before the window are dropped and counted as late."""
        times = self.log.times(data)
        if self.window.times:
            early = times < self.window.times[0] - self.log.overhang(data)
            self.too_late += int(early.sum())
            data, times = self.log.select(data, ~early), times[~early]
            number = None if number is None else number[~early]
        if len(times):
            self.log.append(data, number)
            self._arrivals += times.ravel().tolist()
            self._outdated = True
        if not self.window.times:
            self.log.keep_latest()
            del self._arrivals[:-WAITING]

    @property
    def overhangs(self) -> dict[str, float]:
        """Time [s] by which measurements may lie outside the steps, by kind."""
        return self.log.overhangs

    def collect(self, data: Any) -> bool:
        """Pass raw data (advertisements, scans) to all collectors; True if one of them uses it."""
        return any([collector.collect(data) for collector in self.collectors])

    def close_keyframes(self, at_end: bool = False) -> tuple[list[Interval], bool]:
        """Close the keyframes due after new steps and measurements.

        Returns the new intervals, and True if the steps have reached the time of new measurements.
        """
        window, covered = self.window, self.window.steps.end
        for collector in self.collectors:
            for data in collector.due(covered, window.steps.walked_by):
                self.append(data)
        window.finished = at_end
        reached = [time for time in self._arrivals if time <= covered + CLOSE or at_end]
        ends = window.steps.keyframe_ends(window.times[-1], reached + [covered] * at_end)
        if ends:
            # Before the update marginalises them; the last interval links its calibration to the next
            self._leaving = int(np.searchsorted(window.times[:-2], ends[-1] - self.isam.lag))
            self.finalize_leaving()
        new = window.cut(ends)
        within = [time for time in reached if window.times[0] <= time <= window.times[-1]]
        for time in within:
            if not window.has_keyframe(time):
                window.split(time)
        if reached:
            self._arrivals = [time for time in self._arrivals if not (time <= covered + CLOSE or at_end)]
        self._outdated |= bool(new or reached)
        self.log.version += bool(reached)
        return new, bool(reached)

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
        walls, use, plan = part.walls(), self.prior.corridors, self.window.located_plan
        evidence: list[Measurement] = [] if walls is None else [walls]
        if plan is not None and (use.turns or use.directions) and part.intervals:
            labels = [interval.label for interval in part.intervals for _ in interval.fields]
            at = part.chain.evaluate(part.state(self.isam.values, ()))
            evidence.append(CorridorFactor.about(FloorSequence.of(plan, labels), use).associated(at))
        return evidence

    def update(self, everything: bool = False) -> None:
        """Update the solver with new factors, and with those that must be relinearised."""
        self.finalize_leaving()
        at = self.evaluate(everything)
        values, times = self._new_variables(at)
        add = self._changes(at)
        self._update(add, self.isam.obsolete(at.blocks, at.state), values, times)

    def relinearize(self, tighter: float = 1.0, everything: bool = False) -> bool:
        """Relinearise factors whose variables have moved; False if there were none."""
        if tighter == 1.0 and self._unmoved():
            return False
        self.finalize_leaving()
        at = self.evaluate(everything or self.window.count % FULL_CHECK == 0)
        add = self._changes(at, tighter)
        remove = self.isam.obsolete(at.blocks, at.state)
        if add or remove:
            self._update(add, remove)
        return bool(add or remove)

    def _unmoved(self) -> bool:
        """True if no pose has moved by as much as any factor tolerates since the last check."""
        if self._checked_poses is None or self._outdated or len(self._checked_poses) != len(self.window.pose):
            return False
        apart = np.abs(self.window.pose - self._checked_poses)
        apart[:, 2] = np.abs(wrap_angle(apart[:, 2]))
        return bool((apart < UNMOVED).all())

    def associate_walls(self, pieces: int) -> float:
        """Associate the last ``pieces`` with walls; returns the price of the regions they lead through."""
        self._checked_poses = None
        price = self.window.associate_walls(pieces)
        if self._current is not None and not self._outdated:
            part, measurements = self._current
            walls = part.walls()
            self._current = part, [walls if isinstance(kind, WallFactor) and walls else kind for kind in measurements]
        return price

    def rebuild(self, lag: float) -> None:
        """Put all factors of the window into a new solver, without the marginal."""
        rebuilds, self.isam = self.isam.rebuilds, TransactionalISAM(lag)
        self.isam.rebuilds, self._begins = rebuilds, self.window.segments[0]
        pose = self.window.pose[0].copy()
        hold = StartFactor.heading(float(pose[2])) if self.has_position else StartFactor.fixed(pose)
        self._hold, self._current = (self.window.keyframes[0], hold), None
        self.log.version += 1  # the decisions may have changed
        self.update(everything=True)

    def restart_solver(self, isam: TransactionalISAM, again: Collection[Name]) -> None:
        """Start ``isam``, a solver with variables at other values, and use it from now on; it gets missing variables.

        again: names of the priors to add again, of variables that measurements add.
        """
        self.isam = isam
        self.window.read(isam.values)
        at = self.evaluate(everything=True)
        isam.insert(*self._new_variables(at))
        isam.start(self._changes(at, again=again))
        self.window.read(isam.values)

    def _changes(self, at: Evaluation, tighter: float = 1.0, again: Collection[Name] = ()) -> dict[Name, Linear]:
        """New and relinearised factors of the evaluation ``at``."""
        self._checked_poses = self.window.pose.copy()
        blocks = (self.isam.changes(block, at.state, tighter, again) for block in at.blocks)
        return {name: factor for block in blocks for name, factor in block.items()}

    def _new_variables(self, at: Evaluation) -> tuple[gtsam.Values, dict[int, float]]:
        """Variables that the solver does not have yet, and the time [s] until which each variable is needed."""
        values, times, now = gtsam.Values(), dict[int, float](), self.window.times[-1]
        needed = {"x": at.chain.time, "c": self.window.segment_ends(at.state.number("c"))}
        needed |= {
            variables.symbol: variables.needed for m in at.measurements for variables in m.variables(at.state.poses)
        }
        for symbol, until in needed.items():
            keys = at.state.keys(symbol).tolist()
            for key, vector, time in zip(keys, at.state[symbol], until.tolist(), strict=True):
                new = key not in self.isam
                if new:
                    insert(values, symbol, key, vector)
                if new or symbol != "x":
                    times[key] = min(time, now) if time > -np.inf else now
        return values, times

    def _update(
        self,
        add: Mapping[Name, Linear],
        remove: Sequence[Name] = (),
        values: gtsam.Values | None = None,
        times: dict[int, float] | None = None,
    ) -> None:
        """Update the solver and copy its estimate to the window."""
        self.isam.update(add, remove, values, times)
        self._leaving = next((n for n, number in enumerate(self.window.keyframes) if X(number) in self.isam), 0)
        self.window.read(self.isam.values, self._leaving)

    def finalize_leaving(self) -> None:
        """Finalise the keyframes that leave the window: move their rows and reports to `finalized`."""
        count, window = self._leaving, self.window
        if not count:
            return
        self._leaving, until = 0, window.times[count]
        current, late = self._current, self._outdated and min(self._arrivals, default=until) < until
        if current is not None and len(current[0].intervals) == len(window.intervals) and not late:
            at = self._evaluate(current)
        else:
            at = self.evaluate(everything=True)
        self._report_until(until, at)
        start = window.pose[0].copy() if window.complete else None
        self.finalized.take(window.intervals[:count], at, start)
        window.forget(count)
        if start is not None and self.has_position:
            self.finalized.begin(start, window.pose[0], self.covariance(0))
        self._current = None
        if not self.finalized.anchored:
            self.finalized.hinge = window.pose[0].copy()
        self.log.forget(until)
        for collector in self.collectors:
            collector.forget(until)
        self._arrivals = [time for time in self._arrivals if time >= until]
        if window.times[0] > self.finalized.edge[0] + COVARIANCE_INTERVAL:
            self.finalized.finalize(window.times[0], self.covariance(0))

    def _report_until(self, until: float, at: Evaluation) -> None:
        """Store the reports of instances from before ``until`` [s]."""
        for measurement in at.measurements:
            if measurement.instances is None:
                continue
            numbers, times = measurement.instances
            early = np.flatnonzero(times < until)
            if len(early):
                reports = zip(numbers[early].tolist(), measurement.reports(at, early), strict=True)
                self.finalized.reports.setdefault(measurement.name, {}).update(reports)

    def covariance(self, n: int) -> Array:
        """Stated covariance ``(3, 3)`` of the n-th keyframe of the window, in the output axes."""
        return self.solved_covariance(n) + self.excess.at(np.array([self.window.times[n]]))[0]

    def solved_covariance(self, n: int) -> Array:
        """Covariance ``(3, 3)`` of the n-th keyframe by the solver, in the output axes."""
        R = pose_rotation(self.window.pose[[n], 2])[0]
        return R @ self.isam.covariance([X(self.window.keyframes[n])]) @ R.T

    def store_decisions(self, measurements: Sequence[Measurement]) -> bool:
        """Store the decisions about measurements; True if any has changed."""
        changed = False
        for measurement in measurements:
            if decided := measurement.decisions():
                stored = self.decisions.get(measurement.name, {})
                merged = merged_decisions(stored, decided)
                changed |= not same_decisions(stored, merged)
                self.decisions[measurement.name] = merged
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

    def copy(self) -> LiveGraph:
        """An independent graph of the same window, without rows and reports; its solver has no factors yet."""
        other = copy(self)
        other.window, other.log = self.window.copy(), self.log.copy()
        other.isam = self.isam.with_values(self.isam.values)
        other.finalized, other.collectors, other._arrivals = FinalizedTrajectory(), [], list(self._arrivals)
        other._current = other._last = other._checked_poses = None
        return other

    def checkpoint(self) -> LiveGraphCheckpoint:
        """Return the state, from which the walk continues bit by bit the same."""
        self.finalize_leaving()
        brought = [name for name, factor in self.isam.factors.items() if not factor.poses]
        keyframe, hold = self._hold
        return LiveGraphCheckpoint(
            window=self.window.checkpoint(),
            past=self.finalized.checkpoint(),
            isam=self.isam.checkpoint(),
            tables=self.log.checkpoint(),
            collectors=[collector.checkpoint() for collector in self.collectors],
            decisions=self.decisions,
            brought=brought,
            c_mean=self.c_prior[0],
            c_covariance=self.c_prior[1],
            begins=self._begins,
            hold_keyframe=keyframe,
            hold_pose=hold.pose,
            hold_sigmas=hold.sigmas,
            arrivals=list(self._arrivals),
            too_late=self.too_late,
        )

    def restore(self, checkpoint: LiveGraphCheckpoint) -> None:
        """Set the state to a checkpoint of a graph with the same prior, lag, plan and collectors."""
        self.log.restore(checkpoint.tables)
        self.decisions, self.too_late = checkpoint.decisions, checkpoint.too_late
        self.c_prior, self._begins = (checkpoint.c_mean, checkpoint.c_covariance), checkpoint.begins
        self._hold = checkpoint.hold_keyframe, StartFactor(checkpoint.hold_pose, checkpoint.hold_sigmas)
        self._arrivals = list(checkpoint.arrivals)
        self.finalized.restore(checkpoint.past)
        for collector, stored in zip(self.collectors, checkpoint.collectors, strict=True):
            collector.restore(stored)
        self.window.restore(checkpoint.window)
        isam = TransactionalISAM.restored(checkpoint.isam)
        if self.window.keyframes:
            self.window.read(isam.values)
            self.window.associate_walls(ALL)
            self.restart_solver(isam, [(name, number) for name, number in checkpoint.brought])
