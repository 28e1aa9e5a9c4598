"""CSV files of line segments, ``x1,y1,x2,y2``, as exported from CAD drawings."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from pdr_graph.errors import InputError, count
from pdr_graph.floor.formats.drafting import LARGEST_COORDINATE, MOST_SEGMENTS, UNCLEAR, drawing_of_lines, holds
from pdr_graph.floor.formats.drawing import Drawing
from pdr_graph.floor.plan_limits import check_file_size
from pdr_graph.types import Array

SEGMENT_COLUMNS = ("x1", "y1", "x2", "y2")
LAYER = "layer"


def recognizes(path: Path, head: bytes) -> bool:
    """True for a table whose header names the ends of segments, or whose first row is four numbers."""
    line = head.removeprefix(b"\xef\xbb\xbf").split(b"\n", 1)[0].decode("utf-8", "replace")
    cells = [cell.strip().casefold() for cell in line.replace(";", ",").replace("\t", ",").split(",")]
    return set(SEGMENT_COLUMNS) <= set(cells) or (len(cells) == 4 and all(_is_number(cell) for cell in cells))


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def read(path: Path, scale: float | None) -> Drawing:
    """Read segments in the drawing's own axes. scale: metres per unit, which the format does not state."""
    segments, layers = _rows(path)
    notes = [f"{count(len(segments), 'segment')} of lines without thickness"]
    return drawing_of_lines(path, segments, layers, scale, None, notes)


def _rows(path: Path) -> tuple[Array, list[str]]:
    """The segments ``(n, 2, 2)`` [unit], and what the layer of each holds."""
    check_file_size(path, 50_000_000)  # largest file [bytes]
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(path, "", f"no text ({error.reason})", "a CSV of segments") from None
    first = text.split("\n", 1)[0]
    rows = csv.reader(text.splitlines(), delimiter=next((d for d in ";\t" if d in first), ","))
    header = [cell.strip().casefold() for cell in next(rows, [])]
    named = set(SEGMENT_COLUMNS) <= set(header)
    columns = [header.index(name) if named else n for n, name in enumerate(SEGMENT_COLUMNS)]
    layer = header.index(LAYER) if named and LAYER in header else None
    segments, layers = [] if named else [[float(cell) for cell in header]], [] if named else [UNCLEAR]
    for number, row in enumerate(rows, 2):
        if not any(cell.strip() for cell in row):
            continue
        if len(segments) >= MOST_SEGMENTS:
            raise InputError(path, f"line {number}", f"more than {MOST_SEGMENTS} segments", "the lines of one floor")
        segments.append(_segment(path, number, row, columns))
        layers.append(holds(row[layer]) if layer is not None and layer < len(row) else UNCLEAR)
    ends = np.array(segments, dtype=float).reshape(-1, 2, 2)
    if not (np.abs(ends) < LARGEST_COORDINATE).all():
        raise InputError(
            path, "", "coordinates that are no numbers or too large", f"numbers below {LARGEST_COORDINATE:g}"
        )
    return ends, layers


def _segment(path: Path, number: int, row: list[str], columns: list[int]) -> list[float]:
    """The ends of the segment in a row. Raises InputError unless they are finite numbers."""
    try:
        ends = [float(row[column]) for column in columns]
    except (ValueError, IndexError):
        raise InputError(path, f"line {number}", ",".join(row)[:60], "four numbers, x1,y1,x2,y2") from None
    if not np.isfinite(ends).all():
        raise InputError(path, f"line {number}", ",".join(row)[:60], "finite numbers")
    return ends
