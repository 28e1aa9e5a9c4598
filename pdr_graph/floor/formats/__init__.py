"""Floor plans from files: one format a file; ``read`` recognises it by content."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import shapely

from pdr_graph.errors import InputError, check_not_special
from pdr_graph.floor.cells import LINK
from pdr_graph.floor.formats import (
    drafts,
    imdf,
    ipin21_polygons,
    microsoft,
    osm_indoor,
    osm_xml,
    own_format,
    several_files,
)
from pdr_graph.floor.formats.drawing import Drawing
from pdr_graph.floor.formats.geojson import features_of, read_json
from pdr_graph.storage import fingerprint
from pdr_graph.types import Array


def root_of(path: Path) -> Path:
    """The folder of a Microsoft floor or an IMDF archive from one of its files; any other path unchanged."""
    return imdf.root_of(microsoft.root_of(path))


def files_of(path: Path) -> tuple[Path, ...]:
    """The files that `read` reads: the plan, or all files of a floor folder, of an IMDF archive or of a building."""
    root = root_of(path)
    if not root.is_dir():
        return drafts.files_of(root) if drafts.recognizes(root) else (root,)
    if microsoft.recognizes(root):
        return tuple(root / name for name in microsoft.FILES)
    if imdf.recognizes(root):
        return imdf.files_of(root)
    return tuple(file for plan in several_files.files_of(root) for file in files_of(plan))


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
    if several_files.is_zip(path):
        with several_files.unpacked(path) as folder:
            return read(folder, scale)
    if drafts.recognizes(path):
        return drafts.read(path, scale)
    forms = [form for form in (microsoft, imdf) if form.recognizes(path)]
    if path.is_dir() and not forms:
        return several_files.read(path, partial(read, scale=scale))
    if scale is not None:
        raise InputError("--scale", "", f"{scale:g}", f"none: the format of {path.name} states its own unit")
    return forms[0].read(path) if forms else _read_file(path)


def _read_file(path: Path) -> Drawing:
    """Read a plan of one file."""
    notes, repairs = list[str](), list[str]()
    if osm_xml.recognizes(path):
        features = osm_xml.features_of(path, notes, repairs)
        return replace(osm_indoor.read(path, features, notes), repairs=tuple(repairs))
    collection = read_json(path)
    features = list(features_of(path, collection, notes, repairs))
    if not features:
        raise InputError(path, "features", "none with a geometry", "rooms, corridors or walls")
    if osm_indoor.recognizes(features):
        drawing = osm_indoor.read(path, features, notes)
    else:
        read_format = ipin21_polygons.read if ipin21_polygons.recognizes(features) else own_format.read
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
