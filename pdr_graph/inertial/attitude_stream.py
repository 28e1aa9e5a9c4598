"""Attitude sample by sample: which arriving samples can be used, and causal VQF on them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import vqf

from pdr_graph.geometry import interpolate
from pdr_graph.inertial.attitude import (
    LARGEST_BIAS,
    LONGEST_BRIDGED,
    PHONE,
    SHORTEST_REST,
    STILL_ACCELERATION,
    STILL_RATE,
    vertical_of,
)
from pdr_graph.types import STANDARD_GRAVITY, Array, Mask

LARGEST = 1000.0  # [m/s²], [rad/s] that phones measure: 16 g and 2000°/s, with room
LATEST = 1e12  # [s] of any clock
CONFIRM = 3  # samples after a jump ahead: one wrong time is no gap
PERSISTS = 2.0  # [s] of samples from earlier, until the clock is believed to have been put back
LONGEST_PACKET = 60.0  # [s] of samples that a phone keeps back
HELD = 0.1  # [s] that a sensor's last sample speaks for
KEPT = 1.0  # [s] of samples that have been used already


@dataclass(frozen=True)
class Health:
    """Statistics of one sensor's samples.

    samples: number used; dropped: number that were NaN, out of range, repeated, late, or at a time that no later sample
    confirmed; rate: recent [Hz]; gaps: number longer than is interpolated; last: time of the latest [s], NaN before the
    first; clock_resets: number of resets of its clock; offset: added to its times since then [s].
    """

    samples: int
    dropped: int
    rate: float
    gaps: int
    last: float
    clock_resets: int
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
    clock_resets: int = 0
    offset: float = 0.0
    longest_packet: float = 0.0
    suspect_time: Array = field(default_factory=lambda: np.empty(0))  # as given
    suspect_values: Array = field(default_factory=lambda: np.empty((0, 3)))
    arrived: list[tuple[Array, Array]] = field(default_factory=list)

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
        return Health(self.samples, self.dropped, rate, self.gaps, last, self.clock_resets, self.offset)

    def push(self, time: Array, values: Array) -> None:
        """Samples at times ``(n,)`` [s] of values ``(n, 3)``; they are looked at by `ingest`."""
        time, values = np.array(time, dtype=float).reshape(-1), np.array(values, dtype=float)
        if values.shape != (len(time), 3):
            raise ValueError(f"samples: found shape {values.shape} at {len(time)} times, expected ({len(time)}, 3)")
        if len(time):
            self.arrived.append((time, values))

    def ingest(self, offset: float) -> None:
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

    def segment_start(self, begin: float) -> float:
        """From a time on, or soon after, where the sensor sets in then. [s]"""
        time = np.array([begin])
        later = self.time[self.time >= begin]
        soon = len(later) > 0 and later[0] - begin <= LONGEST_BRIDGED
        return float(later[0]) if soon and not self.covers(time)[0] else begin

    def at(self, time: Array) -> Array:
        """Values ``(m, 3)`` at times ``(m,)``, interpolated."""
        return interpolate(time, self.time, self.values)

    def covers(self, time: Array) -> Mask:
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
            self._reset_clock(offset)
            ahead = True
        if ahead and len(self.suspect_time) >= CONFIRM:
            later = self.suspect_time + self.offset > self.last
            self._accept(self.suspect_time[later] + self.offset, self.suspect_values[later])
            self.suspect_time, self.suspect_values = self.suspect_time[:0], self.suspect_values[:0]

    def _reset_clock(self, offset: float) -> None:
        """The clock was: go on where the samples ended, or as the other sensor does, if that fits."""
        begin, end = self.suspect_time[[0, -1]]
        if not (end + offset > self.last and begin + offset <= self.last + LONGEST_BRIDGED):
            offset = self.last - begin + float(np.median(np.diff(self.suspect_time)))
        self.offset, self.clock_resets = float(offset), self.clock_resets + 1

    def _doubt_nothing(self) -> None:
        """Nothing came of the suspects."""
        self.dropped += len(self.suspect_time)
        self.suspect_time, self.suspect_values = self.suspect_time[:0], self.suspect_values[:0]


FOLLOWED = np.radians(1.0)  # [rad/s] of bias that VQF finds by itself; it stops at twice that


@dataclass
class GravityRestorer:
    """Where a recorder removed it: along the axis that shook most by now, as `attitude_of` has it in the end.

    moments: ``(4, 4)`` sums of products of (1, x, y, z).
    """

    moments: Array = field(default_factory=lambda: np.zeros((4, 4)))

    @property
    def used(self) -> bool:
        """True once it was."""
        return bool(self.moments[0, 0] > 0)

    def restored(self, values: Array) -> Array:
        """Accelerations with gravity ``(n, 3)`` of some without. [m/s²]"""
        ones = np.concatenate([np.ones((len(values), 1)), values], axis=1)[(np.abs(values) < LARGEST).all(axis=1)]
        self.moments = self.moments + ones.T @ ones
        count, total = self.moments[0, 0], self.moments[0, 1:]
        covariance = self.moments[1:, 1:] - np.outer(total, total) / max(count, 1.0)
        return values + STANDARD_GRAVITY * vertical_of(covariance)


@dataclass(frozen=True)
class AttitudeCheckpoint:
    """What an `AttitudeStream` knows. filter_state: all that VQF does."""

    rested: Array
    recent: Array
    filter_state: Array


class AttitudeStream:
    """The phone's attitude as samples come in. bias: ``(3,)`` of the gyroscope that was known before [rad/s]."""

    def __init__(self, period: float, bias: Array | None = None):
        self.rested = np.zeros(3)  # [rad/s], what a rest said of the bias
        self.recent = np.empty((0, 6))  # samples of both sensors
        self._samples = max(3, round(SHORTEST_REST / period))
        options: dict[str, Any] = PHONE
        self._vqf: Any = vqf.VQF(period, **options)  # the stubs do not know that its state can be set
        if bias is not None:
            self._vqf.setBiasEstimate(np.array(bias))

    def update(self, acceleration: Array, angular_rate: Array, seen: Mask) -> tuple[Array, Array]:
        """Quaternions ``(n, 4)`` from device to world, scalar last, and angular rates ``(n, 3)`` without bias [rad/s].

        acceleration ``(n, 3)`` [m/s²]; angular_rate ``(n, 3)`` [rad/s]; seen: ``(n,)`` where the gyroscope ran: where
        not, the vertical follows the accelerometer and the bias stays.
        """
        ran = bool(seen.all())
        if ran:
            self._learn_from_rest(acceleration, angular_rate)
        else:
            angular_rate = np.where(seen[:, None], angular_rate, self.bias)
        self._vqf.setMotionBiasEstEnabled(ran)
        self._vqf.setRestBiasEstEnabled(ran)
        rate = np.ascontiguousarray(angular_rate - self.rested)
        out = self._vqf.updateBatch(rate, np.ascontiguousarray(acceleration))
        return np.roll(out["quat6D"], -1, axis=1), rate - out["bias"]

    @property
    def bias(self) -> Array:
        """Of the gyroscope, by now ``(3,)``. [rad/s]"""
        return self.rested + np.array(self._vqf.state["bias"])

    @property
    def filter_state(self) -> Array:
        """All that VQF knows."""
        return np.concatenate([np.ravel(value) for value in self._vqf.state.values()]).astype(float)

    @filter_state.setter
    def filter_state(self, state: Array) -> None:
        now = self._vqf.state
        parts = np.split(state, np.cumsum([np.size(value) for value in now.values()])[:-1])
        values = zip(now.items(), parts, strict=True)
        self._vqf.state = {
            name: part.tolist() if isinstance(value, list) else type(value)(part[0]) for (name, value), part in values
        }

    def _learn_from_rest(self, acceleration: Array, angular_rate: Array) -> None:
        """A bias that is too large for VQF to find shows at rest."""
        recent = np.concatenate([self.recent, np.concatenate([angular_rate, acceleration], axis=1)])
        self.recent = recent[-self._samples :]
        if len(self.recent) < self._samples:
            return
        mean = self.recent.mean(axis=0)
        spread = np.sqrt(np.mean((self.recent - mean) ** 2, axis=0))
        still = np.linalg.norm(spread[:3]) < STILL_RATE and np.linalg.norm(spread[3:]) < STILL_ACCELERATION
        said = mean[:3]
        if still and np.linalg.norm(said) < LARGEST_BIAS and np.linalg.norm(said - self.rested) > FOLLOWED:
            self.rested = said
            self._vqf.setBiasEstimate(np.zeros(3))
