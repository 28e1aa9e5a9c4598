"""The page of an overview: one self-contained HTML file, the same in a folder and in the browser of `lifelog serve`.

It has the totals, the picture (`picture.py`) and the tables. Its script (``web/page.js``) enlarges maps, and moves a
walker along a day. Names are untrusted text: all are escaped, and the content security policy allows this script alone,
by its hash. It has no names or paths of recordings and plans, and asks for nothing but tiles that a server may show.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from html import escape
from importlib.resources import files

import numpy as np

from pdr_graph.apps.lifelog.diary import Diary, DiaryDay
from pdr_graph.apps.lifelog.local_time import DAY
from pdr_graph.apps.lifelog.maps import TileServer
from pdr_graph.apps.lifelog.overview import (
    Overview,
    ShownTable,
    fleet_tables,
    fleet_text,
    period_title,
    shown_tables,
    sums_text,
)
from pdr_graph.apps.lifelog.picture import SPACE, WIDTH, Links, legend, linked, pictures, tag
from pdr_graph.apps.lifelog.places import Place, local_date
from pdr_graph.apps.lifelog.timeline import TimelineEntry
from pdr_graph.apps.report.page import policy_hash
from pdr_graph.errors import count, one_line

POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; script-src "
SCALE_WIDTH = 100.0  # [px] of the bar of the longest time at a place


@cache
def web_file(name: str) -> str:
    """A file of the folder ``web``."""
    return files("pdr_graph.apps.lifelog").joinpath("web", name).read_text(encoding="utf-8")


@cache
def script_hash() -> str:
    """The hash of the script, for a content security policy."""
    return policy_hash(web_file("page.js").encode())


def title_of(shown: Overview) -> str:
    """The title of an overview: persons, period, place."""
    names = ", ".join(one_line(person) for person in shown.persons)
    names = count(len(shown.persons), "person") if shown.is_fleet else names
    return "  ".join(filter(None, [names, period_title(shown.period), one_line(shown.place)]))


def page(shown: Overview, template: str, remarks: Sequence[str]) -> tuple[bytes, list[str]]:
    """The file of an overview, and a line if there are no tiles.

    template: address of the tiles, "" for none; remarks: a line each.
    """
    tiles = TileServer(template)
    content = body(shown, tiles)
    failures = [tiles.failure] if tiles.failure else []
    notes = "".join(tag("p", escape(line), class_="soft") for line in [*remarks, *failures])
    policy = tag("meta", http_equiv="Content-Security-Policy", content=POLICY + script_hash())
    return document(title_of(shown), notes + content, policy).encode(), failures


def document(title: str, content: str, head: str = "", above: str = "", below: str = "") -> str:
    """A whole page. content, head: HTML; above, below: HTML above and below the title."""
    about = tag("meta", name="viewport", content="width=device-width, initial-scale=1")
    style, script = tag("style", web_file("page.css")), tag("script", web_file("page.js"))
    named = tag("head", tag("meta", charset="utf-8"), head, about, tag("title", escape(title)), style)
    whole = tag("html", named, tag("body", above, tag("h1", escape(title)), below, content, script), lang="en")
    return f"<!doctype html>{whole}\n"


def body(shown: Overview, tiles: TileServer, links: Links | None = None, below: str = "") -> str:
    """Totals, picture and tables of an overview, as HTML. links: to where it leads; below: HTML below the picture."""
    several = len(shown.persons) > 1
    sums = [f"{own.person}: " * several + sums_text(shown, own) for own in shown.diaries]
    sums = [fleet_text(shown)] if shown.is_fleet else sums
    parts = [tag("p", escape(one_line(line)), class_="sums") for line in sums]
    days = shown.days if shown.period.kind == DAY and len(shown.diaries) == 1 and not shown.place else []
    figures = []
    for part in pictures(shown, tiles, links):
        share = np.floor(1e4 * (part.width + SPACE) / (WIDTH + SPACE)) / 100  # of a line; rounded down, so that all fit
        figures.append(tag("figure", part.svg, class_=part.kind, style=f"width:{share}%"))
    parts += [
        legend(any(entry.is_guess for day in shown.days for entry in day.entries)),
        tag("div", *figures, class_="picture"),
    ]
    parts += [_slider(day) for day in days if day.known]
    together = fleet_tables(shown, short=False) if several and (shown.is_fleet or shown.dwells) else ()
    doubts = [line for own in shown.diaries for line in own.doubts]
    parts += [tag("p", escape(one_line(line)), class_="soft") for line in doubts]
    parts += [below, *(html_table("", table, links=links) for table in together)]
    for own in () if shown.is_fleet else shown.diaries:
        tables = shown_tables(shown, own, short=False)
        parts += [html_table(own.person, table, f"{own.person}: " * several, links) for table in tables]
    return "".join(parts)


def _slider(day: DiaryDay) -> str:
    """The slider that moves the walker along a day."""
    span = {"min": int(np.ceil(day.known[0].start)), "max": int(max(entry.end for entry in day.known))}
    slider = tag("input", type="range", id="slider", step=1, value=span["min"], aria_label="time", **span)
    button = tag("button", "▶", type="button", id="play", aria_label="play")
    return tag("div", button, slider, tag("output", id="clock"), id="player", hidden="")


def html_table(person: str, shown: ShownTable, whose: str = "", links: Links | None = None) -> str:
    """A table with a heading and its note; nothing without rows. whose: before the heading."""
    if not shown.rows:
        return ""
    to, rows = links or Links(), []
    subjects = shown.subjects or [None] * len(shown.rows)
    longest = max((own.duration for own in subjects if isinstance(own, Place)), default=1.0) or 1.0
    for cells, subject in zip(shown.rows, subjects, strict=True):
        texts, about = [escape(one_line(cell)) for cell in cells], {}
        match subject:
            case DiaryDay():
                texts[0] = linked(to.day(person, subject.date), texts[0])
            case Diary():
                texts[0] = linked(to.day(subject.person, subject.days[-1].date), texts[0])
            case Place():
                texts[0] = linked(to.place(person, subject.number), texts[0])
                texts.append(tag("i", class_="scale", style=f"width:{SCALE_WIDTH * subject.duration / longest:.0f}px"))
            case TimelineEntry():
                on = local_date(subject.start + subject.offset).isoformat()
                texts[0] = linked(to.place(person, subject.place_number), texts[0])
                texts[1] = linked(to.day(person, on), texts[1])
            case (day, number):
                entry = day.entries[number]
                about = {"data_start": entry.start, "data_end": entry.end, "data_offset": entry.offset}
                correct = linked(to.entry(day, number), "correct") if to.entry(day, number) else ""
                place = to.place(person, entry.place_number) if entry.place_number >= 0 else ""
                texts.append(" · ".join(filter(None, [correct, linked(place, "place") if place else ""])))
            case None:
                pass
        rows.append(tag("tr", *(tag("td", text) for text in texts), **about))
    extra = [""] * any(isinstance(own, Place | tuple) for own in subjects)
    head = tag("tr", *(tag("th", escape(name)) for name in [*shown.head, *extra]))
    table = tag("table", tag("thead", head), tag("tbody", *rows), class_=shown.title.replace(" ", "-"))
    note = tag("p", escape(shown.note), class_="soft") if shown.note else ""
    return tag("h2", escape(one_line(whose + shown.title))) + tag("div", table, class_="wide") + note
