"""The floor of each step by barometer and fixes: the most probable sequence of storeys; batch and live.

A hidden Markov model whose states are the floors and the landings between them, at quarters of a storey. The state
changes only at climbs, by about the climb's height, so slow changes of the weather have no effect. Landings are states
so that the next climb continues from a stop half-way up the stairs. Unknown is the height of the storeys (without a
plan, about the same for all) or the scale of the plan's heights; the most probable of several values is used.

The floor is the nearest one in height: on stairs it changes half-way, and a passed floor is the present one briefly.
Live, the model runs over the last minutes every few seconds; these minutes start at a time without climbs, on the floor
estimated for it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Protocol

import numpy as np

from pdr_graph import storage
from pdr_graph.geometry import row_times, viterbi
from pdr_graph.inertial.barometer import CLIMB, DRAUGHT, RAMP, Climbs, climb_kinds, climbed_share, climbs
from pdr_graph.types import Array, Fixes, Index, Signal, Steps

STOREY_HEIGHT, SPREAD = 3.5, 0.2  # [m], and sigma of its logarithm: flats 2.7, offices 3.3–4.2, shops 5
SCALES, SCALE_SPREAD = np.linspace(0.82, 1.18, 19), 0.08  # candidates and sigma of the scale: nominal heights, warm air
TRIED: Array = STOREY_HEIGHT * np.exp(SPREAD * np.linspace(-2.5, 2.5, 26))  # [m] candidate heights
# "-2", "0"; "F1", "L2", "1F" and below them "B1", "B2F", with no floor 0 between
NUMERIC = re.compile(r"(?P<basement>B?)(?P<letter>[FL]?)(?P<number>-?\d+)(?P<behind>F?)", re.IGNORECASE)


class FloorHeights(Protocol):
    """A building's floors: labels and heights."""

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the floors from the lowest up."""
        ...

    @property
    def heights(self) -> Array:
        """Heights ``(f,)`` [m] of the floors, ascending."""
        ...


@dataclass(frozen=True)
class Storeys:
    """A hypothesis of the floors from the lowest up: labels, "" for a floor without name; heights ``(f,)`` [m].

    begin: index of the floor on which the walk began, None if unknown; cost: negative log prior of the heights.
    """

    labels: tuple[str, ...]
    heights: Array
    begin: int | None
    cost: float = 0.0


def of_building(building: FloorHeights, start: str) -> list[Storeys]:
    """The floors of a plan with several scales of their heights, since plan and barometer have scale errors."""
    labels, heights = building.labels, np.asarray(building.heights, dtype=float)
    begin = labels.index(start) if start in labels else None
    return [Storeys(labels, s * heights, begin, float(0.5 * ((s - 1) / SCALE_SPREAD) ** 2)) for s in SCALES]


def unknown(start: str, reported: tuple[str, ...], reach: float) -> list[Storeys]:
    """Storeys of several heights, numbered in the style of the start's label or else of the first reported one.

    reported: floor labels of fixes; reach: largest height difference [m] by climbs. If labels have no number, only the
    storey of the start has a label.
    """
    named = [label for label in (start, *reported) if label] or [""]
    numbers = {label: n for label in reversed(named) if (n := _number(label, named[0])) is not None}
    begin = numbers.get(start) if numbers else 0
    numbered = numbers.values() or [0]
    hypotheses = []
    for height in TRIED:
        margin = int(np.ceil(reach / height)) + 1
        storeys = range(min(numbered) - margin, max(numbered) + margin + 1)
        names = {n: _name(n, named[0]) for n in storeys} if numbers else {0: named[0]}
        names |= {n: label for label, n in numbers.items()}
        first = None if begin is None else begin - storeys[0]
        unusual = 0.5 * (np.log(height / STOREY_HEIGHT) / SPREAD) ** 2
        labels = tuple(names.get(n, "") for n in storeys)
        hypotheses.append(Storeys(labels, height * np.array(storeys, dtype=float), first, float(unusual)))
    return hypotheses


def _number(label: str, manner: str) -> int | None:
    """Storeys above the ground floor of a label in the style of ``manner``; None for any other label."""
    match, like = NUMERIC.fullmatch(label), NUMERIC.fullmatch(manner)
    if not match or not like or _lettered(match) != _lettered(like):
        return None
    number = int(match["number"])
    if match["basement"]:
        return -number
    return number - 1 if _lettered(match) and number > 0 else number


def _name(storey: int, manner: str) -> str:
    """The label of a storey in the style of another label, ``manner``."""
    like = NUMERIC.fullmatch(manner)
    if not like or not _lettered(like):
        return str(storey)
    behind = like["behind"]
    letter = like["letter"] or ("" if behind else "F")
    return f"{letter}{storey + 1}{behind}" if storey >= 0 else f"B{-storey}{behind}"


def _lettered(match: re.Match[str]) -> bool:
    return bool(match["basement"] or match["letter"] or match["behind"])


LANDINGS = 4  # states per storey
OFF, SCALE = 0.4, 0.06  # sigma of a storey's height: constant [m], and as share of the height
CHANGE, STOREY_COST = 0.5, 0.3  # cost of a change of floor, and of each storey of it: short climbs are more frequent
LANDING, LANDING_TIME, MOST_LANDING = 1.0, 60.0, 2.0  # cost of a stop between floors, its growth time [s], its maximum
OTHER_FLOOR = 1.4  # cost of a fix on another floor: one in five receives a beacon through the ceiling
ALIKE = 5  # most fixes on one floor that count, since those at one place have the same error
START = 5.0  # cost of a floor that differs from the stated start; four fixes that agree outweigh it
UNSEEN = 10.0  # [m] sigma of the height of a climb without barometer


@dataclass(frozen=True)
class Floors:
    """Floors of a walk, a row per row of the trajectory ``(n + 2,)``.

    labels: of the floors, "" for one without label; level: index in ``storeys``, which are the plan's floors, scaled to
    fit the walk, if there is a plan; height: above the start by climbs of the barometer [m]; sigma: of that [m];
    climbs, kinds: all climbs and their kinds.
    """

    labels: tuple[str, ...]
    level: Index
    height: Array
    sigma: Array
    storeys: Storeys
    climbs: Climbs
    kinds: tuple[str, ...]


def floors_of(
    steps: Steps, barometer: Signal | None, start: str, fixes: Fixes, building: FloorHeights | None
) -> tuple[str, ...]:
    """The floor's label on each row of the trajectory: the start, every step's end, the end. "" where unknown.

    steps: of the walk; barometer: pressure, or None; start: label of the floor where the walk began, "" if unknown;
    fixes: those with a floor label are used; building: with labels and heights, None without a plan.
    """
    return floors_along(steps, barometer, start, fixes, building).labels


def floors_along(
    steps: Steps, barometer: Signal | None, start: str, fixes: Fixes, building: FloorHeights | None
) -> Floors:
    """The floors of a walk, with climbs and storeys; arguments as of `floors_of`."""
    # Climbs and their kinds
    detected = _where_fixes_change(fixes) if barometer is None else climbs(barometer)
    kind = climb_kinds(steps, detected) if barometer is not None else ("",) * len(detected)
    none = {DRAUGHT} if building is not None else {DRAUGHT, RAMP}  # without a plan a ramp is a hill
    used = detected[np.array([k not in none for k in kind], dtype=bool)]

    # The storey between climbs
    if building is not None:
        likely = of_building(building, start)
    else:
        likely = unknown(start, fixes.floor, float(np.abs(np.cumsum(used.height)).max(initial=0.0)))
    alike = [list(group) for _, group in groupby(likely, key=lambda s: s.labels)]
    storeys, way, _ = min(
        (_most_probable(group, used, fixes, steps) for group in alike), key=lambda solution: solution[2]
    )

    # The storey of every row
    rows = row_times(steps)
    rising = np.diff(way)
    level = _nearest(storeys.heights, way[0] + rising @ climbed_share(barometer, used, rows))
    determined = storeys.begin is not None or len(_stated_floors(storeys, fixes)[0]) or len(storeys.labels) == 1
    labels = tuple(storeys.labels[n] if determined else "" for n in level)
    real = detected[np.array([k != DRAUGHT for k in kind], dtype=bool)]
    share = climbed_share(barometer, real, rows)
    sigma = np.sqrt(real.sigma**2 @ share**2)
    return Floors(labels, level, real.height @ share, sigma, storeys, detected, kind)


def _most_probable(alike: list[Storeys], used: Climbs, fixes: Fixes, steps: Steps) -> tuple[Storeys, Array, float]:
    """The most probable of storeys that differ only in their heights, its path, and its cost.

    Path: heights ``(c + 1,)`` [m] of floors or landings before, between and after the climbs.
    """
    hypothesis = alike[0]
    place = np.stack([_floors_and_landings(s.heights) for s in alike])
    nearest = np.stack([_nearest(s.heights, at) for s, at in zip(alike, place, strict=True)])
    floor = np.take_along_axis(np.stack([s.heights for s in alike]), nearest, axis=1)
    landing = np.abs(place - floor) > 1e-9
    begin = np.append(steps.start, used.end)
    end = np.append(used.start, steps.end)
    stated, time = _stated_floors(hypothesis, fixes)
    costs = [
        _of_fixes(stated, time, len(hypothesis.labels), a, b)[nearest]
        + landing * min(LANDING + max(b - a, 0.0) / LANDING_TIME, MOST_LANDING)
        for a, b in zip(begin, end, strict=True)
    ]
    if hypothesis.begin is not None:
        costs[0] = costs[0] + START * (nearest != hypothesis.begin)
    costs[0] = costs[0] + MOST_LANDING * landing  # walks begin on floors
    moved, passed = place[:, None] - place[:, :, None], np.abs(nearest[:, None] - nearest[:, :, None])
    further = CHANGE * (passed > 0) + STOREY_COST * passed
    moves = [_of_climb(moved, h, s) + further for h, s in zip(used.height, used.sigma, strict=True)]
    states, cost = viterbi(costs, moves)
    total = cost + [s.cost for s in alike]
    best = int(np.argmin(total))
    return alike[best], place[best, states[best]], float(total[best])


def _of_climb(moved: Array, height: float, sigma: float) -> Array:
    """Cost of a height change ``moved`` [m] for a climb of ``height`` with ``sigma`` [m]."""
    variance = OFF**2 + sigma**2 + (SCALE * moved) ** 2
    return 0.5 * ((height - moved) ** 2 / variance + np.log(variance))


def _of_fixes(stated: Index, time: Array, count: int, begin: float, end: float) -> Array:
    """Cost ``(f,)`` of each of ``count`` storeys by the floors that fixes state from ``begin`` to ``end`` [s]."""
    fixes = np.bincount(stated[(time >= begin) & (time <= end)], minlength=count)
    total = int(fixes.sum())
    return OTHER_FLOOR * min(total, ALIKE) * (1 - fixes / max(total, 1))


def _stated_floors(storeys: Storeys, fixes: Fixes) -> tuple[Index, Array]:
    """Storey index and time [s] of each fix that states a storey."""
    index = {label: n for n, label in enumerate(storeys.labels) if label}
    which = np.array([index.get(label, -1) for label in fixes.floor], dtype=int)
    return which[which >= 0], fixes.time[which >= 0]


def _where_fixes_change(fixes: Fixes) -> Climbs:
    """Possible climbs without a barometer: between consecutive fixes on different floors."""
    labelled = np.flatnonzero([bool(label) for label in fixes.floor])
    labelled = labelled[np.argsort(fixes.time[labelled], kind="stable")]
    label = np.array(fixes.floor, dtype=object)[labelled]
    other = label[:-1] != label[1:]
    start, end = fixes.time[labelled[:-1][other]], fixes.time[labelled[1:][other]]
    return Climbs(start, end, np.zeros(len(start)), np.full(len(start), UNSEEN))


def _floors_and_landings(heights: Array) -> Array:
    """Heights ``(4 (f - 1) + 1,)`` [m] of all floors and of the landings between."""
    last = len(heights) - 1
    return np.interp(np.arange(LANDINGS * last + 1) / LANDINGS, np.arange(last + 1), heights)


def _nearest(heights: Array, at: Array) -> Index:
    """Index of the floor nearest to each height; the lower one in a tie."""
    return np.argmin(np.abs(at[:, None] - heights), axis=1)


UPDATE_INTERVAL = 3.0  # [s] between estimates
LONGEST, SHORTEST, MOST_CLIMBS = 200.0, 60.0, 3  # window: longest [s], length after a cut [s], most climbs
TOO_LONG = 1.5  # multiple of the longest window at which it is cut even within a climb
REMEMBERED = 90.0  # [s] of labels stored from before the window
SILENT = 20.0  # [s] without barometer samples after which fixes are used alone
LOWEST, HIGHEST = 300.0, 1200.0  # [hPa] range of plausible pressures
APART = 120.0  # [s] between a sample and the steps at which its time stamp is wrong
MOST_FIXES, MOST_IN_CELL = 300, 200  # stored fixes, and samples per cell, at most


@dataclass(frozen=True)
class FloorsCheckpoint:
    """State of a `LiveFloors`; fields as its attributes."""

    start: str
    label: str
    climbing: bool
    begin: float
    end: float
    looked: float
    time: Array
    duration: Array
    pressure: Array
    open: Array
    fix_time: Array
    fix_label: tuple[str, ...]
    row_time: Array
    row_label: tuple[str, ...]
    heard: bool


class LiveFloors:
    """The floors of a walk under way. building: see `floors_of`; start: label of the first floor, or ""."""

    def __init__(self, building: FloorHeights | None = None, start: str = ""):
        self.building, self.start = building, start
        self.label = start
        self.climbing = False
        self.begin, self.end = np.nan, np.nan  # [s] start of the window, end of the certain steps
        self.looked = -np.inf  # [s] time of the last estimate
        self.time, self.duration = np.empty(0), np.empty(0)  # of the certain steps in the window [s]
        self.pressure = np.empty((0, 2))  # means over CLIMB.grid: time [s] and pressure [hPa]
        self.open = np.empty((0, 2))  # samples of the cell that is not complete
        self.fix_time, self.fix_label = np.empty(0), np.empty(0, dtype=object)
        self.row_time, self.row_label = np.empty(0), np.empty(0, dtype=object)
        self.heard = False  # True if fixes with a floor came since the last estimate

    def push(self, time: Array, values: Array) -> None:
        """Append barometer samples at times ``(n,)`` [s], values ``(n, 1)`` [hPa]."""
        rows = np.column_stack([time, values]).astype(float)
        rows = rows[np.isfinite(rows).all(axis=1) & (rows[:, 1] > LOWEST) & (rows[:, 1] < HIGHEST)]
        if np.isfinite(self.end):
            rows = rows[np.abs(rows[:, 0] - self.end) < APART]
        else:
            self.pressure = self.pressure[-round(LONGEST / CLIMB.grid) :]
        for sample in rows:
            self._sample(sample)

    def add_fixes(self, fixes: Fixes) -> None:
        """Append fixes; only those with a floor label are used."""
        labelled = np.array([bool(label) for label in fixes.floor], dtype=bool)
        if labelled.any():
            self.fix_time = np.append(self.fix_time, fixes.time[labelled])[-MOST_FIXES:]
            self.fix_label = np.append(self.fix_label, np.array(fixes.floor, dtype=object)[labelled])[-MOST_FIXES:]
            self.heard = True

    def add_steps(self, steps: Steps) -> None:
        """Append the next certain steps."""
        if np.isnan(self.end):
            self.begin = steps.start
        self.time, self.duration = np.append(self.time, steps.time), np.append(self.duration, steps.duration)
        self.end = steps.end

    def advance(self, tail: Steps | None = None) -> None:
        """Estimate the floors again after UPDATE_INTERVAL. tail: provisional steps."""
        now = self.end if tail is None else tail.end
        if not (now > self.begin and abs(now - self.looked) >= UPDATE_INTERVAL):
            return
        measured = self._is_measured(now)
        named = self.building is None or bool(self.start) or len(self.fix_label) > 0
        if named and (measured or self.heard) and now > self.begin:
            self._estimate(now, tail, measured)
        elif now - self.begin > LONGEST:
            self._cut(now - SHORTEST)
        self.looked = now

    def labels(self, time: Array) -> tuple[str, ...]:
        """Labels of the present estimate at times ``(n,)`` [s] within REMEMBERED of the window; "" where unknown."""
        if not len(self.row_time):
            return (self.label,) * len(time)
        row = np.minimum(np.searchsorted(self.row_time, np.asarray(time) - 1e-6), len(self.row_time) - 1)
        return tuple(self.row_label[row].tolist())

    def checkpoint(self) -> FloorsCheckpoint:
        """Return the state, from which estimates continue the same."""
        state = storage.checkpoint(self, FloorsCheckpoint)
        return replace(state, fix_label=tuple(self.fix_label), row_label=tuple(self.row_label))

    def restore(self, checkpoint: FloorsCheckpoint) -> None:
        """Set the state to a checkpoint with the same building."""
        storage.restore(self, checkpoint)
        self.fix_label = np.array(checkpoint.fix_label, dtype=object)
        self.row_label = np.array(checkpoint.row_label, dtype=object)

    def _is_measured(self, now: float) -> bool:
        """True if the barometer covers the window; cuts the window where the barometer stops or starts."""
        if not len(self.pressure):
            return False
        if now - self.pressure[-1, 0] > SILENT:
            self._cut(self.end)
            self.pressure, self.open, self.climbing = self.pressure[:0], self.open[:0], False
            return False
        first = float(self.pressure[0, 0])
        if self.begin + SILENT < first <= self.end:
            self._cut(first)
        return first <= self.begin + SILENT

    def _sample(self, sample: Array) -> None:
        """Append one sample; complete cells become means."""
        last = self.open[-1, 0] if len(self.open) else self.pressure[-1, 0] if len(self.pressure) else -np.inf
        if sample[0] <= last:
            return  # repeated sample, or clock reset
        if len(self.open) and sample[0] // CLIMB.grid > self.open[0, 0] // CLIMB.grid:
            self.pressure = np.concatenate([self.pressure, self.open.mean(axis=0)[None]])
            self.pressure = self.pressure[-round(TOO_LONG * LONGEST / CLIMB.grid) :]
            self.open = self.open[:0]
        if len(self.open) < MOST_IN_CELL:
            self.open = np.concatenate([self.open, sample[None]])

    def _estimate(self, now: float, tail: Steps | None, measured: bool) -> None:
        """Estimate the floors of the window, and cut it if it is too long."""
        fixes = Fixes(
            self.fix_time, np.zeros((len(self.fix_time), 2)), np.ones(len(self.fix_time)), tuple(self.fix_label)
        )
        barometer = Signal(self.pressure[:, 0], self.pressure[:, 1:]) if measured else None
        steps = self._steps(tail)
        floors = floors_along(steps, barometer, self.start, fixes, self.building)
        self._remember(steps, floors, now)
        last = floors.climbs.end[-1:]
        self.climbing = measured and bool(np.any(last > self.pressure[-1, 0] - CLIMB.gust))
        self.heard = False
        if now - self.begin > LONGEST or len(floors.climbs) > MOST_CLIMBS:
            level = _level_before(now - SHORTEST, floors.climbs)
            if level > self.begin + CLIMB.level:
                self._cut(level)
            elif now - self.begin > TOO_LONG * LONGEST:
                self._cut(now - SHORTEST)

    def _steps(self, tail: Steps | None) -> Steps:
        """The steps of the window with those of ``tail``: times and durations."""
        time, duration, end = self.time, self.duration, self.end
        if tail is not None and tail.end > end and (not len(tail) or tail.time[0] - tail.duration[0] >= end - 1e-6):
            time, duration, end = np.append(time, tail.time), np.append(duration, tail.duration), tail.end
        nothing, some = np.zeros(len(time)), np.ones(len(time))
        return Steps(self.begin, end, time, duration, some, nothing, nothing, some, some)

    def _remember(self, steps: Steps, floors: Floors, now: float) -> None:
        """Store the labels of the window's rows."""
        before = (self.row_time < self.begin) & (self.row_time > now - REMEMBERED)
        self.row_time = np.concatenate([self.row_time[before], steps.time, [steps.end]])
        self.row_label = np.append(self.row_label[before], np.array(floors.labels[1:], dtype=object))
        self.label = floors.labels[-1]

    def _cut(self, time: float) -> None:
        """Let the window start at ``time`` [s], or at the end of the certain steps if that is earlier."""
        time = min(time, self.end)
        (self.start,) = self.labels(np.array([time]))
        self.begin = time
        later = self.time - self.duration >= time
        self.time, self.duration = self.time[later], self.duration[later]
        self.pressure = self.pressure[self.pressure[:, 0] >= time]
        order = np.argsort(self.fix_time, kind="stable")
        self.fix_time, self.fix_label = self.fix_time[order], self.fix_label[order]
        first = int(np.searchsorted(self.fix_time, time))
        if first and self.fix_label[first - 1] == self.start:  # a climb leads from it to the next, on another floor
            first -= 1
            self.fix_time[first] = time
        self.fix_time, self.fix_label = self.fix_time[first:], self.fix_label[first:]


def _level_before(time: float, climbs: Climbs) -> float:
    """The last time [s] before ``time`` that is at least CLIMB.level away from any climb."""
    for start, end in zip(climbs.start[::-1].tolist(), climbs.end[::-1].tolist(), strict=True):
        if start - CLIMB.level < time < end + CLIMB.level:
            time = start - CLIMB.level
    return time
