"""Areas of a floor from a drawing of bare lines: outline, walls, doors, and the free spaces between them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import shapely
from numpy.typing import NDArray

from pdr_graph.columns import OneLineRepr
from pdr_graph.errors import count
from pdr_graph.floor.cells import DOOR, OUTLINE, WALL, Area
from pdr_graph.floor.formats import raster
from pdr_graph.floor.formats.drawn_doors import closed_doors, lines_of
from pdr_graph.types import Array

STAIRS = "stairs"
Geometries = NDArray[np.object_]


@dataclass(frozen=True)
class Rules:
    """Lengths that tell walls, rooms and doors apart in a drawing of lines; chosen by hand."""

    grid: float = 0.001  # [m] to which ends are rounded, so that lines that touch meet
    closing_radii: tuple[float, ...] = (0.1, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 2.5)  # [m] half a gap's width
    closed: float = 0.95  # share of the area closed at the largest radius at which an outline counts as closed
    least_area: float = 0.05  # share of the lines' bounding box: a smaller outline encloses no building
    sliver: float = 0.5  # [m] narrower free space, as between the two lines of a wall, is solid
    half_wall: float = 0.01  # [m] half the thickness of a wall drawn as one line
    jamb: float = 0.08  # [m] beside a door's opening that stays a wall
    thickest_wall: float = 0.35  # [m] on either side of a door's line, through which the door leads
    room: float = 3.0  # [m²] a smaller enclosed space is a column, a shaft or furniture
    strip: float = 1.2  # [m] an enclosed space that is narrower everywhere is a cavity or a ledge
    corridor_doors: int = 3  # a space with so many doors is a corridor


RULES = Rules()


@dataclass(frozen=True)
class Lines(OneLineRepr):
    """The lines of one floor [m].

    walls: segments ``(n, 2, 2)``; doors: lines across the openings of doors; stairs: polygons of stairs; solid:
    polygons of walls with thickness.
    """

    walls: Array
    doors: tuple[shapely.Geometry, ...] = ()
    stairs: tuple[shapely.Geometry, ...] = ()
    solid: shapely.Geometry = field(default_factory=shapely.Polygon)

    def _summary(self) -> list[str]:
        return [count(len(self.walls), "segment"), count(len(self.doors), "door")]


def areas_of(lines: Lines, notes: list[str]) -> tuple[tuple[Area, ...], shapely.Geometry]:
    """Areas of a floor from its lines, and the lines outside the building, which were left out.

    What was closed, taken as solid or left out is appended to `notes`. There is no area without a closed outline.
    """
    drawn = [*lines_of(lines.walls), *shapely.get_rings(shapely.get_parts(lines.solid))]
    walls = shapely.union_all(shapely.set_precision(drawn, RULES.grid))
    outline = _outline(walls, notes)
    if shapely.is_empty(outline):
        return (), walls
    around = shapely.buffer(outline, 5 * RULES.half_wall)
    inside, outside = shapely.intersection(walls, around), shapely.difference(walls, around)
    if shapely.length(outside) > 1.0:
        notes.append(f"{shapely.length(outside):.0f} m of lines outside the outline were left out")
    hollow = shapely.difference(outline, lines.solid)
    doors = [*lines.doors, *_doors_of_sealed(hollow, inside, lines, notes)]
    inside = shapely.difference(inside, shapely.union_all([_doorway(door) for door in doors]))
    cells = _cells(_free_spaces(hollow, inside, doors, lines.stairs), doors, lines.stairs, notes)
    return _with_walls(outline, cells, doors, lines.stairs, inside), outside


def areas_within(outline: shapely.Geometry, free: shapely.Geometry, notes: list[str]) -> tuple[Area, ...]:
    """Areas of a floor from its outline and its free space, polygons [m]; all else within the outline is solid."""
    half = RULES.sliver / 2
    wide = shapely.buffer(shapely.buffer(free, -half, join_style="mitre"), half, join_style="mitre")
    spaces = shapely.get_parts(shapely.simplify(shapely.intersection(wide, free), RULES.half_wall))
    cells = _cells(spaces, [], (), notes)
    border = shapely.union_all(shapely.get_rings([c.shape for c in cells])) if cells else shapely.LineString()
    return _with_walls(outline, cells, [], (), border) if cells else ()


def _with_walls(
    outline: shapely.Geometry,
    cells: list[Area],
    doors: list[shapely.Geometry],
    stairs: tuple[shapely.Geometry, ...],
    walls: shapely.Geometry,
) -> tuple[Area, ...]:
    """All areas of a floor: outline, cells, doors, stairs, solid parts, and walls as lines."""
    solid = _solid(outline, [*(cell.shape for cell in cells), *stairs], doors)
    areas = [Area(OUTLINE, "", outline), *cells, *(Area(DOOR, "", door) for door in doors)]
    areas += [Area(STAIRS, "", flight) for flight in stairs]
    return (*areas, *(Area(WALL, "", part) for part in (*solid, *_wall_lines(walls))))


def _outline(walls: shapely.Geometry, notes: list[str]) -> shapely.Geometry:
    """The polygons that the lines enclose once gaps are closed, with the smallest radius that closes the building."""
    radius = closing_radius(shapely.get_coordinates(shapely.get_parts(shapely.segmentize(walls, STEP))))
    if radius is None:
        return shapely.Polygon()
    closed = f"gaps of up to {2 * radius:g} m closed"
    radius = max(radius, min(2 * radius, RULES.closing_radii[-1]))  # a disc of just that radius dents the gap
    wide = shapely.get_parts(shapely.union_all(shapely.buffer(shapely.get_parts(walls), radius, quad_segs=4)))
    filled = shapely.union_all(shapely.polygons(shapely.get_exterior_ring(wide)))
    narrowed = shapely.get_parts(shapely.buffer(filled, -radius, join_style="mitre"))
    large = narrowed[shapely.area(narrowed) > RULES.room]
    outline = shapely.simplify(shapely.union_all(large), RULES.half_wall)
    notes.append(f"the outline was derived from the lines, {closed}: {shapely.area(outline):.0f} m²")
    return outline


STEP, MOST_CELLS = 0.05, 2000  # [m] of the raster, and its cells along the longer side of a large building


def closing_radius(points: Array) -> float | None:
    """The smallest radius [m] that closes a building whose walls are ``points (n, 2)`` [m]; None if none does.

    A disc of that radius rolls around the building and does not get in: the area that it cannot reach is nearly as
    large as with the largest radius.
    """
    low, extent = points.min(axis=0), np.ptp(points, axis=0)
    step = max(STEP, float(extent.max()) / MOST_CELLS)
    around = int(np.ceil(2 * RULES.closing_radii[-1] / step))
    cells = ((points - low) / step).astype(np.intp) + around
    free = np.ones((extent / step).astype(int) + 2 * around + 1, dtype=bool)
    free[tuple(cells.T)] = False
    clearance = raster.distance(free) * step

    def enclosed(radius: float) -> float:
        parts, _ = raster.parts(clearance > radius)
        reached = raster.distance(parts != parts[0, 0]) * step
        return float(np.count_nonzero(reached > radius) * step**2)

    largest = max(enclosed(radius) for radius in RULES.closing_radii[-2:])
    if largest < RULES.least_area * extent[0] * extent[1]:
        return None
    radii = [radius for radius in RULES.closing_radii if radius >= step]
    return next((r for r in radii if enclosed(r) >= RULES.closed * largest), radii[-1])


def _free_spaces(
    outline: shapely.Geometry,
    walls: shapely.Geometry,
    doors: list[shapely.Geometry],
    stairs: tuple[shapely.Geometry, ...] = (),
) -> Geometries:
    """The connected parts of the free space, doors closed, without slivers and stairs."""
    solid = shapely.buffer(walls, RULES.half_wall, cap_style="square", join_style="mitre")
    shut = shapely.union_all([shapely.buffer(d, 2 * RULES.half_wall, cap_style="square") for d in doors])
    free = shapely.difference(outline, shapely.union(solid, shut))
    half = RULES.sliver / 2 - RULES.half_wall
    wide = shapely.buffer(shapely.buffer(free, -half, join_style="mitre"), half, join_style="mitre")
    return shapely.get_parts(shapely.difference(shapely.intersection(wide, free), shapely.union_all(stairs)))


def _doorway(door: shapely.Geometry) -> shapely.Geometry:
    """The part of a wall that a door's line opens; the jambs at its ends stay."""
    start, end = shapely.get_coordinates(door)[[0, -1]]
    margin = min(RULES.jamb / shapely.length(door), 0.4) * (end - start)
    middle = shapely.LineString([start + margin, end - margin])
    return shapely.buffer(middle, RULES.thickest_wall, cap_style="flat")


