"""Export days of a lifelog as GPX 1.1, GeoJSON (RFC 7946), CSV or GeoParquet, without private places.

Exports have no paths of recordings and plans. A line ends at each gap. Names, modes and guesses are those of the diary;
of an export without private places, the names of places that are not hidden, and stated modes.

The GeoParquet tables ``positionfixes``, ``triplegs``, ``staypoints`` and ``locations`` are trackintel's model (Martin
et al., "Trackintel: an open-source Python library for human mobility analysis", Computers, Environment and Urban
Systems 101, 2023), also read by movingpandas. Their rows are those of the diary, with the ids that join the tables;
positions are longitude and latitude (EPSG:4326), times are UTC.
"""

from __future__ import annotations

import io
import json
import secrets
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, date, datetime
from functools import cached_property
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np
import shapely

from pdr_graph.apps.lifelog import cache
from pdr_graph.apps.lifelog.corrections import corrected, place_names
from pdr_graph.apps.lifelog.day import (
    VEHICLE,
    WALKING,
    Day,
    Outing,
    Segment,
    Stay,
    clipped,
    floors_visited,
    split_at_gaps,
)
from pdr_graph.apps.lifelog.diary import (
    Diary,
    UnpartedDiary,
    corrected_rows,
    date_of_guess,
    dates_of,
    detailed,
    diary,
    parted,
    with_places,
    without_overlaps,
)
from pdr_graph.apps.lifelog.facts import MODE, VISIT, Correction, Guess
from pdr_graph.apps.lifelog.local_time import LocalClock
from pdr_graph.apps.lifelog.overview import place_records
from pdr_graph.apps.lifelog.places import NamedArea, Place, dwells, flows
from pdr_graph.apps.lifelog.privacy import (
    CIRCLE,
    PrivatePlace,
    normalized_name,
    private_places,
    without_private_places,
)
from pdr_graph.apps.lifelog.stays_and_legs import VISIT_RADIUS, Track
from pdr_graph.apps.lifelog.store import ZONE, Store
from pdr_graph.apps.lifelog.timeline import PASSING, STAY, TimelineEntry, timeline, timeline_csv
from pdr_graph.errors import InputError, install
from pdr_graph.frames import METRES_PER_DEGREE
from pdr_graph.geometry import horizontal_sigma
from pdr_graph.io import gpx
from pdr_graph.io.validation import RADIUS_68
from pdr_graph.io.writers import TRAJECTORY_HEADER, trajectory_rows
from pdr_graph.types import Array, Index
from pdr_graph.whole_files import output_folder, write_file

if TYPE_CHECKING:
    from geopandas import GeoDataFrame


TRAJECTORY_TABLE_HEADER = f"outing,{TRAJECTORY_HEADER},latitude,longitude"


def not_exported(days: Sequence[Day]) -> list[str]:
    """A line per outing without an absolute position, which GPX and GeoJSON cannot represent."""
    return [
        f"{day.person}, {day.date}: outing {n} left out: no absolute position"
        for day in days
        for n, outing in enumerate(day.outings, 1)
        if not outing.frame.georeferenced
    ]


@dataclass
class DiaryRows:
    """The rows of a person's diary by date, in order: the labels of what is exported."""

    by_date: dict[str, Sequence[TimelineEntry]]

    @cached_property
    def _ordered(self) -> list[TimelineEntry]:
        return sorted((row for own in self.by_date.values() for row in own), key=lambda row: row.start)

    def at(self, time: float) -> TimelineEntry | None:
        """The row at a Unix time [s]; None without one."""
        n = bisect_right(self._ordered, time, key=lambda row: row.start) - 1
        return self._ordered[n] if n >= 0 and time < self._ordered[n].end else None

    def labels(self, outing: Outing, what: Segment | Stay) -> dict[str, Any]:
        """What the diary says of the middle of a segment or stay; nothing where it says nothing."""
        row = self.at(outing.epoch + (what.start + what.end) / 2)
        return {} if row is None else _labels(row)

    def visits(self, date: str) -> list[TimelineEntry]:
        """The stays of a date whose place on Earth is known."""
        return [row for row in self.by_date.get(date, ()) if row.kind == STAY and np.isfinite(row.latitude)]


