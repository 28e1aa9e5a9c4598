"""Gait signals of a recording before any stride model or north: attitude, landings and walking direction.

A gap splits a recording: the app was paused or put to sleep, and the walker may have gone anywhere.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pdr_graph.columns import OneLineRepr
from pdr_graph.errors import InputError, count, slow_rate
from pdr_graph.gait.heading import Direction, forward_acceleration, forward_axis, walking_direction
from pdr_graph.gait.step_detection import Landings, walking_steps
from pdr_graph.inertial.attitude import SHORTEST_WALK, Attitude, attitude_of
from pdr_graph.priors import REST
from pdr_graph.types import Array, Mask, Recording, Signal


def uninterrupted(recording: Recording) -> list[Recording]:
    """Split a recording at gaps into parts in which the accelerometer ran; without a gap, the recording itself.

    Parts of less than a second are dropped. Raises InputError if no part is longer.
    """
    inertial = [s for s in (recording.accelerometer, recording.linear_acceleration) if s is not None]
    gaps = np.concatenate([_gaps(signal) for signal in inertial]) if inertial else np.empty((0, 2))
    if not len(gaps):
        return [recording]
    begins, ends = np.sort(gaps[:, 0]), np.sort(gaps[:, 1])
    start, end = min(s.time[0] for s in inertial), max(s.time[-1] for s in inertial)
    spans = [
        (a, b) for a, b in zip(np.append(start, ends), np.append(begins, end), strict=True) if b - a > SHORTEST_WALK
    ]
    if not spans:
        longest = np.max(ends - begins)
        found = f"{len(gaps)} gaps of up to {longest:.0f} s and no {SHORTEST_WALK:.0f} s of samples between them"
        expected = "samples more often than one a second" + slow_rate(min(s.rate for s in inertial))
        raise InputError(recording.source, "", found, expected)
    return [_cut(recording, a, b) for a, b in spans]


def _gaps(signal: Signal) -> Array:
    """Begin and end ``(g, 2)`` of each gap in a signal. [s]"""
    long = np.flatnonzero(np.diff(signal.time) > REST.longest_bridged)
    return np.stack([signal.time[long], signal.time[long + 1]], axis=1)


def _cut(recording: Recording, start: float, end: float) -> Recording:
    """The recording with its inertial sensors from ``start`` to ``end`` [s], inclusive."""

    def part(signal: Signal | None) -> Signal | None:
        if signal is None:
            return None
        inside = (signal.time >= start) & (signal.time <= end)
        return Signal(signal.time[inside], signal.values[inside])

    return replace(
        recording,
        accelerometer=part(recording.accelerometer),
        linear_acceleration=part(recording.linear_acceleration),
        gyroscope=part(recording.gyroscope),
    )


@dataclass(frozen=True)
class GaitSignals(OneLineRepr):
    """Attitude, landings and walking direction of an uninterrupted part of a recording."""

    recording: Recording
    attitude: Attitude
    landings: Landings
    direction: Direction

    def _summary(self) -> list[str]:
        return [repr(self.attitude), count(len(self.landings), "landing")]

    @property
    def walking(self) -> Mask:
        """``(n,)`` True at the attitude's samples during a step."""
        return self.landings.under_way(self.attitude.time)

    @property
    def forward(self) -> Array:
        """Acceleration along the walking direction ``(n,)``. [m/s²]"""
        ahead = forward_axis(self.attitude, self.direction.heading, self.walking, self.landings.usual_step)
        return forward_acceleration(self.attitude, self.direction.heading, ahead)


def gait_signals(recording: Recording | list[GaitSignals]) -> list[GaitSignals]:
    """The gait signals of each uninterrupted part; a list of them is returned unchanged.

    Raises InputError without an accelerometer.
    """
    return [_of_part(part) for part in uninterrupted(recording)] if isinstance(recording, Recording) else recording


def _of_part(recording: Recording) -> GaitSignals:
    attitude = attitude_of(recording)
    landings = walking_steps(attitude.time, attitude.acceleration)
    return GaitSignals(recording, attitude, landings, walking_direction(attitude, landings.usual_step))
