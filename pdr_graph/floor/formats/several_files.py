"""A plan of several files: a folder or a zip with a file or a Microsoft floor folder per floor, in one frame."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import takewhile
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import shapely

from pdr_graph.errors import InputError
from pdr_graph.floor.cells import Area
from pdr_graph.floor.formats.drawing import Drawing, floor_heights
from pdr_graph.floor.formats.geojson import LARGEST_GEOJSON
from pdr_graph.frames import Frame
from pdr_graph.io.signatures import MICROSOFT
from pdr_graph.io.source import Source

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

    Raises InputError if there are none, or more than MOST_FLOOR_FILES.
    """
    floors = [child for child in sorted(folder.iterdir()) if child.is_dir() and MICROSOFT.is_folder(child)]
    files = [child for child in sorted(folder.iterdir()) if child.is_file()]
    files = [file for file in files if file.name not in MICROSOFT.parts and not file.name.startswith(".")]
    for endings in PLAN_ENDINGS:
        floors = floors or [file for file in files if file.suffix.lower() in endings]
    if not floors:
        expected = "a floor plan, a file or folder for each floor, or an IMDF archive"
        raise InputError(folder, "", f"a folder without {MICROSOFT.folder[0]} or any plan", expected)
    if len(floors) > MOST_FLOOR_FILES:
        raise InputError(folder, "", f"more than {MOST_FLOOR_FILES} plans", "a file for each floor of one building")
    return tuple(floors)


def joined(folder: Path, files: Sequence[Path], drawings: Sequence[Drawing]) -> Drawing:
    """All plans in a folder as one building. drawings: of each of its files.

    Floors have the labels of their plans, else the file names without what these have in common. Raises InputError if
    two floors have one label, or the plans are not in one frame.
    """
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
