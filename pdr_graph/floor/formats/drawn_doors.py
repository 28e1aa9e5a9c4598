"""Doors in drawings of lines: swing arcs with their leaf, leaves drawn closed, and symbols on a layer of doors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import KDTree

from pdr_graph.columns import OneLineRepr
from pdr_graph.geometry import wrap_angle
from pdr_graph.types import Array, Index, Mask

NARROWEST, WIDEST = 0.55, 1.5  # [m] a leaf of a door: 0.6 to 1.2, and what was drawn inaccurately
WIDEST_OPENING = 3.0  # [m] a door of two leaves
TOUCH = 0.08  # [m] two ends so close were meant to touch; the thickness of a leaf drawn as a rectangle
LONGEST_CHORD = 0.5  # [m] of an arc: a quarter of 1.5 m in five chords
FEWEST_CHORDS = 3
BENDS = np.radians([0.5, 40.0])  # [rad] between two chords of an arc
SWEEPS = np.radians([40.0, 130.0])  # [rad] of a swing, 90° as a rule, on drawings also 45°
ROUNDNESS = 0.04  # deviation from the circle as a share of the radius
JAMB = (0.04, 0.6)  # [m] thickness of a wall
SQUARE = np.cos(np.radians(80.0))  # largest cosine between a leaf and its jambs


@dataclass(frozen=True)
class Arc(OneLineRepr):
    """The swing of a door. centre: the hinge ``(2,)``; points: along the arc ``(n, 2)`` [m]."""

    centre: Array
    points: Array

    def _summary(self) -> list[str]:
        return [f"{np.hypot(*(self.points[0] - self.centre)):.2f} m about {self.centre.round(2).tolist()}"]


def lines_of(segments: Array) -> NDArray[np.object_]:
    """The lines of segments ``(n, 2, 2)``."""
    return np.asarray(shapely.linestrings(segments), dtype=object).reshape(-1)


def swing_doors(segments: Array, candidates: Mask) -> tuple[list[shapely.Geometry], Mask]:
    """Doors drawn as an arc with a leaf: the lines across their openings, and which segments are their drawing.

    segments: ``(n, 2, 2)`` [m]; candidates: ``(n,)`` False for segments that are no part of a door's drawing.
    """
    drawing = np.zeros(len(segments), dtype=bool)
    arcs = _arcs(segments[candidates])
    if not arcs:
        return [], drawing
    lines = lines_of(segments)
    shapes = shapely.union_all([shapely.buffer(shapely.LineString(arc.points), TOUCH / 4) for arc in arcs])
    drawing |= candidates & shapely.covers(shapes, lines)
    tree, doors = shapely.STRtree(lines), []
    for arc in arcs:
        near = tree.query(shapely.LineString(arc.points), predicate="dwithin", distance=WIDEST)
        opening, leaf = _opening(arc, shapely.union_all(lines[near[~drawing[near]]]))
        doors.append(opening)
        along = near[shapely.covers(shapely.buffer(leaf, TOUCH), lines[near])]
        drawing[along] |= candidates[along]
    return doors, drawing


def _opening(arc: Arc, walls: shapely.Geometry) -> tuple[shapely.Geometry, shapely.Geometry]:
    """The line across a door's opening, and that of its open leaf: a wall goes on only where the opening ends."""
    sides = [shapely.LineString([arc.centre, end]) for end in arc.points[[0, -1]]]
    costs = []
    for side, end in zip(sides, arc.points[[0, -1]], strict=True):
        beyond = shapely.difference(walls, shapely.buffer(side, TOUCH))
        covered = shapely.length(shapely.intersection(side, shapely.buffer(walls, TOUCH / 2))) / shapely.length(side)
        gap = shapely.distance(beyond, shapely.Point(end)) if not shapely.is_empty(beyond) else WIDEST
        costs.append(float(gap) + TOUCH * float(covered))
    return (sides[0], sides[1]) if costs[0] <= costs[1] else (sides[1], sides[0])


def _arcs(segments: Array) -> list[Arc]:
    """Arcs in a drawing: chains of short segments that bend alike along a circle of a door's size."""
    short = segments[np.hypot(*(segments[:, 1] - segments[:, 0]).T) < LONGEST_CHORD]
    if len(short) < FEWEST_CHORDS:
        return []
    lines = shapely.union_all(shapely.set_precision(shapely.linestrings(short), 0.002))
    chains = [shapely.get_coordinates(c) for c in shapely.get_parts(shapely.line_merge(lines))]
    found = [_fitted(part) for chain in chains for part in _bending_alike(chain)]
    return [arc for arc in found if arc is not None]


def _bending_alike(chain: Array) -> list[Array]:
    """The parts of a chain ``(n, 2)`` whose bends are small and of one sign."""
    course = np.arctan2(*np.diff(chain, axis=0).T[::-1])
    bend = wrap_angle(np.diff(course))
    sign = np.where((np.abs(bend) > BENDS[0]) & (np.abs(bend) < BENDS[1]), np.sign(bend), 0.0)
    cuts = np.flatnonzero((sign[1:] != sign[:-1]) | (sign[1:] == 0)) + 1
    return [
        chain[part[0] : part[-1] + 3]
        for part in np.split(np.arange(len(bend)), cuts)
        if len(part) + 1 >= FEWEST_CHORDS and sign[part[0]]
    ]


