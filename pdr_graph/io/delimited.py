"""Columns of numbers from delimited text, by pyarrow where tables are long, with errors that name the line."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pdr_graph.errors import InputError
from pdr_graph.types import Array, OneLineRepr

DELIMITERS = "\t;,"  # in this order: a comma may be a decimal mark
MISSING = ("", "nan", "null", "none", "na", "n/a", "-")  # texts that recorders write for a missing value
FOR_ARROW = 500_000  # bytes from which the import of pyarrow, 0.1 s, is repaid
MAXIMUM_LINE = 10_000  # characters; rows of recorders have some hundred


@dataclass(frozen=True)
class TextRows(OneLineRepr):
    """Rows of one delimited text file.

    where: name of the file in messages; content: the rows in UTF-8; first: number of the first line, or of each line.
    Blank rows, and rows of empty cells alone, are not counted.
    """

    where: str
    content: bytes
    first: int | Sequence[int] = 1
    delimiter: str = ","

    @classmethod
    def of(cls, where: str, lines: Sequence[str], numbers: Sequence[int], delimiter: str = ",") -> TextRows:
        """Rows from some lines of a file and their line numbers."""
        return cls(where, "\n".join(lines).encode(), numbers, delimiter)

    def __len__(self) -> int:
        return len(self.lines)

    @cached_property
    def _numbered(self) -> list[tuple[int, str]]:
        """Line number and text of each row that is not blank."""
        lines = self.content.decode().split("\n")
        numbers = range(self.first, self.first + len(lines)) if isinstance(self.first, int) else self.first
        return [(number, line) for number, line in zip(numbers, lines, strict=False) if line.strip(" \r\t;,")]

    @cached_property
    def lines(self) -> list[str]:
        """Text of each row."""
        return [line for _, line in self._numbered]

    @cached_property
    def numbers(self) -> list[int]:
        """Line number of each row, from 1."""
        return [number for number, _ in self._numbered]

    def floats(self, columns: Sequence[int], cut_off_allowed: bool = True) -> Array:
        """The columns as numbers ``(n, k)``; NaN where a cell is empty or its number is too large.

        cut_off_allowed: leave out a last row that is too short; False for formats with an end mark.
        Raises InputError, with the line, if a cell is neither empty nor a number.
        """
        table = self._floats_by_arrow(columns) if len(self.content) > FOR_ARROW else None
        table = self._floats_by_cell(columns, cut_off_allowed) if table is None else table
        with np.errstate(invalid="ignore"):
            # a larger number is treated as missing; Unix times in nanoseconds are about 1e18
            numbers = np.abs(table) < 1e20
        if not numbers.all():
            table[~numbers] = np.nan
        return table

    def words(self, column: int) -> list[str]:
        """One column as texts ``(n,)``, empty where a row is too short."""
        return [row[column].strip() if column < len(row) else "" for row in self._cells]

    @cached_property
    def _cells(self) -> list[list[str]]:
        """The cells of each row; raises InputError if a line is too long."""
        for number, line in self._numbered:
            if len(line) > MAXIMUM_LINE:
                expected = f"at most {MAXIMUM_LINE} characters"
                raise InputError(self.where, f"line {number}", f"{len(line)} characters", expected)
        if b'"' in self.content:
            return [split(line, self.delimiter) for _, line in self._numbered]
        return [line.split(self.delimiter) for _, line in self._numbered]

    def _floats_by_arrow(self, columns: Sequence[int]) -> Array | None:
        """The columns as numbers, six times as fast; None without pyarrow, or if a cell is no plain number."""
        try:
            import pyarrow
            from pyarrow import csv as arrow
        except ImportError:
            return None
        names = [str(k) for k in range(self.content.partition(b"\n")[0].count(self.delimiter.encode()) + 1)]
        if b'"' in self.content or max(columns) >= len(names):
            return None
        kept = [names[k] for k in columns]
        try:
            table = arrow.read_csv(
                pyarrow.py_buffer(self.content),
                arrow.ReadOptions(use_threads=False, column_names=names),
                arrow.ParseOptions(delimiter=self.delimiter, quote_char=False, ignore_empty_lines=False),
                arrow.ConvertOptions(include_columns=kept, column_types=dict.fromkeys(kept, pyarrow.float64())),
            )
        except pyarrow.ArrowInvalid:
            return None
        if any(column.null_count for column in table.columns):
            return None
        # `to_numpy` would import pandas
        parts = [np.concatenate([*map(np.from_dlpack, column.chunks)]) for column in table.columns]
        return np.stack(parts, axis=1, dtype=float)

    def _floats_by_cell(self, columns: Sequence[int], cut_off_allowed: bool) -> Array:
        """The columns as numbers, cell by cell: slow, but allows empty cells and names the line of an error."""
        cells = self._cells
        with suppress(ValueError, IndexError):
            return np.array([[float(row[c]) for row in cells] for c in columns]).T.copy()
        last, table = max(columns), list[list[float]]()
        for (number, line), row in zip(self._numbered, cells, strict=True):
            if len(row) > last:
                table.append([self._number(number, row[c]) for c in columns])
            elif not cut_off_allowed or number < self._numbered[-1][0]:  # else the recorder stopped in mid-line
                raise InputError(
                    self.where, f"line {number}", f"{len(row)} fields, {line[:40]!r}", f"at least {last + 1} fields"
                )
        return np.array(table).reshape(-1, len(columns))

    def _number(self, line: int, cell: str) -> float:
        cell = cell.strip()
        if cell.lower() in MISSING:
            return math.nan
        try:
            return float(cell)
        except ValueError:
            raise InputError(self.where, f"line {line}", repr(cell[:40]), "a number") from None


@dataclass(frozen=True)
class Table(OneLineRepr):
    """A file with a header: column names as written, and rows."""

    header: tuple[str, ...]
    rows: TextRows

    def find(self, wanted: Callable[[str], bool]) -> int | None:
        """The number of the first column whose lower-case name is `wanted`; None if there is none."""
        return next((k for k, name in enumerate(self.header) if wanted(name.lower())), None)

    def floats(self, *names: str, optional: Sequence[str] = ()) -> Array:
        """Columns ``(n, k)`` by name in any case; a missing optional column is all NaN.

        Raises InputError if another column is missing.
        """
        columns = [self.find(name.lower().__eq__) for name in (*names, *optional)]
        if None in columns[: len(names)]:
            found = f"the columns {', '.join(self.header)[:80]}"
            raise InputError(self.rows.where, "the header", found, f"a column {names[columns.index(None)]}")
        return self.columns(columns)

    def columns(self, columns: Sequence[int | None]) -> Array:
        """Columns ``(n, k)`` by number, all NaN where that is None."""
        present = [n for n, column in enumerate(columns) if column is not None]
        values = self.rows.floats([column for column in columns if column is not None])
        wide = np.full((len(values), len(columns)), np.nan)
        wide[:, present] = values
        return wide


def split(line: str, delimiter: str) -> list[str]:
    """Split one line into cells, which may be quoted."""
    try:
        return next(csv.reader([line.strip("\r\n")], delimiter=delimiter), [])
    except csv.Error:
        return line.split(delimiter)


def table(where: str, text: str | bytes) -> Table:
    """Split the text of a CSV with a header. Delimiters are tab, semicolon or comma; decimal marks point or comma.

    where: name of the file in messages; text: or its UTF-8 bytes. Raises InputError if the text is empty or its header
    is too long.
    """
    content = text.encode() if isinstance(text, str) else text
    blank = re.match(rb"(?:\s*\n)?", content)
    body = content[blank.end() if blank else 0 :]
    if not body or body.isspace():
        raise InputError(where, "", "an empty file", "a header and rows")
    head, _, rows = body.partition(b"\n")
    line = head.decode()
    if len(line) > MAXIMUM_LINE:
        raise InputError(where, "line 1", f"{len(line)} characters", "a header")
    delimiter = next((d for d in DELIMITERS if d in line), ",")
    header = tuple(name.strip() for name in split(line.rstrip("\r"), delimiter))
    if delimiter != "," and b"," in b"".join(rows.split(b"\n", 10)[:10]):
        rows = rows.replace(b",", b".")
    first = content.count(b"\n", 0, len(content) - len(body)) + 2
    return Table(header, TextRows(where, rows, first, delimiter))


def rows_by_kind(
    where: str, lines: Iterable[str], kinds: Sequence[str], kind_of: Callable[[str], str], delimiter: str
) -> dict[str, TextRows]:
    """The rows of each kind that occurs, with their line numbers, of a file in which rows of several kinds alternate.

    kind_of: the kind of a line; other lines are left out.
    """
    texts: dict[str, list[str]] = {kind: [] for kind in kinds}
    numbers: dict[str, list[int]] = {kind: [] for kind in kinds}
    for number, line in enumerate(lines, start=1):
        kind = kind_of(line)
        if kind in texts:
            texts[kind].append(line)
            numbers[kind].append(number)
    return {kind: TextRows.of(where, texts[kind], numbers[kind], delimiter) for kind in kinds if texts[kind]}
