"""Check a floor plan for errors that would mislead an estimate."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import shapely
from numpy.typing import NDArray

from pdr_graph.floor.building import Building
from pdr_graph.floor.cells import BEACON, CLOSED, CONNECTING, DOOR, ENTRANCE, LINK, OPEN, OUTLINE, Area, Cell, overlap
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.types import Array, Index

SMALL = 0.5  # [m²] smaller overlaps and overhangs are inaccurate drawing; chosen by hand
MOST_EXAMPLES = 3  # places named per kind of problem


def problems(building: Building) -> tuple[str, ...]:
    """Problems of a plan, one line each; empty if there are none."""
    found = list(building.floors[0].repairs)
    for n, floor in enumerate(building.floors):
        reach = [*_doors(floor), *_sealed(building, n), *_stairs(building, n)]
        drawing = [*_overlaps(floor), *_overhang(floor), *_flat(floor), *_links(floor), *_beacons(floor)]
        on = f"floor {floor.label}: " if len(building.floors) > 1 else ""
        found += [on + line for line in (*reach, *drawing)]
    return tuple(found)


def _doors(floor: FloorPlan) -> Iterator[str]:
    """Rooms without doors, and doors that join nothing."""
    cells = floor.cells.cells
    ways = np.bincount(floor.cells.passages.ravel(), minlength=len(cells))
    rooms = [n for n, c in enumerate(cells) if c.kind in CLOSED and ways[n]]
    doors = [n for n, c in enumerate(cells) if c.kind == DOOR]
    if rooms and not doors:
        yield f"{len(rooms)} rooms and no door: the rooms are open to all that they touch"
    alone = [n for n in doors if not ways[n] or (ways[n] < 2 and not _leads_outside(floor, cells[n]))]
    yield from _line("doors that join fewer than two cells", [_place(cells[n].polygon, cells[n].name) for n in alone])


def _leads_outside(floor: FloorPlan, door: Cell) -> bool:
    """True for a door with the property ``entrance``."""
    entrances = [a.shape for a in floor.of_kind(DOOR) if a.properties.get(ENTRANCE)]
    return any(shapely.intersects(shape, door.polygon) for shape in entrances)


def _sealed(building: Building, floor: int) -> Iterator[str]:
    """Cells without a path from the largest connected part of the building (of the floor, if that is separate)."""
    cells, parts = building.floors[floor].cells.cells, building.parts[floor]
    if not len(cells):
        return
    largest = _largest(np.concatenate(building.parts), [c for f in building.floors for c in f.cells.cells])
    if largest not in parts:
        largest = _largest(parts, cells)
        yield "no stairs or lift from the rest of the building"
    named = [f"{cells[n].kind} {_place(cells[n].polygon, cells[n].name)}" for n in np.flatnonzero(parts != largest)]
    yield from _line("cells that cannot be reached from the rest", named)


def _largest(parts: Index, cells: Sequence[Cell]) -> int:
    """Number of the connected part with the largest area."""
    return int(np.argmax(np.bincount(parts, [shapely.area(c.polygon) for c in cells])))


def _stairs(building: Building, n: int) -> Iterator[str]:
    """Stairs and lifts of a building with several floors that do not join two of them."""
    if len(building.floors) == 1:
        return
    floor = building.floors[n]
    joined = [c for c in building.connections if n in c.floors]
    alone = [
        area
        for area in floor.of_kind(*CONNECTING)
        if not any(c.kind == area.kind and overlap(c.polygon, area.shape) for c in joined)
    ]
    yield from _line("stairs or lifts that join no other floor", [_place(a.shape, a.name or a.kind) for a in alone])
    ways = np.bincount(floor.cells.passages.ravel(), minlength=len(floor.cells))
    shut = [c for c, count in zip(floor.cells.cells, ways, strict=True) if c.kind in CONNECTING and not count]
    named = [_place(c.polygon, c.name or c.kind) for c in shut]
    yield from _line("stairs or lifts without an entrance", named)


def _overlaps(floor: FloorPlan) -> Iterator[str]:
    """Rooms that overlap: the room of a position in both would be ambiguous."""
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
    """Walkable area outside the outline, and floors with neither."""
    outline = [a.shape for a in floor.of_kind(OUTLINE) if a.is_polygon]
    if outline:
        outside = float(shapely.area(shapely.difference(floor.walkable, shapely.union_all(outline))))
        if outside > SMALL:
            yield f"{outside:.1f} m² of walkable area lie outside the outline"
    elif not floor.of_kind(*OPEN, *CLOSED):
        yield "neither an outline nor cells"


def _flat(floor: FloorPlan) -> Iterator[str]:
    """Cells drawn as a line or a point: they have no area to walk on."""
    flat = [f"{a.kind} {_place(a.shape, a.name)}" for a in floor.of_kind(*OPEN, *CLOSED) if not a.is_polygon]
    yield from _line("cells that are not polygons", flat)


def _links(floor: FloorPlan) -> Iterator[str]:
    """Links that cross a wall or are not lines."""
    through, short = [], []
    for link in floor.of_kind(LINK):
        corners = shapely.get_coordinates(link.shape)
        if len(corners) < 2:
            short.append(_place(link.shape, link.name))
        elif (crossing := floor.crosses_wall(corners[:-1], corners[1:])).any():
            first = int(np.argmax(crossing))
            through.append(_place(_in_the_wall(floor, corners[first : first + 2]), link.name))
    yield from _line("links that go through a wall", through)
    yield from _line("links that are not lines", short)


def _in_the_wall(floor: FloorPlan, segment: Array) -> shapely.Geometry:
    """Where a segment ``(2, 2)`` [m] leaves the walkable area, or meets a wall."""
    line = shapely.LineString(segment)
    places = shapely.difference(line, floor.walkable), shapely.intersection(line, floor.cells.barriers), line
    return shapely.get_parts(next(place for place in places if not shapely.is_empty(place)))[0]


def _beacons(floor: FloorPlan) -> Iterator[str]:
    """Beacons that no reception can be matched with."""

    def nameless(beacon: Area) -> bool:
        return not any(beacon.properties.get(key) for key in ("id", "mac", "uuid", "name"))

    beacons = floor.of_kind(BEACON)
    yield from _line("beacons without an id", [_place(b.shape, "") for b in beacons if nameless(b)])


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
