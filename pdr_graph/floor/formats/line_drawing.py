"""A plan from the segments of a drawing: its unit, what its layers hold, outline, walls, doors, stairs and free spaces.

Doors are swing arcs with their leaf, leaves drawn closed, and symbols on a layer of doors.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from pdr_graph.errors import InputError, count
from pdr_graph.floor.cells import DOOR, OUTLINE, WALL, Area
from pdr_graph.floor.formats.drawing import Drawing
from pdr_graph.frames import Frame
from pdr_graph.geometry import wrap_angle
from pdr_graph.types import Array, Index, Mask, OneLineRepr

Geometries = NDArray[np.object_]


# Lengths that tell walls, rooms and doors apart in a drawing of lines; chosen by hand
CLOSING_RADII = (0.1, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 2.5)  # [m] half a gap's width
SLIVER = 0.5  # [m] narrower free space, as between the two lines of a wall, is solid
HALF_WALL = 0.01  # [m] half the thickness of a wall drawn as one line
SMALLEST_ROOM = 3.0  # [m²] a smaller enclosed space is a column, a shaft or furniture
STRIP = 1.2  # [m] an enclosed space that is narrower everywhere is a cavity or a ledge


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


def areas_of(lines: Lines, notes: list[str]) -> tuple[tuple[Area, ...], shapely.Geometry]:
    """Areas of a floor from its lines, and the lines outside the building, which were left out.

    What was closed, taken as solid or left out is appended to `notes`. There is no area without a closed outline.
    """
    drawn = [*lines_of(lines.walls), *shapely.get_rings(shapely.get_parts(lines.solid))]
    walls = shapely.union_all(shapely.set_precision(drawn, 0.001))  # so that lines that touch meet
    outline = _outline(walls, notes)
    if shapely.is_empty(outline):
        return (), walls
    around = shapely.buffer(outline, 5 * HALF_WALL)
    inside, outside = shapely.intersection(walls, around), shapely.difference(walls, around)
    if shapely.length(outside) > 1.0:
        notes.append(f"{shapely.length(outside):.0f} m of lines outside the outline were left out")
    hollow = shapely.difference(outline, lines.solid)
    doors = list(lines.doors)
    sealed = [s for s in _free_spaces(hollow, inside, doors, lines.stairs) if shapely.area(s) > SMALLEST_ROOM]
    if len(sealed) > 1:  # closed leaves in the border of spaces without another entrance
        sealed.remove(max(sealed, key=shapely.area))
        rims = shapely.STRtree(sealed)
        leaves = closed_doors(lines.walls)
        leaves = [leaf for leaf in leaves if len(rims.query(leaf, predicate="dwithin", distance=SLIVER))]
        doors += leaves
        notes += [f"{count(len(leaves), 'door')} drawn closed between jambs"] if leaves else []
    ways = list[shapely.Geometry]()
    for door in doors:  # opens the wall; the jambs at its ends stay
        start, end = shapely.get_coordinates(door)[[0, -1]]
        # jambs of 0.08 m beside an opening, walls of up to 0.35 m on either side of a door's line
        margin = min(0.08 / shapely.length(door), 0.4) * (end - start)
        between = shapely.LineString([start + margin, end - margin])
        ways.append(shapely.buffer(between, 0.35, cap_style="flat"))
    inside = shapely.difference(inside, shapely.union_all(ways))
    cells = _cells(_free_spaces(hollow, inside, doors, lines.stairs), doors, lines.stairs, notes)
    return _with_walls(outline, cells, doors, lines.stairs, inside), outside


def areas_within(outline: shapely.Geometry, free: shapely.Geometry, notes: list[str]) -> tuple[Area, ...]:
    """Areas of a floor from its outline and its free space, polygons [m]; all else within the outline is solid."""
    half = SLIVER / 2
    wide = shapely.buffer(shapely.buffer(free, -half, join_style="mitre"), half, join_style="mitre")
    spaces = shapely.get_parts(shapely.simplify(shapely.intersection(wide, free), HALF_WALL))
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
    openings = [shapely.buffer(door, SLIVER, cap_style="flat") for door in doors]
    free = shapely.union_all([*(cell.shape for cell in cells), *stairs, *openings])
    # what is no cell and no opening is solid, but for walls drawn as one line
    thick = shapely.buffer(shapely.difference(outline, free), -2 * HALF_WALL, join_style="mitre")
    solid = shapely.get_parts(shapely.buffer(thick, 2 * HALF_WALL, join_style="mitre"))
    merged = shapely.get_parts(shapely.line_merge(walls))
    merged = merged[(shapely.length(merged) > 2 * HALF_WALL) & (shapely.get_dimensions(merged) == 1)]
    areas = [Area(OUTLINE, "", outline), *cells, *(Area(DOOR, "", door) for door in doors)]
    areas += [Area("stairs", "", flight) for flight in stairs]
    return (*areas, *(Area(WALL, "", part) for part in (*solid[shapely.area(solid) > HALF_WALL], *merged)))


def _outline(walls: shapely.Geometry, notes: list[str]) -> shapely.Geometry:
    """The polygons that the lines enclose once gaps are closed, with the smallest radius that closes the building."""
    radius = closing_radius(shapely.get_coordinates(shapely.get_parts(shapely.segmentize(walls, PIXEL))))
    if radius is None:
        return shapely.Polygon()
    closed = f"gaps of up to {2 * radius:g} m closed"
    radius = max(radius, min(2 * radius, CLOSING_RADII[-1]))  # a disc of just that radius dents the gap
    wide = shapely.get_parts(shapely.union_all(shapely.buffer(shapely.get_parts(walls), radius, quad_segs=4)))
    filled = shapely.union_all(shapely.polygons(shapely.get_exterior_ring(wide)))
    narrowed = shapely.get_parts(shapely.buffer(filled, -radius, join_style="mitre"))
    large = narrowed[shapely.area(narrowed) > SMALLEST_ROOM]
    outline = shapely.simplify(shapely.union_all(large), HALF_WALL)
    notes.append(f"the outline was derived from the lines, {closed}: {shapely.area(outline):.0f} m²")
    return outline


PIXEL = 0.05  # [m] of the raster


def closing_radius(points: Array) -> float | None:
    """The smallest radius [m] that closes a building whose walls are ``points (n, 2)`` [m]; None if none does.

    A disc of that radius rolls around the building and does not get in: the area that it cannot reach is nearly as
    large as with the largest radius.
    """
    low, extent = points.min(axis=0), np.ptp(points, axis=0)
    step = max(PIXEL, float(extent.max()) / 2000)  # a large building has coarser cells
    around = int(np.ceil(2 * CLOSING_RADII[-1] / step))
    cells = ((points - low) / step).astype(np.intp) + around
    free = np.ones((extent / step).astype(int) + 2 * around + 1, dtype=bool)
    free[tuple(cells.T)] = False
    clearance = np.asarray(ndimage.distance_transform_edt(free)) * step

    def enclosed(radius: float) -> float:
        parts = np.asarray(ndimage.label(clearance > radius)[0])  # pyright: ignore[reportIndexIssue] no stubs
        reached = np.asarray(ndimage.distance_transform_edt(parts != parts[0, 0])) * step
        return float(np.count_nonzero(reached > radius) * step**2)

    largest = max(enclosed(radius) for radius in CLOSING_RADII[-2:])
    # a smaller outline encloses no building
    if largest < 0.05 * extent[0] * extent[1]:
        return None
    radii = [radius for radius in CLOSING_RADII if radius >= step]
    return next((r for r in radii if enclosed(r) >= 0.95 * largest), radii[-1])


def _free_spaces(
    outline: shapely.Geometry,
    walls: shapely.Geometry,
    doors: list[shapely.Geometry],
    stairs: tuple[shapely.Geometry, ...] = (),
) -> Geometries:
    """The connected parts of the free space, doors closed, without slivers and stairs."""
    solid = shapely.buffer(walls, HALF_WALL, cap_style="square", join_style="mitre")
    shut = shapely.union_all([shapely.buffer(d, 2 * HALF_WALL, cap_style="square") for d in doors])
    free = shapely.difference(outline, shapely.union(solid, shut))
    half = SLIVER / 2 - HALF_WALL
    wide = shapely.buffer(shapely.buffer(free, -half, join_style="mitre"), half, join_style="mitre")
    return shapely.get_parts(shapely.difference(shapely.intersection(wide, free), shapely.union_all(stairs)))


def _cells(
    spaces: Geometries, doors: list[shapely.Geometry], stairs: tuple[shapely.Geometry, ...], notes: list[str]
) -> list[Area]:
    """Corridors and rooms from free spaces; enclosed spaces that are small or narrow are left out."""
    spaces = np.array([s for s in spaces if shapely.get_dimensions(s) == 2], dtype=object)
    ways = np.zeros(len(spaces), dtype=int)
    for ends in (doors, stairs):
        if len(ends) and len(spaces):
            which, _ = shapely.STRtree(spaces).query(ends, predicate="dwithin", distance=4 * HALF_WALL)[::-1]
            np.add.at(ways, which, 1)
    area = shapely.area(spaces)
    main = int(np.argmax(area)) if len(area) else -1
    narrow = shapely.is_empty(shapely.buffer(spaces, -STRIP / 2))
    solid = (ways == 0) & ((area < SMALLEST_ROOM) | narrow)
    if solid.any():
        notes.append(
            f"{np.count_nonzero(solid)} enclosed spaces without a door were taken as solid: "
            f"smaller than {SMALLEST_ROOM:g} m² or narrower than {STRIP:g} m"
        )
    corridor = (np.arange(len(spaces)) == main) | (ways >= 3)
    return [
        Area("corridor" if corridor[n] else "room", "", spaces[n]) for n in np.flatnonzero(~solid | corridor).tolist()
    ]


NARROWEST_LEAF, WIDEST_LEAF = 0.55, 1.5  # [m] a leaf of a door: 0.6 to 1.2, and what was drawn inaccurately
TOUCHING = 0.08  # [m] two ends so close were meant to touch; the thickness of a leaf drawn as a rectangle
FEWEST_CHORDS = 3
BENDS = np.radians([0.5, 40.0])  # [rad] between two chords of an arc
SWEEPS = np.radians([40.0, 130.0])  # [rad] of a swing, 90° as a rule, on drawings also 45°
JAMB = (0.04, 0.6)  # [m] thickness of a wall
SQUARE = np.cos(np.radians(80.0))  # largest cosine between a leaf and its jambs


Arc = tuple[Array, Array]  # the swing of a door: its hinge ``(2,)``, and points along the arc ``(n, 2)`` [m]


def lines_of(segments: Array) -> NDArray[np.object_]:
    """The lines of segments ``(n, 2, 2)``."""
    return np.asarray(shapely.linestrings(segments), dtype=object).reshape(-1)


def swing_doors(segments: Array, candidates: Mask) -> tuple[list[shapely.Geometry], Mask]:
    """Doors drawn as an arc with a leaf: the lines across their openings, and which segments are their drawing.

    segments: ``(n, 2, 2)`` [m]; candidates: ``(n,)`` False for segments that are no part of a door's drawing.
    """
    drawing = np.zeros(len(segments), dtype=bool)
    arcs = _arcs(segments[candidates])
    if not arcs:
        return [], drawing
    lines = lines_of(segments)
    shapes = shapely.union_all([shapely.buffer(shapely.LineString(points), TOUCHING / 4) for _, points in arcs])
    drawing |= candidates & shapely.covers(shapes, lines)
    tree, doors = shapely.STRtree(lines), []
    for arc in arcs:
        points = arc[1]
        near = tree.query(shapely.LineString(points), predicate="dwithin", distance=WIDEST_LEAF)
        opening, leaf = _opening(arc, shapely.union_all(lines[near[~drawing[near]]]))
        doors.append(opening)
        along = near[shapely.covers(shapely.buffer(leaf, TOUCHING), lines[near])]
        drawing[along] |= candidates[along]
    return doors, drawing


def _opening(arc: Arc, walls: shapely.Geometry) -> tuple[shapely.Geometry, shapely.Geometry]:
    """The line across a door's opening, and that of its open leaf: a wall goes on only where the opening ends."""
    centre, ends = arc[0], arc[1][[0, -1]]
    sides = [shapely.LineString([centre, end]) for end in ends]
    costs = []
    for side, end in zip(sides, ends, strict=True):
        beyond = shapely.difference(walls, shapely.buffer(side, TOUCHING))
        covered = shapely.length(shapely.intersection(side, shapely.buffer(walls, TOUCHING / 2))) / shapely.length(side)
        gap = shapely.distance(beyond, shapely.Point(end)) if not shapely.is_empty(beyond) else WIDEST_LEAF
        costs.append(float(gap) + TOUCHING * float(covered))
    return (sides[0], sides[1]) if costs[0] <= costs[1] else (sides[1], sides[0])


