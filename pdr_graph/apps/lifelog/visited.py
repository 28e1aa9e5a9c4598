"""Receipts and photos: places where a person was by another source than the phone's positions.

A receipt has a place and a time of the till, a date, or an earliest and a latest time; a photo has the place and the
time of its EXIF tags (CIPA DC-008, Exif 3.0: GPS position and its error, DateTimeOriginal, OffsetTimeOriginal, GPS
stamps in UTC). Any may be false: a friend's photo, a clock of another zone, somebody else's receipt. So they are no
corrections: the walk that may have passed a place has it as a measurement that may be an outlier (`untimed_fixes.py`),
positions alone are compared with it, and the diary names it beside the row where it fits, or says why it does not.
"""

from __future__ import annotations

import math
import time as clock
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from datetime import UTC, datetime, timedelta
from importlib import import_module
from pathlib import Path
from typing import Any, Self

import numpy as np

from pdr_graph.apps.lifelog.corrections import place_names
from pdr_graph.apps.lifelog.facts import VISITED, Correction
from pdr_graph.apps.lifelog.local_time import LocalClock, zone_at, zone_named
from pdr_graph.apps.lifelog.stays_and_legs import Track
from pdr_graph.apps.lifelog.store import ZONE, Store
from pdr_graph.apps.lifelog.timeline import TimelineEntry, distance_text
from pdr_graph.errors import InputError, one_line
from pdr_graph.frames import enu
from pdr_graph.geometry import as_complex
from pdr_graph.io.tables import check_geodetic, check_rows, named_area, read_table
from pdr_graph.io.validation import RADIUS_68, float_of
from pdr_graph.types import DAY_LENGTH, FINEST, Array, Mask

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".heic", ".heif")
PHOTO, RECEIPT = "photo", "receipt"
TIME_FORM = "a date or a local time, as 2024-05-01 or 2024-05-01 13:10, in time, or in earliest and latest"
# Standard deviations per axis [m] of a shop on a map, a phone's position in a photo, a track at least, and one on a
# plan; errors of the clocks of tills and cameras [s]; chosen by hand
RECEIPT_SIGMA, PHOTO_SIGMA, TRACK_SIGMA, PLAN_SIGMA = 15.0, 15.0, 20.0, 2.0
MOST_SIGMA = 100.0  # [m] of a track whose place is hardly known: a place far off does not fit it
TILL, SHUTTER = 120.0, 5.0
EXACT = 600.0  # [s] in which a place with a time was visited: that time is shown
LEAST_SILENCE = 600.0  # [s] without data in which somebody may have been elsewhere
FITS = 3.0  # standard deviations of a place from the track within which it fits
LONGEST_SPAN = 366 * DAY_LENGTH  # [s] between earliest and latest
OTHER_ZONES = sorted((h for h in range(-14, 15) if h), key=abs)  # [h] that a clock may be off
SEARCHED = 3 * DAY_LENGTH  # [s] around a time, in which a place that does not fit is sought


@dataclass(frozen=True)
class Summed:
    """A result that adds up, field by field."""

    def __add__(self, other: Self) -> Self:
        """The result of both."""
        return type(self)(*(getattr(self, each.name) + getattr(other, each.name) for each in fields(self)))


@dataclass(frozen=True)
class Added(Summed):
    """Result of adding places: new ones, those that were there already, photos without a place or time, and a line for
    each file that was refused.
    """

    new: int = 0
    existing: int = 0
    unplaced: int = 0
    refused: tuple[str, ...] = ()


def photos_in(paths: Iterable[Path]) -> list[Path]:
    """The photos among files and in folders, by their suffixes."""
    found = list[Path]()
    for path in paths:
        inner = sorted(path.rglob("*")) if path.is_dir() else [path]
        found += [file for file in inner if file.suffix.lower() in PHOTO_SUFFIXES and file.is_file()]
    return found


