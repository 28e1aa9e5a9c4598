"""A lifelog in the browser of its owner: days, a calendar and the places, with forms that correct them.

For this machine alone, with a token in the address that is printed. A day has a map (``web/diary.js``), other pages
have no scripts; nothing is loaded but from this server, and tiles from a server of the user's choice. A correction does
what ``pdr-graph lifelog correct`` does.

A correction must come from a form of these pages: the browser states this origin (so pages must send a referrer to
their own server, else browsers write ``Origin: null``), and the form has a key derived from the token.
"""

from __future__ import annotations

import asyncio
import hmac
import json
import re
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
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

from pdr_graph.apps.lifelog import report, revision
from pdr_graph.apps.lifelog.day import VEHICLE, WALKING
from pdr_graph.apps.lifelog.diary import Diary, DiaryDay, dates_of, diary, totals_of
from pdr_graph.apps.lifelog.facts import MODE_ACTIVITIES
from pdr_graph.apps.lifelog.local_time import ALL, LAST_DATE, Period, period_of
from pdr_graph.apps.lifelog.overview import (
    HOURS_TITLES,
    PLACE_TITLES,
    distance_text,
    overview,
    place_texts,
    row_texts,
    short_text,
    time_text,
    totals_text,
    usual_texts,
    visit_times,
)
from pdr_graph.apps.lifelog.picture import COLOURS
from pdr_graph.apps.lifelog.picture import picture as drawn_picture
from pdr_graph.apps.lifelog.places import FEWEST_HOURS, WEEKDAYS, local_date
from pdr_graph.apps.lifelog.reconstruct import building_of
from pdr_graph.apps.lifelog.show import Choice, show
from pdr_graph.apps.lifelog.stays_and_legs import Track
from pdr_graph.apps.lifelog.store import Store
from pdr_graph.apps.lifelog.timeline import STAY, duration_text
from pdr_graph.apps.report.plotting import picture_bytes
from pdr_graph.apps.serve.access import OWNER, Access, cookie_name
from pdr_graph.apps.serve.application import WEB, Guard, security_headers, settings
from pdr_graph.apps.serve.publishing import plan_layers
from pdr_graph.errors import InputError, count, one_line

NUMBER = re.compile(r"[0-9]{1,9}")  # of an entry or a correction
KEY = "key"  # field of every form
MOST_VISITS = 200  # on the page of a place
LONGEST_FORM = 1 << 14  # [bytes]
MAP_TOLERANCE = 2.0  # [m] to which the tracks of a map are simplified
DAYS_AROUND = 40  # days before and after one, among which the next recorded one is looked for
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; style-src 'self' 'unsafe-inline'; img-src data: 'self'; "
    "form-action 'self'; base-uri 'none'; frame-ancestors 'none'",
    "Referrer-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}
STYLE = report.PAGE_STYLE.replace("h1 { position: absolute; left: -9999px; }", "h1 { font-size: 1.4rem; }")
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
            kind = "image/svg+xml" if content.startswith(b"<") else "application/json"
            return Response(content, media_type=kind, headers=HEADERS)
        key = f'<input type="hidden" name="{KEY}" value="{self.key}"></form>'
        return _html(content.replace("</form>", key))


def application(store: Path, token: str, tiles: str | None = None) -> Starlette:
    """The ASGI application of a lifelog. token: which every request must have; tiles: address of a tile server."""
    server = DiaryServer(store, token)
    scripts = {**HEADERS, **security_headers(tiles, "'self'", " 'unsafe-inline'"), "Referrer-Policy": "same-origin"}

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
        response = await server.run(day_page, request.query_params)
        response.headers.update(scripts)
        return response

    def map_of(path: Path, query: Fields) -> bytes:
        return day_map(path, query, tiles)

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
    routes += [Route("/map.json", shown(map_of)), Mount("/web", StaticFiles(directory=WEB))]
    routes += [Route("/calendar", shown(calendar_page)), Route("/places", shown(places_page))]
    routes += [Route("/place", shown(place_page)), Route("/corrections", shown(list_page))]
    routes += [Route("/correct", correct, methods=["POST"])]
    return Starlette(False, routes, [Middleware(Guard, Access({OWNER: token}))])


MAP_SCRIPTS = """<link rel="stylesheet" href="web/maplibre-gl/maplibre-gl.css">
<script src="web/maplibre-gl/maplibre-gl-csp.js"></script><script type="module" src="web/diary.js"></script>"""