def _arcs(segments: Array) -> list[Arc]:
    """Arcs in a drawing: chains of short segments that bend alike along a circle of a door's size."""
    # chords of a quarter circle of 1.5 m in five chords
    short = segments[np.hypot(*(segments[:, 1] - segments[:, 0]).T) < 0.5]
    if len(short) < FEWEST_CHORDS:
        return []
    lines = shapely.union_all(shapely.set_precision(shapely.linestrings(short), 0.002))
    chains = [shapely.get_coordinates(c) for c in shapely.get_parts(shapely.line_merge(lines))]
    found = list[Arc]()
    for chain in chains:
        course = np.arctan2(*np.diff(chain, axis=0).T[::-1])
        bend = wrap_angle(np.diff(course))
        sign = np.where((np.abs(bend) > BENDS[0]) & (np.abs(bend) < BENDS[1]), np.sign(bend), 0.0)
        cuts = np.flatnonzero((sign[1:] != sign[:-1]) | (sign[1:] == 0)) + 1
        for part in np.split(np.arange(len(bend)), cuts):
            if len(part) + 1 >= FEWEST_CHORDS and sign[part[0]]:
                points = chain[part[0] : part[-1] + 3]
                found += [] if (centre := _hinge(points)) is None else [(centre, points)]
    return found


