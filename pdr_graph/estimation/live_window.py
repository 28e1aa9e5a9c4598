"""The window of a walk under way: its keyframes, the intervals between them, their walls, and the estimate of all."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import C, X

from pdr_graph.estimation.factors import Evaluation, Walls, evaluate
from pdr_graph.estimation.graph import STEPS_PER_SEGMENT, Prior
from pdr_graph.estimation.live_way import CLOSE, Interval, Way
from pdr_graph.estimation.preintegration import Bridge, Pieces, preintegrate
from pdr_graph.floor.building import Building
from pdr_graph.floor.distance import DistanceField
from pdr_graph.floor.ground import Ground
from pdr_graph.geometry import rotation, wrap_angle
from pdr_graph.types import Array

ALL = 10**9  # pieces


class Window:
    """Keyframes in order of time, which need not be that of their numbers.

    way: the steps; keyframes, times, pose ``(k, 3)``: number, time [s] and estimate of each; intervals: between one and
    the next; c: estimate ``(3,)`` of each segment; floor: label of that on which the walk goes on.
    """

    def __init__(self, prior: Prior, plan: Building | None, floor: str):
        self.prior, self.plan, self.floor, self.way = prior, plan, floor, Way()
        self.keyframes, self.times, self.pose = list[int](), list[float](), np.empty((0, 3))
        self.intervals, self.c = list[Interval](), dict[int, Array]()
        self.segment, self.in_segment, self.count = 0, 0, 0

    def begin(self) -> None:
        """The first keyframe."""
        self.keyframes, self.times, self.count = [0], [self.way.start], 1
        self.pose, self.c = np.zeros((1, 3)), {0: np.array(self.prior.mean)}

    def cut(self, marks: list[float]) -> list[Interval]:
        """The intervals that are complete since the last keyframe, each a keyframe further."""
        new: list[Interval] = []
        for end in self.way.ends(self.times[-1], marks):
            segment = self._segment_until(end)
            new.append(self._interval(self.keyframes[-1], self._number(), self.times[-1], end, segment, self.floor))
            ahead = self._led(self.pose[-1], new[-1], self.c[segment])
            self.pose = np.concatenate([self.pose, ahead[None]])
            self.keyframes.append(new[-1].j)
            self.times.append(new[-1].end)
            self.intervals.append(new[-1])
        return new

    def keyframe_at(self, time: float) -> int:
        """The number of the keyframe at a moment; if there is none, an interval is split."""
        at = int(np.argmin(np.abs(np.array(self.times) - time)))
        return self.keyframes[at if abs(self.times[at] - time) <= CLOSE else self._split(time)]

    def evaluate(self, intervals: list[Interval]) -> Evaluation:
        """The own factors of some intervals."""
        at = self.state_of(intervals)
        pieces = Pieces.together([one.pieces for one in intervals])
        joined = Bridge.together([one.bridge for one in intervals])
        return evaluate(pieces, joined, at[:, :3], at[:, 3:6], at[:, 6:], self._walls(intervals))

    def state_of(self, intervals: list[Interval]) -> Array:
        """x_i, x_j, c of intervals ``(k, 9)``."""
        i, j = self.places(one.i for one in intervals), self.places(one.j for one in intervals)
        return np.hstack([self.pose[i], self.pose[j], np.array([self.c[one.segment] for one in intervals])])

    def places(self, numbers: Iterable[int]) -> list[int]:
        """Where keyframes are in order."""
        place = {number: n for n, number in enumerate(self.keyframes)}
        return [place[number] for number in numbers]

    @property
    def known_plan(self) -> Building | None:
        """The plan, where it is known on which of its floors the walk is."""
        return self.plan if self.plan is not None and self.floor in self.plan.labels else None

    def find_walls(self, pieces: int) -> float:
        """The walls about the last so many pieces, where the walk leads now; what it costs to lead there."""
        if self.known_plan is None or not self.intervals:
            return 0.0
        count = np.cumsum([len(one.fields) for one in reversed(self.intervals)])
        last = self.intervals[-1 - int(np.searchsorted(count, min(pieces, count[-1]))) :]
        own, labels = self.evaluate(last), [one.label for one in last for _ in one.fields]
        ground = Ground.of(self.known_plan, labels)
        fields, of_piece, price = ground.walls_along(own.ends[:, :2], own.pieces.length > 0)
        named = [fields[n] if n >= 0 else None for n in of_piece.tolist()]
        for one, first in zip(last, own.pieces.first.tolist(), strict=True):
            now = named[first : first + len(one.fields)]
            if any(a is not b for a, b in zip(now, one.fields, strict=True)):
                one.fields, one.at = now, np.full(9, np.nan)
        return price

    def lead_on(self, after: int, c: Array) -> None:
        """Place the keyframes after one, by its place in order, where the steps lead."""
        for n in range(after + 1, len(self.times)):
            self.pose[n] = self._led(self.pose[n - 1], self.intervals[n - 1], c)

    def read(self, values: gtsam.Values) -> None:
        """Take the estimate over."""
        self.pose[np.argsort(self.keyframes)] = gtsam.utilities.extractPose2(values)
        self.c |= {segment: values.atVector(C(segment)) for segment in self.c if values.exists(C(segment))}

    def values(self) -> tuple[gtsam.Values, dict[int, float]]:
        """All its variables as GTSAM takes them, and until when each is needed [s]."""
        values, times = gtsam.Values(), dict[int, float]()
        for number, time, pose in zip(self.keyframes, self.times, self.pose, strict=True):
            values.insert(X(number), gtsam.Pose2(*pose))
            times[X(number)] = time
        for segment in self.segments:
            values.insert(C(segment), self.c[segment])
            ends = [one.end for one in self.intervals if one.segment == segment]
            times[C(segment)] = max(ends, default=self.times[0])
        return values, times

    @property
    def segments(self) -> list[int]:
        """The calibrations of its intervals."""
        return sorted({one.segment for one in self.intervals} or {self.segment})

    def forget(self, count: int) -> None:
        """Let go of the first so many keyframes."""
        del self.keyframes[:count], self.times[:count], self.intervals[:count]
        self.pose = self.pose[count:]
        self.way.forget(self.times[0])
        kept = {*self.segments, self.segment}
        self.c = {segment: value for segment, value in self.c.items() if segment in kept}

    def state(self) -> dict[str, Any]:
        """All that it knows but what a tree has, as numbers."""
        return {
            "floor": self.floor,
            "numbers": [self.segment, self.in_segment, self.count],
            "way": self.way.state(),
            "keyframes": np.array(self.keyframes, dtype=np.int64),
            "times": np.array(self.times),
            "segments": [one.segment for one in self.intervals],
            "labels": [one.label for one in self.intervals],
            "c": [[segment, value] for segment, value in self.c.items()],
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a `state`, of the same prior and plan; the poses are read of the tree."""
        self.floor, self.way = state["floor"], Way.restored(state["way"])
        self.segment, self.in_segment, self.count = (int(n) for n in state["numbers"])
        self.keyframes, self.times = [int(n) for n in state["keyframes"]], [float(t) for t in state["times"]]
        self.c = {int(segment): np.array(value) for segment, value in state["c"]}
        spans = zip(self.keyframes, self.keyframes[1:], self.times, self.times[1:], strict=False)
        told = zip(spans, state["segments"], state["labels"], strict=True)
        self.intervals = [self._interval(*span, int(segment), label) for span, segment, label in told]
        self.pose = np.zeros((len(self.keyframes), 3))

    def _interval(self, i: int, j: int, begin: float, end: float, segment: int, label: str) -> Interval:
        return self.way.interval(i, j, begin, end, segment, np.array(self.prior.mean), label)

    def _led(self, pose: Array, one: Interval, c: Array) -> Array:
        """Where the steps of an interval lead."""
        moved = preintegrate(one.pieces, c[None]).delta[-1]
        return pose + np.append(rotation(pose[2]) @ moved[:2], moved[2])

    def _number(self) -> int:
        self.count += 1
        return self.count - 1

    def _segment_until(self, end: float) -> int:
        """The calibration of the interval up to ``end`` [s]: another after so many steps, and over a gap."""
        gap = len(self.intervals) > 0 and self.way.gap_within(self.times[-1], end)
        if self.in_segment >= STEPS_PER_SEGMENT or gap:
            self.segment, self.in_segment = self.segment + 1, 0
            self.c[self.segment] = self.c[self.segment - 1]
        self.in_segment += len(self.way.rows(self.times[-1], end))
        return self.segment

    def _split(self, time: float) -> int:
        """A keyframe in an interval that was closed; its place in order."""
        at = int(np.searchsorted(self.times, time))
        old, number = self.intervals[at - 1], self._number()
        halves = [
            self._interval(old.i, number, old.begin, time, old.segment, old.label),
            self._interval(number, old.j, time, old.end, old.segment, old.label),
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

    def _walls(self, intervals: list[Interval]) -> Walls | None:
        if self.plan is None:
            return None
        number: dict[DistanceField | None, int] = {None: -1}
        of_piece = [number.setdefault(field, len(number) - 1) for one in intervals for field in one.fields]
        fields = tuple(field for field in number if field is not None)
        return Walls(fields, np.array(of_piece), 0.0, self.prior.wall_margin, self.prior.wall_sigma)
