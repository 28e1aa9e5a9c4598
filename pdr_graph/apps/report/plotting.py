"""Figures of plans and walks."""

from __future__ import annotations

import io
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import shapely
from matplotlib import rc_context
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PatchCollection
from matplotlib.figure import Figure
from matplotlib.legend_handler import HandlerPolyCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, PathPatch
from matplotlib.path import Path

from pdr_graph.apps.report.page import (
    BAND,
    BORDER,
    CELLS,
    EDGES,
    OPENING,
    OTHER,
    OUTDOORS,
    RADIO,
    ROOM,
    SOLID_FILL,
    STAIRS_COLOUR,
    SURROUNDINGS,
    TRUTH,
    WALKABLE_COLOUR,
)
from pdr_graph.errors import expect, printable
from pdr_graph.floor.building import Building
from pdr_graph.floor.cells import BEACON, CLOSED, LINK, OPEN, SOLID
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.geometry import confidence_band, interpolate, nearest
from pdr_graph.notebook_html import BLUE, GREY, RED
from pdr_graph.types import Array, Estimate, Trajectory

MANY = 50  # points above which marks are smaller, so that the track stays visible
REJECTED = 0.1  # weight below which a fix counts as rejected
LONGEST_SIDE, SHORTEST_SIDE = 8.0, 4.0  # [inch]


def plot(
    estimate: Estimate, floor: FloorPlan | Building | None = None, truth: Trajectory | None = None, title: str = ""
) -> Figure:
    """Draw a walk: dead reckoning in grey, the estimate with its 95 % region, other routes, fixes by weight.

    floor: the plan, drawn below; truth: drawn on top; title: above the picture. Returns a `matplotlib.figure.Figure`;
    a walk over several floors of a building has axes for each, the lowest at the lower left.
    """
    expect("plot, estimate", estimate, Estimate, instead="smooth(graph)")
    expect("plot, floor", floor, FloorPlan, Building, None, instead="FloorPlan.load(path)")
    expect("plot, truth", truth, Trajectory, None, instead="read_trajectory(path, recording)")
    track, grey = estimate.trajectory.position, estimate.dead_reckoning.position
    surveyed = track if truth is None else truth.position
    close = 0.5 * np.ptp(track, axis=0).max()
    near = [(f.x, f.y) for f in estimate.fixes if f.residual < close]
    others = [route.position for _, route in estimate.routes[1:]]
    shown = np.concatenate([track, grey, surveyed, *others, np.reshape(near, (-1, 2))])
    floors = _visited(floor, estimate.trajectory)
    figure, canvases = _canvas(shown, SURROUNDINGS, 1.05, max(1, len(floors)))
    for n, axes in enumerate(canvases):
        if floors:
            draw_plan(axes, floors[n])
        several = len(floors) > 1
        _draw_walk(axes, estimate, truth, floors[n].label if several else None)
        _title(axes, f"{floors[n].label}   {title}" if several else title)
        _draw_scale(axes)
    _draw_legend(figure, canvases)
    return figure


def _draw_legend(figure: Figure, canvases: Sequence[Axes]) -> None:
    """Name the marks of all axes below them, each once."""
    columns = max(2, int(figure.get_figwidth() / 1.9))
    handlers: Any = {PatchCollection: HandlerPolyCollection()}  # which matplotlib knows from 3.11 on
    marks = [zip(*axes.get_legend_handles_labels(handlers), strict=True) for axes in canvases]
    named = {text: mark for of_axes in marks for mark, text in of_axes}
    style: Any = {"loc": "lower center", "ncols": columns, "frameon": False, "fontsize": 9}
    figure.legend(named.values(), named.keys(), handler_map=handlers, **style)