def _hinge(points: Array) -> Array | None:
    """The centre ``(2,)`` of the swing through points ``(n, 2)``; None if they are no arc of a door's size."""
    middle = points.mean(axis=0)
    x, y = (points - middle).T
    design = np.stack([2 * x, 2 * y, np.ones(len(x))], axis=1)
    solution = np.linalg.lstsq(design, x**2 + y**2, rcond=None)[0]
    radius = float(np.sqrt(max(0.0, solution[2] + solution[0] ** 2 + solution[1] ** 2)))
    centre = middle + solution[:2]
    away = points - centre
    sweep = abs(float(wrap_angle(np.diff(np.arctan2(away[[0, -1], 1], away[[0, -1], 0])))[0]))
    # deviation from the circle, as a share of the radius
    is_round = np.abs(np.hypot(*away.T) - radius).max() < 0.04 * radius
    is_swing = NARROWEST_LEAF <= radius <= WIDEST_LEAF and SWEEPS[0] <= sweep <= SWEEPS[1]
    return centre if is_round and is_swing else None


def closed_doors(segments: Array) -> list[shapely.Geometry]:
    """Doors drawn as one closed line between two jambs, which are the ends of a wall drawn as two lines.

    Any other segment of that length stays a wall: it cannot be told from one. segments: ``(n, 2, 2)`` [m].
    """
    along = segments[:, 1] - segments[:, 0]
    length = np.hypot(*along.T)
    leaves = np.flatnonzero((length >= NARROWEST_LEAF) & (length <= WIDEST_LEAF))
    jambs = np.flatnonzero((length >= JAMB[0]) & (length <= JAMB[1]))
    if not len(leaves) or not len(jambs):
        return []
    course, ends = along / np.maximum(length, 1e-9)[:, None], KDTree(segments.reshape(-1, 2))
    tree = shapely.STRtree(lines_of(segments))
    doors = []
    for n in leaves.tolist():
        leaf = segments[n]
        # a line behind the middle of a leaf: a niche, or a wall drawn as two lines
        middle = shapely.LineString([0.6 * leaf[0] + 0.4 * leaf[1], 0.4 * leaf[0] + 0.6 * leaf[1]])
        near = tree.geometries[tree.query(middle, predicate="dwithin", distance=NARROWEST_LEAF / 2)]
        backed = (shapely.distance(near, middle) > TOUCHING).any()
        outward = (leaf[0], -course[n]), (leaf[1], course[n])
        if not backed and all(_ends_wall(segments, course, ends, jambs, tree, *each) for each in outward):
            doors.append(shapely.LineString(leaf))
    return doors


