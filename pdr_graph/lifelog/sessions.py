"""Group recordings of a day into outings, and join the recordings of an outing to one walk with gaps.

Consecutive recordings with short gaps and compatible frames are one outing. If a recorder restarts within seconds, the
walker usually stood still. This is a robust loop closure, which is rejected if the rest of the walk contradicts it. The
turn of the walker during the gap follows from the magnetic field, which does not change at one place.
"""

from __future__ import annotations

from bisect import bisect
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, pairwise
from typing import Any, TypeVar

import numpy as np

from pdr_graph.columns import OneLineRepr
from pdr_graph.frames import Frame
from pdr_graph.gait.steps import GAP_SIGMA_TURN, append_steps, gap, shifted
from pdr_graph.lifelog.observation import FEWEST, Observation
from pdr_graph.measurements import Closures, by_type, last_time, take, with_offset
from pdr_graph.types import Array, Beacons, Fixes, Headings, Sightings, Signal, Steps

LONGEST_GAP = 600.0  # [s] between recordings of one outing: after more, the walker may be anywhere
OVERLAP = 1.0  # [s] by which consecutive recordings may overlap

Named = tuple[str, Observation]
Located = TypeVar("Located", bound=Any)


@dataclass(frozen=True)
class Group:
    """The recordings of one outing, in order of time, each with its content hash.

    beside: recordings with positions only from the same time; notes: recordings left out.
    """

    parts: tuple[Named, ...]
    beside: tuple[Named, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def observations(self) -> list[Observation]:
        """Observations of the recordings, in time order."""
        return [one for _, one in self.parts]

    @property
    def names(self) -> tuple[str, ...]:
        """Content hashes of all recordings."""
        return tuple(dict.fromkeys(name for name, _ in (*self.parts, *self.beside)))

    @property
    def epoch(self) -> float:
        """Unix time of its start [s]."""
        return self.parts[0][1].epoch

    @property
    def end(self) -> float:
        """Unix time of its end [s]."""
        return end_of(self.parts[-1][1])


def groups_of(observations: Mapping[str, Observation]) -> list[Group]:
    """Group the recordings of a day into outings, in time order.

    Recordings with positions only (a watch) during a walk become fixes of that walk. Of recordings with steps that
    overlap in time, the earlier one is used.
    """
    ordered = sorted(observations.items(), key=lambda item: (item[1].epoch, item[0]))
    walks = list(_consecutive([item for item in ordered if item[1].steps is not None]))
    alone: list[Named] = []
    for name, one in ordered:
        if one.steps is None:
            walks, rest = _shared_out(name, one, walks)
            alone += rest
    begins = [walk.epoch for walk in walks]
    between = groupby(sorted(alone, key=lambda item: item[1].epoch), lambda item: bisect(begins, item[1].epoch))
    return sorted([*walks, *(group for _, own in between for group in _consecutive(list(own)))], key=_epoch)


def _epoch(group: Group) -> float:
    return group.epoch


def end_of(one: Observation) -> float:
    """Unix time of a recording's end [s]."""
    return one.epoch + one.duration


def _consecutive(parts: Sequence[Named]) -> Iterator[Group]:
    """Group consecutive recordings with short gaps, on one plan or without a plan."""
    group: Group | None = None
    for name, one in parts:
        if group is not None and one.epoch < group.end - OVERLAP and one.steps is not None:
            note = f"{one.source}: left out: it overlaps {group.parts[-1][1].source} in time"
            group = replace(group, notes=(*group.notes, note))
        elif group is not None and _follows(group, one):
            group = replace(group, parts=(*group.parts, (name, one)))
        else:
            if group is not None:
                yield group
            group = Group(((name, one),))
    if group is not None:
        yield group


def _follows(group: Group, one: Observation) -> bool:
    last = group.parts[-1][1]
    placed = [part for part in (*group.observations, one) if is_located(part)]
    one_frame = all(part.frame.georeferenced for part in placed) or all(part.frame == one.frame for part in placed)
    return one.epoch - group.end <= LONGEST_GAP and last.plan == one.plan and one_frame


def _shared_out(name: str, one: Observation, walks: Sequence[Group]) -> tuple[list[Group], list[Named]]:
    """Positions given to the walks of their time, and the stretches that are left."""
    time = one.epoch + one.fixes.time
    spans = np.array([(walk.epoch, walk.end) for walk in walks]).reshape(-1, 2)
    during = [np.flatnonzero((time >= begin) & (time <= end)) for begin, end in spans]
    given = [
        replace(walk, beside=(*walk.beside, (name, replace(one, fixes=one.fixes[own])))) if len(own) else walk
        for walk, own in zip(walks, during, strict=True)
    ]
    left = np.setdiff1d(np.arange(len(time)), np.concatenate([np.empty(0, int), *during]))
    before = np.searchsorted(spans[:, 0], time[left])
    stretches = np.split(left, np.flatnonzero(np.diff(before)) + 1)
    return given, [(name, _stretch(one, rows)) for rows in stretches if len(rows) >= FEWEST]


def _stretch(one: Observation, rows: np.ndarray) -> Observation:
    """Some of a recording's positions as one of its own."""
    fixes = one.fixes[rows]
    begin, end = float(fixes.time[0]), float(fixes.time[-1])
    shifted = replace(fixes, time=fixes.time - begin)
    return replace(one, epoch=one.epoch + begin, duration=end - begin, fixes=shifted)


RESTART = 20.0  # [s] within which a recorder was started again by somebody who stood still
STOOD = 0.5  # [m] per axis by which a person moves on one spot
ALIKE = 0.3  # share of the field by which it may differ at two moments on one spot, half a metre apart indoors
FIELD_SIGMA = 0.2  # [rad] of a turn by the field: 9° rms over 9 restarts in malls, and one in ten may have walked on
LEAST_FIELD = 10.0  # [µT] horizontally, below which it points nowhere


@dataclass(frozen=True)
class Joined(OneLineRepr):
    """Recordings as one walk, times from the first one's start; fields as of `Observation`.

    closures: between recordings of a recorder that was restarted on the spot.
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
    measurements: tuple[Any, ...] = ()

    def _summary(self) -> list[str]:
        others = [f"{len(table)} {type(table).__name__.lower()}" for table in self.measurements]
        return [f"{self.duration:.1f} s", repr(self.steps), repr(self.fixes), *others]


def joined(parts: Sequence[Observation], fixes: Sequence[Observation] = (), in_frame: Frame | None = None) -> Joined:
    """Recordings with steps, one after the other, and others with positions alone of the same time.

    parts: at least one, in order of time, none overlapping, in frames that can be brought into one; in_frame: that
    one, if it is not to be their own.
    """
    first, frame = parts[0], in_frame or frame_of([*parts, *fixes])
    shift = [part.epoch - first.epoch for part in parts]
    steps = shifted(_steps(first), 0.0)
    for (before, after), by in zip(pairwise(parts), shift[1:], strict=True):
        own = shifted(_steps(after), by)
        steps = append_steps(append_steps(steps, _between(before, after, steps.end, own.start)), own)
    return Joined(
        epoch=first.epoch,
        duration=max(part.epoch - first.epoch + part.duration for part in parts),
        frame=frame,
        steps=steps,
        looks=np.concatenate([part.looks for part in parts]),  # what ends one is before its gap
        headings=_headings([(part.headings, by) for part, by in zip(parts, shift, strict=True)]),
        fixes=_fixes([*parts, *fixes], frame),
        closures=_stops(parts, shift),
        barometer=_signal([(part.barometer, by) for part, by in zip(parts, shift, strict=True)]),
        bluetooth=_sightings([(part.bluetooth, by) for part, by in zip(parts, shift, strict=True)]),
        wifi=_sightings([(part.wifi, by) for part, by in zip(parts, shift, strict=True)]),
        beacons=_beacons(parts, frame),
        measurements=_measurements([*parts, *fixes], frame),
    )


def is_located(part: Observation | Joined) -> bool:
    """True if there are fixes, or measurements of positions in the frame, as ranges to anchors are."""
    return len(part.fixes) > 0 or any(hasattr(table, "position") for table in part.measurements)


def frame_of(parts: Sequence[Observation]) -> Frame:
    """The first georeferenced frame, else the first one with positions in it, else the first."""
    georeferenced = (part.frame for part in parts if part.frame.georeferenced)
    return next(georeferenced, next((part.frame for part in parts if is_located(part)), parts[0].frame))


def converted(table: Located, source: Frame, target: Frame) -> Located:
    """The table with its positions converted from one frame to another; both must be georeferenced unless equal."""
    if not hasattr(table, "position") or not len(table.position):
        return table
    return replace(table, position=target.from_frame(source, table.position))


def _fixes(parts: Sequence[Observation], frame: Frame) -> Fixes:
    """The fixes of all recordings in one frame, times from the start of the first recording."""
    begin = parts[0].epoch
    return Fixes.concatenate([converted(part.fixes, part.frame, frame).shifted(part.epoch - begin) for part in parts])


def _beacons(parts: Sequence[Observation], frame: Frame) -> Beacons | None:
    """The beacons of the first recording that has some, in one frame."""
    convertible = (part for part in parts if part.frame == frame or part.frame.georeferenced)
    return next((converted(p.beacons, p.frame, frame) for p in convertible if p.beacons is not None), None)


def _measurements(parts: Sequence[Observation], frame: Frame) -> tuple[Any, ...]:
    """The tables of all recordings, one per type, in one frame, in order of time from the start of the first."""
    tables = [
        with_offset(converted(table, part.frame, frame), part.epoch - parts[0].epoch)
        for part in parts
        for table in part.measurements
    ]
    return tuple(take(table, np.argsort(last_time(table), kind="stable")) for table in by_type(tables))


def joined_fixes(parts: Sequence[Observation]) -> tuple[Frame, Fixes]:
    """The positions of recordings one after the other, in one frame, times from the first one's start."""
    frame = frame_of(parts)
    return frame, _fixes(parts, frame)


def _steps(part: Observation) -> Steps:
    assert part.steps is not None, "a recording with steps"
    return part.steps


def _between(before: Observation, after: Observation, start: float, end: float) -> Steps:
    """Duration of the gap between two recordings [s]."""
    if end - start > RESTART:
        return gap(start, end)
    turn = turn_by_field(before, after)
    known = (0.0, GAP_SIGMA_TURN) if turn is None else (turn, FIELD_SIGMA)
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
    told = [own.shifted(by) for own, by in parts if len(own)]
    return Headings.concatenate([replace(own, sigma=own.sigma * np.sqrt(len(told))) for own in told])


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
