"""A self-contained HTML page: template, style, scripts and content in one file; floor plans and tracks for it.

Names in recordings and plans are untrusted text. They are part of the content only, as ASCII JSON without a "<", which
the script shows as text. The content security policy allows these two scripts alone, by their hashes, and no request.
The library that draws lies in the page compressed, since it is ten times as large as the rest of a short walk.

Numbers are quantised to a unit and delta encoded: a row of a track takes about 20 bytes instead of 80, so that the
walks of a day are no larger than the script that draws them.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from itertools import groupby
from typing import Any

import numpy as np
import shapely

from pdr_graph.floor.cells import BEACON, CLOSED, DOOR, LINK, OPEN, SOLID
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.geometry import confidence_band
from pdr_graph.types import Array, Index, Mask, Trajectory

# Colours and margin of all pictures and reports
SOLID_FILL, BORDER, EDGES, OUTDOORS, WALKABLE_COLOUR = "#c9c4bb", "#a8a196", "#8d877c", "#efece6", "#ffffff"
ROOM, OPENING, STAIRS_COLOUR = "#f4f6f0", "#e8c9a8", "#ebe3c8"
CELLS = (("room", CLOSED, ROOM), ("door", (DOOR,), OPENING), ("stairs", ("stairs",), STAIRS_COLOUR))  # layers of cells
BAND, TRUTH, RADIO = "#7fb0f0", "#111111", "#7b4fa6"  # and those of `notebook_html`: BLUE track, GREY, RED fixes
OTHER = "#b0458a"  # other routes
SURROUNDINGS = 0.12  # share of the walk's size shown around it
SCRIPTS = ("content", "walker", "map", "charts", "player", "words", "start")  # in this order
PLACEHOLDER = re.compile(rb"\{\{(\w+)\}\}")  # placeholder of a part in the template


def page(content: dict[str, Any]) -> bytes:
    """The HTML file; content: in the form documented in ``web/content.js``."""
    web = files("pdr_graph.apps.report").joinpath("web")
    template, style = web.joinpath("page.html").read_bytes(), web.joinpath("page.css").read_bytes()
    script = b'"use strict";\n' + b"".join(web.joinpath(f"{name}.js").read_bytes() for name in SCRIPTS)
    library, library_hash = packed_library()
    policy = f"default-src 'none'; script-src {library_hash} {policy_hash(script)}; style-src 'unsafe-inline'; "
    text = json.dumps(content, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    parts = {
        b"policy": (policy + "img-src data: blob:").encode(),
        b"style": style,
        b"content": text.encode("ascii"),
        b"library": library,
        b"script": script,
    }
    pieces = PLACEHOLDER.split(template)  # every second piece is the name of a part
    pieces[1::2] = [parts[name] for name in pieces[1::2]]
    return b"".join(pieces)


CENTIMETRE, CENTISECOND, CENTIRADIAN, PERCENT = 0.01, 0.01, 0.01, 0.01  # resolution of numbers on the page
MAXIMUM_ROWS = 20_000  # of one track or line: 20 per pixel of a wide screen
MAXIMUM_MARKS = 4_000  # fixes on a map: each is an SVG element


def column(values: Array, unit: float) -> dict[str, Any]:
    """Values ``(n,)`` in multiples of ``unit``, delta encoded; None for NaN."""
    whole = np.round(np.asarray(values, dtype=float) / unit)
    known = np.isfinite(whole)
    steps = np.full(len(whole), None, dtype=object)
    steps[known] = np.diff(whole[known].astype(np.int64), prepend=0).tolist()
    return {"unit": unit, "steps": steps.tolist()}


def runs(values: Sequence[int]) -> list[list[int]]:
    """Run-length encoding: [value, count] of each run."""
    return [[value, len(list(same))] for value, same in groupby(values)]


def thinned(rows: int, most: int = MAXIMUM_ROWS) -> Index:
    """Indices of at most ``most`` of ``rows`` rows, evenly spaced, with the first and the last."""
    return np.unique(np.linspace(0, rows - 1, min(rows, most)).round().astype(np.intp))


@dataclass(frozen=True)
class PlanLayer:
    """A layer of a drawn plan. shape: polygons or lines [m]; width: of the stroke [m]."""

    name: str
    shape: shapely.Geometry
    fill: str = "none"
    stroke: str = "none"
    width: float = 0.0


def plan_layers(floor: FloorPlan) -> list[PlanLayer]:
    """The layers of a floor plan from below, as every picture and page draws them."""
    areas = [area for area in floor.areas if area.is_polygon and area.kind not in (LINK, BEACON)]
    together, thin = shapely.geometrycollections, 0.05  # [m]
    return [
        PlanLayer("ground", shapely.union_all([area.shape for area in areas]), SOLID_FILL),
        PlanLayer("border", together([area.shape for area in areas if area.kind in SOLID]), "none", BORDER, thin),
        PlanLayer("walkable", floor.walkable, WALKABLE_COLOUR, EDGES, thin),
        *(
            PlanLayer(name, together([c.polygon for c in floor.cells.cells if c.kind in kinds]), fill)
            for name, kinds, fill in CELLS
        ),
        PlanLayer("wall", floor.cells.barriers, "none", EDGES, 0.12),
        PlanLayer("link", together([area.shape for area in floor.of_kind(LINK)]), "none", BORDER, 0.02),
    ]


def plan_drawing(floor: FloorPlan) -> dict[str, Any]:
    """The floor plan as SVG, with its corners [m] and the names in it."""
    width, height = (floor.corners[1] - floor.corners[0]).tolist()
    head = f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.2f}" height="{height:.2f}" '
    head += f'viewBox="0 0 {width:.2f} {height:.2f}" preserveAspectRatio="none">'
    paths = (_path(floor, own.shape, own.fill, own.stroke, own.width) for own in plan_layers(floor))
    return {
        "svg": f'{head}<g fill-rule="evenodd">{"".join(paths)}</g></svg>',
        "corners": floor.corners.tolist(),
        "names": [_name(a.name, a.shape) for a in floor.of_kind(*SOLID, *CLOSED, *OPEN) if a.name and a.is_polygon],
    }


def _name(name: str, polygon: shapely.Geometry) -> dict[str, Any]:
    """A name with a point in its polygon and the width of the polygon [m]."""
    x, y = shapely.get_coordinates(shapely.point_on_surface(polygon))[0].tolist()
    west, _, east, _ = shapely.bounds(polygon).tolist()
    return {"text": name, "x": round(x, 2), "y": round(y, 2), "width": round(east - west, 2)}


def _path(
    floor: FloorPlan, shapes: shapely.Geometry, fill: str = "none", stroke: str = "none", width: float = 0.0
) -> str:
    """Polygons or lines as one SVG path, from the plan's north-west corner: browsers have single precision."""
    corner = np.array([floor.corners[0, 0], floor.corners[1, 1]])
    closed = shapely.get_dimensions(shapes) == 2
    parts = shapely.get_parts(shapely.get_parts(shapes))
    lines = shapely.get_rings(parts[shapely.get_dimensions(parts) == 2]) if closed else parts
    commands = "".join(f"M{_points(shapely.get_coordinates(line) - corner)}{'Z' if closed else ''}" for line in lines)
    return f'<path d="{commands}" fill="{fill}" stroke="{stroke}" stroke-width="{width}"/>' if commands else ""


