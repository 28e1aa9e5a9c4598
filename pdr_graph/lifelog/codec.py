"""The nouns of a lifelog as bytes and back, bit by bit, by the types that their fields are declared with."""

from __future__ import annotations

import types
import zlib
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from functools import cache
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from pdr_graph.online.codec import pack, unpack

LEVEL = 1  # of zlib: the next ones take twice the time for a hundredth of the size of random digits
Noun = TypeVar("Noun")


def encode(noun: object) -> bytes:
    """A frozen dataclass of this package's, with all the others in it. Raises TypeError where one is something else."""
    return zlib.compress(pack(tree_of(noun)), LEVEL)


def decode(kind: type[Noun], blob: bytes) -> Noun:
    """What `encode` made these bytes of. Raises ValueError where it was no such noun, or they are damaged."""
    try:
        return noun_of(kind, unpack(zlib.decompress(blob)))
    except (zlib.error, AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"bytes of no {kind.__name__} ({str(error)[:80]})") from None


def tree_of(value: object) -> object:
    """What JSON and arrays can say of a noun, or of a value of one of its fields."""
    if is_dataclass(value):
        return {field.name: tree_of(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, tuple) and value and all(isinstance(one, str) for one in value):
        return _told_once(value)
    return [tree_of(one) for one in value] if isinstance(value, tuple) else value


def noun_of(declared: Any, value: Any) -> Any:
    """The noun or value, of a declared type, of which `tree_of` made this. Raises as `decode` catches it."""
    origin, arguments = get_origin(declared), get_args(declared)
    if origin in (Union, types.UnionType):
        return None if value is None else noun_of(arguments[0], value)
    if origin is tuple:
        return _tuple(arguments, value)
    if is_dataclass(declared):
        make: Callable[..., Any] = declared  # pyright: ignore[reportAssignmentType]
        hints = _hints(declared)
        return make(**{name: noun_of(hints[name], one) for name, one in value.items()})
    wanted = np.ndarray if origin is np.ndarray else declared
    if not isinstance(value, wanted) and not (wanted is float and isinstance(value, int)):
        raise TypeError(f"found {value!r:.40}, needed {wanted.__name__}")
    return value


def _told_once(texts: tuple[str, ...]) -> dict[str, object]:
    """Each text once, and which comes when: a million rows are on the same few floors."""
    number = {text: n for n, text in enumerate(dict.fromkeys(texts))}
    return {"texts": list(number), "which": np.array([number[text] for text in texts], dtype=np.int32)}


@cache
def _hints(kind: type) -> dict[str, Any]:
    return get_type_hints(kind)


def _tuple(arguments: tuple[Any, ...], value: Any) -> tuple[Any, ...]:
    if isinstance(value, dict):
        return tuple(map(value["texts"].__getitem__, value["which"].tolist()))
    if arguments[-1] is Ellipsis:
        return tuple(noun_of(arguments[0], one) for one in value)
    return tuple(noun_of(kind, one) for kind, one in zip(arguments, value, strict=True))
