"""Gaps in a recording: the app was paused or put to sleep, and the walker may have gone anywhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pdr_graph.errors import InputError
from pdr_graph.inertial.samples import SHORTEST_WALK
from pdr_graph.types import Array, Recording, Signal, Steps

LONGEST_BRIDGED = 1.0  # [s] of missing samples that are interpolated: a step or two
SPEED = 1.0  # [m/s] standard deviation per axis of where a gap takes the walker: they stand or walk
SIGMA_TURN = 1.2  # [rad] of the heading over a gap: as good as unknown, and still a slope to follow


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
        gap = part.start - joined.end
        joined = Steps(
            start=joined.start,
            end=part.end,
            time=np.concatenate([joined.time, [part.start], part.time]),
            duration=np.concatenate([joined.duration, [gap], part.duration]),
            length=np.concatenate([joined.length, [0.0], part.length]),
            turn=np.concatenate([joined.turn, [joined.final_turn], part.turn]),
            pause_turn=np.concatenate([joined.pause_turn, [joined.final_turn], part.pause_turn]),
            sigma_length=np.concatenate([joined.sigma_length, [SPEED * gap], part.sigma_length]),
            sigma_turn=np.concatenate([joined.sigma_turn, [SIGMA_TURN], part.sigma_turn]),
            final_turn=part.final_turn,
            unknown=joined.unknown,
        )
    if len(parts) > 1:
        joined = replace(joined, unknown=(*joined.unknown, f"{len(parts) - 1} gaps in the recording"))
    return joined


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
