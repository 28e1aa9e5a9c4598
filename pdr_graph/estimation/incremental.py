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
from pdr_graph.estimation.factors import Evaluation, Walls, evaluate
from pdr_graph.estimation.graph import FRAME_SIGMA, STEPS_PER_SEGMENT, Prior
from pdr_graph.estimation.live_factors import (
    Factors,
    calibration_factor,
    change_factor,
    fix_factor,
    frame_factor,
    heading_factor,
    own_factors,
)
from pdr_graph.estimation.live_fixes import GRIP, NONE, SLIPPING, LiveFix, believe, judged, report
from pdr_graph.estimation.live_observations import (
    LiveBeacons,
    LiveReceivers,
    Observation,
    SeenFix,
    SeenLevel,
    linearised,
)
from pdr_graph.estimation.live_start import lay
from pdr_graph.estimation.live_way import CLOSE, END, Interval, Way
from pdr_graph.estimation.live_ways import LiveWays, OtherWay
from pdr_graph.estimation.observations import Rows as Observed
from pdr_graph.estimation.prediction import Belief, Position, predicted
from pdr_graph.estimation.preintegration import DECIMALS, Bridge, Pieces, preintegrate
from pdr_graph.estimation.receivers import LATELY
from pdr_graph.estimation.tree import Name, Tree
from pdr_graph.floor.building import Building
from pdr_graph.floor.distance import DistanceField
from pdr_graph.floor.ground import Ground
from pdr_graph.geometry import pose_rotation, rotation, wrap_angle
from pdr_graph.types import Array, Beacons, Calibration, FixReport, Headings, Sightings, Steps

# Of x_i, x_j, c, before an interval is linearised again: the steps' factor is linear in translations, that of walls not
MOVED = np.array([0.5, 0.5, 0.02] * 2 + [0.01, 0.01, 0.002])
SETTLED = np.array([1e-4, 1e-4, 1e-5] * 2 + [1e-4, 1e-4, 1e-6])
BESIDE_WALLS = 0.15  # [m]
RECENT, EVERY = 150, 25  # intervals that are looked at each time; all are when so many keyframes have closed
ROUNDS = 4  # of linearising again after a keyframe, one with each of the next steps
SETTLES = 1e-4  # at the end: when a round takes less than this share off the cost
AGAIN, SPACED = 3.0, 0.2  # [s], and share of its duration, before a walk that is not sure is laid out again
PATIENCE = 4  # fixes that follow from one another, all far from the walk, until it is the walk that is wrong
LOOKED_BACK = 60  # pieces whose walls are asked for again
ALL = 10**9  # pieces
KEPT = ("count", "segment", "in_segment", "fix_count", "too_late", "last_pointed", "sure", "lay_next", "restarts")
KEPT += ("anchored", "floor", "tried", "taken")  # plain numbers and text of a snapshot
SPARSE = 5.0  # [s] between the covariances of rows that leave the window


