"""Floor plans from files: recognises the format by content, and builds the floors that the file draws."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Self

import numpy as np
import shapely

from pdr_graph.errors import InputError, check_not_special
from pdr_graph.floor import building, plan
from pdr_graph.floor.cells import LINK, WALKABLE
from pdr_graph.floor.formats import (
    cad_segments,
    dxf,
    floor_picture,
    geojson,
    imdf,
    ipin21_polygons,
    microsoft,
    osm_indoor,
    pdf_page,
    ros_map,
    several_files,
)
from pdr_graph.floor.formats.drawing import Drawing, check_floor_count, check_neighbours
from pdr_graph.floor.formats.geojson import features_of, read_json
from pdr_graph.floor.formats.line_drawing import check_size
from pdr_graph.io.source import is_zip
from pdr_graph.storage import fingerprint
from pdr_graph.types import Array


class FloorPlan(plan.FloorPlan):
    """One floor, in its own metric frame, read from a file or made of its areas.

    label: the floor's name, "F1"; areas: the outline and everything in it; frame: relates it to latitude and longitude;
    height: above the plan's zero level [m]; notes: features of the file that were skipped or reinterpreted; repairs:
    drawing errors that were repaired; one line each.
    """

    @classmethod
    def load(cls, path: str | Path, floor: str | None = None, scale: float | None = None) -> Self:
        """Read one floor of a plan in any format (``docs/formats.md``).

        floor: label; required if the plan has several floors, ignored if it has one. scale: metres per unit of a
        drawing or per pixel of a picture.

        Raises InputError for another format, an unknown floor, or a floor without walkable area.
        """
        floors = cls.load_all(path, scale)
        found = ", ".join(each.label for each in floors)
        if len(floors) == 1:
            return floors[0]
        if floor is None:
            raise InputError(path, "", f"{len(floors)} floors, {found[:80]}", "the label of one of them")
        chosen = next((each for each in floors if each.label == floor), None)
        if chosen is None:
            raise InputError(path, "", f"the floors {found[:80]}", f"a floor {floor!r}")
        return chosen

    @classmethod
    def load_all(cls, path: str | Path, scale: float | None = None) -> tuple[Self, ...]:
        """Read all floors of a plan, lowest first; scale: as for `load`.

        Raises InputError for a floor without walkable area, or whose rooms and corridors have impossible widths.
        """
        return cls.of(Path(path), read(Path(path), scale))

    @classmethod
    def of(cls, path: Path, drawing: Drawing) -> tuple[Self, ...]:
        """The floors of a drawing, lowest first, checked as by `load_all`; path: its file, for messages."""
        check_floor_count(path, len(drawing.floors))
        floors = tuple(
            cls(label, areas, drawing.frame, drawing.notes, drawing.repairs, drawing.heights.get(label, 0.0))
            for label, areas in drawing.floors.items()
        )
        for floor in floors:
            check_neighbours(path, floor.label, [area.shape for area in floor.of_kind(*WALKABLE) if area.is_polygon])
            if shapely.is_empty(floor.walkable):
                expected = "an outline or a corridor that is not all solid"
                raise InputError(path, f"floor {floor.label}" if floor.label else "", "no walkable area", expected)
            check_size(path, floor.walkable)
        return floors


class Building(building.Building):
    """All floors of a plan in one frame, lowest first, read from a file or made of its floors."""

    @classmethod
    def load(cls, path: str | Path, scale: float | None = None) -> Self:
        """Read all floors of a plan in any format. Raises InputError as `FloorPlan.load_all` does.

        scale: metres per unit of a drawing or per pixel of a picture, whose format states none.
        """
        return cls.of(*FloorPlan.load_all(path, scale))


def root_of(path: Path) -> Path:
    """The folder of a Microsoft floor or an IMDF archive from one of its files; any other path unchanged."""
    return imdf.root_of(microsoft.root_of(path))


DRAWINGS = (dxf, pdf_page, floor_picture, ros_map, cad_segments)  # read with a scale, recognised by the first bytes
UNREAD = {  # first bytes: what it is, what to do
    b"AC10": ("a DWG drawing", "the same saved as DXF"),
    b"P5": ("the picture of a ROS map", "its .yaml file"),
}


def drawing_format(path: Path) -> ModuleType | None:
    """The module of DRAWINGS that reads a drawing or a picture; None for any other file or a folder.

    Raises InputError with advice for a drawing that cannot be read.
    """
    if not path.is_file():
        return None
    with path.open("rb") as file:
        head = file.read(4096)
    for begin, (found, advice) in UNREAD.items():
        if head.startswith(begin):
            raise InputError(path, "", found, advice)
    return next((module for module in DRAWINGS if module.recognizes(path, head)), None)


def files_of(path: Path) -> tuple[Path, ...]:
    """The files that `read` reads: the plan, or all files of a floor folder, of an IMDF archive or of a building."""
    root = root_of(path)
    if not root.is_dir():
        return (root, ros_map.picture_of(root)) if drawing_format(root) is ros_map else (root,)
    if microsoft.recognizes(root):
        return tuple(root / name for name in microsoft.FILES)
    if imdf.recognizes(root):
        return imdf.files_of(root)
    return tuple(file for plan in several_files.files_of(root) for file in files_of(plan))


def is_file_of(file: Path, plan: Path) -> bool:
    """True if `file` is one of the files that `read` reads of a plan."""
    return file.resolve() in {each.resolve() for each in files_of(plan)}


def plan_fingerprint(path: Path, scale: float | None = None) -> str:
    """The name of a plan, a hash of its files, and the scale [m/unit] with which it is read, if any."""
    text = fingerprint(root_of(path), files_of(path))
    return text if scale is None else f"{text}, {scale!r} m per unit"


def read(path: Path, scale: float | None = None) -> Drawing:
    """Read a plan; its format is recognised by content.

    scale: metres per unit of a drawing or per pixel of a picture. Raises InputError for other files, for a drawing
    whose unit is unknown, or for a scale where the format states its own.
    """
    path = root_of(path)
    if not path.exists():
        raise InputError(path, "", "no such file", "a floor plan")
    check_not_special(path, "a floor plan")
    if is_zip(path):
        with several_files.unpacked(path) as folder:
            return read(folder, scale)
    if (reader := drawing_format(path)) is not None:
        return reader.read(path, scale)
    forms = [form for form in (microsoft, imdf) if form.recognizes(path)]
    if path.is_dir() and not forms:
        return several_files.read(path, partial(read, scale=scale))
    if scale is not None:
        raise InputError("--scale", "", f"{scale:g}", f"none: the format of {path.name} states its own unit")
    return forms[0].read(path) if forms else _read_file(path)


def _read_file(path: Path) -> Drawing:
    """Read a plan of one file."""
    notes, repairs = list[str](), list[str]()
    if osm_indoor.is_osm_xml(path):
        features = osm_indoor.osm_features(path, notes, repairs)
        return replace(osm_indoor.read(path, features, notes), repairs=tuple(repairs))
    collection = read_json(path)
    features = list(features_of(path, collection, notes, repairs))
    if not features:
        raise InputError(path, "features", "none with a geometry", "rooms, corridors or walls")
    if osm_indoor.recognizes(features):
        drawing = osm_indoor.read(path, features, notes)
    else:
        read_format = ipin21_polygons.read if ipin21_polygons.recognizes(features) else geojson.read
        drawing = read_format(path, collection, features, notes)
    return replace(drawing, repairs=tuple(repairs))


MOST_CORNERS = 10_000  # of a route; one drawn by hand has some tens


def read_route(path: str | Path) -> Array:
    """Corners ``(m, 2)`` [m] of the only ``link`` in a plan of our own format.

    Raises InputError unless there is exactly one, of at most MOST_CORNERS.
    """
    drawing = read(Path(path))
    lines = {area.shape for areas in drawing.floors.values() for area in areas if area.kind == LINK}
    if len(lines) != 1:
        raise InputError(path, "", f"{len(lines)} features of kind 'link'", "one: the line that was walked")
    corners = shapely.get_coordinates(lines.pop())
    if len(corners) > MOST_CORNERS:
        raise InputError(path, "", f"{len(corners)} corners", f"a line of at most {MOST_CORNERS}: simplify it")
    apart = np.hypot(*np.diff(corners, axis=0).T) > 0
    return corners[np.append(True, apart)]
