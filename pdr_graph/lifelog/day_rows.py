"""The rows of a day in the tables of a lifelog, and the day from its rows."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pdr_graph.frames import Frame
from pdr_graph.gait.walker import Profile
from pdr_graph.lifelog.day import Day, Outing, Segment, Stay
from pdr_graph.storage import compress, decode_json, decompress, encode_json
from pdr_graph.types import Trajectory

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
        segments=tuple(Segment(kind, *map(_number, numbers)) for _, kind, *numbers in own["segment"]),
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