def _html(text: str, status: int = 200) -> Response:
    return HTMLResponse(text, status, HEADERS)


def _page(title: str, body: str, person: str = "") -> str:
    head = '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
    head += f'<title>{escape(title)}</title><style>{STYLE}</style><link rel="stylesheet" href="web/diary.css">'
    query = urlencode({"person": person} if person else {})
    links = [("./", "last day"), ("calendar", "calendar"), ("places", "places"), ("corrections", "corrections")]
    nav = f'<nav class="top">{" · ".join(_link(path, query, text) for path, text in links)}</nav>'
    return f'<!doctype html><html lang="en"><head>{head}</head><body>{nav}<h1>{escape(title)}</h1>{body}</body></html>'


def day_page(store: Path, query: Fields) -> str:
    """A day with its picture and a row per entry; the last day without a date."""
    own, dates, people = _day(store, query)
    place = dates.index(own.date)
    beside = [(on, f"← {on}") for on in dates[place - 1 : place]] if place else []
    beside += [(on, f"{on} →") for on in dates[place + 1 : place + 2]]
    links = [_link("./", _query(own.person, on), text) for on, text in beside]
    links += [_link("calendar", urlencode({"person": own.person, "month": own.date[:7]}), own.date[:7])]
    links += _others("./", own.person, people)
    address = escape(_query(own.person, own.date))
    map_ = f'<div id="map" role="region" aria-label="Map of the day" data-from="map.json?{address}"></div>'
    map_ += f'<section id="forms" aria-live="polite" hidden></section>{MAP_SCRIPTS}'
    picture = f'<img alt="" loading="lazy" style="width:100%" src="picture.svg?{address}">'
    sums = f'{_strip(own)}<p class="soft">{escape(totals_text(own.totals))}</p>'
    picture = f"<details><summary>as a picture</summary>{picture}</details>"
    rows = ""
    for n, entry in enumerate(own.entries):
        cells = "".join(f"<td>{escape(text)}</td>" for text in row_texts(entry))
        correct = _link("entry", f"{_query(own.person, own.date)}&n={n}", "correct")
        correct += f" · {_place_link(own.person, entry.place_number, 'place')}" if entry.place_number >= 0 else ""
        rows += f"<tr>{cells}<td>{correct}</td></tr>"
    table = f'<div class="wide"><table class="day"><tbody>{rows}</tbody></table></div>'
    return _page(
        f"{one_line(own.person)} {own.date}", f"<nav>{' · '.join(links)}</nav>{sums}{map_}{table}{picture}", own.person
    )


def day_map(store: Path, query: Fields, tiles: str | None) -> bytes:
    """What the map of a day shows, as JSON: its legs, its stays by the number of their rows, and its plans."""
    with Store(store, reads=True) as log:
        person, on = revision.person_of(log, query.get("person")), query.get("date", "")
        days = {day.date: day for day in diary(log, person, on, on, MAP_TOLERANCE).days}
    if on not in days:
        raise InputError("date", "", on, "a recorded day")
    track, legs, stays = Track.of(days[on].outings), [], []
    for n, entry in enumerate(days[on].entries):
        line = track.lonlat[track.between(entry.start, entry.end)].round(6).tolist()
        if entry.kind in (WALKING, VEHICLE) and len(line) > 1:
            own = {"n": n, "colour": COLOURS[entry.kind], "floor": ""}
            legs.append({"type": "Feature", "geometry": {"type": "LineString", "coordinates": line}, "properties": own})
        elif np.isfinite(entry.latitude):
            at, time = [round(entry.longitude, 6), round(entry.latitude, 6)], "–".join(row_texts(entry)[:2])
            place = entry.place_number if entry.place_number >= 0 else f"row {n}"
            stays.append({"n": n, "at": at, "label": short_text(entry.label), "time": time, "place": place})
    plans = [plan_layers(building_of(plan)) for plan in dict.fromkeys(o.plan for o in days[on].outings if o.plan)]
    plan = {"type": "FeatureCollection", "features": [one for own in plans for one in own["features"]]}
    shown = {"query": _query(person, on), "legs": legs, "stays": stays, "plan": plan}
    return json.dumps(shown | settings(tiles, guarded=True)).encode()


def _others(path: str, person: str, people: Sequence[str]) -> list[str]:
    """A link to the same page of each other person."""
    return [_link(path, urlencode({"person": name}), one_line(name)) for name in people if name != person]


