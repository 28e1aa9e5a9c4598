"""Days as GeoParquet tables, in the columns that trackintel and movingpandas expect.

``positionfixes``, ``triplegs``, ``staypoints`` and ``locations`` are trackintel's model (Martin et al., "Trackintel: an
open-source Python library for human mobility analysis", Computers, Environment and Urban Systems 101, 2023). The rows
are those of the diary, with the ids that join the tables; positions are longitude and latitude (EPSG:4326), times are
UTC.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from pdr_graph.errors import InputError, install
from pdr_graph.geometry import horizontal_sigma
from pdr_graph.lifelog.day import VEHICLE, WALKING, Day, Outing, split_at_gaps
from pdr_graph.lifelog.diary import corrected_rows, with_places, without_overlaps
from pdr_graph.lifelog.facts import Correction
from pdr_graph.lifelog.places import Place
from pdr_graph.lifelog.stays_and_legs import Track
from pdr_graph.lifelog.timeline import PASSING, STAY, TimelineEntry, timeline
from pdr_graph.types import Array, Index

if TYPE_CHECKING:
    from geopandas import GeoDataFrame

MODES = {WALKING: "walk", PASSING: "walk", VEHICLE: "vehicle"}
WGS84 = "EPSG:4326"
EXTENT_SIGMAS = 2.0  # sigmas around the visits that belong to the extent of a location
LEAST_EXTENT = 10.0  # [m]
NO_ID = -1


@dataclass(frozen=True)
class PersonRows:
    """A person's rows. stays and legs of the diary; places; track: all positions of `outings`; private: as of
    `parquet_tables`.
    """

    person: str
    stays: tuple[TimelineEntry, ...]
    legs: tuple[TimelineEntry, ...]
    places: tuple[Place, ...]
    track: Track
    outings: tuple[Outing, ...]
    private: bool


def parquet_tables(
    days: Iterable[Day], corrections: Sequence[Correction] = (), private: bool = False
) -> dict[str, bytes]:
    """The tables of days as GeoParquet files by name; a table without rows is left out.

    corrections: of all persons. private: True for days from which private places were removed: their stays are not
    joined over what was cut out, and no correction is used. Raises InputError without the extra `geo`.
    """
    _require_libraries()
    ordered = sorted(days, key=lambda day: (day.person, day.date))
    grouped = [(who, list(own)) for who, own in groupby(ordered, key=lambda day: day.person)]
    people = [
        _private_rows(who, own) if private else _rows(who, own, [c for c in corrections if c.person == who])
        for who, own in grouped
    ]
    frames = {
        "positionfixes": _positionfixes(people),
        "triplegs": _triplegs(people),
        "staypoints": _staypoints(people),
        "locations": _locations(people),
    }
    return {f"{name}.parquet": _bytes(frame) for name, frame in frames.items() if len(frame)}


def _require_libraries() -> None:
    """Raise InputError without geopandas or pyarrow."""
    try:
        import geopandas  # noqa: F401  # pyright: ignore[reportUnusedImport]
        import pyarrow  # noqa: F401  # pyright: ignore[reportUnusedImport]
    except ImportError as error:
        raise InputError("--format parquet", "", f"no {error.name}", install("geo")) from None


def _bytes(frame: GeoDataFrame) -> bytes:
    buffer = io.BytesIO()
    frame.to_parquet(buffer)
    return buffer.getvalue()


def _rows(person: str, days: Sequence[Day], corrections: Sequence[Correction]) -> PersonRows:
    """The rows of a person's diary, as corrected."""
    track = Track.of(_located(days))
    return _person_rows(person, days, track, *corrected_rows(_fine(days), track, corrections), False)


def _private_rows(person: str, days: Sequence[Day]) -> PersonRows:
    """The rows of a person's days without private places."""
    return _person_rows(person, days, Track.of(_located(days)), *with_places(_fine(days)), True)


def _fine(days: Sequence[Day]) -> list[TimelineEntry]:
    return without_overlaps([entry for day in days for entry in timeline(day)])


