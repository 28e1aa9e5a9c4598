"""The factor graph of a walk under way: the batch's factors over a window, smoothed by iSAM2.

Measurements are the same objects as the batch's, made from the rows in the window. iSAM2 has them as its factors
(`IncrementalSmoother`), takes an update at each keyframe, and marginalises those that leave. Where the walk is placed
anew, by the batch or by an answer, iSAM2 begins again from the factors and the marginal.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pdr_graph.estimation.factors.base import CALIBRATION, POSE, AnyArray, Itemized, Measurement, State, decisions_of
from pdr_graph.estimation.factors.chain import DECIMALS, Chain, Evaluation, Priors
from pdr_graph.estimation.factors.marginal import MarginalFactor
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
from pdr_graph.estimation.linear_system import RESCUING, NormalEquations
from pdr_graph.estimation.live.finalization import Excess, FinalizedTrajectory
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
from pdr_graph.estimation.optimizer import LONGEST_MOVE, descended
from pdr_graph.floor.building import Building, FloorSequence
from pdr_graph.gait.step_chunks import concatenate_steps
from pdr_graph.geometry import differences, pose_rotation
from pdr_graph.types import Array, Index, Steps, row_columns, take

if TYPE_CHECKING:
    from pdr_graph.estimation.incremental import IncrementalSmoother
    from pdr_graph.floor.paths import PathNetwork

UPDATES = 4  # most of iSAM2 after a keyframe
STEPS = 3 * UPDATES  # most of the damped search, on which a push waits
LEAVE_EVERY = 5.0  # [s] between departures of keyframes from the window: covariances of rows are linear between
MOST_KEPT_REASONS = 100  # reasons that are kept
LEAST_RISE = 0.01  # of the cost, that is no rounding error


class LiveGraph:
    """The factors of a walk under way, and the search for their optimum.

    prior, plan, paths: as of ``WalkGraph``; lag: keyframes older than this leave the window [s]; floor: label of the
    first floor.
    leaving_after: the lag in force, infinite until the walk is placed [s]; marginals: of variables that have left;
    c_prior: mean and covariance of the first calibration in the window; decisions: about measurements, by kind, never
    changed in place, since copies and open questions have them too; too_late: number of measurements from before the
    window; excess: what the stated covariance has beside that of the factors; failures: why iSAM2 was rebuilt;
    updates: number of updates of iSAM2, or beginnings.
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
        self.too_late, self.excess, self.failures, self.updates = 0, Excess(), list[str](), 0
        self._searched = -1  # keyframe at which the damped search was used last
        self._begins, self._hold = 0, (0, first_pose_prior(np.zeros(3)))
        self._arrivals = list[float]()  # times of measurements that the steps have not reached
        self._others: dict[str, dict[int, Array]] = {}  # estimates of the variables that measurements add
        self._priors: Priors = frozenset()  # of these variables, those that hold
        self._factors: WalkGraph | None = None
        self._version = 0  # of the rows that `_factors` has
        self._measurements, self._measured_at = list[Measurement](), (-1, False)  # not bound to a chain
        self._equations = list[NormalEquations]()
        self._isam: IncrementalSmoother | None = None
        self._at: Evaluation | None = None  # at its estimate

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
            if early.any():
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
        if ends:  # the last interval links its calibration to the next; some keyframes leave at once
            leaving = int(np.searchsorted(window.times[:-2], ends[-1] - self.leaving_after))
            if leaving and window.times[leaving] > window.times[0] + LEAVE_EVERY:
                self._leave(leaving)
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
    def factors(self) -> WalkGraph:
        """All factors of the window, with its present estimate."""
        if self._factors is None or self._version != self.log.version:
            self._factors, self._version = self._built(), self.log.version
        return self._factors

    def _built(self) -> WalkGraph:
        window = self.window
        floors = window.floors()
        chain, kinds, state = self._kinds(floors)
        self.marginals = [left for marginal in self.marginals if (left := marginal.among(state))]
        self._add_priors(chain, state, tuple(kinds))
        measurements, prior, steps = (*kinds, *self.marginals), self.prior_in_force, window.steps.steps
        return WalkGraph.under_way(steps, chain, measurements, state, prior, floors, self._priors, self._equations)

    def _kinds(self, floors: FloorSequence | None) -> tuple[Chain, list[Measurement], State]:
        """The chain of the window, its measurement kinds without marginals, its variables; floors: of its pieces."""
        window, chain = self.window, self.window.chain()
        steps = window.steps.steps
        if self._measured_at != (measured_at := (self.log.version, window.finished)):
            end = np.inf if window.finished else window.times[-1]
            self._measurements = self.log.measurements(steps, self.prior_in_force, window.times[0], end, self.decisions)
            self._measured_at = measured_at
        ways = [kind.continued(self.decisions.get(kind.name, {})) for kind in ways_of(self.paths)]
        kinds = [steps_between_keyframes(), *(measurement.bind(chain) for measurement in (*self._measurements, *ways))]

        # Priors of calibration and first pose, while these are in the window; walls and corridors, if the plan is used
        begins = np.flatnonzero(chain.segment_number == self._begins).tolist()
        kinds.append(calibration_prior(dict.fromkeys(begins, self.c_prior), self.prior.change))
        if chain.number[0] == self._hold[0]:
            kinds.append(self._hold[1])
        if (walls := window.walls(floors)) is not None:
            kinds.append(walls)
        if window.intervals and self.prior.corridors and floors is not None:
            at = chain.evaluate(window.state(chain))
            kinds += [kind.associated(at) for kind in corridors_of(floors, self.prior)]

        return chain, kinds, window.state(chain, kinds, self._others)

    def _marginalize(self, left: Evaluation) -> None:
        """Let iSAM2 marginalise the variables that the window does not have any more; the marginal has their priors."""
        own = left.state.arrays.keys() <= {POSE, CALIBRATION}
        state = self.window.state(self.window.chain()) if own else self._kinds(self.window.floors())[2]
        present = set(_names(state))
        leaving = [name for name in _names(left.state) if name not in present]
        gone = set(leaving)
        for block in left.blocks if self._priors else ():
            if block.prior:
                numbers = [(symbol, left.state.number(symbol)[rows].tolist()) for symbol, rows in block.variables]
                bound = [any((symbol, of[n]) in gone for symbol, of in numbers) for n in range(len(block))]
                self._priors -= {(block.name, number) for number in block.number[bound].tolist()}
        self.marginals = [marginal for marginal in self.marginals if gone.isdisjoint(marginal.names)]
        self._others = {  # the offset of a receiver may come back with its next fix: it needs its prior again
            symbol: {number: value for number, value in rows.items() if (symbol, number) not in gone}
            for symbol, rows in self._others.items()
        }
        assert self._isam is not None
        try:
            self._isam.leave(leaving)
        except RuntimeError as error:
            self._fail(error)
            self._read()

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

    # The smoother

    @property
    def isam(self) -> IncrementalSmoother:
        """iSAM2, with all keyframes of the window; measurements since then are for the next `solve`."""
        if self._isam is None or len(self._isam.estimate.poses) != len(self.window.keyframes):
            self._update()
        assert self._isam is not None
        return self._isam

    def approach(self) -> None:
        """Update iSAM2 once, and let the window go towards its estimate, between walls as far as a step of the search.

        Decisions about outliers are made there: an estimate that has stretched the walk to a wrong fix would find none.
        """
        before = self.factors.start
        self.solve()
        walk, estimate = self.isam.walk, self.isam.estimate
        same = all(np.array_equal(before.number(s), estimate.number(s)) for s in estimate.arrays)
        furthest = np.abs(estimate.poses - before.poses)[:, :2].max() if walk.walled and same else 0.0
        if furthest > LONGEST_MOVE:
            share, moves = LONGEST_MOVE / furthest, {s: estimate[s] - before[s] for s in estimate.arrays}
            moves[POSE] = differences(estimate.poses, before.poses)
            near = estimate.replaced(**{s: before[s] + share * move for s, move in moves.items()})
            self._at = walk.evaluate(near)
            self.window.read(near)

    def solve(self, updates: int = 1) -> None:
        """Update iSAM2 with all measurements, and again up to ``updates`` times while its estimate moves."""
        if self._isam is not None and self._at is not None and self._at.state is not self._isam.estimate:
            self._at = None  # it was approached
            self._read()
        for _ in range(updates):
            if self._isam is None or self._isam.walk is not self.factors:
                self._update()
            elif self._isam.stale or not self._isam.converged:
                self._update(again=True)
            else:
                break

    def _update(self, again: bool = False) -> None:
        """Update iSAM2 with the present factors, or with the factors that it has; rebuild it where it cannot go on."""
        factors = self.factors
        try:
            if self._isam is None:
                self._begin(self._search(factors))
            elif self._isam.stale:
                self._begin(self.frozen())
            else:
                if self._at is not None:
                    self._at.forget_blocks()
                self._at = None
                self._isam.again() if again else self._isam.update(factors)
                self._damp(self._isam)
        except (RuntimeError, IndexError, np.linalg.LinAlgError) as error:
            self._fail(error)
        self.updates += 1
        self._read()

    @property
    def _is_searched(self) -> bool:
        """True if the damped search has solved the window since the last keyframe."""
        return self._searched == self.window.keyframes[-1]

    def _damp(self, isam: IncrementalSmoother) -> None:
        """Rebuild iSAM2 if its step has raised the cost, by the damped search from where it was linearised.

        Once at a keyframe: between walls the next step may rise again, and nine rebuilds take a third of a second.
        """
        if self.at.cost <= isam.cost + LEAST_RISE:
            return
        walk = isam.walk.also(isam.marginals())
        rise = walk.evaluate(isam.estimate).cost - walk.evaluate(isam.point).cost
        if not rise <= LEAST_RISE and self._is_searched:
            isam.estimate, self._at = isam.point, None
        elif not rise <= LEAST_RISE:
            self._log_failure(f"an update raised the cost by {rise:.3g}")
            self._begin(self._search(self.frozen()))

    def _search(self, walk: WalkGraph) -> WalkGraph:
        """The walk at the optimum near its start, by the damped search."""
        self._searched = self.window.keyframes[-1]
        return walk.at(descended(walk, STEPS).state)

    def _begin(self, walk: WalkGraph) -> None:
        """Begin iSAM2 with a walk, which has the marginal of what has left."""
        self._isam, self._at = isam, _ = _begun(walk), None
        if not self.at.cost <= isam.cost + LEAST_RISE:  # far from the optimum still: the next updates are damped too
            isam.estimate, self._at = isam.point, None
        self.marginals = [kind for kind in walk.measurements if isinstance(kind, MarginalFactor)]
        self._factors, self._version = walk, self.log.version

    def _fail(self, error: Exception) -> None:
        """Rebuild iSAM2 after factors that it cannot solve; with those that no search can, without the marginal."""
        self._log_failure(str(error).strip().splitlines()[0])
        try:
            self._begin(self._search(self.frozen()))
        except (RuntimeError, IndexError, np.linalg.LinAlgError):
            self.restart(self.leaving_after)
            self._begin(self._search(self.factors))

    def _log_failure(self, reason: str) -> None:
        self.failures = [*self.failures, f"{reason[:100]}, at {self.window.times[-1]:.0f} s"][-MOST_KEPT_REASONS:]

    def frozen(self) -> WalkGraph:
        """The graph of the window as it is now, with the marginal of what has left, at the estimate."""
        walk, marginals = self.factors, [] if self._isam is None else self._isam.marginals()
        state = self.window.state(walk.chain, walk.measurements, self._others)
        return walk.at(state).also([left for marginal in marginals if (left := marginal.among(state))])

    def _read(self) -> None:
        """Copy the estimate to the window."""
        assert self._isam is not None
        self.window.read(self._isam.estimate)
        self._store(self._isam.estimate)

    def _store(self, state: State) -> None:
        """Copy the estimates of the variables that measurements add."""
        self._others = {
            symbol: dict(zip(state.number(symbol).tolist(), rows, strict=True))
            for symbol, rows in state.arrays.items()
            if symbol not in (POSE, CALIBRATION)
        }

    def moved(self) -> None:
        """Rebuild iSAM2 from the window's poses, which were set by others."""
        if self._isam is not None:
            self.marginals += self._isam.marginals()
        self._isam = self._at = self._factors = None

    def place_on(self, path: Path) -> None:
        """Move the window to a path, without a solution there; keyframes after its end are dead-reckoned."""
        self.window.place_on(path)
        self.moved()

    def move_to(self, path: Path) -> None:
        """Move the window to a path, with the walls there."""
        self.place_on(path)
        self.walls_changed()  # or the walls of the path that is left would pull at the first solution
        self.solve()

    def restart(self, lag: float) -> None:
        """Forget what has left the window; keyframes leave after ``lag`` [s] from now on."""
        self.leaving_after, self._isam, self.marginals = lag, None, []
        self._others, self._priors = {}, frozenset()
        self._begins, pose = self.window.segments[0], self.window.pose[0].copy()
        hold = first_heading_prior(float(pose[2])) if self.has_position else first_pose_prior(pose)
        self._hold = self.window.keyframes[0], hold
        self.log.version += 1  # the decisions may have changed
        self.moved()

    def walls_changed(self, pieces: int | None = None) -> bool:
        """Associate the last ``pieces``, or all, with walls; True if any piece has other walls than before."""
        changed = self.window.associate_walls(pieces)
        self._factors = None if changed else self._factors
        return changed

    @property
    def at(self) -> Evaluation:
        """The window's factors at the estimate."""
        isam = self.isam
        if self._at is None:
            self._at = isam.walk.evaluate(isam.estimate)
        return self._at

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
        return R @ self.isam.joint((POSE, np.array([row])))[0] @ R.T

    def calibration_covariance(self) -> Array:
        """Covariances ``(s, 3, 3)`` of the calibrations in the window."""
        return self.isam.joint((CALIBRATION, np.arange(len(self.at.state.c))))

    # Keyframes out

    def _leave(self, count: int) -> None:
        """Marginalise the first ``count`` keyframes; their rows and reports are finalised."""
        window, until = self.window, self.window.times[count]
        if min(self._arrivals, default=until) < until:  # a late measurement is of the past
            self._update()
        at, start, edge = self.at, window.pose[0].copy() if window.complete else None, self.covariance(count)
        for measurement in at.measurements:
            numbers, times = measurement.instances if isinstance(measurement, Itemized) else (np.empty(0), np.empty(0))
            early = np.flatnonzero(times < until)
            if len(early):
                reports = zip(numbers[early].tolist(), measurement.reports(at, early), strict=True)
                self.finalized.reports.setdefault(measurement.name, {}).update(reports)
        leaving = window.intervals[:count]
        window.forget(count)
        if start is not None and self.has_position:
            self.finalized.begin(start, window.pose[0], edge)
        self.finalized.take(leaving, at, start, edge)
        if not self.finalized.anchored:
            self.finalized.hinge = window.pose[0].copy()
        for store in (self.log, *self.collectors):
            store.forget(until)
        self.decisions = (self.log.longer or self.log).present(self.decisions)
        self._arrivals = [time for time in self._arrivals if time >= until]
        self._factors = self._at = None
        self._marginalize(at)

    # Decisions, and the batch of the window

    def store_decisions(self, measurements: Sequence[Measurement]) -> bool:
        """Store the decisions about measurements; True if any has changed."""
        changed = False
        for measurement in measurements:
            if decided := decisions_of(measurement):
                stored = self.decisions.get(measurement.name, {})
                merged = merged_decisions(stored, decided)
                changed |= not same_decisions(stored, merged)
                self.decisions = self.decisions | {measurement.name: merged}
        return changed

    def decide(self, decisions: Decisions) -> None:
        """Replace the decisions about measurements."""
        self.decisions = decisions
        self.log.version += 1

    def batch_graph(
        self, decided: bool = True, c: Array | None = None, but: str = "", tail: Sequence[Steps] = ()
    ) -> Callable[[], WalkGraph]:
        """A function that builds the batch's graph of the present window, at any later time and in any thread.

        decided: with the decisions about whole kinds (relocated beacons).
        c: mean ``(3,)`` of the calibration, by default that of `c_prior`; but: source of fixes and headings left out;
        tail: provisional steps that follow those of the window.
        """
        window, steps = self.window, concatenate_steps([self.window.steps.steps, *tail])
        covered = window.covered if not tail else tail[-1].end
        raw = [data for collector in self.collectors for data in collector.complete(steps)]
        data = [rows for rows in self.log.until(covered) if type(rows) not in map(type, raw)]
        for n, rows in enumerate(data if but else ()):
            if "source" in row_columns(rows):
                data[n] = take(rows, np.flatnonzero(np.array(rows.source) != but))
        prior, mean = self.prior_in_force, self.c_prior[0] if c is None else c
        same_walker = decided or prior is self.prior  # else the batch decides anew who walks
        prior = replace(prior, mean=tuple(mean.tolist())) if same_walker else self.prior
        plan, labels = window.located_plan, None if window.located_plan is None else window.row_labels(steps)
        of_kinds = {name: rows for name, rows in self.decisions.items() if decided and "number" not in rows}
        of_kinds.pop(WALKER_KIND, None)  # it is in the prior

        def build() -> WalkGraph:
            paths = None if decided or self.paths is None else self.paths.around(data)
            options = {"floor": plan, "floors": labels, "prior": prior, "paths": paths}
            return WalkGraph.of(steps, [*data, *raw], **options).decided(of_kinds)

        return build


def _begun(walk: WalkGraph) -> IncrementalSmoother:
    """iSAM2 with a walk; variables that its factors do not determine are held a little where they are."""
    from pdr_graph.estimation.incremental import IncrementalSmoother  # here, since GTSAM is slow to load

    for least in RESCUING[:-1]:
        with suppress(RuntimeError):
            return IncrementalSmoother(walk, least)
    return IncrementalSmoother(walk, RESCUING[-1])


def same_decisions(one: Mapping[str, AnyArray], other: Mapping[str, AnyArray]) -> bool:
    """True if decisions about a kind are the same."""
    return one.keys() == other.keys() and all(
        np.array_equal(one[name], rows, equal_nan=rows.dtype == float) for name, rows in other.items()
    )


def _names(state: State) -> list[tuple[str, int]]:
    """Symbol and number of each variable."""
    return [(symbol, number) for symbol in state.arrays for number in state.number(symbol).tolist()]
