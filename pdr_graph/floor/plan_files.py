"""Floor plans from files: recognises the format by content, and builds the floors that the file draws."""

from __future__ import annotations

from pathlib import Path
from typing import Self

import numpy as np
import shapely

from pdr_graph.errors import InputError, check_not_special
from pdr_graph.floor import building, plan
from pdr_graph.floor.cells import LINK, WALKABLE
from pdr_graph.floor.formats.drawing import Drawing, check_floor_count, check_neighbours
from pdr_graph.floor.formats.line_drawing import check_size
from pdr_graph.floor.formats.several_files import joined, plans_in, unpacked
from pdr_graph.io.signatures import (
    GEOJSON,
    HEAD,
    OTHERS,
    PLAN_FORMATS,
    RECORDING_FORMATS,
    ROS_MAP,
    Signature,
    described,
    function,
    names,
    recognized,
)
from pdr_graph.io.source import Source, is_zip
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


def format_of(path: Path) -> Signature | None:
    """The format of a plan, by the names in a folder or the first bytes of a file.

    None for a folder of several plans, and for a file that is no plan.
    """
    if path.is_dir():
        return next((row for row in PLAN_FORMATS if row.is_folder(path)), None)
    head = _head(path)
    is_json = head.lstrip()[:1] in (b"{", b"[") or path.suffix.lower() in (".json", ".geojson")
    # a reader says best what is wrong with JSON
    return next((row for row in PLAN_FORMATS if row.begins(head)), GEOJSON if is_json else None)


def _head(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(HEAD).removeprefix(b"\xef\xbb\xbf")


def _refusal(path: Path) -> InputError:
    """The error for a file that is no plan: what it is, and what is expected."""
    if (recorder := recognized(Source(path, "floor plan"), RECORDING_FORMATS)) is not None:
        return InputError(path, "", f"a recording of {recorder.name}", f"a floor plan: {names(PLAN_FORMATS)}")
    head = _head(path)
    other = next((row[1:] for row in OTHERS if head.startswith(row[0])), None)
    return InputError(path, "", *(other or (described(head), f"a floor plan: {names(PLAN_FORMATS)}")))


def root_of(path: Path) -> Path:
    """The folder of a Microsoft floor or an IMDF archive from one of its files; any other path unchanged."""
    rows = (row for row in PLAN_FORMATS if path.name in row.parts)
    return path.parent if any(row.is_folder(path.parent) for row in rows) else path


def files_of(path: Path) -> tuple[Path, ...]:
    """The files that `read` reads: the plan, or all files of a floor folder, of an IMDF archive or of a building."""
    root = root_of(path)
    if is_zip(root) or not (root.is_dir() or root.is_file()):
        return (root,)
    row = format_of(root)
    if row is None and root.is_dir():
        return tuple(file for plan in plans_in(root) for file in files_of(plan))
    if row is ROS_MAP:
        return root, function("floor.formats.ros_map:picture_of")(root)
    return tuple(root / name for name in (row.parts if row else ()) if (root / name).is_file()) or (root,)


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
        with unpacked(path) as folder:
            return read(folder, scale)
    row = format_of(path)
    if row is None and path.is_dir():
        files = plans_in(path)
        return joined(path, files, [read(file, scale) for file in files])
    if row is None:
        raise _refusal(path)
    if row.scaled:
        return function(row.reader)(path, scale)
    if scale is not None:
        raise InputError("--scale", "", f"{scale:g}", f"none: the format of {path.name} states its own unit")
    return function(row.reader)(path)


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
