"""Local time: the time zone where the person was, the midnights there, and periods of local days.

Zones come from the boundaries of the IANA time zones (tzfpy, data of timezone-boundary-builder), so a diary follows its
person abroad and through daylight saving time. A lifelog whose zone was chosen keeps that zone everywhere.
"""

from __future__ import annotations

import calendar
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta, tzinfo
from functools import lru_cache
from zoneinfo import ZoneInfo

import numpy as np

from pdr_graph.errors import InputError
from pdr_graph.types import Array


def zone_at(latitude: float, longitude: float) -> str:
    """Name of the time zone at a place; "" where it is unknown."""
    return _zone_near(round(latitude, 3), round(longitude, 3)) if np.isfinite(latitude + longitude) else ""


@lru_cache(maxsize=4096)
def _zone_near(latitude: float, longitude: float) -> str:
    from tzfpy import get_tz  # loads 7 MB of boundaries

    return get_tz(longitude, latitude)


@lru_cache(maxsize=256)
def zone_named(name: str) -> tzinfo:
    """The time zone of a name; UTC for "" and for names that the time zone database lacks."""
    try:
        return ZoneInfo(name) if name and name != "UTC" else UTC
    except (OSError, ValueError, LookupError):
        return UTC


LOCAL_ZONE = "local"  # name of "the zone of each place" on the command line


def checked_zone(name: str) -> str:
    """The setting of a time zone: its name, "" for LOCAL_ZONE. Raises InputError for an unknown name."""
    if name in (LOCAL_ZONE, "UTC"):
        return "" if name == LOCAL_ZONE else name
    try:
        ZoneInfo(name)
        return name
    except (OSError, ValueError, LookupError):
        raise InputError("--zone", "", repr(name), "a time zone, as Europe/Berlin, or local") from None


class LocalClock:
    """The clock on the wall where a person was.

    zone: name of a fixed zone, "" for the zone of the nearest position in time;
    time ``(n,)`` Unix times [s], in order, and lonlat ``(n, 2)`` [deg]: the known positions.
    """

    def __init__(self, zone: str, time: Array, lonlat: Array):
        self._fixed, self._time, self._lonlat = zone, time, lonlat

    def zone(self, time: float) -> tzinfo:
        """The time zone where the person was at a Unix time [s]; UTC without any position."""
        if self._fixed or not len(self._time):
            return zone_named(self._fixed)
        after = int(np.searchsorted(self._time, time))
        beside = [n for n in (after - 1, after) if 0 <= n < len(self._time)]
        longitude, latitude = self._lonlat[min(beside, key=lambda n: abs(self._time[n] - time))].tolist()
        return zone_named(zone_at(latitude, longitude))

    def at(self, time: float) -> datetime:
        """Local time and date at a Unix time [s]."""
        return datetime.fromtimestamp(time, self.zone(time))

    def offset(self, time: float) -> float:
        """Offset of local time from UTC at a Unix time [s]."""
        offset = self.at(time).utcoffset()
        return 0.0 if offset is None else offset.total_seconds()

    def next_midnight(self, time: float) -> float:
        """Unix time [s] of the first midnight after a time, by the zone of that time."""
        here = self.at(time)
        day = (here.replace(tzinfo=None) + timedelta(days=1)).replace(hour=0, minute=0, second=0, microsecond=0)
        return day.replace(tzinfo=here.tzinfo).timestamp()

    def midnight_before(self, time: float) -> float:
        """Unix time [s] of the midnight before a time, or at it, by the zone of that time."""
        return self.at(time).replace(hour=0, minute=0, second=0, microsecond=0).timestamp()


DAY, WEEK, MONTH, YEAR, ALL = "day", "week", "month", "year", "all"
LAST_DATE = date.max - timedelta(days=7)  # so that a week after it can be computed


@dataclass(frozen=True)
class Period:
    """Consecutive dates, first and last included. kind: DAY, WEEK, MONTH, YEAR or ALL; name: as the user writes it."""

    kind: str
    name: str
    first: date
    last: date

    @property
    def dates(self) -> Iterator[date]:
        """Every date of the period."""
        return (self.first + timedelta(days=n) for n in range((self.last - self.first).days + 1))

    def __len__(self) -> int:
        return (self.last - self.first).days + 1


def period_of(day: str = "", week: str = "", month: str = "", year: str = "") -> Period | None:
    """The period that one of the texts describes: 2024-05-01, 2024-W18, 2024-05, 2024; None if all are empty.

    Raises InputError for a text of another form, and for more than one text.
    """
    forms = (
        ("--date", day, DAY, "{}", "2024-05-01"),
        ("--week", week, WEEK, "{}-1", "2024-W18"),
        ("--month", month, MONTH, "{}-01", "2024-05"),
        ("--year", year, YEAR, "{}-01-01", "2024"),
    )
    given = [form for form in forms if form[1]]
    if len(given) > 1:
        raise InputError(" and ".join(form[0] for form in given), "", f"{len(given)} periods", "one of them")
    for option, text, kind, form, example in given:
        try:
            first = date.fromisoformat(form.format(text.upper()))
            last = {
                DAY: first,
                WEEK: min(first, LAST_DATE) + timedelta(days=6),
                MONTH: first.replace(day=calendar.monthrange(first.year, first.month)[1]),
                YEAR: first.replace(month=12, day=31),
            }[kind]
        except ValueError:
            first = last = date.max
        if last > LAST_DATE:
            raise InputError(option, "", repr(text), f"a {kind} such as {example}")
        return Period(kind, text, first, last)
    return None
