"""Export days of a lifelog as GPX 1.1, GeoJSON (RFC 7946), CSV or GeoParquet, without private places.

Exports have no paths of recordings and plans. A line ends at each gap.
"""

from __future__ import annotations

import json
import secrets
from collections.abc import Iterable, Iterator, Sequence
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from pdr_graph.errors import InputError
from pdr_graph.geometry import horizontal_sigma
from pdr_graph.io import gpx
from pdr_graph.io.validation import RADIUS_68
from pdr_graph.io.writers import TRAJECTORY_HEADER, trajectory_rows
from pdr_graph.lifelog import cache
from pdr_graph.lifelog.day import Day, Outing, Segment, Stay, clipped, floors_visited, split_at_gaps
from pdr_graph.lifelog.local_time import zone_of_outings
from pdr_graph.lifelog.privacy import PrivatePlace, private_places, without_private_places
from pdr_graph.lifelog.store import ZONE, Store
from pdr_graph.lifelog.timeline import PASSING, STAY, timeline, timeline_csv
from pdr_graph.types import Array, Trajectory
from pdr_graph.whole_files import output_folder, write_file

HEADER = f"outing,{TRAJECTORY_HEADER},latitude,longitude"


def not_exported(days: Sequence[Day]) -> list[str]:
    """A line per outing without an absolute position, which GPX and GeoJSON cannot represent."""
    return [
        f"{day.person}, {day.date}: outing {n} left out: no absolute position"
        for day in days
        for n, outing in enumerate(day.outings, 1)
        if not outing.frame.georeferenced
    ]


def as_gpx(days: Sequence[Day]) -> bytes:
    """GPX: a track per outing, a track segment per part without a gap, a waypoint per stay."""
    tracks, places = [], []
    for day, number, outing in _numbered_outings(days):
        if not outing.frame.georeferenced:
            continue
        lines = tuple(_points(outing, track) for track, _ in split_at_gaps(outing))
        tracks.append(gpx.Track(f"{day.person} {day.date}, {number}", lines))
        places += [(_stay_name(stay), _stay_point(outing, stay)) for stay in outing.stays if not stay.passing]
    return gpx.document(tracks, places)


def _numbered_outings(days: Sequence[Day]) -> Iterator[tuple[Day, int, Outing]]:
    """All outings as (day, number within the day, outing)."""
    return ((day, n, outing) for day in days for n, outing in enumerate(day.outings, 1))


def _points(outing: Outing, track: Trajectory) -> gpx.Points:
    radius = None if track.covariance is None else RADIUS_68 * horizontal_sigma(track.covariance)
    return gpx.Points(outing.frame.to_lonlat(track.position), outing.epoch + track.time, radius)


def _stay_point(outing: Outing, stay: Stay) -> gpx.Points:
    """The position of a stay, at the time of its start."""
    lonlat = outing.frame.to_lonlat(stay.position[None])
    return gpx.Points(
        lonlat, np.array([outing.epoch + stay.start]), RADIUS_68 * horizontal_sigma(stay.covariance[None])
    )


def _stay_name(stay: Stay) -> str:
    """The name of the most probable place of a stay, with its probability."""
    return f"{stay.facing[0][0]} ({stay.facing[0][1]:.0%})" if stay.facing else STAY


def as_geojson(days: Sequence[Day]) -> bytes:
    """A LineString for each segment, with the times and covariances of its points, and a Point for each stay."""
    features = [
        feature
        for day, number, outing in _numbered_outings(days)
        if outing.frame.georeferenced
        for feature in _features(outing, {"person": day.person, "date": day.date, "outing": number})
    ]
    collection = {"type": "FeatureCollection", "features": features}
    return json.dumps(collection, ensure_ascii=False, allow_nan=False).encode()