def _place_link(person: str, number: int, text: str) -> str:
    return _link("place", urlencode({"person": person, "number": number}), text)


def _person(log: Store, query: Fields) -> tuple[str, list[str], list[str]]:
    """The person of a query, the dates of that person, and all persons. Raises InputError without any."""
    known = dates_of(log)
    people = sorted({name for name, _ in known})
    person = revision.person_of(log, query.get("person") or (people[0] if people else None))
    dates = [on for name, on in known if name == person]
    if not dates:
        raise InputError(log.path, "", "no day", "lifelog build, and more than one position a day")
    return person, dates, people


def calendar_page(store: Path, query: Fields) -> str:
    """A month of a person: a strip of each day, which links to it; the last month by default."""
    with Store(store, reads=True) as log:
        person, dates, people = _person(log, query)
        month = period_of(month=query.get("month") or dates[-1][:7])
        if month is None:
            raise InputError("month", "", "nothing", "a month such as 2024-05")
        own = diary(log, person, month.first.isoformat(), month.last.isoformat(), outings=False)
    months = sorted({on[:7] for on in dates} | {month.name})
    at, by_date = months.index(month.name), {day.date: day for day in own.days if day.known}
    links = [(name, f"← {name}") for name in months[max(at - 1, 0) : at]]
    links += [(name, f"{name} →") for name in months[at + 1 : at + 2]]
    shown = [_link("calendar", urlencode({"person": person, "month": name}), text) for name, text in links]
    shown += _others("calendar", person, people)
    cells = [""] * month.first.weekday()
    for on in month.dates:
        day = by_date.get(on.isoformat())
        text = f'<span class="soft">{on.day}</span>'
        if day is not None:
            walked = distance_text(day.totals.walked) if day.totals.walked >= 1 else ""
            places = ", ".join(name for name, _ in day.totals.places[:2])
            text = f"{_link('./', _query(person, day.date), str(on.day))}{_strip(day)}"
            text += f'<div class="soft">{escape(" · ".join(filter(None, [walked, places])))}</div>'
        cells.append(text)
    cells += [""] * (-len(cells) % 7)
    weeks = (cells[n : n + 7] for n in range(0, len(cells), 7))
    body = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in week)}</tr>" for week in weeks)
    head = "".join(f"<th>{name[:3]}</th>" for name in WEEKDAYS)
    table = f'<table class="month"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>'
    sums = totals_text(totals_of(list(by_date.values()), len(by_date))) if by_date else "no day"
    key = ", ".join(f'<span style="color:{COLOURS[kind]}">■</span> {name}' for kind, name in KEY_OF_STRIPS)
    title = f"{one_line(person)} {month.first:%B %Y}"
    note = f'<p class="soft">{escape(count(len(by_date), "day"))}: {escape(sums)}</p><p class="soft">{key}</p>'
    return _page(title, f"<nav>{' · '.join(shown)}</nav>{table}{note}", person)


KEY_OF_STRIPS = (STAY, "staying"), (WALKING, "walking"), (VEHICLE, "riding")


def _strip(day: DiaryDay) -> str:
    """The day from midnight to midnight as a strip."""
    long, shapes = max(day.end - day.start, 1.0), ""
    for entry in day.entries:
        if entry.kind in COLOURS and entry.is_known:
            x, wide = (100 * t / long for t in (entry.start - day.start, entry.duration))
            shapes += f'<rect x="{x:.2f}" width="{wide:.2f}" height="1" fill="{COLOURS[entry.kind]}"/>'
    frame = '<rect width="100" height="1" fill="gray" fill-opacity="0.15"/>'
    head = f'<svg viewBox="0 0 100 1" preserveAspectRatio="none" role="img" aria-label="{day.date}">'
    return f"{head}{frame}{shapes}</svg>"


def _places(store: Path, query: Fields) -> tuple[Diary, list[str]]:
    """All visits and places of a person, most time first, and all persons."""
    with Store(store, reads=True) as log:
        person, _, people = _person(log, query)
        own = diary(log, person, outings=False)
    everything = Period(ALL, "all days", date.min, LAST_DATE)
    return overview([own], everything).diaries[0], people


