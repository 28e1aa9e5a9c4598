"""The floor of each step by barometer and fixes: the most probable sequence of storeys.

A hidden Markov model whose states are the floors and the landings between them, at quarters of a storey. The state
changes only at climbs, by about the climb's height, so slow changes of the weather have no effect. Landings are states
so that the next climb continues from a stop half-way up the stairs. Unknown is the height of the storeys (without a
plan, about the same for all) or the scale of the plan's heights; the most probable of several values is used.

The floor is the nearest in height: on stairs it changes half-way, and a passed floor is the present floor briefly.

`LiveFloors` runs the same model over the last minutes of a walk under way, every few seconds; these minutes start at a
time without climbs, on the floor estimated for it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np

from pdr_graph.geometry import row_times, viterbi
from pdr_graph.inertial.barometer import CELL, DRAUGHT, RAMP, Climbs, climb_kinds, climbed_share, climbs, goings_of
from pdr_graph.priors import CLIMB, LIVE_FLOORS, STOREYS
from pdr_graph.types import Array, Fixes, Index, Signal, Steps

if TYPE_CHECKING:
    from pdr_graph.floor.building import Building

SCALES = np.linspace(0.82, 1.18, 19)  # candidates of the scale of a plan's heights
# "-2", "0"; "F1", "L2", "1F" and below them "B1", "B2F", with no floor 0 between
NUMERIC = re.compile(r"(?P<basement>B?)(?P<letter>[FL]?)(?P<number>-?\d+)(?P<behind>F?)", re.IGNORECASE)


@dataclass(frozen=True)
class Storeys:
    """A hypothesis of the floors from the lowest up: labels, "" for a floor without name; heights ``(f,)`` [m].

    begin: index of the floor on which the walk began, None if unknown; cost: negative log prior of the heights.
    """

    labels: tuple[str, ...]
    heights: Array
    begin: int | None
    cost: float = 0.0


def unknown(start: str, reported: tuple[str, ...], reach: float) -> list[Storeys]:
    """Storeys of several heights, numbered in the style of the start's label or else of the first reported floor.

    reported: floor labels of fixes; reach: largest height difference [m] by climbs. If labels have no number, only the
    storey of the start has a label.
    """
    named = [label for label in (start, *reported) if label] or [""]
    numbers = {label: n for label in reversed(named) if (n := _number(label, named[0])) is not None}
    begin = numbers.get(start) if numbers else 0
    numbered = numbers.values() or [0]
    hypotheses = []
    for height in STOREYS.height * np.exp(STOREYS.spread * np.linspace(-2.5, 2.5, 26)):
        margin = int(np.ceil(reach / height)) + 1
        storeys = range(min(numbered) - margin, max(numbered) + margin + 1)
        names = {n: _name(n, named[0]) for n in storeys} if numbers else {0: named[0]}
        names |= {n: label for label, n in numbers.items()}
        first = None if begin is None else begin - storeys[0]
        unusual = 0.5 * (np.log(height / STOREYS.height) / STOREYS.spread) ** 2
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


@dataclass(frozen=True)
class Floors:
    """Floors of a walk, a row per row of the trajectory ``(n + 2,)``.

    labels: of the floors, "" without label; height: above the start by climbs of the barometer [m]; sigma: of
    that [m]; climbs, kinds: all climbs and their kinds.
    """

    labels: tuple[str, ...]
    height: Array
    sigma: Array
    climbs: Climbs
    kinds: tuple[str, ...]


def floors_of(
    steps: Steps, barometer: Signal | None, start: str, fixes: Fixes, building: Building | None
) -> tuple[str, ...]:
    """The floor's label on each row of the trajectory: the start, every step's end, the end. "" where unknown.

    steps: of the walk; barometer: pressure, or None; start: label of the floor where the walk began, "" if unknown;
    fixes: those with a floor label are used; building: with labels and heights, None without a plan.
    """
    return floors_along(steps, barometer, start, fixes, building).labels


def floors_along(steps: Steps, barometer: Signal | None, start: str, fixes: Fixes, building: Building | None) -> Floors:
    """The floors of a walk, with climbs and storeys; arguments as of `floors_of`."""
    # Climbs and their kinds
    detected = _where_fixes_change(fixes) if barometer is None else climbs(barometer)
    kind = climb_kinds(steps, detected) if barometer is not None else ("",) * len(detected)
    none = {DRAUGHT} if building is not None else {DRAUGHT, RAMP}  # without a plan a ramp is a hill
    used = detected[np.array([k not in none for k in kind], dtype=bool)]

    # The storey between climbs
    if building is not None:
        # Several scales of the plan's heights, since plan and barometer have scale errors
        labels, heights = building.labels, np.asarray(building.heights, dtype=float)
        begin, costs = labels.index(start) if start in labels else None, ((SCALES - 1) / STOREYS.scale_spread) ** 2 / 2
        likely = [Storeys(labels, s * heights, begin, float(cost)) for s, cost in zip(SCALES, costs, strict=True)]
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
    return Floors(labels, real.height @ share, sigma, detected, kind)


def _most_probable(alike: list[Storeys], used: Climbs, fixes: Fixes, steps: Steps) -> tuple[Storeys, Array, float]:
    """The most probable of storeys that differ only in their heights, its path, and its cost.

    Path: heights ``(c + 1,)`` [m] of floors or landings before, between and after the climbs.
    """
    hypothesis = alike[0]
    last = len(hypothesis.labels) - 1
    landings = np.arange(LANDINGS * last + 1) / LANDINGS  # and floors
    place = np.stack([np.interp(landings, np.arange(last + 1), s.heights) for s in alike])
    nearest = np.stack([_nearest(s.heights, at) for s, at in zip(alike, place, strict=True)])
    floor = np.take_along_axis(np.stack([s.heights for s in alike]), nearest, axis=1)
    landing = np.abs(place - floor) > 1e-9
    begin = np.append(steps.start, used.end)
    end = np.append(used.start, steps.end)
    stated, time = _stated_floors(hypothesis, fixes)
    costs = [
        _of_fixes(stated, time, len(hypothesis.labels), a, b)[nearest]
        + landing * min(STOREYS.landing + max(b - a, 0.0) / STOREYS.landing_time, STOREYS.most_landing)
        for a, b in zip(begin, end, strict=True)
    ]
    if hypothesis.begin is not None:
        costs[0] = costs[0] + STOREYS.start * (nearest != hypothesis.begin)
    costs[0] = costs[0] + STOREYS.most_landing * landing  # walks begin on floors
    moved, passed = place[:, None] - place[:, :, None], np.abs(nearest[:, None] - nearest[:, :, None])
    further = STOREYS.change * (passed > 0) + STOREYS.further * passed
    moves = []
    for height, sigma in zip(used.height, used.sigma, strict=True):
        variance = STOREYS.off**2 + sigma**2 + (STOREYS.off_share * moved) ** 2
        moves.append(0.5 * ((height - moved) ** 2 / variance + np.log(variance)) + further)
    states, cost = viterbi(costs, moves)
    total = cost + [s.cost for s in alike]
    best = int(np.argmin(total))
    return alike[best], place[best, states[best]], float(total[best])


def _of_fixes(stated: Index, time: Array, count: int, begin: float, end: float) -> Array:
    """Cost ``(f,)`` of each of ``count`` storeys by the floors that fixes state from ``begin`` to ``end`` [s]."""
    fixes = np.bincount(stated[(time >= begin) & (time <= end)], minlength=count)
    total = int(fixes.sum())
    return STOREYS.other_floor * min(total, STOREYS.alike) * (1 - fixes / max(total, 1))


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
    return Climbs(start, end, np.zeros(len(start)), np.full(len(start), STOREYS.unseen))


def _nearest(heights: Array, at: Array) -> Index:
    """Index of the floor nearest to each height; the lower in a tie."""
    return np.argmin(np.abs(at[:, None] - heights), axis=1)


LOWEST, HIGHEST = 300.0, 1200.0  # [hPa] range of plausible pressures
ESTIMATED_EVERY = 3.0  # [s] between estimates; a climb is assumed to go on for two
LONGEST_WINDOW, KEPT_WINDOW = 200.0, 60.0  # [s] of the window, and of what is left after a cut
TOO_LONG = 1.5  # times the longest window, when it is cut even within a climb
REMEMBERED = 90.0  # [s] before the window, of which labels are stored
STORED_FIXES, MOST_IN_CELL = 300, 200  # stored fixes, and samples per cell, at most


class LiveFloors:
    """The floors of a walk under way. building: see `floors_of`; start: label of the first floor, or "".

    goings: ``(k, 3)`` of the stairs in the window, see `goings_of`; a climb that may go on ends 2 *
    ESTIMATED_EVERY seconds after its last sample.
    """

    def __init__(self, building: Building | None = None, start: str = ""):
        self.building, self.start = building, start
        self.label = start
        self.climbing = False
        self.begin, self.end = np.nan, np.nan  # [s] start of the window, end of the certain steps
        self.looked = -np.inf  # [s] time of the last estimate
        self.time, self.duration = np.empty(0), np.empty(0)  # of the certain steps in the window [s]
        self.pressure = np.empty((0, 2))  # means over CELL: time [s] and pressure [hPa]
        self.open = np.empty((0, 2))  # samples of the cell that is not complete
        self.fixes = Fixes.none()  # with floor labels
        self.row_time, self.row_label = np.empty(0), np.empty(0, dtype=object)
        self.heard = False  # True if fixes with a floor came since the last estimate
        self.goings = np.empty((0, 3))

    def push(self, time: Array, values: Array) -> None:
        """Append barometer samples at times ``(n,)`` [s], values ``(n, 1)`` [hPa]; complete cells become means."""
        rows = np.column_stack([time, values]).astype(float)
        rows = rows[np.isfinite(rows).all(axis=1) & (rows[:, 1] > LOWEST) & (rows[:, 1] < HIGHEST)]
        if np.isfinite(self.end):
            rows = rows[np.abs(rows[:, 0] - self.end) < LIVE_FLOORS.apart]
        for sample in rows:
            if sample[0] <= max(self.pressure[-1:, 0].max(initial=-np.inf), self.open[-1:, 0].max(initial=-np.inf)):
                continue  # repeated sample, or clock reset
            if len(self.open) and sample[0] // CELL > self.open[0, 0] // CELL:
                self.pressure, self.open = np.vstack([self.pressure, self.open.mean(axis=0)]), self.open[:0]
            if len(self.open) < MOST_IN_CELL:
                self.open = np.vstack([self.open, sample])
        longest = LONGEST_WINDOW * (TOO_LONG if np.isfinite(self.end) else 1.0)
        self.pressure = self.pressure[-round(longest / CELL) :]

    def add_fixes(self, fixes: Fixes) -> None:
        """Append fixes; only those with a floor label are used."""
        labelled = np.array([bool(label) for label in fixes.floor], dtype=bool)
        if labelled.any():
            self.fixes = Fixes.concatenate([self.fixes, fixes[labelled]])[-STORED_FIXES:]
            self.heard = True

    def add_steps(self, steps: Steps) -> None:
        """Append the next certain steps."""
        if np.isnan(self.end):
            self.begin = steps.start
        self.time, self.duration = np.append(self.time, steps.time), np.append(self.duration, steps.duration)
        self.end = steps.end

    def advance(self, tail: Steps | None = None) -> bool:
        """Estimate floors and stairs again after ESTIMATED_EVERY; False if not due. tail: provisional steps."""
        now = self.end if tail is None else tail.end
        if not (now > self.begin and abs(now - self.looked) >= ESTIMATED_EVERY):
            return False
        measured = self._is_measured(now)
        named = self.building is None or bool(self.start) or len(self.fixes) > 0
        if named and (measured or self.heard) and now > self.begin:
            self._estimate(now, tail, measured)
        elif now - self.begin > LONGEST_WINDOW:
            self._cut(now - KEPT_WINDOW)
        self.looked = now
        return True

    def labels(self, time: Array) -> tuple[str, ...]:
        """Labels of the present estimate at times ``(n,)`` [s] within REMEMBERED seconds of the window; "" where
        unknown.
        """
        if not len(self.row_time):
            return (self.label,) * len(time)
        row = np.minimum(np.searchsorted(self.row_time, np.asarray(time) - 1e-6), len(self.row_time) - 1)
        return tuple(self.row_label[row].tolist())

    def _is_measured(self, now: float) -> bool:
        """True if the barometer covers the window; cuts the window where the barometer stops or starts."""
        if not len(self.pressure):
            return False
        if now - self.pressure[-1, 0] > LIVE_FLOORS.silent:
            self._cut(self.end)
            self.pressure, self.open, self.climbing, self.goings = *np.empty((2, 0, 2)), False, np.empty((0, 3))
            return False
        first = float(self.pressure[0, 0])
        if self.begin + LIVE_FLOORS.silent < first <= self.end:
            self._cut(first)
        return first <= self.begin + LIVE_FLOORS.silent

    def _estimate(self, now: float, tail: Steps | None, measured: bool) -> None:
        """Estimate the floors of the window, and cut it if it is too long."""
        barometer = Signal(self.pressure[:, 0], self.pressure[:, 1:]) if measured else None
        time, duration, end = self.time, self.duration, self.end
        if tail is not None and tail.end > end and (not len(tail) or tail.time[0] - tail.duration[0] >= end - 1e-6):
            time, duration, end = np.append(time, tail.time), np.append(duration, tail.duration), tail.end
        nothing, some = np.zeros(len(time)), np.ones(len(time))
        steps = Steps(self.begin, end, time, duration, some, nothing, nothing, some, some)
        floors = floors_along(steps, barometer, self.start, self.fixes, self.building)
        before = (self.row_time < self.begin) & (self.row_time > now - REMEMBERED)
        self.row_time = np.concatenate([self.row_time[before], steps.time, [steps.end]])
        self.row_label = np.append(self.row_label[before], np.array(floors.labels[1:], dtype=object))
        self.label, self.heard = floors.labels[-1], False
        last = floors.climbs.end[-1:]
        self.climbing = measured and bool(np.any(last > self.pressure[-1, 0] - CLIMB.gust))
        self.goings = goings_of(steps, floors.climbs, floors.kinds)
        if self.climbing:
            self.goings[self.goings[:, 1] == last, 1] = self.pressure[-1, 0] + 2 * ESTIMATED_EVERY
        if now - self.begin > LONGEST_WINDOW or len(floors.climbs) > 3:
            level = now - KEPT_WINDOW  # or the last time before, that is CLIMB.level away from any climb
            for start, end in zip(floors.climbs.start[::-1].tolist(), floors.climbs.end[::-1].tolist(), strict=True):
                if start - CLIMB.level < level < end + CLIMB.level:
                    level = start - CLIMB.level
            if level > self.begin + CLIMB.level:
                self._cut(level)
            elif now - self.begin > TOO_LONG * LONGEST_WINDOW:
                self._cut(now - KEPT_WINDOW)

    def _cut(self, time: float) -> None:
        """Let the window start at ``time`` [s], or at the end of the certain steps if that is earlier."""
        time = min(time, self.end)
        (self.start,) = self.labels(np.array([time]))
        self.begin = time
        later = self.time - self.duration >= time
        self.time, self.duration = self.time[later], self.duration[later]
        self.pressure = self.pressure[self.pressure[:, 0] >= time]
        first = int(np.searchsorted(self.fixes.time, time))
        if first and self.fixes.floor[first - 1] == self.start:  # a climb leads from it to the next, on another floor
            first -= 1
        self.fixes = replace(self.fixes, time=np.maximum(self.fixes.time, time))[first:]