def _labels(row: TimelineEntry) -> dict[str, Any]:
    """Name and number of the place, mode, guess of another program, True if the person stated it; without blanks."""
    named = {"place": row.place, "mode": row.mode, "guess": row.guess}
    number = {"number": row.place_number} if row.place_number >= 0 else {}
    stated = {"corrected": True} if row.corrected else {}
    return {name: text for name, text in named.items() if text} | number | stated


NO_ROWS = DiaryRows({})


def as_gpx(days: Sequence[Day], diaries: Mapping[str, DiaryRows] = MappingProxyType({})) -> bytes:
    """GPX: a track per outing and stated mode, a track segment per part without a gap, a waypoint per stay.

    diaries: of each person, for names and modes; without one the stays of outings are waypoints.
    """
    tracks, places = list[gpx.Track](), list[tuple[str, str, gpx.Points]]()
    for day, number, outing in _numbered_outings(days):
        if not outing.frame.georeferenced:
            continue
        own, lines = diaries.get(day.person, NO_ROWS), list[tuple[str, gpx.Points]]()
        for track, segments in split_at_gaps(outing):
            modes = groupby(segments, key=lambda segment: own.labels(outing, segment).get("mode", ""))
            parts = [(mode, list(same)) for mode, same in modes]
            for mode, same in parts:
                rows = track if len(parts) == 1 else clipped(track, same[0].start, same[-1].end)
                lines.append((mode, _points(outing, rows.time, rows.position, rows.covariance)))
        for mode, same in groupby(lines, key=itemgetter(0)):
            name = ", ".join(filter(None, [f"{day.person} {day.date}", str(number), mode]))
            tracks.append(gpx.Track(name, tuple(points for _, points in same), mode))
        for stay in (stay for stay in outing.stays if not stay.passing and day.person not in diaries):
            at = _points(outing, np.array([stay.start]), stay.position[None], stay.covariance[None])
            places.append((_name_faced(stay.facing) or STAY, "", at))
    for day in days:
        for visit in diaries.get(day.person, NO_ROWS).visits(day.date):
            lonlat, accuracy = np.array([[visit.longitude, visit.latitude]]), np.array([RADIUS_68 * visit.sigma])
            about = [visit.mode, visit.guess, "corrected" if visit.corrected else ""]
            at = gpx.Points(lonlat, np.array([visit.start]), None if np.isnan(visit.sigma) else accuracy)
            places.append(
                (_name_faced(visit.facing, visit.place) or visit.label or STAY, "; ".join(filter(None, about)), at)
            )
    return gpx.document(tracks, places)


def _name_faced(facing: Sequence[tuple[str, float]], place: str = "") -> str:
    """The place that was faced with its probability, unless the person gave it another name; "" without any."""
    if place and (not facing or facing[0][0] != place):
        return place
    return f"{facing[0][0]} ({facing[0][1]:.0%})" if facing else ""


def _numbered_outings(days: Sequence[Day]) -> Iterator[tuple[Day, int, Outing]]:
    """All outings as (day, number within the day, outing)."""
    return ((day, n, outing) for day in days for n, outing in enumerate(day.outings, 1))


def _points(outing: Outing, time: Array, position: Array, covariance: Array | None) -> gpx.Points:
    """Points at times [s] and positions [m] of an outing; covariance: [m²]."""
    radius = None if covariance is None else RADIUS_68 * horizontal_sigma(covariance)
    return gpx.Points(outing.frame.to_lonlat(position), outing.epoch + time, radius)


