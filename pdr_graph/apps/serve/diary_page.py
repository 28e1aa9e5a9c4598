"""A lifelog in the browser of its owner: each day with its picture and rows, and forms that correct a row.

For this machine alone, with a token in the address that is printed. Pages have no scripts and load nothing. A
correction does what ``pdr-graph lifelog correct`` does.

A correction must come from a form of these pages: the browser states this origin (so pages must send a referrer to
their own server, else browsers write ``Origin: null``), and the form has a key derived from the token.
"""

from __future__ import annotations

import asyncio
import hmac
import re
from collections.abc import Awaitable, Callable, Mapping
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
from starlette.routing import Route

from pdr_graph.apps.lifelog import report, revision
from pdr_graph.apps.lifelog.diary import DiaryDay, dates_of, diary
from pdr_graph.apps.lifelog.facts import MODE_ACTIVITIES
from pdr_graph.apps.lifelog.local_time import period_of
from pdr_graph.apps.lifelog.overview import row_texts
from pdr_graph.apps.lifelog.picture import picture as drawn_picture
from pdr_graph.apps.lifelog.show import Choice, show
from pdr_graph.apps.lifelog.store import Store
from pdr_graph.apps.report.plotting import picture_bytes
from pdr_graph.apps.serve.access import OWNER, Access, cookie_name
from pdr_graph.apps.serve.application import Guard
from pdr_graph.errors import InputError, one_line

NUMBER = re.compile(r"[0-9]{1,9}")  # of an entry or a correction
KEY = "key"  # field of every form
LONGEST_FORM = 1 << 14  # [bytes]
DAYS_AROUND = 40  # days before and after one, among which the next recorded one is looked for
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'; img-src data: 'self'; "
    "form-action 'self'; base-uri 'none'; frame-ancestors 'none'",
    "Referrer-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}
STYLE = report.PAGE_STYLE.replace("h1 { position: absolute; left: -9999px; }", "h1 { font-size: 1.3rem; }")
STYLE += """
form { margin: 0.5rem 0; } input, select, button { font: inherit; padding: 0.15rem 0.4rem; } nav { margin: 0.6rem 0; }
.fault { color: #a3261f; } pre { white-space: pre-wrap; }
"""
Fields = Mapping[str, str]


class DiaryServer:
    """The lifelog of the routes. One request at a time opens the store."""

    def __init__(self, store: Path, token: str):
        self.store, self.lock = store, asyncio.Lock()
        self.key = hmac.digest(token.encode(), b"forms of the diary", "sha256").hex()

    async def run(self, function: Callable[..., bytes | str], *values: object) -> Response:
        """The page that a function makes; the line of an InputError as a page with status 400."""
        async with self.lock:
            try:
                content = await run_in_threadpool(function, self.store, *values)
            except InputError as error:
                return _html(_page("not possible", f'<p class="fault">{escape(str(error))}</p>'), 400)
            except OSError as error:
                return _html(_page("not possible", f'<p class="fault">{escape(one_line(str(error)))}</p>'), 500)
        if isinstance(content, bytes):
            return Response(content, media_type="image/svg+xml", headers=HEADERS)
        key = f'<input type="hidden" name="{KEY}" value="{self.key}"></form>'
        return _html(content.replace("</form>", key))


def application(store: Path, token: str) -> Starlette:
    """The ASGI application of a lifelog. token: which every request must have."""
    server = DiaryServer(store, token)

    def shown(function: Callable[..., bytes | str]) -> Callable[[Request], Awaitable[Response]]:
        async def answer(request: Request) -> Response:
            return await server.run(function, request.query_params)

        return answer

    async def day(request: Request) -> Response:
        if "token" in request.query_params:
            response = RedirectResponse("./", 303)  # the token stays in no history
            name, token = cookie_name(request.headers), request.query_params["token"]
            response.set_cookie(name, token, httponly=True, samesite="strict")
            return response
        return await server.run(day_page, request.query_params)

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

    routes = [Route("/", day), Route("/picture.svg", shown(day_picture)), Route("/entry", shown(entry_page))]
    routes += [Route("/corrections", shown(list_page)), Route("/correct", correct, methods=["POST"])]
    return Starlette(False, routes, [Middleware(Guard, Access({OWNER: token}))])


def _html(text: str, status: int = 200) -> Response:
    return HTMLResponse(text, status, HEADERS)


def _page(title: str, body: str) -> str:
    head = '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
    head += f"<title>{escape(title)}</title><style>{STYLE}</style>"
    nav = '<nav><a href="./">last day</a> · <a href="corrections">corrections</a></nav>'
    return f'<!doctype html><html lang="en"><head>{head}</head><body>{nav}<h1>{escape(title)}</h1>{body}</body></html>'


def day_page(store: Path, query: Fields) -> str:
    """A day with its picture and a row per entry; the last day without a date."""
    own, dates, people = _day(store, query)
    place = dates.index(own.date)
    beside = [(on, f"← {on}") for on in dates[place - 1 : place]] if place else []
    beside += [(on, f"{on} →") for on in dates[place + 1 : place + 2]]
    links = [_link("./", _query(own.person, on), text) for on, text in beside]
    links += [_link("./", urlencode({"person": name}), one_line(name)) for name in people if name != own.person]
    picture = f'<img alt="" style="width:100%" src="picture.svg?{escape(_query(own.person, own.date))}">'
    rows = ""
    for n, entry in enumerate(own.entries):
        cells = "".join(f"<td>{escape(text)}</td>" for text in row_texts(entry))
        correct = _link("entry", f"{_query(own.person, own.date)}&n={n}", "correct")
        rows += f"<tr>{cells}<td>{correct}</td></tr>"
    table = f'<div class="wide"><table><tbody>{rows}</tbody></table></div>'
    return _page(f"{one_line(own.person)} {own.date}", f"<nav>{' · '.join(links)}</nav>{picture}{table}")


