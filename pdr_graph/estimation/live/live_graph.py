"""The factor graph of a walk under way: the batch's factors over a window, and the marginal of what has left it.

Measurements are the same objects as the batch's, made from the rows in the window, and the search is the batch's
(`Descent`), a few steps at a time. A keyframe that leaves the window is marginalised (`MarginalFactor`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pdr_graph.estimation.factors.base import CALIBRATION, POSE, Itemized, Measurement, State, decisions_of
from pdr_graph.estimation.factors.chain import DECIMALS, Chain, Evaluation, Priors
from pdr_graph.estimation.factors.registry import corridors_of, ways_of
from pdr_graph.estimation.factors.start import (
    WALKER_KIND,
    Prior,
    calibration_prior,
    first_heading_prior,
    first_pose_prior,
)
from pdr_graph.estimation.factors.steps_and_walls import steps_between_keyframes
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.linear_system import NormalEquations, Solution
from pdr_graph.estimation.live.finalization import Excess, FinalizedTrajectory, MarginalFactor, marginalized
from pdr_graph.estimation.live.window import (
    CLOSE,
    WAITING,
    Collector,
    Decisions,
    Interval,
    MeasurementLog,
    Path,
    Window,
    merged_decisions,
)
from pdr_graph.estimation.optimizer import Descent
from pdr_graph.floor.building import Building
from pdr_graph.geometry import pose_rotation
from pdr_graph.priors import SCHEDULE
from pdr_graph.types import Array, Index, row_columns, take

if TYPE_CHECKING:
    from pdr_graph.floor.paths import PathNetwork

MOST_REASONS = 100  # reasons that are kept


@dataclass(frozen=True, eq=False)
class WindowFactors:
    """All factors of a window, as `optimizer.Factors`.

    priors: those of variables that measurements add which hold, see `Evaluation`; start: the present estimate.
    """

    chain: Chain
    measurements: tuple[Measurement, ...]
    priors: Priors
    walled: bool
    start: State
    known: list[NormalEquations]

    def evaluate(self, state: State) -> Evaluation:
        """All factors at one state."""
        return self.chain.evaluate(state, self.measurements, self.priors)

    def normal_equations(self, at: Evaluation) -> NormalEquations:
        """The normal equations of the factors at ``at``; those of the last window if it has the same blocks."""
        if not (self.known and self.known[0].fits(at)):
            self.known[:] = [NormalEquations(at)]
        return self.known[0]


class LiveGraph:
    """The factors of a walk under way, and the search for their optimum.

    prior, plan, paths: as of ``WalkGraph``; lag: keyframes older than this leave the window [s]; floor: label of the
    first floor.
    leaving_after: the lag in force, infinite until the walk is placed [s]; marginals: of variables that have left;
    c_prior: mean and covariance of the first calibration in the window; decisions: about measurements, by kind, never
    changed in place, since copies and open questions have them too; too_late: number of measurements from before the
    window; excess: what the stated covariance has beside that of the factors; failures: why the search began anew.
    """

    def __init__(
        self,
        prior: Prior | None = None,
        lag: float = np.inf,
        plan: Building | None = None,
        floor: str = "",
        paths: PathNetwork | None = None,
    ):
        self.prior, self.lag, self.paths = prior or Prior(), lag, paths
        if plan is not None and len(plan.labels) == 1:
            floor = plan.labels[0]
        self.window, self.log = Window(self.prior, plan, floor), MeasurementLog()
        self.finalized, self.collectors = FinalizedTrajectory(), list[Collector]()
        self.leaving_after, self.marginals = lag, list[MarginalFactor]()
        self.c_prior = np.array(self.prior.mean), self.prior.covariance
        self.decisions: Decisions = {}
        self.too_late, self.excess, self.failures, self.iterations = 0, Excess(), list[str](), 0
        self._begins, self._hold = 0, (0, first_pose_prior(np.zeros(3)))
        self._arrivals = list[float]()  # times of measurements that the steps have not reached
        self._others: dict[str, dict[int, Array]] = {}  # estimates of the variables that measurements add
        self._priors: Priors = frozenset()  # of these variables, those that hold
        self._factors: WindowFactors | None = None
        self._version = 0  # of the rows that `_factors` has
        self._measurements, self._measured_at = list[Measurement](), (-1, False)  # not bound to a chain
        self._equations = list[NormalEquations]()
        self._search: Descent | None = None
        self._left: Evaluation | None = None  # with keyframes that have left, whose marginal is due

    # Steps and measurements in

    def begin(self) -> None:
        """Set the first keyframe, at the start of the steps."""
        self.window.begin()
        self.finalized.edge = self.window.times[0], self.finalized.edge[1]
        self.log.forget(self.window.times[0] - self.log.longest_overhang)

    def append(self, data: Any, number: Index | None = None) -> Array:
        """Append measurements; those from before the window are dropped and counted as late.

        Returns the times of the others [s].
        """
        times = np.round(np.asarray(data.time, dtype=np.float64), DECIMALS)
        if self.window.times:
            early = times < self.window.times[0] - self.log.overhang(data)
            self.too_late += int(early.sum())
            kept = np.flatnonzero(~early if early.ndim == 1 else ~early.any(axis=1))
            data, times, number = take(data, kept), times[kept], None if number is None else number[kept]
        if len(times):
            self.log.append(data, number)
            self._arrivals += times.ravel().tolist()
        if not self.window.times:
            self.log.keep_latest()
            del self._arrivals[:-WAITING]
        return times

    def rewind(self, to: float) -> None:
        """Drop the steps and keyframes after ``to`` [s], and the decisions about measurements since; these remain."""
        self.window.rewind(to)
        end = self.window.times[-1]
        self._arrivals = [time for time in self.log.times() if time > end + CLOSE]
        for name, numbers in self.log.all_numbers(end).items():
            if "number" in (rows := self.decisions.get(name, {})):
                kept = np.isin(rows["number"], numbers)
                self.decisions = self.decisions | {name: {column: values[kept] for column, values in rows.items()}}
        self.log.version += 1
        self.moved()

    def close_keyframes(self, at_end: bool = False) -> tuple[list[Interval], bool]:
        """Close the keyframes due after new steps and measurements; those older than the lag leave.

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
            # The last interval links its calibration to the next
            self._leave(int(np.searchsorted(window.times[:-2], ends[-1] - self.leaving_after)))
        new = window.cut(ends)
        for time in reached:
            window.split(time)
        self._arrivals = [] if at_end else [time for time in self._arrivals if time > covered + CLOSE]
        self._factors = None if new or reached else self._factors
        self.log.version += bool(reached)
        return new, bool(reached)

    # Factors

    @property
    def prior_in_force(self) -> Prior:
        """The prior, or that of another walker if this was decided."""
        another = self.prior.another if self.decisions.get(WALKER_KIND) else None
        return another or self.prior

    @property
    def has_position(self) -> bool:
        """True if a measurement in the window determines a position."""
        times = self.log.position_times()
        return bool(len(times)) and bool(self.window.times) and float(times.min()) <= self.window.times[-1] + CLOSE

    @property
    def factors(self) -> WindowFactors:
        """All factors of the window, with its present estimate."""
        if self._factors is None or self._version != self.log.version:
            self._factors, self._version = self._built(), self.log.version
        return self._factors

    def _built(self) -> WindowFactors:
        window, chain = self.window, self.window.chain()
        if self._measured_at != (measured_at := (self.log.version, window.finished)):
            end = np.inf if window.finished else window.times[-1]
            steps = window.steps.steps
            self._measurements = self.log.measurements(steps, self.prior_in_force, window.times[0], end, self.decisions)
            self._measured_at = measured_at
        ways = [kind.continued(self.decisions.get(kind.name, {})) for kind in ways_of(self.paths)]
        kinds = [steps_between_keyframes(), *(measurement.bind(chain) for measurement in (*self._measurements, *ways))]

        # Priors of calibration and first pose, while these are in the window; walls and corridors, if the plan is used
        begins = np.flatnonzero(chain.segment_number == self._begins).tolist()
        kinds.append(calibration_prior(dict.fromkeys(begins, self.c_prior), self.prior.change))
        if chain.number[0] == self._hold[0]:
            kinds.append(self._hold[1])
        if (walls := window.walls) is not None:
            kinds.append(walls)
        if window.intervals and self.prior.corridors and (floors := window.floors()) is not None:
            at = chain.evaluate(window.state(chain))
            kinds += [kind.associated(at) for kind in corridors_of(floors, self.prior)]

        # The marginal of variables that have left
        state = window.state(chain, kinds, self._others)
        if self._left is not None:
            names, present = _names(self._left.state), set(_names(state))
            marginal, absorbed = marginalized(self._left, np.array([name not in present for name in names]))
            kept = [old for old in self.marginals if present.issuperset(old.names)]
            self.marginals, self._priors, self._left = [*kept, *filter(None, [marginal])], self._priors - absorbed, None
        self.marginals = [left for marginal in self.marginals if (left := marginal.among(state))]
        self._add_priors(chain, state, tuple(kinds))
        measurements, walled = (*kinds, *self.marginals), window.located_plan is not None
        return WindowFactors(chain, measurements, self._priors, walled, state, self._equations)

    def _add_priors(self, chain: Chain, state: State, measurements: tuple[Measurement, ...]) -> None:
        """Let the priors of variables that are new hold.

        The first node of a receiver's error in a window has one too, but what it had before is in the marginal.
        """
        new = {
            symbol: np.array([number not in self._others.get(symbol, {}) for number in state.number(symbol).tolist()])
            for symbol in state.arrays
            if symbol not in (POSE, CALIBRATION)
        }
        if any(added.any() for added in new.values()):
            for block in chain.evaluate(state, measurements).blocks:
                if block.prior:
                    added = np.any([new[symbol][rows] for symbol, rows in block.variables], axis=0)
                    self._priors |= {(block.name, number) for number in block.number[added].tolist()}
            self._store(state)

    # The search

    def search(self) -> Descent:
        """The search for the optimum, begun if there is none; measurements since then are for the next `solve`."""
        search = self._search
        if search is None or len(search.at.state.poses) != len(self.window.keyframes):
            return self._begun()
        return search

    def _begun(self) -> Descent:
        """Begin the search with the present factors, at the present estimate."""
        try:
            self._search = Descent(self.factors, self.factors.start)
        except RuntimeError as error:
            self._fail(error)
            self._search = Descent(self.factors, self.factors.start)
        return self._search

    def solve(self, steps: int = 1) -> bool:
        """Take so many steps of the search, with all measurements; False if it had reached the optimum before."""
        same = self._search is not None and self._search.graph is self.factors
        search, moved = self.search() if same else self._begun(), False
        for _ in range(steps):
            if search.converged:
                break
            try:
                search.step()
            except (RuntimeError, np.linalg.LinAlgError) as error:
                self._fail(error)
                search = self.search()
            self.iterations, moved = self.iterations + 1, True
        if moved:
            self.window.read(search.at.state)
            self._store(search.at.state)
        return moved

    def _store(self, state: State) -> None:
        """Copy the estimates of the variables that measurements add."""
        self._others = {
            symbol: dict(zip(state.number(symbol).tolist(), rows, strict=True))
            for symbol, rows in state.arrays.items()
            if symbol not in (POSE, CALIBRATION)
        }

    def _fail(self, error: Exception) -> None:
        """Begin anew without the marginal, after factors that cannot be solved; measurements in it are left out."""
        self.failures = [*self.failures, str(error).splitlines()[0][:100]][-MOST_REASONS:]
        self.restart(self.leaving_after)

    def moved(self) -> None:
        """Search from the window's poses, which were set by others."""
        self._search = self._factors = None

    def place_on(self, path: Path) -> None:
        """Move the window to a path, without a solution there; keyframes after its end are dead-reckoned."""
        self.window.place_on(path)
        self.moved()

    def move_to(self, path: Path) -> None:
        """Move the window to a path, with the walls there."""
        self.place_on(path)
        self.associate_walls()  # or the walls of the path that is left would pull at the first solution
        self.solve()

    def restart(self, lag: float) -> None:
        """Forget what has left the window; keyframes leave after ``lag`` [s] from now on."""
        self.leaving_after, self.marginals, self._left = lag, [], None
        self._others, self._priors = {}, frozenset()
        self._begins, pose = self.window.segments[0], self.window.pose[0].copy()
        hold = first_heading_prior(float(pose[2])) if self.has_position else first_pose_prior(pose)
        self._hold = self.window.keyframes[0], hold
        self.log.version += 1  # the decisions may have changed
        self.moved()

    def associate_walls(self, pieces: int | None = None) -> float:
        """Associate the last ``pieces``, or all, with walls; returns the price of the regions they lead through."""
        price, changed = self.window.associate_walls(pieces)
        if changed:
            self.moved()
        return price

    @property
    def at(self) -> Evaluation:
        """The window's factors at the estimate."""
        return self.search().at

    @property
    def solution(self) -> Solution:
        """The linear system of the window, solved."""
        return self.search().system.solution

    @property
    def cost(self) -> float:
        """Half the sum of squared, robustly weighted residuals of the window."""
        return self.at.cost - sum(block.cost for block in self.at.blocks_of(MarginalFactor.name))

    def covariance(self, n: int) -> Array:
        """Stated covariance ``(3, 3)`` of the n-th keyframe of the window, in the output axes."""
        return self.solved_covariance(n) + self.excess.at(np.array([self.window.times[n]]))[0]

    def solved_covariance(self, n: int) -> Array:
        """Covariance ``(3, 3)`` of the n-th keyframe by the factors, in the output axes."""
        row = n % len(self.window.keyframes)
        R = pose_rotation(self.at.state.poses[[row], 2])[0]
        return R @ self.solution.joint((POSE, np.array([row])))[0] @ R.T

    def calibration_covariance(self) -> Array:
        """Covariances ``(s, 3, 3)`` of the calibrations in the window."""
        return self.solution.joint((CALIBRATION, np.arange(len(self.at.state.c))))

    # Keyframes out

    def _leave(self, count: int) -> None:
        """Marginalise the first ``count`` keyframes; their rows and reports are finalised."""
        if not count:
            return
        window, until = self.window, self.window.times[count]
        if min(self._arrivals, default=until) < until:
            self._search = None  # a late measurement is of the past
        at, start = self.at, window.pose[0].copy() if window.complete else None
        due = until > self.finalized.edge[0] + SCHEDULE.covariance_interval
        edge = self.covariance(count) if due or start is not None else np.eye(3)
        for measurement in at.measurements:
            numbers, times = measurement.instances if isinstance(measurement, Itemized) else (np.empty(0), np.empty(0))
            early = np.flatnonzero(times < until)
            if len(early):
                reports = zip(numbers[early].tolist(), measurement.reports(at, early), strict=True)
                self.finalized.reports.setdefault(measurement.name, {}).update(reports)
        self.finalized.take(window.intervals[:count], at, start)
        window.forget(count)
        if start is not None and self.has_position:
            self.finalized.begin(start, window.pose[0], edge)
        if not self.finalized.anchored:
            self.finalized.hinge = window.pose[0].copy()
        for store in (self.log, *self.collectors):
            store.forget(until)
        self.decisions = (self.log.longer or self.log).present(self.decisions)
        self._arrivals = [time for time in self._arrivals if time >= until]
        if due:
            self.finalized.finalize(window.times[0], edge)
        self._left, self._factors, self._search = at, None, None

    # Decisions, and the batch of the window

    def store_decisions(self, measurements: Sequence[Measurement]) -> bool:
        """Store the decisions about measurements; True if any has changed."""
        changed = False
        for measurement in measurements:
            if decided := decisions_of(measurement):
                stored = self.decisions.get(measurement.name, {})
                merged = merged_decisions(stored, decided)
                changed |= stored.keys() != merged.keys() or not all(
                    np.array_equal(stored[name], rows, equal_nan=rows.dtype == float) for name, rows in merged.items()
                )
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
        for n, rows in enumerate(data if but else ()):
            if "source" in row_columns(rows):
                data[n] = take(rows, np.flatnonzero(np.array(rows.source) != but))
        prior, mean = self.prior_in_force, self.c_prior[0] if c is None else c
        same_walker = decided or prior is self.prior  # else the batch decides anew who walks
        prior = replace(prior, mean=tuple(mean.tolist())) if same_walker else self.prior
        plan, labels = window.located_plan, None if window.located_plan is None else window.row_labels()
        of_kinds = {name: rows for name, rows in self.decisions.items() if decided and "number" not in rows}
        of_kinds.pop(WALKER_KIND, None)  # it is in the prior

        def build() -> WalkGraph:
            paths = None if decided or self.paths is None else self.paths.around(data)
            options = {"floor": plan, "floors": labels, "prior": prior, "paths": paths}
            return WalkGraph.of(steps, [*data, *raw], **options).decided(of_kinds)

        return build

    def copy(self) -> LiveGraph:
        """An independent graph of the same window, without rows and reports."""
        other = copy(self)
        other.window, other.log = self.window.copy(), self.log.copy()
        other.finalized, other.collectors, other._arrivals = FinalizedTrajectory(), [], list(self._arrivals)
        other.marginals, other._equations, other._factors, other._search = list(self.marginals), [], None, None
        return other


def _names(state: State) -> list[tuple[str, int]]:
    """Symbol and number of each variable."""
    return [(symbol, number) for symbol in state.arrays for number in state.number(symbol).tolist()]
