"""The floor of each step: the most probable path through the storeys by barometer and fixes; batch and live.

A hidden Markov model whose states are the floors and the landings between them, at quarters of a storey. They change
at climbs alone, by about the climb's height; while nobody climbs nothing changes, whatever the weather does. A landing
is a state so that a stop half-way up the stairs is neither a floor nor forgotten: the next climb goes on from there.
Without a plan the height of a storey is unknown and about the same for all, with one the scale of its heights is: the
likeliest of several is taken.

The floor is the nearest one in height: on stairs it changes half-way, and who passes a floor is on it for a moment.
Live, the same runs over the last minutes again every few seconds; earlier floors are the label on which those minutes
begin, at a moment when nobody climbed.
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

STOREY_HEIGHT, SPREAD = 3.5, 0.2  # [m] and of its logarithm: flats 2.7, offices 3.3–4.2, shops 5
SCALES, SCALE_SPREAD = np.linspace(0.82, 1.18, 19), 0.08  # of a plan's heights: nominal ones, air of another warmth
TRIED: Array = STOREY_HEIGHT * np.exp(SPREAD * np.linspace(-2.5, 2.5, 26))  # [m]
# "-2", "0"; "F1", "L2", "1F" and below them "B1", "B2F", with no floor 0 between
NUMERIC = re.compile(r"(?P<basement>B?)(?P<letter>[FL]?)(?P<number>-?\d+)(?P<behind>F?)", re.IGNORECASE)


class FloorHeights(Protocol):
    """What is needed to know of a building: its floors' labels, and their heights ``(f,)`` [m], rising."""

    @property
    def labels(self) -> tuple[str, ...]:
        """From the lowest up."""
        ...

    @property
    def heights(self) -> Array:
        """Of the floors."""
        ...


@dataclass(frozen=True)
class Storeys:
    """Floors from the lowest up: labels, "" where it has no name; heights ``(f,)`` [m].

    begin: index of the floor on which the walk began, None where its label does not tell; cost: how unusual they are.
    """

    labels: tuple[str, ...]
    heights: Array
    begin: int | None
    cost: float = 0.0


def of_building(building: FloorHeights, start: str) -> list[Storeys]:
    """The floors of a plan, their heights scaled in several ways: a plan or a barometer errs on all floors alike."""
    labels, heights = building.labels, np.asarray(building.heights, dtype=float)
    begin = labels.index(start) if start in labels else None
    return [Storeys(labels, s * heights, begin, float(0.5 * ((s - 1) / SCALE_SPREAD) ** 2)) for s in SCALES]


def unknown(start: str, seen: tuple[str, ...], reach: float) -> list[Storeys]:
    """Storeys of likely heights, named in the manner of the start's label or, without one, of the first one seen.

    seen: labels that fixes gave; reach: how far up or down [m] climbs led. Of labels without a number one is known,
    of the storey on which the walk began.
    """
    named = [label for label in (start, *seen) if label] or [""]
    numbers = {label: n for label in reversed(named) if (n := _number(label, named[0])) is not None}
    begin = numbers.get(start) if numbers else 0
    known = numbers.values() or [0]
    found = []
    for height in TRIED:
        margin = int(np.ceil(reach / height)) + 1
        storeys = range(min(known) - margin, max(known) + margin + 1)
        names = {n: _name(n, named[0]) for n in storeys} if numbers else {0: named[0]}
        names |= {n: label for label, n in numbers.items()}
        first = None if begin is None else begin - storeys[0]
        unusual = 0.5 * (np.log(height / STOREY_HEIGHT) / SPREAD) ** 2
        labels = tuple(names.get(n, "") for n in storeys)
        found.append(Storeys(labels, height * np.array(storeys, dtype=float), first, float(unusual)))
    return found


def _number(label: str, manner: str) -> int | None:
    """How many storeys above the floor_sequence, of a label like ``manner``; None for any other."""
    match, like = NUMERIC.fullmatch(label), NUMERIC.fullmatch(manner)
    if not match or not like or _lettered(match) != _lettered(like):
        return None
    number = int(match["number"])
    if match["basement"]:
        return -number
    return number - 1 if _lettered(match) and number > 0 else number


