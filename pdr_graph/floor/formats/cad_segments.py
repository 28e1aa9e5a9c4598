"""CSV files of line segments, ``x1,y1,x2,y2``, as exported from CAD drawings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from pdr_graph.errors import InputError, count
from pdr_graph.floor.formats.drawing import Drawing, check_file_size
from pdr_graph.floor.formats.line_drawing import LARGEST_COORDINATE, MOST_SEGMENTS, UNCLEAR, drawing_of_lines, holds
from pdr_graph.io import delimited
from pdr_graph.io.source import Source
from pdr_graph.io.validation import float_of

SEGMENT_COLUMNS = ("x1", "y1", "x2", "y2")
LAYER = "layer"


def recognizes(path: Path, head: bytes) -> bool:
    """True for a table whose header names the ends of segments, or whose first row is four numbers."""
    line = head.removeprefix(b"\xef\xbb\xbf").split(b"\n", 1)[0].decode("utf-8", "replace")
    cells = [cell.strip().casefold() for cell in line.replace(";", ",").replace("\t", ",").split(",")]
    return set(SEGMENT_COLUMNS) <= set(cells) or (len(cells) == 4 and all(_is_number(cell) for cell in cells))


def _is_number(text: str) -> bool:
    return not np.isnan(float_of(text))


def read(path: Path, scale: float | None) -> Drawing:
    """Read segments in the drawing's own axes. scale: metres per unit, which the format does not state."""
    check_file_size(path, 50_000_000)  # [bytes]
    source = Source(path, "floor plan")
    table = delimited.table(str(path), source.utf8(path.name))
    header, rows = [name.casefold() for name in table.header], table.rows
    named = set(SEGMENT_COLUMNS) <= set(header)
    if not named:  # the first row is a segment
        rows = replace(rows, content=source.utf8(path.name), first=1)
    if len(rows) > MOST_SEGMENTS:
        raise InputError(path, "", f"more than {MOST_SEGMENTS} segments", "the lines of one floor")
    ends = rows.floats([header.index(name) if named else n for n, name in enumerate(SEGMENT_COLUMNS)], False)
    for row in np.flatnonzero(~np.isfinite(ends).all(axis=1))[:1]:
        raise InputError(path, f"line {rows.numbers[row]}", rows.lines[row][:60], "finite numbers")
    if not (np.abs(ends) < LARGEST_COORDINATE).all():
        raise InputError(path, "", "coordinates that are too large", f"numbers below {LARGEST_COORDINATE:g}")
    layers = [holds(name) for name in rows.words(header.index(LAYER))] if named and LAYER in header else []
    notes = [f"{count(len(ends), 'segment')} of lines without thickness"]
    return drawing_of_lines(path, ends.reshape(-1, 2, 2), layers or [UNCLEAR] * len(ends), scale, None, notes)
