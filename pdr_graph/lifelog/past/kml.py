"""KML of map programs and of Google's timeline by day: tracks and points with times; places and ways of a span of time.

Files are untrusted: entities, document types and the network are refused.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import BinaryIO

from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] no stubs

from pdr_graph.io.past_day import TRACK
from pdr_graph.io.validation import float_of
from pdr_graph.lifelog.facts import Guess
from pdr_graph.lifelog.past.gpx_track import AT_ONCE, elements
from pdr_graph.lifelog.past.json_values import NOWHERE, Point, batch_of
from pdr_graph.lifelog.past.past_rows import Batch, guess, with_guesses

NAME = "KML"
UNKNOWN = float("nan")  # accuracy: the format has none


def recognizes(head: bytes) -> bool:
    """True if the root element is ``kml``."""
    return b"<kml" in head[:2048]


def read(stream: BinaryIO, where: str) -> Iterator[Batch]:
    """Read tracks (``gx:Track``) and points with a time; a place or line with a span of time is a guess.

    One track at a time is in memory.
    """
    points, guesses, untimed = list[Point](), list[Guess](), 0
    for element in elements(stream, where, "{*}Placemark"):
        points += [*_track(element), *_point(element)]
        guesses += _guesses(element)
        untimed += _untimed(element)
        if len(points) > AT_ONCE:
            yield batch_of(points)
            points = []
    batch = with_guesses(batch_of(points), guesses)
    left_out = +(batch.left_out + Counter({"no time": untimed}))
    yield Batch(batch.positions, guesses=batch.guesses, left_out=left_out)


def _track(element: etree._Element) -> Iterator[Point]:
    """The points of ``gx:Track``: as many times as coordinates, in the same order."""
    for track in element.iterfind(".//{*}Track"):
        times = [when.text or "" for when in track.iterfind("{*}when")]
        places = [coord.text or "" for coord in track.iterfind("{*}coord")]
        for time, place in zip(times, places, strict=False):
            yield _iso(time), _lat_lon(place.split()), UNKNOWN, TRACK


def _point(element: etree._Element) -> Iterator[Point]:
    """The point of a place with one time."""
    time = element.findtext("{*}TimeStamp/{*}when")
    place = element.findtext(".//{*}Point/{*}coordinates")
    if time and place:
        yield _iso(time), _lat_lon(place.split(",")), UNKNOWN, TRACK


def _guesses(element: etree._Element) -> Iterator[Guess]:
    """The visit or activity of a place or line with a span of time, as Google's timeline has them."""
    begin, end = (element.findtext(f"{{*}}TimeSpan/{{*}}{name}") for name in ("begin", "end"))
    place, line = (element.findtext(f".//{{*}}{name}/{{*}}coordinates") for name in ("Point", "LineString"))
    if begin and end and (place or line):
        first = (place or line or "").split()[:1]
        where = _lat_lon(first[0].split(",")) if first else NOWHERE
        times = _iso(begin), _iso(end)
        yield guess(NAME, "visit" if place else "activity", times, element.findtext("{*}name"), where, None)


def _untimed(element: etree._Element) -> int:
    """Number of points that have no time."""
    if element.find("{*}TimeSpan") is not None or element.find("{*}TimeStamp") is not None:
        return 0
    texts = [text for name in ("Point", "LineString") for text in element.iterfind(f".//{{*}}{name}/{{*}}coordinates")]
    return sum(len((text.text or "").split()) for text in texts)


def _iso(text: str) -> str:
    """A time as text, which is not a bare number such as a year."""
    return text.strip() if "T" in text else ""


def _lat_lon(parts: Sequence[str]) -> tuple[float, float]:
    """Latitude and longitude [deg] of longitude and latitude as texts; NaN if they are none."""
    return (float_of(parts[1]), float_of(parts[0])) if len(parts) > 1 else NOWHERE