def as_geojson(days: Sequence[Day], diaries: Mapping[str, DiaryRows] = MappingProxyType({})) -> bytes:
    """A LineString for each segment, with the times and covariances of its points, and a Point for each stay.

    diaries: of each person: labels, and a Point of kind `visit` for each stay of the diary.
    """
    features = [
        feature
        for day, number, outing in _numbered_outings(days)
        if outing.frame.georeferenced
        for feature in _features(
            outing, {"person": day.person, "date": day.date, "outing": number}, diaries.get(day.person, NO_ROWS)
        )
    ]
    for day in days:
        for visit in diaries.get(day.person, NO_ROWS).visits(day.date):
            about = {"person": day.person, "date": day.date, "kind": VISIT, **_span(visit.start, visit.end)}
            known = {"sigma": round(visit.sigma, 2)} if np.isfinite(visit.sigma) else {}
            about |= {"observed": round(visit.observed, 3), **known, **_labels(visit)}
            features.append(_feature("Point", [round(visit.longitude, 8), round(visit.latitude, 8)], about))
    collection = {"type": "FeatureCollection", "features": features}
    return json.dumps(collection, ensure_ascii=False, allow_nan=False).encode()


def as_trips(days: Sequence[Day], diaries: Mapping[str, DiaryRows] = MappingProxyType({})) -> bytes:
    """The lines of `as_geojson` as trips of kepler.gl: each point is longitude, latitude, 0 and its Unix time [s]."""
    collection = json.loads(as_geojson(days, diaries))
    trips = [each for each in collection["features"] if each["geometry"]["type"] == "LineString"]
    for trip in trips:
        line, about = trip["geometry"], trip["properties"]
        times, _ = about.pop("times"), about.pop("covariances", None)
        line["coordinates"] = [[*place, 0, time] for place, time in zip(line["coordinates"], times, strict=True)]
    return json.dumps(collection | {"features": trips}, ensure_ascii=False, allow_nan=False).encode()


def _features(outing: Outing, about: dict[str, Any], own: DiaryRows) -> Iterator[dict[str, Any]]:
    """Features of the segments and stays; a segment with a single row is a Point.

    about: properties of all; own: labels.
    """
    for track, segments in split_at_gaps(outing):
        for segment in segments:
            line = clipped(track, segment.start, segment.end)
            lonlat = np.round(outing.frame.to_lonlat(line.position), 8).tolist()
            properties = about | {"kind": segment.kind, **_times(outing, segment), **own.labels(outing, segment)}
            properties |= {"distance": round(segment.distance, 2), "floors": list(floors_visited(line))}
            properties["times"] = np.round(outing.epoch + line.time, 3).tolist()
            if line.covariance is not None:
                properties["covariances"] = [_covariance(own) for own in line.covariance]
            if len(lonlat):
                kind, place = ("LineString", lonlat) if len(lonlat) > 1 else ("Point", lonlat[0])
                yield _feature(kind, place, properties)
    for stay in outing.stays:
        [lonlat] = np.round(outing.frame.to_lonlat(stay.position[None]), 8).tolist()
        facing = [{"name": name, "probability": round(p, 4)} for name, p in stay.facing]
        heading = round(stay.heading, 4) if np.isfinite(stay.heading) else None
        properties = about | {"kind": PASSING if stay.passing else STAY, **_times(outing, stay), "floor": stay.floor}
        properties |= {"heading": heading, "covariance": _covariance(stay.covariance), "facing": facing}
        properties |= own.labels(outing, stay)
        yield _feature("Point", lonlat, properties)


def _times(outing: Outing, what: Segment | Stay) -> dict[str, Any]:
    """Start, end and duration of a segment or stay."""
    return _span(outing.epoch + what.start, outing.epoch + what.end)


