"""Rows of many days on their way to one file per day: in memory up to a limit, then on disk, parted by days.

The midnight of a position is that of the sun, by its longitude: days part at night wherever the person is, and the day
of a position depends on nothing else. Receptions, whose place is unknown, have UTC days.
"""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from types import TracebackType

import numpy as np

from pdr_graph.io.past_day import E7, Rows
from pdr_graph.lifelog import cache
from pdr_graph.types import Index

DAY_MS = 86_400_000
SUN_MS = DAY_MS / 360 / E7  # [ms] per 1e-7 degree of longitude
MOST_ROWS = 1_000_000  # in memory: 21 MB, and as much again while they are sorted


def day_of(rows: Rows) -> Index:
    """The day ``(n,)`` of each row, counted from 1970-01-01."""
    names = rows.dtype.names or ()
    sun = np.rint(rows["lon"] * SUN_MS).astype(np.int64) if "lon" in names else 0
    return (rows["time"] + sun) // DAY_MS


class DaySpill:
    """Collects rows of one type, which have a ``time`` [ms]; a context manager, whose files are then removed."""

    def __init__(self, folder: Path, kind: np.dtype[np.void]):
        """folder: for the temporary files, of their owner alone."""
        cache.make_folder(folder)
        self._folder = Path(tempfile.mkdtemp(cache.PARTIAL, dir=folder))
        self._kind, self._waiting, self._size = kind, list[Rows](), 0

    def add(self, rows: Rows) -> None:
        """Add rows, in any order."""
        if len(rows):
            self._waiting.append(rows)
            self._size += len(rows)
        if self._size > MOST_ROWS:
            self._write()

    def days(self) -> list[int]:
        """The days that have rows, counted from 1970-01-01."""
        self._write()
        return sorted(int(file.name) for file in self._folder.iterdir())

    def rows(self, day: int) -> Rows:
        """The rows of a day, in the order in which they were added."""
        file = self._folder / str(day)
        return np.fromfile(file, self._kind) if file.exists() else np.empty(0, self._kind)

    def _write(self) -> None:
        """Append the rows in memory to the files of their days."""
        if not self._waiting:
            return
        rows = np.concatenate(self._waiting)
        self._waiting, self._size = [], 0
        day = day_of(rows)
        if (np.diff(day) < 0).any():
            order = np.argsort(day, kind="stable")
            rows, day = rows[order], day[order]
        numbers, first = np.unique(day, return_index=True)
        for number, part in zip(numbers.tolist(), np.split(rows, first[1:]), strict=True):
            with (self._folder / str(number)).open("ab") as file:
                part.tofile(file)

    def __enter__(self) -> DaySpill:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        shutil.rmtree(self._folder, ignore_errors=True)
