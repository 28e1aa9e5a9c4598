"""Export days of a lifelog as GPX 1.1, GeoJSON (RFC 7946) or CSV, without private places.

Exports have no paths of recordings and plans. A line ends at each gap.
"""

from __future__ import annotations

import json
import secrets
from collections.abc import Iterator, Sequence
from datetime import UTC, date, datetime, tzinfo
from pathlib import Path
from typing import Any
from urllib.parse import quote
from zoneinfo import ZoneInfo

import numpy as np

from pdr_graph.errors import InputError
from pdr_graph.io import gpx
from pdr_graph.io.validation import RADIUS_68
from pdr_graph.io.writers import TRAJECTORY_HEADER, trajectory_rows
from pdr_graph.lifelog import cache
from pdr_graph.lifelog.day import Day, Outing, Segment, Stay, floors_along, part, sigma, stretches
from pdr_graph.lifelog.privacy import shared
from pdr_graph.lifelog.private_places import PrivatePlace, private_places
from pdr_graph.lifelog.store import ZONE, Store
from pdr_graph.lifelog.timeline import PASSING, STAY, table, timeline
from pdr_graph.types import Array, Trajectory

HEADER = f"outing,{TRAJECTORY_HEADER},latitude,longitude"


def notes(days: Sequence[Day]) -> list[str]:
    """A line per outing that GPX and GeoJSON cannot represent."""
    return [
        f"{day.person}, {day.date}: outing {n} left out: no absolute position"
        for day in days
        for n, outing in enumerate(day.outings, 1)
        if not outing.frame.georeferenced
    ]


def as_gpx(days: Sequence[Day]) -> bytes:
    """GPX: a track per outing, a track segment per part without a gap, a waypoint per stay."""
    tracks, places = [], []
    for day, number, outing in _outings(days):
        if not outing.frame.georeferenced:
            continue
        lines = tuple(_points(outing, track) for track, _ in stretches(outing))
        tracks.append(gpx.Track(f"{day.person} {day.date}, {number}", lines))
        places += [(_name(stay), _place(outing, stay)) for stay in outing.stays if not stay.passing]
    return gpx.document(tracks, places)


def _outings(days: Sequence[Day]) -> Iterator[tuple[Day, int, Outing]]:
    """All outings as (day, number within the day, outing)."""
    return ((day, n, outing) for day in days for n, outing in enumerate(day.outings, 1))


def _points(outing: Outing, track: Trajectory) -> gpx.Points:
    radius = None if track.covariance is None else RADIUS_68 * sigma(track.covariance)
    return gpx.Points(outing.frame.to_lonlat(track.position), outing.epoch + track.time, radius)


def _place(outing: Outing, stay: Stay) -> gpx.Points:
    """Where a stay was, at its start."""
    lonlat = outing.frame.to_lonlat(stay.position[None])
    return gpx.Points(lonlat, np.array([outing.epoch + stay.start]), RADIUS_68 * sigma(stay.covariance[None]))


def _name(stay: Stay) -> str:
    """What a stay is called: the most probable place."""
    return f"{stay.facing[0][0]} ({stay.facing[0][1]:.0%})" if stay.facing else STAY


def as_geojson(days: Sequence[Day]) -> bytes:
    """A LineString for each segment, with the times and covariances of its points, and a Point for each stay."""
    features = [
        feature
        for day, number, outing in _outings(days)
        if outing.frame.georeferenced
        for feature in _features(outing, {"person": day.person, "date": day.date, "outing": number})
    ]
    collection = {"type": "FeatureCollection", "features": features}
    return json.dumps(collection, ensure_ascii=False, allow_nan=False).encode()


