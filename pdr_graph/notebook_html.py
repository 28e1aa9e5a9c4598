"""Data types as notebooks show them: a small table of the columns, and a picture of paths, plans and sensors.

The picture is SVG, made of at most `MOST_POINTS` points a line in a few milliseconds, without matplotlib. All text is
escaped.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from html import escape
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from pdr_graph.errors import one_line

Array = NDArray[np.float64]
MOST_POINTS, MOST_AREAS = 1000, 2000  # of a line; of a plan
WIDTH, LINE_HEIGHT = 360, 40  # [px] of a picture, at most its height too; height of the line of a sensor
AT_LEFT = 'style="text-align:left"'
GREY, BLUE, RED, BLACK = "#8a8a8a", "#1f5fbf", "#d1602b", "#111111"  # as in figures
LINE_STYLE = 'fill="none" stroke-width="1.5" vector-effect="non-scaling-stroke"'


def html_of(record: Any) -> str:
    """A data type as HTML: its `repr`, its picture if it has one, a row for each field that is not empty."""
    names = [field.name for field in fields(record) if field.repr] if is_dataclass(record) else []
    cells = [
        f"<tr><th {AT_LEFT}>{escape(name)}</th><td {AT_LEFT}>{_cell(value)}</td></tr>"
        for name in names
        if (value := getattr(record, name)) is not None
        and not (isinstance(value, tuple | Mapping | str) and not len(value))
    ]
    table = f"<table>{''.join(cells)}</table>"
    return f"<div><b>{escape(one_line(repr(record)))}</b><br>{_picture(record)}{table}</div>"


def _picture(record: Any) -> str:
    """The picture of a data type by its name, "" for one without: data types are not imported here."""
    kind = type(record).__name__
    if kind == "Trajectory":
        return _map([(record.position, BLUE)])
    if kind == "Fixes":
        return _map([], record.position)
    if kind == "Estimate":
        fixes = np.array([(fix.x, fix.y) for fix in record.fixes]).reshape(-1, 2)
        return _map([(record.dead_reckoning.position, GREY), (record.trajectory.position, BLUE)], fixes)
    if kind == "FloorPlan":
        return _map([(line, BLACK) for area in record.areas[:MOST_AREAS] for line in _lines(area.shape)])
    return _sensors(record) if kind == "Recording" else ""


def _cell(value: Any) -> str:
    """A field in words, escaped: shape, first and last value of an array; how many things of each kind others have."""
    if isinstance(value, np.ndarray):
        ends = [np.array2string(row, precision=3, threshold=8) for row in (*value[:1], *value[1:][-1:])]
        text = f"{value.shape} {' … '.join(ends)}" if value.ndim else str(value)
    elif isinstance(value, Mapping):
        text = ", ".join(f"{name}: {len(one)}" if isinstance(one, tuple) else str(name) for name, one in value.items())
    elif isinstance(value, tuple) and len(value) > 3:
        text = f"{value[0]} … {value[-1]}, {len(value)} in all"
    elif isinstance(value, tuple):
        text = "; ".join(map(str, value))
    elif isinstance(value, float):
        text = f"{value:.10g}"
    else:
        text = repr(value)
    text = " ".join(text.split())
    return escape(text if len(text) <= 120 else f"{text[:120]} …")


def _sensors(recording: Any) -> str:
    """A line for each sensor: the magnitude of its samples over time."""
    rows = []
    for n, (name, signal) in enumerate(recording.signals.items()):
        strength = np.sqrt(np.sum(np.square(signal.values), axis=1))
        points = _thinned(np.column_stack([signal.time, strength]))
        if len(points) > 1:
            size = np.maximum(np.ptp(points, axis=0), 1e-9)
            scaled = (points - points.min(axis=0)) / size * [WIDTH, 4 - LINE_HEIGHT] + [0, (n + 1) * LINE_HEIGHT - 2]
            rows.append(_polyline(scaled, BLUE))
        rows.append(f'<text x="2" y="{n * LINE_HEIGHT + 10}" font-size="10">{escape(name)}</text>')
    return _svg(rows, LINE_HEIGHT * len(recording.signals)) if rows else ""


def _map(lines: Sequence[tuple[Array, str]], points: Array = np.empty((0, 2))) -> str:
    """Lines ``(n, 2)`` [m] with their colours and points ``(n, 2)`` [m] on a map with a scale bar; "" without any."""
    shown = [_thinned(line) for line, _ in lines]
    marks = _thinned(points)
    everything = np.concatenate([*shown, marks, np.empty((0, 2))])
    if not len(everything):
        return ""
    low, size = everything.min(axis=0), np.maximum(np.ptp(everything, axis=0), 1.0)
    scale = float(min((WIDTH - 20) / size[0], (WIDTH - 40) / size[1]))  # [px/m]
    height = size[1] * scale + 40

    def place(line: Array) -> Array:
        return (line - low) * [scale, -scale] + [10, height - 30]

    drawn = [_polyline(place(line), colour) for line, (_, colour) in zip(shown, lines, strict=True)]
    drawn += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="{RED}"/>' for x, y in place(marks).tolist()]
    bar = 10 ** np.floor(np.log10(0.6 * WIDTH / scale))  # [m]
    end = 10 + bar * scale
    drawn.append(f'<path d="M10 {height - 8:.1f}H{end:.1f}" stroke="{BLACK}" {LINE_STYLE}/>')
    drawn.append(f'<text x="{end + 5:.1f}" y="{height - 5:.1f}" font-size="11">{bar:g} m</text>')
    return _svg(drawn, height)


def _lines(shape: shapely.Geometry) -> Iterator[Array]:
    """The outlines of a polygon, and lines, each ``(n, 2)`` [m]; none for points."""
    for part in shapely.get_parts(shape):
        if shapely.get_dimensions(part) == 2:
            yield from (shapely.get_coordinates(ring) for ring in shapely.get_rings(part))
        elif shapely.get_dimensions(part) == 1:
            yield shapely.get_coordinates(part)


def _thinned(line: Array) -> Array:
    """The finite rows of ``(n, 2)``, at most `MOST_POINTS`, with both ends."""
    line = np.asarray(line, dtype=float).reshape(-1, 2)
    line = line[np.isfinite(line).all(axis=1)]
    if len(line) <= MOST_POINTS:
        return line
    return line[np.linspace(0, len(line) - 1, MOST_POINTS).round().astype(int)]


def _polyline(line: Array, colour: str) -> str:
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in line.tolist())
    return f'<polyline points="{path}" stroke="{colour}" {LINE_STYLE}/>'


def _svg(content: Sequence[str], height: float) -> str:
    size = f'width="{WIDTH}" height="{height:.0f}" viewBox="0 0 {WIDTH} {height:.0f}"'
    style = 'style="background:white;font-family:sans-serif"'
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size} {style}>{"".join(content)}</svg>'