def _draw_scale(axes: Axes) -> None:
    """Draw a bar of 1, 2, 5, 10 … m, the longest that is not above a fifth of the axes."""
    (west, east), (south, north) = axes.get_xlim(), axes.get_ylim()
    most = (east - west) / 5
    power = 10.0 ** np.floor(np.log10(most))
    length = power * max(times for times in (1, 2, 5) if times * power <= most)
    x, y = west + 0.03 * (east - west), south + 0.03 * (north - south)
    axes.plot([x, x + length], [y, y], color=TRUTH, lw=2, solid_capstyle="butt", zorder=9)
    text = f"{length:g} m" if length < 1000 else f"{length / 1000:g} km"
    axes.annotate(text, (x, y), (0, 3), textcoords="offset points", fontsize=8, zorder=9)


def _visited(floor: FloorPlan | Building | None, track: Trajectory) -> tuple[FloorPlan, ...]:
    """The floors of a walk, the lowest first; the lowest of the building if none is known."""
    if floor is None:
        return ()
    floors = Building.around(floor).floors
    return tuple(f for f in floors if f.label in track.floor) or floors[:1]


def _draw_walk(axes: Axes, estimate: Estimate, truth: Trajectory | None, label: str | None) -> None:
    """Draw the part of a walk on the floor with this label; all of it without a label."""
    track = _on(estimate.trajectory, label)
    if estimate.dead_reckoning is not estimate.trajectory:
        reckoned, dashes = _on(estimate.dead_reckoning, label), (0, (4, 2))
        axes.plot(*reckoned.T, color=GREY, lw=1.2, ls=dashes, label="dead reckoning, rigidly aligned", zorder=3)
    draw_uncertainty(axes, estimate.trajectory, label)
    for number, (probability, route) in enumerate(estimate.routes[1:]):
        named = "other routes, with probability" if number == 0 else None
        path = _on(route, label)
        axes.plot(*path.T, color=OTHER, lw=1.2, alpha=0.8, label=named, zorder=4)
        axes.annotate(f"{probability:.0%}", path[-1], color=OTHER, fontsize=8, zorder=4, clip_on=True)
    axes.plot(*track.T, color=BLUE, lw=2.2, label=_name_of(estimate), zorder=5, solid_joinstyle="round")
    axes.plot(*track[0], marker="o", ms=8, mfc="white", mec=BLUE, mew=2, ls="none", zorder=7, label="start")
    axes.plot(*track[-1], marker="s", ms=8, mfc=BLUE, mec="white", mew=1, ls="none", zorder=7, label="end")
    if truth is not None:
        few = len(truth) <= MANY
        name = "surveyed points" if few else "true path"
        axes.plot(*_on(truth, label).T, label=name, zorder=8 if few else 6, **_truth_style(truth))
    _draw_fixes(axes, estimate, label)
    if label in (None, estimate.trajectory.floor[0]):
        _draw_beacons(axes, estimate)


def _name_of(estimate: Estimate) -> str:
    """The name of the track, by what determined it."""
    if estimate.dead_reckoning is estimate.trajectory:
        return "smoothed positions"
    if len(estimate.fixes) > 1 and np.isnan(estimate.probability) and sum(f.weight > 0 for f in estimate.fixes) <= 1:
        return "dead reckoning from the first fix"
    measured = bool(estimate.routes) or any(estimate.reports.values())
    return "most probable walk" if measured else "walk by its steps alone"


def _truth_style(truth: Trajectory) -> dict[str, Any]:
    """Crosses for a few surveyed points, a line for a path."""
    few = len(truth) <= MANY
    return {"color": TRUTH} | ({"marker": "x", "ms": 7, "mew": 1.6, "ls": "none"} if few else {"lw": 1.0})


def _on(track: Trajectory, label: str | None) -> Array:
    """Positions ``(n, 2)`` [m], NaN where the walk is on another floor."""
    elsewhere = np.array([label is not None and floor not in ("", label) for floor in track.floor], dtype=bool)
    return np.where(elsewhere[:, None], np.nan, track.position)


