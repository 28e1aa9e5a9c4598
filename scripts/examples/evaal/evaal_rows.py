"""Rows of GetSensorData as a server sends them, slot by slot, as events of a navigator."""

from __future__ import annotations

import re
from collections import Counter, deque
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np

from pdr_graph import Event, Fixes, InputError, Recording, Sightings, Signal, events_of
from pdr_graph.inertial.units import IMPLAUSIBLE, unit_of
from pdr_graph.io.delimited import MAXIMUM_LINE, TextRows
from pdr_graph.io.get_sensor_data import (
    MAXIMUM_CLOCK_DRIFT,
    SENSOR_TAGS,
    epochs,
    fixes_of,
    rows_by_tag,
    samples,
    sightings,
)
from pdr_graph.types import Array, take

RADIOS = {"BLE4": "bluetooth", "WIFI": "wifi"}
MAXIMUM_SPREAD = 60.0  # [s] of the times in a slot about their median; others are damaged


class RowStream:
    """The rows of one trial.

    rows: number of rows by tag; unread: number of damaged rows by tag; notes: texts, and how often each occurred;
    begin: time of the first row [s], None before it.
    """

    def __init__(self):
        self.rows, self.unread, self.notes = Counter[str](), Counter[str](), Counter[str]()
        self.begin: float | None = None
        self._sensors = {tag: _Sensor(name, self.notes) for tag, name in SENSOR_TAGS.items()}
        self._epochs: deque[float] = deque(maxlen=8)  # the receiver's last epochs, to recognise repeats

    def feed(self, text: str) -> list[Event]:
        """The events of the rows of one slot, in order of arrival; times on the app's clock."""
        lines = [line for line in text.splitlines() if line.strip() and not line.startswith("%")]
        counts = Counter(word.group() if (word := re.match(r"\w{1,12}", line)) else "other" for line in lines)
        for tag, number in counts.items():  # of at most 100 tags by name
            self.rows[tag if tag in self.rows or len(self.rows) < 100 else "other"] += number
        rows = rows_by_tag("the trial", [line for line in lines if len(line) <= MAXIMUM_LINE])
        tables = {tag: _readable(partial(samples, tag), rows[tag]) for tag in SENSOR_TAGS if tag in rows}
        tables["GNSS"] = _readable(epochs, rows.get("GNSS", TextRows("the trial", b"")))
        radios = {tag: sightings(rows[tag]) for tag in RADIOS if tag in rows}

        times = np.concatenate([*(table[:, 0] for table in tables.values()), *(s.time for s in radios.values())])
        times = times[np.isfinite(times)]
        middle = float(np.median(times)) if len(times) else 0.0
        tables = {tag: table[np.abs(table[:, 0] - middle) < MAXIMUM_SPREAD] for tag, table in tables.items()}
        radios = {tag: _near(sightings, middle) for tag, sightings in radios.items()}
        for tag in (*SENSOR_TAGS, "GNSS", *RADIOS):
            if missing := counts[tag] - len(tables.get(tag, radios.get(tag, ()))):
                self.unread[tag] += missing
        if self.begin is None and len(times):
            self.begin = float(times[np.abs(times - middle) < MAXIMUM_SPREAD].min())

        parts: dict[str, Any] = {RADIOS[tag]: sightings for tag, sightings in radios.items()}
        parts |= dict(filter(None, (self._sensors[tag].append(tables[tag]) for tag in SENSOR_TAGS if tag in tables)))
        return list(events_of(Recording("", 0.0, None, fixes=self._fixes(tables["GNSS"]), **parts)))

    def _fixes(self, table: Array) -> Fixes:
        """The fixes of new epochs; the app writes each epoch twice."""
        new: list[int] = []
        for n, epoch in enumerate(table[:, 1].tolist()):
            if epoch not in self._epochs:
                self._epochs.append(epoch)
                new.append(n)
        notes: list[str] = []
        fixes = fixes_of(table[new], notes)
        self.notes.update(notes)
        return fixes


FIRST_SECOND, LONGEST_DELAY = 1.0, 10.0  # [s] of samples from which a unit is recognised; kept while it is not


