"""Tables of measurements for the graph, beside the steps: one frozen data type per kind, rows sorted by time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, TypeVar

import numpy as np

from pdr_graph.columns import OneLineRepr
from pdr_graph.types import Array, Index

Data = TypeVar("Data", bound=Any)


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
class Ranges:
    """Distances to anchors: UWB, Wi-Fi RTT, BLE ranging; ``n`` ranges, ``m`` anchors.

    time: ``(n,)`` [s]; anchor: ``(n,)`` which; range: ``(n,)`` [m]; sigma: ``(n,)`` with line of sight [m].
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
    """What became of one range.

    residual: measured less expected [m], long where it is positive; weight: share of its information that was used.
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
    for name in _row_fields(data):
        column = getattr(data, name)
        selected[name] = column[which] if isinstance(column, np.ndarray) else tuple(column[i] for i in which.tolist())
    return replace(data, **selected)


def appended(data: Data, more: Data) -> Data:
    """The rows of `data` and then of `more`, of the same type; tables that rows refer to are taken from `more`."""
    joined = {}
    for name in _row_fields(data):
        first, second = getattr(data, name), getattr(more, name)
        joined[name] = np.concatenate([first, second]) if isinstance(first, np.ndarray) else (*first, *second)
    return replace(more, **joined)


def last_time(data: Any) -> Array:
    """The time ``(n,)`` at which each row is complete: its only time, or the later of two. [s]"""
    return data.time if data.time.ndim == 1 else data.time.max(axis=1)


def _row_fields(data: Any) -> list[str]:
    """The names of the columns with one value per row; other fields are tables that rows refer to."""
    tables = getattr(type(data), "tables", ())
    columns = [(field.name, getattr(data, field.name)) for field in fields(data) if field.name not in tables]
    return [name for name, column in columns if isinstance(column, (np.ndarray, tuple)) and len(column) == len(data)]