def picture_bytes(figure: Figure, dpi: float = 120, file_format: str = "png") -> bytes:
    """A figure as PNG or SVG; letters that no font has are drawn as boxes in a PNG."""
    content = io.BytesIO()
    with warnings.catch_warnings(), rc_context({"svg.fonttype": "none", "svg.hashsalt": "pdr_graph"}):
        warnings.filterwarnings("ignore", "Glyph")
        about = {"Date": None, "Creator": None} if file_format == "svg" else None
        figure.savefig(content, format=file_format, dpi=dpi, metadata=about)
    return content.getvalue()


CYCLE = ("#1f5fbf", "#d1602b", "#2a9d6f", "#b0458a", "#c9a227", "#7b4fa6", "#5b5b5b", "#36a9c9")  # of trajectories


def plot_comparison(
    tracks: Mapping[str, Trajectory], truth: Trajectory | None = None, floor: Building | None = None
) -> Figure:
    """Draw several trajectories of one walk on the plan, and the truth if there is one."""
    shown = np.concatenate([t.position for t in (*tracks.values(), *([] if truth is None else [truth]))])
    first = next(iter(tracks.values()))
    floors = _visited(floor, first if truth is None or not any(truth.floor) else truth)
    figure, canvases = _canvas(shown, SURROUNDINGS, 1.05, max(1, len(floors)))
    for n, axes in enumerate(canvases):
        if floors:
            draw_plan(axes, floors[n])
        label = floors[n].label if len(floors) > 1 else None
        for number, (name, track) in enumerate(tracks.items()):
            style: dict[str, Any] = {"color": CYCLE[number % len(CYCLE)], "lw": 1.8, "label": printable(name)}
            axes.plot(*_on(track, label).T, ls=LINE_STYLES[number % len(LINE_STYLES)], zorder=5, **style)
        if truth is not None:
            axes.plot(*_on(truth, label).T, label="truth", zorder=8, **_truth_style(truth))
        _title(axes, label or "")
        _draw_scale(axes)
    _draw_legend(figure, canvases)
    return figure


LINE_STYLES = ("-", (0, (5, 1)), (0, (3, 1, 1, 1)), (0, (1, 1)))  # styles, so that grey prints differ too


def plot_plan(*floors: FloorPlan) -> Figure:
    """Draw all floors, the lowest at the lower left: walkable and solid areas."""
    figure, canvases = _canvas(
        np.concatenate([floor.corners for floor in floors]), around=0.02, bottom=0.6, count=len(floors)
    )
    for axes, floor in zip(canvases, floors, strict=True):
        draw_plan(axes, floor)
        _title(axes, f"{floor.label}   walkable {floor.walkable_area:.0f} m²")
    return figure


def plot_conversion(ignored: shapely.Geometry, *floors: FloorPlan) -> Figure:
    """Draw what was understood of a plan, floor by floor: kinds of areas, and in red the lines that were ignored."""
    corners = np.concatenate([floor.corners for floor in floors])
    figure, canvases = _canvas(corners, around=0.02, bottom=0.9, count=len(floors))
    for axes, floor in zip(canvases, floors, strict=True):
        draw_plan(axes, floor)
        _title(axes, f"{floor.label}   walkable {floor.walkable_area:.0f} m²")
    _lines(canvases[0], ignored, color=RED, lw=0.8, ls="--", zorder=2.6)
    fills = {
        "corridor, free space": WALKABLE_COLOUR,
        "room, lift": ROOM,
        "door": OPENING,
        "stairs": STAIRS_COLOUR,
        "solid": SOLID_FILL,
    }
    marks: list[Artist] = [Patch(facecolor=colour, edgecolor=EDGES, label=name) for name, colour in fills.items()]
    marks += [Line2D([], [], color=EDGES, lw=0.9, label="wall"), Line2D([], [], color=RED, ls="--", label="ignored")]
    figure.legend(handles=marks, loc="lower center", ncols=4, frameon=False, fontsize=8)
    return figure