def _located(days: Sequence[Day]) -> tuple[Outing, ...]:
    return tuple(outing for day in days for outing in day.outings if outing.frame.georeferenced)


def _person_rows(
    person: str,
    days: Sequence[Day],
    track: Track,
    rows: Sequence[TimelineEntry],
    places: tuple[Place, ...],
    private: bool,
) -> PersonRows:
    stays = tuple(row for row in rows if row.kind == STAY and np.isfinite(row.latitude))
    legs = tuple(row for row in rows if row.kind in MODES and _line(track, row) is not None)
    return PersonRows(person, stays, legs, places, track, _located(days), private)


def _line(track: Track, row: TimelineEntry) -> Array | None:
    """Longitudes and latitudes ``(n, 2)`` of a track during a row, with interpolated ends; None for a single point."""
    if not len(track.time):
        return None
    begin, after = (int(np.searchsorted(track.time, time, side="right")) for time in (row.start, row.end))
    near = slice(max(begin - 1, 0), after + 1)  # with the rows from which the ends are interpolated
    time, lonlat = track.time[near], track.lonlat[near]
    first, last = np.column_stack([np.interp([row.start, row.end], time, axis) for axis in lonlat.T])
    line = np.vstack([first, lonlat[(time > row.start) & (time < row.end)], last])
    return line if np.any(line != line[0]) else None


def _positionfixes(people: Sequence[PersonRows]) -> GeoDataFrame:
    """A row per position; track_id: of a part without gaps."""
    columns: dict[str, list[Any]] = {name: [] for name in ("user_id", "time", "lonlat", "track_id", "sigma", "floor")}
    stays, legs, track_id = list[Index](), list[Index](), 0
    first_stay = first_leg = 0
    for own in people:
        for outing in own.outings:
            for track, _ in split_at_gaps(outing):
                time = track.time + outing.epoch
                nan = np.full(len(track), np.nan)
                columns["user_id"].append(np.full(len(track), own.person, dtype=object))
                columns["time"].append(time)
                columns["lonlat"].append(outing.frame.to_lonlat(track.position))
                columns["track_id"].append(np.full(len(track), track_id))
                columns["sigma"].append(nan if track.covariance is None else horizontal_sigma(track.covariance))
                columns["floor"].append(np.array(track.floor, dtype=object))
                stays.append(_ids_at(time, own.stays, first_stay))
                legs.append(_ids_at(time, own.legs, first_leg))
                track_id += 1
        first_stay, first_leg = first_stay + len(own.stays), first_leg + len(own.legs)
    if not track_id:
        return _frame({"user_id": []}, [])
    whole = {name: np.concatenate(parts) for name, parts in columns.items()}
    about = {"user_id": whole["user_id"], "tracked_at": _times(whole["time"]), "track_id": whole["track_id"]}
    about |= {"staypoint_id": _ids(np.concatenate(stays)), "tripleg_id": _ids(np.concatenate(legs))}
    about |= {"sigma": whole["sigma"], "floor": whole["floor"]}
    return _frame(about, shapely.points(whole["lonlat"]))


def _ids_at(time: Array, rows: Sequence[TimelineEntry], first: int) -> Index:
    """The id of the row at each time, NO_ID for none. first: id of the first row."""
    starts, ends = (np.array([getattr(row, end) for row in rows]) for end in ("start", "end"))
    if not len(rows):
        return np.full(len(time), NO_ID)
    n = np.maximum(np.searchsorted(starts, time, side="right") - 1, 0)
    return np.where((time >= starts[n]) & (time <= ends[n]), first + n, NO_ID)


def _triplegs(people: Sequence[PersonRows]) -> GeoDataFrame:
    """A row per walk or ride."""
    rows = [(own, leg) for own in people for leg in own.legs]
    about = _about(rows) | {
        "mode": [MODES[leg.kind] for _, leg in rows],
        "distance": [leg.distance for _, leg in rows],
        "observed": [leg.observed for _, leg in rows],
    }
    lines = [_line(own.track, leg) for own, leg in rows]
    return _frame(about, [shapely.linestrings(line) for line in lines if line is not None])


