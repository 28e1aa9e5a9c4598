"""Tables of measurements for the graph, beside the steps: one frozen data type per kind, rows sorted by time.

A data type is a frozen dataclass with ``time``, ``(n,)`` or ``(n, 2)`` for pairs [s]. Arrays and tuples of n values are
columns with a value per row. A type may state, as class variables:

limits: least and largest value of a column; a live walk leaves out rows beyond them, and rows that are not finite.
most: rows that a live walk uses in a quarter of a second.
tables, reference: names of the fields that rows refer to (label, position of anchors), and the column that refers to
    them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Protocol, TypeVar

import numpy as np

from pdr_graph.columns import OneLineRepr
from pdr_graph.types import FARTHEST, FINEST, Array, Index, Limits

Data = TypeVar("Data", bound=Any)


class Measured(Protocol):
    """A table of measurements. time: of each row [s]."""

    @property
    def time(self) -> Array: ...  # noqa: D102


@dataclass(frozen=True)
class Levels(OneLineRepr, row="level"):
    """Mean signal strengths of beacons over parts of a walk; ``l`` levels, ``m`` beacons.

    time: ``(l,)`` [s]; beacon: ``(l,)`` its row in the table of beacons; rssi: ``(l,)`` mean [dBm].
    label: name of each beacon; position: ``(m, 2)`` [m], NaN where unknown; sigma: ``(m,)`` per axis [m].
    """

    time: Array
    beacon: Index
    rssi: Array
    label: tuple[str, ...]
    position: Array
    sigma: Array

    tables: ClassVar[tuple[str, ...]] = ("label", "position", "sigma")
    reference: ClassVar[str] = "beacon"
    limits: ClassVar[Limits] = {
        "rssi": (-200.0, 200.0),
        "position": (-FARTHEST, FARTHEST),
        "sigma": (FINEST, FARTHEST),
    }
    most: ClassVar[None] = None  # as many as there are beacons

    def __len__(self) -> int:
        return len(self.time)


@dataclass(frozen=True)
class Closures(OneLineRepr, row="closure"):
    """Loop closures: ``l`` pairs of times at which the walker was at one place. Some may be wrong.

    time: ``(l, 2)`` both times of each pair [s]; sigma: ``(l,)`` per axis of the distance between both places [m].
    walk: ``(l, 2)`` number of the walk of each time, if there are several walks.
    """

    time: Array
    sigma: Array
    walk: Index

    limits: ClassVar[Limits] = {"sigma": (FINEST, FARTHEST)}
    most: ClassVar[int] = 2

    @classmethod
    def of(cls, rows: Sequence[tuple[float, float, float]], walks: Sequence[tuple[int, int]] = ()) -> Closures:
        """Closures from rows of two times [s] and a sigma [m]; all in walk 0 by default."""
        table = np.array(rows, dtype=float).reshape(-1, 3)
        walk = np.array(walks, dtype=np.intp).reshape(-1, 2) if walks else np.zeros((len(table), 2), np.intp)
        return cls(table[:, :2], table[:, 2], walk)

    @classmethod
    def concatenate(cls, parts: Sequence[Closures]) -> Closures:
        """The closures of all parts, in their order; 0 rows for an empty list."""
        names, parts = ("time", "sigma", "walk"), (cls.of([]), *parts)
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def shifted(self, begins: Array) -> Closures:
        """Closures of one walk: the times of walk ``w`` are ``begins[w]`` [s] later, and every walk number is 0."""
        return replace(self, time=self.time + begins[self.walk], walk=np.zeros_like(self.walk))

    def __len__(self) -> int:
        return len(self.time)


@dataclass(frozen=True)
class Ranges(OneLineRepr, row="range"):
    """Distances to anchors: UWB, Wi-Fi RTT, BLE ranging; ``n`` ranges, ``m`` anchors.

    time: ``(n,)`` [s]; anchor: ``(n,)`` its row in the table of anchors; range: ``(n,)`` [m]; sigma: ``(n,)`` with line
    of sight [m].
    label: of each anchor; position: ``(m, 2)`` [m]; position_sigma: ``(m,)`` of its survey, per axis [m].
    """

    time: Array
    anchor: Index
    range: Array
    sigma: Array
    label: tuple[str, ...]
    position: Array
    position_sigma: Array

    tables: ClassVar[tuple[str, ...]] = ("label", "position", "position_sigma")
    reference: ClassVar[str] = "anchor"
    limits: ClassVar[Limits] = {
        "range": (0.0, FARTHEST),
        "sigma": (FINEST, FARTHEST),
        "position": (-FARTHEST, FARTHEST),
        "position_sigma": (FINEST, FARTHEST),
    }
    most: ClassVar[int] = 10

    def __post_init__(self) -> None:
        """Raise ValueError on what would make an estimate NaN or silently wrong."""
        for name in ("time", "range", "sigma", "position", "position_sigma"):
            if not np.isfinite(getattr(self, name)).all():
                raise ValueError(f"Ranges.{name}: found a value that is not finite, expected finite numbers")
        if (self.sigma <= 0).any() or (self.range < 0).any() or (self.position_sigma <= 0).any():
            raise ValueError("Ranges: found a range below 0 m or a sigma not above 0 m, expected distances and sigmas")

    def __len__(self) -> int:
        return len(self.time)


@dataclass(frozen=True)
class RangeReport:
    """How one range was used.

    residual: measured minus expected [m], positive if the range is too long; weight: share of its information that was
    used, 0-1.
    """

    time: float
    anchor: str
    range: float
    sigma: float
    residual: float
    weight: float
    reason: str


def take(data: Data, which: Index) -> Data:
    """The rows `which` of a measurement table."""
    selected = {}
    for name in row_columns(data):
        column = getattr(data, name)
        selected[name] = column[which] if isinstance(column, np.ndarray) else tuple(column[i] for i in which.tolist())
    return replace(data, **selected)


def appended(data: Data, more: Data) -> Data:
    """The rows of `data` and then of `more`, of the same type; tables that rows refer to are taken from `more`."""
    return replace(more, **{name: _stacked([getattr(data, name), getattr(more, name)]) for name in row_columns(data)})


def with_offset(data: Data, seconds: float) -> Data:
    """The table with `seconds` added to its times."""
    return replace(data, time=data.time + seconds)


def concatenate(parts: Sequence[Data]) -> Data:
    """The rows of at least one table, all of one type, in the order of the parts.

    Tables that rows refer to are merged: a label names one beacon or anchor, described by the first part that has it.
    """
    parts = [part for part in parts if len(part)] or list(parts[:1])
    first = parts[0]
    if len(parts) == 1:
        return first
    joined = {name: _stacked([getattr(part, name) for part in parts]) for name in row_columns(first)}
    tables = getattr(type(first), "tables", ())
    if tables:
        named: dict[tuple[str, int], tuple[Data, int]] = {}
        keys = [list(_keys(part)) for part in parts]
        for part, of_part in zip(parts, keys, strict=True):
            for m, key in enumerate(of_part):
                named.setdefault(key, (part, m))
        row_of = {key: row for row, key in enumerate(named)}
        rows = [np.array([row_of[key] for key in of_part], dtype=np.intp) for of_part in keys]
        column = type(first).reference
        joined[column] = np.concatenate([row[getattr(part, column)] for row, part in zip(rows, parts, strict=True)])
        for name in tables:
            values = [getattr(part, name)[m] for part, m in named.values()]
            joined[name] = tuple(values) if isinstance(getattr(first, name), tuple) else np.array(values)
    return replace(first, **joined)


def by_type(tables: Sequence[Any]) -> tuple[Any, ...]:
    """The tables with all of one type concatenated, in the order in which the types first appear."""
    kinds = dict.fromkeys(type(table) for table in tables)
    return tuple(concatenate([table for table in tables if type(table) is kind]) for kind in kinds)


def last_time(data: Any) -> Array:
    """The time ``(n,)`` at which each row is complete: its only time, or the later of two. [s]"""
    return data.time if data.time.ndim == 1 else data.time.max(axis=1)


def row_columns(data: Any) -> list[str]:
    """The names of the columns with one value per row; other fields are tables that rows refer to."""
    tables = getattr(type(data), "tables", ())
    columns = [(field.name, getattr(data, field.name)) for field in fields(data) if field.name not in tables]
    return [name for name, column in columns if isinstance(column, (np.ndarray, tuple)) and len(column) == len(data)]


def _stacked(columns: Sequence[Any]) -> Any:
    """Columns of several tables below each other: arrays or tuples."""
    if isinstance(columns[0], np.ndarray):
        return np.concatenate(columns)
    return tuple(value for column in columns for value in column)


def _keys(part: Any) -> Iterator[tuple[str, int]]:
    """The label of each beacon or anchor of a part, and how often it stands before in its list.

    A label that stands several times in one list names several things, in the order of the list.
    """
    before = Counter[str]()
    for label in part.label:
        yield label, before[label]
        before[label] += 1