def _name(storey: int, manner: str) -> str:
    """The label of a storey in the manner of another's."""
    like = NUMERIC.fullmatch(manner)
    if not like or not _lettered(like):
        return str(storey)
    behind = like["behind"]
    letter = like["letter"] or ("" if behind else "F")
    return f"{letter}{storey + 1}{behind}" if storey >= 0 else f"B{-storey}{behind}"


def _lettered(match: re.Match[str]) -> bool:
    return bool(match["basement"] or match["letter"] or match["behind"])


LANDINGS = 4  # to a storey
OFF, SCALE = 0.4, 0.06  # [m] and of the height, by which storeys differ from what was assumed, each on its own
CHANGE, STOREY_COST = 0.5, 0.3  # cost of another floor, and of each storey on the way: short climbs are more usual
LANDING, LANDING_TIME, MOST_LANDING = 1.0, 60.0, 2.0  # cost of a stop between floors; it grows with time [s]
OTHER_FLOOR = 1.4  # cost of a fix on another floor: one in five hears a beacon through the ceiling
ALIKE = 5  # fixes on one floor that count: those of one place err together
START = 5.0  # cost of another floor than the stated start; four fixes that agree outweigh it
UNSEEN = 10.0  # [m]: how far a climb went that no barometer saw


@dataclass(frozen=True)
class Floors:
    """Where the walk was in height, a row per row of the trajectory ``(n + 2,)``.

    labels: the floor's, "" where it has none; level: which of ``storeys``, the building's floors if there is a plan,
    whose heights have the scale that fits the walk;
    height: above the start by the barometer's climbs alone [m]; sigma: of that [m]; climbs and what kinds they were.
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

    steps: of the walk; barometer: what tells climbs, None without; start: label of the floor where the walk began, ""
    if unknown; fixes: those with a floor tell too; building: whose labels and heights these are, None without a plan.
    """
    return floors_along(steps, barometer, start, fixes, building).labels


def floors_along(
    steps: Steps, barometer: Signal | None, start: str, fixes: Fixes, building: FloorHeights | None
) -> Floors:
    """The floors of a walk, and how they were found."""
    # When the walker went up or down, and on what
    seen = _where_fixes_change(fixes) if barometer is None else climbs(barometer)
    kind = climb_kinds(steps, seen) if barometer is not None else ("",) * len(seen)
    none = {DRAUGHT} if building is not None else {DRAUGHT, RAMP}  # without a plan a ramp is a hill
    used = seen[np.array([k not in none for k in kind], dtype=bool)]

    # Which storey the walker was on between climbs
    if building is not None:
        likely = of_building(building, start)
    else:
        likely = unknown(start, fixes.floor, float(np.abs(np.cumsum(used.height)).max(initial=0.0)))
    alike = [list(group) for _, group in groupby(likely, key=lambda s: s.labels)]
    storeys, way, _ = min((_most_probable(group, used, fixes, steps) for group in alike), key=lambda found: found[2])

    # Which on every row
    rows = row_times(steps)
    rising = np.diff(way)
    level = _nearest(storeys.heights, way[0] + rising @ climbed_share(barometer, used, rows))
    told = storeys.begin is not None or len(_stated_floors(storeys, fixes)[0]) or len(storeys.labels) == 1
    labels = tuple(storeys.labels[n] if told else "" for n in level)
    real = seen[np.array([k != DRAUGHT for k in kind], dtype=bool)]
    share = climbed_share(barometer, real, rows)
    sigma = np.sqrt(real.sigma**2 @ share**2)
    return Floors(labels, level, real.height @ share, sigma, storeys, seen, kind)


