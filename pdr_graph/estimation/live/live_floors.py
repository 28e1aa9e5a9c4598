"""The floors and stairs of a walk under way.

The model of the batch (`floors_along`) runs over the last minutes every few seconds; these minutes start at a time
without climbs, on the floor estimated for it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pdr_graph.estimation.floors import FloorHeights, floors_along
from pdr_graph.inertial.barometer import goings_of
from pdr_graph.priors import CLIMB, LIVE_FLOORS
from pdr_graph.types import Array, Fixes, Signal, Steps

LOWEST, HIGHEST = 300.0, 1200.0  # [hPa] range of plausible pressures
STORED_FIXES, MOST_IN_CELL = 300, 200  # stored fixes, and samples per cell, at most


class LiveFloors:
    """The floors of a walk under way. building: see `floors_of`; start: label of the first floor, or "".

    goings: ``(k, 3)`` of the stairs in the window, see `goings_of`; a climb that may go on ends 2 *
    LIVE_FLOORS.interval after its last sample.
    """

    def __init__(self, building: FloorHeights | None = None, start: str = ""):
        self.building, self.start = building, start
        self.label = start
        self.climbing = False
        self.begin, self.end = np.nan, np.nan  # [s] start of the window, end of the certain steps
        self.looked = -np.inf  # [s] time of the last estimate
        self.time, self.duration = np.empty(0), np.empty(0)  # of the certain steps in the window [s]
        self.pressure = np.empty((0, 2))  # means over CLIMB.grid: time [s] and pressure [hPa]
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
            if len(self.open) and sample[0] // CLIMB.grid > self.open[0, 0] // CLIMB.grid:
                self.pressure, self.open = np.vstack([self.pressure, self.open.mean(axis=0)]), self.open[:0]
            if len(self.open) < MOST_IN_CELL:
                self.open = np.vstack([self.open, sample])
        longest = LIVE_FLOORS.longest * (LIVE_FLOORS.too_long if np.isfinite(self.end) else 1.0)
        self.pressure = self.pressure[-round(longest / CLIMB.grid) :]

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
        """Estimate floors and stairs again after LIVE_FLOORS.interval; False if not due. tail: provisional steps."""
        now = self.end if tail is None else tail.end
        if not (now > self.begin and abs(now - self.looked) >= LIVE_FLOORS.interval):
            return False
        measured = self._is_measured(now)
        named = self.building is None or bool(self.start) or len(self.fixes) > 0
        if named and (measured or self.heard) and now > self.begin:
            self._estimate(now, tail, measured)
        elif now - self.begin > LIVE_FLOORS.longest:
            self._cut(now - LIVE_FLOORS.shortest)
        self.looked = now
        return True

    def labels(self, time: Array) -> tuple[str, ...]:
        """Labels of the present estimate at times ``(n,)`` [s] within LIVE_FLOORS.remembered of the window; "" where
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
        before = (self.row_time < self.begin) & (self.row_time > now - LIVE_FLOORS.remembered)
        self.row_time = np.concatenate([self.row_time[before], steps.time, [steps.end]])
        self.row_label = np.append(self.row_label[before], np.array(floors.labels[1:], dtype=object))
        self.label, self.heard = floors.labels[-1], False
        last = floors.climbs.end[-1:]
        self.climbing = measured and bool(np.any(last > self.pressure[-1, 0] - CLIMB.gust))
        self.goings = goings_of(steps, floors.climbs, floors.kinds)
        if self.climbing:
            self.goings[self.goings[:, 1] == last, 1] = self.pressure[-1, 0] + 2 * LIVE_FLOORS.interval
        if now - self.begin > LIVE_FLOORS.longest or len(floors.climbs) > LIVE_FLOORS.most_climbs:
            level = now - LIVE_FLOORS.shortest  # or the last time before, that is CLIMB.level away from any climb
            for start, end in zip(floors.climbs.start[::-1].tolist(), floors.climbs.end[::-1].tolist(), strict=True):
                if start - CLIMB.level < level < end + CLIMB.level:
                    level = start - CLIMB.level
            if level > self.begin + CLIMB.level:
                self._cut(level)
            elif now - self.begin > LIVE_FLOORS.too_long * LIVE_FLOORS.longest:
                self._cut(now - LIVE_FLOORS.shortest)

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
