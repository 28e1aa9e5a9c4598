"""Days given away: from a lifelog to files, without what the user wants to keep private."""

from __future__ import annotations

import secrets
from collections.abc import Iterator, Sequence
from datetime import date, tzinfo
from pathlib import Path
from urllib.parse import quote
from zoneinfo import ZoneInfo

from pdr_graph.errors import InputError
from pdr_graph.lifelog import files
from pdr_graph.lifelog.day import Day
from pdr_graph.lifelog.export import as_csv, as_geojson, as_gpx, notes
from pdr_graph.lifelog.privacy import shared
from pdr_graph.lifelog.private_places import PrivatePlace, private_places
from pdr_graph.lifelog.store import ZONE, Store
from pdr_graph.lifelog.timeline import table, timeline

GPX, GEOJSON, CSV = "gpx", "geojson", "csv"
DOCUMENTS = {GPX: as_gpx, GEOJSON: as_geojson}
SECRET, SECRET_BYTES = "secret", 32  # the setting by which private places are hidden, and its length


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
        raise InputError("--out", "", str(out), "a folder: CSV is two files for each day")
    said, written = list[str](), list[Path]()
    with Store(path) as log:
        zone, wanted = ZoneInfo(log.setting(ZONE)), _wanted(log, person, _day("--from", since), _day("--to", until))
        places = _places(log, cut), _places(log, blur)
        days = _shown(log, wanted, form, places, said)
        for target, content in _whole(out, form, list(days)) if single else _by_day(out, form, days, zone):
            files.write(target, content)
            written.append(target)
    return written, said


def _day(option: str, text: str) -> str:
    try:
        return date.fromisoformat(text).isoformat() if text else ""
    except ValueError:
        raise InputError(option, "", repr(text), "a day as 2024-05-01") from None


def _wanted(log: Store, person: str | None, since: str, until: str) -> list[tuple[str, str]]:
    """Persons and days within what was asked for, of which there must be one."""
    days = [key for key in log.days() if person in (None, key[0])]
    if not days:
        needed = "a lifelog that pdr-graph lifelog build has built" if person is None else "somebody who has"
        raise InputError(log.path, "" if person is None else person, "no day", needed)
    wanted = [key for key in days if (not since or key[1] >= since) and (not until or key[1] <= until)]
    if not wanted:
        there = sorted(day for _, day in days)
        raise InputError(
            log.path, f"{since or '…'} to {until or '…'}", "no day", f"some from {there[0]} to {there[-1]}"
        )
    return wanted


def _places(log: Store, texts: Sequence[str]) -> tuple[PrivatePlace, ...]:
    plans = sorted({entry.plan for entry in log.entries() if entry.plan})
    return private_places(texts, plans, _secret(log)) if texts else ()


def _secret(log: Store) -> bytes:
    """The lifelog's own: another one each time would give a private place away, export by export."""
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
    """Days one after the other, as they may be shown, if there is something of them to show; notes go to ``said``."""
    for person, day in wanted:
        there = log.day(person, day)
        left, lines = shared([there] if there else [], *places)
        said += lines if form == CSV else [*lines, *notes(left)]
        if any(form == CSV or outing.frame.georeferenced for own in left for outing in own.outings):
            yield from left
        else:
            said.append(f"{person}, {day}: nothing of it can be shown")


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
