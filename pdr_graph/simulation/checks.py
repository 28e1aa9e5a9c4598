"""Values of a scenario, checked one by one: what is wrong is refused with its place in the file."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from pdr_graph.errors import InputError
from pdr_graph.types import Array

FARTHEST = 1e5  # [m] from the origin
NAMES = {float: "a number", int: "a whole number", str: "a text", dict: "a table", list: "a list"}


def typed(path: Path, place: str, value: Any, kind: type) -> Any:
    """A value of a kind; a whole number will do for a float."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        if kind in (float, int) and isinstance(value, (int, kind)) and abs(value) < 1e15:
            return kind(value)
    elif isinstance(value, kind):
        return value
    raise InputError(path, place, repr(value), NAMES[kind])


def number(path: Path, place: str, value: Any, low: float = -1e5, high: float = 1e5, unit: str = "") -> float:
    """A number within bounds."""
    said = typed(path, place, value, float)
    if not low <= said <= high:
        raise InputError(path, place, f"{said:g}", f"{low:g} to {high:g} {unit}".rstrip())
    return said


def pair(path: Path, place: str, value: Any, needed: str = "[x, y] in metres", most: float = FARTHEST) -> Array:
    """Two numbers ``(2,)``, most of either."""
    if not isinstance(value, list | tuple) or len(value) != 2:
        raise InputError(path, place, repr(value), needed)
    both = np.array([typed(path, place, v, float) for v in value])
    if not np.all(np.abs(both) <= most):
        raise InputError(path, place, repr(value), f"{needed}, at most {most:g}")
    return both


def one_of(path: Path, place: str, value: Any, names: Iterable[str]) -> str:
    """One of some words."""
    if not isinstance(value, str) or value not in names:
        raise InputError(path, place, repr(value), "one of " + ", ".join(filter(None, names)))
    return value


def known(path: Path, place: str, table: Iterable[str], names: Iterable[str]) -> None:
    """A table has only keys that mean something."""
    for name in table:
        if name not in names:
            raise InputError(path, f"{place}.{name}".lstrip("."), "an unknown name", "one of " + ", ".join(names))