def add_places(log: Store, person: str, receipts: Path | None, photos: Sequence[Path]) -> Added:
    """Add the places of a table of receipts, and of photos, to a lifelog; each once.

    Raises InputError naming the line of the table.
    """
    known = {(c.span, c.content) for c in log.corrections(person) if c.kind == VISITED}
    found = [] if receipts is None else list(_receipts(log, person, receipts))
    refused, unplaced, before = list[str](), 0, len(known)
    for path in photos:
        try:
            photo = read_photo(path, log.setting(ZONE))
        except InputError as error:
            refused.append(str(error))
            continue
        unplaced += photo is None
        found += [] if photo is None else [photo]
    for span, value in found:
        fact = Correction(0, person, clock.time(), VISITED, *span, value)
        if (span, fact.content) not in known:
            known.add((span, fact.content))
            log.put_correction(fact)
    new = len(known) - before
    return Added(new, len(found) - new, unplaced, tuple(refused))


Fact = tuple[tuple[float, float], dict[str, float | str]]  # span [s], value of a correction


def _receipts(log: Store, person: str, path: Path) -> Iterable[Fact]:
    """The places of a table ``place`` or ``lat,lon``, with ``time`` or ``earliest,latest`` and ``sigma``."""
    columns = ("place", "time", "earliest", "latest")
    numbers, words = read_table(path, [("lat", "lon"), ()], ("sigma",), columns)
    rows = len(words["place"])
    sigma = numbers.get("sigma", np.full(rows, np.nan))
    check_rows(path, sigma < FINEST, sigma, "sigma", f"a standard deviation of {FINEST:g} m or more")
    if "lat" in numbers:
        check_geodetic(path, numbers)
    elif not any(words["place"]):
        raise InputError(
            path, "line 1", "no place", "place (a name in the diary or on the plan) or lat,lon in each row"
        )
    fixed = log.setting(ZONE)
    for row in range(rows):
        name, where = words["place"][row].strip(), f"data row {row + 1}"
        if "lat" in numbers:
            place = float(numbers["lat"][row]), float(numbers["lon"][row]), RECEIPT_SIGMA
        else:
            place = _named(log, person, path, row, name)
        zone = zone_named(fixed or zone_at(*place[:2]))
        given = [words[column][row].strip() for column in columns[1:]]
        try:
            spans = [_span(text, zone) for text in given if text]
        except (ValueError, OverflowError):
            raise InputError(path, f"{where}, time", ", ".join(filter(None, given))[:60], TIME_FORM) from None
        if not spans or (not given[0] and len(spans) < 2):
            raise InputError(path, where, "no time", f"{TIME_FORM}; smooth --visited takes places without any")
        start, end = spans[0][0], spans[-1][1]
        if spans[0][0] > spans[-1][0] or end - start > LONGEST_SPAN:
            raise InputError(path, f"{where}, latest", ", ".join(given[1:]), "latest after earliest, by a year at most")
        radius = float(sigma[row]) if np.isfinite(sigma[row]) else place[2]
        about = {"name": one_line(name) or f"row {row + 1}", "source": RECEIPT}
        yield (start, end), {"latitude": place[0], "longitude": place[1], "radius": radius} | about


def _span(text: str, zone: Any) -> tuple[float, float]:
    """First and last Unix time [s] that a text may mean: a day, a minute, a second, with the error of a till's clock.

    Raises ValueError for other texts.
    """
    if math.isfinite(number := float_of(text)):
        return number - TILL, number + TILL
    time = datetime.fromisoformat(text)
    time = time if time.tzinfo else time.replace(tzinfo=zone)
    if len(text) <= len("2024-05-01"):
        return time.timestamp(), (time + timedelta(days=1)).timestamp()
    whole = 60.0 if time.second == 0 else 0.0  # a till that prints minutes
    return time.timestamp() - TILL, time.timestamp() + whole + TILL


def _named(log: Store, person: str, path: Path, row: int, name: str) -> tuple[float, float, float]:
    """Latitude, longitude [deg] and sigma [m] of a place that the person has named, or of an area of a plan."""
    from pdr_graph.floor.plan_files import Building  # loads SciPy, which most diaries do not need

    named = {known.casefold(): (*place, radius / 2) for *place, radius, known in place_names(log.corrections(person))}
    if name.casefold() in named:
        latitude, longitude, sigma = named[name.casefold()]
        return latitude, longitude, sigma
    plans = dict.fromkeys(e.options.plan for e in log.entries() if e.person == person and e.options.plan is not None)
    floors = [floor for plan in plans for floor in Building.load(plan).floors]
    if not floors or not floors[0].frame.georeferenced:
        expected = "a name of the diary, or of a plan with latitudes that a recording has; or lat,lon in each row"
        raise InputError(path, f"data row {row + 1}, place", repr(name), expected)
    position, sigma = named_area(path, row, name, floors)
    frame = floors[0].frame
    longitude, latitude = frame.to_lonlat(position[None])[0].tolist()
    return latitude, longitude, sigma


