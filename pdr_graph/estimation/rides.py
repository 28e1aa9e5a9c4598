"""Rides within a walk: times in which the positions move farther than the steps can have led.

Positions alone do not separate a cyclist from a runner, nor a bumpy road from a pavement; steps and positions together
do. The steps of a ride are shaking: a gap takes their place, through which the fixes alone carry the walk.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pdr_graph.estimation.results import time_on_steps
from pdr_graph.gait.step_chunks import gap
from pdr_graph.priors import FIXES, RIDING, TRAVEL
from pdr_graph.types import INSTANT, STEP_COLUMNS, Array, Contradiction, Fixes, Index, Mask, Steps


def farthest_lengths(steps: Steps) -> Array:
    """How far each row ``(n,)`` can have led: a step its length, a gap at FIXES.driven. [m]"""
    return np.where(steps.is_gap, FIXES.driven * steps.duration, steps.length)


def on_way(time: Array, position: Array, sigma: Array) -> Index:
    """Indices of the fixes ``(n,)`` that lie between those before and after, roughly; outliers lie beside them.

    The first and the last fix are no outliers only if the fixes beside them are not far either.
    """
    kept = np.arange(len(time))
    while len(kept) > 2:
        t, p = time[kept], position[kept]
        share = ((t[1:-1] - t[:-2]) / np.maximum(t[2:] - t[:-2], INSTANT))[:, None]
        beside = np.hypot(*(p[1:-1] - (1 - share) * p[:-2] - share * p[2:]).T)
        off = beside - RIDING.beside * np.hypot(*(p[2:] - p[:-2]).T) - FIXES.outlier * sigma[kept][1:-1]
        wrong = (off > 0) & (off >= np.maximum(np.append(0, off[:-1]), np.append(off[1:], 0)))
        if not wrong.any():
            break
        kept = np.delete(kept, 1 + np.flatnonzero(wrong))
    return kept


def ridden(begins: Array, ends: Array, rides: Array) -> Mask:
    """True for times from ``begins (n,)`` to ``ends (n,)`` [s] that are in part within one of the rides ``(r, 2)``."""
    return np.any((ends[:, None] > rides[:, 0] + INSTANT) & (begins[:, None] < rides[:, 1] - INSTANT), axis=1)


def without_rides(steps: Steps, rides: Array, fixes: Fixes) -> Steps:
    """The steps, with a gap instead of those within each ride ``(r, 2)`` [s], a row to each fix in it."""
    if not len(rides):
        return steps
    walked = ~ridden(steps.time - steps.duration, steps.time, rides)
    gaps = [gap(start, end, speed=RIDING.speed, rows=fixes.time) for start, end in rides.tolist()]
    columns = {
        name: np.concatenate([getattr(steps, name)[walked], *(getattr(ride, name) for ride in gaps)])
        for name in STEP_COLUMNS
    }
    order = np.argsort(columns["time"], kind="stable")
    ridden_for = float(np.diff(rides).sum())
    times = {name: max(getattr(steps, name) - ridden_for, 0.0) for name in ("stepless", "missing")}
    return replace(steps, **times, **{name: column[order] for name, column in columns.items()})


def stepping(steps: Steps, rides: Array) -> Array:
    """Time on steps within each ride ``(r,)`` [s]."""
    inside = (steps.time[:, None] > rides[:, 0]) & (steps.time[:, None] <= rides[:, 1]) & ~steps.is_gap[:, None]
    return np.sum(steps.duration[:, None] * inside, axis=0)


def ride_notes(rides: Array) -> tuple[str, ...]:
    """A line for each ride ``(r, 2)`` [s]."""
    return tuple(f"a ride from {start:.0f} to {end:.0f} s: positions alone are used there" for start, end in rides)


def ride_contradictions(rides: Array, on_steps: Array) -> tuple[Contradiction, ...]:
    """Contradictions of rides ``(r, 2)`` [s] with steps in most of their time: ``(r,)`` [s] on steps."""
    check = "the scale and the clock of the fixes, and whether this was a ride"
    found = list[Contradiction]()
    for (start, end), walked in zip(rides.tolist(), on_steps.tolist(), strict=True):
        if walked > RIDING.stepping * (end - start):
            when = f"from {start:.0f} to {end:.0f} s, of which {walked:.0f} s have steps"
            text = f"the fixes go farther than the steps {when}"
            found.append(Contradiction("fixes", "steps", walked, "s", text, check))
    return tuple(found)


class RideWatch:
    """The rides of a walk under way: its steps pass through, but those of a ride come as a gap, some time later.

    found: start, end and time on steps of the rides so far [s]. Fixes of the last `RIDING.watched` seconds are compared
    with the steps between them, as in `gps_track.detect_rides`, but by the straight line between fixes.
    """

    def __init__(self) -> None:
        self.found = list[tuple[float, float, float]]()
        self._rides = False
        self._led = 0.0  # by all steps so far [m]
        self._held = list[Steps]()
        self._rows = np.empty((0, 5))  # fixes: time [s], x, y, sigma [m], how far the steps had led [m]

    @property
    def since(self) -> float | None:
        """Start of the present ride [s]; None on foot."""
        return self.found[-1][0] if self._rides else None

    @property
    def notes(self) -> tuple[str, ...]:
        """A line for each ride so far."""
        return ride_notes(self._table[:, :2])

    @property
    def contradictions(self) -> tuple[Contradiction, ...]:
        """Those of the rides so far."""
        return ride_contradictions(self._table[:, :2], self._table[:, 2])

    @property
    def _table(self) -> Array:
        return np.array(self.found).reshape(-1, 3)

    @property
    def end(self) -> float:
        """End of the steps that wait for the end of the ride [s]; NaN without."""
        return self._held[-1].end if self._held else np.nan

    def steps(self, steps: Steps) -> list[Steps]:
        """The steps to use now: those given, or in a ride a gap every `RIDING.boarding` seconds."""
        self._led += float(farthest_lengths(steps).sum())
        if not self._rides:
            return [steps]
        self._held.append(steps)
        due = steps.end - self._held[0].start > RIDING.boarding
        return self._ridden() if due else []

    def fix(self, time: float, position: Array, sigma: float) -> list[Steps]:
        """Compare a fix with those before; returns the steps to use now, if a ride has ended by it."""
        if len(self._rows) and time <= self._rows[-1, 0]:
            return []
        rows = np.vstack([self._rows, np.array([time, *position, sigma, self._led])])
        rows = rows[on_way(rows[:, 0], rows[:, 1:3], rows[:, 3])]
        self._rows = rows = rows[rows[:, 0] >= min(time - RIDING.watched, rows[-4:][0, 0])]
        if not self._rides:
            rows = rows[:-2]  # nothing says yet that the last ones are no outliers
            if len(rows) < 2:
                return []
        past, now = rows[:-1], rows[-1]
        moved, led = np.hypot(*(now[1:3] - past[:, 1:3]).T), now[4] - past[:, 4]
        excess = moved - FIXES.stretched * led - RIDING.slowest * (now[0] - past[:, 0])
        if not self._rides:
            step = np.hypot(*np.diff(rows[:, 1:3], axis=0).T)
            longest, noise = np.maximum.accumulate(step[::-1])[::-1], FIXES.outlier * np.median(rows[:, 3])
            self._rides = bool(is_ride(excess, longest, float(noise), np.arange(len(past)) > 0).any())
            if self._rides:
                self.found.append((float(past[np.argmax(excess), 0]), float(now[0]), 0.0))
            return []
        start, until, on_steps = self.found[-1]
        lately = min(int(np.searchsorted(past[:, 0], time - RIDING.pause)), len(past) - 1)
        if excess[lately] > 0:
            self.found[-1] = start, time, on_steps
        elif now[4] - np.interp(until, rows[:, 0], rows[:, 4]) > RIDING.alighted:
            self._rows = rows[rows[:, 0] >= until]
            return self.finish()
        return []

    def finish(self) -> list[Steps]:
        """The steps that are left at the end of the present ride, or of the walk."""
        ridden, held, self._held, self._rides = self._ridden(), self._held, [], False
        return [*ridden, *held]

    def gap(self, start: float, end: float) -> Steps:
        """A part of the present ride, with a row to each fix in it; how long the ride lasts is not known."""
        speed = RIDING.speed * np.sqrt(TRAVEL.lasts / (end - start))
        return gap(start, end, speed=float(speed), rows=self._rows[:, 0])

    def _ridden(self) -> list[Steps]:
        """The held steps that are certainly of the ride, as a gap."""
        start, until, on_steps = self.found[-1] if self.found else (0.0, -np.inf, 0.0)
        ridden = [steps for steps in self._held if steps.end <= until]
        if not ridden:
            return []
        self._held = self._held[len(ridden) :]
        self.found[-1] = start, until, on_steps + sum(time_on_steps(steps) for steps in ridden)
        return [self.gap(ridden[0].start, ridden[-1].end)]


def is_ride(excess: Array, longest: Array, noise: float, within: Mask) -> Mask:
    """True where the positions went farther than the steps led, not by one jump.

    excess: by how far ``(n,)`` [m]; longest: step from fix to fix within ``(n,)`` [m]; noise: of the receiver [m];
    within: ``(n,)`` True if a fix before and a fix after say that it was no outlier at an end of the walk.
    """
    return ((excess > max(noise, RIDING.shortest)) & within) | (excess - longest > max(noise, RIDING.gradual))
