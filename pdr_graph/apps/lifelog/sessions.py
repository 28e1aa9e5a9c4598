"""Group the recordings of a day into sessions, one per outing, and join a session's recordings to one walk with gaps.

Consecutive recordings with short gaps and compatible frames are one session. If a recorder is restarted within seconds,
the walker usually stood still: this is a robust loop closure, which is rejected if the rest of the walk contradicts it.
The turn of the walker during the gap follows from the magnetic field, which does not change at one place.
"""

from __future__ import annotations

from bisect import bisect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, pairwise

import numpy as np

from pdr_graph.apps.lifelog.facts import SHORTEST_FLIGHT
from pdr_graph.apps.lifelog.observation import MIN_POSITIONS, Observation, in_frame, shifted
from pdr_graph.apps.lifelog.stays_and_legs import arc, on_sphere
from pdr_graph.errors import count
from pdr_graph.frames import Frame, enu
from pdr_graph.gait.step_chunks import concatenate_steps, gap
from pdr_graph.priors import FIXES, TRACK
from pdr_graph.types import (
    Array,
    Closures,
    Fixes,
    Headings,
    OneLineRepr,
    Sightings,
    Table,
    by_type,
    concatenate,
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
        last = self.parts[-1][1]
        return last.epoch + last.duration

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


def _consecutive(parts: Sequence[Hashed]) -> list[Session]:
    """Group consecutive recordings that follow within LONGEST_SESSION_GAP, on one plan or without a plan.

    Their frames are equal or can be converted.
    """
    found: list[Session] = []
    for name, observation in parts:
        last, follows = found[-1] if found else None, False
        if last is not None:
            frames = [part.frame for part in (*last.observations, observation) if is_located(part)]
            follows = observation.epoch - last.end <= LONGEST_SESSION_GAP
            follows &= last.parts[-1][1].plan == observation.plan
            follows &= all(f.georeferenced for f in frames) or all(f == observation.frame for f in frames)
        # longest overlap [s] of two consecutive recordings
        if last is not None and observation.epoch < last.end - 1.0 and observation.steps is not None:
            note = f"{observation.source}: left out: it overlaps {last.parts[-1][1].source} in time"
            found[-1] = replace(last, notes=(*last.notes, note))
        elif last is not None and follows:
            found[-1] = replace(last, parts=(*last.parts, (name, observation)))
        else:
            found.append(Session(((name, observation),)))
    return found


def _assign_positions(
    name: str, observation: Observation, walks: Sequence[Session]
) -> tuple[list[Session], list[Hashed]]:
    """Assign positions to the walks of their time; returns the walks, and the positions between walks."""
    time = observation.epoch + observation.fixes.time
    spans = np.array([(walk.epoch, walk.end) for walk in walks]).reshape(-1, 2)
    during = [(time >= begin) & (time <= end) for begin, end in spans]
    assigned = [
        replace(walk, beside=(*walk.beside, (name, replace(observation, fixes=observation.fixes[rows]))))
        if rows.any()
        else walk
        for walk, rows in zip(walks, during, strict=True)
    ]
    rest = np.flatnonzero(~np.any([np.zeros(len(time), bool), *during], axis=0))
    between = list[Hashed]()
    for rows in np.split(rest, np.flatnonzero(np.diff(np.searchsorted(spans[:, 0], time[rest]))) + 1):
        if len(rows) >= MIN_POSITIONS:
            fixes = observation.fixes[rows]
            begin, end = float(fixes.time[0]), float(fixes.time[-1])
            moved = {"epoch": observation.epoch + begin, "duration": end - begin, "fixes": fixes.shifted(-begin)}
            between.append((name, replace(observation, **moved)))
    return assigned, between


# A recorder that was restarted by somebody who stood still
LONGEST_RESTART = 20.0  # [s] between the recordings; chosen by hand
STANDING_SIGMA = 0.5  # [m] per axis by which a person moves on one spot; chosen by hand
TURN_SIGMA = 0.2  # [rad] of a turn by the field: 9° rms over 9 restarts in malls, and one in ten may have walked on


def join(parts: Sequence[Observation], beside: Sequence[Observation] = (), frame: Frame | None = None) -> Observation:
    """Join recordings one after the other, and recordings of positions alone from the same time, to one.

    parts: at least one, in order of time, without overlap, all with steps or all without, in frames that can be
    converted to one; frame: of the result, by default as of `frame_of`. Without profile, notes and magnetic field.
    """
    frame, epoch = frame or frame_of([*parts, *beside]), parts[0].epoch
    moved = [shifted(in_frame(part, frame), part.epoch - epoch) for part in parts]
    every = [*moved, *(shifted(in_frame(part, frame), part.epoch - epoch) for part in beside)]
    steps = moved[0].steps
    for (before, after), later in zip(pairwise(parts), moved[1:], strict=True):
        if steps is not None and later.steps is not None:
            between = gap(steps.end, later.steps.start)
            turn = turn_by_field(before, after)
            if between.end - between.start <= LONGEST_RESTART and turn is not None:
                between = gap(between.start, between.end, turn, TURN_SIGMA)
            steps = concatenate_steps((steps, between, later.steps))
    # Headings of different recordings share most of their error, so those of n recordings get √n times the sigma
    some = [part.headings for part in moved if len(part.headings)]
    headings = [replace(headings, sigma=headings.sigma * np.sqrt(len(some))) for headings in some]
    beacons = (part.beacons for part in moved if part.beacons is not None)
    tables = by_type([table for part in every for table in part.measurements])
    return replace(
        moved[0],
        duration=max(part.epoch - epoch + part.duration for part in parts),
        steps=steps,
        looks=np.concatenate([part.looks for part in parts]),  # the last value of a part is that before the gap
        headings=Headings.concatenate(headings),
        fixes=Fixes.concatenate([part.fixes for part in every]),
        barometer=_concatenated([part.barometer for part in moved]),
        bluetooth=_concatenated([_with_minor(part.bluetooth) for part in moved]),
        wifi=_concatenated([part.wifi for part in moved]),
        beacons=next(beacons, None),
        ends=None,
        profile=None,
        notes=(),
        measurements=tuple(take(table, np.argsort(last_time(table), kind="stable")) for table in tables),
        stated=tuple(dict.fromkeys(activity for part in parts for activity in part.stated)),
    )


LARGEST_FRAME = 1_000_000.0  # [m] from the origin of a frame: distances are right to 0.4 % there


def local_parts(part: Observation) -> list[Observation]:
    """Positions alone, divided at jumps such as flights, and where they are far from where their frame begins.

    Each part but the first has a frame about its first position, with distances and north of its own. Single positions
    between two jumps are left out.
    """
    if not part.frame.georeferenced or part.plan:
        return [part]
    from pdr_graph.estimation.gps_track import plausible  # imports scipy, which a diary of done days does not need

    used = plausible(part.fixes)
    time, lonlat = part.fixes.time[used], part.frame.to_lonlat(part.fixes.position[used])
    sphere = on_sphere(lonlat)
    jumps = np.flatnonzero(arc(np.linalg.norm(np.diff(sphere, axis=0), axis=1)) > SHORTEST_FLIGHT)
    spans = list[tuple[int, int]]()
    for first, last in zip([0, *(jumps + 1).tolist()], [*jumps.tolist(), len(time) - 1], strict=True):
        while True:
            far = arc(np.linalg.norm(sphere[first : last + 1] - sphere[first], axis=1))
            if not (far > LARGEST_FRAME).any():
                break
            spans.append((first, first + int(np.argmax(far > LARGEST_FRAME)) - 1))
            first = spans[-1][1]
        spans.append((first, last))
    found = list[Observation]()
    for first, last in spans:
        begin, end = float(time[first]), float(time[last])
        # a frame far from all of a part is that of a position during a flight
        keeps = np.hypot(*part.fixes.position[used[first]]) < SHORTEST_FLIGHT
        if len(spans) == 1 and keeps:
            return [part]
        rows = np.flatnonzero((part.fixes.time >= begin) & (part.fixes.time <= end))
        if last - first + 1 >= MIN_POSITIONS:
            frame = part.frame if keeps else enu(*lonlat[first, ::-1].tolist())
            own = in_frame(replace(part, fixes=part.fixes[rows]), frame)
            found.append(replace(shifted(own, -begin), duration=end - begin))
    return found or [part]


def _concatenated(tables: Sequence[Table | None]) -> Table | None:
    """The tables of all recordings as one; None without any."""
    some = [table for table in tables if table is not None]
    return concatenate(some) if some else None


def _with_minor(received: Sightings | None) -> Sightings | None:
    """The receptions with a minor number each, empty where the log has none."""
    return received and replace(received, minor=received.minor or ("",) * len(received))


def is_located(part: Observation) -> bool:
    """True if there are fixes, or measurements of positions in the frame, as ranges to anchors are."""
    return len(part.fixes) > 0 or any(hasattr(table, "position") for table in part.measurements)


def frame_of(parts: Sequence[Observation]) -> Frame:
    """The first georeferenced frame, else the first one with positions in it, else the first."""
    georeferenced = (part.frame for part in parts if part.frame.georeferenced)
    return next(georeferenced, next((part.frame for part in parts if is_located(part)), parts[0].frame))


def turn_by_field(before: Observation, after: Observation) -> float | None:
    """Turn of a person on the spot between two recordings [rad]; None if the field does not determine it."""
    if before.ends is None or after.ends is None:
        return None
    field = np.array([before.ends.field[1], after.ends.field[0]])
    vertical = np.array([before.ends.vertical[1], after.ends.vertical[0]])
    horizontal, (first, second) = np.hypot(*field.T), field @ [1, 1j]
    mean = np.hypot(horizontal, vertical).mean()
    # field tolerance: relative difference of the field at two moments on one spot, half a metre apart indoors
    # least field [µT]: horizontally; a weaker field has no direction
    if horizontal.min() < 10.0 or np.hypot(np.ptp(horizontal), np.ptp(vertical)) > 0.3 * mean:
        return None
    return float(np.angle(first * second.conjugate()))


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


FEWEST_RETURNS, LEAST_SHARE = 10, 0.01  # of positions that lead there and back: a receiver that starts has a few


def doubted_positions(time: Array, position: Array, sigma: Array, sources: Sequence[str]) -> tuple[str, ...]:
    """A line if many positions lead back and forth faster than anybody goes on the ground, else none.

    time: ``(n,)`` [s], in order; position: ``(n, 2)`` [m]; sigma: ``(n,)`` per axis [m]; sources: where they are from.
    """
    way = np.diff(position, axis=0)
    error = FIXES.outlier * (sigma[1:] + sigma[:-1])
    fast = np.hypot(*way.T) > TRACK.fastest * (np.diff(time) + 1.0) + error  # times may be whole seconds
    back = fast[1:] & fast[:-1] & (np.einsum("ij,ij->i", way[1:], way[:-1]) < 0)
    if (returns := int(back.sum())) < max(FEWEST_RETURNS, LEAST_SHARE * len(time)):
        return ()
    fastest = f"{3.6 * TRACK.fastest:.0f} km/h"
    text = f"doubtful: {returns} of {len(time)} positions lead back and forth faster than {fastest}"
    return (f"{text}: of two persons or devices? From {', '.join(dict.fromkeys(sources))}",)