def read_photo(path: Path, zone: str = "") -> Fact | None:
    """The place and time of a photo; None if it has none.

    A time without offset has that of the GPS stamps, which are UTC; without these it is local time of the place. zone:
    of the lifelog, "" for that of the place. Raises InputError if it cannot be read.
    """
    from PIL import ExifTags, Image  # loads its plugins, which few commands need

    if path.suffix.lower() in PHOTO_SUFFIXES[2:]:
        try:
            import_module("pillow_heif").register_heif_opener()  # extra photos
        except ImportError:
            raise InputError(
                path, "", "a HEIC photo", "pillow-heif (pip install 'pdr_graph[photos]'), or JPEG"
            ) from None
    try:
        with Image.open(path) as image:
            tags = image.getexif()
            gps, own = tags.get_ifd(ExifTags.IFD.GPSInfo), tags.get_ifd(ExifTags.IFD.Exif)
    except (
        OSError,
        ValueError,
        TypeError,
        SyntaxError,
        LookupError,
        ArithmeticError,
        Image.DecompressionBombError,
    ) as e:
        raise InputError(path, "", one_line(str(e))[:80] or type(e).__name__, "a whole JPEG or HEIC photo") from None
    latitude, longitude = (_degrees(gps.get(n), str(gps.get(n - 1, ""))) for n in (2, 4))
    if not (abs(latitude) <= 90 and abs(longitude) <= 180 and (latitude or longitude)):
        return None
    taken = _stamp(str(own.get(36867) or tags.get(306) or ""))
    if taken is None:
        return None
    offset, stamp = _stamp("2000:01:01 00:00:00" + str(own.get(36881, "")).strip()), _gps_stamp(gps)
    if offset is not None and offset.tzinfo is not None:
        moment = taken.replace(tzinfo=offset.tzinfo)
    elif stamp is not None and abs((away := stamp - taken.replace(tzinfo=UTC)).total_seconds()) < 15 * 3600:
        quarters = timedelta(minutes=15) * round(away / timedelta(minutes=15))  # zones are whole quarters of an hour
        moment = taken.replace(tzinfo=UTC) + quarters
    else:
        moment = taken.replace(tzinfo=zone_named(zone or zone_at(latitude, longitude)))
    error = _number(gps.get(31))
    radius = error / RADIUS_68 if error > 0 else PHOTO_SIGMA
    value = {"latitude": latitude, "longitude": longitude, "radius": round(max(radius, 1.0), 1)}
    start, end = moment.timestamp() - SHUTTER, moment.timestamp() + SHUTTER
    return (start, end), value | {"name": one_line(path.name), "source": PHOTO}


def _number(value: Any) -> float:
    """A rational of EXIF, NaN if it is none."""
    try:
        return float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return math.nan


def _degrees(value: Any, reference: str) -> float:
    """Degrees of degrees, minutes and seconds; NaN if they are none."""
    parts = [_number(part) for part in value] if isinstance(value, tuple | list) and len(value) == 3 else [math.nan]
    size = sum(part / 60**n for n, part in enumerate(parts))
    return -size if reference.strip().upper()[:1] in ("S", "W") else size


def _stamp(text: str) -> datetime | None:
    """The time of a stamp ``2024:05:01 13:10:02``; None for others, as cameras without a clock write."""
    try:
        return datetime.fromisoformat(text.strip("\0 ").replace(":", "-", 2))
    except ValueError:
        return None


def _gps_stamp(gps: dict[int, Any]) -> datetime | None:
    """The time of the GPS stamps, UTC."""
    hours = [_number(part) for part in gps.get(7) or ()]
    day = _stamp(f"{gps.get(29, '')} 00:00:00")
    if day is None or len(hours) != 3 or not all(map(math.isfinite, hours)):
        return None
    return day.replace(tzinfo=UTC) + timedelta(hours=hours[0], minutes=hours[1], seconds=hours[2])


# Beside the diary


