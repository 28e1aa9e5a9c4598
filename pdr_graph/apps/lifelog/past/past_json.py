"""JSON of timelines, all untrusted and of any size: elements of top-level arrays, values in them.

The document is a list of elements, or an object of lists, read a few megabytes at a time. numpy finds the brackets
outside strings of a piece, so that the elements can be decoded together, in C; only where that fails is each decoded by
itself.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, BinaryIO, TypeVar

import msgspec
import numpy as np

from pdr_graph.apps.lifelog.past.past_rows import Batch, Format
from pdr_graph.errors import InputError, quoted
from pdr_graph.io.past_day import E7
from pdr_graph.io.validation import float_of
from pdr_graph.types import Index

PIECE_SIZE = 4_000_000  # [bytes] read at a time
LONGEST_JSON_ELEMENT = 64_000_000  # [bytes] of one element; real ones have up to a megabyte
MOST_ARRAYS = 1000  # in one document; real ones have three
JSON_MARKS = bytes(c in b'"{}[]' for c in range(256))
BLANK = b" \t\r\n,"
DECODE_ERRORS = (msgspec.DecodeError, RecursionError, ValueError)
Element = TypeVar("Element")


@dataclass(frozen=True)
class Piece:
    """Whole elements of one array. key: name of the array, "" for a bare list; text: the elements, with commas between
    them; ends: where each ends in the text.
    """

    key: str
    text: bytes
    ends: Index

    def each(self) -> Iterator[bytes]:
        """The text of each element."""
        begin = 0
        for end in self.ends.tolist():
            yield self.text[begin:end].strip(BLANK)
            begin = end


def decoded(piece: Piece, decode_all: Callable[[bytes], list[Element]], kind: Any) -> tuple[list[Element], int]:
    """The elements of a piece, and how many cannot be read.

    decode_all: of a whole list, strict; kind: type of an element, for the second attempt, which allows texts for
    numbers.
    """
    try:
        return decode_all(b"[" + piece.text.lstrip(BLANK) + b"]"), 0
    except DECODE_ERRORS:
        found, bad = list[Element](), 0
    for text in piece.each():
        try:
            found.append(msgspec.json.decode(as_utf8(text), type=kind, strict=False))
        except DECODE_ERRORS:
            bad += 1
    return found, bad


def as_utf8(text: bytes) -> bytes:
    """`text` as UTF-8; one with other bytes is taken as Latin-1, in which old tools wrote names."""
    try:
        text.decode()
    except UnicodeDecodeError:
        return text.decode("latin-1").encode()
    return text


@dataclass
class _State:
    """Where the text not yet consumed begins. array: depth of the elements, 1 in a bare list, else 2; inside: True
    in an array; key: of that array.
    """

    array: int
    inside: bool
    key: str = ""
    arrays: int = 0


def pieces(stream: BinaryIO, where: str) -> Iterator[Piece]:
    """Split a JSON document into pieces of whole elements. where: name of the file in messages.

    Raises InputError if an element is too long, the document is neither a list nor an object, is cut off, or if
    something follows its end.
    """
    text = stream.read(PIECE_SIZE)
    text = text.removeprefix(b"\xef\xbb\xbf").lstrip()
    if text[:1] not in (b"{", b"["):
        raise InputError(where, "", quoted(text[:20]), "JSON: a list or an object")
    state = _State(1, True) if text[:1] == b"[" else _State(2, False)
    text = text[1:]
    while True:
        brackets = _brackets(text, 2 if state.array == 2 and state.inside else 1)
        consumed = 0
        for begin, end, cut in _spans(text, brackets, state, where):
            consumed = cut
            if len(end):
                yield Piece(state.key, text[begin : int(end[-1])], end - begin)
        closing = brackets[0][brackets[1] == 0]
        if len(closing):
            _check_end(text[int(closing[0]) + 1 :] + stream.read(PIECE_SIZE), where)
            return
        text = text[consumed:]
        if len(text) > LONGEST_JSON_ELEMENT:
            raise InputError(
                where, state.key, f"an element of more than {LONGEST_JSON_ELEMENT // 10**6} MB", "a timeline"
            )
        more = stream.read(max(PIECE_SIZE, len(text)))
        if not more:
            raise InputError(where, state.key, "an end in the middle", "the whole file: was the download cut off?")
        text += more


def _check_end(text: bytes, where: str) -> None:
    """Raise InputError for more than blanks after the end of the document. text: what follows the end."""
    if more := text.strip():
        raise InputError(
            where, "", f"{quoted(more[:20])} after the end", "one document (two files, one behind the other?)"
        )


def _brackets(text: bytes, depth: int) -> tuple[Index, Index, Index]:
    """Places of the brackets outside strings, the depth after each, and +1 or -1 for opening or closing."""
    place = np.flatnonzero(np.frombuffer(text.translate(JSON_MARKS), bool))
    mark = np.frombuffer(text, np.uint8)[place]
    quote = mark == ord('"')
    if b"\\" in text:
        quote[quote] = ~_escaped(text, place[quote])
    inside = np.cumsum(quote, dtype=np.uint8) & 1  # the number of quotes, whose last bit an overflow keeps
    chosen = (inside == 0) & (mark != ord('"'))
    place, mark = place[chosen], mark[chosen]
    step = np.where((mark | 32) == ord("{"), 1, -1)  # 32: "[" and "{" differ by it, as "]" and "}" do
    return place, depth + np.cumsum(step), step


def _escaped(text: bytes, quote: Index) -> Index:
    """True for quotes after an odd number of backslashes."""
    letters = np.frombuffer(text, np.uint8)
    plain = np.where(letters != ord("\\"), np.arange(len(letters), dtype=np.int32), -1)
    before = np.append(np.int32(-1), np.maximum.accumulate(plain))  # last letter that is no backslash, before each
    return (quote - 1 - before[quote]) % 2 == 1


def _spans(
    text: bytes, brackets: tuple[Index, Index, Index], state: _State, where: str
) -> Iterator[tuple[int, Index, int]]:
    """Parts of the text inside an array: its begin, the ends of its elements, and up to where the text is consumed.

    Updates the state, which holds for the part that is yielded.
    """
    place, depth, step = brackets
    begin, first = 0, 0
    if state.array == 1:
        events = np.flatnonzero(depth == 0)[:1]
    else:
        events = np.flatnonzero(((step > 0) & (depth == 2)) | ((step < 0) & (depth <= 1)))
    for event in [*events.tolist(), len(place)]:
        closes = event < len(place) and step[event] < 0
        ends = place[first:event][(step[first:event] < 0) & (depth[first:event] == state.array)] + 1
        if state.inside:
            cut = int(place[event]) + 1 if closes else int(ends[-1]) if len(ends) else begin
            yield begin, ends, cut
        elif closes:
            yield begin, ends[:0], int(place[event]) + 1
        if event == len(place) or (closes and depth[event] <= 0):
            return
        first, previous, begin = event + 1, begin, int(place[event]) + 1
        state.inside = not closes and text[place[event]] == ord("[")
        if state.inside:
            state.key, state.arrays = _key(text[previous : begin - 1]), state.arrays + 1
            if state.arrays > MOST_ARRAYS:
                raise InputError(where, "", f"more than {MOST_ARRAYS} lists", "a timeline")
            yield begin, ends[:0], begin


def _key(text: bytes) -> str:
    """The name at the end of a text such as ``, "locations": ``."""
    name = text.rstrip(b" \t\r\n:").rpartition(b'"')[0].rpartition(b'"')[2]
    return name[-100:].decode("utf-8", "replace")


NO_POSITION = (math.nan, math.nan)
# "50.0506312°, 14.3439906°", "48.8566, 2.3522" and "geo:27.72,-97.34"
COORDINATES = re.compile(r"(?:geo:)?\s*(-?\d{1,3}(?:\.\d*)?)\s*°?\s*,\s*(-?\d{1,3}(?:\.\d*)?)\s*°?\s*", re.ASCII)
DECODE = msgspec.json.Decoder(list[dict[str, Any]]).decode


def lists_format(name: str, sign: bytes, lists: Mapping[str, Callable[[Sequence[Any], int], Batch]]) -> Format:
    """A format of JSON lists. sign: pattern in its first bytes; lists: for each list by its name, "" for a bare one, a
    function that makes a batch of some of its elements and the number of those that cannot be read.
    """

    def rows(stream: BinaryIO, where: str) -> Iterator[Batch]:
        for piece in pieces(stream, where):
            if piece.key in lists:
                yield lists[piece.key](*decoded(piece, DECODE, dict[str, Any]))

    return Format(name, re.compile(sign, re.DOTALL), rows)


def at(value: Any, *path: str) -> Any:
    """The value along a path of names in nested objects; None where there is none."""
    for name in path:
        value = value.get(name) if isinstance(value, dict) else None
    return value


def items(value: Any, *path: str) -> list[Any]:
    """The list along a path of names; empty where there is none."""
    found = at(value, *path)
    return found if isinstance(found, list) else []


def coordinates(value: Any) -> tuple[float, float]:
    """Latitude and longitude [deg] of a text, or of an object that has it as ``latLng``; NaN if it is neither."""
    if isinstance(value, dict):
        value = value.get("latLng") or value.get("LatLng")
    match = COORDINATES.fullmatch(value) if isinstance(value, str) and len(value) < 100 else None
    return (float(match[1]), float(match[2])) if match else NO_POSITION


def coordinates_e7(value: Any) -> tuple[float, float]:
    """Latitude and longitude [deg] of ``latitudeE7`` and ``longitudeE7``, or ``latE7`` and ``lngE7``; else NaN."""
    for names in (("latitudeE7", "longitudeE7"), ("latE7", "lngE7")):
        lat, lon = (float_of(at(value, name)) / E7 for name in names)
        if math.isfinite(lat) and math.isfinite(lon):
            return lat, lon
    return NO_POSITION