def _points(line: Array) -> str:
    """The points ``(n, 2)`` [m] of a line in SVG syntax, where y points down: the first, then the moves, to 1 cm."""
    at = np.rint(100 * line * (1, -1)).astype(int)
    moves = np.diff(at, axis=0)
    moves = moves[moves.any(axis=1)]
    first, *others = (f"{x / 100:.10g},{y / 100:.10g}" for x, y in (*at[:1].tolist(), *moves.tolist()))
    return f"{first}l{' '.join(others)}" if others else first


OFF_PLAN = 1.0  # [m] from the walkable area at which a walk has left the plan
ON_EVERY_MAP, ON_NO_MAP = -1, -2  # instead of a map number: on every map, on none


def maps_of(floors: Sequence[str], labels: Sequence[str]) -> list[int]:
    """The map number of each row: of its floor, ON_EVERY_MAP if the floor is unknown, ON_NO_MAP if it has no map."""
    if len(labels) == 1:
        return [0] * len(floors)
    number = {label: n for n, label in enumerate(labels)} | {"": ON_EVERY_MAP}
    return [number.get(floor, ON_NO_MAP) for floor in floors]


def track(name: str, colour: str, path: Trajectory, on: Sequence[int], **style: Any) -> dict[str, Any]:
    """A track; on: map number of each row; style: any other key that ``web/content.js`` lists for a track."""
    rows = thinned(len(path))
    drawn = {
        "name": name,
        "colour": colour,
        "on": runs([on[row] for row in rows.tolist()]),
        "time": column(path.time[rows], CENTISECOND),
        "x": column(path.position[rows, 0], CENTIMETRE),
        "y": column(path.position[rows, 1], CENTIMETRE),
        "heading": column(path.heading[rows], CENTIRADIAN),
    }
    if path.covariance is not None:
        covariance = path.covariance[rows]
        # square centimetre [m²]
        drawn["covariance"] = [column(covariance[:, i, j], 1e-4) for i, j in ((0, 0), (0, 1), (1, 1))]
    return drawn | style


