"""A lifelog in the browser of its owner: days, months and the places, with forms that correct them.

For this machine alone, with a token in the address that is printed. A day, a month and a place are the pages that
``pdr-graph lifelog show`` writes (`lifelog.overview_page`), with links and forms; ``web/diary.js`` opens the forms
beside the picture of a day. Nothing is loaded but from this server, and tiles from a server of the user's choice. A
correction does what ``pdr-graph lifelog correct`` does.

A correction must come from a form of these pages: the browser states this origin (so pages must send a referrer to
their own server, else browsers write ``Origin: null``), and the form has a key derived from the token.
"""

from __future__ import annotations

import asyncio
import hmac
import re
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, date, datetime, timedelta
from html import escape
from pathlib import Path
from urllib.parse import parse_qs, urlencode

import numpy as np
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, PlainTextResponse, RedirectResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from pdr_graph.apps.lifelog import revision
from pdr_graph.apps.lifelog.diary import DiaryDay, dates_of, diary
from pdr_graph.apps.lifelog.facts import MODE_ACTIVITIES
from pdr_graph.apps.lifelog.local_time import ALL, DAY, LAST_DATE, MONTH, WEEK, Period, period_of
from pdr_graph.apps.lifelog.maps import TileServer
from pdr_graph.apps.lifelog.overview import Overview, entry_text, guess_notes, overview, places_table, row_texts
from pdr_graph.apps.lifelog.overview_page import body, document, html_table, script_hash, title_of
from pdr_graph.apps.lifelog.picture import Links, linked, tag
from pdr_graph.apps.lifelog.show import TRACK_TOLERANCE, Choice, overview_of
from pdr_graph.apps.lifelog.stays_and_legs import MOVING
from pdr_graph.apps.lifelog.store import Store
from pdr_graph.apps.lifelog.timeline import STAY
from pdr_graph.apps.serve.access import OWNER, Access, cookie_name
from pdr_graph.apps.serve.application import WEB, Guard, security_headers
from pdr_graph.errors import InputError, count, one_line

NUMBER = re.compile(r"[0-9]{1,9}")  # of an entry or a correction
KEY = "key"  # field of every form that corrects
KEY_PLACE = "<!-- key -->"  # of it in the page of such a form; texts are escaped
LONGEST_FORM = 1 << 14  # [bytes]
MAP_TOLERANCE = 2.0  # [m] to which the tracks of a map are simplified
DAYS_AROUND = 40  # days before and after one, among which the next recorded one is looked for
Fields = Mapping[str, str]


class DiaryLinks(Links):
    """The addresses of the pages of the diary."""

    def day(self, person: str, on: str) -> str:
        """Address of a day."""
        return "./?" + urlencode({"person": person, "date": on})

    def place(self, person: str, number: int) -> str:
        """Address of a place; "" for none."""
        return "place?" + urlencode({"person": person, "number": number}) if number >= 0 else ""

    def entry(self, day: DiaryDay, number: int) -> str:
        """Address of the forms of an entry."""
        return "entry?" + urlencode({"person": day.person, "date": day.date, "n": number})


LINKS = DiaryLinks()


class DiaryServer:
    """The lifelog of the routes. One request at a time opens the store. tiles: address of a tile server."""

    def __init__(self, store: Path, token: str, tiles: str | None):
        self.store, self.tiles, self.lock = store, tiles or "", asyncio.Lock()
        self.key = hmac.digest(token.encode(), b"forms of the diary", "sha256").hex()
        self.headers = security_headers(tiles, "'self'", " 'unsafe-inline'") | {"Cache-Control": "no-store"}
        policy = self.headers["Content-Security-Policy"].replace("script-src", f"script-src {script_hash()}")
        self.headers |= {"Content-Security-Policy": policy, "Referrer-Policy": "same-origin"}

    async def run(self, function: Callable[..., str], query: Fields) -> Response:
        """The page that a function makes; the line of an InputError as a page with status 400."""
        status = 200
        async with self.lock:
            try:
                content = await run_in_threadpool(function, self.store, query, TileServer(self.tiles, embeds=False))
            except (InputError, OSError) as error:
                status = 400 if isinstance(error, InputError) else 500
                content = _page("not possible", tag("p", escape(one_line(str(error))), class_="fault"))
        return HTMLResponse(
            content.replace(KEY_PLACE, tag("input", type="hidden", name=KEY, value=self.key)), status, self.headers
        )


