"""The window of a walk under way: its measurements, its steps, keyframes, the intervals between them, the estimate."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeVar

import numpy as np

from pdr_graph.estimation.factors.base import CALIBRATION, POSE, AnyArray, Measurement, State
from pdr_graph.estimation.factors.chain import (
    CLOSE,
    DECIMALS,
    Bridge,
    Chain,
    Path,
    Pieces,
    after,
    bridge,
    increment,
    intervals,
    pace_changes,
    preintegrate,
    whole_pieces,
)
from pdr_graph.estimation.factors.registry import KINDS, kind_of, measurements_of
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.estimation.factors.steps_and_walls import walls_of_fields, walls_on_plan
from pdr_graph.floor.building import Building, FloorSequence
from pdr_graph.floor.distance_field import DistanceField
from pdr_graph.gait.step_chunks import concatenate_steps
from pdr_graph.geometry import wrap_angle
from pdr_graph.inertial.barometer import with_goings
from pdr_graph.priors import FIXES, MOTION
from pdr_graph.types import (
    INSTANT,
    STEP_COLUMNS,
    Array,
    Fixes,
    Headings,
    Index,
    Mask,
    Sightings,
    Steps,
    appended,
    last_time,
    take,
)

Rows = TypeVar("Rows", Fixes, Headings)
RECENT = 6 * MOTION.pace_steps  # pieces, steps and pauses, among which a change of pace is sought
WAITING = 1000  # measurements of a type that are kept for the first steps
Decisions = dict[str, dict[str, AnyArray]]  # about measurements, by kind
UNTIL, LENGTH, VARIANCE, TURN_VARIANCE, IS_ROW, IS_GAP = 0, 1, 3, 4, 5, 6  # columns of whole pieces


@dataclass
class Interval:
    """The steps between two keyframes.

    j: number of the last keyframe; segment: number of the calibration; pieces, bridge: of its steps; delta: ``(3,)``
    displacement with the prior mean of the calibration; row_time [s], row_piece: of the trajectory rows that end in it;
    fields: distance to the walls of each piece, None without; label: of its floor.
    """

    j: int
    segment: int
    pieces: Pieces
    bridge: Bridge
    delta: Array
    row_time: Array
    row_piece: Index
    fields: list[DistanceField | None]
    label: str

    @property
    def begin(self) -> float:
        """Time of the first keyframe. [s]"""
        return float(self.pieces.keyframe_time[0])

    @property
    def end(self) -> float:
        """Time of the last keyframe. [s]"""
        return float(self.pieces.keyframe_time[1])


class StepBuffer:
    """The steps since the first keyframe of the window.

    whole: pieces ``(m, 7)``: columns of `whole_pieces`, then 1 if a trajectory row ends with the piece, 1 if it is a
    gap; start: of the first piece [s]; walked: distance before it [m]; chunks: the steps.
    """

    def __init__(self) -> None:
        self.whole, self.start, self.walked = np.empty((0, 7)), np.nan, 0.0
        self.chunks: list[Steps] = []
        self._distance: tuple[Array, Array, Array] | None = None  # pieces, their ends [s], distance by then [m]

    @property
    def end(self) -> float:
        """End of the last certain step. [s]"""
        return float(self.whole[-1, UNTIL]) if len(self.whole) else self.start

    @property
    def steps(self) -> Steps:
        """All stored steps."""
        if len(self.chunks) > 1:
            self.chunks = [concatenate_steps(self.chunks)]
        return self.chunks[0]

    def append(self, steps: Steps) -> Array:
        """Append the next steps; returns their whole pieces."""
        if not self.chunks:
            self.start = round(steps.start, DECIMALS)
        before = len(self.whole)
        self.chunks = [*self.chunks, steps]
        self.whole = self.with_tail(steps)
        return self.whole[before:]

    def set_goings(self, goings: Array) -> float:
        """Give the steps on stairs the length of the treads; returns when the first changed one ended [s], or infinity.

        goings: ``(k, 3)``, see `goings_of`.
        """
        if not self.chunks:
            return np.inf
        before, self.chunks, self.whole = self.steps, [with_goings(self.steps, goings)], self.whole.copy()
        row = np.flatnonzero(self.whole[:, IS_ROW])  # of the last steps: those before them have no piece any more
        changed = (self.steps.length != before.length)[len(before) - len(row) :]
        self.whole[row, LENGTH] = self.steps.length[len(before) - len(row) :]
        self.whole[row, VARIANCE] = self.steps.sigma_length[len(before) - len(row) :] ** 2
        return float(self.whole[row[changed], UNTIL].min(initial=np.inf))

    def with_tail(self, tail: Steps | None) -> Array:
        """The whole pieces, followed by those of provisional steps."""
        if tail is None:
            return self.whole
        whole, ends = whole_pieces(tail), np.round(tail.time, DECIMALS).tolist()
        is_gap = dict(zip(ends, tail.is_gap.tolist(), strict=True))
        marks = np.array([(end in is_gap, is_gap.get(end, False)) for end in whole[:, UNTIL].tolist()], dtype=float)
        return np.concatenate([self.whole, np.column_stack([whole, marks.reshape(-1, 2)])])

    def walked_by(self, time: float | Array) -> Array:
        """Distance walked by each time [s], with gaps at speed FIXES.driven. [m]"""
        if self._distance is None or self._distance[0] is not self.whole:
            end = self.whole[:, UNTIL]
            driven = np.where(self.whole[:, IS_GAP] > 0, FIXES.driven * np.diff(end, prepend=self.start), 0)
            distance = np.append(0.0, np.cumsum(self.whole[:, LENGTH] + driven))
            self._distance = self.whole, np.append(self.start, end), self.walked + distance
        return np.asarray(np.interp(time, *self._distance[1:]))

    def rows(self, begin: float, end: float) -> Array:
        """The pieces after ``begin`` and until ``end`` [s] that end with a trajectory row."""
        ends = self.whole[:, UNTIL]
        return self.whole[(self.whole[:, IS_ROW] > 0) & (ends > begin + CLOSE) & (ends <= end + CLOSE)]

    def keyframe_ends(self, last: float, marks: list[float]) -> list[float]:
        """Times [s] of the next keyframes after ``last``: at ``marks``, gaps, and after MOTION.steps_per_keyframe."""
        after = self.whole[:, UNTIL] > last + CLOSE
        gaps = np.flatnonzero(after & (self.whole[:, IS_GAP] > 0))
        over, begins = self.whole[gaps, UNTIL], [self.whole[n - 1, UNTIL] if n else self.start for n in gaps]
        required = np.unique([*(t for t in (*begins, *marks) if last + CLOSE < t <= self.end), *over])
        ends, pieces = list[float](), self.whole[after, UNTIL]
        for stop in required.tolist():
            share = np.append(pieces[(pieces > last + CLOSE) & (pieces < stop - CLOSE)], stop)
            parts = -(-len(share) // MOTION.steps_per_keyframe)
            ends += [float(part[-1]) for part in np.array_split(share, parts)]
            last = stop
        rest = pieces[pieces > last + CLOSE]
        return ends + rest[MOTION.steps_per_keyframe - 1 :: MOTION.steps_per_keyframe].tolist()

    def rewind(self, to: float) -> None:
        """Drop the pieces that end after ``to`` [s]."""
        self.whole = self.whole[: int(np.searchsorted(self.whole[:, UNTIL], to + CLOSE))]
        self.chunks = rewound(self.chunks, self.end)

    def forget(self, before: float) -> None:
        """Drop steps that ended before the first keyframe of the window, ``before`` [s]."""
        count = int(np.searchsorted(self.whole[:, UNTIL], before + CLOSE))
        if count:
            start = float(self.whole[count - 1, UNTIL])
            self.walked, self.start, self.whole = float(self.walked_by(start)), start, self.whole[count:]
        self.chunks = [later_steps(self.steps, before)]


def later_steps(steps: Steps, before: float) -> Steps:
    """The steps that end after ``before`` [s]; they start where the step before them ended."""
    count = int(np.searchsorted(steps.time, before))
    if not count:
        return steps
    later = {name: getattr(steps, name)[count:] for name in STEP_COLUMNS}
    return Steps(start=float(steps.time[count - 1]), end=steps.end, final_turn=steps.final_turn, **later)


def rewound(chunks: list[Steps], end: float) -> list[Steps]:
    """The steps that end by ``end`` [s], where the last chunk ends now."""
    before = [chunk for chunk in chunks if chunk.end <= end]
    for chunk in chunks[len(before) : len(before) + 1]:
        if chunk.start < end:
            count = int(np.searchsorted(chunk.time, end, side="right"))
            rows = {name: getattr(chunk, name)[:count] for name in STEP_COLUMNS}
            before.append(replace(chunk, end=end, final_turn=0.0, **rows))
    return before


Others = Mapping[str, Mapping[int, Array]]  # estimates ``(3,)`` of further variables, by symbol and number


class Window:
    """Keyframes in order of time; their numbers may be in another order.

    steps: of the walk; keyframes, times, pose ``(k, 3)``: number, time [s] and estimate of each; intervals: between
    consecutive keyframes; c, pace: estimate ``(3,)`` and change of pace of each segment; floor: label of the present
    floor; led, came: of the first keyframe, see `Chain`.
    """

    def __init__(self, prior: Prior, plan: Building | None, floor: str):
        self.prior, self.plan, self.floor, self.steps = prior, plan, floor, StepBuffer()
        self.keyframes, self.times, self.pose = list[int](), list[float](), np.empty((0, 3))
        self.intervals, self.c, self.pace = list[Interval](), dict[int, Array](), dict[int, float]()
        self.segment, self.in_segment, self.in_gap, self.count, self.finished = 0, 0, False, 0, False
        self.led: complex = 0.0
        self.came: complex = 0.0
        self._chain: Chain | None = None  # of the last intervals, None if it must be built again

    def begin(self) -> None:
        """Set the first keyframe, at the start of the steps."""
        self.keyframes, self.times, self.count = [0], [self.steps.start], 1
        self.pose, self.c = np.zeros((1, 3)), {0: np.array(self.prior.mean)}

    @property
    def covered(self) -> float:
        """Time [s] of the last measurements that may be used: any, when the walk has ended."""
        return np.inf if self.finished else self.steps.end

    @property
    def complete(self) -> bool:
        """True if the whole walk is still in the window."""
        return bool(self.keyframes) and self.keyframes[0] == 0

    @property
    def duration(self) -> float:
        """Time from the first to the last keyframe. [s]"""
        return self.times[-1] - self.times[0]

    def cut(self, ends: Iterable[float]) -> list[Interval]:
        """Close the intervals since the last keyframe that end at these times [s], and return them.

        After so many steps and after a gap, a new calibration begins.
        """
        new: list[Interval] = []
        for end in ends:
            rows = self.steps.rows(self.times[-1], end)
            gap = bool(rows[:, IS_GAP].any())
            due = self.in_segment >= MOTION.steps_per_segment or (gap and not self.in_gap)
            if due and self.intervals:  # an empty window has no link from the segment before
                self.segment, self.in_segment = self.segment + 1, 0
                self.c[self.segment] = self.c[self.segment - 1]
            self.in_gap = gap
            self.in_segment += len(rows)
            new.append(self._interval(self._number(), self.times[-1], end, self.segment, self.floor))
            move, _, _ = increment(self.steps.whole, self.steps.start, self.times[-1], end, self.c[self.segment])
            self.pose = np.concatenate([self.pose, after(self.pose[-1], move)[None]])
            self.keyframes.append(new[-1].j)
            self.times.append(new[-1].end)
            self.intervals.append(new[-1])
        if new:
            self._change_pace()
        if self._chain is not None:
            self._chain = _extended(self._chain, new, self.pace)
        return new

    def _change_pace(self) -> None:
        """Begin another segment at the keyframe nearest to where the pace last changed within the present one."""
        begin = min((interval.begin for interval in self.intervals if interval.segment == self.segment), default=np.inf)
        recent = np.flatnonzero(self.steps.whole[:, UNTIL] > begin + CLOSE)[-RECENT:]
        if not len(recent):
            return
        before = np.append(self.steps.start, self.steps.whole[:, UNTIL])[recent[0]]
        changed, pace = pace_changes(self.steps.whole[recent], float(before), begins=self.segment == 0)
        if not len(changed):
            return
        first = int(np.argmin(np.abs(np.array(self.times[:-1]) - changed[-1])))
        if first and self.times[first] > begin + CLOSE:  # the segment before it stays in the window
            self.segment += 1
            self.c[self.segment], self.pace[self.segment] = self.c[self.segment - 1], float(pace[-1])
            for interval in self.intervals[first:]:
                interval.segment = self.segment
            self.in_segment = len(self.steps.rows(self.times[first], self.times[-1]))
            self._chain = None

    def split(self, time: float) -> None:
        """Insert a keyframe at ``time`` [s] into a closed interval, if it has none; its pose is interpolated."""
        if not self.times[0] <= time <= self.times[-1] or np.abs(np.array(self.times) - time).min() <= CLOSE:
            return
        at = int(np.searchsorted(self.times, time))
        old, number = self.intervals[at - 1], self._number()
        halves = [
            self._interval(number, old.begin, time, old.segment, old.label),
            self._interval(old.j, time, old.end, old.segment, old.label),
        ]
        ends = old.begin + old.pieces.to_end[1]
        for half in halves:
            inside = np.searchsorted(ends, half.begin + half.pieces.to_end[1] - CLOSE)
            half.fields = [old.fields[min(n, len(ends) - 1)] for n in inside]
        share = (time - old.begin) / (old.end - old.begin)
        between = (1 - share) * self.pose[at - 1] + share * self.pose[at]
        between[2] = self.pose[at - 1, 2] + share * wrap_angle(self.pose[at, 2] - self.pose[at - 1, 2])
        self.intervals[at - 1 : at] = halves
        self._chain = None
        self.keyframes.insert(at, number)
        self.times.insert(at, time)
        self.pose = np.insert(self.pose, at, between, axis=0)

    def rewind(self, to: float) -> None:
        """Drop what is after the last keyframe until ``to`` [s], or after the first."""
        count = max(int(np.searchsorted(self.times, to + CLOSE)), 1)
        del self.keyframes[count:], self.times[count:], self.intervals[count - 1 :]
        self.pose, self._chain = self.pose[:count], None
        self.segment = self.intervals[-1].segment if self.intervals else self.segment
        self.steps.rewind(self.times[-1])

    def set_goings(self, goings: Array) -> bool:
        """Give the steps on stairs the length of the treads, see `StepBuffer`; True if any changed."""
        first = self.steps.set_goings(goings)
        for n, old in enumerate(self.intervals):
            if old.end > first - CLOSE:
                new = self._interval(old.j, old.begin, old.end, old.segment, old.label)
                self.intervals[n] = replace(new, fields=old.fields)
                self._chain = None
        return first < np.inf

    def chain(self, first: int = 0) -> Chain:
        """The intervals from the ``first`` on, as a chain for the factors."""
        if self._chain is None:
            at = Chain.keyframe_alone(self.times[0], self.keyframes[0], self.segment)
            self._chain = _extended(at, self.intervals, self.pace)
        whole = replace(self._chain, heading=self.pose[:, 2], led=self.led, came=self.came)
        return replace(whole.after(first), begins=first == 0, ends=self.finished)

    def state(self, chain: Chain, measurements: Iterable[Measurement] = (), others: Others | None = None) -> State:
        """The estimate of the last keyframes, those of ``chain``, and of the variables that measurements add.

        others: present estimates of these; without one, a variable is at its initial value.
        """
        c = np.array([self.c[segment] for segment in chain.segment_number.tolist()])
        arrays: dict[str, Array] = {POSE: self.pose[-len(chain.number) :], CALIBRATION: c}
        numbers: dict[str, Index] = {POSE: chain.number, CALIBRATION: chain.segment_number}
        for measurement in measurements:
            for new in measurement.variables(arrays[POSE]):
                values = (others or {}).get(new.symbol, {})
                rows = zip(new.number.tolist(), new.initial, strict=True)
                arrays[new.symbol] = np.array([values.get(n, initial) for n, initial in rows]).reshape(-1, 3)
                numbers[new.symbol] = new.number
        return State(arrays, numbers)

    @property
    def located_plan(self) -> Building | None:
        """The plan if it has the present floor, else None."""
        return self.plan if self.plan is not None and self.floor in self.plan.labels else None

    def floors(self, first: int = 0) -> FloorSequence | None:
        """The floor of each piece from interval ``first`` on; None if the plan does not have the present floor."""
        labels = [interval.label for interval in self.intervals[first:] for _ in interval.fields]
        return None if self.located_plan is None else FloorSequence.of(self.located_plan, labels)

    def walls(self, floors: FloorSequence | None) -> Measurement | None:
        """The walls that the pieces are associated with; None without a plan. floors: of the pieces."""
        if self.plan is None:
            return None
        fields = [field for interval in self.intervals for field in interval.fields]
        number = {field: n for n, field in enumerate(dict.fromkeys(field for field in fields if field is not None))}
        field_of = np.array([-1 if field is None else number[field] for field in fields], dtype=np.intp)
        return walls_of_fields(list(number), field_of, self.prior, floors)

    def associate_walls(self, pieces: int | None = None) -> bool:
        """Associate the last ``pieces``, by default all, with the walls along the estimate.

        Returns True if any piece has other walls than before.
        """
        if not self.intervals:
            return False
        count = np.cumsum([len(interval.fields) for interval in reversed(self.intervals)])
        first = max(0, len(self.intervals) - 1 - int(np.searchsorted(count, min(pieces or count[-1], count[-1]))))
        if (floors := self.floors(first)) is None:
            return False
        chain, last, changed = self.chain(first), self.intervals[first:], False
        walls = walls_on_plan(floors, self.prior).associated(chain.evaluate(self.state(chain)))
        named = [walls.fields[n] if n >= 0 else None for n in walls.field_of.tolist()]
        for interval, at in zip(last, chain.pieces.first.tolist(), strict=True):
            before, interval.fields = interval.fields, named[at : at + len(interval.fields)]
            changed |= any(a is not b for a, b in zip(before, interval.fields, strict=True))
        return changed

    @property
    def path(self) -> Path:
        """The estimate as a path."""
        chain = self.chain()
        return Path.of(chain, self.state(chain))

    def place_on(self, path: Path) -> None:
        """Move the estimate to a path; keyframes after its end are dead-reckoned."""
        chain = self.chain()
        self.read(path.placed(chain, self.state(chain)))

    def read(self, state: State) -> None:
        """Copy poses and calibrations from a state of all keyframes."""
        self.pose = state.poses.copy()
        self.c |= dict(zip(state.number(CALIBRATION).tolist(), state.c, strict=True))

    @property
    def segments(self) -> list[int]:
        """Numbers of the calibration segments in the window, ascending."""
        return sorted({interval.segment for interval in self.intervals} or {self.segment})

    def row_labels(self, steps: Steps) -> list[str]:
        """The floor's label of each trajectory row of steps from the window's start on: start, steps, end."""
        ends = np.array([interval.end for interval in self.intervals])
        labels = [*(interval.label for interval in self.intervals), self.floor]
        rows = [steps.start, *steps.time.tolist(), steps.end]
        return [labels[n] for n in np.searchsorted(ends, np.array(rows) - CLOSE).tolist()]

    def forget(self, count: int) -> None:
        """Drop the first ``count`` keyframes."""
        self._chain = self.chain().after(count)
        self.led, self.came = self._chain.led, self._chain.came
        del self.keyframes[:count], self.times[:count], self.intervals[:count]
        self.pose = self.pose[count:]
        self.steps.forget(self.times[0])
        kept = {*self.segments, self.segment}
        self.c = {segment: value for segment, value in self.c.items() if segment in kept}
        self.pace = {segment: value for segment, value in self.pace.items() if segment in kept}

    def _interval(self, j: int, begin: float, end: float, segment: int, label: str) -> Interval:
        """The interval to keyframe j, from ``begin`` to ``end`` [s]."""
        pieces = intervals(self.steps.whole, self.steps.start, begin, np.array([end]))
        ends, rows = begin + pieces.to_end[1], self.steps.rows(begin, end)[:, UNTIL]
        which = np.minimum(np.searchsorted(ends, rows - CLOSE), len(ends) - 1)
        increments = preintegrate(pieces, np.array([self.prior.mean]))
        bridges, delta = bridge(pieces, increments), increments.delta[-1]
        return Interval(j, segment, pieces, bridges, delta, rows, which, [None] * len(ends), label)

    def _number(self) -> int:
        self.count += 1
        return self.count - 1


def _extended(chain: Chain, new: Sequence[Interval], pace: Mapping[int, float]) -> Chain:
    """A chain with new intervals appended; pace: changes at the beginnings of segments, by number."""
    if not new:
        return chain
    of_segment = [*chain.segment_number[chain.segment].tolist(), *(interval.segment for interval in new)]
    segment_number, segment = np.unique(np.array(of_segment, dtype=np.intp), return_inverse=True)
    return Chain(
        pieces=Pieces.together([chain.pieces, *(interval.pieces for interval in new)]),
        bridge=Bridge.together([chain.bridge, *(interval.bridge for interval in new)]),
        delta=np.concatenate([chain.delta, [interval.delta for interval in new]]),
        segment=segment.astype(np.intp),
        number=np.append(chain.number, [interval.j for interval in new]),
        segment_number=segment_number,
        pace=np.array([pace.get(number, 0.0) for number in segment_number.tolist()]),
    )


class Collector(Protocol):
    """Makes measurements from receptions that arrive piecemeal (advertisements, scans)."""

    def collect(self, received: Sightings, radio: str) -> None:
        """Store receptions of a radio, "bluetooth" or "wifi"."""
        ...

    def due(self, until: float, walked: Callable[[Array], Array]) -> Iterable[Any]:
        """Return, once, the measurements that are complete until ``until`` [s].

        walked: times [s] to the distance walked by then [m].
        """
        ...

    def complete(self, steps: Steps) -> Iterable[Any]:
        """All measurements of the stored data, as the batch makes them."""
        ...

    def forget(self, before: float) -> None:
        """Drop raw data from before a moment [s]."""
        ...


@dataclass(frozen=True)
class Table:
    """Rows of one type of data. number: ``(n,)`` permanent row numbers; count: number of all rows so far."""

    data: Any
    number: Index
    count: int


class MeasurementLog:
    """The measurements of a window, by type of data, in order of time."""

    def __init__(self) -> None:
        self._tables: dict[type, Table] = {}
        self.version = 0  # increases when `measurements` would return others
        self.longer: MeasurementLog | None = None  # another log that gets the same rows, and keeps them longer

    def append(self, data: Any, number: Index | None = None) -> None:
        """Append rows. number: ``(n,)``, the next numbers by default; stored rows with these numbers are replaced."""
        kind_of(data)
        table = self._tables.get(type(data))
        count = 0 if table is None else table.count
        number = count + np.arange(len(data)) if number is None else number
        self.version += 1
        if self.longer is not None:
            self.longer.append(data, number)
        if table is not None:
            kept, before = table.number, table.data
            if (number < count).any() and (again := np.isin(kept, number)).any():
                kept, before = kept[~again], take(before, ~again)
            number, data = np.concatenate([kept, number]), appended(before, data)
        count = max(count, int(number.max(initial=-1)) + 1)
        time = last_time(data)
        if (np.diff(time) < 0).any():
            order = np.argsort(time, kind="stable")
            data, number = take(data, order), number[order]
        self._tables[type(data)] = Table(data, number, count)

    @property
    def longest_overhang(self) -> float:
        """Time [s] by which stored measurements may lie outside the steps."""
        return max((self.overhang(table.data) for table in self._tables.values()), default=0.0)

    @staticmethod
    def overhang(data: Any) -> float:
        """Time [s] by which measurements of the type of ``data`` may lie outside the steps."""
        return kind_of(data).overhang + INSTANT

    def rows_and_numbers(self, kind: type[Rows]) -> tuple[Rows, Index]:
        """All rows of one type, in order of time, and their numbers."""
        table = self._tables.get(kind)
        return (kind.none(), np.empty(0, dtype=np.intp)) if table is None else (table.data, table.number)

    def all_numbers(self, until: float) -> dict[str, Index]:
        """Row numbers of each kind up to ``until`` [s], in order of time."""
        tables = self._tables.values()
        return {kind_of(t.data).name: t.number[last_time(t.data) <= until + INSTANT] for t in tables}

    def renumbered(self, name: str, decisions: dict[str, AnyArray]) -> dict[str, AnyArray]:
        """Decisions about one kind, by row of all data instead of permanent number; without rows that are gone."""
        numbers = self.all_numbers(np.inf).get(name)
        if "number" not in decisions or numbers is None:
            return decisions
        row, old = np.nonzero(numbers[:, None] == decisions["number"])
        return {**{column: values[old] for column, values in decisions.items()}, "number": row}

    def present(self, decisions: Decisions) -> Decisions:
        """The decisions about rows that are still there; without the kinds of which no row is."""
        left = dict(decisions)
        for name, numbers in self.all_numbers(np.inf).items():
            if "number" in decisions.get(name, {}):
                of_kind = left.pop(name)
                if (kept := np.isin(of_kind["number"], numbers)).any():
                    left[name] = {column: rows[kept] for column, rows in of_kind.items()}
        return left

    def position_times(self) -> Array:
        """Times ``(n,)`` [s] of the rows that determine positions."""
        times = [last_time(table.data) for table in self._tables.values() if kind_of(table.data).determines_position]
        return np.concatenate([np.empty(0), *times])

    def times(self) -> list[float]:
        """Times of the rows of all types [s]."""
        return [
            time for table in self._tables.values() for time in np.round(table.data.time, DECIMALS).ravel().tolist()
        ]

    def until(self, end: float) -> list[Any]:
        """The rows of all types up to ``end`` [s]."""
        tables = [table.data for table in self._tables.values()]
        return [take(rows, np.flatnonzero(last_time(rows) <= end + INSTANT)) for rows in tables]

    def remove(self, kind: type, number: int) -> None:
        """Remove the row with this number, if there is one."""
        if self.longer is not None:
            self.longer.remove(kind, number)
        if kind in self._tables:
            self._keep(kind, self._tables[kind].number != number)

    def rows(self, kind: type) -> Any | None:
        """All rows of one type; None if none was ever appended."""
        table = self._tables.get(kind)
        return None if table is None else table.data

    def measurements(
        self, steps: Steps, prior: Prior, begin: float, end: float, decisions: Mapping[str, Mapping[str, AnyArray]]
    ) -> list[Measurement]:
        """All measurement kinds of the rows between ``begin`` and ``end`` [s], with decisions; not bound to a chain."""
        measurements = list[Measurement]()
        for kind in KINDS:
            table = self._tables.get(kind)
            if table is None:
                continue
            time, slack = last_time(table.data), self.overhang(table.data)
            which = np.flatnonzero((time >= begin - slack) & (time <= end + INSTANT))
            if len(which):
                every = len(which) == len(table.number)
                rows, number = (table.data, table.number) if every else (take(table.data, which), table.number[which])
                measurements += measurements_of(rows, steps, prior, number, decisions)
        return measurements

    def forget(self, before: float) -> None:
        """Drop the rows from before ``before`` [s]."""
        for kind, table in self._tables.items():
            time = table.data.time
            self._keep(kind, (time if time.ndim == 1 else time.min(axis=1)) >= before - INSTANT)

    def keep_latest(self, count: int = WAITING) -> None:
        """Drop all rows but the ``count`` of each type that arrived last; of the longer log too."""
        for kind, table in self._tables.items():
            self._keep(kind, np.isin(table.number, np.sort(table.number)[-count:]))
        if self.longer is not None:
            self.longer.keep_latest(count)

    def _keep(self, kind: type, kept: Mask) -> None:
        """Drop the rows of one type that are not ``kept (n,)``."""
        if not kept.all():
            table, self.version = self._tables[kind], self.version + 1
            self._tables[kind] = Table(take(table.data, kept), table.number[kept], table.count)


def numbered(decisions: dict[str, AnyArray], numbers: Index | None) -> dict[str, AnyArray]:
    """Decisions about rows 0, 1, … as those about the rows with permanent ``numbers``; without rows as they are."""
    if "number" not in decisions or numbers is None:
        return decisions
    return {**decisions, "number": numbers[decisions["number"].astype(np.intp)]}


def merged_decisions(old: Mapping[str, AnyArray], new: dict[str, AnyArray]) -> dict[str, AnyArray]:
    """The new decisions, and the old decisions about all other instances."""
    if "number" not in new or not old or np.array_equal(old["number"], new["number"]):
        return new
    kept = ~np.isin(old["number"], new["number"])
    joined = {name: np.concatenate([old[name][kept], column]) for name, column in new.items()}
    order = np.argsort(joined["number"])
    return {name: column[order] for name, column in joined.items()}
