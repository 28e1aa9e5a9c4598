"""Data types of a lifelog (day, outing, segment, stay), slices of trajectories, and the rows of a day in the tables.

Times are seconds from an outing's ``epoch``, positions metres in its frame. A slice ends where a gap begins.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from pdr_graph.errors import count
from pdr_graph.frames import Frame
from pdr_graph.gait.walker import Profile
from pdr_graph.geometry import interpolate, length_along, nearest, wrap_angle
from pdr_graph.storage import compress, decode_json, decompress, encode_json
from pdr_graph.types import INSTANT, Array, OneLineRepr, Trajectory, time_span

WALKING, STANDING, VEHICLE, GAP = "walking", "standing", "vehicle", "gap"
ACTIVITIES = (STANDING, WALKING, VEHICLE, GAP)  # in the order of the numbers in `estimation.gps_track`


@dataclass(frozen=True)
class Segment(OneLineRepr):
    """A part of an outing with one activity; segments are contiguous.

    kind: one of ACTIVITIES; a gap has no data. start, end: [s]. distance: along the path [m], 0 for standing and for
    gaps (unknown). mode: what the person calls it, in an export whose times are moved; not stored.
    """

    kind: str
    start: float
    end: float
    distance: float
    mode: str = ""

    def _summary(self) -> list[str]:
        return [self.kind, f"{self.start:.1f} to {self.end:.1f} s", f"{self.distance:.0f} m"]


@dataclass(frozen=True)
class Stay(OneLineRepr):
    """A time at one place, or a slow pass by it.

    start, end: [s]; passing: True for a slow pass; position ``(2,)`` [m] with its covariance ``(2, 2)`` [m²]; heading:
    direction that the person faced [rad], NaN if unknown; floor: the plan's label, empty if unknown.
    facing: (name, probability) of the places that the person may have faced, most probable first; the remainder to 1
    is the probability of no named place. Empty without a plan.
    """

    start: float
    end: float
    passing: bool
    position: Array
    covariance: Array
    heading: float
    floor: str
    facing: tuple[tuple[str, float], ...] = ()

    def _summary(self) -> list[str]:
        x, y = self.position.tolist()
        names = [f"{self.facing[0][0]!r} {self.facing[0][1]:.0%}"] if self.facing else []
        kind = ["passing"] if self.passing else []
        return [*kind, f"{self.start:.1f} to {self.end:.1f} s", f"x {x:.1f} m, y {y:.1f} m", *names]


@dataclass(frozen=True)
class Outing(OneLineRepr):
    """One walk or ride of a person: consecutive recordings in one frame.

    recordings: content hashes, in order; source: name in messages; epoch: Unix time at 0 [s].
    frame: of all positions; plan: path of the floor plan, "" without one.
    trajectory: with covariance, as in ``Estimate``; segments: cover its whole duration; stays: in time order.
    steps: number of steps. notes: warnings, missing: results that could not be estimated, a line each.
    """

    recordings: tuple[str, ...]
    source: str
    epoch: float
    frame: Frame
    plan: str
    trajectory: Trajectory
    segments: tuple[Segment, ...]
    stays: tuple[Stay, ...]
    steps: int
    notes: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()

    def _summary(self) -> list[str]:
        parts = [count(len(self.segments), "segment"), count(len(self.stays), "stay"), count(self.steps, "step")]
        return [repr(self.source), *time_span(self.trajectory), *parts]


@dataclass(frozen=True)
class Day(OneLineRepr):
    """The outings of a person that began on one date.

    date: "2024-05-01", in the lifelog's time zone; profile: of the walker at the end of the day, None if unknown.
    """

    person: str
    date: str
    outings: tuple[Outing, ...]
    profile: Profile | None = None

    def _summary(self) -> list[str]:
        return [repr(self.person), self.date, count(len(self.outings), "outing")]

    def total(self, kind: str) -> tuple[float, float]:
        """Total time [s] and distance [m] of all segments of one kind."""
        own = [s for outing in self.outings for s in outing.segments if s.kind == kind]
        return float(np.sum([s.end - s.start for s in own])), float(np.sum([s.distance for s in own]))


PRIVATE = "private"  # kind of a segment that is hidden in an export
KINDS_WITHOUT_DATA = (GAP, PRIVATE)
Timed = TypeVar("Timed", Segment, Stay)


@dataclass(frozen=True)
class ExportedPart(OneLineRepr):
    """A part of an outing as it is exported; all times are Unix times [s]."""

    start: float
    end: float
    track: Trajectory
    segments: tuple[Segment, ...]
    stays: tuple[Stay, ...]

    def _summary(self) -> list[str]:
        return [f"{self.start:.1f} to {self.end:.1f} s", repr(self.track)]


def shift(item: Timed, by: float) -> Timed:
    """The segment or stay ``by`` seconds later."""
    return replace(item, start=item.start + by, end=item.end + by)


def split_at_gaps(outing: Outing) -> list[tuple[Trajectory, tuple[Segment, ...]]]:
    """Split an outing at its gaps: the rows and segments of each part without a gap."""
    found: list[list[Segment]] = [[]]
    for segment in outing.segments:
        if segment.kind == PRIVATE:  # a blurred part has rows too
            found += [[segment], []]
        elif segment.kind == GAP:
            found.append([])
        else:
            found[-1].append(segment)
    parts = [(_rows_of(outing.trajectory, segments), tuple(segments)) for segments in found if segments]
    return [(track, segments) for track, segments in parts if len(track)]


def without_gap_rows(outing: Outing) -> Trajectory:
    """The rows of an outing's trajectory, without those inside gaps."""
    track = outing.trajectory
    bridge = np.zeros(len(track), dtype=bool)
    for gap in (segment for segment in outing.segments if segment.kind == GAP):
        bridge |= (track.time > gap.start + INSTANT) & (track.time < gap.end - INSTANT)
    return track[~bridge] if bridge.any() else track


