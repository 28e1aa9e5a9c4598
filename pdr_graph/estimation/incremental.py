"""The factor graph of a walk under way: the model of `graph`, keyframe by keyframe, in a `Tree`.

Steps come in order; a keyframe closes after ten pieces of them, where something was measured, and at gaps. What comes
late splits the interval that it falls into. The own factors of an interval (steps, and walls along them) are linearised
all at once here, not by callbacks, and again when a variable has moved: what GTSAM gets is linear.

Until the direction of the walk is sure there is nothing to linearise about: now and then the batch lays it out
(`live_start`), and nothing leaves the window.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import C, X

from pdr_graph.estimation.cloud import Seen
from pdr_graph.estimation.covariance import CovarianceBlocks, covariance_of_pieces
from pdr_graph.estimation.graph import FRAME_SIGMA, Prior
from pdr_graph.estimation.live_factors import Factors, frame_factor, own_factors
from pdr_graph.estimation.live_fixes import GRIP, NONE, SLIPPING, LiveFix, believe, judged, report
from pdr_graph.estimation.live_observations import (
    LiveBeacons,
    LiveReceivers,
    Observation,
    SeenFix,
    SeenLevel,
    linearised,
)
from pdr_graph.estimation.live_past import SPARSE, Past, Rows
from pdr_graph.estimation.live_start import Laid, lay
from pdr_graph.estimation.live_way import CLOSE, END, ROW, Interval
from pdr_graph.estimation.live_ways import LiveWays, OtherWay
from pdr_graph.estimation.live_window import ALL, Window
from pdr_graph.estimation.native import calibration_factor, change_factor, fix_factor, heading_factor
from pdr_graph.estimation.observations import Rows as Observed
from pdr_graph.estimation.prediction import Belief, Position, predicted
from pdr_graph.estimation.preintegration import DECIMALS
from pdr_graph.estimation.receivers import LATELY
from pdr_graph.estimation.reports import prior_sigma
from pdr_graph.estimation.tree import Name, Tree
from pdr_graph.floor.building import Building
from pdr_graph.geometry import pose_rotation, wrap_angle
from pdr_graph.state import restore, state_of
from pdr_graph.types import Array, Beacons, Calibration, FixReport, Headings, Sightings, Steps

# Of x_i, x_j, c, before an interval is linearised again: the steps' factor is linear in translations, that of walls not
MOVED = np.array([0.5, 0.5, 0.02] * 2 + [0.01, 0.01, 0.002])
SETTLED = np.array([1e-4, 1e-4, 1e-5] * 2 + [1e-4, 1e-4, 1e-6])
BESIDE_WALLS = 0.15  # [m]
RECENT, EVERY = 150, 25  # intervals that are looked at each time; all are when so many keyframes have closed
ROUNDS = 4  # of linearising again after a keyframe, one with each of the next steps
SETTLES = 1e-4  # at the end: when a round takes less than this share off the cost
AGAIN, SPACED = 3.0, 0.2  # [s], and share of its duration, before a walk that is not sure is laid out again
CHECKED = 5  # keyframes after which the cost is looked at
STRAINED, OF_KEYFRAME, OF_FIX = 8.0, 0.4, 3.0  # cost beyond which a walk is strained: twice what good ones have
PATIENCE = 4  # fixes that follow from one another, all far from the walk, until it is the walk that is wrong
LONGEST_OPEN = 180.0  # [s] until the most probable of several ways is taken: nobody can wait for a longer walk
REVIEWED = 50.0  # [s] after which a walk on a plan is laid out once more
LOOKED_BACK = 60  # pieces whose walls are asked for again


@dataclass
class Pointed:
    """A walking direction that was measured. keyframe: its number, -1 before the steps have come so far."""

    time: float
    heading: float
    sigma: float
    keyframe: int = -1


class IncrementalGraph:
    """Every measurement of a walk under way as a factor.

    lag: keyframes older than this leave the window [s]; prior, plan: as of ``WalkGraph``; floor: label of the one that
    the walk is on.
    """

    kept = ("fix_count", "too_late", "last_pointed", "sure", "lay_next", "restarts", "reviewed", "tried", "taken")

    def __init__(self, prior: Prior | None = None, lag: float = np.inf, plan: Building | None = None, floor: str = ""):
        self.prior, self.lag, self.tree, self.past = prior or Prior(), lag, Tree(lag), Past()
        if plan is not None and len(plan.labels) == 1:
            floor = plan.labels[0]
        self.window = Window(self.prior, plan, floor)
        self.c_prior = np.array(self.prior.mean), self.prior.covariance

        # What was measured
        self.fixes, self.fix_count, self.too_late = list[LiveFix](), 0, 0
        self.headings, self.last_pointed = dict[int, Pointed](), -1  # the last that has left the window
        self.receivers = LiveReceivers()
        self.beacons: LiveBeacons | None = None

        # How it does, and what is due
        self.sure, self.lay_next, self.restarts, self.finished = False, -np.inf, 0, False
        self.walls_due, self.rounds_due = False, 0
        self.ways: LiveWays | None = None
        self.reviewed = False  # once, when more of the walk was known
        self.tried, self.taken = 0, 0  # other ways, and those that were better
        self._last: tuple[gtsam.Values, Belief] | None = None

    # What comes in

    def extend(self, steps: Steps, floor: str | None = None) -> None:
        """The next steps of the walk, on a floor; the first begin at its start."""
        self.window.way.add(steps)
        self.window.floor = self.window.floor if floor is None else floor
        if not self.window.keyframes:
            self._begin()
        busy = self._close() or self._refine()
        if self.ways is not None and self.ways.work(busy):
            self._compare(self.ways)

    def add_fix(self, time: float, position: Array, sigma: float, floor: str = "", source: str = "") -> None:
        """A fix; one of before the window counts as too late."""
        time = round(float(time), DECIMALS)
        fix = LiveFix(self.fix_count, time, np.array(position, dtype=float), float(sigma), floor, source)
        if not self._in_time(fix):
            return
        self.fix_count += 1
        self.fixes.append(fix)
        if self.window.keyframes and time <= self.window.way.end:
            self._close()

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
        return predicted(self._last_belief(), whole, self.window.way.start, at, end, fixes, self.sure)

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
        parts = [first] * (window.keyframes[0] == 0) + [Rows(time, own.poses.value[which], covariance, labels)]
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

    @property
    def cost(self) -> float:
        """Half the sum of squared, robustly weighted errors of the window."""
        values = self.tree.values
        own = self.window.evaluate(self.window.intervals).cost if self.window.intervals else 0.0
        observed = sum(rows.cost for _, _, rows, _ in self._observed(values))
        linear = self._linear_names()
        others = [factor for name, factor in self.tree.factors.items() if name not in linear]
        return own + observed + float(sum(factor.error(values) for factor in [*others, *self.tree.past]))

    def finish(self) -> None:
        """The walk ends here: its last keyframe, and everything linearised where it is until nothing moves."""
        if not self.window.keyframes:
            return
        for fix in self.waiting:
            if fix.time > self.window.way.end:
                fix.hold_at(self.window.way.end)
        self.finished = True
        self._close(at_end=True)
        if not self.sure and self.placed:
            self._lay()
        best, least = self.tree, self.cost
        self.tree = best.anew(relinearise=0.0)
        while self._relinearise(SETTLED, everything=True) and self.cost < least * (1 - SETTLES):
            best, least = self.tree.anew(relinearise=0.0), self.cost
        if self.cost > least:
            self.tree = best
        self.window.read(self.tree.values)

    # Keyframes

    def _begin(self) -> None:
        self.window.begin()
        self.past.edge = self.window.times[0], np.eye(3) * FRAME_SIGMA**2
        self.fixes = [fix for fix in self.fixes if self._in_time(fix)]
        values, times = self.window.values()
        factors: Factors = {"frame": frame_factor(0, self.window.pose[0], placed=False)}
        self.tree.update(factors | {"c": calibration_factor(0, *self.c_prior)}, values=values, times=times)

    def _in_time(self, fix: LiveFix) -> bool:
        """Whether a fix is of the window, or holds at its first keyframe."""
        in_time = not self.window.times or fix.time >= self.window.times[0] or fix.hold_at(self.window.times[0])
        self.too_late += not in_time
        return in_time

    def _close(self, at_end: bool = False) -> bool:
        """Close the keyframes that steps and measurements have made, and update the estimate; whether there are any."""
        levels = self.beacons.due(self.window.way.end, self.window.way.walked_by) if self.beacons else []
        pointed = {n: one for n, one in self.headings.items() if one.keyframe < 0 and one.time <= self.window.way.end}
        marks = [one.time for one in (*self.waiting, *levels, *pointed.values())] + [self.window.way.end] * at_end
        new = self.window.cut(marks)
        reached = [fix for fix in self.waiting if fix.time <= self.window.times[-1] + CLOSE]
        if not (new or reached or levels or pointed):
            return False
        for one in (*reached, *levels, *pointed.values()):
            one.keyframe = self.window.keyframe_at(one.time)
        for fix in reached:
            fix.walked = float(self.window.way.walked_by(fix.time))
        if reached and believe([fix for fix in self.fixes if fix.reached]) and self.sure:
            self._restart()
        if not self.sure and self.placed and self.window.times[-1] >= self.lay_next:
            self._lay()
        else:
            self._add(new, reached, levels)
        if reached and self.sure:
            self._judge()
        self._follow(new)
        self.walls_due, self.rounds_due = self.window.plan is not None, ROUNDS
        return True

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

    def _lay(self) -> None:
        """Begin again from the walk as the batch lays it out."""
        reached = [fix for fix in self.fixes if fix.reached]
        laid = self._laid_out(reached)
        self.window.pose = laid.at(np.array(self.window.times))
        long = self.window.times[-1] - self.window.times[0] > LONGEST_OPEN
        self.sure = laid.sure or (long and len(reached) > 2)
        for one in self.window.intervals:
            self.window.c[one.segment] = laid.calibration(one.end)
            one.fields = [None] * len(one.fields)
        if not self.past.anchored:
            self.past.move(self.window.pose[0].copy())
        self.past.anchored |= self.sure
        self.lay_next = self.window.times[-1] + max(AGAIN, SPACED * (self.window.times[-1] - self.window.times[0]))
        self._build()
        self._find_walls(ALL)
        for _ in range(ROUNDS):
            self._relinearise(MOVED)

    def _laid_out(self, fixes: list[LiveFix]) -> Laid:
        """The window as the batch lays it out, which tells the fixes how they are believed."""
        steps = self.window.way.steps
        levels = self.beacons.so_far(steps) if self.beacons else None
        prior = replace(self.prior, mean=tuple(self.c_prior[0].tolist()))
        floors = [self.window.floor] * (len(steps) + 2)
        return lay(steps, fixes, self._all_headings(), levels, self.window.known_plan, floors, prior)

    def _build(self) -> None:
        """All factors of the window in a new tree."""
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
        factors |= self._observe(reached, self.beacons.again() if self.beacons else [], known, values, times)
        self._update(factors, values=values, times=times)

    def _restart(self) -> None:
        """The fixes say that the walk was elsewhere: what was before the window is no longer believed."""
        first = self.window.intervals[0].segment
        if C(first) in self.tree:
            covariance = self.tree.covariance([C(first)]) + np.diag(np.square(self.prior.change))
            self.c_prior = self.window.c[first], covariance
        self.restarts += 1
        self.sure, self.lay_next = False, -np.inf

    def _judge(self) -> None:
        """Fixes that are far off lose their grip; those that are near again have it."""
        reached = [fix for fix in self.fixes[-RECENT:] if fix.reached]
        factors, remove = Factors(), list[Name]()
        for fix in judged(reached, self.window.pose[self.window.places(fix.keyframe for fix in reached), :2]):
            seen = self.receivers.fixes.get(fix.number)
            if fix.kind == NONE:
                remove.append(("fix", fix.number))
                self.receivers.fixes.pop(fix.number, None)
            elif seen is not None:
                seen.wild, seen.at = fix.kind == SLIPPING, np.full(4, np.nan)
            elif not fix.source:
                factors["fix", fix.number] = self._fix_alone(fix)
        if factors or remove:
            self._update(factors, remove)
        last = [fix for fix in reached if fix.believed][-PATIENCE:]
        astray = len(last) == PATIENCE and all(fix.kind == SLIPPING for fix in last)
        if astray and self.window.times[-1] >= self.lay_next:
            self._restart()
            self._lay()

    def _refine(self) -> bool:
        """One thing at a time, in the steps between keyframes: the walls, and what has moved linearised again.

        Returns whether there was anything to do.
        """
        due = bool(self.rounds_due) or self.walls_due
        if self.walls_due:
            self.walls_due = False
            self._find_walls(LOOKED_BACK)
        elif self.rounds_due:
            self.rounds_due = self.rounds_due - 1 if self._relinearise(MOVED) else 0
        return due

    def _find_walls(self, pieces: int) -> float:
        """As the window does, where the walk has been laid out on the plan."""
        return self.window.find_walls(pieces) if np.isfinite(self.lay_next) else 0.0

    # Other ways

    def _follow(self, new: list[Interval]) -> None:
        """Send the cloud after the walk; it begins where the walk is once that is sure."""
        plan = self.window.known_plan
        if plan is None or not self.sure:
            self.ways = None
        elif self.ways is None:
            self.ways = LiveWays(plan, self.prior, self._last_belief(), self.window.times[-1], self.window.floor)
        else:
            for one in new:
                self.ways.add(one, self._seen_at(one.j))
            self.ways.forget(self.window.times[0])

    def _seen_at(self, keyframe: int) -> Seen:
        """What was measured at a keyframe, as particles take it."""
        fixes = [fix for fix in self.fixes if fix.keyframe == keyframe]
        sigma = [fix.sigma * np.sqrt(self.receivers.alike(fix.source)) for fix in fixes]
        headings = [(one.heading, one.sigma) for one in self.headings.values() if one.keyframe == keyframe]
        return Seen(
            np.array([fix.position for fix in fixes]).reshape(-1, 2),
            np.array(sigma),
            np.array([fix.kind != GRIP for fix in fixes], dtype=bool),
            *np.array(headings).reshape(-1, 2).T,
        )

    def _compare(self, ways: LiveWays) -> None:
        """Try the way of most particles where it is elsewhere, once the batch's; begin again where all is strained."""
        at = int(np.searchsorted(self.window.times, ways.times[-1] - CLOSE))
        other = ways.elsewhere(self.window.pose[min(at, len(self.window.times) - 1), :2])
        if other is None and self._review_due():
            self.reviewed = True
            laid = self._laid_out([replace(fix) for fix in self.fixes if fix.reached])
            other = OtherWay(laid.time, np.column_stack([laid.pose, np.tile(laid.c[-1], (len(laid.time), 1))]))
        if other is not None and other.time[-1] >= self.window.times[0]:
            self._try(other)
        elif self.window.count % CHECKED == 0 and self.window.times[-1] >= self.lay_next and self._strained():
            self._restart()
            self.c_prior = np.array(self.prior.mean), self.prior.covariance
            self._lay()

    def _try(self, other: OtherWay) -> None:
        """Move to another way, and back if that has more against it."""
        self.tried += 1
        tree, pose, c = self.tree, self.window.pose.copy(), dict(self.window.c)
        walls = [(one.fields, one.at) for one in self.window.intervals]
        before = self.cost + self._find_walls(ALL)
        self._move_to(other)
        price = self._find_walls(ALL)
        for _ in range(ROUNDS):
            self._relinearise(MOVED)
        if self.cost + price < before:
            self.taken += 1
            return
        self.tree, self.window.pose, self.window.c = tree, pose, c
        for one, (fields, linearised_at) in zip(self.window.intervals, walls, strict=True):
            one.fields, one.at = fields, linearised_at

    def _review_due(self) -> bool:
        """Whether a walk that was soon sure is to be laid out once more, before any of it leaves the window."""
        at, start = self.window.times[-1], self.window.times[0]
        return not self.reviewed and self.placed and self.window.keyframes[0] == 0 and at - start > REVIEWED

    def _strained(self) -> bool:
        """Whether so much speaks against the walk that it can hardly have gone this way, and there are fixes to ask."""
        fixes = sum(fix.reached for fix in self.fixes)
        return fixes > 1 and self.cost > STRAINED + OF_KEYFRAME * len(self.window.keyframes) + OF_FIX * fixes

    def _move_to(self, other: OtherWay) -> None:
        """The same graph at another way; beyond its end as the steps lead on."""
        times = np.array(self.window.times)
        within = np.flatnonzero((times >= other.time[0] - CLOSE) & (times <= other.time[-1] + CLOSE))
        self.window.pose[within] = other.at(times[within])
        self.window.lead_on(int(within[-1]), other.state[-1, 3:])
        values = gtsam.Values(self.tree.values)
        for number, pose in zip(self.window.keyframes, self.window.pose, strict=True):
            values.update(X(number), gtsam.Pose2(*pose))
        for one in self.window.intervals:
            if one.begin >= other.time[0] - CLOSE:
                self.window.c[one.segment] = other.state[-1, 3:]
                values.update(C(one.segment), other.state[-1, 3:])
        self.tree = self.tree.at(values, self._linear_names())
        self._linearise_all()

    def _linearise_all(self) -> None:
        """Start the tree with everything linearised where it is."""
        known = self.tree.values
        for _, seen, _, _ in self._observed(known):
            for one in seen.values():
                one.at = np.full(4, np.nan)
        self.tree.start(self._own(self.window.intervals, known) | self._seen(known))
        self.window.read(self.tree.values)

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

    # Snapshots

    def state(self) -> dict[str, Any]:
        """All that the rest of the walk depends on, as numbers; rows that were handed out are not among it."""
        return {
            **state_of(self),
            "tree": self.tree.state(self._linear_names() | {("fix", fix.number) for fix in self.fixes}),
            "window": self.window.state(),
            "past": self.past.state(),
            "c_prior": list(self.c_prior),
            "fixes": [asdict(fix) for fix in self.fixes],
            "headings": [[number, asdict(one)] for number, one in self.headings.items()],
            "receivers": self.receivers.state(),
            "beacons": self.beacons.state() if self.beacons else None,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a `state`, of the same prior, lag, plan and beacons."""
        restore(self, state)
        self.tree = Tree.restored(state["tree"])
        self.window.restore(state["window"])
        self.past.restore(state["past"])
        mean, covariance = state["c_prior"]
        self.c_prior = np.array(mean), np.array(covariance)
        self.fixes = [LiveFix(**fix) for fix in state["fixes"]]
        self.headings = {int(number): Pointed(**one) for number, one in state["headings"]}
        self.receivers = LiveReceivers.restored(state["receivers"])
        if self.beacons is not None:
            self.beacons.restore(state["beacons"])
        if self.window.keyframes:
            self._go_on()

    def _go_on(self) -> None:
        """Linearise everything where it is, and start the tree."""
        self.window.read(self.tree.values)
        self._find_walls(ALL)
        alone = [
            fix for fix in self.fixes if fix.reached and fix.kind != NONE and fix.number not in self.receivers.fixes
        ]
        self.tree.factors |= {("fix", fix.number): self._fix_alone(fix) for fix in alone}
        self._linearise_all()
