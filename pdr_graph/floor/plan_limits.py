"""Limits of an untrusted plan: file sizes, and what costs the square of it: floors, areas on one another, crossings."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from pdr_graph.errors import InputError, check_not_special, install

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