def application(store: Path, token: str, tiles: str | None = None) -> Starlette:
    """The ASGI application of a lifelog. token: which every request must have; tiles: address of a tile server."""
    server = DiaryServer(store, token, tiles)

    def shown(function: Callable[..., str]) -> Callable[[Request], Awaitable[Response]]:
        async def answer(request: Request) -> Response:
            if "token" in request.query_params:
                response = RedirectResponse("./", 303)  # the token stays in no history
                name, token = cookie_name(request.headers), request.query_params["token"]
                response.set_cookie(name, token, httponly=True, samesite="strict")
                return response
            return await server.run(function, request.query_params)

        return answer

    async def correct(request: Request) -> Response:
        body = b""
        async for part in request.stream():
            body += part
            if len(body) > LONGEST_FORM:
                return PlainTextResponse(f"found a form of over {LONGEST_FORM} bytes\n", 413)
        fields = {name: values[0] for name, values in parse_qs(body.decode(errors="replace")).items()}
        if not hmac.compare_digest(fields.get(KEY, "").encode(), server.key.encode()):
            return PlainTextResponse("found a form of another page, expected one of this diary: reload it\n", 403)
        return await server.run(corrected_page, fields)

    pages = {"/": day_page, "/calendar": month_page, "/places": places_page, "/place": place_page}
    pages |= {"/entry": entry_page, "/corrections": list_page, "/everybody": everybody_page}
    routes = [Route(path, shown(function)) for path, function in pages.items()]
    routes += [Mount("/web", StaticFiles(directory=WEB)), Route("/correct", correct, methods=["POST"])]
    return Starlette(False, routes, [Middleware(Guard, Access({OWNER: token}))])


def _page(title: str, content: str, person: str = "", links: Sequence[str] = ()) -> str:
    """A page with the links to all others. links: to those beside it, as HTML."""
    query = "?" + urlencode({"person": person}) if person else ""
    tops = [("./", "last day"), ("calendar", "calendar"), ("places", "places"), ("corrections", "corrections")]
    top = " · ".join([*(linked(path + query, text) for path, text in tops), linked("everybody", "everybody")])
    return document(title, content, above=tag("nav", top, class_="top"), below=tag("nav", " · ".join(links)))


def _body(shown: Overview, tiles: TileServer, below: str = "") -> str:
    """The content of a page with what other programs guessed, as a note. below: HTML below the picture."""
    notes = (tag("p", escape(f"note: {line}"), class_="soft") for line in guess_notes(shown))
    return "".join(notes) + body(shown, tiles, LINKS, below)


def day_page(store: Path, query: Fields, tiles: TileServer) -> str:
    """A day, whose entries and places lead to their forms; the last day without a date."""
    own, dates, known, people = _day(store, query)
    with Store(store, reads=True) as log:
        found = diary(log, own.person, own.date, own.date, MAP_TOLERANCE)
    on = date.fromisoformat(own.date)
    shown = overview([found], Period(DAY, own.date, on, on))
    links = _beside("./", "date", own.date, dates, own.person)
    links += [linked("calendar?" + urlencode({"person": own.person, "month": own.date[:7]}), own.date[:7])]
    forms = tag("section", id="forms", aria_live="polite", hidden="") + tag("script", type="module", src="web/diary.js")
    links.append(_chooser("./", own.person, people, _date_field("date", "date", known, own.date)))
    return _page(title_of(shown), _body(shown, tiles, forms), own.person, links)