def _features(outing: Outing, about: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for track, segments in stretches(outing):
        for segment in segments:
            line = part(track, segment.start, segment.end)
            if len(line):
                yield _line(outing, segment, line, about)
    for stay in outing.stays:
        yield _point(outing, stay, about)


def _line(outing: Outing, segment: Segment, line: Trajectory, about: dict[str, Any]) -> dict[str, Any]:
    """A segment; as a Point if no more of it is known."""
    lonlat = np.round(outing.frame.to_lonlat(line.position), 8).tolist()
    properties = about | {"kind": segment.kind, **_times(outing, segment), "distance": round(segment.distance, 2)}
    properties |= {"floors": list(floors_along(line)), "times": np.round(outing.epoch + line.time, 3).tolist()}
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
    """Start and end in words, and how long [s]."""
    moments = {"start": _utc(outing.epoch + what.start), "end": _utc(outing.epoch + what.end)}
    return {**moments, "duration": round(what.end - what.start, 3)}


def _utc(time: float) -> str:
    return datetime.fromtimestamp(time, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _covariance(matrix: Array) -> list[float]:
    """Variance east, covariance, variance north. [m²]"""
    return [float(f"{value:.6g}") for value in (matrix[0, 0], matrix[0, 1], matrix[1, 1])]


def _feature(kind: str, coordinates: list[Any], properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "geometry": {"type": kind, "coordinates": coordinates}, "properties": properties}


def as_csv(day: Day) -> bytes:
    """All rows of a day: ``trajectory.csv`` in Unix time, each with its outing's number, in whose frame x and y are.

    Latitude and longitude are empty where nobody knows them; rows stand on either side of a gap, none in it.
    """
    lines = [HEADER]
    for _, number, outing in _outings([day]):
        for track, _ in stretches(outing):
            lines += _rows(number, outing, track)
    return ("\n".join(lines) + "\n").encode()


def _rows(number: int, outing: Outing, track: Trajectory) -> Iterator[str]:
    lonlat = outing.frame.to_lonlat(track.position) if outing.frame.georeferenced else np.full((len(track), 2), np.nan)
    for row, (lon, lat) in zip(trajectory_rows(track, outing.epoch), lonlat, strict=True):
        yield f"{number},{row},{',' if np.isnan(lat) else f'{lat:.8f},{lon:.8f}'}"


GPX, GEOJSON, CSV = "gpx", "geojson", "csv"
DOCUMENTS = {GPX: as_gpx, GEOJSON: as_geojson}
SECRET, SECRET_BYTES = "secret", 32  # name of the setting that keys the hiding of private places, and its length


def give(
    path: Path,
    out: Path,
    form: str,
    person: str | None = None,
    since: str = "",
    until: str = "",
    cut: Sequence[str] = (),
    blur: Sequence[str] = (),
) -> tuple[list[Path], list[str]]:
    """Write a lifelog's days to one file or, CSV always, to a folder with files for each.

    form: GPX, GEOJSON or CSV; out: a file if its name ends in that; person, since, until: whose days and which, all
    if it is not said; cut, blur: places to be kept private, as of `private_places`.
    Returns the files, and what a user must know, a line each. Raises InputError.
    """
    single = out.suffix.lower() == f".{form}" and not out.is_dir()
    if single and form == CSV:
        raise InputError("--out", "", str(out), "a folder: CSV has two files per day")
    said, written = list[str](), list[Path]()
    with Store(path) as log:
        zone, wanted = ZoneInfo(log.setting(ZONE)), _wanted(log, person, _day("--from", since), _day("--to", until))
        places = _places(log, cut), _places(log, blur)
        days = _shown(log, wanted, form, places, said)
        for target, content in _whole(out, form, list(days)) if single else _by_day(out, form, days, zone):
            cache.write(target, content)
            written.append(target)
    return written, said


def _day(option: str, text: str) -> str:
    try:
        return date.fromisoformat(text).isoformat() if text else ""
    except ValueError:
        raise InputError(option, "", repr(text), "a date such as 2024-05-01") from None


def _wanted(log: Store, person: str | None, since: str, until: str) -> list[tuple[str, str]]:
    """(person, date) of the days selected. Raises InputError if there is none."""
    days = [key for key in log.days() if person in (None, key[0])]
    if not days:
        expected = "a built lifelog: run pdr-graph lifelog build" if person is None else "a person with days"
        raise InputError(log.path, "" if person is None else person, "no day", expected)
    wanted = [key for key in days if (not since or key[1] >= since) and (not until or key[1] <= until)]
    if not wanted:
        there = sorted(day for _, day in days)
        raise InputError(
            log.path, f"{since or '…'} to {until or '…'}", "no day", f"days from {there[0]} to {there[-1]}"
        )
    return wanted


def _places(log: Store, texts: Sequence[str]) -> tuple[PrivatePlace, ...]:
    plans = sorted({entry.plan for entry in log.entries() if entry.plan})
    return private_places(texts, plans, _secret(log)) if texts else ()


def _secret(log: Store) -> bytes:
    """The secret of the lifelog. It must stay the same: averaging over exports would reveal a private place."""
    try:
        return bytes.fromhex(log.setting(SECRET))
    except IndexError:  # its first export
        log.set(SECRET, secrets.token_hex(SECRET_BYTES))
        return _secret(log)


def _shown(
    log: Store,
    wanted: Sequence[tuple[str, str]],
    form: str,
    places: tuple[Sequence[PrivatePlace], Sequence[PrivatePlace]],
    said: list[str],
) -> Iterator[Day]:
    """Yield the days with private places removed, if anything is left; notes are appended to ``said``."""
    for person, day in wanted:
        there = log.day(person, day)
        left, lines = shared([there] if there else [], *places)
        said += lines if form == CSV else [*lines, *notes(left)]
        if any(form == CSV or outing.frame.georeferenced for own in left for outing in own.outings):
            yield from left
        else:
            said.append(f"{person}, {day}: nothing left to export")


def _whole(out: Path, form: str, days: Sequence[Day]) -> Iterator[tuple[Path, bytes]]:
    if days:
        yield out, DOCUMENTS[form](days)


def _by_day(out: Path, form: str, days: Iterator[Day], zone: tzinfo) -> Iterator[tuple[Path, bytes]]:
    for day in days:
        name = f"{quote(day.person, safe=' ')}_{day.date}"
        if form == CSV:
            yield out / f"{name}_trajectory.csv", as_csv(day)
            yield out / f"{name}_timeline.csv", table(timeline(day), zone).encode()
        else:
            yield out / f"{name}.{form}", DOCUMENTS[form]([day])
