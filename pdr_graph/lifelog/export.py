"""Days as files for other programs: GPX 1.1, GeoJSON (RFC 7946) and CSV.

Nothing of where a day's recordings and plans lie, and nothing that nobody recorded: a line ends at a gap.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np

from pdr_graph.io import gpx
from pdr_graph.io.positions import RADIUS_68
from pdr_graph.io.writers import TRAJECTORY_HEADER, trajectory_rows
from pdr_graph.lifelog.day import Day, Outing, Segment, Stay
from pdr_graph.lifelog.parts import floors_along, part, sigma, stretches
from pdr_graph.lifelog.timeline import PASSING, STAY
from pdr_graph.types import Array, Trajectory

HEADER = f"outing,{TRAJECTORY_HEADER},latitude,longitude"


def notes(days: Sequence[Day]) -> list[str]:
    """What of some days GPX and GeoJSON cannot hold, a line each."""
    return [
        f"{day.person}, {day.date}: outing {n} is not in it: nobody knows where on earth it was"
        for day in days
        for n, outing in enumerate(day.outings, 1)
        if not outing.frame.georeferenced
    ]


def as_gpx(days: Sequence[Day]) -> bytes:
    """A track for each outing, a segment for each stretch without a break, a waypoint for each stay."""
    tracks, places = [], []
    for day, number, outing in _outings(days):
        if not outing.frame.georeferenced:
            continue
        lines = tuple(_points(outing, track) for track, _ in stretches(outing))
        tracks.append(gpx.Track(f"{day.person} {day.date}, {number}", lines))
        places += [(_name(stay), _place(outing, stay)) for stay in outing.stays if not stay.passing]
    return gpx.document(tracks, places)


def _outings(days: Sequence[Day]) -> Iterator[tuple[Day, int, Outing]]:
    """All outings with their days and numbers in them."""
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
