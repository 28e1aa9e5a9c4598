"""The measurements in the window of a walk under way, by type of data."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import numpy as np

from pdr_graph.estimation.factors import KINDS, kind_of, measurements_of
from pdr_graph.estimation.factors.base import AnyArray, Measurement
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.types import INSTANT, Array, Fixes, Headings, Index, Mask, Sightings, Steps, appended, last_time, take

Rows = TypeVar("Rows", Fixes, Headings)
WAITING = 1000  # measurements of a type that are kept for the first steps
Decisions = dict[str, dict[str, AnyArray]]  # about measurements, by kind


class Collector(Protocol):
    """Makes measurements from receptions that arrive piecemeal (advertisements, scans)."""

    def collect(self, received: Sightings, radio: str) -> bool:
        """Store receptions of a radio, "bluetooth" or "wifi"; True if any of them is usable."""
        ...

    def due(self, until: float, walked: Callable[[Array], Array]) -> Iterable[Any]:
        """Return, once, the measurements that are complete until ``until`` [s].

        walked: times [s] to the distance walked by then [m].
        """
        ...

    def complete(self, steps: Steps) -> Iterable[Any]:
        """All measurements of the stored data, as the batch makes them."""
        ...

    def forget(self, before: float) -> None:
        """Drop raw data from before a moment [s]."""
        ...


@dataclass(frozen=True)
class Table:
    """Rows of one type of data. number: ``(n,)`` permanent row numbers; count: number of all rows so far."""

    data: Any
    number: Index
    count: int


class MeasurementLog:
    """The measurements of a window, by type of data, in order of time."""

    def __init__(self) -> None:
        self._tables: dict[type, Table] = {}
        self.version = 0  # increases when `measurements` would return others
        self.longer: MeasurementLog | None = None  # another log that gets the same rows, and keeps them longer

    def append(self, data: Any, number: Index | None = None) -> None:
        """Append rows. number: ``(n,)``, the next numbers by default; stored rows with these numbers are replaced."""
        kind_of(data)
        table = self._tables.get(type(data))
        count = 0 if table is None else table.count
        number = count + np.arange(len(data)) if number is None else number
        self.version += 1
        if self.longer is not None:
            self.longer.append(data, number)
        if table is not None:
            kept = np.flatnonzero(~np.isin(table.number, number))
            number = np.concatenate([table.number[kept], number])
            data = appended(take(table.data, kept), data)
        order = np.argsort(last_time(data), kind="stable")
        count = max(count, int(number.max(initial=-1)) + 1)
        self._tables[type(data)] = Table(take(data, order), number[order], count)

    @property
    def longest_overhang(self) -> float:
        """Time [s] by which stored measurements may lie outside the steps."""
        return max((self.overhang(table.data) for table in self._tables.values()), default=0.0)

    @staticmethod
    def overhang(data: Any) -> float:
        """Time [s] by which measurements of the type of ``data`` may lie outside the steps."""
        return kind_of(data).overhang + INSTANT

    def rows_and_numbers(self, kind: type[Rows]) -> tuple[Rows, Index]:
        """All rows of one type, in order of time, and their numbers."""
        table = self._tables.get(kind)
        return (kind.none(), np.empty(0, dtype=np.intp)) if table is None else (table.data, table.number)

    def all_numbers(self, until: float) -> dict[str, Index]:
        """Row numbers of each kind up to ``until`` [s], in order of time."""
        tables = self._tables.values()
        return {kind_of(t.data).name: t.number[last_time(t.data) <= until + INSTANT] for t in tables}

    def renumbered(self, name: str, decisions: dict[str, AnyArray]) -> dict[str, AnyArray]:
        """Decisions about one kind, by row of all data instead of permanent number; without rows that are gone."""
        numbers = self.all_numbers(np.inf).get(name)
        if "number" not in decisions or numbers is None:
            return decisions
        row, old = np.nonzero(numbers[:, None] == decisions["number"])
        return {**{column: values[old] for column, values in decisions.items()}, "number": row}

    def position_times(self) -> Array:
        """Times ``(n,)`` [s] of the rows that determine positions."""
        times = [last_time(table.data) for table in self._tables.values() if kind_of(table.data).determines_position]
        return np.concatenate([np.empty(0), *times])

    def until(self, end: float) -> list[Any]:
        """The rows of all types up to ``end`` [s]."""
        tables = [table.data for table in self._tables.values()]
        return [take(rows, np.flatnonzero(last_time(rows) <= end + INSTANT)) for rows in tables]

    def remove(self, kind: type, number: int) -> None:
        """Remove the row with this number, if there is one."""
        if self.longer is not None:
            self.longer.remove(kind, number)
        if kind in self._tables:
            self._keep(kind, self._tables[kind].number != number)

    def rows(self, kind: type) -> Any | None:
        """All rows of one type; None if none was ever appended."""
        table = self._tables.get(kind)
        return None if table is None else table.data

    def measurements(
        self, steps: Steps, prior: Prior, begin: float, end: float, decisions: Mapping[str, Mapping[str, AnyArray]]
    ) -> list[Measurement]:
        """All measurement kinds of the rows between ``begin`` and ``end`` [s], with decisions; not bound to a chain."""
        measurements = list[Measurement]()
        for kind in KINDS:
            table = self._tables.get(kind)
            if table is None:
                continue
            time, slack = last_time(table.data), self.overhang(table.data)
            which = np.flatnonzero((time >= begin - slack) & (time <= end + INSTANT))
            if len(which):
                rows, number = take(table.data, which), table.number[which]
                measurements += measurements_of(rows, steps, prior, number, decisions)
        return measurements

    def forget(self, before: float) -> None:
        """Drop the rows from before ``before`` [s]."""
        for kind, table in self._tables.items():
            time = table.data.time
            self._keep(kind, (time if time.ndim == 1 else time.min(axis=1)) >= before - INSTANT)

    def keep_latest(self, count: int = WAITING) -> None:
        """Drop all rows but the ``count`` of each type that arrived last; of the longer log too."""
        for kind, table in self._tables.items():
            self._keep(kind, np.isin(table.number, np.sort(table.number)[-count:]))
        if self.longer is not None:
            self.longer.keep_latest(count)

    def copy(self) -> MeasurementLog:
        """An independent log of the same rows."""
        other = MeasurementLog()
        other._tables, other.version = dict(self._tables), self.version
        return other

    def _keep(self, kind: type, kept: Mask) -> None:
        """Drop the rows of one type that are not ``kept (n,)``."""
        if not kept.all():
            table, self.version = self._tables[kind], self.version + 1
            self._tables[kind] = Table(take(table.data, kept), table.number[kept], table.count)


def numbered(decisions: dict[str, AnyArray], numbers: Index | None) -> dict[str, AnyArray]:
    """Decisions about rows 0, 1, … as those about the rows with permanent ``numbers``; without rows as they are."""
    if "number" not in decisions or numbers is None:
        return decisions
    return {**decisions, "number": numbers[decisions["number"].astype(np.intp)]}


def merged_decisions(old: Mapping[str, AnyArray], new: dict[str, AnyArray]) -> dict[str, AnyArray]:
    """The new decisions, and the old ones about instances that have no new one."""
    if "number" not in new or not old:
        return new
    kept = ~np.isin(old["number"], new["number"])
    joined = {name: np.concatenate([old[name][kept], column]) for name, column in new.items()}
    order = np.argsort(joined["number"])
    return {name: column[order] for name, column in joined.items()}
