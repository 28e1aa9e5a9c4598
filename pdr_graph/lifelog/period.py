"""The period of an overview: a day, an ISO week, a month, a year, or everything."""

from __future__ import annotations

import calendar
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import date, timedelta

from pdr_graph.errors import InputError

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
    options = {"--date": day, "--week": week, "--month": month, "--year": year}
    texts = {option: text for option, text in options.items() if text}
    if len(texts) > 1:
        raise InputError(" and ".join(texts), "", f"{len(texts)} periods", "one of them")
    for option, text in texts.items():
        kind, read, example = _FORMS[option]
        try:
            first, last = read(text)
        except (ValueError, OverflowError):
            raise InputError(option, "", repr(text), f"a {kind} such as {example}") from None
        if last > LAST_DATE:
            raise InputError(option, "", repr(text), f"a {kind} such as {example}")
        return Period(kind, text, first, last)
    return None


def _day(text: str) -> tuple[date, date]:
    return date.fromisoformat(text), date.fromisoformat(text)


def _week(text: str) -> tuple[date, date]:
    year, week = text.upper().split("-W")
    monday = date.fromisocalendar(int(year), int(week), 1)
    return monday, monday + timedelta(days=6)


def _month(text: str) -> tuple[date, date]:
    first = date.fromisoformat(f"{text}-01")
    return first, first.replace(day=calendar.monthrange(first.year, first.month)[1])


def _year(text: str) -> tuple[date, date]:
    return date(int(text), 1, 1), date(int(text), 12, 31)


_FORMS = {
    "--date": (DAY, _day, "2024-05-01"),
    "--week": (WEEK, _week, "2024-W18"),
    "--month": (MONTH, _month, "2024-05"),
    "--year": (YEAR, _year, "2024"),
}