def _ends_wall(
    segments: Array, course: Array, ends: KDTree, jambs: Index, tree: shapely.STRtree, end: Array, outward: Array
) -> bool:
    """True if a leaf's end ``(2,)`` lies on a jamb from whose both ends a wall goes on along `outward (2,)`."""
    near = np.intersect1d(tree.query(shapely.Point(end), predicate="dwithin", distance=TOUCHING / 2), jambs)
    for jamb in near[np.abs(course[near] @ outward) < SQUARE].tolist():
        faces = 0
        for corner in segments[jamb]:
            touching = np.array(ends.query_ball_point(corner, TOUCHING / 2), dtype=np.intp)
            others, which = np.divmod(touching, 2)
            leaving = course[others] * np.where(which == 0, 1.0, -1.0)[:, None]
            faces += bool((leaving @ outward > 1 - SQUARE**2).any())
        if faces == 2:
            return True
    return False


def symbol_doors(symbols: Array, walls: Array) -> list[shapely.Geometry]:
    """The lines across the openings of doors on a layer of doors: one for each connected symbol.

    symbols: segments of the symbols ``(n, 2, 2)``; walls: all other segments ``(m, 2, 2)`` [m].
    """
    if not len(symbols):
        return []
    all_walls = shapely.union_all(shapely.linestrings(walls)) if len(walls) else shapely.LineString()
    doors = []
    for part in shapely.get_parts(shapely.union_all(shapely.buffer(shapely.linestrings(symbols), TOUCHING / 2))):
        within = symbols[shapely.covers(part, shapely.linestrings(symbols))]
        arcs = _arcs(within)
        if arcs:
            near = shapely.intersection(all_walls, shapely.buffer(part, WIDEST_LEAF))
            doors += [_opening(arc, near)[0] for arc in arcs]
            continue
        # the side or the middle line of the symbol's rectangle whose ends lie nearest to walls
        corners = shapely.get_coordinates(shapely.minimum_rotated_rectangle(part))
        if len(corners) == 5:
            middles = (corners[:-1] + corners[1:]) / 2
            pairs = [middles[[0, 2]], middles[[1, 3]], *(corners[n : n + 2] for n in range(4))]
            # widest opening [m]: a door of two leaves
            pairs = [pair for pair in pairs if NARROWEST_LEAF <= np.hypot(*(pair[1] - pair[0])) <= 3.0]
            apart = [shapely.distance(all_walls, shapely.points(pair)).sum() for pair in pairs]
            doors += [shapely.LineString(pairs[int(np.argmin(apart))])] if pairs else []
    return doors


