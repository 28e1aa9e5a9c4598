"""Rows of GetSensorData, IPIN or xDR, while they come, into events: what `io.get_sensor_data` does with a whole log.

A log is judged as a whole, rows that come must be taken before the rest is known. The unit of a sensor is told from
its first second, for which its samples are held back. Its clock is laid on the app's by the median lag so far, which
the times approach too slowly for a sample to overtake another. Rows that cannot be read are counted and left out.
"""

from __future__ import annotations

import re
from collections import Counter, deque
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from pdr_graph.errors import InputError
from pdr_graph.io.delimited import MAXIMUM_LINE, TextRows
from pdr_graph.io.get_sensor_data import MAXIMUM_CLOCK_DRIFT, SENSORS, epochs, fixes_of, rows_by_tag, samples, sightings
from pdr_graph.io.validation import IMPLAUSIBLE, unit_of
from pdr_graph.online.interface import Event, events_of
from pdr_graph.types import Array, Fixes, Recording, Sightings, Signal

FIRST_SECOND, MOST_HELD = 1.0, 10.0  # [s] of samples that tell a unit, and that are held while they do not
LAGS = 600  # of the latest slots, whose median is the lag: five minutes, over which clocks drift by less than 25 ms
SLEW = 0.002  # [s/s] by which the lag follows: twenty times the drift of clocks, a fifth of 100 Hz's interval per slot
EPOCHS = 8  # of the receiver, of which repeats are known
FARTHEST = 60.0  # [s] from the others of its slot: a damaged time
RADIOS = {"BLE4": "bluetooth", "WIFI": "wifi"}
TAG = re.compile(r"\w{1,12}")
MOST_TAGS = 100  # that are counted by name


class RowStream:
    """The rows of one trial.

    rows: how many came, by tag; unread: how many of them should have been read and could not; notes: what was
    noticed, and how often; begin: time of the first row [s], None before it.
    """

    def __init__(self):
        self.rows, self.unread, self.notes = Counter[str](), Counter[str](), Counter[str]()
        self.begin: float | None = None
        self._sensors = {tag: _Sensor(name, self.notes) for tag, name in SENSORS.items()}
        self._epochs: deque[float] = deque(maxlen=EPOCHS)

    def feed(self, text: str) -> list[Event]:
        """The events of the rows of one slot, in order of arrival; times on the app's clock."""
        lines = [line for line in text.splitlines() if line.strip() and not line.startswith("%")]
        came = self._count(lines)
        rows = rows_by_tag("the trial", [line for line in lines if len(line) <= MAXIMUM_LINE])
        tables = {tag: _readable(partial(samples, tag), rows[tag]) for tag in SENSORS if tag in rows}
        tables["GNSS"] = _readable(epochs, rows["GNSS"]) if "GNSS" in rows else np.empty((0, 6))
        radios = {tag: sightings(rows[tag]) for tag in RADIOS if tag in rows}

        every = np.concatenate([*(table[:, 0] for table in tables.values()), *(of.time for of in radios.values())])
        every = every[np.isfinite(every)]
        middle = float(np.median(every)) if len(every) else 0.0
        tables = {tag: table[np.abs(table[:, 0] - middle) < FARTHEST] for tag, table in tables.items()}
        radios = {tag: _within(of, middle) for tag, of in radios.items()}
        for tag in (*SENSORS, "GNSS", *RADIOS):
            if missing := came[tag] - len(tables.get(tag, radios.get(tag, ()))):
                self.unread[tag] += missing
        if self.begin is None and len(every):
            self.begin = float(every[np.abs(every - middle) < FARTHEST].min())

        parts: dict[str, Any] = {RADIOS[tag]: of for tag, of in radios.items()}
        parts |= dict(filter(None, (self._sensors[tag].take(tables[tag]) for tag in SENSORS if tag in tables)))
        return list(events_of(Recording("", 0.0, None, fixes=self._fixes(tables["GNSS"]), **parts)))

    def _count(self, lines: list[str]) -> Counter[str]:
        tags = (word.group() if (word := TAG.match(line)) else "other" for line in lines)
        came = Counter(tags)
        for tag, count in came.items():
            self.rows[tag if tag in self.rows or len(self.rows) < MOST_TAGS else "other"] += count
        return came

    def _fixes(self, table: Array) -> Fixes:
        """Every epoch is written twice: once counts."""
        new: list[int] = []
        for n, epoch in enumerate(table[:, 1].tolist()):
            if epoch not in self._epochs:
                self._epochs.append(epoch)
                new.append(n)
        said: list[str] = []
        fixes = fixes_of(table[new], said)
        self.notes.update(said)
        return fixes