def _beside(path: str, name: str, own: str, known: Sequence[str], person: str) -> list[str]:
    """Links to the day or month before and to the one after. name: of the field of the query; known: all, in order."""
    at = known.index(own)
    near = [(other, f"← {other}") for other in known[max(at - 1, 0) : at]]
    near += [(other, f"{other} →") for other in known[at + 1 : at + 2]]
    return [linked(f"{path}?{urlencode({'person': person, name: other})}", text) for other, text in near]


def _chooser(path: str, person: str, people: Sequence[str], *fields: str) -> str:
    """A form that opens another person, and what other fields it has, on the same page; "" if there is none."""
    if len(people) > 1:
        names = tag("datalist", *(tag("option", value=name) for name in people), id="people")
        fields = (tag("label", "person ", tag("input", name="person", value=person, list="people")), names, *fields)
    elif fields:
        fields = (tag("input", type="hidden", name="person", value=person), *fields)
    return tag("form", *fields, tag("button", "Show"), class_="chooser", action=path) if fields else ""


def _date_field(name: str, kind: str, dates: Sequence[str], own: str) -> str:
    """The field of a date or a month, from the first to the last of some."""
    return tag("input", type=kind, name=name, value=own, min=dates[0], max=dates[-1], aria_label=name)


def _person(log: Store, query: Fields) -> tuple[str, list[str], list[str]]:
    """The person of a query, the dates of that person, and all persons. Raises InputError without any."""
    known = dates_of(log)
    people = sorted({name for name, _ in known})
    person = revision.person_of(log, query.get("person") or (people[0] if people else None))
    dates = [on for name, on in known if name == person]
    if not dates:
        raise InputError(log.path, "", "no day", "lifelog build, and more than one position a day")
    return person, dates, people


def month_page(store: Path, query: Fields, tiles: TileServer) -> str:
    """A month of a person, whose days and places lead to their pages; the last month by default."""
    with Store(store, reads=True) as log:
        person, dates, people = _person(log, query)
        month = period_of(month=query.get("month") or dates[-1][:7])
        if month is None:
            raise InputError("month", "", "nothing", "a month such as 2024-05")
        own = diary(log, person, month.first.isoformat(), month.last.isoformat(), TRACK_TOLERANCE)
    shown = overview([replace(own, days=tuple(day for day in own.days if day.known))], month)
    months = sorted({on[:7] for on in dates} | {month.name})
    links = _beside("calendar", "month", month.name, months, person)
    links.append(_chooser("calendar", person, people, _date_field("month", "month", months, month.name)))
    return _page(title_of(shown), _body(shown, tiles), person, links)


SPANS = (DAY, WEEK, MONTH, ALL)


def everybody_page(store: Path, query: Fields, tiles: TileServer) -> str:
    """All persons together on a day, in its week or month, or on all days; those whose name has a text."""
    span, text = query.get("span") or DAY, query.get("person", "")
    with Store(store, reads=True) as log:
        known = dates_of(log)
        dates = sorted({on for _, on in known})
        day = period_of(day=query.get("date") or dates[-1]) if dates else None
        if day is None or span not in SPANS:
            raise InputError("date" if day is None else "span", "", span, f"a day that was built, and one of {SPANS}")
        year, week, _ = day.first.isocalendar()
        spans = {DAY: day, WEEK: period_of(week=f"{year}-W{week:02d}"), MONTH: period_of(month=day.name[:7])}
        period = spans.get(span) or Period(ALL, "all days", date.min, LAST_DATE)
        persons = tuple(sorted({name for name, _ in known if text.casefold() in name.casefold()}))
        fields = (
            tag(
                "label",
                "persons ",
                tag("input", name="person", value=text, type="search", placeholder="part of a name"),
            ),
            _date_field("date", "date", dates, day.name),
            tag("select", *(tag("option", name, selected="" if name == span else None) for name in SPANS), name="span"),
        )
        links = [tag("form", *fields, tag("button", "Show"), class_="chooser", action="everybody")]
        try:
            shown = overview_of(log, Choice(persons or (text,), period))
        except InputError as error:
            return _page("everybody", tag("p", escape(one_line(str(error))), class_="fault"), links=links)
    return _page(title_of(shown), _body(shown, tiles), links=links)