@dataclass(frozen=True)
class Rows:
    """Rows of a trajectory: time ``(n,)``, poses ``(n, 3)``, covariances ``(n, 3, 3)``, floors."""

    time: Array
    pose: Array
    covariance: Array
    floor: list[str]


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

    def __init__(self, prior: Prior | None = None, lag: float = np.inf, plan: Building | None = None, floor: str = ""):
        self.prior, self.lag, self.plan, self.floor = prior or Prior(), lag, plan, floor
        if plan is not None and len(plan.labels) == 1:
            self.floor = plan.labels[0]
        self.tree, self.way = Tree(lag), Way()

        # The window: keyframes in order, intervals between them, and the estimate of each
        self.keyframes, self.times, self.pose = list[int](), list[float](), np.empty((0, 3))
        self.intervals, self.c = list[Interval](), dict[int, Array]()
        self.segment, self.in_segment, self.count = 0, 0, 0
        self.c_prior = np.array(self.prior.mean), self.prior.covariance

        # What was measured
        self.fixes, self.fix_count, self.too_late = list[LiveFix](), 0, 0
        self.headings, self.last_pointed = dict[int, Pointed](), -1  # the last that has left the window
        self.receivers = LiveReceivers()
        self.beacons: LiveBeacons | None = None

        # How it does, and what is due
        self.sure, self.lay_next, self.restarts = False, -np.inf, 0
        self.anchored = False  # it has been sure once
        self.hinge = np.zeros(3)  # the pose of the start of the window, as what has left goes with it
        self.walls_due, self.rounds_due = False, 0
        self.ways: LiveWays | None = None
        self.tried, self.taken = 0, 0  # other ways, and those that were better

        # What has left the window
        self.settled, self.left = list[Rows](), list[Rows]()  # those left have the spread about their keyframes alone
        self.past_reports = list[FixReport]()
        self.edge = 0.0, np.zeros((3, 3))  # when the covariance of the first keyframe was asked for, and what it was
        self._last: tuple[gtsam.Values, Belief] | None = None

    # What comes in

    def extend(self, steps: Steps, floor: str | None = None) -> None:
        """The next steps of the walk, on a floor; the first begin at its start."""
        self.way.add(steps)
        self.floor = self.floor if floor is None else floor
        if not self.keyframes:
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
        if self.keyframes and time <= self.way.end:
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
        if np.isfinite(sigma) and (not self.times or time >= self.times[0]):
            self.headings[number] = Pointed(round(time, DECIMALS), heading, sigma)

    def hear(self, heard: Sightings, beacons: Beacons) -> None:
        """What a radio heard, of beacons that were surveyed."""
        self.beacons = self.beacons or LiveBeacons(beacons)
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
        whole, at = self.way.with_tail(tail), self.times[-1]
        end = float(whole[-1, END]) if len(whole) else at
        end = end if until is None else min(end, until)
        fixes = [
            Position(fix.time, fix.position, fix.sigma, 1 / self.receivers.alike(fix.source))
            for fix in self.waiting
            if at <= fix.time <= end
        ]
        return predicted(self._last_belief(), whole, self.way.start, at, end, fixes, self.sure)

    def rows(self) -> Rows:
        """The walk in the window until its last keyframe; with its start if that is in it."""
        first = Rows(np.array(self.times[:1]), self.pose[:1], self._covariance(0)[None], [self.floor])
        if not self.intervals:
            return first
        own = self._evaluate(self.intervals)
        linear = self.tree.graph().linearize(self.tree.values)
        net = linear.eliminateSequential(gtsam.Ordering.MetisGaussianFactorGraph(linear))
        keys = [(X(one.i), X(one.j), C(one.segment)) for one in self.intervals]
        which = np.concatenate([n + one.row_piece for n, one in zip(own.pieces.first, self.intervals, strict=True)])
        covariance = covariance_of_pieces(CovarianceBlocks(net), keys, own, which)
        time = np.concatenate([one.row_time for one in self.intervals])
        rows = Rows(time, own.poses.value[which], covariance, self._labels())
        return _joined([first, rows]) if self.keyframes[0] == 0 else rows

    def rows_ahead(self, tail: Steps | None = None) -> Rows:
        """The steps since the last keyframe, as they are believed; the last row is the present."""
        whole = self.way.with_tail(tail)
        ends = whole[(whole[:, END] > self.times[-1] + CLOSE) & (whole[:, 6] > 0), END]
        moments = np.unique(np.append(ends, whole[-1:, END]))
        moments = moments[moments > self.times[-1] + CLOSE]
        beliefs = [self.belief(tail, until) for until in moments.tolist()]
        pose = np.array([one.mean[:3] for one in beliefs]).reshape(-1, 3)
        covariance = np.array([one.covariance[:3, :3] for one in beliefs]).reshape(-1, 3, 3)
        return Rows(moments, pose, covariance, [self.floor] * len(moments))

    def reports(self) -> list[FixReport]:
        """Why each fix was trusted or not; of those that left the window, since rows were handed out."""
        return self.past_reports + [self._report(fix) for fix in sorted(self.fixes, key=lambda fix: fix.time)]

    def calibration(self) -> Calibration | None:
        """What the window tells of walker and gyroscope."""
        segments = sorted({one.segment for one in self.intervals})
        if not segments:
            return None
        covariance = np.array([self.tree.covariance([C(segment)]) for segment in segments])
        start = [min(one.begin for one in self.intervals if one.segment == segment) for segment in segments]
        prior = np.sqrt(np.square(self.prior.sigma) + np.array(segments)[:, None] * np.square(self.prior.change))
        return Calibration(np.array(start), np.array([self.c[segment] for segment in segments]), covariance, prior)

    def hand_out(self) -> list[Rows]:
        """The rows that are settled, once; none while nothing has told for sure where the walk was."""
        if not self.anchored:
            return []
        self.past_reports = []
        handed, self.settled = self.settled, []
        return handed

    @property
    def cost(self) -> float:
        """Half the sum of squared, robustly weighted errors of the window."""
        values = self.tree.values
        own = self._evaluate(self.intervals).cost if self.intervals else 0.0
        observed = sum(rows.cost for _, _, rows, _ in self._observed(values))
        linear = self._linear_names()
        others = [factor for name, factor in self.tree.factors.items() if name not in linear]
        return own + observed + float(sum(factor.error(values) for factor in [*others, *self.tree.past]))

    def finish(self) -> None:
        """The walk ends here: its last keyframe, and everything linearised where it is until nothing moves."""
        if not self.keyframes:
            return
        for fix in self.waiting:
            if fix.time > self.way.end:
                fix.hold_at(self.way.end)
        self._close(at_end=True)
        if not self.sure and self.placed:
            self._lay()
        best, least = self.tree, self.cost
        self.tree = best.anew(relinearise=0.0)
        while self._relinearise(SETTLED) and self.cost < least * (1 - SETTLES):
            best, least = self.tree.anew(relinearise=0.0), self.cost
        if self.cost > least:
            self.tree = best
        self._read()

    # Keyframes

    def _begin(self) -> None:
        self.keyframes, self.times, self.count = [0], [self.way.start], 1
        self.pose, self.c = np.zeros((1, 3)), {0: np.array(self.prior.mean)}
        self.edge = self.way.start, np.eye(3) * FRAME_SIGMA**2
        self.fixes = [fix for fix in self.fixes if self._in_time(fix)]
        values = gtsam.Values()
        values.insert(X(0), gtsam.Pose2())
        values.insert(C(0), self.c[0])
        times = {X(0): self.way.start, C(0): self.way.start}
        factors: Factors = {"frame": frame_factor(0, self.pose[0], placed=False)}
        self.tree.update(factors | {"c": calibration_factor(0, *self.c_prior)}, values=values, times=times)

    def _in_time(self, fix: LiveFix) -> bool:
        """Whether a fix is of the window, or holds at its first keyframe."""
        in_time = not self.times or fix.time >= self.times[0] or fix.hold_at(self.times[0])
        self.too_late += not in_time
        return in_time

    def _close(self, at_end: bool = False) -> bool:
        """Close the keyframes that steps and measurements have made, and update the estimate; whether there are any."""
        levels = self.beacons.due(self.way.end, self.way.walked_by) if self.beacons else []
        pointed = {n: one for n, one in self.headings.items() if one.keyframe < 0 and one.time <= self.way.end}
        marks = [one.time for one in (*self.waiting, *levels, *pointed.values())] + [self.way.end] * at_end
        new = self._cut(marks)
        reached = [fix for fix in self.waiting if fix.time <= self.times[-1] + CLOSE]
        if not (new or reached or levels or pointed):
            return False
        for one in (*reached, *levels, *pointed.values()):
            one.keyframe = self._keyframe_at(one.time)
        for fix in reached:
            fix.walked = float(self.way.walked_by(fix.time))
        if reached and believe([fix for fix in self.fixes if fix.reached]) and self.sure:
            self._restart()
        if not self.sure and self.placed and self.times[-1] >= self.lay_next:
            self._lay()
        else:
            self._add(new, reached, levels)
        if reached and self.sure:
            self._judge()
        self._follow(new)
        self.walls_due, self.rounds_due = self.plan is not None, ROUNDS
        return True

    def _cut(self, marks: list[float]) -> list[Interval]:
        """The intervals that are complete since the last keyframe, each a keyframe further."""
        new: list[Interval] = []
        for end in self.way.ends(self.times[-1], marks):
            segment = self._segment_until(end)
            one = self.way.interval(
                self.keyframes[-1], self._number(), self.times[-1], end, segment, np.array(self.prior.mean), self.floor
            )
            moved = preintegrate(one.pieces, self.c[segment][None]).delta[-1]
            last = self.pose[-1]
            ahead = last + np.append(rotation(last[2]) @ moved[:2], moved[2])
            self.pose = np.concatenate([self.pose, ahead[None]])
            self.keyframes.append(one.j)
            self.times.append(one.end)
            self.intervals.append(one)
            new.append(one)
        return new

    def _segment_until(self, end: float) -> int:
        """The calibration of the interval up to ``end`` [s]: another after so many steps, and over a gap."""
        gap = len(self.intervals) > 0 and self.way.gap_within(self.times[-1], end)
        if self.in_segment >= STEPS_PER_SEGMENT or gap:
            self.segment, self.in_segment = self.segment + 1, 0
            self.c[self.segment] = self.c[self.segment - 1]
        self.in_segment += len(self.way.rows(self.times[-1], end))
        return self.segment

    def _number(self) -> int:
        self.count += 1
        return self.count - 1

    def _keyframe_at(self, time: float) -> int:
        """The number of the keyframe at a moment of the window; if there is none, an interval is split."""
        at = int(np.argmin(np.abs(np.array(self.times) - time)))
        return self.keyframes[at if abs(self.times[at] - time) <= CLOSE else self._split(time)]

    def _split(self, time: float) -> int:
        """A keyframe in an interval that was closed; its place in order."""
        at = int(np.searchsorted(self.times, time))
        old, number, mean = self.intervals[at - 1], self._number(), np.array(self.prior.mean)
        halves = [
            self.way.interval(old.i, number, old.begin, time, old.segment, mean, old.label),
            self.way.interval(number, old.j, time, old.end, old.segment, mean, old.label),
        ]
        ends = old.begin + old.pieces.to_end[1]
        for half in halves:
            inside = np.searchsorted(ends, half.begin + half.pieces.to_end[1] - CLOSE)
            half.fields = [old.fields[min(n, len(ends) - 1)] for n in inside]
        share = (time - old.begin) / (old.end - old.begin)
        between = (1 - share) * self.pose[at - 1] + share * self.pose[at]
        between[2] = self.pose[at - 1, 2] + share * wrap_angle(self.pose[at, 2] - self.pose[at - 1, 2])
        self.intervals[at - 1 : at] = halves
        self.keyframes.insert(at, number)
        self.times.insert(at, time)
        self.pose = np.insert(self.pose, at, between, axis=0)
        return at

    # Estimates

    def _add(self, new: list[Interval], reached: list[LiveFix], levels: list[SeenLevel]) -> None:
        """One update with what is new."""
        values, times, factors = gtsam.Values(), dict[int, float](), Factors()
        for number, time, pose in zip(self.keyframes, self.times, self.pose, strict=True):
            if X(number) not in self.tree:
                values.insert(X(number), gtsam.Pose2(*pose))
                times[X(number)] = time
        for segment in sorted({one.segment for one in new}):
            if C(segment) not in self.tree:
                values.insert(C(segment), self.c[segment])
                factors["change", segment] = change_factor(segment, self.prior)
            times[C(segment)] = self.times[-1]
        known = gtsam.Values(self.tree.values)
        known.insert(values)
        factors |= self._own([one for one in self.intervals if np.isnan(one.at[0])], known)
        factors |= self._observe(reached, levels, known, values, times)
        self._update(factors, values=values, times=times)

    def _lay(self) -> None:
        """Begin again from the walk as the batch lays it out."""
        steps, reached = self.way.steps, [fix for fix in self.fixes if fix.reached]
        levels = self.beacons.so_far(steps) if self.beacons else None
        prior = replace(self.prior, mean=tuple(self.c_prior[0].tolist()))
        floors = [self.floor] * (len(steps) + 2)
        laid = lay(steps, reached, self._all_headings(), levels, self._known_plan, floors, prior)
        self.pose, self.sure = laid.at(np.array(self.times)), laid.sure
        for one in self.intervals:
            self.c[one.segment] = laid.calibration(one.end)
            one.fields = [None] * len(one.fields)
        if not self.anchored:
            self._move_settled(self.pose[0].copy())
        self.anchored |= self.sure
        self.lay_next = self.times[-1] + max(AGAIN, SPACED * (self.times[-1] - steps.start))
        self._build()
        self._find_walls(ALL)
        for _ in range(ROUNDS):
            self._relinearise(MOVED)

    def _build(self) -> None:
        """All factors of the window in a new tree."""
        rebuilds, self.tree = self.tree.rebuilds, Tree(self.lag if self.sure else np.inf)
        self.tree.rebuilds = rebuilds
        values, times = gtsam.Values(), dict[int, float]()
        for number, time, pose in zip(self.keyframes, self.times, self.pose, strict=True):
            values.insert(X(number), gtsam.Pose2(*pose))
            times[X(number)] = time
        segments = sorted({one.segment for one in self.intervals} or {self.segment})
        factors: Factors = {"frame": frame_factor(self.keyframes[0], self.pose[0], self.placed)}
        factors["c"] = calibration_factor(segments[0], *self.c_prior)
        for segment in segments:
            values.insert(C(segment), self.c[segment])
            times[C(segment)] = max(
                (one.end for one in self.intervals if one.segment == segment), default=self.times[0]
            )
            if segment != segments[0]:
                factors["change", segment] = change_factor(segment, self.prior)
        known = gtsam.Values(values)
        factors |= self._own(self.intervals, known)
        self.receivers = LiveReceivers()
        reached = sorted((fix for fix in self.fixes if fix.reached), key=lambda fix: fix.time)
        factors |= self._observe(reached, self.beacons.again() if self.beacons else [], known, values, times)
        self._update(factors, values=values, times=times)

    def _restart(self) -> None:
        """The fixes say that the walk was elsewhere: what was before the window is no longer believed."""
        first = self.intervals[0].segment
        if C(first) in self.tree:
            covariance = self.tree.covariance([C(first)]) + np.diag(np.square(self.prior.change))
            self.c_prior = self.c[first], covariance
        self.restarts += 1
        self.sure, self.lay_next = False, -np.inf

    def _judge(self) -> None:
        """Fixes that are far off lose their grip; those that are near again have it."""
        reached = [fix for fix in self.fixes[-RECENT:] if fix.reached]
        factors, remove = Factors(), list[Name]()
        for fix in judged(reached, self.pose[self._places(fix.keyframe for fix in reached), :2]):
            seen = self.receivers.fixes.get(fix.number)
            if fix.kind == NONE:
                remove.append(("fix", fix.number))
                self.receivers.fixes.pop(fix.number, None)
            elif seen is not None:
                seen.wild, seen.at = fix.kind == SLIPPING, np.full(4, np.nan)
            elif not fix.source:
                factors["fix", fix.number] = fix_factor(fix)
        if factors or remove:
            self._update(factors, remove)
        last = [fix for fix in reached if fix.believed][-PATIENCE:]
        if len(last) == PATIENCE and all(fix.kind == SLIPPING for fix in last) and self.times[-1] >= self.lay_next:
            self._restart()
            self._lay()

    def _refine(self) -> bool:
        """One thing at a time, in the steps between keyframes: the walls, and what has moved linearised again.

        Returns whether there was anything to do.
        """
        due = bool(self.rounds_due) or (self.walls_due and self.sure)
        if self.walls_due and self.sure:
            self.walls_due = False
            self._find_walls(LOOKED_BACK)
        elif self.rounds_due:
            self.rounds_due = self.rounds_due - 1 if self._relinearise(MOVED) else 0
        return due

    # Other ways

    def _follow(self, new: list[Interval]) -> None:
        """Send the cloud after the walk; it begins where the walk is once that is sure."""
        plan = self._known_plan
        if plan is None or not self.sure:
            self.ways = None
        elif self.ways is None:
            self.ways = LiveWays(plan, self.prior, self._last_belief(), self.times[-1], self.floor)
        else:
            for one in new:
                self.ways.add(one, self._seen_at(one.j))
            self.ways.forget(self.times[0])

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
        """Try the way of most particles where it is elsewhere, and keep the better one."""
        at = int(np.searchsorted(self.times, ways.times[-1] - CLOSE))
        other = ways.elsewhere(self.pose[min(at, len(self.times) - 1), :2])
        if other is None:
            return
        self.tried += 1
        tree, pose, c = self.tree, self.pose.copy(), dict(self.c)
        walls = [(one.fields, one.at) for one in self.intervals]
        before = self.cost + self._find_walls(ALL)
        self._move_to(other)
        price = self._find_walls(ALL)
        for _ in range(ROUNDS):
            self._relinearise(MOVED)
        if self.cost + price < before:
            self.taken += 1
            return
        self.tree, self.pose, self.c = tree, pose, c
        for one, (fields, linearised_at) in zip(self.intervals, walls, strict=True):
            one.fields, one.at = fields, linearised_at

    def _move_to(self, other: OtherWay) -> None:
        """The same graph at another way; beyond its end as the steps lead on."""
        times = np.array(self.times)
        within = np.flatnonzero((times >= other.time[0] - CLOSE) & (times <= other.time[-1] + CLOSE))
        self.pose[within] = other.at(times[within])
        for n in range(int(within[-1]) + 1, len(times)):
            moved = preintegrate(self.intervals[n - 1].pieces, other.state[-1:, 3:]).delta[-1]
            last = self.pose[n - 1]
            self.pose[n] = last + np.append(rotation(last[2]) @ moved[:2], moved[2])
        values = gtsam.Values(self.tree.values)
        for number, pose in zip(self.keyframes, self.pose, strict=True):
            values.update(X(number), gtsam.Pose2(*pose))
        for one in self.intervals:
            if one.begin >= other.time[0] - CLOSE:
                self.c[one.segment] = other.state[-1, 3:]
                values.update(C(one.segment), other.state[-1, 3:])
        self.tree = self.tree.at(values, self._linear_names())
        self._linearise_all()

    def _linearise_all(self) -> None:
        """Start the tree with everything linearised where it is."""
        known = self.tree.values
        for _, seen, _, _ in self._observed(known):
            for one in seen.values():
                one.at = np.full(4, np.nan)
        self.tree.start(self._own(self.intervals, known) | self._seen(known))
        self._read()

    def _relinearise(self, moved: Array) -> bool:
        """Linearise again what has moved; whether anything had."""
        if not self.intervals:
            return False
        looked = self.intervals if moved is SETTLED or self.count % EVERY == 0 else self.intervals[-RECENT:]
        apart = np.abs(self._state(looked) - np.array([one.at for one in looked]))
        apart[:, [2, 5]] = np.abs(wrap_angle(apart[:, [2, 5]]))
        limit = np.tile(moved, (len(looked), 1))
        if self.plan is not None:
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
        gone = next((n for n, number in enumerate(self.keyframes) if X(number) in self.tree), 0)
        if gone:
            self._let_go(gone)
        self._read()
        if gone and self.times[0] > self.edge[0] + SPARSE:
            self._settle()

    def _read(self) -> None:
        """Poses and calibrations of the window."""
        values = self.tree.values
        self.pose[np.argsort(self.keyframes)] = gtsam.utilities.extractPose2(values)
        self.c |= {segment: values.atVector(C(segment)) for segment in self.c if values.exists(C(segment))}

    # What leaves the window

    def _let_go(self, gone: int) -> None:
        """The rows before the first keyframe that is left stay where they are."""
        leaving = self.intervals[:gone]
        own = self._evaluate(leaving)
        for n, one in enumerate(leaving):
            pose = own.poses.value[own.pieces.first[n] + one.row_piece]
            R = pose_rotation(np.full(len(pose), self.pose[n, 2]))
            spread = R @ one.bridge.spread[one.row_piece] @ R.transpose(0, 2, 1)
            self.left.append(Rows(one.row_time, pose, spread, [one.label] * len(pose)))
        if self.keyframes[0] == 0:
            self.left.insert(0, Rows(np.array(self.times[:1]), self.pose[:1], np.zeros((1, 3, 3)), [leaving[0].label]))
        leaving_at = set(self.keyframes[:gone])
        reported = [self._report(fix) for fix in self.fixes if fix.keyframe in leaving_at]
        del self.keyframes[:gone], self.times[:gone], self.intervals[:gone]
        self.pose = self.pose[gone:]
        self.way.forget(self.times[0])
        if not self.anchored:
            self.hinge = self.pose[0].copy()
        alive = set(self.keyframes)
        self.past_reports += reported
        self.fixes = [fix for fix in self.fixes if not fix.reached or fix.keyframe in alive]
        gone_headings = [n for n, one in self.headings.items() if one.keyframe >= 0 and one.keyframe not in alive]
        for number in gone_headings:
            del self.headings[number]
        self.last_pointed = max([self.last_pointed, *gone_headings])
        self.receivers.forget(alive)
        if self.beacons is not None:
            self.beacons.forget(alive, self.times[0])
        segments = {one.segment for one in self.intervals} | {self.segment}
        self.c = {segment: value for segment, value in self.c.items() if segment in segments}

    def _settle(self) -> None:
        """Give the rows that have left their covariance: between two keyframes that left, it changes evenly."""
        (before, one), (after, other) = self.edge, (self.times[0], self._covariance(0))
        for rows in self.left:
            share = ((rows.time - before) / (after - before))[:, None, None]
            self.settled.append(replace(rows, covariance=(1 - share) * one + share * other + rows.covariance))
        self.left, self.edge = [], (after, other)

    def _move_settled(self, after: Array) -> None:
        """What has left the window before anything told where the walk was goes with the window's start."""
        before, self.hinge = self.hinge, after
        turn = after[2] - before[2]
        R = pose_rotation(np.array([turn]))[0]
        for past in (self.settled, self.left):
            for k, rows in enumerate(past):
                moved = (rows.pose[:, :2] - before[:2]) @ R[:2, :2].T + after[:2]
                pose = np.column_stack([moved, rows.pose[:, 2] + turn])
                past[k] = replace(rows, pose=pose, covariance=R @ rows.covariance @ R.T)

    # Factors

    def _own(self, intervals: list[Interval], known: gtsam.Values) -> Factors:
        """Steps and walls of some intervals, linearised where they are."""
        if not intervals:
            return {}
        for one, at in zip(intervals, self._state(intervals), strict=True):
            one.at = at
        return own_factors(intervals, self._evaluate(intervals), known)

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
                speed = (fix.walked - float(self.way.walked_by(fix.time - LATELY))) / LATELY
                seen = SeenFix(fix.keyframe, position=fix.position, velocity=speed, wild=fix.kind == SLIPPING)
                new(*self.receivers.add(fix.number, fix.source, seen, fix.time, fix.sigma, fix.walked, known))
            else:
                factors["fix", fix.number] = fix_factor(fix)
        for level in levels:
            assert self.beacons is not None, "it was heard"
            new(*self.beacons.add(level, self.times[-1]))
        times |= {key: self.times[-1] for key in (self.beacons.keys if self.beacons else ())}
        pointed = {n: one for n, one in self.headings.items() if one.keyframe >= 0}
        for number, one in pointed.items():
            if ("heading", number) not in self.tree.factors:
                factors["heading", number] = heading_factor(one.keyframe, one.heading, one.sigma)
        return factors | self._seen(known)

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
                pose = self.pose[self._places(one.keyframe for one in model.seen.values())]
                yield kind, model.seen, model.rows(pose, known), pose

    def _linear_names(self) -> set[Name]:
        """The factors that are linearised here."""
        names = {("own", one.j) for one in self.intervals} | {("fix", n) for n in self.receivers.fixes}
        return {*names, *(("level", n) for n in (self.beacons.levels if self.beacons else ()))}

    @property
    def _known_plan(self) -> Building | None:
        """The plan, where it is known on which of its floors the walk is."""
        return self.plan if self.plan is not None and self.floor in self.plan.labels else None

    def _all_headings(self) -> Headings:
        """Those that the steps have reached, in order of time."""
        rows = sorted((one.time, one.heading, one.sigma) for one in self.headings.values() if one.keyframe >= 0)
        return Headings(*np.array(rows).reshape(-1, 3).T)

    def _evaluate(self, intervals: list[Interval]) -> Evaluation:
        """The own factors of some intervals."""
        at = self._state(intervals)
        pieces = Pieces.together([one.pieces for one in intervals])
        joined = Bridge.together([one.bridge for one in intervals])
        return evaluate(pieces, joined, at[:, :3], at[:, 3:6], at[:, 6:], self._walls(intervals))

    def _walls(self, intervals: list[Interval]) -> Walls | None:
        if self.plan is None:
            return None
        number: dict[DistanceField | None, int] = {None: -1}
        of_piece = [number.setdefault(field, len(number) - 1) for one in intervals for field in one.fields]
        fields = tuple(field for field in number if field is not None)
        return Walls(fields, np.array(of_piece), 0.0, self.prior.wall_margin, self.prior.wall_sigma)

    def _find_walls(self, pieces: int) -> float:
        """The walls about the last so many pieces, where the walk leads now; what it costs to lead there."""
        if self._known_plan is None or not self.sure or not self.intervals:
            return 0.0
        count = np.cumsum([len(one.fields) for one in reversed(self.intervals)])
        last = self.intervals[-1 - int(np.searchsorted(count, min(pieces, count[-1]))) :]
        own, labels = self._evaluate(last), [one.label for one in last for _ in one.fields]
        ground = Ground.of(self._known_plan, labels)
        fields, of_piece, price = ground.walls_along(own.poses.value[:, :2], own.pieces.length > 0)
        named = [fields[n] if n >= 0 else None for n in of_piece.tolist()]
        for one, first in zip(last, own.pieces.first.tolist(), strict=True):
            now = named[first : first + len(one.fields)]
            if any(a is not b for a, b in zip(now, one.fields, strict=True)):
                one.fields, one.at = now, np.full(9, np.nan)
        return price

    def _state(self, intervals: list[Interval]) -> Array:
        """x_i, x_j, c of intervals ``(k, 9)``."""
        i, j = self._places(one.i for one in intervals), self._places(one.j for one in intervals)
        return np.hstack([self.pose[i], self.pose[j], np.array([self.c[one.segment] for one in intervals])])

    def _places(self, numbers: Iterable[int]) -> list[int]:
        """Where keyframes are in order."""
        place = {number: n for n, number in enumerate(self.keyframes)}
        return [place[number] for number in numbers]

    def _report(self, fix: LiveFix) -> FixReport:
        return report(fix, self.pose[self._places([fix.keyframe])[0], :2] if fix.reached else fix.position)

    def _labels(self) -> list[str]:
        return [one.label for one in self.intervals for _ in one.row_time]

    def _covariance(self, n: int) -> Array:
        """Of a keyframe, in the output axes."""
        R = pose_rotation(self.pose[n : n + 1, 2])[0]
        return R @ self.tree.covariance([X(self.keyframes[n])]) @ R.T

    def _last_belief(self) -> Belief:
        """Of the last keyframe and its calibration, at the estimate."""
        if self._last is None or self._last[0] is not self.tree.values:
            joint = self.tree.covariance([X(self.keyframes[-1]), C(self.segment)])
            T = np.eye(6)
            T[:3, :3] = pose_rotation(self.pose[-1:, 2])[0]
            self._last = self.tree.values, Belief(np.append(self.pose[-1], self.c[self.segment]), T @ joint @ T.T)
        return self._last[1]

    # Snapshots

    def state(self) -> dict[str, Any]:
        """All that the rest of the walk depends on, as numbers; rows that were handed out are not among it."""
        return {
            **{name: getattr(self, name) for name in KEPT},
            "tree": self.tree.state(self._linear_names() | {("fix", fix.number) for fix in self.fixes}),
            "rebuilds": list(self.tree.rebuilds),
            "way": self.way.state(),
            "keyframes": np.array(self.keyframes, dtype=np.int64),
            "times": np.array(self.times),
            "segments": [one.segment for one in self.intervals],
            "labels": [one.label for one in self.intervals],
            "c": [[segment, value] for segment, value in self.c.items()],
            "c_prior": list(self.c_prior),
            "fixes": [asdict(fix) for fix in self.fixes],
            "headings": [[number, asdict(one)] for number, one in self.headings.items()],
            "receivers": self.receivers.state(),
            "beacons": self.beacons.state() if self.beacons else None,
            "left": [vars(rows) for rows in self.left],
            "settled": [vars(rows) for rows in self.settled],
            "hinge": self.hinge,
            "edge": list(self.edge),
        }

    def restore(self, state: dict[str, Any], beacons: Beacons | None) -> None:
        """Go on from a `state`, of the same prior, lag and plan."""
        for name in KEPT:
            setattr(self, name, state[name])
        self.way, self.tree = Way.restored(state["way"]), Tree.restored(state["tree"])
        self.tree.rebuilds = list(state["rebuilds"])
        self.keyframes, self.times = [int(n) for n in state["keyframes"]], [float(t) for t in state["times"]]
        self.c = {int(segment): np.array(value) for segment, value in state["c"]}
        mean, covariance = state["c_prior"]
        self.c_prior, self.edge = (np.array(mean), np.array(covariance)), (state["edge"][0], np.array(state["edge"][1]))
        self.fixes = [LiveFix(**fix) for fix in state["fixes"]]
        self.headings = {int(number): Pointed(**one) for number, one in state["headings"]}
        self.receivers = LiveReceivers.restored(state["receivers"])
        if state["beacons"] is not None and beacons is not None:
            self.beacons = LiveBeacons.restored(beacons, state["beacons"])
        self.left, self.settled = ([Rows(**rows) for rows in state[name]] for name in ("left", "settled"))
        self.hinge = np.array(state["hinge"])
        spans = zip(self.keyframes, self.keyframes[1:], self.times, self.times[1:], strict=False)
        told = zip(spans, state["segments"], state["labels"], strict=True)
        mean = np.array(self.prior.mean)
        self.intervals = [self.way.interval(*span, int(segment), mean, label) for span, segment, label in told]
        if self.keyframes:
            self._go_on()

    def _go_on(self) -> None:
        """Linearise everything where it is, and start the tree."""
        self.pose = np.zeros((len(self.keyframes), 3))
        self._read()
        self._find_walls(ALL)
        alone = [
            fix for fix in self.fixes if fix.reached and fix.kind != NONE and fix.number not in self.receivers.fixes
        ]
        self.tree.factors |= {("fix", fix.number): fix_factor(fix) for fix in alone}
        self._linearise_all()


def _joined(parts: Iterable[Rows]) -> Rows:
    """Rows that follow one another."""
    parts = list(parts)
    time, pose, covariance = (
        np.concatenate([getattr(p, name) for p in parts]) for name in ("time", "pose", "covariance")
    )
    return Rows(time, pose, covariance, [label for part in parts for label in part.floor])