class _Sensor:
    """One sensor: its samples until its unit is known, and its clock."""

    def __init__(self, name: str, notes: Counter[str]):
        self.name, self.notes = name, notes
        self.held: Array | None = None
        self.unit: tuple[str, float] | None = None
        self.lags: deque[float] = deque(maxlen=LAGS)
        self.lag, self.latest, self.read = 0.0, -np.inf, -np.inf
        self.own_clock = True

    def take(self, table: Array) -> tuple[str, Signal] | None:
        """What the rows ``(n, 2 + k)`` of a slot add: nothing while they are held, then all that were."""
        if self.unit is None:
            table = table if self.held is None else np.concatenate([self.held, table])
            self._tell_unit(table)
            if self.unit is None:
                self.held = table[table[:, 0] > table[-1:, 0] - MOST_HELD]
                return None
            self.held = None
        name, factor = self.unit
        time = self._on_app_clock(table[:, 0], table[:, 1])
        was_set = len(time) > 0 and time.max() < self.latest - MAXIMUM_CLOCK_DRIFT  # what comes is new all the same
        latest = -np.inf if was_set else self.latest
        forward = time > np.maximum.accumulate(np.append(latest, time))[:-1]
        if not forward.all():
            self.notes[f"{self.name}: samples at or before an earlier time were left out"] += int((~forward).sum())
        if forward.any():
            self.latest = float(time[forward][-1])
        return name, Signal(time[forward], table[forward, 2:] * factor)

    def _tell_unit(self, held: Array) -> None:
        if not len(held) or np.ptp(held[:, 0]) < FIRST_SECOND:
            return
        said: list[str] = []
        # a sensor whose own clock stands still is used by the app's
        self.own_clock = 0.5 < np.ptp(held[:, 1]) / np.ptp(held[:, 0]) < 2.0
        try:
            self.unit = unit_of("the trial", self.name, Signal(held[:, 0], held[:, 2:]), said)
        except InputError:
            said.append(f"{self.name}: its unit cannot be told, so that it is held back")
        self.notes.update(said)

    def _on_app_clock(self, app: Array, sensor: Array) -> Array:
        """Times of the sensor's own clock, laid on the app's."""
        if not self.own_clock or not len(app):
            return app
        usual = float(np.median(app - sensor))
        if not self.lags:
            self.lag, self.read = usual, float(sensor[0])
        if abs(usual - self.lag) > MAXIMUM_CLOCK_DRIFT:
            self.own_clock = False
            self.notes[f"{self.name}: its clock and the app's part; the app's is used"] += 1
            return app
        self.lags.append(usual)
        most = SLEW * abs(float(sensor[-1]) - self.read)
        self.lag += float(np.clip(np.median(self.lags) - self.lag, -most, most))
        self.read = float(sensor[-1])
        return sensor + self.lag


def _readable(parse: Callable[[TextRows], Array], rows: TextRows) -> Array:
    """The columns of those rows that can be read."""
    try:
        table = parse(rows)
    except InputError:
        table = np.concatenate([_one(parse, rows, n) for n in range(len(rows))])
    with np.errstate(invalid="ignore"):
        return table[(np.abs(table) < IMPLAUSIBLE)[:, : None if parse is not epochs else 2].all(axis=1)]


def _one(parse: Callable[[TextRows], Array], rows: TextRows, n: int) -> Array:
    """A single row, or none."""
    try:
        return parse(TextRows(rows.where, [rows.lines[n]], [n + 1], rows.delimiter))
    except InputError:
        return parse(TextRows(rows.where, [], []))


def _within(heard: Sightings, middle: float) -> Sightings:
    """What was heard near a time, in order."""
    with np.errstate(invalid="ignore"):
        rows = np.flatnonzero(np.isfinite(heard.rssi) & (np.abs(heard.time - middle) < FARTHEST))
    rows = rows[np.argsort(heard.time[rows], kind="stable")]
    names, minors = (tuple(of[n] for n in rows) for of in (heard.transmitter, heard.minor))
    return Sightings(heard.time[rows], names, heard.rssi[rows], minors)