def beside(
    rows: Sequence[TimelineEntry], track: Track, places: Iterable[Correction], local: LocalClock
) -> tuple[list[TimelineEntry], tuple[tuple[float, str], ...]]:
    """The rows with the receipts and photos that fit, and of the others a time [s] and a line each.

    A place fits if the track comes within three standard deviations of both in its time.
    """
    found, doubts = list(rows), list[tuple[float, str]]()
    for place in places:
        inside = [n for n, row in enumerate(found) if row.start < place.end and row.end > place.start]
        name, middle = f"{place.text('source')} {place.text('name')}", (place.start + place.end) / 2
        if not any(found[n].is_seen for n in inside):
            text = f"{name}: at {place.place[0]:.5f}, {place.place[1]:.5f}, no data then"
            n = next((n for n in inside if found[n].start <= middle <= found[n].end), -1)
            if n < 0:  # before the first row, or after the last
                doubts.append((middle, text))
            else:
                found[n] = replace(found[n], evidence=(*found[n].evidence, (middle, text)))
            continue
        time, off, fits = _passes(found, track, place, place.start, place.end)
        nearest = int(np.argmin(off)) if len(off) else -1
        if nearest < 0 or not fits[nearest]:
            far = float(off[nearest]) if len(off) else math.inf
            why = _why(found, track, place, far, local)
            silent = [
                min(found[n].end, place.end) - max(found[n].start, place.start) for n in inside if not found[n].is_seen
            ]
            unless = ", unless it was in the time without data" if sum(silent) > LEAST_SILENCE else ""
            doubts.append((middle, f"{name} does not fit: {why}{unless}"))
            continue
        n = next(n for n in inside if found[n].start <= time[nearest] <= found[n].end)
        shown = middle if place.end - place.start <= EXACT else float(time[nearest])
        shown = min(max(shown, found[n].start), found[n].end)
        found[n] = replace(found[n], evidence=(*found[n].evidence, (shown, f"{name}, {off[nearest]:.0f} m")))
    return found, tuple(doubts)


def _passes(
    rows: Sequence[TimelineEntry], track: Track, place: Correction, start: float, end: float
) -> tuple[Array, Array, Mask]:
    """Time ``(n,)`` [s] and distance [m] of each interval of the track, with data and within a time, where it is
    nearest to a place, and whether the place fits there.
    """
    first, last = np.searchsorted(track.time, [start, end])  # from the position before to that after: nobody knows when
    rows_of_time = slice(max(int(first) - 1, 0), int(last) + 1)
    time, lonlat = track.time[rows_of_time], track.lonlat[rows_of_time]
    way = as_complex(enu(*place.place).from_lonlat(lonlat))
    along = np.diff(way)
    share = np.clip(-(way[:-1] * along.conj()).real / np.maximum(np.abs(along) ** 2, 1e-9), 0.0, 1.0)
    off, at = np.abs(way[:-1] + share * along), np.clip(time[:-1] + share * np.diff(time), start, end)
    seen = [(row.start, row.end) for row in rows if row.is_seen and row.end > start and row.start < end]
    known = np.zeros(len(at), dtype=bool)
    for first, last in seen:
        known |= (at >= first) & (at <= last)
    ends = track.plan[rows_of_time], track.sigma[rows_of_time]
    least = np.where(ends[0][1:], PLAN_SIGMA, TRACK_SIGMA)
    sigma = np.maximum(least, np.minimum(np.maximum(ends[1][1:], ends[1][:-1]), MOST_SIGMA))
    fits = off <= FITS * np.hypot(place.radius, sigma)
    return at[known], off[known], fits[known]


def _why(rows: Sequence[TimelineEntry], track: Track, place: Correction, off: float, local: LocalClock) -> str:
    """How far a place is from the way of its time, and when the person was there instead."""
    text = f"{distance_text(off)} from the way" if math.isfinite(off) else "no position then"
    for hours in OTHER_ZONES if place.text("source") == PHOTO else ():
        if _passes(rows, track, place, place.start + 3600 * hours, place.end + 3600 * hours)[2].any():
            return f"{text}; there {abs(hours)} h {'later' if hours > 0 else 'earlier'}: a clock of another time zone?"
    at, _, fits = _passes(rows, track, place, place.start - SEARCHED, place.end + SEARCHED)
    if fits.any():
        when = min(at[fits].tolist(), key=lambda time: max(place.start - time, time - place.end))
        return f"{text}; there at {local.at(when):%Y-%m-%d %H:%M}: of another time?"
    return f"{text}: somebody else's?"
