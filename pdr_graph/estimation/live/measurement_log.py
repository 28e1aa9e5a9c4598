"""What was measured in the window of a walk under way, by type of data."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from pdr_graph.estimation.factors import KINDS, kind_of, measurements_of
from pdr_graph.estimation.factors.base import AnyArray, Measurement
from pdr_graph.estimation.factors.preintegration import DECIMALS
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.measurements import appended, last_time, take
from pdr_graph.storage import decode, encode
from pdr_graph.types import INSTANT, Array, Index, Mask, Steps


class Collector(Protocol):
    """What makes measurements out of raw data that comes in bit by bit (advertisements, scans)."""

    def collect(self, data: Any) -> bool:
        """Take raw data; whether it was of use."""
        ...

    def due(self, until: float, walked: Callable[[Array], Array]) -> Iterable[Any]:
        """Measurements that are complete until a moment [s], once; walked: how far the steps have led by some times."""
        ...

    def complete(self, steps: Steps) -> Iterable[Any]:
        """All measurements of the data that is kept, as a batch would make them."""
        ...

    def forget(self, before: float) -> None:
        """Drop raw data from before a moment [s]."""
        ...

    def checkpoint(self) -> dict[str, Array]:
        """What it keeps, as arrays by name."""
        ...

    def restore(self, checkpoint: Mapping[str, Array]) -> None:
        """Go on from a checkpoint."""
        ...


@dataclass(frozen=True)
class Table:
    """Rows of one type of data. number: ``(n,)`` of each row, for good; count: of all rows that there have been."""

    data: Any
    number: Index
    count: int


@dataclass(frozen=True)
class TableCheckpoint:
    """A `Table`. data: as of `storage.encode`, which tells its type by name: any of `KINDS`."""

    data: bytes
    number: Index
    count: int


class MeasurementLog:
    """The measurements of a window, by type of data, in order of time."""

    def __init__(self) -> None:
        self._tables: dict[type, Table] = {}
        self.version = 0  # of what `measurements` returns

    def append(self, data: Any, number: Index | None = None) -> None:
        """Append rows; number: ``(n,)`` of these, the next ones by default; rows of known numbers are replaced."""
        kind_of(data)
        known = self._tables.get(type(data))
        count = 0 if known is None else known.count
        number = count + np.arange(len(data)) if number is None else number
        self.version += 1
        if known is not None:
            kept = np.flatnonzero(~np.isin(known.number, number))
            number = np.concatenate([known.number[kept], number])
            data = appended(take(known.data, kept), data)
        order = np.argsort(last_time(data), kind="stable")
        count = max(count, int(number.max(initial=-1)) + 1)
        self._tables[type(data)] = Table(take(data, order), number[order], count)

    @property
    def overhangs(self) -> dict[str, float]:
        """By how much measurements may lie outside the steps, by kind [s]."""
        return {kind_of(table.data).name: self.overhang(table.data) for table in self._tables.values()}

    @staticmethod
    def overhang(data: Any) -> float:
        """By how much measurements of a type may lie outside the steps. [s]"""
        return kind_of(data).overhang + INSTANT

    @staticmethod
    def times(data: Any) -> Array:
        """The times of rows ``(n,)``, or ``(n, 2)`` of pairs. [s]"""
        kind_of(data)
        return np.asarray(np.round(np.asarray(data.time, dtype=np.float64), DECIMALS), dtype=np.float64)

    @staticmethod
    def select(data: Any, kept: Mask) -> Any:
        """Some rows."""
        return take(data, np.flatnonzero(kept if kept.ndim == 1 else kept.all(axis=1)))

    def numbers(self, name: str) -> Index | None:
        """The numbers of the rows of one kind, in order of time; None if there are none."""
        return next((one.number for one in self._tables.values() if kind_of(one.data).name == name), None)

    def placing_times(self) -> Array:
        """The times of the rows that tell where the walk was. [s]"""
        placing = [last_time(table.data) for table in self._tables.values() if kind_of(table.data).places]
        return np.concatenate([np.empty(0), *placing])

    def until(self, end: float) -> list[Any]:
        """The rows of all types up to a moment [s]."""
        data = [table.data for table in self._tables.values()]
        return [take(one, np.flatnonzero(last_time(one) <= end + INSTANT)) for one in data]

    def remove(self, kind: type, number: int) -> None:
        """Remove a row, if it is there."""
        table = self._tables.get(kind)
        if table is not None:
            self._keep(kind, table, table.number != number)
            self.version += 1

    def rows(self, kind: type) -> Any | None:
        """All rows of one type, None if there never was one."""
        table = self._tables.get(kind)
        return None if table is None else table.data

    def measurements(
        self, steps: Steps, prior: Prior, begin: float, end: float, decisions: Mapping[str, Mapping[str, AnyArray]]
    ) -> list[Measurement]:
        """All kinds, from the rows between two moments [s], with what was decided about them; not yet on a chain."""
        found = list[Measurement]()
        for kind in KINDS:
            table = self._tables.get(kind)
            if table is None:
                continue
            time, slack = last_time(table.data), kind_of(table.data).overhang + INSTANT
            which = np.flatnonzero((time >= begin - slack) & (time <= end + INSTANT))
            if len(which):
                known = decisions.get(kind_of(table.data).name, {})
                found += measurements_of(take(table.data, which), steps, prior, table.number[which], known)
        return found

    def forget(self, before: float) -> None:
        """Drop the rows from before a moment [s]."""
        for kind, table in list(self._tables.items()):
            time = table.data.time
            kept = (time if time.ndim == 1 else time.min(axis=1)) >= before - INSTANT
            if not kept.all():
                self._keep(kind, table, kept)
                self.version += 1

    def checkpoint(self) -> list[TableCheckpoint]:
        """All tables."""
        return [TableCheckpoint(encode(one.data), one.number, one.count) for one in self._tables.values()]

    def restore(self, checkpoint: Sequence[TableCheckpoint]) -> None:
        """Go on from a checkpoint. Raises ValueError if a table is of none of `KINDS`."""
        tables = [Table(decode(one.data, *KINDS), one.number.copy(), one.count) for one in checkpoint]
        self._tables = {type(one.data): one for one in tables}

    def _keep(self, kind: type, table: Table, kept: Any) -> None:
        which = np.flatnonzero(kept)
        self._tables[kind] = Table(take(table.data, which), table.number[which], table.count)