def draw_plan(axes: Axes, floor: FloorPlan) -> None:
    """Draw the walkable and solid areas of a plan [m], with the names that fit."""
    solid = [area for area in floor.of_kind(*SOLID) if area.is_polygon]
    drawn = [area for area in floor.areas if area.is_polygon and area.kind != LINK]
    axes.set_facecolor(OUTDOORS)
    axes.add_collection(_patches(shapely.union_all([a.shape for a in drawn]), facecolor=SOLID_FILL, lw=0, zorder=1))
    borders = shapely.geometrycollections([area.shape for area in solid])
    axes.add_collection(_patches(borders, facecolor="none", edgecolor=BORDER, lw=0.4, zorder=1))
    axes.add_collection(_patches(floor.walkable, facecolor=WALKABLE_COLOUR, edgecolor=EDGES, lw=0.5, zorder=2))
    for kinds, colour in CELLS:
        cells = shapely.geometrycollections([c.polygon for c in floor.cells.cells if c.kind in kinds])
        axes.add_collection(_patches(cells, facecolor=colour, lw=0, zorder=2.1))
    _lines(axes, floor.cells.barriers, color=EDGES, lw=0.7, zorder=2.2)
    _lines(axes, shapely.union_all([a.shape for a in floor.of_kind(LINK)]), color=BORDER, lw=0.5, ls=":", zorder=2.3)
    for beacon in floor.of_kind(BEACON):
        axes.plot(*shapely.get_coordinates(beacon.shape)[:1].T, marker="^", ms=5, color=RED, ls="none", zorder=2.4)
    for area in (*solid, *floor.of_kind(*CLOSED, *OPEN)):
        if area.name.isascii() and area.name.isprintable() and area.is_polygon:
            _name(axes, area.name, area.shape)


def _title(axes: Axes, text: str) -> None:
    """Write a text above the axes, in which names of files and floors mean nothing to matplotlib."""
    axes.set_title(printable(text), loc="left", fontsize=10, parse_math=False)


def _lines(axes: Axes, geometry: shapely.Geometry, **style: Any) -> None:
    """Draw lines as one collection."""
    parts = [shapely.get_coordinates(p) for p in shapely.get_parts(geometry) if shapely.get_dimensions(p) == 1]
    axes.add_collection(LineCollection(parts, **style))


def _patches(geometry: shapely.Geometry, **style: object) -> PatchCollection:
    """Polygons with holes as one collection."""
    patches = []
    for polygon in shapely.get_parts(shapely.get_parts(geometry)):
        if shapely.get_dimensions(polygon) == 2:
            rings = [shapely.get_coordinates(r) for r in shapely.get_rings(polygon)]
            patches.append(PathPatch(Path.make_compound_path(*(Path(r, closed=True) for r in rings))))
    return PatchCollection(patches, match_original=False, **style)


def _name(axes: Axes, name: str, polygon: shapely.Geometry) -> None:
    """Write a name into the visible part of its polygon, if it fits."""
    (west, east), (south, north) = axes.get_xlim(), axes.get_ylim()
    shown = shapely.intersection(polygon, shapely.box(west, south, east, north))
    letter = 0.06 * (east - west) / LONGEST_SIDE  # [m] wide, at 6 points
    x0, y0, x1, y1 = shapely.bounds(shown)
    if shapely.area(shown) > 0 and len(name) * letter < x1 - x0 and 2 * letter < y1 - y0:
        place = shapely.point_on_surface(shown)
        x, y = shapely.get_x(place), shapely.get_y(place)
        style: dict[str, Any] = {"fontsize": 6, "color": "#6b655b", "zorder": 2.5, "parse_math": False}
        axes.annotate(name, (x, y), ha="center", va="center", **style)


def draw_uncertainty(axes: Axes, trajectory: Trajectory, label: str | None) -> None:
    """Draw the union of the 95 % ellipses of the steps."""
    region = shapely.union_all(confidence_band(trajectory, np.isfinite(_on(trajectory, label)[:, 0])))
    named = {"label": "95 % region"} if shapely.area(region) > 0 else {}
    axes.add_collection(_patches(region, facecolor=BAND, edgecolor="none", alpha=0.3, zorder=4, **named))


