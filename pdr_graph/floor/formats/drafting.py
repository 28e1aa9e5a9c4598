"""A plan from the segments of a drawing: its unit, what its layers hold, walls, doors, stairs, and what is left out."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import shapely
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from pdr_graph.errors import InputError, count
from pdr_graph.floor.formats.drawing import Drawing
from pdr_graph.floor.formats.line_drawing import Lines, areas_of, lines_of, swing_doors, symbol_doors
from pdr_graph.frames import Frame
from pdr_graph.types import Array, Mask

MOST_SEGMENTS = 200_000  # of an untrusted file
FEWEST_SEGMENTS = 3
LARGEST_COORDINATE = 1e10  # [unit] northings of a projection in millimetres
MARGIN = 0.01  # share of a page's longer side between a frame and the drawing in it
# Treads of stairs: equal parallel lines, evenly spaced
TREAD_LENGTH = (0.7, 4.0)  # [m]
TREAD_SPACING = (0.2, 0.42)  # [m] building codes allow 0.21 to 0.37
FEWEST_TREADS = 4
TREAD_TOLERANCE = 0.08  # [m] of length and alignment


def drawing_of_lines(
    path: Path,
    segments: Array,
    layers: Sequence[str],
    scale: float | None,
    stated: float | None,
    notes: list[str],
    framed: bool = False,
) -> Drawing:
    """The plan of one floor from segments ``(n, 2, 2)`` in the drawing's unit and axes.

    layers: what the layer of each holds; scale: metres per unit by the user; stated: by the file; framed: pages have
    frames, which are left out. Raises InputError if the unit is unknown or impossible, or if the lines enclose no
    building.
    """
    if len(segments) < FEWEST_SEGMENTS:
        raise InputError(path, "", count(len(segments), "segment"), "the walls of a floor")
    holds = np.array(layers, dtype=object)
    while framed and (frame := _frame(segments)).any():
        notes.append("a frame around the drawing was left out")
        segments, holds = segments[~frame], holds[~frame]
    named, unknown = np.count_nonzero(holds == WALL_LINES), holds == UNCLEAR
    if named >= FEWEST_SEGMENTS and unknown.any():
        notes.append(f"{count(int(unknown.sum()), 'segment')} on layers not named walls were left out")
    holds = np.where(unknown, IGNORED if named >= FEWEST_SEGMENTS else WALL_LINES, holds)
    drawn = segments[holds != IGNORED]
    metres = metres_per_unit(path, drawn.reshape(-1, 2), scale, count(len(segments), "segment"), stated)
    segments = segments * metres
    long = np.hypot(*(segments[:, 1] - segments[:, 0]).T) > 0
    segments, holds = segments[long], holds[long]
    lines, left_out = _understood(segments, holds, notes)
    areas, outside = areas_of(lines, notes)
    if not areas:
        raise InputError(path, "", "lines that enclose no building", "walls with gaps of at most 5 m around it")
    ignored = shapely.union_all([*lines_of(left_out), outside])
    affine = (metres, 0.0, 0.0, 0.0, metres, 0.0)
    return Drawing({"": areas}, Frame(), tuple(notes), affine=affine, ignored=ignored)


def _frame(segments: Array) -> Mask:
    """Which segments ``(n, 2, 2)`` lie on the drawing's bounding box, if that is a frame with a margin inside."""
    low, high = segments.min(axis=(0, 1)), segments.max(axis=(0, 1))
    near = MARGIN / 4 * (high - low).max()
    on = [(np.abs(segments[:, :, axis] - side[axis]) < near).all(axis=1) for axis in (0, 1) for side in (low, high)]
    frame = np.any(on, axis=0)
    rest = segments[~frame]
    if not all(side.any() for side in on) or not len(rest):
        return np.zeros(len(segments), dtype=bool)
    margins = np.concatenate([rest.min(axis=(0, 1)) - low, high - rest.max(axis=(0, 1))])
    return frame if (margins > MARGIN * (high - low).max()).all() else np.zeros(len(segments), dtype=bool)


def _understood(segments: Array, holds: Array, notes: list[str]) -> tuple[Lines, Array]:
    """Walls, doors and stairs, and the segments ``(m, 2, 2)`` that are neither [m]."""
    on_doors, on_stairs, ignored = (holds == kind for kind in (DOOR_LINES, STAIR_LINES, IGNORED))
    if ignored.any():
        notes.append(f"{count(int(ignored.sum()), 'segment')} on layers of texts, dimensions or furniture left out")
    swinging, swing = swing_doors(segments, holds == WALL_LINES)
    treads, steps = _stairs(segments, (holds == WALL_LINES) & ~swing)
    walls = (holds == WALL_LINES) & ~swing & ~treads
    symbols = symbol_doors(segments[on_doors], segments[walls])
    if swinging:
        notes.append(f"{count(len(swinging), 'door')} drawn with a swing")
    if symbols:
        notes.append(f"{count(len(symbols), 'door')} on layers of doors")
    if on_stairs.any():  # the hulls of connected segments
        half = TREAD_SPACING[1] / 2
        wide = shapely.union_all(shapely.buffer(lines_of(segments[on_stairs]), half))
        hulls = shapely.buffer(shapely.convex_hull(shapely.get_parts(wide)), -half)
        steps += list(hulls[shapely.area(hulls) > 2 * half])
    if steps:
        notes.append(f"{count(len(steps), 'flight')} of stairs")
    lines = Lines(segments[walls], (*swinging, *symbols), tuple(steps))
    return lines, segments[ignored]


