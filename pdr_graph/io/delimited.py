"""Columns of numbers from delimited text, at the speed of NumPy or pyarrow, with errors that name the line."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import overload

import numpy as np

from pdr_graph.errors import InputError, count
from pdr_graph.types import Array, OneLineRepr

DELIMITERS = "\t;,"  # in this order: a comma may be a decimal mark
MISSING = ("", "nan", "null", "none", "na", "n/a", "-")  # texts that recorders write for a missing value
FOR_ARROW = 20_000  # rows from which the import of pyarrow, 0.1 s, is repaid
MAXIMUM_LINE = 10_000  # characters; rows of recorders have some hundred


class Lines(Sequence[str]):
    """The lines of a UTF-8 text, split when one of them is asked for: pyarrow splits long tables itself."""

    def __init__(self, content: bytes, begin: int = 0, count: int | None = None):
        """begin: of the first line in ``content`` [bytes]; count: number of lines, if it is known."""
        self.content, self.begin = content, begin
        self.end = max(begin, len(content) - content.endswith(b"\n"))
        self._count = content.count(b"\n", begin, self.end) + 1 if count is None else count
        self._count *= self.end > begin

    def __len__(self) -> int:
        return self._count

    @overload
    def __getitem__(self, index: int) -> str: ...
    @overload
    def __getitem__(self, index: slice) -> list[str]: ...
    def __getitem__(self, index: int | slice) -> str | list[str]:
        return self._split[index]

    def __iter__(self) -> Iterator[str]:
        return iter(self._split)

    @cached_property
    def _split(self) -> list[str]:
        return self.content[self.begin : self.end].decode().split("\n") if self._count else []

    def head(self, count: int) -> list[str]:
        """The first few lines."""
        head, end = [], self.begin - 1
        while len(head) < min(count, self._count):
            first = end + 1
            end = self.content.find(b"\n", first, self.end)
            end = self.end if end < 0 else end
            head.append(self.content[first:end].decode())
        return head


@dataclass(frozen=True)
class TextRows(OneLineRepr):
    """Rows of one delimited text file.

    where: name of the file in messages; lines: text of the rows; numbers: their line numbers, from 1.
    """

    where: str
    lines: Sequence[str]
    numbers: Sequence[int]
    delimiter: str = ","

    def __len__(self) -> int:
        return len(self.lines)

    def _summary(self) -> list[str]:
        return [repr(self.where), count(len(self.lines), "row")]

    def floats(self, columns: Sequence[int], cut_off_allowed: bool = True) -> Array:
        """The columns as numbers ``(n, k)``; NaN where a cell is empty or its number is too large.

        cut_off_allowed: leave out a last row that is too short; False for formats with an end mark.
        Raises InputError, with the line, if a cell is neither empty nor a number.
        """
        if not self.lines:
            return np.empty((0, len(columns)))
        table = self._floats_by_arrow(columns) if len(self.lines) > FOR_ARROW else None
        table = self._floats_by_numpy(columns) if table is None else table
        table = self._floats_by_cell(columns, cut_off_allowed) if table is None else table
        with np.errstate(invalid="ignore"):
            # maximum number: a larger number is treated as missing; Unix times in nanoseconds are about 1e18
            numbers = np.abs(table) < 1e20
        if not numbers.all():
            table[~numbers] = np.nan
        return table

    def words(self, column: int) -> list[str]:
        """One column as texts ``(n,)``, empty where a row is too short."""
        return [row[column].strip() if column < len(row) else "" for row in self._cells()]

    def word(self, column: int) -> str:
        """A cell of the first row; empty if the row is too short or there is none."""
        return next(iter(TextRows(self.where, self.lines[:1], self.numbers[:1], self.delimiter).words(column)), "")

    def _cells(self) -> list[list[str]]:
        """The cells of each row; raises InputError if a line is too long."""
        if any(len(line) > MAXIMUM_LINE for line in self.lines):
            longest = int(np.argmax([len(line) for line in self.lines]))
            found = f"{len(self.lines[longest])} characters"
            raise InputError(self.where, f"line {self.numbers[longest]}", found, f"at most {MAXIMUM_LINE} characters")
        if any('"' in line for line in self.lines):
            return [split(line, self.delimiter) for line in self.lines]
        return [line.split(self.delimiter) for line in self.lines]

    def _floats_by_arrow(self, columns: Sequence[int]) -> Array | None:
        """The columns as numbers, thrice as fast as by NumPy; None without pyarrow or if a cell is no plain number."""
        try:
            import pyarrow
            from pyarrow import csv as arrow
        except ImportError:
            return None
        lines = (
            self.lines if isinstance(self.lines, Lines) else Lines("\n".join(self.lines).encode(), 0, len(self.lines))
        )
        width = lines.head(1)[0].count(self.delimiter) + 1
        if lines.content.find(b'"', lines.begin, lines.end) >= 0 or max(columns) >= width:
            return None
        names = [str(k) for k in range(width)]
        kept = [names[k] for k in columns]
        try:
            table = arrow.read_csv(
                pyarrow.py_buffer(memoryview(lines.content)[lines.begin : lines.end]),
                arrow.ReadOptions(use_threads=False, column_names=names),
                arrow.ParseOptions(delimiter=self.delimiter, quote_char=False),
                arrow.ConvertOptions(include_columns=kept, column_types=dict.fromkeys(kept, pyarrow.float64())),
            )
        except pyarrow.ArrowInvalid:
            return None
        if len(table) != len(self.lines) or any(column.null_count for column in table.columns):
            return None
        # `to_numpy` would import pandas
        parts = [np.concatenate([*map(np.from_dlpack, column.chunks)]) for column in table.columns]
        return np.stack(parts, axis=1, dtype=float)

    def _floats_by_numpy(self, columns: Sequence[int]) -> Array | None:
        """The columns as numbers; None if a cell is none."""
        try:
            table = np.loadtxt(
                self.lines, delimiter=self.delimiter, usecols=columns, comments=None, quotechar='"', ndmin=2
            )
        except (ValueError, OverflowError):
            return None
        return table if len(table) == len(self.lines) else None  # an open quote joins a line to the next

    def _floats_by_cell(self, columns: Sequence[int], cut_off_allowed: bool) -> Array:
        """The columns as numbers, cell by cell: slow, but allows empty cells and names the line of an error."""
        table: list[list[float]] = []
        for number, line, row in zip(self.numbers, self.lines, self._cells(), strict=True):
            if len(row) <= max(columns):
                if cut_off_allowed and number == self.numbers[-1]:
                    break  # the recorder stopped in mid-line
                found = f"{len(row)} fields, {line[:40]!r}"
                raise InputError(self.where, f"line {number}", found, f"at least {max(columns) + 1} fields")
            table.append([self._number(number, row[c]) for c in columns])
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

    def _summary(self) -> list[str]:
        return [repr(self.rows.where), count(len(self.header), "column"), count(len(self.rows), "row")]

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
        present = [n for n, column in enumerate(columns) if column is not None]
        values = self.rows.floats([column for column in columns if column is not None])
        if len(present) == len(columns):
            return values
        wide = np.full((len(values), len(columns)), np.nan)
        wide[:, present] = values
        return wide


def split(line: str, delimiter: str) -> list[str]:
    """Split one line into cells, which may be quoted."""
    try:
        return next(csv.reader([line.strip("\r\n")], delimiter=delimiter), [])
    except csv.Error:
        return line.split(delimiter)


BLANKS = " \r\t;,"  # the only characters of a row with empty cells
BLANK_ROW = re.compile(rf"\n[{BLANKS}]*\n|\n[{BLANKS}]+\Z".encode())
BEGINS_BLANK_ROW = np.isin(np.arange(256), [*f"{BLANKS}\n".encode()])  # by the first byte of a line
CHUNK = 1 << 22  # bytes


def table(where: str, text: str | bytes) -> Table:
    """Split the text of a CSV with a header. Delimiters are tab, semicolon or comma; decimal marks point or comma.

    where: name of the file in messages; text: or its UTF-8 bytes. Raises InputError if the text is empty or its header
    is too long.
    """
    content = text.encode() if isinstance(text, str) else text
    begin, end = _first_line(where, content)
    if end - begin > MAXIMUM_LINE and (length := len(content[begin:end].decode())) > MAXIMUM_LINE:
        raise InputError(where, "line 1", f"{length} characters", "a header")
    head = content[begin:end].decode()
    delimiter = next((d for d in DELIMITERS if d in head), ",")
    header = tuple(name.strip() for name in split(head, delimiter))
    newlines, maybe_blank = _scan(content, end)
    rows: Sequence[str] = Lines(content, end + 1, newlines - content.endswith(b"\n"))
    first = content.count(b"\n", 0, begin) + 2
    numbers: Sequence[int] = range(first, first + len(rows))
    if maybe_blank and BLANK_ROW.search(content):
        kept = [(number, line) for number, line in zip(numbers, rows, strict=True) if line.strip(BLANKS)]
        numbers, rows = [number for number, _ in kept], [line for _, line in kept]
    if delimiter != "," and any("," in line for line in (rows.head(10) if isinstance(rows, Lines) else rows[:10])):
        with_points = Lines(content.replace(b",", b"."), end + 1, len(rows))
        rows = with_points if isinstance(rows, Lines) else [line.replace(",", ".") for line in rows]
    return Table(header, TextRows(where, rows, numbers, delimiter))


def _first_line(where: str, content: bytes) -> tuple[int, int]:
    """Begin and end of the first line that is not blank [bytes]; raises InputError without one."""
    begin = 0
    while begin < len(content):
        end = content.find(b"\n", begin)
        end = len(content) if end < 0 else end
        if content[begin:end].decode().strip():
            return begin, end
        begin = end + 1
    raise InputError(where, "", "an empty file", "a header and rows")


def _scan(content: bytes, begin: int) -> tuple[int, bool]:
    """Number of newlines from byte ``begin`` on, and False if it is certain that no line after one of them is blank.

    Ten times as fast as to search for a blank line.
    """
    newlines, blank = 0, False
    for first in range(begin, len(content), CHUNK):
        text = np.frombuffer(content, np.uint8, min(CHUNK + 1, len(content) - first), first)
        after = np.flatnonzero(text[:CHUNK] == ord("\n")) + 1
        newlines += len(after)
        blank = blank or bool(BEGINS_BLANK_ROW[text[after[after < len(text)]]].any())
    return newlines, blank