def _all_days(store: Path, query: Fields, place: str = "") -> tuple[Overview, list[str]]:
    """The overview of all days of a person, and all persons. place: name or number, "" for all."""
    with Store(store, reads=True) as log:
        person, _, people = _person(log, query)
        own = diary(log, person, outings=False)
    own = replace(own, days=tuple(day for day in own.days if day.known))
    first, last = (date.fromisoformat(own.days[n].date) for n in (0, -1)) if own.days else (date.min, LAST_DATE)
    return overview([own], Period(ALL, "all days", first, last), place), people


def places_page(store: Path, query: Fields, _: TileServer) -> str:
    """The places of a person with visits, time and usual hours; each leads to its page."""
    shown, people = _all_days(store, query)
    [own] = shown.diaries
    table = html_table(own.person, places_table(own.places, short=False), links=LINKS)
    title = f"{one_line(own.person)}: {count(len(own.places), 'place')}"
    return _page(title, table, own.person, [_chooser("places", own.person, people)])


def place_page(store: Path, query: Fields, tiles: TileServer) -> str:
    """A place with its usual hours and visits, and forms that name or forget it."""
    number = query.get("number", "")
    shown, _ = _all_days(store, query, number if NUMBER.fullmatch(number) else "-")
    if not shown.places:
        raise InputError("number", "", number, "the number of a place")
    [(person, place), *_] = shown.places
    forms = ""
    if np.isfinite(place.latitude):
        hidden = {"person": person, "at": f"{place.latitude:.6f},{place.longitude:.6f}", "page": "places"}
        value = tag("input", name="value", value=place.name, required="")
        forms = _form("name", hidden, "This place is called", value)
        sure = tag("input", name="sure", placeholder="type yes", size=8)
        forms += _form("forget-place", hidden, "Forget this place: delete all times here for good", sure, "Forget")
    return _page(one_line(place.label), forms + _body(shown, tiles), person)


def _day(store: Path, query: Fields) -> tuple[DiaryDay, list[str], list[str], list[str]]:
    """The day of a query, the dates around it, all of this person, and all persons.

    Raises InputError if there is no such day.
    """
    with Store(store, reads=True) as log:
        person, stored, people = _person(log, query)
        on = query.get("date") or stored[-1]
        wanted = period_of(day=on)
        if wanted is None:
            raise InputError(store, "", "no day", "lifelog build, and more than one position a day")
        middle, most = wanted.first.toordinal(), date.max.toordinal()
        first, last = (date.fromordinal(min(max(middle + n, 1), most)).isoformat() for n in (-DAYS_AROUND, DAYS_AROUND))
        days = {day.date: day for day in diary(log, person, first, last, outings=False).days}
    if on not in days:
        raise InputError("date", "", on, "a recorded day")
    return days[on], sorted(days), stored, people


def entry_page(store: Path, query: Fields, _: TileServer) -> str:
    """The forms that correct an entry of a day."""
    day, _dates, _known, _people = _day(store, query)
    number = query.get("n", "")
    if not NUMBER.fullmatch(number) or int(number) >= len(day.entries):
        raise InputError("n", "", number, "the number of an entry")
    entry, later = day.entries[int(number)], day.entries[int(number) + 1 :]
    middle = _time((entry.start + entry.end) / 2, entry.offset)
    hidden = {"person": day.person, "date": day.date, "start": _time(entry.start, entry.offset), "at": middle}
    hidden |= {"end": _time(entry.end, entry.end_offset)}
    place = tag("input", name="value", placeholder="LAT,LON or a name", required="")
    modes = tag("select", *(tag("option", mode) for mode in MODE_ACTIVITIES), name="value")
    moment = tag("input", name="value", size=16, value=middle[:16].replace("T", " "), required="")
    forms = [
        _form("at", hidden, "I was at", place),
        _form("mode", hidden, "This was", modes),
        _form("split", hidden, "Split at", moment),
        _form("not-me", hidden, "This was not me"),
        _form("forget", hidden, "Delete this time for good", tag("input", name="sure", placeholder="type yes")),
    ]
    if np.isfinite(entry.latitude):
        forms.insert(1, _form("name", hidden, "This place is called", tag("input", name="value", required="")))
    following = next((n for n, row in enumerate(later) if row.kind == STAY), None)
    if entry.kind == STAY and following is not None:
        stay, gone = later[following], [entry_text(row) for row in later[:following] if row.kind in MOVING]
        both = hidden | {"end": _time(stay.end, stay.end_offset)}
        vanishes = f"; this vanishes: {'; '.join(gone)}" if gone else ""
        forms.insert(2, _form("merge", both, f"This and the next stay ({entry_text(stay)}) are one{vanishes}"))
    title = f"{row_texts(entry)[0]} to {row_texts(entry)[1]}, {' '.join(filter(None, row_texts(entry)[3:]))}"
    return _page(title, "".join(forms), day.person)