def _rows_of(track: Trajectory, segments: Sequence[Segment]) -> Trajectory:
    """Rows of consecutive segments; a private segment shares no row with its neighbours."""
    inside = 2 * INSTANT if segments[0].kind == PRIVATE else 0.0
    return rows_between(track, segments[0].start + inside, segments[-1].end - inside)


def rows_between(track: Trajectory, start: float, end: float) -> Trajectory:
    """Rows from ``start`` to ``end`` [s], both included."""
    first, last = np.searchsorted(track.time, [start - INSTANT, end + INSTANT])
    return track[int(first) : int(last)]


def clipped(track: Trajectory, start: float, end: float) -> Trajectory:
    """Clip a trajectory to ``start`` to ``end`` [s], with interpolated rows at both."""
    start, end = max(start, float(track.time[0])), min(end, float(track.time[-1]))
    rows = slice(*np.searchsorted(track.time, [start - INSTANT, end + INSTANT]).tolist())
    time = track.time[rows]
    if start > end or (len(time) and time[0] <= start + INSTANT and time[-1] >= end - INSTANT):
        return track[rows]
    between = time[(time > start + INSTANT) & (time < end - INSTANT)]
    return sampled(track, np.unique([start, *between, end]))


def sampled(track: Trajectory, time: Array) -> Trajectory:
    """Sample a trajectory at times ``(m,)`` [s]: linear between rows, heading and floor of the nearest row."""
    near = nearest(track.time, time)
    covariance = track.covariance
    if covariance is not None:
        covariance = interpolate(time, track.time, covariance.reshape(len(track), 9)).reshape(-1, 3, 3)
    floor = tuple(track.floor[i] for i in near)
    position = interpolate(time, track.time, track.position)
    return Trajectory(time, position, wrap_angle(track.heading[near]), floor, covariance)


def path_shares(track: Trajectory, time: Sequence[float]) -> Array:
    """Shares ``(m - 1,)`` of the path length in each interval between times ``(m,)`` [s], summing to 1."""
    way = np.interp(time, track.time, length_along(track.position))
    way = way if way[-1] > way[0] else np.asarray(time)
    return np.diff(way) / (way[-1] - way[0])


def floors_visited(track: Trajectory) -> tuple[str, ...]:
    """Labels of the floors visited, in order, without unknown ones and immediate repetitions."""
    known = [label for label in track.floor if label]
    return tuple(label for label, before in zip(known, ["", *known], strict=False) if label != before)


DAY_SCHEMA = (
    # key: of all that a day is made of; recordings: hashes, JSON
    "CREATE TABLE day (person TEXT, date TEXT, key TEXT, recordings TEXT, PRIMARY KEY (person, date))",
    # epoch: Unix time at 0 [s]; frame, recordings, notes and missing: JSON
    """CREATE TABLE outing (person TEXT, date TEXT, outing INTEGER, source TEXT, epoch REAL, steps INTEGER, plan TEXT,
        frame TEXT, recordings TEXT, notes TEXT, missing TEXT, PRIMARY KEY (person, date, outing))""",
    # start, stop: from the outing's epoch [s]; distance [m]
    """CREATE TABLE segment (person TEXT, date TEXT, outing INTEGER, segment INTEGER, kind TEXT, start REAL, stop REAL,
        distance REAL, PRIMARY KEY (person, date, outing, segment))""",
    # bytes: as of storage.compress
    """CREATE TABLE trajectory (person TEXT, date TEXT, outing INTEGER, bytes BLOB,
        PRIMARY KEY (person, date, outing))""",
    # x, y [m] in the outing's frame; heading [rad], NULL where unknown
    """CREATE TABLE stay (person TEXT, date TEXT, outing INTEGER, stay INTEGER, start REAL, stop REAL, passing INTEGER,
        x REAL, y REAL, var_x REAL, cov_xy REAL, var_y REAL, heading REAL, floor TEXT,
        PRIMARY KEY (person, date, outing, stay))""",
    """CREATE TABLE facing (person TEXT, date TEXT, outing INTEGER, stay INTEGER, rank INTEGER, name TEXT,
        probability REAL, PRIMARY KEY (person, date, outing, stay, rank))""",
    # at the end of the day; covariance: 3 × 3 in the order of the coefficients, JSON
    """CREATE TABLE profile (person TEXT, date TEXT, E_length REAL, E_straight REAL, E_corner REAL, covariance TEXT,
        residual REAL, speed REAL, PRIMARY KEY (person, date))""",
)
TABLES = ("day", "outing", "segment", "trajectory", "stay", "facing", "profile")  # tables with rows of a day
Rows = dict[str, list[tuple[Any, ...]]]


