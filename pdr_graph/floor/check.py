"""Check a floor plan for errors that would mislead an estimate."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import shapely
from numpy.typing import NDArray

from pdr_graph.floor.building import Building
from pdr_graph.floor.cells import BEACON, CLOSED, CONNECTING, DOOR, ENTRANCE, LINK, OPEN, OUTLINE, Cell, overlap
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.types import Index

SMALL = 0.5  # [m²] smaller overlaps and overhangs are inaccurate drawing; chosen by hand
MOST_EXAMPLES = 3  # places named per kind of problem


def problems(building: Building) -> tuple[str, ...]:
    """Problems of a plan, one line each; empty if there are none."""
    found = list(building.floors[0].repairs)
    for n, floor in enumerate(building.floors):
        on = f"floor {floor.label}: " if len(building.floors) > 1 else ""
        found += [on + line for line in (*_passages(building, n), *_areas(floor), *_links_and_beacons(floor))]
    return tuple(found)


def _passages(building: Building, n: int) -> Iterator[str]:
    """Rooms without doors, doors, stairs and lifts that join nothing, and cells that cannot be reached."""
    floor, parts = building.floors[n], building.parts[n]
    cells = floor.cells.cells
    passages = np.bincount(floor.cells.passages.ravel(), minlength=len(cells))
    rooms = [k for k, c in enumerate(cells) if c.kind in CLOSED and passages[k]]
    doors = [k for k, c in enumerate(cells) if c.kind == DOOR]
    if rooms and not doors:
        yield f"{len(rooms)} rooms and no door: the rooms are open to all that they touch"
    entrances = shapely.union_all([a.shape for a in floor.of_kind(DOOR) if a.properties.get(ENTRANCE)])
    outside = [passages[k] == 1 and bool(shapely.intersects(entrances, cells[k].polygon)) for k in doors]
    alone = [cells[k] for k, leads in zip(doors, outside, strict=True) if passages[k] < 2 and not leads]
    yield from _line("doors that join fewer than two cells", [_place(c.polygon, c.name) for c in alone])

    if len(cells):  # the largest connected part of the building, or of the floor, if that is separate
        largest = _largest(np.concatenate(building.parts), [c for f in building.floors for c in f.cells.cells])
        if largest not in parts:
            largest = _largest(parts, cells)
            yield "no stairs or lift from the rest of the building"
        cut_off = [cells[k] for k in np.flatnonzero(parts != largest)]
        named = [f"{c.kind} {_place(c.polygon, c.name)}" for c in cut_off]
        yield from _line("cells that cannot be reached from the rest", named)

    if len(building.floors) > 1:
        joined = [c for c in building.connections if n in c.floors]
        areas = [
            area
            for area in floor.of_kind(*CONNECTING)
            if not any(c.kind == area.kind and overlap(c.polygon, area.shape) for c in joined)
        ]
        yield from _line("stairs or lifts that join no other floor", [_place(a.shape, a.name or a.kind) for a in areas])
        shut = [c for c, number in zip(cells, passages, strict=True) if c.kind in CONNECTING and not number]
        yield from _line("stairs or lifts without an entrance", [_place(c.polygon, c.name or c.kind) for c in shut])


def _largest(parts: Index, cells: Sequence[Cell]) -> int:
    """Number of the connected part with the largest area."""
    return int(np.argmax(np.bincount(parts, [shapely.area(c.polygon) for c in cells])))


def _areas(floor: FloorPlan) -> Iterator[str]:
    """Rooms that overlap, so that the room of a position is ambiguous; area outside the outline; cells without area."""
    rooms = [c for c in floor.cells.cells if c.kind in CLOSED]
    polygons: NDArray[np.object_] = np.array([c.polygon for c in rooms], dtype=object)
    first, second = shapely.STRtree(polygons).query(polygons, predicate="intersects") if rooms else ([], [])
    both = shapely.area(shapely.intersection(polygons[first], polygons[second])) if rooms else []
    pairs = [(i, j) for i, j, shared in zip(first, second, both, strict=True) if i < j and shared > SMALL]
    named = [f"{rooms[i].name or 'room'} and {_place(rooms[j].polygon, rooms[j].name)}" for i, j in pairs]
    yield from _line("rooms that overlap", named)

    outline = [a.shape for a in floor.of_kind(OUTLINE) if a.is_polygon]
    outside = float(shapely.area(shapely.difference(floor.walkable, shapely.union_all(outline))))
    if outline and outside > SMALL:
        yield f"{outside:.1f} m² of walkable area lie outside the outline"
    if not outline and not floor.of_kind(*OPEN, *CLOSED):
        yield "neither an outline nor cells"

    flat = [f"{a.kind} {_place(a.shape, a.name)}" for a in floor.of_kind(*OPEN, *CLOSED) if not a.is_polygon]
    yield from _line("cells that are not polygons", flat)


def _links_and_beacons(floor: FloorPlan) -> Iterator[str]:
    """Links that cross a wall or are not lines, and beacons that no reception can be matched with."""
    through, short = [], []
    for link in floor.of_kind(LINK):
        corners = shapely.get_coordinates(link.shape)
        if len(corners) < 2:
            short.append(_place(link.shape, link.name))
        elif (crossing := floor.crosses_wall(corners[:-1], corners[1:])).any():
            first = int(np.argmax(crossing))
            line = shapely.LineString(corners[first : first + 2])
            # where it leaves the walkable area, or meets a wall
            places = shapely.difference(line, floor.walkable), shapely.intersection(line, floor.cells.barriers), line
            place = shapely.get_parts(next(place for place in places if not shapely.is_empty(place)))[0]
            through.append(_place(place, link.name))
    yield from _line("links that go through a wall", through)
    yield from _line("links that are not lines", short)
    keys = ("id", "mac", "uuid", "name")
    nameless = [b for b in floor.of_kind(BEACON) if not any(b.properties.get(key) for key in keys)]
    yield from _line("beacons without an id", [_place(b.shape, "") for b in nameless])


def _line(what: str, places: list[str]) -> Iterator[str]:
    """One line with the number of problems of a kind and their first places; no line without places."""
    if places:
        more = f" and {len(places) - MOST_EXAMPLES} more" if len(places) > MOST_EXAMPLES else ""
        yield f"{len(places)} {what}: {'; '.join(places[:MOST_EXAMPLES])}{more}"


def _place(shape: shapely.Geometry, name: str) -> str:
    """Name and centre of the bounding box of a shape."""
    x0, y0, x1, y1 = shapely.bounds(shape)
    x, y = np.round([(x0 + x1) / 2, (y0 + y1) / 2], 1) + 0.0  # + 0.0: avoids -0.0
    return f"{name} at ({x:.1f}, {y:.1f})".strip()