def _time(time: float, offset: float) -> str:
    """A Unix time [s] as ISO 8601 at an offset of local time [s]."""
    shown = (datetime.fromtimestamp(time, UTC) + timedelta(seconds=offset)).replace(tzinfo=None)
    hours, minutes = divmod(abs(round(offset)) // 60, 60)
    return f"{shown.isoformat(timespec='milliseconds')}{'-' if offset < 0 else '+'}{hours:02d}:{minutes:02d}"


def _form(action: str, hidden: Fields, text: str, inputs: str = "", button: str = "Save") -> str:
    given = {**hidden, "do": action}.items()
    fields = (tag("input", type="hidden", name=name, value=value) for name, value in given)
    label = tag("label", f"{escape(text)} {inputs}")
    return tag("form", *fields, label, " ", tag("button", button), KEY_PLACE, method="post", action="correct")


def corrected_page(store: Path, fields: Fields, _: TileServer) -> str:
    """Make the correction of a form; the page has what was stored and what the diary shows now. Raises InputError."""
    person, value = fields.get("person") or None, fields.get("value", "")
    start, end = fields.get("start", ""), fields.get("end", "")
    match fields.get("do"):
        case "at":
            lines = revision.state_place(store, fields.get("at", ""), value, person=person)
        case "name":
            lines = revision.name_place(store, fields.get("at", ""), value, person=person)
        case "merge":
            lines = revision.merge(store, start, end, person)
        case "split":
            lines = revision.split(store, value, person)
        case "mode":
            lines = revision.state_mode(store, start, end, value, person)
        case "not-me":
            lines = revision.state_not_me(store, start, end, person)
        case "forget" if fields.get("sure", "").strip().lower() == "yes":
            lines = revision.forget(store, start, end, person)
        case "forget-place" if fields.get("sure", "").strip().lower() == "yes":
            lines = revision.forget_place(store, fields.get("at", ""), person=person)
        case "forget" | "forget-place":
            raise InputError("forget", "", "no yes", "yes: what is deleted does not come back")
        case "undo" if NUMBER.fullmatch(value):
            lines = revision.undo(store, int(value))
        case _:
            raise InputError("do", "", repr(fields.get("do")), "a correction")
    back = ""
    if fields.get("page") and person:
        back = linked("places?" + urlencode({"person": person}), "back to the places")
    elif "date" in fields:
        back = linked(LINKS.day(fields.get("person", ""), fields["date"]), "back to the day")
    return _page("saved", tag("pre", escape("\n".join(lines))) + back, person or "")


def list_page(store: Path, _query: Fields, _: TileServer) -> str:
    """All corrections, each with a form that undoes it."""
    listed = ((line, line.split(" ", 1)[0]) for line in revision.listing(store))
    rows = [
        tag("p", escape(line)) + (_form("undo", {"value": number}, "", "", "Undo") if number.isdecimal() else "")
        for line, number in listed
    ]
    return _page("corrections", "".join(rows))
