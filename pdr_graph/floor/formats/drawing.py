"""What a plan's file says: the areas of each floor in one frame, and the heights of the floors.

A file is untrusted: its size is limited, and what costs the square of it: floors, areas on one another, crossings.

IMDF archives and OpenStreetMap draw some doors and not others. A room or a lift without a door opens along its border
to the corridors that it touches; if it touches none, to all rooms and lifts that it touches.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from pdr_graph.errors import InputError, check_not_special, count, install
from pdr_graph.floor.cells import CLOSED, DOOR, OPEN, Area
from pdr_graph.frames import Frame, enu
from pdr_graph.priors import PLANS
from pdr_graph.types import OneLineRepr


@dataclass(frozen=True)
class Drawing(OneLineRepr):
    """The floors of a plan's file by label, lowest first, in one frame.

    notes: features that were skipped or reinterpreted; repairs: drawing errors that were repaired, one line each;
    heights: of the floors by label [m], empty if the format has one floor per file; affine: (a, b, c, d, e, f) converts
    the file's own coordinates to the frame, x = a·u + b·v + c and y = d·u + e·v + f [m], of a drawing without
    georeference; ignored: lines that were left out [m], for pictures.
    """

    floors: dict[str, tuple[Area, ...]]
    frame: Frame
    notes: tuple[str, ...] = ()
    repairs: tuple[str, ...] = ()
    heights: dict[str, float] = field(default_factory=dict)
    affine: tuple[float, float, float, float, float, float] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
    ignored: shapely.Geometry = field(default_factory=shapely.LineString)


def frame_about(shapes: Iterable[shapely.Geometry]) -> Frame:
    """East-North frame about the centre of the bounding box of shapes in longitude and latitude [deg]."""
    west, south, east, north = shapely.total_bounds(list(shapes)).tolist()
    return enu((south + north) / 2, (west + east) / 2)


STOREY = 3.8  # [m] height of a storey if the plan has no heights: offices and shops have 3.5 to 4.5
HIGHEST_FLOOR = 1000.0  # [m] above or below zero: no building is higher
GROUND = ("G", "GF", "EG")  # labels of the ground floor
BELOW = ("B", "BF", "UG")  # letters before or after the number of a floor below the ground: B1, B1F, 2UG


def floor_heights(path: Path, labels: Iterable[str], stated: Any = None) -> dict[str, float]:
    """Height of each floor [m] by its label, lowest first.

    stated: the plan's heights by label; None: a storey each, in the order of the labels. Raises InputError for the
    height of an unknown floor, a floor without a height, or a height that is not a number.
    """
    ordered = sorted(labels, key=storey_of)
    if stated is None:
        return {label: STOREY * n for n, label in enumerate(ordered)}
    place, floors = "pdr_graph.heights", ", ".join(ordered)
    if not isinstance(stated, dict):
        raise InputError(path, place, repr(stated), 'a height for each floor, {"1": 0.0, "2": 4.0}')
    if unknown := sorted(set(stated) - set(ordered)):
        raise InputError(path, place, f"a floor {unknown[0]!r}", f"the labels of floors: {floors}")
    for label in ordered:
        if label not in stated:
            raise InputError(path, place, f"no height of floor {label!r}", f"a height for each of {floors}")
        if type(stated[label]) not in (int, float) or not abs(stated[label]) < HIGHEST_FLOOR:
            raise InputError(path, f"{place}.{label}", repr(stated[label]), f"metres, less than {HIGHEST_FLOOR:g}")
    return {label: float(stated[label]) for label in sorted(ordered, key=lambda label: stated[label])}


def storey_of(label: str) -> tuple[float, str]:
    """Sort key of a floor: its number (-2, B1, 0, EG, 1, F2, 3F, 4OG); floors without a number are last, by name."""
    found = re.fullmatch(r"([A-Z]*) ?(-?\d{1,9}(?:\.\d{1,9})?) ?([A-Z]*)", label.strip().upper())
    if found is None:
        return (0.0 if label.strip().upper() in GROUND else np.inf), label
    before, number, after = found.groups()
    return (-float(number) if before in BELOW or after in BELOW else float(number)), label


MOST_FLOORS = 500  # the tallest building has 163
MOST_NEIGHBOURS = 40  # areas that touch an area, on average; real plans have up to ten


def check_floor_count(path: Path, number: int) -> None:
    """Raise InputError unless a plan has 1 to MOST_FLOORS floors."""
    if not 0 < number <= MOST_FLOORS:
        raise InputError(path, "", f"{number} floors", f"1 to {MOST_FLOORS}")


def check_neighbours(path: Path, floor: str, areas: list[shapely.Geometry]) -> None:
    """Raise InputError if the areas of a floor lie on one another so that pairs of them cannot be compared."""
    if _pairs(np.array(areas, dtype=object), MOST_NEIGHBOURS, "intersects"):
        found = f"{len(areas)} areas, each of which touches more than {MOST_NEIGHBOURS} others on average"
        raise InputError(path, f"floor {floor}" if floor else "", found, "areas beside one another")


def check_crossings(path: Path, where: str, shape: shapely.Geometry) -> None:
    """Raise InputError for an outline that crosses itself too often to be repaired."""
    corners, ring = shapely.get_coordinates(shapely.get_rings(shapely.get_parts(shape)), return_index=True)
    inside = ring[1:] == ring[:-1]
    ends = np.stack([corners[:-1], corners[1:]], axis=1)[inside]
    sides = np.asarray(shapely.linestrings(ends), dtype=np.object_)  # (n,): ends has three dimensions
    if _pairs(sides, 10, None):
        found = f"an outline of {len(sides)} sides that cross one another in most places"
        raise InputError(path, where, found, "an outline around an area")


def _pairs(shapes: NDArray[np.object_], most: int, predicate: Literal["intersects"] | None) -> bool:
    """True if each shape meets more than `most` others on average; predicate None: their boxes do."""
    tree, number, limit = shapely.STRtree(shapes), 0, 20_000 + most * len(shapes)
    size = max(1, 1_000_000 // max(1, len(shapes)))
    for first in range(0, len(shapes), size):
        number += tree.query(shapes[first : first + size], predicate=predicate).shape[1]
        if number > limit:
            return True
    return False


def check_file_size(path: Path, largest: int, advice: str = "") -> None:
    """Raise InputError for a file larger than `largest` [bytes], or one without an end, such as a pipe.

    advice: what to do, appended to the message.
    """
    check_not_special(path, "a file of a floor plan")
    size = path.stat().st_size
    if size > largest:
        raise InputError(path, "", f"{size} bytes", f"at most {largest} bytes{advice and ': ' + advice}")


@contextmanager
def required_library(path: Path, noun: str, library: str) -> Iterator[None]:
    """Raise InputError where the block's import fails. noun: what the file is; library: its name on PyPI."""
    try:
        yield
    except ImportError:
        raise InputError(path, "", f"{noun} and no {library}", install("plans")) from None


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
        # 0.3 m from any third cell, which the opening would open too; chosen by hand
        border = shapely.difference(border, shapely.buffer(third, 0.3))
        lines = [line for line in shapely.get_parts(border) if shapely.length(line) > NARROWEST_DOOR]
        if lines:
            found.append(shapely.line_merge(shapely.union_all(lines)))
    return found
