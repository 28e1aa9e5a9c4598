"""GPX tracks of a watch or an app, in bounded memory. Files are untrusted: entities and document types are refused."""

from __future__ import annotations

from collections.abc import Iterator
from typing import BinaryIO

from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] no stubs

from pdr_graph.errors import InputError
from pdr_graph.io.gpx import ACCURACY_TAGS, accuracy_of
from pdr_graph.io.past_day import TRACK
from pdr_graph.io.validation import float_of
from pdr_graph.lifelog.past.json_values import Point, batch_of
from pdr_graph.lifelog.past.past_rows import Batch

NAME = "GPX"
AT_ONCE = 20_000  # points in a batch
LONGEST = 50_000_000  # [bytes] from one element to the next, whose tree takes 1 GB of memory


def recognizes(head: bytes) -> bool:
    """True if the root element is ``gpx``."""
    return b"<gpx" in head[:2048]


def read(stream: BinaryIO, where: str) -> Iterator[Batch]:
    """Read the track points; a radius is that of an extension, else estimated from HDOP, else unknown."""
    points = list[Point]()
    for element in elements(stream, where, "{*}trkpt"):
        points.append(_point(element))
        if len(points) == AT_ONCE:
            yield batch_of(points)
            points = []
    yield batch_of(points)


def elements(stream: BinaryIO, where: str, tag: str) -> Iterator[etree._Element]:
    """Each element of a tag when it is complete; it and those before it are then removed from the tree.

    Raises InputError if the XML is broken or has a document type, or an element is too long.
    """
    bounded = _BoundedStream(stream, where)
    options = {"resolve_entities": False, "no_network": True, "load_dtd": False, "huge_tree": False}
    try:
        for _, element in etree.iterparse(bounded, ("end",), tag=tag, remove_comments=True, **options):
            if element.getroottree().docinfo.doctype:
                raise InputError(where, "", "a document type definition", "plain XML without one")
            bounded.left = LONGEST
            yield element
            element.clear()
            while element.getprevious() is not None:
                del element.getparent()[0]
    except etree.XMLSyntaxError as error:
        raise InputError(where, "", f"broken XML ({str(error)[:120]})", "a whole file") from None


class _BoundedStream:
    """A stream that refuses to be read once nothing is left. left: [bytes]."""

    def __init__(self, stream: BinaryIO, where: str):
        self._stream, self._where, self.left = stream, where, LONGEST

    def read(self, size: int) -> bytes:
        """The next bytes. Raises InputError if nothing is left."""
        content = self._stream.read(size)
        self.left -= len(content)
        if self.left < 0:
            raise InputError(self._where, "", f"an element of more than {LONGEST // 10**6} MB", "shorter tracks")
        return content


def _point(element: etree._Element) -> Point:
    """The point of an element."""
    time, values = "", dict[str, str]()
    for inner in element.iterdescendants():
        name = str(inner.tag).rpartition("}")[2]
        if name == "time":
            time = time or (inner.text or "").strip()
        elif name in ACCURACY_TAGS:
            values.setdefault(name.lower(), inner.text or "")
    place = float_of(element.get("lat")), float_of(element.get("lon"))
    return time, place, accuracy_of(values), TRACK