def _staypoints(people: Sequence[PersonRows]) -> GeoDataFrame:
    """A row per stay."""
    rows = [(own, stay) for own in people for stay in own.stays]
    number = _location_ids(people)
    location = [number.get((own.person, stay.place_number), NO_ID) for own, stay in rows]
    about = _about(rows) | {
        "location_id": _ids(np.array(location, dtype=np.intp)),
        "name": [stay.place or (stay.facing[0][0] if stay.facing else "") for _, stay in rows],
        "observed": [stay.observed for _, stay in rows],
        "sigma": [stay.sigma for _, stay in rows],
        "floor": [" > ".join(stay.floor) for _, stay in rows],
    }
    return _frame(about, [shapely.Point(stay.longitude, stay.latitude) for _, stay in rows])


def _location_ids(people: Sequence[PersonRows]) -> dict[tuple[str, int], int]:
    """The id of each place, by person and number."""
    return {key: n for n, key in enumerate((own.person, place.number) for own in people for place in own.places)}


def _locations(people: Sequence[PersonRows]) -> GeoDataFrame:
    """A row per place with its center, and its extent: the hull of the visits with their uncertainty."""
    from geopandas import GeoSeries

    rows = [(own, place) for own in people for place in own.places]
    about: dict[str, Any] = {
        "user_id": [own.person for own, _ in rows],
        "name": [place.name for _, place in rows],
        "visits": [len(place.visits) for _, place in rows],
        "duration": [place.duration for _, place in rows],
        "sigma": [_sigma(own, place) for own, place in rows],
        "extent": GeoSeries([_extent(own, place) for own, place in rows], crs=WGS84),
    }
    return _frame(about, [shapely.Point(place.longitude, place.latitude) for _, place in rows], "center")


def _sigma(own: PersonRows, place: Place) -> float:
    """Standard deviation per axis of a place [m], at least that of its best visit: blurred visits err all alike."""
    return max(place.sigma, min(visit.sigma for visit in place.visits) if own.private else 0.0)


def _extent(own: PersonRows, place: Place) -> shapely.Geometry:
    """The convex hull of the visits to a place, widened by EXTENT_SIGMAS."""
    visits = [stay for stay in own.stays if stay.place_number == place.number]
    middle = np.array([place.longitude, place.latitude])
    # metres per degree of latitude; approximate, for extents
    metres = 111_195.0 * np.array([np.cos(np.radians(place.latitude)), 1.0])
    discs = [
        shapely.Point((np.array([stay.longitude, stay.latitude]) - middle) * metres).buffer(
            max(EXTENT_SIGMAS * stay.sigma, LEAST_EXTENT), quad_segs=4
        )
        for stay in visits
    ]
    hull = shapely.convex_hull(shapely.union_all(discs))
    return shapely.transform(hull, lambda corners: corners / metres + middle)


def _about(rows: Sequence[tuple[PersonRows, TimelineEntry]]) -> dict[str, Any]:
    """The columns that triplegs and staypoints share."""
    return {
        "user_id": [own.person for own, _ in rows],
        "started_at": _times(np.array([row.start for _, row in rows])),
        "finished_at": _times(np.array([row.end for _, row in rows])),
    }


def _times(unix: Array) -> Any:
    """UTC times of Unix times [s], in milliseconds."""
    from pandas import to_datetime

    return to_datetime(np.round(unix * 1000).astype(np.int64), unit="ms", utc=True)


def _ids(numbers: Index) -> Any:
    """Ids as integers, with a missing value for NO_ID."""
    from pandas import NA, Series

    return Series(numbers, dtype="Int64").replace(NO_ID, NA)


def _frame(columns: dict[str, Any], geometry: Any, name: str = "geom") -> GeoDataFrame:
    """A table with an index `id` and one active geometry column."""
    from geopandas import GeoDataFrame

    frame = GeoDataFrame(columns | {name: list(geometry)}, geometry=name, crs=WGS84)
    frame.index.name = "id"
    return frame
