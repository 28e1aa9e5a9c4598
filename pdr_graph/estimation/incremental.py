"""The factor graph of a walk under way: the model of `graph`, keyframe by keyframe, in a `Tree`.

Steps come in order; a keyframe closes after ten pieces of them, where something was measured, and at gaps. What comes
late splits the interval that it falls into. Its factors are those of `live_model`; this is how the walk finds its way.

Until the direction of the walk is sure there is nothing to linearise about: now and then the batch lays it out
(`live_start`), and nothing leaves the window.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import C, X

from pdr_graph.estimation.cloud import Seen
from pdr_graph.estimation.graph import FRAME_SIGMA, Prior
from pdr_graph.estimation.live_factors import Factors, frame_factor
from pdr_graph.estimation.live_fixes import GRIP, NONE, SLIPPING, LiveFix, believe, judged
from pdr_graph.estimation.live_model import MOVED, RECENT, LiveModel, Pointed
from pdr_graph.estimation.live_observations import LiveReceivers, SeenLevel
from pdr_graph.estimation.live_start import Laid, lay
from pdr_graph.estimation.live_way import CLOSE, Interval
from pdr_graph.estimation.live_ways import LiveWays, OtherWay
from pdr_graph.estimation.live_window import ALL
from pdr_graph.estimation.native import calibration_factor
from pdr_graph.estimation.preintegration import DECIMALS
from pdr_graph.estimation.tree import Name, Tree
from pdr_graph.floor.building import Building
from pdr_graph.state import restore, state_of
from pdr_graph.types import Array, Steps

SETTLED = np.array([1e-4, 1e-4, 1e-5] * 2 + [1e-4, 1e-4, 1e-6])  # of x_i, x_j, c, as `MOVED`, at the end of the walk
ROUNDS = 4  # of linearising again after a keyframe, one with each of the next steps
SETTLES = 1e-4  # at the end: when a round takes less than this share off the cost
AGAIN, SPACED = 3.0, 0.2  # [s], and share of its duration, before a walk that is not sure is laid out again
CHECKED = 5  # keyframes after which the cost is looked at
STRAINED, OF_KEYFRAME, OF_FIX = 8.0, 0.4, 3.0  # cost beyond which a walk is strained: twice what good ones have
PATIENCE = 4  # fixes that follow from one another, all far from the walk, until it is the walk that is wrong
LONGEST_OPEN = 180.0  # [s] until the most probable of several ways is taken: nobody can wait for a longer walk
REVIEWED = 50.0  # [s] after which a walk on a plan is laid out once more
LOOKED_BACK = 60  # pieces whose walls are asked for again


class IncrementalGraph(LiveModel):
    """Every measurement of a walk under way as a factor, about the way that explains them best.

    Arguments as of ``LiveModel``.
    """

    kept = ("fix_count", "too_late", "last_pointed", "sure", "lay_next", "restarts", "reviewed", "tried", "taken")

    def __init__(self, prior: Prior | None = None, lag: float = np.inf, plan: Building | None = None, floor: str = ""):
        super().__init__(prior, lag, plan, floor)
        self.lay_next, self.restarts = -np.inf, 0
        self.walls_due, self.rounds_due = False, 0
        self.ways: LiveWays | None = None
        self.reviewed = False  # once, when more of the walk was known
        self.tried, self.taken = 0, 0  # other ways, and those that were better

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
            self._lay(levels)
        else:
            self._add(new, reached, levels)
        if reached and self.sure:
            self._judge()
        self._follow(new)
        self.walls_due, self.rounds_due = self.window.plan is not None, ROUNDS
        return True

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

    # Where the walk is

    def _lay(self, levels: Sequence[SeenLevel] = ()) -> None:
        """Begin again from the walk as the batch lays it out; levels: that are not yet in the graph."""
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
        self._build(levels)
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

    # Where else it may be

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

    def _review_due(self) -> bool:
        """Whether a walk that was soon sure is to be laid out once more, before any of it leaves the window."""
        at, start = self.window.times[-1], self.window.times[0]
        return not self.reviewed and self.placed and self.window.keyframes[0] == 0 and at - start > REVIEWED

    def _strained(self) -> bool:
        """Whether so much speaks against the walk that it can hardly have gone this way, and there are fixes to ask."""
        fixes = sum(fix.reached for fix in self.fixes)
        return fixes > 1 and self.cost > STRAINED + OF_KEYFRAME * len(self.window.keyframes) + OF_FIX * fixes

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