def places_page(store: Path, query: Fields) -> str:
    """The places of a person with visits, time and usual hours; each links to its page."""
    own, people = _places(store, query)
    longest, rows = max((place.duration for place in own.places), default=1.0), ""
    for place in own.places:
        texts = place_texts(place)
        scale = f'<span class="scale" style="width:{100 * place.duration / longest:.0f}px"></span>'
        cells = [_place_link(own.person, place.number, one_line(place.label)), *map(escape, texts[1:7]), scale]
        rows += f"<tr>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>"
    head = "".join(f"<th>{escape(title)}</th>" for title in (*PLACE_TITLES[:7], ""))
    table = f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>'
    nav = " · ".join(_others("places", own.person, people))
    return _page(f"{one_line(own.person)}: {count(len(own.places), 'place')}", f"<nav>{nav}</nav>{table}", own.person)


def place_page(store: Path, query: Fields) -> str:
    """A place with its usual hours and visits, and forms that name or forget it."""
    own, _ = _places(store, query)
    place = next((place for place in own.places if str(place.number) == query.get("number")), None)
    if place is None:
        raise InputError("number", "", query.get("number", ""), "the number of a place")
    where = [f"{place.latitude:.5f}, {place.longitude:.5f} ± {place.sigma:.0f} m"] if place.sigma >= 0 else []
    facts = [count(len(place.visits), "visit"), time_text(place.duration), f"{place.first} to {place.last}", *where]
    hours = [
        [usual.weekday, *usual_texts(usual)]
        for usual in place.hours
        if max(usual.arrivals, usual.departures) >= FEWEST_HOURS
    ]
    visits = ""
    for visit in place.visits[: -MOST_VISITS - 1 : -1]:
        on = local_date(visit.start + visit.offset).isoformat()
        cells = [_link("./", _query(own.person, on), visit_times(visit)[0]), escape(visit_times(visit)[1])]
        cells += [duration_text(visit.duration), f"{visit.observed:.0%} with data"]
        visits += f"<tr>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>"
    body = f'<p class="soft">{escape(" · ".join(facts))}</p>'
    if np.isfinite(place.latitude):
        hidden = {"person": own.person, "at": f"{place.latitude:.6f},{place.longitude:.6f}", "page": "places"}
        value = f'<input name="value" value="{escape(place.name)}" required>'
        body += _form("name", hidden, "This place is called", value)
        sure = '<input name="sure" placeholder="type yes" size="8">'
        body += _form("forget-place", hidden, "Forget this place: delete all times here for good", sure, "Forget")
    if hours:
        body += f"<h2>usual hours</h2>{_table(HOURS_TITLES[1:], hours)}"
    body += f'<h2>visits</h2><div class="wide"><table><tbody>{visits}</tbody></table></div>'
    hidden_visits = len(place.visits) - MOST_VISITS
    body += f'<p class="soft">and {count(hidden_visits, "earlier visit")}</p>' if hidden_visits > 0 else ""
    return _page(one_line(place.label), body, own.person)


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    titles = "".join(f"<th>{escape(title)}</th>" for title in head)
    body = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows)
    return f'<div class="wide"><table><thead><tr>{titles}</tr></thead><tbody>{body}</tbody></table></div>'


def _day(store: Path, query: Fields) -> tuple[DiaryDay, list[str], list[str]]:
    """The day of a query, the dates around it, and all persons. Raises InputError if there is no such day."""
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
        case "forget-place" if fields.get("sure", "").strip().lower() == "yes":
            lines = revision.forget_place(store, fields.get("at", ""), person=person)
        case "forget" | "forget-place":
            raise InputError("forget", "", "no yes", "yes: what is deleted does not come back")
        case "undo" if NUMBER.fullmatch(value):
            lines = revision.undo(store, int(value))
        case _:
            raise InputError("do", "", repr(fields.get("do")), "a correction")
    back = _link("./", _query(fields.get("person", ""), fields["date"]), "back to the day") if "date" in fields else ""
    back = (
        _link("places", urlencode({"person": person}), "back to the places") if fields.get("page") and person else back
    )
    return _page("saved", f"<pre>{escape(chr(10).join(lines))}</pre>{back}", person or "")


def list_page(store: Path, _: Fields) -> str:
    """All corrections, each with a form that undoes it."""
    lines = revision.listing(store)
    numbers = [line.split(" ", 1)[0] for line in lines]
    rows = [
        f"<p>{escape(line)}</p>" + (_form("undo", {"value": number}, "", "", "Undo") if number.isdecimal() else "")
        for line, number in zip(lines, numbers, strict=True)
    ]
    return _page("corrections", "".join(rows))
