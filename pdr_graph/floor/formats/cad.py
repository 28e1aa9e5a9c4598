"""CAD drawings: DXF, and CSV of line segments ``x1,y1,x2,y2`` as exported from others.

Of a DXF drawing the lines, polylines, arcs, circles and blocks of the model space are read, by layer.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from pdr_graph.errors import InputError, count
from pdr_graph.floor.formats.drawing import Drawing, check_file_size, required_library
from pdr_graph.floor.formats.line_drawing import (
    IGNORED,
    LARGEST_COORDINATE,
    MOST_SEGMENTS,
    UNCLEAR,
    UNITS,
    drawing_of_lines,
    holds,
)
from pdr_graph.io import delimited
from pdr_graph.io.source import Source
from pdr_graph.types import Array

CURVES = ("LINE", "LWPOLYLINE", "POLYLINE", "ARC", "CIRCLE", "ELLIPSE", "SPLINE")
MOST_BLOCKS = 100_000  # insertions of blocks, those inside blocks among them
INSERT_UNITS = {  # $INSUNITS: metres per unit
    **{1: UNITS["inches"], 2: UNITS["feet"], 4: UNITS["millimetres"], 5: UNITS["centimetres"], 6: UNITS["metres"]},
    **{10: 0.9144, 14: 0.1, 21: 1200 / 3937},
}


def read_dxf(path: Path, scale: float | None) -> Drawing:
    """Read the model space of a DXF drawing in its own axes.

    scale: metres per unit; None: that of ``$INSUNITS``. Raises InputError if neither is known, or for a damaged file.
    """
    document = _document(path)
    hidden = {layer.dxf.name for layer in document.layers if layer.is_off() or layer.is_frozen()}
    notes, reading = list[str](), _Reading(path, hidden)
    for entity in document.modelspace():
        reading.add(entity, UNCLEAR, 0)
    segments = np.concatenate(reading.segments) if reading.segments else np.empty((0, 2, 2))
    if not (np.abs(segments) < LARGEST_COORDINATE).all():
        raise InputError(path, "", "coordinates that are no numbers or too large", f"below {LARGEST_COORDINATE:g}")
    stated = INSERT_UNITS.get(document.header.get("$INSUNITS", 0))
    if scale is not None and stated is not None and abs(scale / stated - 1) > 0.001:
        notes.append(f"--scale {scale:g} is used, not $INSUNITS, by which a unit is {stated:g} m")
    notes.append(f"{count(len(segments), 'segment')} of lines and curves")
    if reading.skipped:
        notes.append(f"left out: {', '.join(f'{number} {kind}' for kind, number in reading.skipped.most_common(6))}")
    return drawing_of_lines(path, segments, reading.layers, scale, stated, notes)


def _document(path: Path) -> Any:
    """The document in a DXF file. Raises InputError for a damaged one, or without ezdxf."""
    with required_library(path, "a DXF drawing", "ezdxf"):
        from ezdxf import recover
        from ezdxf.lldxf.const import DXFError
    check_file_size(path, 100_000_000)
    try:
        return recover.readfile(path)[0]
    except (DXFError, OSError, ValueError, TypeError, AttributeError, LookupError, RecursionError) as error:
        raise InputError(path, "", f"a damaged DXF drawing ({str(error)[:80]})", "a whole one") from None


DEGENERATE = (TypeError, ValueError, AttributeError, ZeroDivisionError, LookupError)  # of ezdxf, for damaged entities


@dataclass
class _Reading:
    """Segments collected from entities. hidden: names of layers that are left out."""

    path: Path
    hidden: set[str]
    segments: list[Array] = field(default_factory=list)
    layers: list[str] = field(default_factory=list)
    skipped: Counter[str] = field(default_factory=Counter)
    blocks: int = 0

    def add(self, entity: Any, inherited: str, depth: int) -> None:
        """Add an entity's segments, or count it as skipped. inherited: what the block that it is in holds."""
        kind, layer = entity.dxftype(), str(entity.dxf.get("layer", "0"))
        on = holds(layer)
        on = inherited if on == UNCLEAR else on
        if layer in self.hidden or entity.dxf.get("invisible", 0):
            self.skipped["hidden entities"] += 1
        elif kind == "INSERT":
            for part in self._parts(entity, depth):
                self.add(part, on if on != UNCLEAR else holds(str(entity.dxf.get("name", ""))), depth + 1)
        elif kind not in CURVES or (on == IGNORED and kind != "LINE"):
            self.skipped[kind] += 1
        else:
            points = _points(entity, kind)
            if len(points) < 2:
                self.skipped[kind] += 1
                return
            self.segments.append(np.stack([points[:-1], points[1:]], axis=1))
            self.layers += [on] * (len(points) - 1)
            if len(self.layers) > MOST_SEGMENTS:
                raise InputError(self.path, "", f"more than {MOST_SEGMENTS} segments", "the drawing of one floor")

    def _parts(self, insert: Any, depth: int) -> Iterator[Any]:
        """The entities of an inserted block, in the coordinates of the drawing."""
        copies = max(1, int(insert.mcount))
        self.blocks += copies
        if self.blocks > MOST_BLOCKS or depth > 16:  # deepest block: blocks in blocks
            raise InputError(self.path, "", "too many blocks in blocks", f"at most {MOST_BLOCKS} insertions")
        for single in insert.multi_insert() if copies > 1 else (insert,):
            try:
                yield from single.virtual_entities()
            except DEGENERATE:
                self.skipped["blocks that cannot be placed"] += 1


def _points(entity: Any, kind: str) -> Array:
    """The corners ``(n, 2)`` [unit] of an entity; curves as chords. Empty if it has none."""
    from ezdxf.path import make_path

    try:
        if kind == "LINE":
            return np.array([(p.x, p.y) for p in (entity.dxf.start, entity.dxf.end)], dtype=float)
        path = make_path(entity)
        corners = np.array([(p.x, p.y) for p in path.control_vertices()], dtype=float).reshape(-1, 2)
        largest = np.abs(corners).max(initial=0.0)
        if not path.has_curves or not largest < LARGEST_COORDINATE:  # `flattening` would not end with no numbers
            return corners
        size = np.hypot(*(corners - corners[0]).T).max()
        # 24 chords a circle, enough to recognise the swing of a door; chords as near to their curve as coordinates are
        # rounded would be halved without end
        sagitta = max(size * (1 - np.cos(np.pi / 24)) / 2, 1e-6, 1e-12 * largest)
        return np.array([(p.x, p.y) for p in path.flattening(sagitta)], dtype=float).reshape(-1, 2)
    except DEGENERATE:
        return np.empty((0, 2))


SEGMENT_COLUMNS = ("x1", "y1", "x2", "y2")
LAYER = "layer"


def read_segments(path: Path, scale: float | None) -> Drawing:
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