MOST_SEGMENTS = 200_000  # of an untrusted file
FEWEST_SEGMENTS = 3
LARGEST_COORDINATE = 1e10  # [unit] northings of a projection in millimetres
MARGIN = 0.01  # share of a page's longer side between a frame and the drawing in it
# Treads of stairs: equal parallel lines, evenly spaced
TREAD_LENGTH = (0.7, 4.0)  # [m]
TREAD_SPACING = (0.2, 0.42)  # [m] building codes allow 0.21 to 0.37
FEWEST_TREADS = 4
TREAD_TOLERANCE = 0.08  # [m] of length and alignment


def drawing_of_lines(
    path: Path,
    segments: Array,
    layers: Sequence[str],
    scale: float | None,
    stated: float | None,
    notes: list[str],
    framed: bool = False,
) -> Drawing:
    """The plan of one floor from segments ``(n, 2, 2)`` in the drawing's unit and axes.

    layers: what the layer of each holds; scale: metres per unit by the user; stated: by the file; framed: pages have
    frames, which are left out. Raises InputError if the unit is unknown or impossible, or if the lines enclose no
    building.
    """
    if len(segments) < FEWEST_SEGMENTS:
        raise InputError(path, "", count(len(segments), "segment"), "the walls of a floor")
    holds = np.array(layers, dtype=object)
    while framed and (frame := _frame(segments)).any():
        notes.append("a frame around the drawing was left out")
        segments, holds = segments[~frame], holds[~frame]
    named, unknown = np.count_nonzero(holds == WALL_LINES), holds == UNCLEAR
    if named >= FEWEST_SEGMENTS and unknown.any():
        notes.append(f"{count(int(unknown.sum()), 'segment')} on layers not named walls were left out")
    holds = np.where(unknown, IGNORED if named >= FEWEST_SEGMENTS else WALL_LINES, holds)
    drawn = segments[holds != IGNORED]
    metres = metres_per_unit(path, drawn.reshape(-1, 2), scale, count(len(segments), "segment"), stated)
    segments = segments * metres
    long = np.hypot(*(segments[:, 1] - segments[:, 0]).T) > 0
    segments, holds = segments[long], holds[long]
    lines, left_out = _understood(segments, holds, notes)
    areas, outside = areas_of(lines, notes)
    if not areas:
        raise InputError(path, "", "lines that enclose no building", "walls with gaps of at most 5 m around it")
    ignored = shapely.union_all([*lines_of(left_out), outside])
    affine = (metres, 0.0, 0.0, 0.0, metres, 0.0)
    return Drawing({"": areas}, Frame(), tuple(notes), affine=affine, ignored=ignored)


