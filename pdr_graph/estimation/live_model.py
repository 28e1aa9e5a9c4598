"""The variables and factors of a walk under way: what was measured in its window, as factors in a `Tree`, and what is
known of the walk by them.

The own factors of an interval (steps, and walls along them) are linearised all at once here, not by callbacks, and
again when a variable has moved: what GTSAM gets is linear.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import C, X

from pdr_graph.estimation.covariance import CovarianceBlocks, covariance_of_pieces
from pdr_graph.estimation.graph import Prior
from pdr_graph.estimation.live_factors import Factors, frame_factor, own_factors
from pdr_graph.estimation.live_fixes import NONE, SLIPPING, LiveFix, report
from pdr_graph.estimation.live_observations import (
    LiveBeacons,
    LiveReceivers,
    Observation,
    SeenFix,
    SeenLevel,
    linearised,
)
from pdr_graph.estimation.live_past import SPARSE, Past, Rows
from pdr_graph.estimation.live_way import CLOSE, END, ROW, Interval
from pdr_graph.estimation.live_window import Window
from pdr_graph.estimation.native import calibration_factor, change_factor, fix_factor, heading_factor
from pdr_graph.estimation.observations import Rows as Observed
from pdr_graph.estimation.prediction import Belief, Position, predicted
from pdr_graph.estimation.preintegration import DECIMALS
from pdr_graph.estimation.receivers import LATELY
from pdr_graph.estimation.reports import prior_sigma
from pdr_graph.estimation.tree import Name, Tree
from pdr_graph.floor.building import Building
from pdr_graph.geometry import pose_rotation, wrap_angle
from pdr_graph.types import Array, Beacons, Calibration, FixReport, Headings, Sightings, Steps

# Of x_i, x_j, c, before an interval is linearised again: the steps' factor is linear in translations, that of walls not
MOVED = np.array([0.5, 0.5, 0.02] * 2 + [0.01, 0.01, 0.002])
BESIDE_WALLS = 0.15  # [m]
RECENT, EVERY = 150, 25  # intervals that are looked at each time; all are when so many keyframes have closed


@dataclass
class Pointed:
    """A walking direction that was measured. keyframe: its number, -1 before the steps have come so far."""

    time: float
    heading: float
    sigma: float
    keyframe: int = -1


class LiveModel:
    """What was measured in the window, as factors.

    lag: keyframes older than this leave the window [s]; prior, plan: as of ``WalkGraph``; floor: label of the one that
    the walk is on.
    """

    def __init__(self, prior: Prior | None = None, lag: float = np.inf, plan: Building | None = None, floor: str = ""):
        self.prior, self.lag, self.tree, self.past = prior or Prior(), lag, Tree(lag), Past()
        if plan is not None and len(plan.labels) == 1:
            floor = plan.labels[0]
        self.window = Window(self.prior, plan, floor)
        self.c_prior = np.array(self.prior.mean), self.prior.covariance
        self.sure, self.finished = False, False

        self.fixes, self.fix_count, self.too_late = list[LiveFix](), 0, 0
        self.headings, self.last_pointed = dict[int, Pointed](), -1  # the last that has left the window
        self.receivers = LiveReceivers()
        self.beacons: LiveBeacons | None = None
        self._last: tuple[gtsam.Values, Belief] | None = None

    # What comes in

    def _in_time(self, fix: LiveFix) -> bool:
        """Whether a fix is of the window, or holds at its first keyframe."""
        in_time = not self.window.times or fix.time >= self.window.times[0] or fix.hold_at(self.window.times[0])
        self.too_late += not in_time
        return in_time

    def point(self, number: int, time: float, heading: float, sigma: float) -> None:
        """A walking direction [rad]; of one number the last counts, as long as the one before is in the window.

        One of an infinite sigma tells nothing.
        """
        if number <= self.last_pointed:
            return
        known = self.headings.pop(number, None)
        if known is not None and ("heading", number) in self.tree.factors:
            self._update({}, [("heading", number)])
        if np.isfinite(sigma) and (not self.window.times or time >= self.window.times[0]):
            self.headings[number] = Pointed(round(time, DECIMALS), heading, sigma)

    def survey(self, beacons: Beacons) -> None:
        """Where beacons are, in the frame of the walk."""
        self.beacons = LiveBeacons(beacons)

    def hear(self, heard: Sightings) -> None:
        """What a radio heard; only beacons that were surveyed tell."""
        if self.beacons is not None:
            self.beacons.hear(heard)

    # What is known

    @property
    def waiting(self) -> list[LiveFix]:
        """The fixes that the steps have not reached, in order of time."""
        return sorted((fix for fix in self.fixes if not fix.reached), key=lambda fix: fix.time)

    @property
    def placed(self) -> bool:
        """Whether anything tells where the walk was."""
        return bool(self.beacons and self.beacons.levels) or any(fix.reached for fix in self.fixes)

    @property
    def cost(self) -> float:
        """Half the sum of squared, robustly weighted errors of the window."""
        values = self.tree.values
        own = self.window.evaluate(self.window.intervals).cost if self.window.intervals else 0.0
        observed = sum(rows.cost for _, _, rows, _ in self._observed(values))
        linear = self._linear_names()
        others = [factor for name, factor in self.tree.factors.items() if name not in linear]
        return own + observed + float(sum(factor.error(values) for factor in [*others, *self.tree.past]))

    def belief(self, tail: Steps | None = None, until: float | None = None) -> Belief:
        """What is believed now: of the last keyframe, through the steps and fixes since, and through a ``tail`` of
        steps that may change yet, until a moment [s].
        """
        whole, at = self.window.way.with_tail(tail), self.window.times[-1]
        end = float(whole[-1, END]) if len(whole) else at
        end = end if until is None else min(end, until)
        fixes = [
            Position(fix.time, fix.position, fix.sigma, 1 / self.receivers.alike(fix.source))
            for fix in self.waiting
            if at <= fix.time <= end
        ]
        known = self._last_belief()
        if fixes and not self.placed:
            known = known.anywhere(fixes[0].position)
        return predicted(known, whole, self.window.way.start, at, end, fixes, self.sure)

    def rows_past(self) -> list[Rows]:
        """What has left the window, and was not handed out."""
        return self.past.rows(self.window.times[0], self._covariance(0))

    def rows(self) -> Rows:
        """The walk in the window until its last keyframe, with its start and its end where these are in it."""
        window, intervals = self.window, self.window.intervals
        first = Rows(np.array(window.times[:1]), window.pose[:1], self._covariance(0)[None], [window.floor])
        if not intervals:
            return first
        own = window.evaluate(intervals)
        linear = self.tree.graph().linearize(self.tree.values)
        net = linear.eliminateSequential(gtsam.Ordering.MetisGaussianFactorGraph(linear))
        keys = [(X(one.i), X(one.j), C(one.segment)) for one in intervals]
        which = np.concatenate([n + one.row_piece for n, one in zip(own.pieces.first, intervals, strict=True)])
        covariance = covariance_of_pieces(CovarianceBlocks(net), keys, own, which)
        time = np.concatenate([one.row_time for one in intervals])
        labels = [one.label for one in intervals for _ in one.row_time]
        parts = [first] * (window.keyframes[0] == 0) + [Rows(time, own.ends[which], covariance, labels)]
        if self.finished and not (len(time) and time[-1] > window.times[-1] - CLOSE):
            end = self._covariance(-1)[None]
            parts.append(Rows(np.array(window.times[-1:]), window.pose[-1:], end, [window.floor]))
        return Rows.joined(parts)

    def rows_ahead(self, tail: Steps | None = None) -> Rows:
        """The steps since the last keyframe, as they are believed; the last row is the present."""
        whole = self.window.way.with_tail(tail)
        ends = whole[(whole[:, END] > self.window.times[-1] + CLOSE) & (whole[:, ROW] > 0), END]
        moments = np.unique(np.append(ends, whole[-1:, END]))
        moments = moments[moments > self.window.times[-1] + CLOSE]
        beliefs = [self.belief(tail, until) for until in moments.tolist()]
        pose = np.array([one.mean[:3] for one in beliefs]).reshape(-1, 3)
        covariance = np.array([one.covariance[:3, :3] for one in beliefs]).reshape(-1, 3, 3)
        return Rows(moments, pose, covariance, [self.window.floor] * len(moments))

    def reports(self) -> list[FixReport]:
        """Why each fix was trusted or not; of those that left the window, since rows were handed out."""
        return self.past.reports + [self._report(fix) for fix in sorted(self.fixes, key=lambda fix: fix.time)]

    def calibration(self) -> Calibration | None:
        """What the window tells of walker and gyroscope."""
        window, segments = self.window, self.window.segments
        if not window.intervals:
            return None
        value = np.array([window.c[segment] for segment in segments])
        covariance = np.array([self.tree.covariance([C(segment)]) for segment in segments])
        start = np.array([min(one.begin for one in window.intervals if one.segment == s) for s in segments])
        return Calibration(start, value, covariance, prior_sigma(self.prior, np.array(segments)))

    def hand_out(self) -> list[Rows]:
        """The rows that are settled, once."""
        return self.past.hand_out()

    def _report(self, fix: LiveFix) -> FixReport:
        return report(fix, self.window.pose[self.window.places([fix.keyframe])[0], :2] if fix.reached else fix.position)

    def _covariance(self, n: int) -> Array:
        """Of a keyframe, in the output axes."""
        R = pose_rotation(self.window.pose[[n], 2])[0]
        return R @ self.tree.covariance([X(self.window.keyframes[n])]) @ R.T

    def _last_belief(self) -> Belief:
        """Of the last keyframe and its calibration, at the estimate."""
        if self._last is None or self._last[0] is not self.tree.values:
            window = self.window
            T = np.eye(6)
            T[:3, :3] = pose_rotation(window.pose[-1:, 2])[0]
            joint = T @ self.tree.covariance([X(window.keyframes[-1]), C(window.segment)]) @ T.T
            self._last = self.tree.values, Belief(np.append(window.pose[-1], window.c[window.segment]), joint)
        return self._last[1]

    # Estimates

    def _add(self, new: list[Interval], reached: list[LiveFix], levels: list[SeenLevel]) -> None:
        """One update with what is new."""
        values, times, factors = gtsam.Values(), dict[int, float](), Factors()
        window = self.window
        for number, time, pose in zip(window.keyframes, window.times, window.pose, strict=True):
            if X(number) not in self.tree:
                values.insert(X(number), gtsam.Pose2(*pose))
                times[X(number)] = time
        for segment in sorted({one.segment for one in new}):
            if C(segment) not in self.tree:
                values.insert(C(segment), self.window.c[segment])
                factors["change", segment] = change_factor(segment, self.prior.change)
            times[C(segment)] = self.window.times[-1]
        known = gtsam.Values(self.tree.values)
        known.insert(values)
        factors |= self._own([one for one in self.window.intervals if np.isnan(one.at[0])], known)
        factors |= self._observe(reached, levels, known, values, times)
        self._update(factors, values=values, times=times)

    def _build(self, levels: Sequence[SeenLevel]) -> None:
        """All factors of the window in a new tree, and those of new levels."""
        rebuilds, self.tree = self.tree.rebuilds, Tree(self.lag if self.sure else np.inf)
        self.tree.rebuilds = rebuilds
        values, times = self.window.values()
        first, *others = self.window.segments
        factors: Factors = {"frame": frame_factor(self.window.keyframes[0], self.window.pose[0], self.placed)}
        factors["c"] = calibration_factor(first, *self.c_prior)
        factors |= {("change", segment): change_factor(segment, self.prior.change) for segment in others}
        known = gtsam.Values(values)
        factors |= self._own(self.window.intervals, known)
        self.receivers = LiveReceivers()
        reached = sorted((fix for fix in self.fixes if fix.reached), key=lambda fix: fix.time)
        heard = [*(self.beacons.again() if self.beacons else ()), *levels]
        factors |= self._observe(reached, heard, known, values, times)
        self._update(factors, values=values, times=times)

    def _relinearise(self, moved: Array, everything: bool = False) -> bool:
        """Linearise again what has moved; whether anything had. everything: not only of late."""
        if not self.window.intervals:
            return False
        everything |= self.window.count % EVERY == 0
        looked = self.window.intervals if everything else self.window.intervals[-RECENT:]
        apart = np.abs(self.window.state_of(looked) - np.array([one.at for one in looked]))
        apart[:, [2, 5]] = np.abs(wrap_angle(apart[:, [2, 5]]))
        limit = np.tile(moved, (len(looked), 1))
        if self.window.plan is not None:
            beside = [any(one.fields) for one in looked]
            limit[np.ix_(beside, [0, 1, 3, 4])] = min(moved[0], BESIDE_WALLS)
        stale = [looked[n] for n in np.flatnonzero(~(apart <= limit).all(axis=1))]
        factors = self._own(stale, self.tree.values) | self._seen(self.tree.values)
        if factors:
            self._update(factors)
        return len(factors) > 0

    def _linearise_all(self) -> None:
        """Start the tree with everything linearised where it is."""
        known = self.tree.values
        for _, seen, _, _ in self._observed(known):
            for one in seen.values():
                one.at = np.full(4, np.nan)
        self.tree.start(self._own(self.window.intervals, known) | self._seen(known))
        self.window.read(self.tree.values)

    def _update(
        self,
        factors: Factors,
        remove: Iterable[Name] = (),
        values: gtsam.Values | None = None,
        times: dict[int, float] | None = None,
    ) -> None:
        """Update the tree, and let go of what leaves the window."""
        self.tree.update(factors, remove, values, times)
        gone = next((n for n, number in enumerate(self.window.keyframes) if X(number) in self.tree), 0)
        if gone:
            self._let_go(gone)
        self.window.read(self.tree.values)
        if gone and self.window.times[0] > self.past.edge[0] + SPARSE:
            self.past.settle(self.window.times[0], self._covariance(0))

    def _let_go(self, gone: int) -> None:
        """The first so many keyframes have left the window, and what was measured there."""
        window, leaving = self.window, self.window.intervals[:gone]
        start = window.pose[0].copy() if window.keyframes[0] == 0 else None
        self.past.take(leaving, window.evaluate(leaving), start)
        left = set(window.keyframes[:gone])
        self.past.reports += [self._report(fix) for fix in self.fixes if fix.keyframe in left]
        window.forget(gone)
        if not self.past.anchored:
            self.past.hinge = window.pose[0].copy()
        alive = set(window.keyframes)
        self.fixes = [fix for fix in self.fixes if fix.keyframe not in left]
        gone_headings = [number for number, one in self.headings.items() if one.keyframe in left]
        for number in gone_headings:
            del self.headings[number]
        self.last_pointed = max([self.last_pointed, *gone_headings])
        self.receivers.forget(alive)
        if self.beacons is not None:
            self.beacons.forget(alive, window.times[0])

    # Factors

    def _own(self, intervals: list[Interval], known: gtsam.Values) -> Factors:
        """Steps and walls of some intervals, linearised where they are."""
        if not intervals:
            return {}
        for one, at in zip(intervals, self.window.state_of(intervals), strict=True):
            one.at = at
        return own_factors(intervals, self.window.evaluate(intervals), known)

    def _observe(
        self,
        fixes: list[LiveFix],
        levels: list[SeenLevel],
        known: gtsam.Values,
        values: gtsam.Values,
        times: dict[int, float],
    ) -> Factors:
        """The factors of what was measured at the keyframes; new variables go into ``known``, values and times."""
        factors = Factors()

        def new(added: Factors, variables: gtsam.Values, alive: dict[int, float]) -> None:
            factors.update(added)
            values.insert(variables)
            known.insert(variables)
            times.update(alive)

        for fix in fixes:
            if fix.kind == NONE:
                continue
            if fix.source and not self.prior.fix_flat:
                speed = (fix.walked - float(self.window.way.walked_by(fix.time - LATELY))) / LATELY
                seen = SeenFix(fix.keyframe, position=fix.position, velocity=speed, wild=fix.kind == SLIPPING)
                new(*self.receivers.add(fix.number, fix.source, seen, fix.time, fix.sigma, fix.walked, known))
            else:
                factors["fix", fix.number] = self._fix_alone(fix)
        for level in levels:
            assert self.beacons is not None, "it was heard"
            new(*self.beacons.add(level, self.window.times[-1]))
        times |= {key: self.window.times[-1] for key in (self.beacons.keys if self.beacons else ())}
        pointed = {n: one for n, one in self.headings.items() if one.keyframe >= 0}
        for number, one in pointed.items():
            if ("heading", number) not in self.tree.factors:
                factors["heading", number] = heading_factor(one.keyframe, one.heading, one.sigma)
        return factors | self._seen(known)

    def _fix_alone(self, fix: LiveFix) -> gtsam.NonlinearFactor:
        return fix_factor(fix.keyframe, fix.position, fix.sigma, wild=fix.kind == SLIPPING)

    def _seen(self, known: gtsam.Values) -> Factors:
        """The factors of receivers and beacons that have changed since they were linearised."""
        factors = Factors()
        for kind, seen, rows, pose in self._observed(known):
            factors |= linearised(kind, seen, rows, pose, known)
        return factors

    def _observed(self, known: gtsam.Values) -> Iterator[tuple[str, Mapping[int, Observation], Observed, Array]]:
        """What receivers and beacons saw, their factors, and the poses of their keyframes."""
        for kind, model in (("fix", self.receivers), ("level", self.beacons)):
            if model is not None and model.seen:
                pose = self.window.pose[self.window.places(one.keyframe for one in model.seen.values())]
                yield kind, model.seen, model.rows(pose, known), pose

    def _linear_names(self) -> set[Name]:
        """The factors that are linearised here."""
        names = {("own", one.j) for one in self.window.intervals} | {("fix", n) for n in self.receivers.fixes}
        return {*names, *(("level", n) for n in (self.beacons.levels if self.beacons else ()))}

    def _all_headings(self) -> Headings:
        """Those that the steps have reached, in order of time."""
        rows = sorted((one.time, one.heading, one.sigma) for one in self.headings.values() if one.keyframe >= 0)
        return Headings(*np.array(rows).reshape(-1, 3).T)