def _cells(
    spaces: Geometries, doors: list[shapely.Geometry], stairs: tuple[shapely.Geometry, ...], notes: list[str]
) -> list[Area]:
    """Corridors and rooms from free spaces; enclosed spaces that are small or narrow are left out."""
    spaces = np.array([s for s in spaces if shapely.get_dimensions(s) == 2], dtype=object)
    ways = np.zeros(len(spaces), dtype=int)
    for ends in (doors, stairs):
        if len(ends) and len(spaces):
            which, _ = shapely.STRtree(spaces).query(ends, predicate="dwithin", distance=4 * RULES.half_wall)[::-1]
            np.add.at(ways, which, 1)
    area = shapely.area(spaces)
    main = int(np.argmax(area)) if len(area) else -1
    narrow = shapely.is_empty(shapely.buffer(spaces, -RULES.strip / 2))
    solid = (ways == 0) & ((area < RULES.room) | narrow)
    if solid.any():
        notes.append(
            f"{np.count_nonzero(solid)} enclosed spaces without a door were taken as solid: "
            f"smaller than {RULES.room:g} m² or narrower than {RULES.strip:g} m"
        )
    corridor = (np.arange(len(spaces)) == main) | (ways >= RULES.corridor_doors)
    return [
        Area("corridor" if corridor[n] else "room", "", spaces[n]) for n in np.flatnonzero(~solid | corridor).tolist()
    ]


