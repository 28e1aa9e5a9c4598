"""Recordings that follow one another become one walk, with an honest gap between each two.

A recorder that is stopped and started again a few seconds later was handled by somebody who stood still: a robust loop
closure says so, and lets go where the rest of the walk contradicts it. Which way they turned meanwhile the magnetic
field tells: it is another at every place of a building, and at one place the same before and after.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from pdr_graph.estimation.closures import Closures
from pdr_graph.frames import Frame
from pdr_graph.gait.gaps import SIGMA_TURN, follow, gap, later
from pdr_graph.lifelog.observation import Observation
from pdr_graph.types import Array, Beacons, Fixes, Headings, Sightings, Signal, Steps

RESTART = 20.0  # [s] within which a recorder was started again by somebody who stood still
STOOD = 0.5  # [m] per axis by which a person moves on one spot
ALIKE = 0.3  # share of the field by which it may differ at two moments on one spot, half a metre apart indoors
FIELD_SIGMA = 0.2  # [rad] of a turn by the field: 9° rms over 9 restarts in malls, and one in ten may have walked on
LEAST_FIELD = 10.0  # [µT] horizontally, below which it points nowhere


@dataclass(frozen=True)
class Joined:
    """Recordings as one walk, times from the first one's start; fields as of `Observation`.

    closures: where they stood.
    """

    epoch: float
    duration: float
    frame: Frame
    steps: Steps
    looks: Array
    headings: Headings
    fixes: Fixes
    closures: Closures
    barometer: Signal | None
    bluetooth: Sightings | None
    wifi: Sightings | None
    beacons: Beacons | None


def joined(parts: Sequence[Observation], fixes: Sequence[Observation] = (), in_frame: Frame | None = None) -> Joined:
    """Recordings with steps, one after the other, and others with positions alone of the same time.

    parts: at least one, in order of time, none overlapping, in frames that can be brought into one; in_frame: that
    one, if it is not to be their own.
    """
    first, frame = parts[0], in_frame or frame_of([*parts, *fixes])
    shift = [part.epoch - first.epoch for part in parts]
    steps = later(_steps(first), 0.0)
    for (before, after), by in zip(pairwise(parts), shift[1:], strict=True):
        own = later(_steps(after), by)
        steps = follow(follow(steps, _between(before, after, steps.end, own.start)), own)
    return Joined(
        epoch=first.epoch,
        duration=max(part.epoch - first.epoch + part.duration for part in parts),
        frame=frame,
        steps=steps,
        looks=np.concatenate([part.looks for part in parts]),  # what ends one is before its gap
        headings=_headings([(part.headings, by) for part, by in zip(parts, shift, strict=True)]),
        fixes=Fixes.together([fixes_in(frame, part).later(part.epoch - first.epoch) for part in (*parts, *fixes)]),
        closures=_stops(parts, shift),
        barometer=_signal([(part.barometer, by) for part, by in zip(parts, shift, strict=True)]),
        bluetooth=_sightings([(part.bluetooth, by) for part, by in zip(parts, shift, strict=True)]),
        wifi=_sightings([(part.wifi, by) for part, by in zip(parts, shift, strict=True)]),
        beacons=next((part.beacons for part in parts if part.beacons is not None), None),
    )


def frame_of(parts: Sequence[Observation]) -> Frame:
    """The first one's that has one on earth, else any that has positions."""
    georeferenced = (part.frame for part in parts if part.frame.georeferenced)
    return next(georeferenced, next((part.frame for part in parts if len(part.fixes)), parts[0].frame))


def fixes_in(frame: Frame, part: Observation) -> Fixes:
    """The positions of a recording in another frame, which must be on earth if they are in one."""
    if not len(part.fixes):
        return part.fixes
    return replace(part.fixes, position=frame.from_frame(part.frame, part.fixes.position))


def joined_fixes(parts: Sequence[Observation]) -> tuple[Frame, Fixes]:
    """The positions of recordings one after the other, in one frame, times from the first one's start."""
    frame = frame_of(parts)
    return frame, Fixes.together([fixes_in(frame, part).later(part.epoch - parts[0].epoch) for part in parts])


def _steps(part: Observation) -> Steps:
    assert part.steps is not None, "a recording with steps"
    return part.steps


def _between(before: Observation, after: Observation, start: float, end: float) -> Steps:
    """What nobody recorded between two recordings. [s]"""
    if end - start > RESTART:
        return gap(start, end)
    turn = turn_by_field(before, after)
    known = (0.0, SIGMA_TURN) if turn is None else (turn, FIELD_SIGMA)
    return gap(start, end, *known)


def turn_by_field(before: Observation, after: Observation) -> float | None:
    """How far somebody turned on the spot between two recordings [rad]; None if the field cannot tell."""
    if before.ends is None or after.ends is None:
        return None
    one, other = _field(before, 1), _field(after, 0)
    level = np.hypot(*one[:2]), np.hypot(*other[:2])
    usual = (np.linalg.norm(one) + np.linalg.norm(other)) / 2
    apart = np.hypot(level[0] - level[1], one[2] - other[2])
    if min(level) < LEAST_FIELD or apart > ALIKE * usual:
        return None
    return float(np.angle((one[0] + 1j * one[1]) * (other[0] - 1j * other[1])))


def _field(part: Observation, end: int) -> Array:
    """Ahead, to the left and up ``(3,)`` at a recording's start (0) or end (1). [µT]"""
    assert part.ends is not None, "asked for with one"
    return np.append(part.ends.field[end], part.ends.vertical[end])


def _stops(parts: Sequence[Observation], shift: Sequence[float]) -> Closures:
    """Where the recorder was started again by somebody who stood."""
    found = []
    for (before, after), begin, end in zip(pairwise(parts), shift, shift[1:], strict=False):
        ends, begins = begin + _steps(before).end, end + _steps(after).start
        if begins - ends <= RESTART:
            found.append((ends, begins, STOOD))
    return Closures.of(found)


def _headings(parts: Sequence[tuple[Headings, float]]) -> Headings:
    """Those of all recordings. They share most of their error, so that all together weigh as the best recording's."""
    told = [own.later(by) for own, by in parts if len(own)]
    return Headings.together([replace(own, sigma=own.sigma * np.sqrt(len(told))) for own in told])


def _signal(parts: Sequence[tuple[Signal | None, float]]) -> Signal | None:
    told = [(own, by) for own, by in parts if own is not None]
    if not told:
        return None
    return Signal(np.concatenate([own.time + by for own, by in told]), np.concatenate([own.values for own, _ in told]))


def _sightings(parts: Sequence[tuple[Sightings | None, float]]) -> Sightings | None:
    told = [(own, by) for own, by in parts if own is not None]
    if not told:
        return None
    minor = tuple(m for own, _ in told for m in (own.minor or ("",) * len(own)))
    return Sightings(
        np.concatenate([own.time + by for own, by in told]),
        tuple(name for own, _ in told for name in own.transmitter),
        np.concatenate([own.rssi for own, _ in told]),
        minor if any(minor) else (),
    )