def _span(start: float, end: float) -> dict[str, Any]:
    """Start and end in ISO 8601 of Unix times [s], and the duration [s]."""
    utc = (datetime.fromtimestamp(time, UTC).isoformat(timespec="milliseconds") for time in (start, end))
    return dict(zip(("start", "end"), (text.replace("+00:00", "Z") for text in utc), strict=True)) | {
        "duration": round(end - start, 3)
    }


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
    lines = [TRAJECTORY_TABLE_HEADER]
    for _, number, outing in _numbered_outings([day]):
        for track, _ in split_at_gaps(outing):
            lonlat = np.full((len(track), 2), np.nan)
            if outing.frame.georeferenced:
                lonlat = outing.frame.to_lonlat(track.position)
            for row, (lon, lat) in zip(trajectory_rows(track, outing.epoch), lonlat, strict=True):
                lines.append(f"{number},{row},{',' if np.isnan(lat) else f'{lat:.8f},{lon:.8f}'}")
    return ("\n".join(lines) + "\n").encode()


TABLE_NAMES = ("positionfixes", "triplegs", "staypoints", "locations")  # of PARQUET
PLACE_TABLES = ("dwell", "flows", "busy")  # of places on plans, of PARQUET without hidden places
GPX, GEOJSON, KEPLER, CSV, PARQUET = "gpx", "geojson", "kepler", "csv", "parquet"
DOCUMENTS = {GPX: as_gpx, GEOJSON: as_geojson, KEPLER: as_trips}
SUFFIX = {form: f".{GEOJSON if form == KEPLER else form}" for form in (GPX, GEOJSON, KEPLER, CSV, PARQUET)}
SECRET = "secret"  # setting that determines how private areas are moved


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

    file_format: GPX, GEOJSON, KEPLER, CSV or PARQUET; out: a file if it has its SUFFIX, else a folder; person: None for
    all; since, until: first and last date, "" for all; cut, blur: places to keep private, as of `private_places`.
    Returns the files, and notes on what was left out, a line each. Raises InputError if a choice cannot be used.
    """
    single = out.suffix.lower() == SUFFIX[file_format] and not out.is_dir()
    if single and file_format in (CSV, PARQUET):
        raise InputError("--out", "", str(out), f"a folder: {file_format} has several files")
    notes, written = list[str](), list[Path]()
    with Store(path, reads=not (cut or blur)) as log:  # private places need a secret that is stored
        dates = _checked_date("--from", since), _checked_date("--to", until)
        places = _private_places(log, cut), _private_places(log, blur)
        statements = {who: Statements.of(log, who, dates, places if cut or blur else None) for who in _people(log)}
        wanted = _selected_days(log, person, *dates, guesses=not (cut or blur))
        days = _public_days(log, wanted, file_format, places, notes)
        if single:
            if left := list(days):
                cache.make_folder(out.parent)
                write_file(out, DOCUMENTS[file_format](left, diary_rows(log, left, statements)), private=True)
                written.append(out)
        else:
            with output_folder(out, private=True) as staged:
                if file_format == PARQUET:
                    own = (who for who in _people(log) if person in (None, who) and not (cut or blur))
                    diaries = [diary(log, who, *dates, outings=False) for who in own]
                    contents = iter((parquet_tables(days, statements) | place_tables(diaries)).items())
                else:
                    contents = _files_by_day(log, file_format, days, statements)
                for name, content in contents:
                    cache.write(staged / name, content)
                    written.append(out / name)
    if cut or blur:  # files of an earlier export would show what is private now
        possible = [out]
        if not single and file_format == PARQUET:
            possible = [out / f"{name}.parquet" for name in (*TABLE_NAMES, *PLACE_TABLES)]
        elif not single:
            possible = [out / name for person, day in wanted for name in _day_files(file_format, person, day)]
        for file in possible:
            if file not in written and file.is_file():
                file.unlink()
                notes.append(f"{file}: of an earlier export, removed: nothing is left for it now")
    return written, notes


def _checked_date(option: str, text: str) -> str:
    """The date in ISO 8601, "" if none is given. Raises InputError for another text."""
    try:
        return date.fromisoformat(text).isoformat() if text else ""
    except ValueError:
        raise InputError(option, "", repr(text), "a date such as 2024-05-01") from None


def _selected_days(
    log: Store, person: str | None, since: str, until: str, guesses: bool = False
) -> list[tuple[str, str]]:
    """Person and date of the days of a choice. Raises InputError if there is none.

    guesses: with days of which another program guessed something.
    """
    days = [key for key in (dates_of(log) if guesses else log.days()) if person in (None, key[0])]
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
    """The places that some texts describe; names are looked up on all plans and among all visited places.

    The secret of the lifelog stays the same: averaging over exports would reveal a private place.
    """
    if not texts:
        return ()
    plans, named = sorted({str(entry.options.plan) for entry in log.entries() if entry.options.plan}), list[NamedArea]()
    by_name = any(not CIRCLE.fullmatch(text) and not Path(text).suffix for text in texts)
    for person in sorted({person for person, _ in log.days()}) if by_name else ():
        named += place_names(log.corrections(person))
        visited = diary(log, person).places
        named += [
            (p.latitude, p.longitude, VISIT_RADIUS + p.sigma, p.label) for p in visited if np.isfinite(p.latitude)
        ]
    secret = bytes.fromhex(log.lasting_setting(SECRET, secrets.token_hex(32)))
    return private_places(texts, plans, secret, named)


def _public_days(
    log: Store,
    wanted: Sequence[tuple[str, str]],
    file_format: str,
    places: tuple[Sequence[PrivatePlace], Sequence[PrivatePlace]],
    notes: list[str],
) -> Iterator[Day]:
    """Yield the days with private places removed, if anything is left; notes are appended to ``notes``."""
    for person, day in wanted:
        stored, corrections = log.day(person, day), log.corrections(person)
        whole = corrected(stored or Day(person, day, ()), corrections)
        left, lines = without_private_places([with_modes(whole, corrections) if any(places) else whole], *places)
        notes += lines if file_format == CSV else [*lines, *not_exported(left)]
        if stored is None or any(
            file_format == CSV or outing.frame.georeferenced for own in left for outing in own.outings
        ):
            yield from left
        else:
            notes.append(f"{person}, {day}: nothing left to export")


def _files_by_day(
    log: Store, file_format: str, days: Iterator[Day], statements: Mapping[str, Statements]
) -> Iterator[tuple[str, bytes]]:
    """Names and contents of the files of each day."""
    public = {who: diary_rows_of(log, who) for who, own in statements.items() if own.private is None}
    for day in days:
        first, *others = _day_files(file_format, day.person, day.date)
        diaries = public if day.person in public else diary_rows(log, [day], statements)
        yield first, as_csv(day) if file_format == CSV else DOCUMENTS[file_format]([day], diaries)
        for file in others:
            yield file, timeline_csv(detailed(diaries[day.person].by_date.get(day.date, ()))).encode()


def _day_files(file_format: str, person: str, date: str) -> list[str]:
    """The file of a day, or its ``trajectory.csv`` and ``timeline.csv``."""
    endings = ("_trajectory.csv", "_timeline.csv") if file_format == CSV else (SUFFIX[file_format],)
    return [f"{quote(person, safe=' ')}_{date}{ending}" for ending in endings]


@dataclass(frozen=True)
class Statements:
    """Statements about a person's time. corrections: of the person; guesses: of other programs, of the exported dates;
    private: places that are hidden in the export, None for an export of everything.
    """

    corrections: tuple[Correction, ...] = ()
    guesses: tuple[Guess, ...] = ()
    private: tuple[PrivatePlace, ...] | None = None

    @classmethod
    def of(
        cls, log: Store, person: str, dates: tuple[str, str], places: tuple[Sequence[PrivatePlace], ...] | None
    ) -> Statements:
        """Of a person of a lifelog. dates: first and last, "" for all; places: to hide, None for nothing."""
        zone, (first, last) = log.setting(ZONE), dates
        guesses = [guess for guess in log.guesses(person) if first <= date_of_guess(guess, zone) <= (last or "9")]
        private = None if places is None else tuple(place for group in places for place in group)
        return cls(log.corrections(person), tuple(guesses), private)

    def rows(self, days: Sequence[Day], track: Track) -> tuple[list[TimelineEntry], tuple[Place, ...]]:
        """The rows of the diary of days, and their places. track: of the days.

        With hidden places stays are not joined over what was cut out, and guesses are left out, as are names of places
        that are hidden or called like one.
        """
        fine = without_overlaps([entry for day in days for entry in timeline(day)])
        if self.private is None:
            return corrected_rows(fine, track, self.corrections, self.guesses)
        areas = place_names(self.corrections)
        at = [(area, np.array([[area[1], area[0]]])) for area in areas]
        hidden = {area[3] for area, lonlat in at if any(place.hides(lonlat)[0] for place in self.private)}
        names = {normalized_name(name) for name in (*hidden, *(place.name for place in self.private))}
        rows, places = with_places(fine, [area for area in areas if normalized_name(area[3]) not in names])
        every = [(outing.epoch, segment) for day in days for outing in day.outings for segment in outing.segments]
        for epoch, segment in every if any(segment.mode for _, segment in every) else ():
            start, end = epoch + segment.start, epoch + segment.end
            for n, row in enumerate(rows):
                if segment.mode and start <= (row.start + row.end) / 2 <= end:
                    rows[n] = replace(row, mode=segment.mode, corrected=True)
        return rows, places


def with_modes(day: Day, corrections: Iterable[Correction]) -> Day:
    """The day with the mode that the person stated of the middle of each segment."""
    stated = [c for c in corrections if c.kind == MODE]

    def mode(time: float) -> str:
        return next((c.text("mode") for c in reversed(stated) if c.start <= time <= c.end), "")

    outings = (
        replace(o, segments=tuple(replace(s, mode=mode(o.epoch + (s.start + s.end) / 2)) for s in o.segments))
        for o in day.outings
    )
    return replace(day, outings=tuple(outings)) if stated else day


def _people(log: Store) -> list[str]:
    """All persons with days, corrections or guesses."""
    return sorted({*log.people(), *(person for person, _ in log.days())})


def diary_rows(log: Store, days: Sequence[Day], statements: Mapping[str, Statements]) -> dict[str, DiaryRows]:
    """The rows of the diary of each person of some days, with the private places of these days removed."""
    found = dict[str, DiaryRows]()
    for who in dict.fromkeys(day.person for day in days):
        if statements[who].private is None:
            found[who] = diary_rows_of(log, who)
            continue
        by_date = dict[str, Sequence[TimelineEntry]]()
        for day in (day for day in days if day.person == who):
            track = Track.of(day.outings)
            clock = LocalClock(log.setting(ZONE), track.time, track.lonlat)
            rows, _ = statements[who].rows([day], track)
            by_date[day.date] = [
                replace(row, offset=clock.offset(row.start), end_offset=clock.offset(row.end)) for row in rows
            ]
        found[who] = DiaryRows(by_date)
    return found


def diary_rows_of(log: Store, person: str) -> DiaryRows:
    """The rows of a person's whole diary."""
    whole = UnpartedDiary.of(log, person, [date for name, date in log.days() if name == person])
    return DiaryRows(dict(parted(whole.rows, whole.clock, whole.track)))


