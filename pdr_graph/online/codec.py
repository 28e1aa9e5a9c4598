"""Events and snapshots as bytes and back, bit by bit, without pickle.

JSON of everything but the arrays, then their bytes, one after the other:

    checksum (4 bytes) · length of the JSON (4) · JSON, an array as {"@": [dtype, *shape]} · bytes of the arrays
"""

from __future__ import annotations

import json
import math
import struct
import zlib
from collections.abc import Callable
from dataclasses import fields
from functools import cache
from typing import Any, TypeVar

import numpy as np

from pdr_graph.online.events import Samples, Scan
from pdr_graph.types import Fixes, Sightings, Steps, Trajectory

HEADER = struct.Struct("<II")
CHECKED = 4  # [bytes] before those that the checksum is of
ARRAY = "@"
DTYPES = frozenset(np.dtype(name).str for name in ("f8", "f4", "c16", "i8", "i4", "u8", "u4", "u1", "?"))
MOST_DIMENSIONS = 8
EVENTS = (Samples, Fixes, Scan, Steps)
NOUNS = {kind.__name__: kind for kind in (*EVENTS, Trajectory)}
UNREADABLE = (struct.error, ValueError, TypeError, LookupError, RecursionError, OverflowError)
Noun = TypeVar("Noun")


def encode(noun: Samples | Fixes | Scan | Steps | Trajectory) -> bytes:
    """An event, or a trajectory. Raises TypeError where a field is not of its type: it would not come back."""
    return pack({type(noun).__name__: _values(noun)})


def decode(blob: bytes, kinds: tuple[type, ...]) -> Any:
    """What `encode` made these bytes of, one of these kinds. Raises ValueError where it made no such."""
    try:
        [(name, values)] = unpack(blob).items()
        noun = _made(NOUNS[name], values)
    except (*UNREADABLE, AttributeError) as error:
        raise ValueError(f"bytes of neither {' nor '.join(k.__name__ for k in kinds)} ({str(error)[:80]})") from None
    if not isinstance(noun, kinds):
        raise ValueError(f"bytes of {name}")
    return noun


def pack(tree: object) -> bytes:
    """Dictionaries with names as keys, lists, texts, numbers, None and numeric arrays. Tuples come back as lists.

    Raises TypeError on anything else.
    """
    parts: list[bytes] = []

    def put(what: object) -> object:
        if isinstance(what, np.generic):
            return what.item()
        if not isinstance(what, np.ndarray) or what.dtype.str not in DTYPES:
            raise TypeError(f"found {type(what).__name__} {what!r:.80}, needed texts, numbers and numeric arrays")
        parts.append(what.tobytes())
        return {ARRAY: [what.dtype.str, *what.shape]}

    text = json.dumps(tree, default=put, separators=(",", ":"))
    if text.count(f'"{ARRAY}":') != len(parts):
        raise TypeError(f"found a key {ARRAY!r}, which says where an array is")
    told = text.encode()
    checked = b"".join([struct.pack("<I", len(told)), told, *parts])
    return struct.pack("<I", zlib.crc32(checked)) + checked


def unpack(blob: bytes) -> Any:
    """What `pack` made these bytes of, in memory as long as they are. Raises ValueError where it made no such."""
    try:
        return _unpacked(memoryview(blob))
    except UNREADABLE as error:
        raise ValueError(f"damaged bytes ({str(error)[:80]})") from None


def _unpacked(blob: memoryview) -> Any:
    checksum, length = HEADER.unpack_from(blob)
    if zlib.crc32(blob[CHECKED:]) != checksum:
        raise ValueError("their checksum is of others")
    at = HEADER.size + length

    def get(said: dict[str, Any]) -> Any:
        nonlocal at
        if said.keys() != {ARRAY}:
            return said
        dtype, *shape = said[ARRAY]
        if dtype not in DTYPES or len(shape) > MOST_DIMENSIONS or any(type(n) is not int or n < 0 for n in shape):
            raise ValueError(f"an array {said[ARRAY]}")
        begin, at = at, at + math.prod(shape) * np.dtype(dtype).itemsize
        if at > len(blob):
            raise ValueError(f"an array {said[ARRAY]} in {len(blob)} bytes")
        # a copy: aligned, and the receiver's own
        return np.frombuffer(blob[begin:at], dtype).reshape(shape).copy()

    tree = json.loads(bytes(blob[HEADER.size : at]), object_hook=get)
    if at != len(blob):
        raise ValueError(f"{len(blob)} bytes, {at} of them told of")
    return tree


def _is_texts(value: object) -> bool:
    return isinstance(value, tuple) and all(isinstance(one, str) for one in value)


OF_TYPE: dict[Any, Callable[[Any], bool]] = {  # by what the field's declaration says
    "Array": lambda value: isinstance(value, np.ndarray),
    "Array | None": lambda value: value is None or isinstance(value, np.ndarray),
    "str": lambda value: isinstance(value, str),
    "tuple[str, ...]": _is_texts,
    "float": lambda value: isinstance(value, (float, int, np.number)),
    "int | None": lambda value: value is None or isinstance(value, (int, np.integer)),
    "Sightings": lambda value: isinstance(value, Sightings),
}


@cache
def _declared(kind: Any) -> dict[str, Any]:
    return {field.name: field.type for field in fields(kind)}


def _values(noun: object) -> dict[str, Any]:
    """What the fields of a noun hold, each of its type."""
    values = {}
    for name, declared in _declared(type(noun)).items():
        value = getattr(noun, name)
        if not OF_TYPE[declared](value):
            raise TypeError(f"{type(noun).__name__}.{name}: found {value!r:.80}, needed {declared}")
        values[name] = _values(value) if isinstance(value, Sightings) else value
    return values


def _made(kind: Callable[..., Noun], values: dict[str, Any]) -> Noun:
    """A noun of the fields' values, which JSON has as lists where they are tuples."""
    given, declared = {}, _declared(kind)
    for name, value in values.items():
        if declared[name] == "Sightings":
            given[name] = _made(Sightings, value)
        else:
            given[name] = tuple(value) if isinstance(value, list) else value
    noun = kind(**given)
    _values(noun)
    return noun