def _features(outing: Outing, about: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for track, segments in split_at_gaps(outing):
        for segment in segments:
            line = clipped(track, segment.start, segment.end)
            if len(line):
                yield _line(outing, segment, line, about)
    for stay in outing.stays:
        yield _point(outing, stay, about)


def _line(outing: Outing, segment: Segment, line: Trajectory, about: dict[str, Any]) -> dict[str, Any]:
    """A segment as a LineString, or as a Point if it has a single row."""
    lonlat = np.round(outing.frame.to_lonlat(line.position), 8).tolist()
    properties = about | {"kind": segment.kind, **_times(outing, segment), "distance": round(segment.distance, 2)}
    properties |= {"floors": list(floors_visited(line)), "times": np.round(outing.epoch + line.time, 3).tolist()}
    if line.covariance is not None:
        properties["covariances"] = [_covariance(own) for own in line.covariance]
    if len(lonlat) == 1:
        return _feature("Point", lonlat[0], properties)
    return _feature("LineString", lonlat, properties)


def _point(outing: Outing, stay: Stay, about: dict[str, Any]) -> dict[str, Any]:
    lonlat = np.round(outing.frame.to_lonlat(stay.position[None])[0], 8).tolist()
    facing = [{"name": name, "probability": round(p, 4)} for name, p in stay.facing]
    heading = round(stay.heading, 4) if np.isfinite(stay.heading) else None
    properties = about | {"kind": PASSING if stay.passing else STAY, **_times(outing, stay), "floor": stay.floor}
    properties |= {"heading": heading, "covariance": _covariance(stay.covariance), "facing": facing}
    return _feature("Point", lonlat, properties)


def _times(outing: Outing, what: Segment | Stay) -> dict[str, Any]:
    """Start and end in ISO 8601, and the duration [s]."""
    moments = {"start": _utc(outing.epoch + what.start), "end": _utc(outing.epoch + what.end)}
    return {**moments, "duration": round(what.end - what.start, 3)}


def _utc(time: float) -> str:
    return datetime.fromtimestamp(time, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _covariance(matrix: Array) -> list[float]:
    """Variance east, covariance and variance north [m²], to six digits."""
    return [float(f"{value:.6g}") for value in (matrix[0, 0], matrix[0, 1], matrix[1, 1])]


def _feature(kind: str, coordinates: list[Any], properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "geometry": {"type": kind, "coordinates": coordinates}, "properties": properties}


def as_csv(day: Day) -> bytes:
    """All rows of a day as CSV: ``trajectory.csv`` in Unix time with the number of the outing.

    x and y are in the frame of the outing. Latitude and longitude are empty without an absolute position; gaps have no
    rows.
    """
    lines = [HEADER]
    for _, number, outing in _numbered_outings([day]):
        for track, _ in split_at_gaps(outing):
            lines += _rows(number, outing, track)
    return ("\n".join(lines) + "\n").encode()


def _rows(number: int, outing: Outing, track: Trajectory) -> Iterator[str]:
    lonlat = outing.frame.to_lonlat(track.position) if outing.frame.georeferenced else np.full((len(track), 2), np.nan)
    for row, (lon, lat) in zip(trajectory_rows(track, outing.epoch), lonlat, strict=True):
        yield f"{number},{row},{',' if np.isnan(lat) else f'{lat:.8f},{lon:.8f}'}"


TABLE_NAMES = ("positionfixes", "triplegs", "staypoints", "locations")  # of PARQUET
GPX, GEOJSON, CSV, PARQUET = "gpx", "geojson", "csv", "parquet"
DOCUMENTS = {GPX: as_gpx, GEOJSON: as_geojson}
SECRET, SECRET_BYTES = "secret", 32  # setting that determines how private areas are moved, and its length


def export_days(
    path: Path,
    out: Path,
    file_format: str,
    person: str | None = None,
    since: str = "",
    until: str = "",
    cut: Sequence[str] = (),
    blur: Sequence[str] = (),
) -> tuple[list[Path], list[str]]:
    """Write days of a lifelog to one file, or to a folder with files per day (CSV) or tables (PARQUET).

    file_format: GPX, GEOJSON, CSV or PARQUET; out: a file if its suffix is the format, else a folder; person: None for
    all; since, until: first and last date, "" for all; cut, blur: places to keep private, as of `private_places`.
    Returns the files, and notes on what was left out, a line each. Raises InputError if a choice cannot be used.
    """
    single = out.suffix.lower() == f".{file_format}" and not out.is_dir()
    if single and file_format in (CSV, PARQUET):
        raise InputError("--out", "", str(out), f"a folder: {file_format} has several files")
    notes, written = list[str](), list[Path]()
    with Store(path) as log:
        zone = log.setting(ZONE)
        wanted = _selected_days(log, person, _checked_date("--from", since), _checked_date("--to", until))
        places = _private_places(log, cut), _private_places(log, blur)
        days = _public_days(log, wanted, file_format, places, notes)
        if single:
            written = _write_one_file(out, file_format, list(days))
        else:
            with output_folder(out, private=True) as staged:
                for target, content in (
                    _tables(staged, days, log, bool(cut or blur))
                    if file_format == PARQUET
                    else _files_by_day(staged, file_format, days, zone)
                ):
                    cache.write(target, content)
                    written.append(out / target.relative_to(staged))
    if cut or blur:
        possible = [out] if single else _possible_files(out, file_format, wanted)
        notes += _without_earlier(path for path in possible if path not in written)
    return written, notes


def _possible_files(out: Path, file_format: str, wanted: Sequence[tuple[str, str]]) -> list[Path]:
    """The files that an export of some days to a folder can have."""
    if file_format == PARQUET:
        return [out / f"{name}.parquet" for name in TABLE_NAMES]
    return [file for person, day in wanted for file in _day_files(out, file_format, person, day)]


def _without_earlier(files: Iterable[Path]) -> Iterator[str]:
    """Remove files of an earlier export, which would show what is private now; yields a note for each."""
    for file in files:
        if file.is_file():
            file.unlink()
            yield f"{file}: of an earlier export, removed: nothing is left for it now"


def _checked_date(option: str, text: str) -> str:
    """The date in ISO 8601, "" if none is given. Raises InputError for another text."""
    try:
        return date.fromisoformat(text).isoformat() if text else ""
    except ValueError:
        raise InputError(option, "", repr(text), "a date such as 2024-05-01") from None


def _selected_days(log: Store, person: str | None, since: str, until: str) -> list[tuple[str, str]]:
    """Person and date of the days of a choice. Raises InputError if there is none."""
    days = [key for key in log.days() if person in (None, key[0])]
    if not days:
        expected = "a built lifelog: run pdr-graph lifelog build" if person is None else "a person with days"
        raise InputError(log.path, "" if person is None else person, "no day", expected)
    wanted = [key for key in days if (not since or key[1] >= since) and (not until or key[1] <= until)]
    if not wanted:
        dates = sorted(date for _, date in days)
        raise InputError(
            log.path, f"{since or '…'} to {until or '…'}", "no day", f"days from {dates[0]} to {dates[-1]}"
        )
    return wanted


def _private_places(log: Store, texts: Sequence[str]) -> tuple[PrivatePlace, ...]:
    """The places that some texts describe; names are looked up on all plans of the lifelog."""
    plans = sorted({str(entry.options.plan) for entry in log.entries() if entry.options.plan})
    return private_places(texts, plans, _secret(log)) if texts else ()


def _secret(log: Store) -> bytes:
    """The secret of the lifelog. It must stay the same: averaging over exports would reveal a private place."""
    return bytes.fromhex(log.lasting_setting(SECRET, secrets.token_hex(SECRET_BYTES)))


def _public_days(
    log: Store,
    wanted: Sequence[tuple[str, str]],
    file_format: str,
    places: tuple[Sequence[PrivatePlace], Sequence[PrivatePlace]],
    notes: list[str],
) -> Iterator[Day]:
    """Yield the days with private places removed, if anything is left; notes are appended to ``notes``."""
    for person, day in wanted:
        stored = log.day(person, day)
        left, lines = without_private_places([stored] if stored else [], *places)
        notes += lines if file_format == CSV else [*lines, *not_exported(left)]
        if any(file_format == CSV or outing.frame.georeferenced for own in left for outing in own.outings):
            yield from left
        else:
            notes.append(f"{person}, {day}: nothing left to export")


def _write_one_file(out: Path, file_format: str, days: Sequence[Day]) -> list[Path]:
    """Write all days to one file; returns it, nothing without a day."""
    if not days:
        return []
    cache.make_folder(out.parent)
    write_file(out, DOCUMENTS[file_format](days), private=True)
    return [out]


def _tables(out: Path, days: Iterator[Day], log: Store, private: bool) -> Iterator[tuple[Path, bytes]]:
    """One table of each kind, of all days."""
    from pdr_graph.lifelog.geo_tables import parquet_tables  # heavy, and of an extra

    yield from ((out / name, content) for name, content in parquet_tables(days, log.corrections(), private).items())


def _files_by_day(out: Path, file_format: str, days: Iterator[Day], zone: str) -> Iterator[tuple[Path, bytes]]:
    for day in days:
        first, *others = _day_files(out, file_format, day.person, day.date)
        yield first, as_csv(day) if file_format == CSV else DOCUMENTS[file_format]([day])
        for file in others:
            yield file, timeline_csv(timeline(day), zone_of_outings(zone, day.outings)).encode()


def _day_files(out: Path, file_format: str, person: str, date: str) -> list[Path]:
    """The file of a day, or its ``trajectory.csv`` and ``timeline.csv``."""
    endings = ("_trajectory.csv", "_timeline.csv") if file_format == CSV else (f".{file_format}",)
    return [out / f"{quote(person, safe=' ')}_{date}{ending}" for ending in endings]
