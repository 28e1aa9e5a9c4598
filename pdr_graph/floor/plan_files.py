"""Floor plans from files: recognises the format, and builds the floors that the files draw.

A plan of several files is a folder or a zip with a file or a Microsoft floor folder per floor, in one frame.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import takewhile
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Self

import numpy as np
import shapely

from pdr_graph.errors import InputError, check_not_special
from pdr_graph.floor import building, plan
from pdr_graph.floor.cells import LINK, WALKABLE, Area
from pdr_graph.floor.formats.drawing import Drawing, check_floor_count, check_neighbours, floor_heights
from pdr_graph.floor.formats.geojson import LARGEST_GEOJSON
from pdr_graph.floor.formats.line_drawing import check_size
from pdr_graph.frames import Frame
from pdr_graph.io.signatures import (
    GEOJSON,
    HEAD,
    MICROSOFT,
    OTHERS,
    PLANS,
    RECORDINGS,
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
        return next((row for row in PLANS if row.is_folder(path)), None)
    head = _head(path)
    is_json = head.lstrip()[:1] in (b"{", b"[") or path.suffix.lower() in (".json", ".geojson")
    # a reader says best what is wrong with JSON
    return next((row for row in PLANS if row.begins(head)), GEOJSON if is_json else None)


def _head(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(HEAD).removeprefix(b"\xef\xbb\xbf")


def _refusal(path: Path) -> InputError:
    """The error for a file that is no plan: what it is, and what is expected."""
    if (recorder := recognized(Source(path, "floor plan"), RECORDINGS)) is not None:
        return InputError(path, "", f"a recording of {recorder.name}", f"a floor plan: {names(PLANS)}")
    head = _head(path)
    other = next((row[1:] for row in OTHERS if head.startswith(row[0])), None)
    return InputError(path, "", *(other or (described(head), f"a floor plan: {names(PLANS)}")))


def root_of(path: Path) -> Path:
    """The folder of a Microsoft floor or an IMDF archive from one of its files; any other path unchanged."""
    rows = (row for row in PLANS if path.name in row.parts)
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
        return _read_floors(path, scale)
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


# Endings of plans, those with most detail first: what has the first is the plan, pictures beside it are not
PLAN_ENDINGS = (
    (".geojson", ".osm"),
    (".json",),
    (".dxf",),
    (".csv",),
    (".yaml", ".yml"),
    (".pdf", ".png", ".jpg", ".jpeg"),
)
MOST_FLOOR_FILES = 200


@contextmanager
def unpacked(path: Path) -> Iterator[Path]:
    """A temporary folder with the files of an archive; errors name the archive instead.

    Raises InputError for hostile archives: names that lead elsewhere, links, doubles, more than 200 MB of files.
    """
    source = Source(path, "floor plan", LARGEST_GEOJSON)
    with TemporaryDirectory(prefix="pdr_graph-") as top:
        folder = Path(top) / path.stem
        try:
            folder.mkdir()
            for name in source.names:
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                (folder / name).write_bytes(source.content(name))
        except (OSError, ValueError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(path, "", "member names that no folder can hold", "an archive of plain files") from None
        try:
            yield folder
        except InputError as error:
            raise error.renamed(str(folder), str(path)) from None


def plans_in(folder: Path) -> tuple[Path, ...]:
    """The plans in a folder, by name: files of one format, and floor folders of Microsoft.

    Raises InputError if there are none.
    """
    floors = [child for child in sorted(folder.iterdir()) if child.is_dir() and MICROSOFT.is_folder(child)]
    files = [child for child in sorted(folder.iterdir()) if child.is_file()]
    files = [file for file in files if file.name not in MICROSOFT.parts and not file.name.startswith(".")]
    for endings in PLAN_ENDINGS:
        plans = [] if floors else [file for file in files if file.suffix.lower() in endings]
        if plans:
            return tuple(plans[: MOST_FLOOR_FILES + 1])
    if not floors:
        expected = "a floor plan, a file or folder for each floor, or an IMDF archive"
        raise InputError(folder, "", f"a folder without {MICROSOFT.folder[0]} or any plan", expected)
    return tuple(floors[: MOST_FLOOR_FILES + 1])


def _read_floors(folder: Path, scale: float | None) -> Drawing:
    """Read all plans in a folder as one building.

    Floors have the labels of their plans, else the file names without what these have in common. Raises InputError if
    two floors have one label, or the plans are not in one frame.
    """
    files = plans_in(folder)
    if len(files) > MOST_FLOOR_FILES:
        raise InputError(folder, "", f"more than {MOST_FLOOR_FILES} plans", "a file for each floor of one building")
    drawings = [read(file, scale) for file in files]
    if len(drawings) == 1:
        return drawings[0]
    drawings = [_labelled(d, name) for d, name in zip(drawings, _short_names(files), strict=True)]
    times = Counter(label for drawing in drawings for label in drawing.floors)
    for label, number in times.items():
        if number > 1:
            first, other = [f.name for f, d in zip(files, drawings, strict=True) if label in d.floors][:2]
            raise InputError(folder, "", f"floor {label!r} in {first} and in {other}", "each floor in one file")
    frame, floors = drawings[0].frame, dict[str, tuple[Area, ...]]()
    for file, drawing in zip(files, drawings, strict=True):
        floors |= {label: _in_frame(file, areas, drawing.frame, frame) for label, areas in drawing.floors.items()}
    boxes = {label: shapely.total_bounds([area.shape for area in areas]) for label, areas in floors.items()}
    low, high = next(iter(boxes.values())).reshape(2, 2)
    for file, label in (
        (file, label) for file, drawing in zip(files, drawings, strict=True) for label in drawing.floors
    ):
        south_west, north_east = boxes[label].reshape(2, 2)
        apart = float(np.hypot(*np.maximum(np.maximum(south_west - high, low - north_east), 0.0)))
        if not apart <= 200.0:  # farthest [m] between floors of one building
            found = f"{file.name} {apart:.0f} m beside {files[0].name}"
            raise InputError(folder, "", found, "the floors of one building, in one frame with common axes")
    heights = {label: drawing.heights.get(label, 0.0) for drawing in drawings for label in drawing.floors}
    # a storey each by their labels, unless the plans state different heights
    heights = floor_heights(folder, heights, heights if len(set(heights.values())) == len(heights) else None)
    notes = _lines(files, [drawing.notes for drawing in drawings])
    repairs = _lines(files, [drawing.repairs for drawing in drawings])
    floors = {label: floors[label] for label in heights}
    return Drawing(floors, frame, notes, repairs, heights, affine=drawings[0].affine)


def _lines(files: Sequence[Path], of_files: Sequence[Sequence[str]]) -> tuple[str, ...]:
    """Notes with the names of the files that they are about."""
    return tuple(f"{file.name}: {line}" for file, lines in zip(files, of_files, strict=True) for line in lines)


def _labelled(drawing: Drawing, name: str) -> Drawing:
    """A drawing whose only floor has no label, with the name of its file; its areas are on that floor alone."""
    names = {label: label or name for label in drawing.floors} if set(drawing.floors) == {""} else None
    names = names or {label: label for label in drawing.floors}
    floors = {
        names[label]: tuple(area if area.floors else replace(area, floors=(names[label],)) for area in areas)
        for label, areas in drawing.floors.items()
    }
    heights = {names.get(label, label): height for label, height in drawing.heights.items()}
    return replace(drawing, floors=floors, heights=heights)


def _short_names(files: Sequence[Path]) -> list[str]:
    """The names of files without endings, and without words that all of them begin with: ``EG`` for plan_EG.geojson."""
    words = [re.split(r"(?<=[-_. ])|(?<=[^\W\d_]{3})(?=-?\d)", file.stem) for file in files]
    common = len(list(takewhile(lambda column: len(set(column)) == 1, zip(*words, strict=False))))
    shared = min(common, *(len(each) - 1 for each in words))
    return ["".join(each[shared:]) for each in words]


def _in_frame(file: Path, areas: tuple[Area, ...], own: Frame, frame: Frame) -> tuple[Area, ...]:
    """Areas converted to the frame of the building. Raises InputError if only one of the frames has a latitude."""
    if own == frame:
        return areas
    if own.georeferenced != frame.georeferenced:
        found = "a plan in degrees" if own.georeferenced else "a plan in metres without a georeference"
        raise InputError(file, "", f"{found} beside others that are not", "all floors in one frame")
    return tuple(replace(a, shape=shapely.transform(a.shape, lambda p: frame.from_frame(own, p))) for a in areas)
