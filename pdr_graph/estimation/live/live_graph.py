"""The factor graph of a walk under way: that of the batch over a window, and the marginal of what has left it.

Measurements are the same objects as the batch's, made of the rows in the window; the incremental solver gets their
factors linearised where the walk is, and again when a variable has moved.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from pdr_graph.estimation.factors.base import AnyArray, Measurement, State, insert
from pdr_graph.estimation.factors.chain import Evaluation
from pdr_graph.estimation.factors.corridor import CorridorFactor
from pdr_graph.estimation.factors.start import CalibrationFactor, Prior, StartFactor
from pdr_graph.estimation.factors.steps_and_walls import StepFactor, WallFactor
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.live.finalization import SPARSE, FinalizedCheckpoint, FinalizedTrajectory
from pdr_graph.estimation.live.isam import IsamCheckpoint, Linear, Name, TransactionalISAM
from pdr_graph.estimation.live.measurement_log import Collector, MeasurementLog, TableCheckpoint
from pdr_graph.estimation.live.step_buffer import CLOSE, Interval
from pdr_graph.estimation.live.window import ALL, Part, Window, WindowCheckpoint
from pdr_graph.floor.building import Building, FloorSequence
from pdr_graph.geometry import pose_rotation, wrap_angle
from pdr_graph.types import Array, Index

RECENT, EVERY = 150, 25  # intervals that are looked at each time; all are when so many keyframes have closed
STILL = np.array([0.05, 0.05, 0.005])  # [m, m, rad] of a move that no factor notices
Decisions = dict[str, dict[str, AnyArray]]


@dataclass(frozen=True)
class LiveGraphCheckpoint:
    """What a `LiveGraph` knows.

    brought: names and numbers of the factors of variables that measurements have brought, while these are alive.
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
    """Every measurement of a walk under way as a factor.

    prior, plan: as of ``WalkGraph``; lag: keyframes older than this leave the window [s]; floor: label of the one that
    the walk is on.

    c_prior: mean and covariance of the calibration with which the window begins; decisions: about measurements, by
    kind; too_late: how many came after their time had left the window.
    """

    def __init__(self, prior: Prior | None = None, lag: float = np.inf, plan: Building | None = None, floor: str = ""):
        self.prior, self.lag = prior or Prior(), lag
        if plan is not None and len(plan.labels) == 1:
            floor = plan.labels[0]
        self.window, self.log, self.past = Window(self.prior, plan, floor), MeasurementLog(), FinalizedTrajectory()
        self.isam, self.collectors = TransactionalISAM(lag), list[Collector]()
        self.c_prior = np.array(self.prior.mean), self.prior.covariance
        self.decisions: Decisions = {}
        self.too_late = 0
        self._arrivals = list[float]()
        self._begins, self._hold = 0, (0, StartFactor.fixed(np.zeros(3)))
        self._current: tuple[Part, list[Measurement]] | None = None
        self._outdated, self._version = False, 0  # whether rows or intervals have come since `_current` was made
        self._measurements, self._measured_at = list[Measurement](), (-1, 0.0, False)  # not on a chain yet
        self._last: tuple[Any, gtsam.Values, Evaluation] | None = None  # the latest evaluation, and of what
        self._leaving = 0  # keyframes that the solver has marginalised or is about to, and the window still has
        self._looked: Array | None = None  # the poses where the factors were last looked at

    # What comes in

    def begin(self) -> None:
        """Set the first keyframe, at the start of the steps."""
        self.window.begin()
        self.past.edge = self.window.times[0], self.past.edge[1]
        self.log.forget(self.window.times[0] - max(self.overhangs.values(), default=0.0))
        self.update()

    def append(self, data: Any, number: Index | None = None) -> None:
        """Append measurements; those from before the window count as too late."""
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

    @property
    def overhangs(self) -> dict[str, float]:
        """By how much measurements may lie outside the steps, by kind [s]."""
        return self.log.overhangs

    def collect(self, data: Any) -> bool:
        """Take raw data (advertisements, scans); whether anything makes measurements of it."""
        return any([one.collect(data) for one in self.collectors])

    def close_keyframes(self, at_end: bool = False) -> tuple[list[Interval], bool]:
        """Close the keyframes that steps and measurements have made.

        Returns the new intervals, and whether measurements were reached.
        """
        window, covered = self.window, self.window.steps.end
        for one in self.collectors:
            for data in one.due(covered, window.steps.walked_by):
                self.append(data)
        window.finished = at_end
        reached = [time for time in self._arrivals if time <= covered + CLOSE or at_end]
        ends = window.steps.keyframe_ends(window.times[-1], reached + [covered] * at_end)
        if ends:
            # What the update with these keyframes marginalises; the calibration of the last interval is linked to the next
            self._leaving = int(np.searchsorted(window.times[:-2], ends[-1] - self.isam.lag))
            self.let_go()
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

    # The graph at the estimate

    @property
    def placed(self) -> bool:
        """Whether anything in the window tells where the walk was."""
        times = self.log.placing_times()
        return bool(len(times)) and bool(self.window.times) and float(times.min()) <= self.window.times[-1] + CLOSE

    def current(self, everything: bool = False) -> tuple[Part, list[Measurement]]:
        """The last intervals, or all, and the measurements on them."""
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
        """The cost of the window and of the marginal, to compare one estimate with another."""
        return self.cost + self.isam.marginal_cost()

    def _measured(self, part: Part) -> tuple[Part, list[Measurement]]:
        window, chain = self.window, part.chain
        state = self.log.version, chain.time[0] if part.first else -np.inf, window.finished
        if self._measured_at != state:
            end = np.inf if window.finished else window.times[-1]
            found = list[Measurement]()
            if window.steps.chunks:
                found = self.log.measurements(window.steps.steps, self.prior, chain.time[0], end, self.decisions)
            self._measured_at, self._measurements = state, found
        measured = [one.on(chain) for one in self._measurements]
        return part, [StepFactor(), *measured, *self._held(part), *self._on_plan(part)]

    def _held(self, part: Part) -> list[Measurement]:
        """What is believed of calibration and start, while these are in the window."""
        row = {number: n for n, number in enumerate(part.segments.tolist())}
        begins = {row[self._begins]: self.c_prior} if self._begins in row else {}
        keyframe, hold = self._hold
        held = [hold] if part.chain.number[0] == keyframe else []
        return [CalibrationFactor(begins, self.prior.change), *held]

    def _on_plan(self, part: Part) -> list[Measurement]:
        """Walls and corridors."""
        walls, use, plan = part.walls(), self.prior.corridors, self.window.known_plan
        found: list[Measurement] = [] if walls is None else [walls]
        if plan is not None and (use.turns or use.directions) and part.intervals:
            labels = [one.label for one in part.intervals for _ in one.fields]
            at = part.chain.evaluate(part.state(self.isam.values, ()))
            found.append(CorridorFactor.about(FloorSequence.of(plan, labels), use).associated(at))
        return found

    # The incremental solver

    def update(self, everything: bool = False) -> None:
        """Give the solver what is new, and what must be linearised again."""
        self.let_go()
        at = self.evaluate(everything)
        values, times = self._new_variables(at)
        add = self._changes(at)
        self._update(add, self.isam.gone(at.blocks, at.state), values, times)

    def relinearize(self, tighter: float = 1.0, everything: bool = False) -> bool:
        """Linearise again what has moved; whether anything had."""
        if tighter == 1.0 and self._unmoved():
            return False
        self.let_go()
        at = self.evaluate(everything or self.window.count % EVERY == 0)
        add = self._changes(at, tighter)
        remove = self.isam.gone(at.blocks, at.state)
        if add or remove:
            self._update(add, remove)
        return bool(add or remove)

    def _unmoved(self) -> bool:
        """Whether no pose has moved since the factors were last looked at by as much as would matter to any."""
        if self._looked is None or self._outdated or len(self._looked) != len(self.window.pose):
            return False
        apart = np.abs(self.window.pose - self._looked)
        apart[:, 2] = np.abs(wrap_angle(apart[:, 2]))
        return bool((apart < STILL).all())

    def associate_walls(self, pieces: int) -> float:
        """Find the walls about the last so many pieces; returns what it costs to lead there."""
        self._looked = None
        price = self.window.associate_walls(pieces)
        if self._current is not None and not self._outdated:
            part, measurements = self._current
            walls = part.walls()
            self._current = part, [walls if isinstance(one, WallFactor) and walls else one for one in measurements]
        return price

    def rebuild(self, lag: float) -> None:
        """Forget the marginal, and put all factors of the window into a new solver."""
        rebuilds, self.isam = self.isam.rebuilds, TransactionalISAM(lag)
        self.isam.rebuilds, self._begins = rebuilds, self.window.segments[0]
        pose = self.window.pose[0].copy()
        hold = StartFactor.heading(float(pose[2])) if self.placed else StartFactor.fixed(pose)
        self._hold, self._current = (self.window.keyframes[0], hold), None
        self.log.version += 1  # decisions may be others
        self.update(everything=True)

    def start_at(self, isam: TransactionalISAM, again: Collection[Name]) -> None:
        """Go on with a solver that has the same variables, at other values; again: factors that it must have.

        These are such as tell of variables that measurements have brought.
        """
        self.isam = isam
        self.window.read(isam.values)
        at = self.evaluate(everything=True)
        isam.start(self._changes(at, again=again))
        self.window.read(isam.values)

    def return_to(self, isam: TransactionalISAM) -> None:
        """Go back to a solver, whose estimate the window has again."""
        self.isam, self._current = isam, None

    def _changes(self, at: Evaluation, tighter: float = 1.0, again: Collection[Name] = ()) -> dict[Name, Linear]:
        self._looked = self.window.pose.copy()
        add: dict[Name, Linear] = {}
        for block in at.blocks:
            add |= self.isam.changes(block, at.state, tighter, again)
        return add

    def _new_variables(self, at: Evaluation) -> tuple[gtsam.Values, dict[int, float]]:
        """The variables that the solver does not have yet, and until when all are needed [s]."""
        values, times, now = gtsam.Values(), dict[int, float](), self.window.times[-1]
        needed = {"x": at.chain.time, "c": self._segment_ends(at.state)}
        needed |= {one.symbol: one.needed for m in at.measurements for one in m.variables(at.state.poses)}
        for symbol, until in needed.items():
            keys = at.state.keys(symbol).tolist()
            for key, vector, time in zip(keys, at.state[symbol], until.tolist(), strict=True):
                new = key not in self.isam
                if new:
                    insert(values, symbol, key, vector)
                if new or symbol != "x":
                    times[key] = min(time, now) if time > -np.inf else now
        return values, times

    def _segment_ends(self, state: State) -> Array:
        """The end of the last interval of each calibration ``(s,)``. [s]"""
        ends = {one.segment: one.end for one in self.window.intervals}
        return np.array([ends.get(segment, self.window.times[-1]) for segment in state.number("c").tolist()])

    def _update(
        self,
        add: Mapping[Name, Linear],
        remove: Sequence[Name] = (),
        values: gtsam.Values | None = None,
        times: dict[int, float] | None = None,
    ) -> None:
        """Update the solver, and take its estimate over."""
        self.isam.update(add, remove, values, times)
        self._leaving = next((n for n, number in enumerate(self.window.keyframes) if X(number) in self.isam), 0)
        self.window.read(self.isam.values, self._leaving)

    def let_go(self) -> None:
        """Let go of the keyframes that leave, and of what was measured there."""
        gone, window = self._leaving, self.window
        if not gone:
            return
        self._leaving, until = 0, window.times[gone]
        complete = self._current is not None and len(self._current[0].intervals) == len(window.intervals)
        late = self._outdated and min(self._arrivals, default=until) < until
        at = self._evaluate(self._current) if complete and not late else self.evaluate(everything=True)
        self._report_until(until, at)
        self.past.take(window.intervals[:gone], at, window.pose[0].copy() if window.complete else None)
        window.forget(gone)
        self._current = None
        if not self.past.anchored:
            self.past.hinge = window.pose[0].copy()
        self.log.forget(until)
        for one in self.collectors:
            one.forget(until)
        self._arrivals = [time for time in self._arrivals if time >= until]
        if window.times[0] > self.past.edge[0] + SPARSE:
            self.past.finalize(window.times[0], self.covariance(0))

    def _report_until(self, until: float, at: Evaluation) -> None:
        """Keep the reports of instances from before a moment [s]."""
        for one in at.measurements:
            if one.instances is None:
                continue
            numbers, times = one.instances
            early = np.flatnonzero(times < until)
            if len(early):
                reports = zip(numbers[early].tolist(), one.reports(at, early), strict=True)
                self.past.reports.setdefault(one.name, {}).update(reports)

    def covariance(self, n: int) -> Array:
        """Covariance ``(3, 3)`` of a keyframe, by its place in order, in the output axes."""
        R = pose_rotation(self.window.pose[[n], 2])[0]
        return R @ self.isam.covariance([X(self.window.keyframes[n])]) @ R.T

    # Decisions

    def decide(self, measurements: Sequence[Measurement]) -> bool:
        """Keep what was decided about measurements; whether that changes anything."""
        changed = False
        for one in measurements:
            if decided := one.decisions():
                known = self.decisions.get(one.name, {})
                merged = _merged(known, decided)
                changed |= not _same(known, merged)
                self.decisions[one.name] = merged
        return changed

    def batch_graph(self) -> WalkGraph:
        """The window as the batch has it."""
        window, steps = self.window, self.window.steps.steps
        raw = [data for one in self.collectors for data in one.complete(steps)]
        data = [
            one for one in self.log.until(np.inf if window.finished else steps.end) if type(one) not in map(type, raw)
        ]
        prior = Prior(**{**vars(self.prior), "mean": tuple(self.c_prior[0].tolist())})
        labels = None if window.known_plan is None else window.row_labels()
        graph = WalkGraph.of(steps, [*data, *raw], floor=window.known_plan, floors=labels, prior=prior)
        return graph.decided({name: known for name, known in self.decisions.items() if "number" not in known})

    def checkpoint(self) -> LiveGraphCheckpoint:
        """All that the rest of the walk depends on."""
        self.let_go()
        brought = [name for name, one in self.isam.factors.items() if not one.poses]
        keyframe, hold = self._hold
        return LiveGraphCheckpoint(
            window=self.window.checkpoint(),
            past=self.past.checkpoint(),
            isam=self.isam.checkpoint(),
            tables=self.log.checkpoint(),
            collectors=[one.checkpoint() for one in self.collectors],
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
        """Go on from a checkpoint, with the same prior, lag, plan and collectors."""
        self.log.restore(checkpoint.tables)
        self.decisions, self.too_late = checkpoint.decisions, checkpoint.too_late
        self.c_prior, self._begins = (checkpoint.c_mean, checkpoint.c_covariance), checkpoint.begins
        self._hold = checkpoint.hold_keyframe, StartFactor(checkpoint.hold_pose, checkpoint.hold_sigmas)
        self._arrivals = list(checkpoint.arrivals)
        self.past.restore(checkpoint.past)
        for one, known in zip(self.collectors, checkpoint.collectors, strict=True):
            one.restore(known)
        self.window.restore(checkpoint.window)
        isam = TransactionalISAM.restored(checkpoint.isam)
        if self.window.keyframes:
            self.window.read(isam.values)
            self.window.associate_walls(ALL)
            self.start_at(isam, [(name, number) for name, number in checkpoint.brought])


def _same(one: Mapping[str, AnyArray], other: Mapping[str, AnyArray]) -> bool:
    """Whether two sets of decisions are the same."""
    if one.keys() != other.keys():
        return False
    return all(np.array_equal(one[name], rows, equal_nan=rows.dtype == float) for name, rows in other.items())


def _merged(old: Mapping[str, AnyArray], new: dict[str, AnyArray]) -> dict[str, AnyArray]:
    """Decisions about instances by number: the new ones, and the old ones about others."""
    if "number" not in new or not old:
        return new
    if np.array_equal(old["number"], new["number"]):
        return new
    kept = ~np.isin(old["number"], new["number"])
    joined = {name: np.concatenate([old[name][kept], column]) for name, column in new.items()}
    order = np.argsort(joined["number"])
    return {name: column[order] for name, column in joined.items()}
