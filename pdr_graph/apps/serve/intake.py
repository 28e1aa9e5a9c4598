"""The messages of a session as events of a navigator: the same packets as `events_of` makes of the whole recording.

Samples of a packet that the message ends within wait for the next message, so that it makes no difference to the
estimate where the messages end.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pdr_graph.apps.serve import positions, sensor_messages
from pdr_graph.apps.serve.sensor_messages import Signs
from pdr_graph.online.interface import PACKET, Event, Scan, events_of
from pdr_graph.priors import FIXES
from pdr_graph.types import INERTIAL, LONLAT, Array, Fixes, Recording, Signal

LATEST_TIME = 1e8  # [s] from the first sample: three years; times beyond are damage
SENSOR_LOGGER = "sensorlogger"
PLATFORMS = ("ios", "android")


@dataclass
class Intake:
    """What is known of a session after some messages.

    protocol; platform: "ios" or "android" if the user stated it; origin: Unix time of time 0 of the events [s], NaN
    before the first; latest: time of the last inertial sample [s]; held: rows that wait, by sensor, times in seconds
    since origin; held_fixes ``(n, 4)``: time, longitude, latitude, sigma; ignored: number of samples of other sensors;
    unusable: number of rows by sensor that were no numbers, or years away.
    """

    protocol: str
    platform: str = ""
    origin: float = np.nan
    latest: float = -np.inf
    signs: Signs = field(default_factory=Signs)
    held: dict[str, Array] = field(default_factory=dict)
    held_fixes: Array = field(default_factory=lambda: np.empty((0, 4)))
    ignored: dict[str, int] = field(default_factory=dict)
    unusable: dict[str, int] = field(default_factory=dict)

    def events(self, body: bytes) -> list[Event]:
        """The events of a message. Raises InputError if it is malformed."""
        if self.protocol == SENSOR_LOGGER:
            return self._sensor_events(sensor_messages.parse(body))
        _, fixes = positions.parse(self.protocol, body)
        return self._fix_events(fixes)

    def flush(self) -> list[Event]:
        """The events that waited for another message."""
        return self._released(np.inf)

    def _fix_events(self, fixes: Fixes) -> list[Event]:
        if not len(fixes):
            return []
        if np.isnan(self.origin):
            self.origin = float(fixes.time[0])
        fixes = sensor_messages.shifted(fixes, self.origin)
        usable = np.abs(fixes.time) < LATEST_TIME
        self._count_unusable("location", int((~usable).sum()))
        return [fixes[usable]] if usable.any() else []

    def _sensor_events(self, message: sensor_messages.Message) -> list[Event]:
        tables, ignored = sensor_messages.tables_of(message.payload)
        heard = sensor_messages.receptions(message.payload)
        if heard is not None:
            ignored.pop("bluetooth", None)
        for name, count in ignored.items():
            if name in self.ignored or len(self.ignored) < 50:  # names are the app's, or an attacker's
                self.ignored[name] = self.ignored.get(name, 0) + count
        android = any(sample.accuracy is not None for sample in message.payload)
        signals = sensor_messages.signals_of(tables, self.signs, self.platform, android)
        fixes = sensor_messages.fixes_of(tables, [])
        self._begin(signals, fixes)
        events = self._arrived({name: self._usable(name, table) for name, table in signals.items()}, fixes)
        if heard is not None and not np.isnan(self.origin):
            events.append(Scan("bluetooth", sensor_messages.shifted(heard, self.origin)))
        return events

    def _begin(self, signals: dict[str, Array], fixes: Fixes | None) -> None:
        """Set time 0 at the first sample, as a recording does; else at the first fix."""
        if not np.isnan(self.origin):
            return
        finite = {name: table[np.isfinite(table).all(axis=1), 0] for name, table in signals.items()}
        starts = [time[0] for name, time in finite.items() if name in INERTIAL and len(time)]
        starts = starts or [time[0] for time in finite.values() if len(time)]
        starts = starts or ([fixes.time[0]] if fixes is not None else [])
        self.origin = float(min(starts, default=np.nan))

    def _usable(self, name: str, table: Array) -> Array:
        """The rows of finite numbers, times since the origin."""
        table = table - np.eye(1, table.shape[1])[0] * self.origin
        with np.errstate(invalid="ignore"):
            usable = np.isfinite(table).all(axis=1) & (np.abs(table[:, 0]) < LATEST_TIME)
        self._count_unusable(name, int((~usable).sum()))
        return table[usable]

    def _count_unusable(self, name: str, count: int) -> None:
        if count:
            self.unusable[name] = self.unusable.get(name, 0) + count

    def _arrived(self, signals: dict[str, Array], fixes: Fixes | None) -> list[Event]:
        """Hold rows, and return the events of all complete packets."""
        times = [table[:, 0] for name, table in signals.items() if name in INERTIAL and len(table)]
        events: list[Event] = []
        # clock reset [s] by which the times of a message are earlier than those before, if the clock was reset
        if times and min(time[0] for time in times) < self.latest - 60.0:
            events = self._released(np.inf)
        for name, table in signals.items():
            earlier = self.held.get(name)
            self.held[name] = table if earlier is None else np.concatenate([earlier, table])
        if fixes is not None:
            rows = np.column_stack([fixes.time - self.origin, fixes.position, fixes.sigma])
            rows = rows[(np.abs(rows[:, 0]) < LATEST_TIME) & (rows[:, 0] >= -FIXES.longest_overhang)]
            self.held_fixes = np.concatenate([self.held_fixes, rows])
        if times:
            self.latest = float(max(time[-1] for time in times))
            return events + self._released(np.floor(self.latest / PACKET))
        return events + self._released(np.inf)

    def _released(self, until: float) -> list[Event]:
        """The events of all held rows in packets before the one of a number."""
        signals, fixes = dict[str, Any](), Fixes.none()
        for name, table in self.held.items():
            used, self.held[name] = _split(table, until)
            if len(used):
                signals[name] = Signal(used[:, 0], used[:, 1:])
        used, self.held_fixes = _split(self.held_fixes, until)
        if len(used):
            fixes = Fixes(used[:, 0], used[:, 1:3], used[:, 3], (), LONLAT, ("GNSS",) * len(used))
        return list(events_of(Recording("session", self.origin, self.origin, **signals, fixes=fixes)))

    @property
    def advice(self) -> tuple[str, ...]:
        """What the user can change at the phone, a line each; empty before a second of samples."""
        if self.protocol != SENSOR_LOGGER or self.latest < 1.0:
            return ()
        lines = []
        if not self.signs.kind:
            lines.append("no accelerometer: switch on Accelerometer and Gravity, else no steps are detected")
        elif self.signs.kind == sensor_messages.LINEAR:
            lines.append("no gravity: switch on Gravity beside Accelerometer, else the vertical is a guess")
        if "gyroscope" not in self.signs.plain:
            lines.append("no gyroscope: switch on Gyroscope, else turns are not seen")
        return tuple(lines)


def _split(table: Array, until: float) -> tuple[Array, Array]:
    """The rows in packets before the one of a number, in order of time and without repeats, and the others."""
    table = table[np.argsort(table[:, 0], kind="stable")]
    if len(table) > 1:
        repeated = (table[1:] == table[:-1]).all(axis=1)
        table = table[np.concatenate([[True], ~repeated])]
    number = np.floor(table[:, 0] / PACKET)
    count = int(np.searchsorted(number, until))
    return table[:count], table[count:].copy()