TRACKINTEL_MODES = {WALKING: "walk", PASSING: "walk", VEHICLE: "vehicle"}
WGS84 = "EPSG:4326"
NO_ID = -1


@dataclass(frozen=True)
class PersonRows:
    """A person's rows. stays and legs of the diary; places; track: all positions of `outings`; private: True if
    places are hidden.
    """

    person: str
    stays: tuple[TimelineEntry, ...]
    legs: tuple[TimelineEntry, ...]
    places: tuple[Place, ...]
    track: Track
    outings: tuple[Outing, ...]
    private: bool


def parquet_tables(
    days: Iterable[Day], statements: Mapping[str, Statements] = MappingProxyType({})
) -> dict[str, bytes]:
    """The tables of days as GeoParquet files by name; a table without rows is left out.

    statements: of each person; nothing by default. Raises InputError without the extra `geo`.
    """
    try:
        import geopandas  # noqa: F401  # pyright: ignore[reportUnusedImport]
        import pyarrow  # noqa: F401  # pyright: ignore[reportUnusedImport]
    except ImportError as error:
        raise InputError("--format parquet", "", f"no {error.name}", install("geo")) from None
    people = list[PersonRows]()
    for who, same in groupby(sorted(days, key=lambda day: (day.person, day.date)), key=lambda day: day.person):
        own = list(same)
        outings = tuple(outing for day in own for outing in day.outings if outing.frame.georeferenced)
        track = Track.of(outings)
        rows, places = statements.get(who, Statements()).rows(own, track)
        stays = tuple(row for row in rows if row.kind == STAY and np.isfinite(row.latitude))
        legs = tuple(row for row in rows if row.kind in TRACKINTEL_MODES and _line_of(track, row) is not None)
        private = statements.get(who, Statements()).private is not None
        people.append(PersonRows(who, stays, legs, places, track, outings, private))
    tables = {}
    frames = _positionfixes(people), _triplegs(people), _staypoints(people), _locations(people)
    for name, frame in zip(TABLE_NAMES, frames, strict=True):
        if len(frame):
            buffer = io.BytesIO()
            frame.to_parquet(buffer)
            tables[f"{name}.parquet"] = buffer.getvalue()
    return tables


