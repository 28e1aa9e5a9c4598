"""The unit of a drawing: metres per unit, sizes that no building has, and what unit may have been meant."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import shapely

from pdr_graph.errors import InputError
from pdr_graph.types import Array

UNITS = {"metres": 1.0, "millimetres": 0.001, "centimetres": 0.01, "feet": 0.3048, "inches": 0.0254}  # [m]
LIKELY = (10.0, 300.0)  # [m] longer side of most buildings, for guesses alone
POSSIBLE = (2.5, 3000.0)  # [m] longer side of a plan: a small room, more than the largest terminal
WIDTHS = (0.2, 500.0)  # [m] typical width of the walkable area: a body is 0.5 m wide, the widest halls have 400 m
SCALES = (1e-9, 1e9)  # [m] per unit that --scale may state


def metres_per_unit(path: Path, points: Array, scale: float | None, noun: str, stated: float | None = None) -> float:
    """The scale of a drawing [m/unit]: `scale`, else the one that the file states.

    points: the drawing's corners ``(n, 2)`` [unit]; noun: of what it has, "517 segments". Raises InputError without a
    scale, or if no building has the drawing's size in it; the text guesses the unit.
    """
    width, height = np.ptp(points, axis=0).tolist()
    if scale is None and stated is None:
        found = f"{noun}, {width:.4g} by {height:.4g} units, unit not stated"
        expected = "--scale METRES_PER_UNIT, or a plan of pdr-graph map convert"
        raise InputError(path, "", found, expected + _guess(max(width, height)))
    metres = stated if scale is None else scale
    assert metres is not None
    if not SCALES[0] <= metres <= SCALES[1]:
        raise InputError("--scale" if scale is not None else path, "", f"{metres:g}", "metres per unit, above 0")
    size = metres * max(width, height)
    if not POSSIBLE[0] <= size <= POSSIBLE[1]:
        found = f"a building of {metres * width:.3g} by {metres * height:.3g} m with {metres:g} m per unit"
        fewest, most = POSSIBLE
        raise InputError(path, "", found, f"one of {fewest:g} to {most:g} m{_correction(max(width, height), metres)}")
    return metres


def _likely(size: float) -> list[tuple[str, float]]:
    """Units and their metres in which the longer side of a drawing [unit] is that of most buildings."""
    return [(unit, metres) for unit, metres in UNITS.items() if LIKELY[0] <= size * metres <= LIKELY[1]][:2]


def _guess(size: float) -> str:
    """A guess at the unit of a drawing from its longer side [unit]."""
    guesses = [f"--scale {metres:g} if drawn in {unit}: {size * metres:.0f} m" for unit, metres in _likely(size)]
    return f" ({' or '.join(guesses)})" if guesses else ""


def _correction(size: float, metres: float) -> str:
    """A guess at the scale that was meant instead of `metres` per unit; size: longer side [unit]."""
    for unit, likely in _likely(size):
        ratio = metres / likely
        times = f"{ratio:.4g} times too large" if ratio > 1 else f"{1 / ratio:.4g} times too small"
        return f" ({times}: {unit}? --scale {likely:g})"
    return ""


def check_size(path: Path, walkable: shapely.Geometry) -> None:
    """Raise InputError for a walkable area [m] so wide or so narrow that its unit cannot be metres."""
    area, border = float(shapely.area(walkable)), float(shapely.length(walkable))
    if not area or not border:
        return
    width = 2 * area / border
    if WIDTHS[0] <= width <= WIDTHS[1]:
        return
    large = width > WIDTHS[1]
    x0, y0, x1, y1 = shapely.bounds(walkable)
    size = max(x1 - x0, y1 - y0)
    factors = [f for f in (1000, 100, 10) if LIKELY[0] <= (size / f if large else size * f) <= LIKELY[1]]
    factor = factors[0] if factors else 1000
    unit = {1000: "millimetres", 100: "centimetres", 10: "decimetres"}[factor]
    found = f"rooms and corridors {width:.3g} m wide in a plan of {x1 - x0:.3g} by {y1 - y0:.3g} m"
    times = f"{factor} times too {'large: ' + unit + '?' if large else 'small'}"
    raise InputError(
        path, "", f"{found} ({times})", f"widths of {WIDTHS[0]:g} to {WIDTHS[1]:g} m, coordinates in metres"
    )