def _stairs(segments: Array, candidates: Mask) -> tuple[Mask, list[shapely.Geometry]]:
    """Which segments are treads of stairs, and the polygon around each flight [m]."""
    along = segments[:, 1] - segments[:, 0]
    length = np.hypot(*along.T)
    chosen = np.flatnonzero(candidates & (length > TREAD_LENGTH[0]) & (length < TREAD_LENGTH[1]))
    treads = np.zeros(len(segments), dtype=bool)
    if len(chosen) < FEWEST_TREADS:
        return treads, []
    middle, course = segments[chosen].mean(axis=1), along[chosen] / length[chosen, None]
    i, j = KDTree(middle).query_pairs(TREAD_SPACING[1], output_type="ndarray").T
    apart = middle[j] - middle[i]
    parallel = np.abs(np.sum(course[i] * course[j], axis=1)) > np.cos(np.radians(2.0))
    beside = np.abs(np.sum(apart * course[i], axis=1)) < TREAD_TOLERANCE
    equal = np.abs(length[chosen[i]] - length[chosen[j]]) < TREAD_TOLERANCE
    near = parallel & beside & equal & (np.hypot(*apart.T) > TREAD_SPACING[0])
    joined = coo_array((np.ones(near.sum()), (i[near], j[near])), shape=(len(chosen), len(chosen)))
    flight = connected_components(joined, directed=False)[1]
    steps = []
    for n in np.flatnonzero(np.bincount(flight) >= FEWEST_TREADS):
        which = chosen[flight == n]
        treads[which] = True
        steps.append(shapely.convex_hull(shapely.multipoints(segments[which].reshape(-1, 2))))
    return treads, steps


WALL_LINES, DOOR_LINES, STAIR_LINES, IGNORED, UNCLEAR = "walls", "doors", "stairs", "ignored", "unknown"
# Parts of names, the first that fits decides: "A-WALL", "A-DOOR", "I-FURN" of the AIA; German, French, Spanish, Italian
LAYER_NAMES = (
    (IGNORED, r"text|txt|anno|label|dim\b|dims|dimen|bema|maß|cota|cote|quota|grid|axis|achse|raster|hatch|schraff"),
    (IGNORED, r"furn|möbel|moebel|mobel|mobil|equip|einricht|elec|elektr|light|lamp|plumb|sanit|hvac|heiz|duct|pipe"),
    (IGNORED, r"title|border|frame|rahmen|viewport|defpoints|logo|legend|north|symb|area|room.?name|tree|baum|topo"),
    (DOOR_LINES, r"door|tür|tuer|\btur\b|porte|puerta|\bporta|drzwi|deur"),
    (STAIR_LINES, r"stair|trepp|escal|\bscal|step|stufe|ramp|rolltr"),
    (WALL_LINES, r"wall|wand|wänd|waend|mauer|\bmur|muro|parede|pared|column|\bcol\b|stütz|stuetz|säule|pillar|colonn"),
    (
        WALL_LINES,
        r"window|fenster|fenetre|fenêtre|ventana|finestra|glaz|glas|facade|fassade|railing|gelaender|geländer|core",
    ),
)


def holds(name: str) -> str:
    """What a layer or a block of this name holds: WALL_LINES, DOOR_LINES, STAIR_LINES, IGNORED or UNCLEAR."""
    for kind, pattern in LAYER_NAMES:
        if re.search(pattern, name.casefold()):
            return kind
    return UNCLEAR


UNITS = {"metres": 1.0, "millimetres": 0.001, "centimetres": 0.01, "feet": 0.3048, "inches": 0.0254}  # [m]
LIKELY = (10.0, 300.0)  # [m] longer side of most buildings, for guesses alone
POSSIBLE = (2.5, 3000.0)  # [m] longer side of a plan: a small room, more than the largest terminal
WIDTHS = (0.2, 500.0)  # [m] typical width of the walkable area: a body is 0.5 m wide, the widest halls have 400 m
ACCEPTED_SCALES = (1e-9, 1e9)  # [m] per unit that --scale may state


def metres_per_unit(path: Path, points: Array, scale: float | None, noun: str, stated: float | None = None) -> float:
    """The scale of a drawing [m/unit]: `scale`, else the one that the file states.

    points: the drawing's corners ``(n, 2)`` [unit]; noun: of what it has, "517 segments". Raises InputError without a
    scale, or if no building has the drawing's size in it; the text guesses the unit.
    """
    width, height = np.ptp(points, axis=0).tolist()
    side = max(width, height)
    likely = [(unit, metres) for unit, metres in UNITS.items() if LIKELY[0] <= side * metres <= LIKELY[1]][:2]
    if scale is None and stated is None:
        found = f"{noun}, {width:.4g} by {height:.4g} units, unit not stated"
        guesses = [f"--scale {metres:g} if drawn in {unit}: {side * metres:.0f} m" for unit, metres in likely]
        expected = "--scale METRES_PER_UNIT, or a plan of pdr-graph map convert"
        raise InputError(path, "", found, f"{expected} ({' or '.join(guesses)})" if guesses else expected)
    metres = stated if scale is None else scale
    assert metres is not None
    if not ACCEPTED_SCALES[0] <= metres <= ACCEPTED_SCALES[1]:
        raise InputError("--scale" if scale is not None else path, "", f"{metres:g}", "metres per unit, above 0")
    if not POSSIBLE[0] <= metres * side <= POSSIBLE[1]:
        found = f"a building of {metres * width:.3g} by {metres * height:.3g} m with {metres:g} m per unit"
        expected = f"one of {POSSIBLE[0]:g} to {POSSIBLE[1]:g} m"
        for unit, meant in likely[:1]:
            ratio = metres / meant
            times = f"{ratio:.4g} times too large" if ratio > 1 else f"{1 / ratio:.4g} times too small"
            expected += f" ({times}: {unit}? --scale {meant:g})"
        raise InputError(path, "", found, expected)
    return metres


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
