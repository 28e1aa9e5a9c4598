"""The samples of one sensor: validation as they arrive, and values at any time."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from pdr_graph.geometry import interpolate
from pdr_graph.priors import REST
from pdr_graph.types import Array, Mask


@dataclass(frozen=True)
class ValidationSettings:
    """Constants by which arriving samples are validated, chosen by hand.

    largest: magnitude that phones can measure [m/s², rad/s]: 16 g and 2000 °/s, with a margin.
    latest: time of any clock [s].
    confirming: number of samples after a jump ahead that confirm it: a single wrong time is no gap.
    clock_reset: duration of samples from an earlier time after which the clock was reset [s].
    longest_packet: time for which a phone may hold samples back [s].
    memory: time constant with which it is forgotten how late samples came [s].
    hold: time for which a sensor's last sample is valid [s].
    history: duration of the samples that are stored after use [s].
    """

    largest: float = 1000.0
    latest: float = 1e12
    confirming: int = 3
    clock_reset: float = 2.0
    longest_packet: float = 60.0
    memory: float = 300.0
    hold: float = 0.1
    history: float = 1.0


SENSOR_VALIDATION = ValidationSettings()
UNUSABLE, REPEATED = "could not be used: no numbers, or none that phones measure", "came twice and were used once"
LATE, UNCONFIRMED = "came too late", "had a time that no later sample confirmed"
SHORTEST_WAIT = 0.005  # [s]: less is the jitter of one stream's clock


@dataclass(frozen=True)
class Health:
    """Statistics of one sensor's samples.

    samples: number used; left_out: number of others, by the reason; rate: recent [Hz]; gaps: number of gaps; last: time
    of the latest sample [s], NaN before the first; clock_resets: number of resets of its clock; offset: added to its
    times since then [s].
    """

    samples: int
    left_out: Mapping[str, int]
    rate: float
    gaps: int
    last: float
    clock_resets: int
    offset: float


@dataclass
class SensorStream:
    """The valid samples of one sensor, in increasing time.

    time ``(n,)`` [s], values ``(n, 3)``: samples that were not used yet, and the last samples before them.
    start: time of the first sample of all [s]; longest_packet: recently [s].
    suspect_time ``(k,)``, suspect_values ``(k, 3)``: samples after a jump in time, times by the sensor's clock.
    arrived: packets that were not validated yet, those that wait among them; wait: for samples that come late [s], as
    late as some did recently, up to ``clock_reset``: the newest wait so long and are put in order.
    """

    time: Array = field(default_factory=lambda: np.empty(0))
    values: Array = field(default_factory=lambda: np.empty((0, 3)))
    start: float = np.inf
    samples: int = 0
    left_out: Counter[str] = field(default_factory=Counter)
    gaps: int = 0
    clock_resets: int = 0
    offset: float = 0.0
    longest_packet: float = 0.0
    suspect_time: Array = field(default_factory=lambda: np.empty(0))
    suspect_values: Array = field(default_factory=lambda: np.empty((0, 3)))
    arrived: list[tuple[Array, Array]] = field(default_factory=list)
    wait: float = 0.0

    @property
    def last(self) -> float:
        """Time of the latest valid sample [s]; minus infinity before the first."""
        return float(self.time[-1]) if len(self.time) else -np.inf

    @property
    def newest(self) -> float:
        """Time of the latest sample that arrived, valid or not. [s]"""
        return float(self.arrived[-1][0][-1]) + self.offset if self.arrived else self.last

    @property
    def health(self) -> Health:
        """Statistics of the samples so far."""
        recent = self.time[-50:]
        rate = float(1 / np.median(np.diff(recent))) if len(recent) > 1 else 0.0
        last = self.last if len(self.time) else np.nan
        return Health(self.samples, dict(self.left_out), rate, self.gaps, last, self.clock_resets, self.offset)

    def push(self, time: Array, values: Array) -> None:
        """Queue samples at times ``(n,)`` [s] with values ``(n, 3)``. Raises ValueError for other shapes."""
        time, values = np.array(time, dtype=float).reshape(-1), np.array(values, dtype=float)
        if values.shape != (len(time), 3):
            raise ValueError(f"samples: found shape {values.shape} at {len(time)} times, expected ({len(time)}, 3)")
        if len(time):
            self.arrived.append((time, values))

    def ingest(self, offset: float, last: bool = False) -> None:
        """Validate the queued samples; offset: that of another sensor with the same clock [s]; last: none follow."""
        if not self.arrived:
            return
        time, values = (np.concatenate(column) for column in zip(*self.arrived, strict=True))
        spans = [max(0.0, float(packet[-1]) - float(packet[0])) for packet, _ in self.arrived]
        spans = [min(span, SENSOR_VALIDATION.longest_packet) for span in spans]
        self.longest_packet = max(0.9 * self.longest_packet, *spans)
        self.arrived.clear()
        good = (np.abs(time) < SENSOR_VALIDATION.latest) & (np.abs(values) < SENSOR_VALIDATION.largest).all(axis=1)
        if not good.all():
            self.left_out[UNUSABLE] += int(np.sum(~good))
            time, values = time[good], values[good]
        time, values = self._in_order(time, values, last)
        apart = np.diff(time)
        jumps = np.flatnonzero((apart <= 0) | (apart > REST.longest_bridged)) + 1
        for part, its_values in zip(np.split(time, jumps), np.split(values, jumps), strict=True):
            # Times do not jump within a part: samples are added together from the first that follows those before
            for k, moment in enumerate(part.tolist()):
                if self._follows(part[k:] + self.offset):
                    self._discard_suspects()
                    self._accept(part[k:] + self.offset, its_values[k:])
                    break
                self._add(moment, its_values[k], offset)

    def forget(self, before: float) -> None:
        """Drop samples more than a second before a time ``before`` [s]."""
        first = min(int(np.searchsorted(self.time, before - SENSOR_VALIDATION.history)) - 1, len(self.time) - 1)
        if first > 0:
            self.time, self.values = self.time[first:], self.values[first:]

    def drop_until(self, until: float) -> None:
        """Drop all samples up to a time [s]."""
        later = self.time > until
        self.time, self.values = self.time[later], self.values[later]

    def segment_start(self, begin: float) -> float:
        """Start of the segment [s]: first sample within 1 s of ``begin`` if the sensor starts there, else ``begin``."""
        time = np.array([begin])
        later = self.time[self.time >= begin]
        soon = len(later) > 0 and later[0] - begin <= REST.longest_bridged
        return float(later[0]) if soon and not self.covers(time)[0] else begin

    def at(self, time: Array) -> Array:
        """Interpolated values ``(m, 3)`` at times ``(m,)`` [s]."""
        return interpolate(time, self.time, self.values)

    def sampled(self, time: Array) -> Array:
        """Interpolated values ``(m, 3)`` at times ``(m,)`` [s]; NaN where the sensor did not run."""
        ran = self.covers(time)
        return np.where(ran[:, None], self.at(time) if ran.any() else np.zeros((len(time), 3)), np.nan)

    def covers(self, time: Array) -> Mask:
        """``(m,)`` True at times ``(m,)`` [s] at which the sensor ran."""
        edges = np.concatenate([[-np.inf], self.time, [np.inf]])
        after = np.searchsorted(self.time, time, side="right")
        since = time - edges[after]
        return (edges[after + 1] - edges[after] <= REST.longest_bridged) | (since <= SENSOR_VALIDATION.hold)

    def _in_order(self, time: Array, values: Array, last: bool) -> tuple[Array, Array]:
        """The samples in order of time, without those that wait for others; where a clock was reset, as they came."""
        if not len(time):
            return time, values
        behind = np.maximum.accumulate(np.append(self.last - self.offset, time))[1:] - time
        late = float(behind.max(initial=0.0))
        self.wait *= math.exp(-max(float(time[-1]) + self.offset - self.last, 0.0) / SENSOR_VALIDATION.memory)
        if late > SENSOR_VALIDATION.clock_reset or max(late, self.wait) < SHORTEST_WAIT:
            return time, values
        # half as long again: what came so late so far was not the latest
        self.wait = max(self.wait, min(1.5 * late, SENSOR_VALIDATION.clock_reset))
        order = np.argsort(time, kind="stable")
        time, values = time[order], values[order]
        first = len(time) if last else int(np.searchsorted(time, time[-1] - self.wait, side="right"))
        if first < len(time):
            self.arrived.append((time[first:], values[first:]))
        return time[:first], values[:first]

    def _follows(self, time: Array) -> bool:
        """True if times increase from the last sample on without a gap."""
        apart = np.diff(time, prepend=self.time[-1:])
        return not len(apart) or bool(apart.min() > 0 and apart.max() <= REST.longest_bridged)

    def _accept(self, time: Array, values: Array) -> None:
        """Append valid samples."""
        self.gaps += int(len(self.time) > 0 and time[0] - self.last > REST.longest_bridged)
        self.start = min(self.start, float(time[0]))
        self.samples += len(time)
        self.time, self.values = np.concatenate([self.time, time]), np.concatenate([self.values, values])

    def _add(self, time: float, value: Array, offset: float) -> None:
        """Add one sample after a jump in time; it becomes valid when later samples confirm the jump."""
        since = time - float(self.suspect_time[-1]) if len(self.suspect_time) else REST.longest_bridged
        if -SENSOR_VALIDATION.clock_reset < since <= 0:
            self.left_out[LATE if since else REPEATED] += 1
            return
        if not 0 < since <= REST.longest_bridged:
            self._discard_suspects()
        self.suspect_time = np.append(self.suspect_time, time)
        self.suspect_values = np.concatenate([self.suspect_values, value[None]])
        ahead = self.suspect_time[0] + self.offset > self.last
        if not ahead and np.ptp(self.suspect_time) > SENSOR_VALIDATION.clock_reset:
            # Continue where the samples ended, or with the other sensor's offset if it is plausible
            begin, end = self.suspect_time[[0, -1]]
            if not (end + offset > self.last and begin + offset <= self.last + REST.longest_bridged):
                offset = self.last - begin + float(np.median(np.diff(self.suspect_time)))
            self.offset, self.clock_resets = float(offset), self.clock_resets + 1
            ahead = True
        if ahead and len(self.suspect_time) >= SENSOR_VALIDATION.confirming:
            later = self.suspect_time + self.offset > self.last
            self._accept(self.suspect_time[later] + self.offset, self.suspect_values[later])
            self.suspect_time, self.suspect_values = self.suspect_time[:0], self.suspect_values[:0]

    def _discard_suspects(self) -> None:
        for time in (self.suspect_time + self.offset).tolist():
            self.left_out[UNCONFIRMED if time > self.last else REPEATED if time in self.time else LATE] += 1
        self.suspect_time, self.suspect_values = self.suspect_time[:0], self.suspect_values[:0]
