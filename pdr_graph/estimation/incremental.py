"""The factor graph of a walk under way: the model of `graph`, keyframe by keyframe, in a `Tree`.

Steps come in order; a keyframe closes after ten pieces of them, at a fix's own time, and at gaps. A fix that comes late
splits the interval that it falls into. The own factors of an interval (steps, and walls along them) are linearised all
at once here, not by callbacks, and again when a variable has moved: what GTSAM gets is linear, with its variables'
values.

Until fixes tell the direction of the walk there is nothing to linearise about: with every one of them the track is laid
on them anew, in closed form (`initial`), and nothing leaves the window.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce

import gtsam
import numpy as np
from gtsam.symbol_shorthand import C, X

from pdr_graph.estimation.covariance import CovarianceBlocks, covariance_of_pieces
from pdr_graph.estimation.factors import Evaluation, Walls, evaluate
from pdr_graph.estimation.graph import (
    AMBIGUOUS,
    ANY_HEADING,
    FRAME_SIGMA,
    LONGEST_OVERHANG,
    STEPS_PER_SEGMENT,
    WALKING_SPEED,
    Prior,
    State,
    WalkGraph,
)
from pdr_graph.estimation.live_observations import LiveBeacons, LiveReceivers, Seen, SeenFix, SeenLevel, linearised
from pdr_graph.estimation.optimizer import WILD, Optimum, probabilities, solutions, ways
from pdr_graph.estimation.prediction import Belief
from pdr_graph.estimation.preintegration import (
    DECIMALS,
    PIECES_PER_KEYFRAME,
    Bridge,
    Pieces,
    bridge,
    one_interval,
    preintegrate,
    whole_pieces,
)
from pdr_graph.estimation.reach import DRIVEN, ENDS, STRETCHED, WITHIN, chained
from pdr_graph.estimation.receivers import LATELY
from pdr_graph.estimation.reports import SURE
from pdr_graph.estimation.robust import HUBER_WIDTH, WILD_WIDTH
from pdr_graph.estimation.tree import Name, Tree, linear
from pdr_graph.floor.building import Building
from pdr_graph.floor.distance import DistanceField
from pdr_graph.floor.ground import Ground
from pdr_graph.gait.gaps import follow
from pdr_graph.geometry import interpolate, pose_rotation, rotation, wrap_angle
from pdr_graph.types import Array, Beacons, Fixes, Index, Sightings, Steps

# Of x_i, x_j, c, before an interval is linearised again: the steps' factor is linear in translations, that of walls not
MOVED = np.array([0.5, 0.5, 0.02] * 2 + [0.01, 0.01, 0.002])
SPARSE = 5.0  # [s] between the covariances of rows that leave the window
BESIDE_WALLS = 0.15  # [m]
RECENT = 150  # intervals that are looked at each time; all are when EVERY so many keyframes have closed
EVERY = 25
SETTLED = np.array([1e-4, 1e-4, 1e-5] * 2 + [1e-4, 1e-4, 1e-6])
ROUNDS = 4  # of linearising again after a keyframe, one with each of the next steps
SETTLES = 1e-4  # at the end: when a round takes less than this share off the cost
AGAIN, SPACED = 3.0, 0.3  # [s], and share of its duration, before the track is laid on fixes again
LOOKED_BACK = 60  # pieces whose walls are asked for again
INSTANT = 2e-6  # [s]: see DECIMALS
END, LENGTH, TURN, ROW, GAP = 0, 1, 2, 6, 7  # columns of whole pieces


@dataclass
class Interval:
    """Between two keyframes.

    i, j: numbers of these; segment: of its calibration; pieces, bridge: of itself; row_time, row_piece: of the rows of
    the trajectory that end in it; fields: of the walls about each piece, None of none; floors: the label of each row;
    at: ``(9,)`` x_i, x_j, c where it was linearised.
    """

    i: int
    j: int
    segment: int
    pieces: Pieces
    bridge: Bridge
    row_time: Array
    row_piece: Index
    fields: list[DistanceField | None]
    labels: list[str]
    at: Array = field(default_factory=lambda: np.full(9, np.nan))

    @property
    def is_gap(self) -> bool:
        """Whether nobody knows where the walker went meanwhile."""
        return len(self.pieces.length) == 1 and self.pieces.length[0] == 0 and len(self.row_time) == 1

    @property
    def begin(self) -> float:
        """[s]"""
        return float(self.pieces.keyframe_time[0])

    @property
    def end(self) -> float:
        """[s]"""
        return float(self.pieces.keyframe_time[1])


@dataclass
class LiveFix:
    """A fix of the walk under way.

    keyframe: its number, None before the steps have come so far; walked: metres until then; believed: it is of the
    longest chain within reach; kind: how it is believed, "grip", "wild" or "none".
    """

    number: int
    time: float
    position: Array
    sigma: float
    floor: str
    source: str = ""
    keyframe: int | None = None
    walked: float = 0.0
    believed: bool = True
    kind: str = "grip"


@dataclass(frozen=True)
class Rows:
    """Rows of a trajectory: time ``(n,)``, poses ``(n, 3)``, covariances ``(n, 3, 3)``, floors."""

    time: Array
    pose: Array
    covariance: Array
    floor: list[str]


class IncrementalGraph:
    """Every measurement of a walk under way as a factor.

    lag: keyframes older than this leave the window [s]; prior, plan: as of ``WalkGraph``.
    """

    def __init__(
        self,
        prior: Prior | None = None,
        lag: float = np.inf,
        plan: Building | None = None,
    ):
        self.prior, self.lag, self.plan = prior or Prior(), lag, plan
        self.tree = Tree()
        self.keyframes: list[int] = []
        self.times: list[float] = []
        self.intervals: list[Interval] = []
        self.pose = np.empty((0, 3))  # of each keyframe
        self.c: dict[int, Array] = {}
        self.fixes: list[LiveFix] = []
        self.receivers = LiveReceivers()
        self.beacons: LiveBeacons | None = None
        self.too_late = 0
        self.restarts = 0
        self._rebuilds: list[str] = []
        self.walls = plan is not None
        self.settled: list[Rows] = []
        self.left: list[Rows] = []  # of rows that left since, with the spread about their keyframes alone
        self._edge = 0.0, np.zeros((3, 3))  # when the covariance of the first keyframe was asked for, and what it was
        self._last: tuple[gtsam.Values, Belief] | None = None  # what is believed of the last keyframe at an estimate
        self._whole = np.empty((0, 8))
        self._whole_start = 0.0
        self._walked = 0.0  # [m] before the first whole piece
        self._count = 0  # of keyframes ever
        self._segment, self._in_segment = 0, 0
        self._fix_count = 0
        self._c_prior = np.array(self.prior.mean), self.prior.covariance
        self.sure = False
        self._walls_due, self._rounds_due = False, 0
        self._lay_next = -np.inf  # [s] when the track is, while the direction is not sure
        self._steps: list[Steps] = []  # of the window
        self.floor = plan.labels[0] if plan is not None and len(plan.labels) == 1 else ""

    # What comes in

    def extend(self, steps: Steps, floor: str | None = None) -> None:
        """The next steps of the walk, on a floor; the first begin at its start."""
        if not self.keyframes:
            self._begin(steps.start)
        if floor is not None:
            self.floor = floor
        self._steps.append(steps)
        self._whole = np.concatenate([self._whole, _rows(steps)])
        if not self._close():
            self._refine()

    def add_fix(self, time: float, position: Array, sigma: float, floor: str = "", source: str = "") -> LiveFix | None:
        """A fix of a moment after the start of the window, or None if it is too late."""
        place, stated = np.asarray(position, dtype=float), float(sigma)
        fix = LiveFix(self._fix_count, round(float(time), DECIMALS), place, stated, floor, source)
        if self.times and not self._hold_at(fix, self.times[0]):
            return None
        self._fix_count += 1
        self.fixes.append(fix)
        if self.keyframes and fix.time <= self.covered:
            self._close()
        return fix

    def hear(self, heard: Sightings, beacons: Beacons) -> None:
        """What a radio heard, of beacons that were surveyed."""
        self.beacons = self.beacons or LiveBeacons(beacons)
        self.beacons.hear(heard)

    def _hold_at(self, fix: LiveFix, time: float) -> bool:
        """Whether a fix counts: one shortly before a moment holds at it, less exactly."""
        overhang = time - fix.time
        if overhang > LONGEST_OVERHANG:
            self.too_late += 1
        elif overhang > 0:
            fix.time, fix.sigma = time, float(np.hypot(fix.sigma, WALKING_SPEED * overhang))
        return overhang <= LONGEST_OVERHANG

    @property
    def covered(self) -> float:
        """Until when the steps are known. [s]"""
        return float(self._whole[-1, END]) if len(self._whole) else self._whole_start

    @property
    def waiting(self) -> list[LiveFix]:
        """The fixes that the steps have not reached, in order of time."""
        return sorted((fix for fix in self.fixes if fix.keyframe is None), key=lambda fix: fix.time)

    # What is known

    @property
    def rebuilds(self) -> list[str]:
        """Why the tree was made anew, each time."""
        return self._rebuilds + self.tree.rebuilds

    def evaluate(self, intervals: list[Interval]) -> Evaluation:
        """The own factors of some intervals."""
        at = self._state(intervals)
        pieces = Pieces.together([one.pieces for one in intervals])
        joined = Bridge.together([one.bridge for one in intervals])
        return evaluate(pieces, joined, at[:, :3], at[:, 3:6], at[:, 6:], self._walls(intervals))

    def belief(self, tail: Steps | None = None, until: float | None = None) -> Belief:
        """What is believed now: the last keyframe's, through the steps and fixes since, and through a ``tail`` of steps
        that may change yet, until a moment [s].
        """
        whole = self._whole if tail is None else np.concatenate([self._whole, _rows(tail)])
        end = float(whole[-1, END]) if len(whole) else self._whole_start
        end = end if until is None else min(end, until)
        belief, at = self._last_belief(), self.times[-1]
        for fix in self.waiting:
            if at <= fix.time <= end:
                belief = belief.after(whole, self._whole_start, at, fix.time)
                belief = (belief if self.sure else belief.anywhere()).seen(fix.position, fix.sigma)
                at = fix.time
        return belief.after(whole, self._whole_start, at, end)

    def rows(self) -> Rows:
        """The start of the window, and every step in it until its last keyframe."""
        first = Rows(np.array(self.times[:1]), self.pose[:1], self._covariance(0)[None], [self.floor])
        if not self.intervals:
            return first
        own, values = self.evaluate(self.intervals), self.tree.values
        linear = self.tree.graph().linearize(values)
        net = linear.eliminateSequential(gtsam.Ordering.MetisGaussianFactorGraph(linear))
        keys = [(X(one.i), X(one.j), C(one.segment)) for one in self.intervals]
        begins = own.pieces.first.tolist()
        which = np.concatenate([begin + one.row_piece for begin, one in zip(begins, self.intervals, strict=True)])
        covariance = covariance_of_pieces(CovarianceBlocks(net), keys, own, which)
        time = np.concatenate([one.row_time for one in self.intervals])
        return Rows(time, own.poses.value[which], covariance, [f for one in self.intervals for f in one.labels])

    def rows_ahead(self, tail: Steps | None = None) -> Rows:
        """The steps since the last keyframe, and what they are likely to be; the last is the present."""
        whole = self._whole if tail is None else np.concatenate([self._whole, _rows(tail)])
        ends = whole[(whole[:, END] > self.times[-1] + INSTANT) & (whole[:, ROW] > 0), END]
        moments = np.append(ends, whole[-1:, END]) if len(whole) else ends
        beliefs = [self.belief(tail, until) for until in moments.tolist()]
        pose = np.array([one.mean[:3] for one in beliefs]).reshape(-1, 3)
        covariance = np.array([one.covariance[:3, :3] for one in beliefs]).reshape(-1, 3, 3)
        return Rows(moments, pose, covariance, [self.floor] * len(moments))

    def hand_out(self) -> list[Rows]:
        """The rows that are settled, once."""
        handed, self.settled = self.settled, []
        return handed

    @property
    def cost(self) -> float:
        """Half the sum of squared, robustly weighted errors of the window."""
        values = self.tree.values
        own = self.evaluate(self.intervals).cost if self.intervals else 0.0
        observed = sum(rows.cost for _, _, rows, _ in self._observed(values))
        linear = {("own", one.j) for one in self.intervals} | {("fix", n) for n in self.receivers.fixes}
        linear |= {("level", n) for n in self.beacons.levels} if self.beacons else set()
        others = [factor for name, factor in self.tree.factors.items() if name not in linear]
        return own + observed + float(sum(factor.error(values) for factor in [*others, *self.tree.past]))

    def _last_belief(self) -> Belief:
        """Of the last keyframe and its calibration, as the tree has it now."""
        if self._last is None or self._last[0] is not self.tree.values:
            joint = self.tree.covariance([X(self.keyframes[-1]), C(self._segment)])
            T = np.eye(6)
            T[:3, :3] = pose_rotation(self.pose[-1:, 2])[0]
            self._last = self.tree.values, Belief(np.append(self.pose[-1], self.c[self._segment]), T @ joint @ T.T)
        return self._last[1]

    def finish(self) -> None:
        """The walk ends here: its last keyframe, and everything linearised where it is until nothing moves."""
        if not self.keyframes:
            return
        for fix in self.waiting:
            overhang = fix.time - self.covered
            if 0 < overhang <= LONGEST_OVERHANG:
                fix.time, fix.sigma = self.covered, float(np.hypot(fix.sigma, WALKING_SPEED * overhang))
        self._close(at_end=True)
        if not self.sure and self._placed():
            self._lay()
        best, least = self.tree, self.cost
        self.tree = best.anew(relinearise=0.0)
        while self._relinearise(SETTLED) and self.cost < least * (1 - SETTLES):
            best, least = self.tree.anew(relinearise=0.0), self.cost
        if self.cost > least:
            self.tree = best
        self._read()

    # Keyframes

    def _begin(self, time: float) -> None:
        self._whole_start = round(time, DECIMALS)
        self.tree = Tree(self.lag)
        self.keyframes, self.times, self._count = [0], [self._whole_start], 1
        self._edge = self._whole_start, np.diag([FRAME_SIGMA**2] * 3)
        self.pose = np.zeros((1, 3))
        self.c = {0: np.array(self.prior.mean)}
        values = gtsam.Values()
        values.insert(X(0), gtsam.Pose2())
        values.insert(C(0), self.c[0])
        times = {X(0): self._whole_start, C(0): self._whole_start}
        self.fixes = [fix for fix in self.fixes if self._hold_at(fix, self._whole_start)]
        self.tree.update({"frame": self._frame(), "c": self._c_factor(0)}, values=values, times=times)

    def _close(self, at_end: bool = False) -> bool:
        """Close the keyframes that the steps and fixes have made, and update the estimate; whether there were any."""
        levels = self.beacons.due(self.covered, self._walked_by) if self.beacons else []
        new, changed = self._cut_new([level.time for level in levels], at_end), self._reach_fixes()
        if not new and not changed:
            return False
        for level in levels:
            level.keyframe = self.keyframes[self._keyframe_at(level.time)]
        if changed:
            self._believe()
        if not self.sure and self.times[-1] >= self._lay_next and self._placed():
            self._lay()
        else:
            self._add(new, changed, levels)
        if changed:
            self._judge()
        self._walls_due, self._rounds_due = self.plan is not None, ROUNDS
        return True

    def _placed(self) -> bool:
        """Whether anything tells where the walk was."""
        return bool(self.beacons and self.beacons.levels) or any(fix.keyframe is not None for fix in self.fixes)

    def _cut_new(self, marks: list[float], at_end: bool) -> list[Interval]:
        """The intervals that are complete since the last keyframe."""
        made: list[Interval] = []
        for end in self._ends([*marks, self.covered] if at_end else marks):
            made.append(
                self._interval(self.keyframes[-1], self._number(), self.times[-1], end, self._next_segment(end))
            )
            self._place_last(made[-1])
        return made

    def _ends(self, marks: list[float]) -> list[float]:
        """The times of the next keyframes, of which some are asked for."""
        last = self.times[-1]
        rows = self._whole[self._whole[:, END] > last + INSTANT]
        if not len(rows):
            return []
        gaps = rows[rows[:, GAP] > 0]
        starts = self._whole[np.searchsorted(self._whole[:, END], gaps[:, END]) - 1, END] if len(gaps) else []
        at_fixes = [fix.time for fix in self.waiting if last + INSTANT < fix.time <= self.covered]
        at_fixes += [mark for mark in marks if last + INSTANT < mark]
        required = np.unique([*at_fixes, *(t for t in starts if t > last + INSTANT), *gaps[:, END]])
        ends: list[float] = []
        for stop in (*required.tolist(), None):
            inside = rows[(rows[:, END] > last + INSTANT) & (rows[:, END] < (np.inf if stop is None else stop)), END]
            if stop is None:
                ends += inside[PIECES_PER_KEYFRAME - 1 :: PIECES_PER_KEYFRAME].tolist()
                break
            parts = -(-(len(inside) + 1) // PIECES_PER_KEYFRAME)
            whole = np.append(inside, stop)
            ends += [float(share[-1]) for share in np.array_split(whole, parts)]
            last = stop
        return ends

    def _interval(self, i: int, j: int, begin: float, end: float, segment: int) -> Interval:
        pieces = one_interval(self._whole, self._whole_start, begin, end)
        ends = np.append(begin + pieces.to_end[1], end)[:-1]
        rows = self._whole[(self._whole[:, ROW] > 0), END]
        rows = rows[(rows > begin + INSTANT) & (rows <= end + INSTANT)]
        own = bridge(pieces, preintegrate(pieces, np.array(self.prior.mean)[None]))
        which = np.minimum(np.searchsorted(ends, rows - INSTANT), len(ends) - 1)
        return Interval(i, j, segment, pieces, own, rows, which, [None] * len(ends), [self.floor] * len(rows))

    def _place_last(self, one: Interval) -> None:
        """A keyframe where the steps lead from the one before."""
        c = self.c[one.segment]
        moved = preintegrate(one.pieces, c[None]).delta[-1]
        pose = self.pose[-1] + np.append(rotation(self.pose[-1, 2]) @ moved[:2], moved[2])
        self.intervals.append(one)
        self.keyframes.append(one.j)
        self.times.append(one.end)
        self.pose = np.concatenate([self.pose, pose[None]])

    def _next_segment(self, end: float) -> int:
        """The calibration of the interval up to ``end``."""
        rows = self._whole[(self._whole[:, END] > self.times[-1] + INSTANT) & (self._whole[:, END] <= end + INSTANT)]
        gap = bool(len(self.intervals)) and bool(rows[:, GAP].any())
        if self._in_segment >= STEPS_PER_SEGMENT or gap:
            self._segment += 1
            self._in_segment = 0
            self.c[self._segment] = self.c[self._segment - 1]
        self._in_segment += int(rows[:, ROW].sum())
        return self._segment

    def _number(self) -> int:
        self._count += 1
        return self._count - 1

    def _reach_fixes(self) -> list[LiveFix]:
        """Give fixes that the steps have reached their keyframe; those that got one."""
        reached = [fix for fix in self.waiting if fix.time <= self.times[-1] + INSTANT]
        for fix in reached:
            fix.keyframe = self.keyframes[self._keyframe_at(fix.time)]
            fix.walked = float(self._walked_by(fix.time))
        return reached

    def _keyframe_at(self, time: float) -> int:
        """The place in order of the keyframe at a moment of the window; it is made if there is none."""
        at = int(np.argmin(np.abs(np.array(self.times) - time)))
        return at if abs(self.times[at] - time) <= INSTANT else self._split(time)

    def _split(self, time: float) -> int:
        """A keyframe in an interval that was closed; its place in order."""
        at = int(np.searchsorted(self.times, time))
        old, number = self.intervals[at - 1], self._number()
        one = self._interval(old.i, number, old.begin, time, old.segment)
        other = self._interval(number, old.j, time, old.end, old.segment)
        for part in (one, other):
            nearest = np.searchsorted(old.pieces.to_end[1] + old.begin, part.begin + part.pieces.to_end[1] - INSTANT)
            part.fields = [old.fields[min(n, len(old.fields) - 1)] for n in nearest]
        share = (time - old.begin) / (old.end - old.begin)
        pose = (1 - share) * self.pose[at - 1] + share * self.pose[at]
        self.intervals[at - 1 : at] = [one, other]
        self.keyframes.insert(at, number)
        self.times.insert(at, time)
        self.pose = np.insert(self.pose, at, pose, axis=0)
        return at

    def _walked_by(self, time: float | Array) -> Array:
        """How far the steps have led. [m]"""
        moved = np.where(self._whole[:, GAP] > 0, DRIVEN * np.diff(self._whole[:, END], prepend=self._whole_start), 0)
        way = np.append(0.0, np.cumsum(self._whole[:, LENGTH] + moved))
        return self._walked + np.interp(time, np.append(self._whole_start, self._whole[:, END]), way)

    # Estimates

    def _add(self, new: list[Interval], reached: list[LiveFix], levels: list[SeenLevel]) -> None:
        """One update with what is new."""
        values, times = gtsam.Values(), dict[int, float]()
        for number, time, pose in zip(self.keyframes, self.times, self.pose, strict=True):
            if X(number) not in self.tree:
                values.insert(X(number), gtsam.Pose2(*pose))
                times[X(number)] = time
        factors: dict[Name, gtsam.NonlinearFactor] = {}
        for segment in sorted({one.segment for one in new}):
            if C(segment) not in self.tree:
                values.insert(C(segment), self.c[segment])
                factors["change", segment] = self._change(segment)
            times[C(segment)] = self.times[-1]
        known = gtsam.Values(self.tree.values)
        known.insert(values)
        factors |= self._own([one for one in self.intervals if np.isnan(one.at[0])], known)
        factors |= self._observe(reached, levels, known, values, times)
        self._update(factors, values=values, times=times)

    def _refine(self) -> None:
        """One thing at a time, in the steps between keyframes: the walls, and whatever has moved linearised again."""
        if self._walls_due and self.sure:
            self._walls_due = False
            self._find_walls()
        elif self._rounds_due:
            self._rounds_due = self._rounds_due - 1 if self._relinearise(MOVED) else 0

    def _lay(self) -> None:
        """Begin again with the track laid on all fixes of the window, as a batch would."""
        self._laid_out()
        for one in self.intervals:
            one.fields = [None] * len(one.fields)
        elapsed = self.times[-1] - self._steps[0].start
        self._lay_next = self.times[-1] + max(AGAIN, SPACED * elapsed)
        self._build(Tree(self.lag if self.sure else np.inf))
        for _ in range(ROUNDS):
            if not self._relinearise(MOVED):
                break

    def _build(self, tree: Tree) -> None:
        """All factors of the window, in a tree that is new."""
        self._rebuilds += self.tree.rebuilds
        self.tree = tree
        values, times = gtsam.Values(), dict[int, float]()
        for number, time, pose in zip(self.keyframes, self.times, self.pose, strict=True):
            values.insert(X(number), gtsam.Pose2(*pose))
            times[X(number)] = time
        segments = sorted({one.segment for one in self.intervals}) or [self._segment]
        factors: dict[Name, gtsam.NonlinearFactor] = {"frame": self._frame(), "c": self._c_factor(segments[0])}
        for segment in segments:
            values.insert(C(segment), self.c[segment])
            times[C(segment)] = max(one.end for one in self.intervals if one.segment == segment)
            if segment != segments[0]:
                factors["change", segment] = self._change(segment)
        known = gtsam.Values(values)
        factors |= self._own(self.intervals, known)
        self.receivers = LiveReceivers()
        reached = sorted((fix for fix in self.fixes if fix.keyframe is not None), key=lambda fix: fix.time)
        levels = self.beacons.again() if self.beacons else []
        factors |= self._observe(reached, levels, known, values, times)
        self._update(factors, values=values, times=times)

    def _observe(
        self,
        fixes: list[LiveFix],
        levels: list[SeenLevel],
        known: gtsam.Values,
        values: gtsam.Values,
        times: dict[int, float],
    ) -> dict[Name, gtsam.NonlinearFactor]:
        """The factors of fixes and levels that have their keyframe; their variables go into all three."""
        factors: dict[Name, gtsam.NonlinearFactor] = {}

        def new(added: dict[Name, gtsam.NonlinearFactor], variables: gtsam.Values) -> None:
            factors.update(added)
            values.insert(variables)
            known.insert(variables)

        for fix in fixes:
            assert fix.keyframe is not None, "it was reached"
            if fix.kind == "none":
                continue
            if fix.source and not self.prior.fix_flat:
                speed = (fix.walked - float(self._walked_by(fix.time - LATELY))) / LATELY
                one = SeenFix(fix.keyframe, position=fix.position, velocity=speed, wild=fix.kind == "wild")
                nodes, variables, alive = self.receivers.add(
                    fix.number, fix.source, one, fix.time, fix.sigma, fix.walked, known
                )
                new(nodes, variables)
                times |= alive
            else:
                factors["fix", fix.number] = self._fix(fix)
        for level in levels:
            assert self.beacons is not None, "it was heard"
            new(*self.beacons.add(level))
        for key in self.beacons.keys if self.beacons else ():
            times[key] = self.times[-1]
        return factors | self._seen(known)

    def _seen(self, known: gtsam.Values) -> dict[Name, gtsam.NonlinearFactor]:
        """The factors of receivers and beacons that have changed since they were linearised."""
        factors: dict[Name, gtsam.NonlinearFactor] = {}
        for kind, seen, rows, pose in self._observed(known):
            factors |= linearised(kind, seen, rows, pose, known)
        return factors

    def _observed(self, known: gtsam.Values) -> Iterator[tuple[str, dict[int, Seen], Rows, Array]]:
        """What receivers and beacons saw, their factors and the poses of their keyframes."""
        place = {number: n for n, number in enumerate(self.keyframes)}
        for kind, seen, model in (
            ("fix", self.receivers.fixes, self.receivers),
            ("level", self.beacons.levels if self.beacons else {}, self.beacons),
        ):
            if seen and model is not None:
                pose = self.pose[[place[one.keyframe] for one in seen.values()]]
                yield kind, seen, model.rows(list(seen.values()), pose, known), pose

    def _laid_out(self) -> None:
        """Poses and calibrations of the window as a batch has them, and whether these are sure."""
        steps = reduce(follow, self._steps)
        fixes = [fix for fix in self.fixes if fix.keyframe is not None]
        graph = WalkGraph(
            steps,
            _as_fixes(fixes),
            floor=self.plan,
            floors=[self.floor] * (len(steps) + 2),
            levels=self.beacons.so_far(steps) if self.beacons else None,
            prior=replace(self.prior, mean=tuple(self._c_prior[0].tolist())),
        )
        found = solutions(graph)
        best, before = found[0], self.pose[0].copy()
        track = Track.of(best)
        self.pose = track.at(np.array(self.times))
        for one in self.intervals:
            self.c[one.segment] = track.calibration(one.end)
        weight = probabilities(found, ways(found))
        self.sure = bool(weight[ways(found) == 0].sum() > SURE and track.sigma_heading < AMBIGUOUS)
        for fix, held, wild in zip(fixes, best.graph.fix_held.tolist(), best.graph.fix_wild.tolist(), strict=True):
            fix.kind = "none" if not held else "wild" if wild else "grip"
        self._move_settled(before, self.pose[0])

    def _believe(self) -> None:
        """Which fixes of the window can be of one walk."""
        fixes = sorted((fix for fix in self.fixes if fix.keyframe is not None), key=lambda fix: fix.time)
        if not fixes:
            return
        sigma = np.array([fix.sigma for fix in fixes])
        way = STRETCHED * np.array([fix.walked for fix in fixes])
        _, believed = chained(np.array([fix.position for fix in fixes]), WITHIN * sigma, way, np.inf, ENDS)
        newest = int(np.flatnonzero(believed)[-1])
        turned = [fix for n, fix in enumerate(fixes) if fix.believed and not believed[n] and n < newest]
        for fix, now in zip(fixes, believed.tolist(), strict=True):
            fix.believed = now
            if not now and fix.kind == "grip":
                fix.kind = "none"
        if turned and self.sure and believed.sum() > 1:
            self._restart()

    def _restart(self) -> None:
        """The fixes say that the walk was elsewhere: what was before the window is no longer believed."""
        first = self.intervals[0].segment
        covariance = self.tree.covariance([C(first)]) + np.diag(np.square(self.prior.change))
        self._c_prior = self.c[first], covariance
        self.restarts += 1
        self.sure, self._lay_next = False, -np.inf

    def _judge(self) -> None:
        """Fixes that are far off lose their grip; those that are near again have it."""
        place = {number: n for n, number in enumerate(self.keyframes)}
        reached = [fix for fix in self.fixes[-RECENT:] if fix.keyframe is not None]
        at = [place[fix.keyframe] for fix in reached if fix.keyframe is not None]
        apart = self.pose[at, :2] - np.array([fix.position for fix in reached])
        far = np.hypot(*apart.T) > WILD * np.array([fix.sigma for fix in reached])
        factors: dict[Name, gtsam.NonlinearFactor] = {}
        remove: list[Name] = []
        for fix, is_far in zip(reached, far.tolist(), strict=True):
            kind = ("wild" if fix.believed else "none") if is_far else "grip"
            if kind != fix.kind:
                fix.kind = kind
                seen = self.receivers.fixes.get(fix.number)
                if kind == "none":
                    remove.append(("fix", fix.number))
                    self.receivers.fixes.pop(fix.number, None)
                elif seen is not None:
                    seen.wild, seen.at = kind == "wild", np.full(4, np.nan)
                else:
                    factors["fix", fix.number] = self._fix(fix)
        if factors or remove:
            self._update(factors, remove)

    def _relinearise(self, moved: Array) -> bool:
        """Linearise the intervals that have moved; whether there were any."""
        if not self.intervals:
            return False
        looked = self.intervals if moved is SETTLED or self._count % EVERY == 0 else self.intervals[-RECENT:]
        apart = np.abs(self._state(looked) - np.array([one.at for one in looked]))
        apart[:, [2, 5]] = np.abs(wrap_angle(apart[:, [2, 5]]))
        limit = np.tile(moved, (len(looked), 1))
        if self.walls:
            near = [any(one.fields) for one in looked]
            limit[np.ix_(near, [0, 1, 3, 4])] = np.minimum(moved[0], BESIDE_WALLS)
        stale = np.flatnonzero(~(apart <= limit).all(axis=1))
        factors = self._own([looked[n] for n in stale], self.tree.values) | self._seen(self.tree.values)
        if factors:
            self._update(factors)
        return len(factors) > 0

    def _update(
        self,
        factors: dict[Name, gtsam.NonlinearFactor],
        remove: Iterable[Name] = (),
        values: gtsam.Values | None = None,
        times: dict[int, float] | None = None,
    ) -> None:
        """Update the tree, and let go of what leaves the window."""
        self.tree.update(factors, remove, values, times)
        gone = next((n for n, number in enumerate(self.keyframes) if X(number) in self.tree), len(self.keyframes))
        if gone:
            self._let_go(gone)
        self._read()
        if gone and self.times[0] > self._edge[0] + SPARSE:
            self._settle()

    def _let_go(self, gone: int) -> None:
        """The rows before the first keyframe that is left stay where they are."""
        leaving = self.intervals[:gone]
        placed, first = self.evaluate(leaving).poses.value, 0
        for n, one in enumerate(leaving):
            pose = placed[first + one.row_piece]
            first += len(one.pieces.length)
            R = pose_rotation(np.full(len(pose), self.pose[n, 2]))
            spread = R @ one.bridge.spread[one.row_piece] @ R.transpose(0, 2, 1)
            self.left.append(Rows(one.row_time, pose, spread, one.labels))
        keep = self._whole[:, END] > self.times[gone] + INSTANT
        first = int(np.argmax(keep)) if keep.any() else len(self._whole)
        start = float(self._whole[first - 1, END]) if first else self._whole_start
        self._walked = float(self._walked_by(start))
        self._whole, self._whole_start = self._whole[first:], start
        del self.keyframes[:gone], self.times[:gone], self.intervals[:gone]
        self.pose = self.pose[gone:]
        self._steps = [steps for steps in self._steps if steps.end > self.times[0]]
        alive = set(self.keyframes)
        self.fixes = [fix for fix in self.fixes if fix.keyframe is None or fix.keyframe in alive]
        self.receivers.forget(alive)
        if self.beacons is not None:
            self.beacons.forget(alive, self.times[0])
        segments = {one.segment for one in self.intervals} | {self._segment}
        self.c = {s: value for s, value in self.c.items() if s in segments}

    def _settle(self) -> None:
        """Give the rows that have left their covariance: between two keyframes that left, it changes evenly."""
        (before, one), (after, other) = self._edge, (self.times[0], self._covariance(0))
        for rows in self.left:
            share = ((rows.time - before) / (after - before))[:, None, None]
            self.settled.append(replace(rows, covariance=(1 - share) * one + share * other + rows.covariance))
        self.left, self._edge = [], (after, other)

    def _read(self) -> None:
        """Poses and calibrations of the window."""
        values = self.tree.values
        self.pose[np.argsort(self.keyframes)] = gtsam.utilities.extractPose2(values)
        for segment in self.c:
            if values.exists(C(segment)):
                self.c[segment] = values.atVector(C(segment))

    def _state(self, intervals: list[Interval]) -> Array:
        """x_i, x_j, c of intervals ``(k, 9)``."""
        place = {number: n for n, number in enumerate(self.keyframes)}
        i, j = ([place[getattr(one, end)] for one in intervals] for end in "ij")
        return np.hstack([self.pose[i], self.pose[j], np.array([self.c[one.segment] for one in intervals])])

    def _covariance(self, n: int) -> Array:
        """Of a keyframe, in the output axes."""
        R = pose_rotation(self.pose[n : n + 1, 2])[0]
        return R @ self.tree.covariance([X(self.keyframes[n])]) @ R.T

    def _move_settled(self, before: Array, after: Array) -> None:
        """What has left the window was in a frame of its own until now."""
        turn = after[2] - before[2]
        R = pose_rotation(np.array([turn]))[0]
        for past in (self.settled, self.left):
            for k, rows in enumerate(past):
                moved = (rows.pose[:, :2] - before[:2]) @ R[:2, :2].T + after[:2]
                pose = np.column_stack([moved, rows.pose[:, 2] + turn])
                past[k] = replace(rows, pose=pose, covariance=R @ rows.covariance @ R.T)

    # Factors

    def _own(self, intervals: list[Interval], known: gtsam.Values) -> dict[Name, gtsam.NonlinearFactor]:
        """Steps and walls of some intervals, linearised where they are."""
        if not intervals:
            return {}
        own, at = self.evaluate(intervals), self._state(intervals)
        pdr, wall, pressed = own.pdr, own.wall, np.empty(0, dtype=np.intp)
        if wall is not None:
            pressed = np.flatnonzero(wall.value[:, 0])
        factors: dict[Name, gtsam.NonlinearFactor] = {}
        for n, one in enumerate(intervals):
            one.at = at[n]
            blocks = [pdr.by_i[n], pdr.by_j[n], pdr.by_c[n]]
            error = pdr.value[n]
            if wall is not None and len(here := pressed[own.pieces.interval[pressed] == n]):
                rows = wall.take(here)
                error = np.append(error, rows.value[:, 0])
                others = (rows.by_i[:, 0], rows.by_j[:, 0], rows.by_c[:, 0])
                blocks = [np.vstack(pair) for pair in zip(blocks, others, strict=True)]
            keys = X(one.i), X(one.j), C(one.segment)
            factors["own", one.j] = linear(keys, blocks, error, known)
        return factors

    def _fix(self, fix: LiveFix) -> gtsam.NonlinearFactor:
        noise, estimator = gtsam.noiseModel, gtsam.noiseModel.mEstimator
        loss = estimator.GemanMcClure.Create(WILD_WIDTH) if fix.kind == "wild" else estimator.Huber.Create(HUBER_WIDTH)
        robust = noise.Robust.Create(loss, noise.Isotropic.Sigma(2, fix.sigma))
        assert fix.keyframe is not None, "it was reached"
        return gtsam.PoseTranslationPrior2D(X(fix.keyframe), fix.position, robust)

    def _c_factor(self, segment: int) -> gtsam.NonlinearFactor:
        mean, covariance = self._c_prior
        return gtsam.PriorFactorVector(C(segment), mean, gtsam.noiseModel.Gaussian.Covariance(covariance))

    def _change(self, segment: int) -> gtsam.NonlinearFactor:
        change = gtsam.noiseModel.Diagonal.Sigmas(np.array(self.prior.change))
        return gtsam.BetweenFactorVector(C(segment - 1), C(segment), np.zeros(3), change)

    def _frame(self) -> gtsam.NonlinearFactor:
        """A loose hold on the first heading of the window; without a fix, what defines the frame."""
        first, pose = X(self.keyframes[0]), gtsam.Pose2(*self.pose[0])
        if any(fix.keyframe is not None for fix in self.fixes):
            return gtsam.PoseRotationPrior2D(first, pose, gtsam.noiseModel.Isotropic.Sigma(1, ANY_HEADING))
        return gtsam.PriorFactorPose2(first, pose, gtsam.noiseModel.Isotropic.Sigma(3, FRAME_SIGMA))

    # Walls

    def _walls(self, intervals: list[Interval]) -> Walls | None:
        if self.plan is None:
            return None
        number: dict[DistanceField | None, int] = {None: -1}
        of_piece = [number.setdefault(field, len(number) - 1) for one in intervals for field in one.fields]
        fields = tuple(f for f in number if f is not None)
        return Walls(fields, np.array(of_piece), 0.0, self.prior.wall_margin, self.prior.wall_sigma)

    def _find_walls(self) -> None:
        """The walls about the last pieces, where the walk leads now."""
        assert self.plan is not None, "asked for with a plan"
        last, count = [], 0
        for one in reversed(self.intervals):
            last.insert(0, one)
            count += len(one.pieces.length)
            if count > LOOKED_BACK:
                break
        own = self.evaluate(last)
        labels = [self.floor] * count
        ground = Ground.of(self.plan, labels)
        fields, of_piece, _ = ground.walls_along(own.poses.value[:, :2], own.pieces.length > 0)
        named = [fields[n] if n >= 0 else None for n in of_piece.tolist()]
        for one, first in zip(last, own.pieces.first.tolist(), strict=True):
            now = named[first : first + len(one.fields)]
            if any(a is not b for a, b in zip(now, one.fields, strict=True)):
                one.fields = now
                one.at = np.full(9, np.nan)


@dataclass(frozen=True)
class Track:
    """A batch's walk: time ``(m + 1,)`` and pose ``(m + 1, 3)`` of the ends of its pieces; segment_start ``(s,)`` [s] and
    c ``(s, 3)``; sigma_heading: of its end [rad].
    """

    time: Array
    pose: Array
    segment_start: Array
    c: Array
    sigma_heading: float

    @classmethod
    def of(cls, optimum: Optimum) -> Track:
        """The walk of an optimum."""
        pieces, own, graph = optimum.graph.pieces, optimum.own, optimum.graph
        ends = pieces.keyframe_time[:-1][pieces.interval] + pieces.to_end[1]
        pose = np.vstack([own.pose_i[:1], own.poses.value])
        first = np.flatnonzero(np.diff(graph.segment, prepend=-1))
        last = CovarianceBlocks(optimum.net).joint([(X(len(graph.segment)),)])[0]
        start = pieces.keyframe_time[:1]
        return cls(
            np.append(start, ends),
            pose,
            pieces.keyframe_time[first],
            State.of(optimum.values).c,
            float(np.sqrt(last[2, 2])),
        )

    def at(self, time: Array) -> Array:
        """Poses ``(n, 3)`` at some times; before its start as at it."""
        return interpolate(time, self.time, np.column_stack([self.pose[:, :2], np.unwrap(self.pose[:, 2])]))

    def calibration(self, time: float) -> Array:
        """c at a moment [s]."""
        return self.c[max(int(np.searchsorted(self.segment_start, time)) - 1, 0)]


def _as_fixes(fixes: Sequence[LiveFix]) -> Fixes:
    return Fixes(
        np.array([fix.time for fix in fixes]),
        np.array([fix.position for fix in fixes]).reshape(-1, 2),
        np.array([fix.sigma for fix in fixes]),
        tuple(fix.floor for fix in fixes),
        source=tuple(fix.source for fix in fixes),
    )


def _rows(steps: Steps) -> Array:
    """Whole pieces ``(m, 8)`` of steps: as of `whole_pieces`, whether a row ends there, and whether it is a gap."""
    whole = whole_pieces(steps)
    row = np.isin(whole[:, END], np.round(steps.time, DECIMALS))
    gap = np.isin(whole[:, END], np.round(steps.time[steps.length == 0], DECIMALS))
    return np.column_stack([whole, row, gap])
