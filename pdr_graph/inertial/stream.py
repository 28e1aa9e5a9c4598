"""A sensor's samples as they arrive: which of them can be used, and how the sensor is."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from pdr_graph.geometry import interpolate
from pdr_graph.inertial.samples import LONGEST_BRIDGED
from pdr_graph.types import Array, Mask

LARGEST = 1000.0  # [m/s²], [rad/s] that phones measure: 16 g and 2000°/s, with room
LATEST = 1e12  # [s] of any clock
CONFIRM = 3  # samples after a jump ahead: one wrong time is no gap
PERSISTS = 2.0  # [s] of samples from earlier, until the clock is believed to have been put back
LONGEST_PACKET = 60.0  # [s] of samples that a phone keeps back
HELD = 0.1  # [s] that a sensor's last sample speaks for
KEPT = 1.0  # [s] of samples that have been used already


@dataclass(frozen=True)
class Health:
    """How a sensor is.

    samples: so many were used; dropped: NaN, absurd, repeated, late, or at a time that none after them confirmed;
    rate: lately [Hz]; gaps: longer than is bridged; last: time of the latest [s], NaN before any; put_back: how often
    its clock was; offset: by how much its times are later now than those given [s].
    """

    samples: int
    dropped: int
    rate: float
    gaps: int
    last: float
    put_back: int
    offset: float


@dataclass
class SensorStream:
    """The usable samples of one sensor, times increasing.

    time ``(n,)`` [s], values ``(n, 3)``: those not used yet and the last before them. began: with the first of all [s];
    longest_packet: lately [s].
    """

    time: Array = field(default_factory=lambda: np.empty(0))
    values: Array = field(default_factory=lambda: np.empty((0, 3)))
    began: float = np.inf
    samples: int = 0
    dropped: int = 0
    gaps: int = 0
    put_back: int = 0
    offset: float = 0.0
    longest_packet: float = 0.0
    suspect_time: Array = field(default_factory=lambda: np.empty(0))  # as given
    suspect_values: Array = field(default_factory=lambda: np.empty((0, 3)))
    arrived: list[tuple[Array, Array]] = field(default_factory=list)

    kept: ClassVar = (
        *("time", "values", "began", "samples", "dropped", "gaps", "put_back"),
        *("offset", "longest_packet", "suspect_time", "suspect_values"),
    )

    @property
    def last(self) -> float:
        """Time of the latest usable sample [s]; minus infinity before any."""
        return float(self.time[-1]) if len(self.time) else -np.inf

    @property
    def newest(self) -> float:
        """Time of the latest sample that arrived, usable or not. [s]"""
        return float(self.arrived[-1][0][-1]) + self.offset if self.arrived else self.last

    @property
    def health(self) -> Health:
        """How the sensor is by now."""
        lately = self.time[-50:]
        rate = float(1 / np.median(np.diff(lately))) if len(lately) > 1 else 0.0
        last = self.last if len(self.time) else np.nan
        return Health(self.samples, self.dropped, rate, self.gaps, last, self.put_back, self.offset)

    def push(self, time: Array, values: Array) -> None:
        """Samples at times ``(n,)`` [s] of values ``(n, 3)``; they are looked at by `take_in`."""
        time, values = np.array(time, dtype=float).reshape(-1), np.array(values, dtype=float)
        if values.shape != (len(time), 3):
            raise ValueError(f"samples: found shape {values.shape} at {len(time)} times, needed ({len(time)}, 3)")
        if len(time):
            self.arrived.append((time, values))

    def take_in(self, offset: float) -> None:
        """Look at what arrived. offset: of another sensor of the same clock [s]."""
        if not self.arrived:
            return
        time, values = (np.concatenate(column) for column in zip(*self.arrived, strict=True))
        spans = [min(max(0.0, float(packet[-1]) - float(packet[0])), LONGEST_PACKET) for packet, _ in self.arrived]
        self.longest_packet = max(0.9 * self.longest_packet, *spans)
        self.arrived.clear()
        good = (np.abs(time) < LATEST) & (np.abs(values) < LARGEST).all(axis=1)
        if not good.all():
            self.dropped += int(np.sum(~good))
            time, values = time[good], values[good]
        if not len(time):
            return
        if not len(self.suspect_time) and self._follows(time + self.offset):
            self._accept(time + self.offset, values)
        else:
            for one, value in zip(time.tolist(), values, strict=True):
                self._take(one, value, offset)

    def forget(self, before: float) -> None:
        """Drop samples that have been used, but for the last seconds."""
        first = min(int(np.searchsorted(self.time, before - KEPT)) - 1, len(self.time) - 1)
        if first > 0:
            self.time, self.values = self.time[first:], self.values[first:]

    def cut(self, until: float) -> None:
        """Drop all up to a time [s]."""
        later = self.time > until
        self.time, self.values = self.time[later], self.values[later]

    def from_where(self, begin: float) -> float:
        """From a time on, or soon after, where the sensor sets in then. [s]"""
        time = np.array([begin])
        later = self.time[self.time >= begin]
        soon = len(later) > 0 and later[0] - begin <= LONGEST_BRIDGED
        return float(later[0]) if soon and not self.seen(time)[0] else begin

    def at(self, time: Array) -> Array:
        """Values ``(m, 3)`` at times ``(m,)``, interpolated."""
        return interpolate(time, self.time, self.values)

    def seen(self, time: Array) -> Mask:
        """At which times ``(m,)`` the sensor ran."""
        edges = np.concatenate([[-np.inf], self.time, [np.inf]])
        after = np.searchsorted(self.time, time, side="right")
        since = time - edges[after]
        return (edges[after + 1] - edges[after] <= LONGEST_BRIDGED) | (since <= HELD)

    def _follows(self, time: Array) -> bool:
        apart = time[1:] - time[:-1]
        first = float(time[0] - self.time[-1]) if len(self.time) else LONGEST_BRIDGED
        least, most = (float(apart.min()), float(apart.max())) if len(apart) else (first, first)
        return min(first, least) > 0 and max(first, most) <= LONGEST_BRIDGED

    def _accept(self, time: Array, values: Array) -> None:
        self.gaps += int(len(self.time) > 0 and time[0] - self.last > LONGEST_BRIDGED)
        self.began = min(self.began, float(time[0]))
        self.samples += len(time)
        self.time, self.values = np.concatenate([self.time, time]), np.concatenate([self.values, values])

    def _take(self, time: float, value: Array, offset: float) -> None:
        """The next sample, where something is wrong with the times."""
        if self._follows(np.array([time + self.offset])):
            self._doubt_nothing()
            self._accept(np.array([time + self.offset]), value[None])
            return
        since = time - float(self.suspect_time[-1]) if len(self.suspect_time) else LONGEST_BRIDGED
        if -PERSISTS < since <= 0:
            self.dropped += 1
            return
        if not 0 < since <= LONGEST_BRIDGED:
            self._doubt_nothing()
        self.suspect_time = np.append(self.suspect_time, time)
        self.suspect_values = np.concatenate([self.suspect_values, value[None]])
        ahead = self.suspect_time[0] + self.offset > self.last
        if not ahead and np.ptp(self.suspect_time) > PERSISTS:
            self._put_back(offset)
            ahead = True
        if ahead and len(self.suspect_time) >= CONFIRM:
            later = self.suspect_time + self.offset > self.last
            self._accept(self.suspect_time[later] + self.offset, self.suspect_values[later])
            self.suspect_time, self.suspect_values = self.suspect_time[:0], self.suspect_values[:0]

    def _put_back(self, offset: float) -> None:
        """The clock was: go on where the samples ended, or as the other sensor does, if that fits."""
        begin, end = self.suspect_time[[0, -1]]
        if not (end + offset > self.last and begin + offset <= self.last + LONGEST_BRIDGED):
            offset = self.last - begin + float(np.median(np.diff(self.suspect_time)))
        self.offset, self.put_back = float(offset), self.put_back + 1

    def _doubt_nothing(self) -> None:
        """Nothing came of the suspects."""
        self.dropped += len(self.suspect_time)
        self.suspect_time, self.suspect_values = self.suspect_time[:0], self.suspect_values[:0]