@dataclass(frozen=True)
class DayRows:
    """The rows of a day by table, on their way from a worker to the store."""

    tables: Rows


def rows_of(day: Day, key: str, recordings: Sequence[str]) -> Rows:
    """The rows of a day by table. key: hash of its inputs; recordings: content hashes."""
    own = (day.person, day.date)
    rows: Rows = {name: [] for name in TABLES}
    rows["day"].append((*own, key, json.dumps(list(recordings))))
    for n, outing in enumerate(day.outings):
        _add(rows, (*own, n), outing)
    if day.profile is not None:
        rows["profile"].append((*own, *profile_row(day.profile)))
    return rows


def day_of(person: str, date: str, read: Callable[[str], Sequence[Sequence[Any]]]) -> Day:
    """The day whose rows `rows_of` returned. read: returns the rows of a table in order, without person and date.

    Raises ValueError if the rows are invalid.
    """
    tables = {name: read(name) for name in TABLES}
    found = [profile_of(row) for row in tables["profile"]]
    outings = tuple(_outing(row, tables) for row in tables["outing"])
    return Day(person, date, outings, found[0] if found else None)


def profile_row(profile: Profile) -> tuple[Any, ...]:
    """Row of a profile for its table."""
    covariance = json.dumps(profile.covariance.tolist())
    return (profile.E_length, profile.E_straight, profile.E_corner, covariance, profile.residual, profile.speed)


def profile_of(row: Sequence[Any]) -> Profile:
    """Profile from a row of its table."""
    length, straight, corner, covariance, residual, speed = row
    length, straight, corner, residual, speed = map(_number, (length, straight, corner, residual, speed))
    return Profile(length, straight, corner, np.array(json.loads(covariance)), residual, speed)


def _add(rows: Rows, own: tuple[str, str, int], outing: Outing) -> None:
    """Add the rows of one outing."""
    texts = [json.dumps(list(lines)) for lines in (outing.recordings, outing.notes, outing.missing)]
    frame = encode_json(outing.frame)
    rows["outing"].append((*own, outing.source, outing.epoch, outing.steps, outing.plan, frame, *texts))
    rows["trajectory"].append((*own, compress(outing.trajectory)))
    for n, s in enumerate(outing.segments):
        rows["segment"].append((*own, n, s.kind, s.start, s.end, s.distance))
    for n, stay in enumerate(outing.stays):
        place = (*stay.position.tolist(), *stay.covariance.ravel()[[0, 1, 3]].tolist())
        rows["stay"].append((*own, n, stay.start, stay.end, int(stay.passing), *place, stay.heading, stay.floor))
        rows["facing"] += [(*own, n, rank, name, p) for rank, (name, p) in enumerate(stay.facing)]


def _outing(row: Sequence[Any], tables: Mapping[str, Sequence[Sequence[Any]]]) -> Outing:
    """The outing of a row of its table, with its rows in the other tables."""
    number, source, epoch, steps, plan, frame, *texts = row
    recordings, notes, missing = (tuple(json.loads(lines)) for lines in texts)
    own = {name: [r[1:] for r in tables[name] if r[0] == number] for name in TABLES[2:]}
    [(track,)] = own["trajectory"]
    return Outing(
        recordings=recordings,
        source=source,
        epoch=epoch,
        frame=decode_json(frame, Frame),
        plan=plan,
        trajectory=decompress(track, Trajectory),
        segments=tuple(Segment(kind, _number(a), _number(b), _number(far)) for _, kind, a, b, far in own["segment"]),
        stays=tuple(_stay(r, own["facing"]) for r in own["stay"]),
        steps=steps,
        notes=notes,
        missing=missing,
    )


def _stay(row: Sequence[Any], facing: Sequence[Sequence[Any]]) -> Stay:
    """The stay of a row of its table; facing: the rows of its outing."""
    number, start, stop, passing, *numbers, floor = row
    x, y, var_x, cov_xy, var_y, heading = map(_number, numbers)
    names = tuple((name, probability) for stay, _, name, probability in facing if stay == number)
    covariance = np.array([[var_x, cov_xy], [cov_xy, var_y]])
    return Stay(start, stop, bool(passing), np.array([x, y]), covariance, heading, floor, names)


def _number(value: float | None) -> float:
    """A number from SQLite, which stores NaN as NULL."""
    return float("nan") if value is None else value
