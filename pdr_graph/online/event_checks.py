"""What a live walk can use of an event: values of a possible size, times near the walk, and not too many rows a second.

All else is left out and counted, and the status says so. A rate beyond what walking needs would only cost time: each
measurement is a keyframe.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from pdr_graph.gait.step_chunks import concatenate_steps, gap
from pdr_graph.inertial.sensor_stream import SENSOR_VALIDATION
from pdr_graph.inertial.units import METRIC, WEB, AccelerationSign, G, GravityRestorer, SensorUnit
from pdr_graph.priors import MOTION
from pdr_graph.types import (
    INERTIAL,
    INSTANT,
    TABLE,
    Array,
    Fixes,
    Levels,
    Limits,
    Mask,
    Sightings,
    Steps,
    declared,
    last_time,
    row_columns,
    take,
)

AHEAD = 30.0  # [s] by which a measurement may lie in the future, if its clock is not that of the sensors
CLOCK_AHEAD = 2.0, 5  # [s] by which all, and so many, fixes of a source are of the future, until it is corrected
STEP_LIMITS: Limits = {  # [m, rad] of steps of another front end; of rows that are no gaps
    "length": (-100.0, 100.0),
    "turn": (-100.0, 100.0),
    "pause_turn": (-100.0, 100.0),
    "sigma_length": (1e-6, 1e4),
    "sigma_turn": (1e-6, 1e3),
}
SPAN = 0.25  # [s] in which at most so many rows are used: a walker moves by 0.3 m
MOST_SOURCES = 100  # whose clocks are watched, and whose last positions are stored, to recognise duplicate epochs
MOST = 10  # rows in SPAN of a type of data that does not state it
MOST_MOMENTS = 4  # of a type of data in SPAN: each moment is a keyframe; ranges to several anchors may have the same
UNUSABLE, OUT_OF_ORDER = "could not be used", "came out of order"
FINER = {  # unit of a clock: least and largest interval of inertial samples in it, at 10 to 1000 Hz
    "milliseconds": (1.0, 100.0),
    "microseconds": (1e3, 1e5),
    "nanoseconds": (1e6, 1e8),
}
LARGEST_FLOAT = float(np.finfo(float).max)
SILENT = 5.0, 10  # [s] without a source, and number of its mean intervals, until it is silent
TOO_OFTEN = f"came more often than {{}} in {SPAN:g} s and were left out"


class EventChecks:
    """Leaves out rows of live events; unused: how many, by what the status says of them.

    units: of each sensor, and sign: of the accelerations, as far as they are known from earlier events.
    """

    def __init__(self, units: dict[str, SensorUnit] | None = None, sign: AccelerationSign | None = None) -> None:
        self.unused = Counter[tuple[str, str]]()
        self.units = units or {}
        for unit in self.units.values():
            unit.gravity = None if unit.gravity is None else GravityRestorer()
        self.sign = sign or AccelerationSign()
        self._stamps = dict[str, tuple[float, str]]()  # last time of each sensor and the unit of its packet
        self._heard = dict[str, tuple[float, float, int]]()  # of each source: first and last time [s], and how often
        self._leads = dict[str, tuple[int, float]]()  # of each source: number of fixes, least lead of the sensors [s]

    def note(self, source: str, time: Array) -> None:
        """Note that a source was received at times ``(n,)`` [s]."""
        if len(time) and np.isfinite(time[-1]) and (source in self._heard or len(self._heard) < MOST_SOURCES):
            now = float(time[-1])
            first, last, number = self._heard.get(source, (now, now, 0))
            self._heard[source] = first, max(last, now), number + 1

    def silences(self, now: float) -> Iterator[str]:
        """Yield the sources that are silent at a time [s] for longer than usual, a line each."""
        least, intervals = SILENT
        for source, (first, last, number) in self._heard.items():
            usual = (last - first) / (number - 1) if number > 2 else np.inf
            if now - last > max(least, intervals * usual):
                yield f"{source}: silent for {now - last:.0f} s"

    def watch(self, sensor: str, time: Array, values: Array) -> bool:
        """Examine samples ``(n, k)`` at times ``(n,)`` [s]; True if the unit or sign of the sensor changed."""
        stamps, values = np.array(time, dtype=float).reshape(-1), np.array(values, dtype=float)  # kept for a window
        if not _are_rows(stamps, values):
            return False
        unit = self.units.setdefault(sensor, SensorUnit(sensor))
        before = unit.note, unit.factor
        unit.watch(stamps, values)
        turns = self.units.get("gyroscope")
        if sensor == "accelerometer":
            in_degrees = turns is not None and turns.factor != 1.0
            self.sign.unit = G if unit.factor != 1.0 else WEB if in_degrees else METRIC
            self.sign.watch(stamps, values)
        return self.sign.decide() or (unit.note, unit.factor) != before

    def in_unit(self, sensor: str, time: Array, values: Array) -> Array:
        """A sensor's samples ``(n, k)`` at times ``(n,)`` [s] in its unit, with Android's sign."""
        stamps, values = np.asarray(time, dtype=float).reshape(-1), np.asarray(values, dtype=float)
        if not _are_rows(stamps, values):
            return values
        self._check_clock(sensor, stamps)
        unit = self.units.setdefault(sensor, SensorUnit(sensor))
        return unit.converted(-values if sensor == "accelerometer" and self.sign.sign < 0 else values)

    def _check_clock(self, sensor: str, stamps: Array) -> None:
        """Count samples whose times ``(n,)`` are in a finer unit than seconds."""
        if sensor not in INERTIAL:
            return
        last, before = self._stamps.get(sensor, (np.nan, ""))
        several = len(stamps) > 1
        apart = (stamps[-1] - stamps[0]) / (len(stamps) - 1) if several else stamps[-1] - last
        unit = next((unit for unit, (least, most) in FINER.items() if least <= apart <= most), "")
        self._stamps[sensor] = float(stamps[-1]), unit
        if unit and unit == before:  # twice in a row: else it is a gap
            self.unused[sensor, f"samples seem to have times in {unit}: seconds are expected"] += len(stamps)

    def valid(self, name: str, data: Any) -> Any:
        """The rows of a table of measurements whose values are possible; None if there are none.

        Values are within the limits of the type of data, and finite. A listed position may be unknown.
        """
        limits: Limits = getattr(data, "limits", {})
        tables = {column: limits[column] for column in declared(type(data), TABLE) if column in limits}
        arrays = {name: column for name, column in row_columns(data).items() if isinstance(column, np.ndarray)}
        optional = getattr(data, "optional", ())
        numbers = [name for name, column in arrays.items() if column.dtype.kind == "f" and name not in optional]
        finite: Limits = dict.fromkeys(numbers, (-LARGEST_FLOAT, LARGEST_FLOAT))
        soon = np.abs(data.time) < SENSOR_VALIDATION.latest
        rows = {column: bounds for column, bounds in (finite | limits).items() if column not in tables}
        within = _within(data, rows) & (soon if soon.ndim == 1 else soon.all(axis=1))
        for column, (least, most) in tables.items():
            listed = getattr(data, column)
            unknown = np.isnan(listed) if column == "position" else False
            within &= bool(((listed >= least) & (listed <= most) | unknown).all())
        return self._counted(name, data, within, UNUSABLE)

    def on_earth(self, fixes: Fixes) -> Fixes | None:
        """The fixes whose longitude and latitude are possible [deg]; None if there are none."""
        return self._counted("fixes", fixes, np.all(np.abs(fixes.position) <= [180.0, 90.0], axis=1), UNUSABLE)

    def by_sensor_clock(self, fixes: Fixes, now: float) -> Fixes:
        """The fixes by the clock of the sensors, which is ``now`` [s], minus infinity before their first sample.

        Nobody knows the future: the clock of a source whose fixes are all later than now is ahead by the least of it.
        Steps of another front end are no such clock: they may be certain seconds later.
        """
        time = fixes.time.copy()
        for n, source in enumerate(fixes.source if now > -np.inf else ()):
            seen, lead = self._leads.pop(source, (0, np.inf))
            self._leads[source] = seen + 1, min(lead, time[n] - now)
            time[n] -= self._ahead.get(source, 0.0)
        while len(self._leads) > MOST_SOURCES:
            del self._leads[next(iter(self._leads))]
        return replace(fixes, time=time)

    @property
    def _ahead(self) -> dict[str, float]:
        """Sources whose clocks are ahead, and by how much. [s]"""
        least, fewest = CLOCK_AHEAD
        return {source: lead for source, (seen, lead) in self._leads.items() if lead > least and seen > fewest}

    def thinned(self, name: str, data: Any, used: Any | None) -> Any:
        """The rows that are not too many in SPAN seconds; None if all are.

        used: the rows of this type so far, in order of time, None without any.
        """
        most = getattr(data, "most", MOST)
        if most is None or not len(data):
            return data
        span = np.floor(last_time(data) / SPAN)
        order = np.argsort(span, kind="stable")
        place = np.empty(len(data), dtype=np.intp)
        place[order] = np.arange(len(data)) - np.searchsorted(span[order], span[order])
        earlier = np.empty(0) if used is None else last_time(used)  # sorted
        place += np.searchsorted(earlier, (span + 1) * SPAN) - np.searchsorted(earlier, span * SPAN)
        within = place < most
        if most > MOST_MOMENTS:
            moments = dict[float, set[float]]()
            for n, (moment, part) in enumerate(zip(last_time(data).tolist(), span.tolist(), strict=True)):
                if part not in moments:
                    first, last = np.searchsorted(earlier, [part * SPAN, (part + 1) * SPAN])
                    moments[part] = set(earlier[first:last].tolist())
                if moment in moments[part] or len(moments[part]) < MOST_MOMENTS:
                    moments[part].add(moment)
                else:
                    within[n] = False
        return self._counted(name, data, within, TOO_OFTEN.format(most))

    def heard(self, received: Sightings) -> Sightings | None:
        """The receptions whose times and levels are possible; None without any."""
        least, most = Levels.limits["rssi"]
        within = (np.abs(received.time) < SENSOR_VALIDATION.latest) & (received.rssi >= least) & (received.rssi <= most)
        return self._counted("scans", received, within, UNUSABLE)

    def in_order(self, steps: Steps, end: float) -> Steps | None:
        """The steps after ``end`` [s], NaN before the first, with a gap up to the first of them; None without any.

        Rows of impossible values become gaps.
        """
        if not np.abs([steps.start, steps.end]).max() < SENSOR_VALIDATION.latest:
            self.unused["steps", UNUSABLE] += max(1, len(steps))
            return None
        possible = _within(steps, STEP_LIMITS) | (steps.is_gap & (np.abs(steps.turn) <= STEP_LIMITS["turn"][1]))
        if not possible.all() or abs(steps.final_turn) > STEP_LIMITS["turn"][1]:
            unknown = {"length": 0.0, "turn": 0.0, "pause_turn": 0.0, "sigma_turn": MOTION.gap_turn}
            unknown |= {"sigma_length": MOTION.gap_speed * steps.duration}
            columns = {name: np.where(possible, getattr(steps, name), value) for name, value in unknown.items()}
            final_turn = steps.final_turn if abs(steps.final_turn) <= STEP_LIMITS["turn"][1] else 0.0
            steps = replace(steps, final_turn=final_turn, **columns)
            self.unused["steps", UNUSABLE] += max(1, int((~possible).sum()))
        if not steps.start < end - INSTANT:
            return concatenate_steps([gap(end, steps.start), steps]) if steps.start > end + INSTANT else steps
        later = steps.time - steps.duration >= end - INSTANT
        self.unused["steps", OUT_OF_ORDER] += max(1, int((~later).sum()))
        if steps.end <= end + INSTANT:
            return None
        return replace(take(steps, later), start=end)

    def issues(self) -> list[str]:
        """A line for each unit that is not the expected one, and for each reason why rows were left out."""
        units = [note for note in (*(unit.note for unit in self.units.values()), self.sign.note) if note]
        clock = "the clock is {:.0f} s ahead of the sensors; corrected"
        clocks = [f"{source or 'fixes'}: {clock.format(lead)}" for source, lead in self._ahead.items()]
        return units + clocks + [f"{name}: {count} {reason}" for (name, reason), count in self.unused.items() if count]

    def _counted(self, name: str, data: Any, within: Mask, reason: str) -> Any:
        """The rows within; None without any."""
        if within.all():
            return data
        self.unused[name, reason] += int((~within).sum())
        return take(data, within) if within.any() else None


def _are_rows(stamps: Array, values: Array) -> bool:
    return len(stamps) > 0 and values.ndim == 2 and len(values) == len(stamps)


def _within(data: Any, limits: Limits) -> Mask:
    """``(n,)`` True for rows whose columns are all within their limits; NaN is not."""
    within = np.ones(len(data), dtype=bool)
    for name, (least, most) in limits.items():
        column: Array = getattr(data, name)
        within &= ((column >= least) & (column <= most)).all(axis=tuple(range(1, column.ndim)))
    return within