def _draw_fixes(axes: Axes, estimate: Estimate, label: str | None) -> None:
    """Draw fixes, paler with less weight, each with a line to the walk at its time."""
    if not estimate.fixes:
        return
    track, time = estimate.trajectory, np.array([f.time for f in estimate.fixes])
    here = np.isfinite(_on(track, label)[nearest(track.time, time), 0])
    place = np.array([(f.x, f.y) for f in estimate.fixes])[here]
    weight = np.array([f.weight for f in estimate.fixes])[here]
    at = interpolate(time[here], track.time, track.position)
    if not len(place):
        return
    share = min(1.0, MANY / len(place))
    gaps = list(np.stack([place, at], axis=1))
    axes.add_collection(LineCollection(gaps, color=RED, lw=0.3 + 0.5 * share, alpha=0.15 + 0.45 * share, zorder=4.5))
    faces = [(0.82, 0.38, 0.17, 0.15 + 0.85 * w) for w in weight]
    size = max(42 * share, 5)
    axes.scatter(*place.T, s=size, c=faces, edgecolors=RED, linewidths=1.2, zorder=4.5)
    name = "fix" + ("" if weight.min() > REJECTED else " (hollow: rejected)")
    style: dict[str, Any] = {"color": RED, "lw": 0.8, "marker": "o", "ms": size**0.5, "label": name}
    axes.plot([], [], **style)


def _draw_beacons(axes: Axes, estimate: Estimate) -> None:
    """Draw the estimated positions of the beacons with their names, misplaced ones in another colour."""
    for colour, moved, label in ((RADIO, False, "beacons"), (RED, True, "misplaced beacons")):
        group = [b for b in estimate.beacons if b.misplaced == moved]
        if group:
            place = np.array([(b.x, b.y) for b in group])
            axes.scatter(
                *place.T, s=46, marker="D", c="white", edgecolors=colour, linewidths=1.4, zorder=4.6, label=label
            )
            for b in group:
                style: dict[str, Any] = {"fontsize": 7, "color": colour, "parse_math": False}
                axes.annotate(printable(b.label), (b.x, b.y), (5, 5), textcoords="offset points", **style)


def _canvas(points: Array, around: float, bottom: float, count: int = 1) -> tuple[Figure, list[Axes]]:
    """A figure with ``count`` axes of equal scale that show points ``(n, 2)`` [m] and their surroundings.

    Axes fill rows from the lower left. around: margin as a share of the size; bottom: space for labels and legend
    [inch]. pyplot is not used: it is slow to import and keeps all figures in memory.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    shown = high - low + 2 * max(2.0, around * float(np.max(high - low)))
    scale = LONGEST_SIDE / float(shown.max())  # [inch/m]
    shown = np.maximum(shown, SHORTEST_SIDE / scale)
    left, right, top = 0.85, 0.15, 0.35  # [inch]
    each, high_up = shown * scale + (left + right, bottom + top)
    columns = min(count, max(1, round(np.sqrt(count * high_up / each))))
    rows = -(-count // columns)
    figure = Figure(figsize=(columns * each, rows * high_up))
    FigureCanvasAgg(figure)
    (west, south), (east, north) = (low + high - shown) / 2, (low + high + shown) / 2
    canvases = []
    for n in range(count):
        row, column = divmod(n, columns)
        place = (
            (column + left / each) / columns,
            (row + bottom / high_up) / rows,
            shown[0] * scale / each / columns,
            shown[1] * scale / high_up / rows,
        )
        axes = figure.add_axes(place)
        axes.set(xlim=(west, east), ylim=(south, north), aspect="equal")
        axes.set_xlabel("x [m]")
        axes.set_ylabel("y [m]")
        axes.tick_params(labelsize=8)
        axes.locator_params(nbins=7)
        axes.ticklabel_format(useOffset=False, style="plain")
        canvases.append(axes)
    return figure, canvases
