"""Operations on rasters of truth values: connected parts, distances, closing and opening."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from pdr_graph.types import Array, Mask

Numbers = NDArray[np.intp]


def parts(mask: Mask, diagonal: bool = False) -> tuple[Numbers, int]:
    """The number of the connected part of each pixel, 0 outside the mask, and how many parts there are."""
    found: Any = ndimage.label(mask, np.ones((3, 3)) if diagonal else None)
    return np.asarray(found[0], dtype=np.intp), int(found[1])


def sizes(numbers: Numbers, number: int) -> Array:
    """Pixels ``(number + 1,)`` of each part, of all outside first."""
    return np.bincount(numbers.ravel(), minlength=number + 1).astype(float)


def sides(numbers: Numbers) -> Array:
    """Height and width ``(n, 2)`` of the bounding box of each part. [pixel]"""
    boxes: Any = ndimage.find_objects(numbers)
    return np.array([[side.stop - side.start for side in box] for box in boxes], dtype=float).reshape(-1, 2)


def distance(mask: Mask) -> Array:
    """Distance of each pixel in the mask to the nearest one outside. [pixel]"""
    return np.asarray(ndimage.distance_transform_edt(mask), dtype=float)


def closing(mask: Mask, width: int) -> Mask:
    """The mask with gaps narrower than a square of `width` pixels closed, also along the border."""
    padded: Any = ndimage.binary_closing(np.pad(mask, width), np.ones((width, width)))
    return np.asarray(padded[width:-width, width:-width], dtype=bool)


def opening(mask: Mask, width: int) -> Mask:
    """The mask without strokes narrower than a square of `width` pixels."""
    return np.asarray(ndimage.binary_opening(mask, np.ones((width, width))), dtype=bool)


def dilation(mask: Mask) -> Mask:
    """The mask with all pixels around it."""
    return np.asarray(ndimage.binary_dilation(mask, np.ones((3, 3))), dtype=bool)