def place_tables(diaries: Iterable[Diary]) -> dict[str, bytes]:
    """Time, flows and hours of all persons at places on plans as Parquet files, as ``lifelog show`` has."""
    import pandas

    days = [day for own in diaries for day in own.days]
    dwelt = dwells((day.person, row) for day in days for row in day.entries)
    made = dict[str, bytes]()
    for name, (rows, columns) in place_records(dwelt, flows(day.entries for day in days)).items():
        buffer = io.BytesIO()
        pandas.DataFrame(rows, columns=columns.split()).to_parquet(buffer)
        made[f"{Path(name).stem}.parquet"] = buffer.getvalue()
    return made


def _line_of(track: Track, row: TimelineEntry) -> Array | None:
    """Longitudes and latitudes ``(n, 2)`` of a track during a row, with interpolated ends; None for a single point."""
    if not len(track.time) or not row.is_seen:
        return None
    begin, after = (int(np.searchsorted(track.time, time, side="right")) for time in (row.start, row.end))
    near = slice(max(begin - 1, 0), after + 1)  # with the rows from which the ends are interpolated
    time, lonlat = track.time[near], track.lonlat[near]
    first, last = np.column_stack([np.interp([row.start, row.end], time, axis) for axis in lonlat.T])
    line = np.vstack([first, lonlat[(time > row.start) & (time < row.end)], last])
    return line if np.any(line != line[0]) else None


