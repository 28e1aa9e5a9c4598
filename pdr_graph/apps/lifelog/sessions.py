"""Group the recordings of a day into sessions, one per outing, and join a session's recordings to one walk with gaps.

Consecutive recordings with short gaps and compatible frames are one session. If a recorder is restarted within seconds,
the walker usually stood still: this is a robust loop closure, which is rejected if the rest of the walk contradicts it.
The turn of the walker during the gap follows from the magnetic field, which does not change at one place.
"""

from __future__ import annotations

from bisect import bisect
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, pairwise
from typing import Any

import numpy as np

from pdr_graph.apps.lifelog.observation import MIN_POSITIONS, Observation, StatedActivity, in_frame, shifted
from pdr_graph.errors import count
from pdr_graph.frames import Frame
from pdr_graph.gait.step_chunks import append_steps, gap
from pdr_graph.priors import MOTION
from pdr_graph.types import (
    Array,
    Closures,
    Fixes,
    Headings,
    Index,
    OneLineRepr,
    Sightings,
    Signal,
    Steps,
    by_type,
    last_time,
    take,
)

# Chosen by hand
LONGEST_SESSION_GAP = 600.0  # [s] between two recordings of one session; after a longer one the walker may be anywhere

Hashed = tuple[str, Observation]  # an observation with the content hash of its recording


