"""Base of the data types: a `repr` of one line, and checks of their columns when an object is made."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from pdr_graph.errors import count

Table = TypeVar("Table", bound=Any)


class OneLineRepr:
    """Base of data types: their `repr` is ``Name(part, part)`` on one line, never a dump of arrays.

    row: the noun for one row, in the singular.
    """

    _row: ClassVar[str] = "row"

    def __init_subclass__(cls, row: str = "row", **options: object):
        super().__init_subclass__(**options)
        cls._row = row
        cls.__repr__ = OneLineRepr.__repr__  # in the class itself: `dataclass` replaces an inherited one

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(self._summary())})"

    def _repr_html_(self) -> str:
        """A table of the fields, and a picture of paths, plans and sensors: what a notebook shows."""
        from pdr_graph.notebook_html import html_of  # imports shapely

        return html_of(self)

    def _summary(self) -> list[str]:
        """The parts of the `repr`: the number of rows and the span of their times; other types override it."""
        return [count(len(getattr(self, "time", getattr(self, "position", ()))), self._row), *time_span(self)]


def time_span(record: object) -> list[str]:
    """The first and last time of a record's rows as a text, ``0.0 to 243.1 s``; empty without rows."""
    time = np.asarray(getattr(record, "time", ()))
    return [f"{time.min():.1f} to {time.max():.1f} s"] if time.size else []


def check_finite(record: object, *columns: str) -> None:
    """Store the named columns of `record` as float arrays ``(n, …)`` of equal length; lists are converted.

    The first column is the time. If it is a number, the record has one row, and its columns are lifted to arrays of one
    row. Raises ValueError unless all values are finite.
    """
    if isinstance(getattr(record, columns[0]), float | int | np.number):
        for name in columns:
            object.__setattr__(record, name, [getattr(record, name)])
    rows = len(_stored_array(record, columns[0]))
    for name in columns:
        values = _stored_array(record, name)
        if len(values) != rows or not np.isfinite(values).all():
            bad = np.flatnonzero(~np.isfinite(values).reshape(len(values), -1).all(axis=1)) if len(values) else []
            found = f"row {bad[0]}: {values[bad[0]]}" if len(bad) else f"{len(values)} rows"
            raise ValueError(f"{type(record).__name__}.{name}: found {found}, expected {rows} finite rows")


def _stored_array(record: object, name: str) -> NDArray[np.float64]:
    """Convert a column to an array, store it in the frozen record and return it."""
    column = getattr(record, name)
    try:
        values = np.asarray(column, dtype=np.float64)
    except (TypeError, ValueError):
        values = np.empty(())
    if not values.ndim:
        raise ValueError(f"{type(record).__name__}.{name}: found {type(column).__name__}, expected an array of numbers")
    object.__setattr__(record, name, values)
    return values


def check_each(name: str, valid: NDArray[np.bool_], values: NDArray[np.float64], expected: str) -> None:
    """Raise ValueError at the first row that is not valid; `expected` says what a valid row is."""
    if not valid.all():
        row = int(np.argmin(valid))
        raise ValueError(f"{name}, row {row}: found {values[row]}, expected {expected}")


def fill_labels(record: Any, *names: str) -> None:
    """Store an empty text per row if a column of texts was left empty; raise ValueError if its length is wrong."""
    rows = len(record.time)
    for name in names:
        labels = getattr(record, name) or ("",) * rows
        labels = (labels,) if isinstance(labels, str) else labels
        if len(labels) != rows:
            raise ValueError(f"{type(record).__name__}.{name}: found {len(labels)} labels, expected {rows}")
        object.__setattr__(record, name, labels)


def select_rows(table: Table, which: int | slice | NDArray[np.bool_] | NDArray[np.intp]) -> Table:
    """Selected rows of all columns, which are arrays or tuples; a column that is None or empty is kept."""
    index = np.atleast_1d(np.arange(len(table.time))[which])
    selected: dict[str, Any] = {}
    for name, column in vars(table).items():
        if isinstance(column, np.ndarray):
            selected[name] = column[index]
        elif isinstance(column, tuple) and column:
            selected[name] = tuple(map(column.__getitem__, index.tolist()))
    return replace(table, **selected)