def _frame(segments: Array) -> Mask:
    """Which segments ``(n, 2, 2)`` lie on the drawing's bounding box, if that is a frame with a margin inside."""
    low, high = segments.min(axis=(0, 1)), segments.max(axis=(0, 1))
    near = MARGIN / 4 * (high - low).max()
    on = [(np.abs(segments[:, :, axis] - side[axis]) < near).all(axis=1) for axis in (0, 1) for side in (low, high)]
    frame = np.any(on, axis=0)
    rest = segments[~frame]
    if not all(side.any() for side in on) or not len(rest):
        return np.zeros(len(segments), dtype=bool)
    margins = np.concatenate([rest.min(axis=(0, 1)) - low, high - rest.max(axis=(0, 1))])
    return frame if (margins > MARGIN * (high - low).max()).all() else np.zeros(len(segments), dtype=bool)


def _understood(segments: Array, holds: Array, notes: list[str]) -> tuple[Lines, Array]:
    """Walls, doors and stairs, and the segments ``(m, 2, 2)`` that are neither [m]."""
    on_doors, on_stairs, ignored = (holds == kind for kind in (DOOR_LINES, STAIR_LINES, IGNORED))
    if ignored.any():
        notes.append(f"{count(int(ignored.sum()), 'segment')} on layers of texts, dimensions or furniture left out")
    swinging, swing = swing_doors(segments, holds == WALL_LINES)
    treads, steps = _stairs(segments, (holds == WALL_LINES) & ~swing)
    walls = (holds == WALL_LINES) & ~swing & ~treads
    symbols = symbol_doors(segments[on_doors], segments[walls])
    if swinging:
        notes.append(f"{count(len(swinging), 'door')} drawn with a swing")
    if symbols:
        notes.append(f"{count(len(symbols), 'door')} on layers of doors")
    if on_stairs.any():  # the hulls of connected segments
        half = TREAD_SPACING[1] / 2
        wide = shapely.union_all(shapely.buffer(lines_of(segments[on_stairs]), half))
        hulls = shapely.buffer(shapely.convex_hull(shapely.get_parts(wide)), -half)
        steps += list(hulls[shapely.area(hulls) > 2 * half])
    if steps:
        notes.append(f"{count(len(steps), 'flight')} of stairs")
    lines = Lines(segments[walls], (*swinging, *symbols), tuple(steps))
    return lines, segments[ignored]