def bands(path: Trajectory, on: Sequence[int], floors: Sequence[FloorPlan | None]) -> list[dict[str, Any]]:
    """The 95 % region of a path on the map of each floor, None without a plan, as rings."""
    where = np.array(on)
    return [rings(region(path, (where == n) | (where == ON_EVERY_MAP), floor)) for n, floor in enumerate(floors)]


def region(path: Trajectory, here: Mask, floor: FloorPlan | None) -> np.ndarray:
    """Polygons ``(k,)`` that make the 95 % region of the rows ``here (n,)``; on a plan, its walkable part.

    Around rows that are more than OFF_PLAN from the walkable area, where the plan does not hold, the region is whole.
    """
    hulls = confidence_band(path, here)
    if floor is None or not len(hulls):
        return hulls
    shapely.prepare(floor.walkable)
    on_plan = shapely.dwithin(floor.walkable, shapely.centroid(hulls), OFF_PLAN)
    walkable = shapely.intersection(shapely.union_all(hulls[on_plan]), floor.walkable)
    whole = shapely.buffer(shapely.union_all([walkable, *hulls[~on_plan]]), 0.0)  # without lines where both touch
    return shapely.normalize(shapely.get_parts(whole))


def rings(polygons: Array) -> dict[str, Any]:
    """Corners of the rings of polygons ``(k,)``, rings separated by None; holes run the other way round."""
    parts = [np.append(shapely.get_coordinates(r), [[np.nan, np.nan]], axis=0) for r in shapely.get_rings(polygons)]
    x, y = np.concatenate([np.empty((0, 2)), *parts]).T
    return {"x": column(x, CENTIMETRE), "y": column(y, CENTIMETRE)}


@cache
def packed_library() -> tuple[bytes, str]:
    """The JavaScript library of charts as base64 of its zlib stream, and its hash for a content security policy."""
    library = files("plotly").joinpath("package_data", "plotly.min.js").read_bytes()
    try:  # where ISA-L is installed: an eighth of the time, a tenth longer
        from isal import isal_zlib

        packed = isal_zlib.compress(library, isal_zlib.ISAL_BEST_COMPRESSION)
    except ImportError:
        packed = zlib.compress(library)
    return base64.b64encode(packed), policy_hash(library)


def policy_hash(script: bytes) -> str:
    """The hash of a script as a content security policy states it."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(script).digest()).decode()}'"