def _most_probable(alike: list[Storeys], used: Climbs, fixes: Fixes, steps: Steps) -> tuple[Storeys, Array, float]:
    """The likeliest of storeys that differ in their heights alone, and where the walk was then, and what it costs.

    Where: heights ``(c + 1,)`` [m] of floors or landings before, between and after the climbs.
    """
    one = alike[0]
    place = np.stack([_floors_and_landings(s.heights) for s in alike])
    nearest = np.stack([_nearest(s.heights, at) for s, at in zip(alike, place, strict=True)])
    floor = np.take_along_axis(np.stack([s.heights for s in alike]), nearest, axis=1)
    landing = np.abs(place - floor) > 1e-9
    begin = np.append(steps.start, used.end)
    end = np.append(used.start, steps.end)
    stated, time = _stated_floors(one, fixes)
    costs = [
        _of_fixes(stated, time, len(one.labels), a, b)[nearest]
        + landing * min(LANDING + max(b - a, 0.0) / LANDING_TIME, MOST_LANDING)
        for a, b in zip(begin, end, strict=True)
    ]
    if one.begin is not None:
        costs[0] = costs[0] + START * (nearest != one.begin)
    costs[0] = costs[0] + MOST_LANDING * landing  # walks begin on floors
    moved, passed = place[:, None] - place[:, :, None], np.abs(nearest[:, None] - nearest[:, :, None])
    further = CHANGE * (passed > 0) + STOREY_COST * passed
    moves = [_of_climb(moved, h, s) + further for h, s in zip(used.height, used.sigma, strict=True)]
    states, cost = viterbi(costs, moves)
    total = cost + [s.cost for s in alike]
    best = int(np.argmin(total))
    return alike[best], place[best, states[best]], float(total[best])


def _of_climb(moved: Array, height: float, sigma: float) -> Array:
    """Cost of having moved up so far [m] by a climb of so much."""
    variance = OFF**2 + sigma**2 + (SCALE * moved) ** 2
    return 0.5 * ((height - moved) ** 2 / variance + np.log(variance))


def _of_fixes(stated: Index, time: Array, count: int, begin: float, end: float) -> Array:
    """Cost ``(f,)`` of each of ``count`` storeys by the floors that fixes at ``time`` state, from begin to end [s]."""
    heard = np.bincount(stated[(time >= begin) & (time <= end)], minlength=count)
    total = int(heard.sum())
    return OTHER_FLOOR * min(total, ALIKE) * (1 - heard / max(total, 1))


def _stated_floors(storeys: Storeys, fixes: Fixes) -> tuple[Index, Array]:
    """Which storey each fix that knows one says, and when [s]."""
    index = {label: n for n, label in enumerate(storeys.labels) if label}
    which = np.array([index.get(label, -1) for label in fixes.floor], dtype=int)
    return which[which >= 0], fixes.time[which >= 0]


def _where_fixes_change(fixes: Fixes) -> Climbs:
    """Where a walker may have gone up or down without a barometer: between fixes of different floors."""
    known = np.flatnonzero([bool(label) for label in fixes.floor])
    known = known[np.argsort(fixes.time[known], kind="stable")]
    label = np.array(fixes.floor, dtype=object)[known]
    other = label[:-1] != label[1:]
    start, end = fixes.time[known[:-1][other]], fixes.time[known[1:][other]]
    return Climbs(start, end, np.zeros(len(start)), np.full(len(start), UNSEEN))


def _floors_and_landings(heights: Array) -> Array:
    """Heights ``(4 (f - 1) + 1,)`` [m] of all floors and of quarters between."""
    last = len(heights) - 1
    return np.interp(np.arange(LANDINGS * last + 1) / LANDINGS, np.arange(last + 1), heights)


def _nearest(heights: Array, at: Array) -> Index:
    """The floor nearest to each height; the lower of two that are as near."""
    return np.argmin(np.abs(at[:, None] - heights), axis=1)