@dataclass(frozen=True)
class Session(OneLineRepr):
    """The recordings of one outing, in order of time, each with its content hash.

    parts: the recordings that follow one another; beside: recordings of positions alone from the same time; notes:
    which recordings were left out.
    """

    parts: tuple[Hashed, ...]
    beside: tuple[Hashed, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def observations(self) -> list[Observation]:
        """Observations of the recordings that follow one another, in time order."""
        return [observation for _, observation in self.parts]

    @property
    def hashes(self) -> tuple[str, ...]:
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

    def _summary(self) -> list[str]:
        beside = [f"{len(self.beside)} beside"] if self.beside else []
        return [count(len(self.parts), "recording"), *beside, f"{self.end - self.epoch:.1f} s"]


def sessions_of(observations: Mapping[str, Observation]) -> list[Session]:
    """Group the recordings of a day into sessions, in time order; observations: by content hash.

    Positions of a recording without steps (a watch) from the time of a walk become fixes of that walk. Of recordings
    with steps that overlap in time, the earlier one is used.
    """
    ordered = sorted(observations.items(), key=lambda item: (item[1].epoch, item[0]))
    walks = list(_consecutive([item for item in ordered if item[1].steps is not None]))
    rest: list[Hashed] = []
    for name, observation in ordered:
        if observation.steps is None:
            walks, unassigned = _assign_positions(name, observation, walks)
            rest += unassigned
    begins = [walk.epoch for walk in walks]
    between = groupby(sorted(rest, key=lambda item: item[1].epoch), lambda item: bisect(begins, item[1].epoch))
    tracks = [session for _, parts in between for session in _consecutive(list(parts))]
    return sorted([*walks, *tracks], key=lambda session: session.epoch)


def end_of(observation: Observation) -> float:
    """Unix time of a recording's end [s]."""
    return observation.epoch + observation.duration


def _consecutive(parts: Sequence[Hashed]) -> Iterator[Session]:
    """Group consecutive recordings with short gaps, on one plan or without a plan."""
    session: Session | None = None
    for name, observation in parts:
        # longest overlap [s] of two consecutive recordings
        if session is not None and observation.epoch < session.end - 1.0 and observation.steps is not None:
            note = f"{observation.source}: left out: it overlaps {session.parts[-1][1].source} in time"
            session = replace(session, notes=(*session.notes, note))
        elif session is not None and _continues(session, observation):
            session = replace(session, parts=(*session.parts, (name, observation)))
        else:
            if session is not None:
                yield session
            session = Session(((name, observation),))
    if session is not None:
        yield session


def _continues(session: Session, observation: Observation) -> bool:
    """True if a recording follows within LONGEST_SESSION_GAP, on the same plan, in a frame that can be converted."""
    frames = [part.frame for part in (*session.observations, observation) if is_located(part)]
    convertible = all(frame.georeferenced for frame in frames) or all(frame == observation.frame for frame in frames)
    same_plan = session.parts[-1][1].plan == observation.plan
    return observation.epoch - session.end <= LONGEST_SESSION_GAP and same_plan and convertible


def _assign_positions(
    name: str, observation: Observation, walks: Sequence[Session]
) -> tuple[list[Session], list[Hashed]]:
    """Assign positions to the walks of their time; returns the walks, and the positions between walks."""
    time = observation.epoch + observation.fixes.time
    spans = np.array([(walk.epoch, walk.end) for walk in walks]).reshape(-1, 2)
    during = [np.flatnonzero((time >= begin) & (time <= end)) for begin, end in spans]
    assigned = [
        replace(walk, beside=(*walk.beside, (name, replace(observation, fixes=observation.fixes[rows]))))
        if len(rows)
        else walk
        for walk, rows in zip(walks, during, strict=True)
    ]
    rest = np.setdiff1d(np.arange(len(time)), np.concatenate([np.empty(0, int), *during]))
    walks_before = np.searchsorted(spans[:, 0], time[rest])
    runs = np.split(rest, np.flatnonzero(np.diff(walks_before)) + 1)
    return assigned, [(name, _with_fixes(observation, rows)) for rows in runs if len(rows) >= MIN_POSITIONS]


def _with_fixes(observation: Observation, rows: Index) -> Observation:
    """Some rows of a recording of positions, as a recording that begins with the first of them."""
    fixes = observation.fixes[rows]
    begin, end = float(fixes.time[0]), float(fixes.time[-1])
    return replace(observation, epoch=observation.epoch + begin, duration=end - begin, fixes=fixes.shifted(-begin))


# A recorder that was restarted by somebody who stood still
LONGEST_RESTART = 20.0  # [s] between the recordings; chosen by hand
STANDING_SIGMA = 0.5  # [m] per axis by which a person moves on one spot; chosen by hand
TURN_SIGMA = 0.2  # [rad] of a turn by the field: 9° rms over 9 restarts in malls, and one in ten may have walked on


def join(parts: Sequence[Observation], beside: Sequence[Observation] = (), frame: Frame | None = None) -> Observation:
    """Join recordings with steps, one after the other, and recordings of positions alone from the same time, to one.

    parts: at least one, in order of time, without overlap, in frames that can be converted to one; frame: of the
    result, by default as of `frame_of`. Without profile, notes and magnetic field.
    """
    frame = frame or frame_of([*parts, *beside])
    moved = [_moved(part, frame, parts[0].epoch) for part in parts]
    others = [_moved(part, frame, parts[0].epoch) for part in beside]
    steps = moved[0].walked
    for (before, after), later in zip(pairwise(parts), (part.walked for part in moved[1:]), strict=True):
        steps = append_steps(append_steps(steps, _gap_between(before, after, steps.end, later.start)), later)
    return replace(
        moved[0],
        duration=max(part.epoch - parts[0].epoch + part.duration for part in parts),
        steps=steps,
        looks=np.concatenate([part.looks for part in parts]),  # the last value of a part is that before the gap
        headings=_headings([part.headings for part in moved]),
        fixes=Fixes.concatenate([part.fixes for part in (*moved, *others)]),
        barometer=_signal([part.barometer for part in moved]),
        bluetooth=_sightings([part.bluetooth for part in moved]),
        wifi=_sightings([part.wifi for part in moved]),
        beacons=next((part.beacons for part in moved if part.beacons is not None), None),
        ends=None,
        profile=None,
        notes=(),
        measurements=_measurements([table for part in (*moved, *others) for table in part.measurements]),
        stated=tuple(dict.fromkeys(activity for part in parts for activity in part.stated)),
    )


def _moved(part: Observation, frame: Frame, epoch: float) -> Observation:
    """The observation in a frame, with times from a Unix time `epoch` [s]."""
    return shifted(in_frame(part, frame), part.epoch - epoch)


def join_fixes(parts: Sequence[Observation]) -> tuple[Frame, Fixes]:
    """Fixes of recordings one after the other in one frame, times from the start of the first; and that frame."""
    frame = frame_of(parts)
    return frame, Fixes.concatenate([_moved(part, frame, parts[0].epoch).fixes for part in parts])


def is_located(part: Observation) -> bool:
    """True if there are fixes, or measurements of positions in the frame, as ranges to anchors are."""
    return len(part.fixes) > 0 or any(hasattr(table, "position") for table in part.measurements)


def join_stated(parts: Sequence[Observation]) -> tuple[StatedActivity, ...]:
    """The activities stated for recordings, times from the start of the first; each once, in their order."""
    stated = dict.fromkeys(activity for part in parts for activity in part.stated)
    return tuple((start - parts[0].epoch, end - parts[0].epoch, kind) for start, end, kind in stated)


def frame_of(parts: Sequence[Observation]) -> Frame:
    """The first georeferenced frame, else the first one with positions in it, else the first."""
    georeferenced = (part.frame for part in parts if part.frame.georeferenced)
    return next(georeferenced, next((part.frame for part in parts if is_located(part)), parts[0].frame))


def _measurements(tables: Sequence[Any]) -> tuple[Any, ...]:
    """The tables of all recordings, one per type, in order of time."""
    return tuple(take(table, np.argsort(last_time(table), kind="stable")) for table in by_type(tables))


def _gap_between(before: Observation, after: Observation, start: float, end: float) -> Steps:
    """The gap between two recordings as a row of steps, from `start` to `end` [s]."""
    if end - start > LONGEST_RESTART:
        return gap(start, end)
    turn = turn_by_field(before, after)
    turn_and_sigma = (0.0, MOTION.gap_turn) if turn is None else (turn, TURN_SIGMA)
    return gap(start, end, *turn_and_sigma)


def turn_by_field(before: Observation, after: Observation) -> float | None:
    """Turn of a person on the spot between two recordings [rad]; None if the field does not determine it."""
    if before.ends is None or after.ends is None:
        return None
    first, second = _field_at(before, 1), _field_at(after, 0)
    horizontal = np.hypot(*first[:2]), np.hypot(*second[:2])
    mean = (np.linalg.norm(first) + np.linalg.norm(second)) / 2
    difference = np.hypot(horizontal[0] - horizontal[1], first[2] - second[2])
    # field tolerance: relative difference of the field at two moments on one spot, half a metre apart indoors
    # least field [µT]: horizontally; a weaker field has no direction
    if min(horizontal) < 10.0 or difference > 0.3 * mean:
        return None
    return float(np.angle((first[0] + 1j * first[1]) * (second[0] - 1j * second[1])))


def _field_at(part: Observation, end: int) -> Array:
    """Field ``(3,)`` forward, left and up at a recording's start (0) or end (1) [µT]."""
    assert part.ends is not None, "the caller has checked it"
    return np.append(part.ends.field[end], part.ends.vertical[end])


def restart_closures(parts: Sequence[Observation]) -> Closures:
    """Loop closures between recordings of a recorder that was restarted within LONGEST_RESTART.

    Times are from the start of the first recording.
    """
    rows = []
    for before, after in pairwise(parts):
        stopped = before.epoch - parts[0].epoch + before.walked.end
        started = after.epoch - parts[0].epoch + after.walked.start
        if started - stopped <= LONGEST_RESTART:
            rows.append((stopped, started, STANDING_SIGMA))
    return Closures.of(rows)


def _headings(parts: Sequence[Headings]) -> Headings:
    """Headings of all recordings.

    Headings of different recordings share most of their error, so those of n recordings get √n times the sigma.
    """
    some = [headings for headings in parts if len(headings)]
    return Headings.concatenate([replace(headings, sigma=headings.sigma * np.sqrt(len(some))) for headings in some])


def _signal(parts: Sequence[Signal | None]) -> Signal | None:
    """Signals of all recordings as one; None without any."""
    some = [signal for signal in parts if signal is not None]
    if not some:
        return None
    return Signal(np.concatenate([signal.time for signal in some]), np.concatenate([signal.values for signal in some]))


def _sightings(parts: Sequence[Sightings | None]) -> Sightings | None:
    """Sightings of all recordings as one; None without any."""
    some = [sightings for sightings in parts if sightings is not None]
    if not some:
        return None
    minor = tuple(m for sightings in some for m in (sightings.minor or ("",) * len(sightings)))
    return Sightings(
        np.concatenate([sightings.time for sightings in some]),
        tuple(name for sightings in some for name in sightings.transmitter),
        np.concatenate([sightings.rssi for sightings in some]),
        minor if any(minor) else (),
    )
