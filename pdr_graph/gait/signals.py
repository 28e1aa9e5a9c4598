"""Gait signals of a recording before any model of stride or north: attitude, landings, direction; and gaps.

In a gap the app was paused or put to sleep, and the walker may have gone anywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np

from pdr_graph.errors import InputError
from pdr_graph.gait.heading import Direction, forward_acceleration, forward_axis, walking_direction
from pdr_graph.gait.step_detection import Landings, walking_steps
from pdr_graph.inertial.attitude import LONGEST_BRIDGED, SHORTEST_WALK, Attitude, attitude_of
from pdr_graph.types import Array, Mask, Recording, Signal, Steps

GAP_SPEED = 1.0  # [m/s] standard deviation per axis of where a gap takes the walker: they stand or walk
GAP_SIGMA_TURN = 1.2  # [rad] of the heading over a gap: as good as unknown, and still a slope to follow


def uninterrupted(recording: Recording) -> list[Recording]:
    """The parts of a recording in which every inertial sensor ran; the recording itself if it has no gap.

    Parts too short for a step are left to the gap.

    Raises InputError if no part is long enough.
    """
    inertial = [
        s for s in (recording.accelerometer, recording.linear_acceleration, recording.gyroscope) if s is not None
    ]
    gaps = np.concatenate([_gaps(signal) for signal in inertial]) if inertial else np.empty((0, 2))
    if not len(gaps):
        return [recording]
    begins, ends = np.sort(gaps[:, 0]), np.sort(gaps[:, 1])
    start, end = min(s.time[0] for s in inertial), max(s.time[-1] for s in inertial)
    spans = [
        (a, b) for a, b in zip(np.append(start, ends), np.append(begins, end), strict=True) if b - a > SHORTEST_WALK
    ]
    if not spans:
        found = (
            f"{len(gaps)} gaps, at most {np.max(ends - begins):.0f} s long, and no {SHORTEST_WALK:.0f} s between them"
        )
        raise InputError(recording.source, "", found, "samples more often than one a second")
    return [_cut(recording, a, b) for a, b in spans]


def join(parts: Sequence[Steps]) -> Steps:
    """The steps of the parts of a walk, a row of length 0 for each gap between them."""
    joined = parts[0]
    for part in parts[1:]:
        joined = append_steps(append_steps(joined, gap(joined.end, part.start)), part)
    if len(parts) > 1:
        joined = replace(joined, unknown=(*joined.unknown, f"{len(parts) - 1} gaps in the recording"))
    return joined


def gap(
    start: float, end: float, turn: float = 0.0, sigma_turn: float = GAP_SIGMA_TURN, speed: float = GAP_SPEED
) -> Steps:
    """A row of length 0, for what nobody saw between two times [s].

    turn, sigma_turn: of the heading over it [rad]; speed: standard deviation of the way per time and axis [m/s].
    """
    long, nothing = np.array([end - start]), np.zeros(1)
    return Steps(
        start,
        end,
        time=np.array([end]),
        duration=long,
        length=nothing,
        turn=np.array([turn]),
        pause_turn=nothing,
        sigma_length=speed * long,
        sigma_turn=np.array([sigma_turn]),
    )


def shifted(steps: Steps, by: float) -> Steps:
    """The same walk, so much later [s]."""
    return replace(steps, start=steps.start + by, end=steps.end + by, time=steps.time + by)


def append_steps(first: Steps, then: Steps) -> Steps:
    """A walk of two chunks, the second of which starts where the first ends."""
    turn, pause_turn, final_turn = then.turn.copy(), then.pause_turn.copy(), then.final_turn
    if len(then):
        turn[0] += first.final_turn
        pause_turn[0] += first.final_turn
    else:
        final_turn += first.final_turn
    names = ("time", "duration", "length", "sigma_length", "sigma_turn")
    columns = {name: np.concatenate([getattr(first, name), getattr(then, name)]) for name in names}
    columns |= {"turn": np.append(first.turn, turn), "pause_turn": np.append(first.pause_turn, pause_turn)}
    unknown = (*first.unknown, *(line for line in then.unknown if line not in first.unknown))
    return Steps(first.start, then.end, **columns, final_turn=final_turn, unknown=unknown)


def concatenate_steps(chunks: Sequence[Steps]) -> Steps:
    """A walk of at least one chunk, each of which starts where the one before ends; neighbours first, of so many."""
    while len(chunks) > 1:
        chunks = [reduce(append_steps, chunks[n : n + 2]) for n in range(0, len(chunks), 2)]
    return chunks[0]


def _gaps(signal: Signal) -> Array:
    """Begin and end ``(g, 2)`` of each gap in a signal [s]."""
    long = np.flatnonzero(np.diff(signal.time) > LONGEST_BRIDGED)
    return np.stack([signal.time[long], signal.time[long + 1]], axis=1)


def _cut(recording: Recording, start: float, end: float) -> Recording:
    """The recording from ``start`` to ``end`` [s], inclusive."""

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
class GaitSignals:
    """An uninterrupted part of a recording. direction: straight on if unknown."""

    recording: Recording
    attitude: Attitude
    landings: Landings
    direction: Direction

    @property
    def walking(self) -> Mask:
        """When the walker was under way ``(n,)``, at the attitude's samples."""
        return self.landings.under_way(self.attitude.time)

    @property
    def forward(self) -> Array:
        """Acceleration along the walking direction ``(n,)``. [m/s²]"""
        ahead = forward_axis(self.attitude, self.direction.heading, self.walking, self.landings.usual_step)
        return forward_acceleration(self.attitude, self.direction.heading, ahead)


def gait_signals(recording: Recording | list[GaitSignals]) -> list[GaitSignals]:
    """One of each uninterrupted part, unless that is what is given. Raises InputError without an accelerometer."""
    return [_of_part(part) for part in uninterrupted(recording)] if isinstance(recording, Recording) else recording


def _of_part(recording: Recording) -> GaitSignals:
    attitude = attitude_of(recording)
    landings = walking_steps(attitude.time, attitude.acceleration)
    nothing = np.zeros(len(attitude.time))
    seen = attitude.angular_rate is not None
    direction = walking_direction(attitude, landings.usual_step) if seen else Direction(nothing, nothing)
    return GaitSignals(recording, attitude, landings, direction)
