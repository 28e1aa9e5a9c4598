"""Occupancy maps of ROS map_server: a YAML file and the picture that it names."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import shapely
from scipy import ndimage

from pdr_graph.errors import InputError
from pdr_graph.floor.formats.drawing import Drawing, check_file_size, required_library
from pdr_graph.floor.formats.floor_picture import Picture, opened, outlines
from pdr_graph.floor.formats.line_drawing import areas_within, metres_per_unit
from pdr_graph.frames import Frame
from pdr_graph.types import Array, Mask

PICTURE_FORMATS = ("PPM", "PNG", "JPEG", "BMP", "TIFF")  # Pillow's PPM reads PGM too
LARGEST_NUMBER = 1e7  # in the file: metres of an origin far away
MAP_MODES = ("trinary", "scale", "raw")


def picture_of(path: Path) -> Path:
    """The picture that a map's YAML file names. Raises InputError if it is not beside it or below."""
    name, folder = _settings(path).get("image"), path.parent.resolve()
    if not isinstance(name, str) or not name:
        raise InputError(path, "image", f"{name!r}"[:60], "the name of a picture")
    picture = (folder / name).resolve()
    if not picture.is_relative_to(folder):
        raise InputError(path, "image", name[:60], "a picture in the folder of the map")
    if not picture.is_file():
        raise InputError(path, "image", f"no file {name[:60]}", "a picture beside the map")
    return picture


def read(path: Path, scale: float | None) -> Drawing:
    """Read a map in its own frame, whose origin and yaw it states. scale: must be None, since the map states it."""
    settings = _settings(path)
    resolution = _number(path, settings, "resolution")
    if scale is not None:
        raise InputError("--scale", "", f"{scale:g}", f"none: {path.name} states {resolution:g} m per pixel")
    picture, factor = opened(picture_of(path), PICTURE_FORMATS)
    rows, columns = np.array(picture.shape) * factor
    metres_per_unit(path, np.array([[0, 0], [columns, rows]]), resolution, "a picture")
    notes = [f"an occupancy map of {resolution:g} m per pixel"]
    free, unknown = _cells_of(path, settings, picture, notes)
    to_metres = _affine(path, settings, resolution * factor, len(picture))
    with required_library(path, "a ROS map", "scikit-image"):
        rings = shapely.get_exterior_ring(shapely.get_parts(outlines(~unknown)))
        parts = np.asarray(shapely.polygons(rings), dtype=object)
        large = shapely.area(parts) > shapely.area(parts).max(initial=0) / 10
        outline = shapely.union_all(parts[large]) if len(parts) else shapely.Polygon()
        spots: Any = ndimage.label(~free)[0]  # pyright: ignore[reportIndexIssue] no stubs
        # occupied or unknown spots of less than 0.05 m² in free space are noise of the scanner
        small = np.bincount(spots.ravel()) * (resolution * factor) ** 2 < 0.05
        small[0] = False
        walkable = shapely.intersection(outlines(free | small[spots]), outline)
    outline, walkable = (
        shapely.transform(s, lambda p: p @ to_metres[:, :2].T + to_metres[:, 2]) for s in (outline, walkable)
    )
    areas = areas_within(outline, walkable, notes)
    if not areas:
        raise InputError(path, "", "no free pixels", "free space, lighter than free_thresh")
    return Drawing({"": areas}, Frame(), tuple(notes))


def _settings(path: Path) -> dict[str, Any]:
    """The values in a YAML file. Raises InputError for another one."""
    with required_library(path, "a ROS map", "PyYAML"):
        import yaml
    try:
        check_file_size(path, 100_000)  # [bytes]
        values = yaml.safe_load(path.read_text(encoding="utf-8-sig"))
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError, ValueError, TypeError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(path, "", f"no YAML ({str(error)[:80]})", "a map of ROS map_server") from None
    if not isinstance(values, dict):
        raise InputError(path, "", f"a {type(values).__name__}", "image, resolution and origin")
    return values


def _number(path: Path, settings: dict[str, Any], key: str, default: float | None = None) -> float:
    value = settings.get(key, default)
    if type(value) not in (int, float) or not abs(value) < LARGEST_NUMBER or (key == "resolution" and value <= 0):
        raise InputError(path, key, f"{value!r}"[:60], "a positive number" if key == "resolution" else "a number")
    return float(value)


def _cells_of(path: Path, settings: dict[str, Any], picture: Picture, notes: list[str]) -> tuple[Mask, Mask]:
    """Which pixels are free, and which are unknown: neither free nor occupied."""
    mode = settings.get("mode", MAP_MODES[0])
    if mode not in MAP_MODES:
        raise InputError(path, "mode", f"{mode!r}"[:60], "one of " + ", ".join(MAP_MODES))
    if mode == "raw":  # values are percent
        occupancy, known = picture / 100.0, picture <= 100
    else:
        negate = _number(path, settings, "negate", 0) != 0
        occupancy = (picture if negate else 255 - picture.astype(int)) / 255.0
        known = np.ones(picture.shape, dtype=bool)
    # the default thresholds of map_server
    free = known & (occupancy < _number(path, settings, "free_thresh", 0.196))
    occupied = known & (occupancy > _number(path, settings, "occupied_thresh", 0.65))
    unknown = ~free & ~occupied
    notes.append(
        f"{np.mean(free):.0%} of the pixels free, {np.mean(occupied):.0%} occupied, {np.mean(unknown):.0%} unknown"
    )
    return free, unknown


def _affine(path: Path, settings: dict[str, Any], metres: float, rows: int) -> Array:
    """The affine ``(2, 3)`` from pixels (centres are whole, y downwards) to the map's frame [m]."""
    origin = settings.get("origin")
    numbers = origin if isinstance(origin, list) else []
    listed = [float(v) for v in numbers if type(v) in (int, float) and abs(v) < LARGEST_NUMBER]
    if len(listed) not in (2, 3) or len(listed) != len(numbers):
        raise InputError(path, "origin", f"{origin!r}"[:60], "[x, y, yaw] of the lower left pixel, in m and rad")
    yaw = listed[2] if len(listed) == 3 else 0.0
    cos, sin = np.cos(yaw), np.sin(yaw)
    turn = np.array([[cos, -sin], [sin, cos]])
    lower_left = turn @ (np.array([0.5, rows - 0.5]) * metres)
    return np.column_stack([turn @ np.diag([metres, -metres]), np.array(listed[:2]) + lower_left])
