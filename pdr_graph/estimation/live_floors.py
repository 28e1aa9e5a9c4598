"""The floor while a person walks: `floors_along` over the last minutes, again every few seconds.

What lies further back is the label on which those minutes begin, at a moment when nobody climbed.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pdr_graph.estimation.floors import Floors, floors_along
from pdr_graph.estimation.storeys import FloorHeights
from pdr_graph.inertial.barometer import GRID, GUST, LEVEL, Climbs
from pdr_graph.state import restore, state_of
from pdr_graph.types import Array, Fixes, Signal, Steps

EVERY = 3.0  # [s] until the floors are looked at again
LONGEST, SHORTEST, MOST_CLIMBS = 200.0, 60.0, 3  # [s] of what is looked at, before and after it is cut; climbs in it
TOO_LONG = 1.5  # times the longest, when it is cut in a climb too
REMEMBERED = 90.0  # [s] of labels before it
SILENT = 20.0  # [s] without a barometer, after which fixes tell alone
LOWEST, HIGHEST = 300.0, 1200.0  # [hPa] that a phone measures
APART = 120.0  # [s] between a sample and the steps: a wild time
LABELS = ("fix_label", "row_label")  # arrays of text
MOST_FIXES, MOST_IN_CELL = 300, 200  # a flood of either tells no more


class LiveFloors:
    """The floor by all that has come in. building: as of `floors_along`; start: label of the first floor, or ""."""

    kept = ("start", "label", "climbing", "begin", "end", "looked", "time", "duration", "pressure", "open")
    kept += ("fix_time", "fix_label", "row_time", "row_label", "heard")

    def __init__(self, building: FloorHeights | None = None, start: str = ""):
        self.building, self.start = building, start
        self.label = start
        self.climbing = False
        self.begin, self.end = np.nan, np.nan  # of what is looked at, and of the certain steps [s]
        self.looked = -np.inf  # [s] when
        self.time, self.duration = np.empty(0), np.empty(0)  # of the certain steps
        self.pressure = np.empty((0, 2))  # means over GRID: time [s] and pressure [hPa]
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

    def state(self) -> dict[str, Any]:
        """All that it knows, as numbers, labels and arrays of them; what follows a `restore` is the same."""
        return {name: value.tolist() if name in LABELS else value for name, value in state_of(self).items()}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a `state`, of the same building."""
        restore(self, state)

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
            return  # repeated, or of a clock that was put back: it comes to where it was
        if len(self.open) and one[0] // GRID > self.open[0, 0] // GRID:
            self.pressure = np.concatenate([self.pressure, self.open.mean(axis=0)[None]])
            self.pressure = self.pressure[-round(TOO_LONG * LONGEST / GRID) :]
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
        self.climbing = measured and bool(np.any(last > self.pressure[-1, 0] - GUST))
        self.heard = False
        if now - self.begin > LONGEST or len(found.climbs) > MOST_CLIMBS:
            level = _level_before(now - SHORTEST, found.climbs)
            if level > self.begin + LEVEL:
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
        if start - LEVEL < time < end + LEVEL:
            time = start - LEVEL
    return time
