"""Rooms that a map draws without a door: its authors left the door out, and nobody can be walled in.

IMDF archives and OpenStreetMap draw some doors and not others. A room or a lift without one opens along its border to
the corridors that it touches; if it touches none, to all rooms and lifts that it touches.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely
from numpy.typing import NDArray

from pdr_graph.errors import count
from pdr_graph.floor.cells import CLOSED, DOOR, OPEN, Area
from pdr_graph.priors import PLANS

NARROWEST_DOOR = 0.6  # [m] length of border that can have a door
DOOR_SLACK = 0.2  # [m] from a room within which a door belongs to it


def open_doorless_rooms(
    areas: Sequence[Area], label: str, notes: list[str], from_outside: bool = False
) -> tuple[Area, ...]:
    """The areas of a floor, with an opening along the border of each room or lift that has no door.

    A floor without any door is returned unchanged: all its rooms are open (`Cells`). from_outside: a room with an outer
    wall may be entered there, as shops from the street, and opens to no other room. notes: a line is appended.
    """
    doors = [area.shape for area in areas if area.kind == DOOR]
    cells = [area for area in areas if area.kind in (*OPEN, *CLOSED) and area.is_polygon]
    if not doors or not cells:
        return tuple(areas)
    door_tree, shapes = shapely.STRtree(doors), np.array([cell.shape for cell in cells], dtype=object)
    tree = shapely.STRtree(shapes)
    openings, opened = list[Area](), 0
    for n, cell in enumerate(cells):
        if cell.kind not in CLOSED or len(door_tree.query(cell.shape, predicate="dwithin", distance=DOOR_SLACK)):
            continue
        near = [int(k) for k in tree.query(cell.shape, predicate="dwithin", distance=PLANS.crack) if k != n]
        open_ = [k for k in near if cells[k].kind in OPEN]
        borders = _borders(shapes, n, open_, near)
        if not borders and not (from_outside and _has_outer_wall(shapes, n, near)):
            borders = _borders(shapes, n, near, near)
        openings += [Area(DOOR, "", border, {}, (label,)) for border in borders]
        opened += bool(borders)
    if opened:
        notes.append(
            f"floor {label}: {count(opened, 'room')} without a door: open along the corridor or room beside it"
        )
    return (*areas, *openings)


def _has_outer_wall(shapes: NDArray[np.object_], n: int, near: list[int]) -> bool:
    """True if a part of the border of cell n wide enough for a door has no other cell behind it."""
    around = shapely.buffer(shapely.union_all(shapes[near]), PLANS.crack, join_style="mitre")
    return float(shapely.length(shapely.difference(shapely.boundary(shapes[n]), around))) > NARROWEST_DOOR


def _borders(shapes: NDArray[np.object_], n: int, others: list[int], near: list[int]) -> list[shapely.Geometry]:
    """The border of cell n with each of some others as lines [m], away from all further cells near it."""
    found = []
    ring = shapely.boundary(shapes[n])
    for k in others:
        third = shapely.union_all([shapes[j] for j in near if j != k])
        border = shapely.intersection(ring, shapely.buffer(shapes[k], PLANS.crack, join_style="mitre"))
        # clearance [m] between an opening and any third cell, which it would open too; chosen by hand
        border = shapely.difference(border, shapely.buffer(third, 0.3))
        lines = [line for line in shapely.get_parts(border) if shapely.length(line) > NARROWEST_DOOR]
        if lines:
            found.append(shapely.line_merge(shapely.union_all(lines)))
    return found