def _doors_of_sealed(
    outline: shapely.Geometry, walls: shapely.Geometry, lines: Lines, notes: list[str]
) -> list[shapely.Geometry]:
    """Doors drawn as a closed leaf between two jambs, in the border of spaces without another way in."""
    doors = closed_doors(lines.walls)
    spaces = _free_spaces(outline, walls, list(lines.doors), lines.stairs)
    sealed = [s for s in spaces if shapely.area(s) > RULES.room]
    if len(sealed) < 2 or not doors:
        return []
    sealed.remove(max(sealed, key=shapely.area))
    rims = shapely.STRtree(sealed)
    found = [door for door in doors if len(rims.query(door, predicate="dwithin", distance=RULES.sliver))]
    if found:
        notes.append(f"{count(len(found), 'door')} drawn closed between jambs")
    return found


def _solid(outline: shapely.Geometry, cells: list[shapely.Geometry], doors: list[shapely.Geometry]) -> Geometries:
    """The solid parts of the building: what is no cell and no opening of a door, but for walls drawn as one line."""
    free = shapely.union_all([*cells, *(shapely.buffer(d, RULES.sliver, cap_style="flat") for d in doors)])
    thick = shapely.buffer(shapely.difference(outline, free), -2 * RULES.half_wall, join_style="mitre")
    solid = shapely.get_parts(shapely.buffer(thick, 2 * RULES.half_wall, join_style="mitre"))
    return solid[shapely.area(solid) > RULES.half_wall]


def _wall_lines(walls: shapely.Geometry) -> Geometries:
    """The walls drawn as lines, those around solid parts among them."""
    merged = shapely.get_parts(shapely.line_merge(walls))
    return merged[(shapely.length(merged) > 2 * RULES.half_wall) & (shapely.get_dimensions(merged) == 1)]