def _positionfixes(people: Sequence[PersonRows]) -> GeoDataFrame:
    """A row per position; track_id: of a part without gaps."""
    columns: dict[str, list[Array]] = {name: [] for name in ("user", "time", "lonlat", "track", "sigma", "floor")}
    stays, legs, number = list[Index](), list[Index](), 0
    first_stay = first_leg = 0
    for own in people:
        for outing, track in [(each, part) for each in own.outings for part, _ in split_at_gaps(each)]:
            rows, time = len(track), track.time + outing.epoch
            columns["user"].append(np.full(rows, own.person, dtype=object))
            columns["time"].append(time)
            columns["lonlat"].append(outing.frame.to_lonlat(track.position))
            columns["track"].append(np.full(rows, number))
            sigma = np.full(rows, np.nan) if track.covariance is None else horizontal_sigma(track.covariance)
            columns["sigma"].append(sigma)
            columns["floor"].append(np.array(track.floor, dtype=object))
            stays.append(_ids_at(time, own.stays, first_stay))
            legs.append(_ids_at(time, own.legs, first_leg))
            number += 1
        first_stay, first_leg = first_stay + len(own.stays), first_leg + len(own.legs)
    if not number:
        return _frame({"user_id": []}, [])
    whole = {name: np.concatenate(parts) for name, parts in columns.items()}
    about = {"user_id": whole["user"], "tracked_at": _timestamps(whole["time"]), "track_id": whole["track"]}
    about |= {"staypoint_id": _ids(np.concatenate(stays)), "tripleg_id": _ids(np.concatenate(legs))}
    return _frame(about | {"sigma": whole["sigma"], "floor": whole["floor"]}, shapely.points(whole["lonlat"]))


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
        "mode": [leg.mode or TRACKINTEL_MODES[leg.kind] for _, leg in rows],
        "distance": [leg.distance for _, leg in rows],
        "observed": [leg.observed for _, leg in rows],
    }
    lines = [_line_of(own.track, leg) for own, leg in rows]
    return _frame(about, [shapely.linestrings(line) for line in lines if line is not None])


