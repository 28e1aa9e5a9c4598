"""The factor graph of a walk under way: the factors of a window, and the marginal of finalised variables.

The incremental solver receives the factors linearised at the estimate, and again when a variable has moved.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from copy import copy
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from pdr_graph.estimation.ambiguity.review import Excess
from pdr_graph.estimation.factors.base import insert
from pdr_graph.estimation.factors.chain import Evaluation
from pdr_graph.estimation.factors.start import Prior, StartFactor
from pdr_graph.estimation.factors.steps_and_walls import WallFactor
from pdr_graph.estimation.live.finalization import COVARIANCE_INTERVAL, FinalizedCheckpoint, FinalizedTrajectory
from pdr_graph.estimation.live.isam import IsamCheckpoint, Linear, Name, TransactionalISAM
from pdr_graph.estimation.live.measurement_log import (
    WAITING,
    Decisions,
    TableCheckpoint,
)
from pdr_graph.estimation.live.nearby_optimum import restart_nearby
from pdr_graph.estimation.live.step_buffer import CLOSE, Interval
from pdr_graph.estimation.live.window import ALL, WindowCheckpoint
from pdr_graph.estimation.live.window_graph import WindowGraph
from pdr_graph.floor.building import Building
from pdr_graph.geometry import pose_rotation, wrap_angle
from pdr_graph.types import Array, Index, Sightings

RECENT = 150  # intervals that each update evaluates, chosen by hand
FULL_CHECK = 25  # keyframes after which a relinearisation evaluates all intervals, chosen by hand
OVERSHOT, ROUNDS = 10.0, 5  # [nats] by which a solution between walls may cost more than what it was linearised at,
# until it is sought again by damped steps; most of these steps. Both are chosen by hand
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


class LiveGraph(WindowGraph):
    """The factors of a walk under way, and the solver that they go to; arguments as of `WindowGraph`.

    too_late: number of measurements from before the window; excess: what the stated covariance has beside the solver's.
    """

    def __init__(self, prior: Prior | None = None, lag: float = np.inf, plan: Building | None = None, floor: str = ""):
        super().__init__(prior, lag, plan, floor)
        self.finalized = FinalizedTrajectory()
        self.too_late, self.excess = 0, Excess.none()
        self._arrivals = list[float]()
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

    def set_goings(self, goings: Array) -> None:
        """Give the steps on stairs the length of the treads, see `StepBuffer`."""
        if self.window.set_goings(goings):
            self._current = self._checked_poses = None
            self.log.version += 1

    def collect(self, received: Sightings, radio: str) -> bool:
        """Pass receptions of a radio to all collectors; True if one of them uses any."""
        return any([collector.collect(received, radio) for collector in self.collectors])

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

    def update(self, everything: bool = False) -> None:
        """Update the solver with new factors, and with those that must be relinearised."""
        self.finalize_leaving()
        at = self.evaluate(everything)
        values, times = self._new_variables(at)
        self._update(at, self._changes(at), values, times)

    def relinearize(self) -> bool:
        """Relinearise factors whose variables have moved; False if there were none."""
        if self._unmoved():
            return False
        self.finalize_leaving()
        at = self.evaluate(everything=self.window.count % FULL_CHECK == 0)
        return self._update(at, self._changes(at))

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
        isam.start(self._all_factors(again))
        self._read()

    def place(self, isam: TransactionalISAM) -> None:
        """Use this solver, which need not have started, and move the window to its values."""
        self.isam = isam
        self.window.read(isam.values)

    def outside(self, factors: Mapping[Name, Linear]) -> dict[Name, Linear]:
        """Those of some factors that no evaluation of the window has, since the solver is about to forget a variable.

        A solver that replaces theirs must absorb them, or their information is lost.
        """
        at = self.evaluate(everything=True)
        inside, listed = set(at.state.keys("x").tolist()), {(b.name, n) for b in at.blocks for n in b.number.tolist()}
        return {
            name: factor
            for name, factor in factors.items()
            if name not in listed and not (factor.poses and inside.issuperset(factor.poses))
        }

    def linearized(self, again: Collection[Name]) -> gtsam.GaussianFactorGraph:
        """The factors and the marginal at the estimate, for a solver that has not started; again: see above."""
        self.isam.factors = self._all_factors(again)
        return self.isam.linearized()

    def _all_factors(self, again: Collection[Name]) -> dict[Name, Linear]:
        """All factors for a solver that has not started; it gets missing variables."""
        at = self.evaluate(everything=True)
        obsolete = set(self.isam.obsolete(at.blocks, at.state))
        remaining = {name: factor for name, factor in self.isam.factors.items() if name not in obsolete}
        factors = remaining | self._changes(at, again=again)
        self.isam.insert(*self._new_variables(at))  # after the priors of new variables were found to be missing
        return factors

    def _changes(self, at: Evaluation, again: Collection[Name] = ()) -> dict[Name, Linear]:
        """New and relinearised factors of the evaluation ``at``."""
        self._checked_poses = self.window.pose.copy()
        blocks = (self.isam.changes(block, at.state, again) for block in at.blocks)
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
        at: Evaluation,
        add: Mapping[Name, Linear],
        values: gtsam.Values | None = None,
        times: dict[int, float] | None = None,
    ) -> bool:
        """Update the solver and copy its estimate to the window; False if nothing has changed.

        at: the present estimate; add: factors linearised there; values, times: of new variables. A solution that costs
        much more than ``at`` has crossed walls that held nothing before: it is sought again from there.
        """
        remove = self.isam.obsolete(at.blocks, at.state)
        if not (add or remove or values is not None):
            return False
        window, walled = self.window, self.window.located_plan is not None
        before = (self.isam.moved(self.isam.values), window.pose, dict(window.c)) if walled else None
        self.isam.update(add, remove, values, times)
        self._read()
        whole = at.chain.number[0] == window.keyframes[0]
        if before is not None and self.evaluate(everything=whole).cost > at.cost + OVERSHOT:
            (self.isam, window.pose, window.c), self._leaving = before, 0
            restart_nearby(self, self.isam.factors, ROUNDS)
        return True

    def _read(self) -> None:
        """Copy the estimate of the solver to the window."""
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

    def copy(self) -> LiveGraph:
        """An independent graph of the same window, without rows and reports; its solver has no factors yet."""
        other = copy(self)
        other.window, other.log = self.window.copy(), self.log.copy()
        other.isam = self.isam.with_values(self.isam.values)
        other.isam.absorb(self.outside(self.isam.factors))
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
            isam=self.isam.checkpoint(self.outside(self.isam.factors)),
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
            self.place(isam)
            self.window.associate_walls(ALL)
            self.restart_solver(isam, [(name, number) for name, number in checkpoint.brought])