def _stairs(segments: Array, candidates: Mask) -> tuple[Mask, list[shapely.Geometry]]:
    """Which segments are treads of stairs, and the polygon around each flight [m]."""
    along = segments[:, 1] - segments[:, 0]
    length = np.hypot(*along.T)
    chosen = np.flatnonzero(candidates & (length > TREAD_LENGTH[0]) & (length < TREAD_LENGTH[1]))
    treads = np.zeros(len(segments), dtype=bool)
    if len(chosen) < FEWEST_TREADS:
        return treads, []
    middle, course = segments[chosen].mean(axis=1), along[chosen] / length[chosen, None]
    i, j = KDTree(middle).query_pairs(TREAD_SPACING[1], output_type="ndarray").T
    apart = middle[j] - middle[i]
    parallel = np.abs(np.sum(course[i] * course[j], axis=1)) > np.cos(np.radians(2.0))
    beside = np.abs(np.sum(apart * course[i], axis=1)) < TREAD_TOLERANCE
    equal = np.abs(length[chosen[i]] - length[chosen[j]]) < TREAD_TOLERANCE
    near = parallel & beside & equal & (np.hypot(*apart.T) > TREAD_SPACING[0])
    joined = coo_array((np.ones(near.sum()), (i[near], j[near])), shape=(len(chosen), len(chosen)))
    flight = connected_components(joined, directed=False)[1]
    steps = []
    for n in np.flatnonzero(np.bincount(flight) >= FEWEST_TREADS):
        which = chosen[flight == n]
        treads[which] = True
        steps.append(shapely.convex_hull(shapely.multipoints(segments[which].reshape(-1, 2))))
    return treads, steps


WALL_LINES, DOOR_LINES, STAIR_LINES, IGNORED, UNCLEAR = "walls", "doors", "stairs", "ignored", "unknown"
# Parts of names, the first that fits decides: "A-WALL", "A-DOOR", "I-FURN" of the AIA; German, French, Spanish, Italian
LAYER_NAMES = (
    (IGNORED, r"text|txt|anno|label|dim\b|dims|dimen|bema|maß|cota|cote|quota|grid|axis|achse|raster|hatch|schraff"),
    (IGNORED, r"furn|möbel|moebel|mobel|mobil|equip|einricht|elec|elektr|light|lamp|plumb|sanit|hvac|heiz|duct|pipe"),
    (IGNORED, r"title|border|frame|rahmen|viewport|defpoints|logo|legend|north|symb|area|room.?name|tree|baum|topo"),
    (DOOR_LINES, r"door|tür|tuer|\btur\b|porte|puerta|\bporta|drzwi|deur"),
    (STAIR_LINES, r"stair|trepp|escal|\bscal|step|stufe|ramp|rolltr"),
    (WALL_LINES, r"wall|wand|wänd|waend|mauer|\bmur|muro|parede|pared|column|\bcol\b|stütz|stuetz|säule|pillar|colonn"),
    (
        WALL_LINES,
        r"window|fenster|fenetre|fenêtre|ventana|finestra|glaz|glas|facade|fassade|railing|gelaender|geländer|core",
    ),
)