def _staypoints(people: Sequence[PersonRows]) -> GeoDataFrame:
    """A row per stay."""
    rows = [(own, stay) for own in people for stay in own.stays]
    places = [(own.person, place.number) for own in people for place in own.places]
    number = {key: n for n, key in enumerate(places)}
    location = [number.get((own.person, stay.place_number), NO_ID) for own, stay in rows]
    about = _about(rows) | {
        "location_id": _ids(np.array(location, dtype=np.intp)),
        "name": [stay.place or (stay.facing[0][0] if stay.facing else "") for _, stay in rows],
        "observed": [stay.observed for _, stay in rows],
        "sigma": [stay.sigma for _, stay in rows],
        "floor": [" > ".join(stay.floor) for _, stay in rows],
    }
    return _frame(about, [shapely.Point(stay.longitude, stay.latitude) for _, stay in rows])


def _locations(people: Sequence[PersonRows]) -> GeoDataFrame:
    """A row per place with its center, and its extent: the hull of the visits with their uncertainty.

    The sigma of a private place is at least that of its best visit: blurred visits err all alike.
    """
    from geopandas import GeoSeries

    rows = [(own, place) for own in people for place in own.places]
    least = [min(visit.sigma for visit in place.visits) if own.private else 0.0 for own, place in rows]
    about: dict[str, Any] = {
        "user_id": [own.person for own, _ in rows],
        "name": [place.name for _, place in rows],
        "visits": [len(place.visits) for _, place in rows],
        "duration": [place.duration for _, place in rows],
        "sigma": [max(place.sigma, at_least) for (_, place), at_least in zip(rows, least, strict=True)],
        "extent": GeoSeries([_extent(own, place) for own, place in rows], crs=WGS84),
    }
    return _frame(about, [shapely.Point(place.longitude, place.latitude) for _, place in rows], "center")


def _extent(own: PersonRows, place: Place) -> shapely.Geometry:
    """The convex hull of the visits to a place, widened by two sigma, 10 m at least."""
    visits = [stay for stay in own.stays if stay.place_number == place.number]
    middle = np.array([place.longitude, place.latitude])
    metres = METRES_PER_DEGREE * np.array([np.cos(np.radians(place.latitude)), 1.0])
    discs = [
        shapely.Point((np.array([stay.longitude, stay.latitude]) - middle) * metres).buffer(
            max(2 * stay.sigma, 10.0), quad_segs=4
        )
        for stay in visits
    ]
    hull = shapely.convex_hull(shapely.union_all(discs))
    return shapely.transform(hull, lambda corners: corners / metres + middle)


def _about(rows: Sequence[tuple[PersonRows, TimelineEntry]]) -> dict[str, Any]:
    """The columns that triplegs and staypoints share."""
    return {
        "user_id": [own.person for own, _ in rows],
        "started_at": _timestamps(np.array([row.start for _, row in rows])),
        "finished_at": _timestamps(np.array([row.end for _, row in rows])),
        "corrected": [row.corrected for _, row in rows],
        "guess": [row.guess for _, row in rows],
    }


def _timestamps(unix: Array) -> Any:
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