def _day(store: Path, query: Fields) -> tuple[DiaryDay, list[str], list[str]]:
    """The day of a query, the dates around it, and all persons. Raises InputError if there is no such day."""
    with Store(store) as log:
        known = dates_of(log)
        people = sorted({name for name, _ in known})
        person = revision.person_of(log, query.get("person") or (people[0] if people else None))
        stored = [on for name, on in known if name == person]
        on = query.get("date") or (stored[-1] if stored else "")
        wanted = period_of(day=on)
        if wanted is None:
            raise InputError(store, "", "no day", "lifelog build, and more than one position a day")
        middle, most = wanted.first.toordinal(), date.max.toordinal()
        first, last = (date.fromordinal(min(max(middle + n, 1), most)).isoformat() for n in (-DAYS_AROUND, DAYS_AROUND))
        days = {day.date: day for day in diary(log, person, first, last).days}
    if on not in days:
        raise InputError("date", "", on, "a recorded day")
    return days[on], sorted(days), people


def _query(person: str, on: str) -> str:
    return urlencode({"person": person, "date": on})


def _link(path: str, query: str, text: str) -> str:
    return f'<a href="{escape(f"{path}?{query}")}">{escape(text)}</a>'


def day_picture(store: Path, query: Fields) -> bytes:
    """The picture of a day as SVG."""
    choice = Choice((query.get("person", ""),), period_of(day=query.get("date", "")))
    figure, _ = drawn_picture(show(store, choice, write=False).overview, "")
    return picture_bytes(figure, file_format="svg")


def entry_page(store: Path, query: Fields) -> str:
    """The forms that correct an entry of a day."""
    day, _, _ = _day(store, query)
    number = query.get("n", "")
    if not NUMBER.fullmatch(number) or int(number) >= len(day.entries):
        raise InputError("n", "", number, "the number of an entry")
    entry, after = day.entries[int(number)], day.entries[int(number) + 1 : int(number) + 2]
    hidden = {"person": day.person, "date": day.date, "start": _time(entry.start, entry.offset)}
    hidden |= {"end": _time(entry.end, entry.end_offset)}
    hidden |= {"at": (middle := _time((entry.start + entry.end) / 2, entry.offset))}
    modes = "".join(f"<option>{mode}</option>" for mode in MODE_ACTIVITIES)
    forms = [
        _form("at", hidden, "I was at", '<input name="value" placeholder="LAT,LON or a name" required>'),
        _form("mode", hidden, "This was", f'<select name="value">{modes}</select>'),
        _form(
            "split",
            hidden,
            "Split at",
            f'<input name="value" size="16" value="{middle[:16].replace("T", " ")}" required>',
        ),
        _form("not-me", hidden, "This was not me", ""),
        _form("forget", hidden, "Delete this time for good", '<input name="sure" placeholder="type yes">'),
    ]
    if np.isfinite(entry.latitude):
        forms.insert(1, _form("name", hidden, "This place is called", '<input name="value" required>'))
    if after:
        both = hidden | {"end": _time(after[0].end, after[0].end_offset)}
        forms.insert(2, _form("merge", both, "This and the next are one stay", ""))
    title = f"{row_texts(entry)[0]} to {row_texts(entry)[1]}, {' '.join(filter(None, row_texts(entry)[3:]))}"
    return _page(title, "".join(forms))


def _time(time: float, offset: float) -> str:
    """A Unix time [s] as ISO 8601 at an offset of local time [s]."""
    shown = (datetime.fromtimestamp(time, UTC) + timedelta(seconds=offset)).replace(tzinfo=None)
    hours, minutes = divmod(abs(round(offset)) // 60, 60)
    return f"{shown.isoformat(timespec='milliseconds')}{'-' if offset < 0 else '+'}{hours:02d}:{minutes:02d}"


def _form(action: str, hidden: Fields, text: str, inputs: str, button: str = "Save") -> str:
    given = {**hidden, "do": action}.items()
    fields = "".join(f'<input type="hidden" name="{name}" value="{escape(value)}">' for name, value in given)
    shown = f"<label>{escape(text)} {inputs}</label> <button>{button}</button>"
    return f'<form method="post" action="correct">{fields}{shown}</form>'


def corrected_page(store: Path, fields: Fields) -> str:
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
        case "forget":
            raise InputError("forget", "", "no yes", "yes: what is deleted does not come back")
        case "undo" if NUMBER.fullmatch(value):
            lines = revision.undo(store, int(value))
        case _:
            raise InputError("do", "", repr(fields.get("do")), "a correction")
    back = _link("./", _query(fields.get("person", ""), fields["date"]), "back to the day") if "date" in fields else ""
    return _page("saved", f"<pre>{escape(chr(10).join(lines))}</pre>{back}")


def list_page(store: Path, _: Fields) -> str:
    """All corrections, each with a form that undoes it."""
    lines = revision.listing(store)
    numbers = [line.split(" ", 1)[0] for line in lines]
    rows = [
        f"<p>{escape(line)}</p>" + (_form("undo", {"value": number}, "", "", "Undo") if number.isdecimal() else "")
        for line, number in zip(lines, numbers, strict=True)
    ]
    return _page("corrections", "".join(rows))