EVERY = 3.0  # [s] until the floors are looked at again
LONGEST, SHORTEST, MOST_CLIMBS = 200.0, 60.0, 3  # [s] of what is looked at, before and after it is cut; climbs in it
TOO_LONG = 1.5  # times the longest, when it is cut in a climb too
REMEMBERED = 90.0  # [s] of labels before it
SILENT = 20.0  # [s] without a barometer, after which fixes tell alone
LOWEST, HIGHEST = 300.0, 1200.0  # [hPa] that a phone measures
APART = 120.0  # [s] between a sample and the steps: a wrong time stamp
MOST_FIXES, MOST_IN_CELL = 300, 200  # a flood of either tells no more


@dataclass(frozen=True)
class FloorsCheckpoint:
    """What a `LiveFloors` knows."""

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
    """The floor by all that has come in. building: as of `floors_along`; start: label of the first floor, or ""."""

    def __init__(self, building: FloorHeights | None = None, start: str = ""):
        self.building, self.start = building, start
        self.label = start
        self.climbing = False
        self.begin, self.end = np.nan, np.nan  # of what is looked at, and of the certain steps [s]
        self.looked = -np.inf  # [s] when
        self.time, self.duration = np.empty(0), np.empty(0)  # of the certain steps
        self.pressure = np.empty((0, 2))  # means over CLIMB.grid: time [s] and pressure [hPa]
        self.open = np.empty((0, 2))  # samples of the cell that is not full
        self.fix_time, self.fix_label = np.empty(0), np.empty(0, dtype=object)
        self.row_time, self.row_label = np.empty(0), np.empty(0, dtype=object)
        self.heard = False  # something that is not looked at

    def push(self, time: Array, values: Array) -> None:
        """Samples of the barometer at times ``(n,)`` [s], ``(n, 1)`` [hPa]."""
        rows = np.column_stack([time, values]).astype(float)
        rows = rows[np.isfinite(rows).all(axis=1) & (rows[:, 1] > LOWEST) & (rows[:, 1] < HIGHEST)]
        if np.isfinite(self.end):
            rows = rows[np.abs(rows[:, 0] - self.end) < APART]
        for one in rows:
            self._sample(one)

    def see(self, fixes: Fixes) -> None:
        """Fixes, of which those with a floor tell."""
        told = np.array([bool(label) for label in fixes.floor], dtype=bool)
        if told.any():
            self.fix_time = np.append(self.fix_time, fixes.time[told])[-MOST_FIXES:]
            self.fix_label = np.append(self.fix_label, np.array(fixes.floor, dtype=object)[told])[-MOST_FIXES:]
            self.heard = True

    def walked(self, steps: Steps) -> None:
        """The next steps that are certain."""
        if np.isnan(self.end):
            self.begin = steps.start
        self.time, self.duration = np.append(self.time, steps.time), np.append(self.duration, steps.duration)
        self.end = steps.end

    def advance(self, tail: Steps | None = None) -> None:
        """Look at the floors again, if it is time. tail: steps after the certain ones, as far as can be said by now."""
        now = self.end if tail is None else tail.end
        if not (now > self.begin and abs(now - self.looked) >= EVERY):
            return
        measured = self._is_measured(now)
        if (measured or self.heard) and now > self.begin:
            self._look(now, tail, measured)
        elif now - self.begin > LONGEST:
            self._cut(now - SHORTEST)
        self.looked = now

    def labels(self, time: Array) -> tuple[str, ...]:
        """The floors at times ``(n,)`` [s] of the last minute or more, as they are known by now; "" where unknown."""
        if not len(self.row_time):
            return (self.label,) * len(time)
        row = np.minimum(np.searchsorted(self.row_time, np.asarray(time) - 1e-6), len(self.row_time) - 1)
        return tuple(self.row_label[row].tolist())

    def checkpoint(self) -> FloorsCheckpoint:
        """All that it knows; what follows a `restore` is the same."""
        known = storage.checkpoint(self, FloorsCheckpoint)
        return replace(known, fix_label=tuple(self.fix_label), row_label=tuple(self.row_label))

    def restore(self, checkpoint: FloorsCheckpoint) -> None:
        """Go on from a checkpoint, of the same building."""
        storage.restore(self, checkpoint)
        self.fix_label = np.array(checkpoint.fix_label, dtype=object)
        self.row_label = np.array(checkpoint.row_label, dtype=object)

    def _is_measured(self, now: float) -> bool:
        """Whether the barometer tells of all that is looked at; where it stops or sets in, fixes have told before."""
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

    def _sample(self, one: Array) -> None:
        last = self.open[-1, 0] if len(self.open) else self.pressure[-1, 0] if len(self.pressure) else -np.inf
        if one[0] <= last:
            return  # repeated sample, or clock reset
        if len(self.open) and one[0] // CLIMB.grid > self.open[0, 0] // CLIMB.grid:
            self.pressure = np.concatenate([self.pressure, self.open.mean(axis=0)[None]])
            self.pressure = self.pressure[-round(TOO_LONG * LONGEST / CLIMB.grid) :]
            self.open = self.open[:0]
        if len(self.open) < MOST_IN_CELL:
            self.open = np.concatenate([self.open, one[None]])

    def _look(self, now: float, tail: Steps | None, measured: bool) -> None:
        fixes = Fixes(
            self.fix_time, np.zeros((len(self.fix_time), 2)), np.ones(len(self.fix_time)), tuple(self.fix_label)
        )
        barometer = Signal(self.pressure[:, 0], self.pressure[:, 1:]) if measured else None
        steps = self._steps(tail)
        found = floors_along(steps, barometer, self.start, fixes, self.building)
        self._remember(steps, found, now)
        last = found.climbs.end[-1:]
        self.climbing = measured and bool(np.any(last > self.pressure[-1, 0] - CLIMB.gust))
        self.heard = False
        if now - self.begin > LONGEST or len(found.climbs) > MOST_CLIMBS:
            level = _level_before(now - SHORTEST, found.climbs)
            if level > self.begin + CLIMB.level:
                self._cut(level)
            elif now - self.begin > TOO_LONG * LONGEST:
                self._cut(now - SHORTEST)

    def _steps(self, tail: Steps | None) -> Steps:
        """Those that are looked at: when, and how long they took."""
        time, duration, end = self.time, self.duration, self.end
        if tail is not None and tail.end > end and (not len(tail) or tail.time[0] - tail.duration[0] >= end - 1e-6):
            time, duration, end = np.append(time, tail.time), np.append(duration, tail.duration), tail.end
        nothing, some = np.zeros(len(time)), np.ones(len(time))
        return Steps(self.begin, end, time, duration, some, nothing, nothing, some, some)

    def _remember(self, steps: Steps, found: Floors, now: float) -> None:
        before = (self.row_time < self.begin) & (self.row_time > now - REMEMBERED)
        self.row_time = np.concatenate([self.row_time[before], steps.time, [steps.end]])
        self.row_label = np.append(self.row_label[before], np.array(found.labels[1:], dtype=object))
        self.label = found.labels[-1]

    def _cut(self, time: float) -> None:
        """Look no further back than a time [s], that of certain steps, any more."""
        time = min(time, self.end)
        (self.start,) = self.labels(np.array([time]))
        self.begin = time
        later = self.time - self.duration >= time
        self.time, self.duration = self.time[later], self.duration[later]
        self.pressure = self.pressure[self.pressure[:, 0] >= time]
        order = np.argsort(self.fix_time, kind="stable")
        self.fix_time, self.fix_label = self.fix_time[order], self.fix_label[order]
        first = int(np.searchsorted(self.fix_time, time))
        if first and self.fix_label[first - 1] == self.start:  # from it to the next, another floor's, is a climb
            first -= 1
            self.fix_time[first] = time
        self.fix_time, self.fix_label = self.fix_time[first:], self.fix_label[first:]


def _level_before(time: float, climbs: Climbs) -> float:
    """The last moment before a time at which nobody had climbed for a while, nor would. [s]"""
    for start, end in zip(climbs.start[::-1].tolist(), climbs.end[::-1].tolist(), strict=True):
        if start - CLIMB.level < time < end + CLIMB.level:
            time = start - CLIMB.level
    return time