def holds(name: str) -> str:
    """What a layer or a block of this name holds: WALL_LINES, DOOR_LINES, STAIR_LINES, IGNORED or UNCLEAR."""
    for kind, pattern in LAYER_NAMES:
        if re.search(pattern, name.casefold()):
            return kind
    return UNCLEAR


UNITS = {"metres": 1.0, "millimetres": 0.001, "centimetres": 0.01, "feet": 0.3048, "inches": 0.0254}  # [m]
LIKELY = (10.0, 300.0)  # [m] longer side of most buildings, for guesses alone
POSSIBLE = (2.5, 3000.0)  # [m] longer side of a plan: a small room, more than the largest terminal
WIDTHS = (0.2, 500.0)  # [m] typical width of the walkable area: a body is 0.5 m wide, the widest halls have 400 m
ACCEPTED_SCALES = (1e-9, 1e9)  # [m] per unit that --scale may state


def metres_per_unit(path: Path, points: Array, scale: float | None, noun: str, stated: float | None = None) -> float:
    """The scale of a drawing [m/unit]: `scale`, else the one that the file states.

    points: the drawing's corners ``(n, 2)`` [unit]; noun: of what it has, "517 segments". Raises InputError without a
    scale, or if no building has the drawing's size in it; the text guesses the unit.
    """
    width, height = np.ptp(points, axis=0).tolist()
    side = max(width, height)
    likely = [(unit, metres) for unit, metres in UNITS.items() if LIKELY[0] <= side * metres <= LIKELY[1]][:2]
    if scale is None and stated is None:
        found = f"{noun}, {width:.4g} by {height:.4g} units, unit not stated"
        guesses = [f"--scale {metres:g} if drawn in {unit}: {side * metres:.0f} m" for unit, metres in likely]
        expected = "--scale METRES_PER_UNIT, or a plan of pdr-graph map convert"
        raise InputError(path, "", found, f"{expected} ({' or '.join(guesses)})" if guesses else expected)
    metres = stated if scale is None else scale
    assert metres is not None
    if not ACCEPTED_SCALES[0] <= metres <= ACCEPTED_SCALES[1]:
        raise InputError("--scale" if scale is not None else path, "", f"{metres:g}", "metres per unit, above 0")
    if not POSSIBLE[0] <= metres * side <= POSSIBLE[1]:
        found = f"a building of {metres * width:.3g} by {metres * height:.3g} m with {metres:g} m per unit"
        expected = f"one of {POSSIBLE[0]:g} to {POSSIBLE[1]:g} m"
        for unit, meant in likely[:1]:
            ratio = metres / meant
            times = f"{ratio:.4g} times too large" if ratio > 1 else f"{1 / ratio:.4g} times too small"
            expected += f" ({times}: {unit}? --scale {meant:g})"
        raise InputError(path, "", found, expected)
    return metres


def check_size(path: Path, walkable: shapely.Geometry) -> None:
    """Raise InputError for a walkable area [m] so wide or so narrow that its unit cannot be metres."""
    area, border = float(shapely.area(walkable)), float(shapely.length(walkable))
    if not area or not border:
        return
    width = 2 * area / border
    if WIDTHS[0] <= width <= WIDTHS[1]:
        return
    large = width > WIDTHS[1]
    x0, y0, x1, y1 = shapely.bounds(walkable)
    size = max(x1 - x0, y1 - y0)
    factors = [f for f in (1000, 100, 10) if LIKELY[0] <= (size / f if large else size * f) <= LIKELY[1]]
    factor = factors[0] if factors else 1000
    unit = {1000: "millimetres", 100: "centimetres", 10: "decimetres"}[factor]
    found = f"rooms and corridors {width:.3g} m wide in a plan of {x1 - x0:.3g} by {y1 - y0:.3g} m"
    times = f"{factor} times too {'large: ' + unit + '?' if large else 'small'}"
    raise InputError(
        path, "", f"{found} ({times})", f"widths of {WIDTHS[0]:g} to {WIDTHS[1]:g} m, coordinates in metres"
    )