def _fitted(points: Array) -> Arc | None:
    """The swing through points ``(n, 2)``; None if they are no arc of a door's size."""
    middle = points.mean(axis=0)
    x, y = (points - middle).T
    design = np.stack([2 * x, 2 * y, np.ones(len(x))], axis=1)
    solution = np.linalg.lstsq(design, x**2 + y**2, rcond=None)[0]
    radius = float(np.sqrt(max(0.0, solution[2] + solution[0] ** 2 + solution[1] ** 2)))
    if not NARROWEST <= radius <= WIDEST:
        return None
    centre = middle + solution[:2]
    away = points - centre
    sweep = abs(float(wrap_angle(np.diff(np.arctan2(away[[0, -1], 1], away[[0, -1], 0])))[0]))
    round_ = np.abs(np.hypot(*away.T) - radius).max() < ROUNDNESS * radius
    return Arc(centre, points) if round_ and SWEEPS[0] <= sweep <= SWEEPS[1] else None


def closed_doors(segments: Array) -> list[shapely.Geometry]:
    """Doors drawn as one closed line between two jambs, which are the ends of a wall drawn as two lines.

    Any other segment of that length stays a wall: it cannot be told from one. segments: ``(n, 2, 2)`` [m].
    """
    along = segments[:, 1] - segments[:, 0]
    length = np.hypot(*along.T)
    leaves = np.flatnonzero((length >= NARROWEST) & (length <= WIDEST))
    jambs = np.flatnonzero((length >= JAMB[0]) & (length <= JAMB[1]))
    if not len(leaves) or not len(jambs):
        return []
    course, ends = along / np.maximum(length, 1e-9)[:, None], KDTree(segments.reshape(-1, 2))
    tree = shapely.STRtree(lines_of(segments))
    doors = []
    for n in leaves.tolist():
        leaf = segments[n]
        ways = [
            _ends_wall(segments, course, ends, jambs, tree, leaf[i], -course[n] if i == 0 else course[n])
            for i in (0, 1)
        ]
        if all(ways) and not _is_backed(tree, leaf):
            doors.append(shapely.LineString(leaf))
    return doors


def _ends_wall(
    segments: Array, course: Array, ends: KDTree, jambs: Index, tree: shapely.STRtree, end: Array, outward: Array
) -> bool:
    """True if a leaf's end ``(2,)`` lies on a jamb from whose both ends a wall goes on along `outward (2,)`."""
    near = np.intersect1d(tree.query(shapely.Point(end), predicate="dwithin", distance=TOUCH / 2), jambs)
    for jamb in near[np.abs(course[near] @ outward) < SQUARE].tolist():
        faces = 0
        for corner in segments[jamb]:
            touching = np.array(ends.query_ball_point(corner, TOUCH / 2), dtype=np.intp)
            others, which = np.divmod(touching, 2)
            leaving = course[others] * np.where(which == 0, 1.0, -1.0)[:, None]
            faces += bool((leaving @ outward > 1 - SQUARE**2).any())
        if faces == 2:
            return True
    return False


def _is_backed(tree: shapely.STRtree, leaf: Array) -> bool:
    """True if a line lies behind the middle of a leaf ``(2, 2)``: a niche, or a wall drawn as two lines."""
    middle = shapely.LineString([0.6 * leaf[0] + 0.4 * leaf[1], 0.4 * leaf[0] + 0.6 * leaf[1]])
    near = tree.geometries[tree.query(middle, predicate="dwithin", distance=NARROWEST / 2)]
    return bool((shapely.distance(near, middle) > TOUCH).any())


def symbol_doors(symbols: Array, walls: Array) -> list[shapely.Geometry]:
    """The lines across the openings of doors on a layer of doors: one for each connected symbol.

    symbols: segments of the symbols ``(n, 2, 2)``; walls: all other segments ``(m, 2, 2)`` [m].
    """
    if not len(symbols):
        return []
    all_walls = shapely.union_all(shapely.linestrings(walls)) if len(walls) else shapely.LineString()
    doors = []
    for part in shapely.get_parts(shapely.union_all(shapely.buffer(shapely.linestrings(symbols), TOUCH / 2))):
        within = symbols[shapely.covers(part, shapely.linestrings(symbols))]
        arcs = _arcs(within)
        if arcs:
            near = shapely.intersection(all_walls, shapely.buffer(part, WIDEST))
            doors += [_opening(arc, near)[0] for arc in arcs]
        else:
            doors += _straight_symbol(part, all_walls)
    return doors


def _straight_symbol(part: shapely.Geometry, walls: shapely.Geometry) -> list[shapely.Geometry]:
    """The side or the middle line of a symbol's rectangle whose ends lie nearest to walls; none if that is no door."""
    corners = shapely.get_coordinates(shapely.minimum_rotated_rectangle(part))
    if len(corners) < 5:
        return []
    middles = (corners[:-1] + corners[1:]) / 2
    lines = [shapely.LineString(pair) for pair in (middles[[0, 2]], middles[[1, 3]])]
    lines += [shapely.LineString(corners[n : n + 2]) for n in range(4)]
    lines = [line for line in lines if NARROWEST <= shapely.length(line) <= WIDEST_OPENING]
    if not lines:
        return []
    ends = [shapely.points(shapely.get_coordinates(line)) for line in lines]
    return [lines[int(np.argmin([shapely.distance(walls, pair).sum() for pair in ends]))]]
