"""Pedestrian dead reckoning, start here: a recording becomes gait signals, and these become steps.

A gap splits a recording: the app was paused or put to sleep, and the walker may have gone anywhere. The gait signals of
a part are attitude, landings and walking direction, before any stride model or north. A gap becomes a row of length 0.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from pdr_graph.errors import InputError, count, expect, slow_rate
from pdr_graph.gait.heading import Direction, forward_acceleration, forward_axis, walking_direction
from pdr_graph.gait.step_chunks import join
from pdr_graph.gait.step_detection import Landings, UnrecognisedMovement, walking_steps
from pdr_graph.gait.walker import MODELS, StepFeatures, Walker
from pdr_graph.inertial.attitude import NO_GYROSCOPE, SHORTEST_WALK, Attitude, attitude_of
from pdr_graph.priors import CONFIDENCE, IRREGULARITY, MOTION, REST
from pdr_graph.types import Array, Mask, OneLineRepr, Recording, Signal, Steps


def detect_steps(recording: Recording | list[GaitSignals], walker: Walker | None = None) -> Steps:
    """The steps of a recording: when each foot landed, the step's length, and the change of heading.

    recording: or its `gait_signals`, where they are needed for something else too; walker: whose stride model and
    profile are used, by default those of a person of 1.70 m.

    A gap in the recording is a row of length 0 with a wide sigma. Where no gyroscope ran, turns are 0 with a wide
    sigma.
    ``unknown`` names what the sensors cannot measure.

    Raises InputError if there is no accelerometer.
    """
    expect("detect_steps, recording", recording, Recording, list, instead="load(path)")
    expect("detect_steps, walker", walker, Walker, None, instead="Walker(height=1.72)")
    walker = walker or Walker()
    parts = list[Steps]()
    for gait in gait_signals(recording):
        movement = UnrecognisedMovement(gait.attitude.period)
        stepless, missed = movement.update(gait.attitude.acceleration, gait.walking)
        missed += gait.attitude.time[0]
        parts.append(with_missing(replace(steps_of(gait, walker), stepless=stepless), missed))
    steps = join(parts)
    return walker.profile.corrected(steps) if walker.profile else steps


def steps_of(gait: GaitSignals, walker: Walker, start: float | None = None) -> Steps:
    """The steps of an uninterrupted part, before correction by a profile.

    start: beginning of the part [s], before all landings; default: its first sample.
    """
    # When the feet landed
    attitude, landings = gait.attitude, gait.landings
    start = float(attitude.time[0]) if start is None else start
    since_last = np.diff(landings.time, prepend=start)
    duration = np.minimum(landings.period, since_last)

    # How far
    length, sigma_length = MODELS[walker.stride](StepFeatures(gait), height=walker.height, **walker.constants)
    sigma_length *= (landings.irregularity / IRREGULARITY.usual) ** IRREGULARITY.exponent
    share = duration / landings.period  # below 1 only where the recording starts in mid-step
    none = np.maximum(1 - landings.confidence / CONFIDENCE.sure, 0)  # probability that it is no step, and its length 0
    sigma_length = np.hypot(sigma_length, np.sqrt(none * (1 - none)) * length)

    # Which way
    heading = gait.direction.heading
    landed = np.interp(landings.time, attitude.time, heading)
    set_off = np.interp(landings.time - duration, attitude.time, heading)
    before = np.append(np.interp(start, attitude.time, heading), landed[:-1])[: len(landed)]

    rows, unmeasured = np.append(start, landings.time), np.isnan(attitude.angular_rate[:, 0])
    variance = np.interp(rows, attitude.time, gait.direction.variance)
    blind = np.diff(np.interp(rows, attitude.time, np.cumsum(unmeasured))) > 0

    return Steps(
        start=start,
        end=float(attitude.time[-1]),
        time=landings.time,
        duration=duration,
        length=length * share,
        turn=landed - before,
        pause_turn=set_off - before,
        sigma_length=sigma_length,
        sigma_turn=np.where(blind, MOTION.unmeasured_turn, np.sqrt(walker.sigma_turn**2 + np.diff(variance))),
        final_turn=float(heading[-1] - (landed[-1] if len(landed) else np.interp(start, attitude.time, heading))),
        confidence=landings.confidence,
        unknown=(*attitude.unknown, *([NO_GYROSCOPE] if unmeasured[attitude.time > start].any() else [])),
    )


def with_missing(steps: Steps, missed: Array) -> Steps:
    """The steps with the time of missing ones: the next step's sigma has how far the walker may have gone in it.

    missed: ``(k,)`` ends of seconds that moved like steps without one [s].
    """
    if not len(steps):
        return replace(steps, missing=float(len(missed)))
    row = np.minimum(np.searchsorted(steps.time, missed), len(steps) - 1)
    lost = np.bincount(row, minlength=len(steps)) / steps.duration * steps.length
    return replace(steps, missing=float(len(missed)), sigma_length=np.hypot(steps.sigma_length, lost))


def uninterrupted(recording: Recording) -> list[Recording]:
    """Split a recording at gaps into parts in which the accelerometer ran; without a gap, the recording itself.

    Parts of less than a second are dropped. Raises InputError if no part is longer.
    """
    inertial = [s for s in (recording.accelerometer, recording.linear_acceleration) if s is not None]
    begins, ends = np.empty(0), np.empty(0)  # of the gaps
    for signal in inertial:
        long = np.flatnonzero(np.diff(signal.time) > REST.longest_bridged)
        begins, ends = np.append(begins, signal.time[long]), np.append(ends, signal.time[long + 1])
    if not len(begins):
        return [recording]
    starts = np.append(min(s.time[0] for s in inertial), np.sort(ends))
    stops = np.append(np.sort(begins), max(s.time[-1] for s in inertial))
    spans = [(a, b) for a, b in zip(starts, stops, strict=True) if b - a > SHORTEST_WALK]
    if not spans:
        longest = np.max(starts[1:] - stops[:-1])
        found = f"{len(begins)} gaps of up to {longest:.0f} s and no {SHORTEST_WALK:.0f} s of samples between them"
        expected = "samples more often than one a second" + slow_rate(min(s.rate for s in inertial))
        raise InputError(recording.source, "", found, expected)

    def part(signal: Signal | None, a: float, b: float) -> Signal | None:
        if signal is None:
            return None
        inside = (signal.time >= a) & (signal.time <= b)
        return Signal(signal.time[inside], signal.values[inside])

    names = ("accelerometer", "linear_acceleration", "gyroscope")
    return [replace(recording, **{name: part(getattr(recording, name), *span) for name in names}) for span in spans]


@dataclass(frozen=True)
class GaitSignals(OneLineRepr):
    """Attitude, landings and walking direction of an uninterrupted part of a recording."""

    recording: Recording
    attitude: Attitude
    landings: Landings
    direction: Direction

    def _summary(self) -> list[str]:
        return [repr(self.attitude), count(len(self.landings), "landing")]

    def pieces(self, duration: float) -> Iterator[GaitSignals]:
        """Yield consecutive pieces of about so many seconds."""
        size = max(1, round(duration / self.attitude.period))
        course, landings, landed = self.direction, self.landings, 0
        for first in range(0, len(self.attitude.time), size):
            part = slice(first, first + size)
            attitude, before = self.attitude[part], landed
            landed = int(np.searchsorted(landings.time, attitude.time[-1], side="right"))
            direction = Direction(course.heading[part], course.variance[part])
            yield GaitSignals(self.recording, attitude, landings[before:landed], direction)

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
    if not isinstance(recording, Recording):
        return recording
    parts = []
    for part in uninterrupted(recording):
        attitude = attitude_of(part)
        landings = walking_steps(attitude.time, attitude.acceleration)
        parts.append(GaitSignals(part, attitude, landings, walking_direction(attitude, landings.usual_step)))
    return parts
