"""What in a floor plan would mislead a walk."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import shapely
from numpy.typing import NDArray

from pdr_graph.floor.areas import BEACON, CLOSED, DOOR, LINK, OPEN, OUTLINE, Area
from pdr_graph.floor.plan import FloorPlan

SMALL = 0.5  # [m²] overlaps and overhangs below are drawing inaccuracy
SAID = 3  # places named of each kind of problem


def problems(floor: FloorPlan) -> tuple[str, ...]:
    """What is wrong with one floor, a line each; empty if nothing was found."""
    found = [*_doors(floor), *_sealed(floor), *_overlaps(floor), *_overhang(floor), *_links(floor), *_beacons(floor)]
    return tuple(found)


def _doors(floor: FloorPlan) -> Iterator[str]:
    cells = floor.cells.cells
    rooms = [c for c in cells if c.kind in CLOSED]
    doors = [n for n, c in enumerate(cells) if c.kind == DOOR]
    if rooms and not doors:
        yield f"{len(rooms)} rooms and no door: the rooms are open to all that they touch"
    ways = np.bincount(floor.cells.passages.ravel(), minlength=len(cells))
    yield from _line(
        "doors that join fewer than two cells", [_place(cells[n].polygon, cells[n].name) for n in doors if ways[n] < 2]
    )


def _sealed(floor: FloorPlan) -> Iterator[str]:
    """Cells that nobody can get to from the largest part of the floor."""
    cells, parts = floor.cells.cells, floor.cells.parts
    if not len(cells):
        return
    area = np.bincount(parts, [shapely.area(c.polygon) for c in cells])
    cut_off = np.flatnonzero(parts != np.argmax(area))
    named = [f"{cells[n].kind} {_place(cells[n].polygon, cells[n].name)}" for n in cut_off]
    yield from _line("cells that cannot be reached from the rest", named)


def _overlaps(floor: FloorPlan) -> Iterator[str]:
    """Rooms that lie over each other: a position in both belongs to neither."""
    rooms = [c for c in floor.cells.cells if c.kind in CLOSED]
    if not rooms:
        return
    polygons: NDArray[np.object_] = np.array([c.polygon for c in rooms], dtype=object)
    one, other = shapely.STRtree(polygons).query(polygons, predicate="intersects")
    both = shapely.area(shapely.intersection(polygons[one], polygons[other]))
    pairs = [(i, j) for i, j, shared in zip(one, other, both, strict=True) if i < j and shared > SMALL]
    named = [f"{rooms[i].name or 'room'} and {_place(rooms[j].polygon, rooms[j].name)}" for i, j in pairs]
    yield from _line("rooms that overlap", named)


def _overhang(floor: FloorPlan) -> Iterator[str]:
    outline = [a.shape for a in floor.of_kind(OUTLINE) if a.is_polygon]
    if outline:
        outside = float(shapely.area(shapely.difference(floor.walkable, shapely.union_all(outline))))
        if outside > SMALL:
            yield f"{outside:.1f} m² of walkable area lie outside the outline"
    elif not floor.of_kind(*OPEN, *CLOSED):
        yield "neither an outline nor cells"


def _links(floor: FloorPlan) -> Iterator[str]:
    crossing = []
    for link in floor.of_kind(LINK):
        corners = shapely.get_coordinates(link.shape)
        if len(corners) < 2 or floor.crosses_wall(corners[:-1], corners[1:]).any():
            crossing.append(_place(link.shape, link.name))
    yield from _line("links that go through a wall", crossing)


def _beacons(floor: FloorPlan) -> Iterator[str]:
    def nameless(beacon: Area) -> bool:
        return not any(beacon.properties.get(key) for key in ("id", "mac", "uuid", "name"))

    beacons = floor.of_kind(BEACON)
    yield from _line("beacons without an id", [_place(b.shape, "") for b in beacons if nameless(b)])


def _line(what: str, places: list[str]) -> Iterator[str]:
    if places:
        more = f" and {len(places) - SAID} more" if len(places) > SAID else ""
        yield f"{len(places)} {what}: {'; '.join(places[:SAID])}{more}"


def _place(shape: shapely.Geometry, name: str) -> str:
    x0, y0, x1, y1 = shapely.bounds(shape)
    return f"{name} at ({(x0 + x1) / 2:.1f}, {(y0 + y1) / 2:.1f})".strip()
