"""What a plan's file says: the areas of each floor in one frame, and the heights of the floors."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from pdr_graph.errors import InputError
from pdr_graph.floor.cells import Area
from pdr_graph.frames import Frame, enu
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