class _Sensor:
    """The samples of one sensor until its unit is known, and its clock.

    unit: kind and factor, as of `unit_of`; lag: app minus sensor time [s]; latest: time of the last sample [s]; read:
    the sensor's time at the end of the last slot [s]; own_clock: True while the sensor's own clock is used.
    """

    def __init__(self, name: str, notes: Counter[str]):
        self.name, self.notes = name, notes
        self.delayed: Array | None = None
        self.unit: tuple[str, float] | None = None
        # of the slots of five minutes, in which clocks drift by less than 25 ms; their median is the lag
        self.lags: deque[float] = deque(maxlen=600)
        self.lag, self.latest, self.read = 0.0, -np.inf, -np.inf
        self.own_clock = True

    def append(self, table: Array) -> tuple[str, Signal] | None:
        """Kind and signal of the rows ``(n, 2 + k)`` of a slot and all delayed ones; None while the unit is unknown."""
        if self.unit is None:
            table = table if self.delayed is None else np.concatenate([self.delayed, table])
            self._recognize_unit(table)
            if self.unit is None:
                self.delayed = table[table[:, 0] > table[-1:, 0] - LONGEST_DELAY]
                return None
            self.delayed = None
        name, factor = self.unit
        time = self._on_app_clock(table[:, 0], table[:, 1])
        was_reset = len(time) > 0 and time.max() < self.latest - MAXIMUM_CLOCK_DRIFT  # the samples are new all the same
        latest = -np.inf if was_reset else self.latest
        forward = time > np.maximum.accumulate(np.append(latest, time))[:-1]
        if not forward.all():
            self.notes[f"{self.name}: samples at or before an earlier time were left out"] += int((~forward).sum())
        if forward.any():
            self.latest = float(time[forward][-1])
        return name, Signal(time[forward], table[forward, 2:] * factor)

    def _recognize_unit(self, table: Array) -> None:
        """Set the unit from the first second of samples, and whether the sensor's own clock runs."""
        if not len(table) or np.ptp(table[:, 0]) < FIRST_SECOND:
            return
        notes: list[str] = []
        # if the sensor's clock stands still, the app's is used
        self.own_clock = 0.5 < np.ptp(table[:, 1]) / np.ptp(table[:, 0]) < 2.0
        try:
            self.unit = unit_of("the trial", self.name, Signal(table[:, 0], table[:, 2:]), notes)
        except InputError:
            notes.append(f"{self.name}: not used yet, its unit is not recognised")
        self.notes.update(notes)

    def _on_app_clock(self, app: Array, sensor: Array) -> Array:
        """Times ``(n,)`` of the sensor's own clock, shifted to the app's [s]."""
        if not self.own_clock or not len(app):
            return app
        median = float(np.median(app - sensor))
        if not self.lags:
            self.lag, self.read = median, float(sensor[0])
        if abs(median - self.lag) > MAXIMUM_CLOCK_DRIFT:
            self.own_clock = False
            self.notes[f"{self.name}: its clock and the app's differ; the app's clock is used from now on"] += 1
            return app
        self.lags.append(median)
        # the lag changes by 2 ms/s: twenty times the drift of clocks, a fifth of 100 Hz's interval per slot
        most = 0.002 * abs(float(sensor[-1]) - self.read)
        self.lag += float(np.clip(np.median(self.lags) - self.lag, -most, most))
        self.read = float(sensor[-1])
        return sensor + self.lag


def _readable(parse: Callable[[TextRows], Array], rows: TextRows) -> Array:
    """The columns of the rows that can be read and have plausible values."""
    try:
        table = parse(rows)
    except InputError:
        tables = [parse(TextRows(rows.where, b""))]
        for n, line in enumerate(rows.lines, 1):
            with suppress(InputError):
                tables.append(parse(TextRows.of(rows.where, [line], [n], rows.delimiter)))
        table = np.concatenate(tables)
    with np.errstate(invalid="ignore"):
        return table[(np.abs(table) < IMPLAUSIBLE)[:, : None if parse is not epochs else 2].all(axis=1)]


def _near(sightings: Sightings, middle: float) -> Sightings:
    """The receptions within MAXIMUM_SPREAD of the time `middle` [s], sorted by time."""
    with np.errstate(invalid="ignore"):
        rows = np.flatnonzero(np.isfinite(sightings.rssi) & (np.abs(sightings.time - middle) < MAXIMUM_SPREAD))
    return take(sightings, rows[np.argsort(sightings.time[rows], kind="stable")])
