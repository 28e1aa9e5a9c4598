"""Figures of plans and walks."""

from __future__ import annotations

import io
import warnings
from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any

import numpy as np
import shapely
from matplotlib import rc_context
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PatchCollection
from matplotlib.colors import to_rgba_array
from matplotlib.figure import Figure
from matplotlib.legend_handler import HandlerPolyCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, PathPatch
from matplotlib.path import Path
from matplotlib.patheffects import Normal, Stroke

from pdr_graph.apps.report.page import (
    BAND,
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
    plan_layers,
    region,
)
from pdr_graph.errors import expect, printable
from pdr_graph.floor.building import Building
from pdr_graph.floor.cells import BEACON, CLOSED, OPEN, SOLID
from pdr_graph.floor.paths import PathNetwork
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.geometry import interpolate, nearest
from pdr_graph.notebook_html import BLUE, GREY, RED
from pdr_graph.priors import REPORTS
from pdr_graph.types import Array, Estimate, Mask, Trajectory

MANY = 50  # points above which marks are smaller, so that the track stays visible
LONGEST_SIDE, SHORTEST_SIDE = 8.0, 4.0  # [inch]
STYLE: Any = {  # of all figures; names of files and floors mean nothing to matplotlib
    "font.size": 8,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.formatter.useoffset": False,
    "axes.formatter.limits": (-9, 9),
    "legend.frameon": False,
    "legend.fontsize": 9,
    "legend.loc": "lower center",
    "text.parse_math": False,
}
HALO = [Stroke(linewidth=2.2, foreground="white", alpha=0.85), Normal()]


@rc_context(STYLE)
def plot(
    estimate: Estimate,
    floor: FloorPlan | Building | None = None,
    truth: Trajectory | None = None,
    title: str = "",
    paths: PathNetwork | None = None,
) -> Figure:
    """Draw a walk: dead reckoning in grey, the estimate with its 95 % region, other routes, fixes by weight.

    floor: the plan, drawn below, as are the ways ``paths``; truth: drawn on top; title: above the picture. Returns a
    `matplotlib.figure.Figure`; a walk over several floors of a building has axes for each, the lowest at the lower
    left.
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
        if paths is not None:
            _draw_ways(axes, paths)
        several = len(floors) > 1
        _draw_walk(axes, estimate, truth, floors[n].label if several else None, floors[n] if floors else None)
        axes.set_title(printable(f"{floors[n].label}   {title}" if several else title))
        draw_scale(axes)
    _draw_legend(figure, canvases)
    return figure


def _draw_legend(figure: Figure, canvases: Sequence[Axes]) -> None:
    """Name the marks of all axes below them, each once."""
    handlers: Any = {PatchCollection: HandlerPolyCollection()}  # which matplotlib knows from 3.11 on
    marks = [zip(*axes.get_legend_handles_labels(handlers), strict=True) for axes in canvases]
    named = {text: mark for of_axes in marks for mark, text in of_axes}
    columns = max(2, int(figure.get_figwidth() / 1.9))
    figure.legend(named.values(), named.keys(), handler_map=handlers, ncols=columns)


def draw_scale(axes: Axes) -> None:
    """Draw a bar of 1, 2, 5, 10 … m, the longest that is not above a fifth of the axes."""
    (west, east), (south, north) = axes.get_xlim(), axes.get_ylim()
    most = (east - west) / 5
    power = 10.0 ** np.floor(np.log10(most))
    length = power * max(times for times in (1, 2, 5) if times * power <= most)
    x, y = west + 0.03 * (east - west), south + 0.03 * (north - south)
    axes.plot([x, x + length], [y, y], color=TRUTH, lw=2.5, solid_capstyle="butt", zorder=9)
    text = f"{length:g} m" if length < 1000 else f"{length / 1000:g} km"
    style: dict[str, Any] = {"va": "center", "zorder": 9, "path_effects": HALO}
    axes.annotate(text, (x + length, y), (4, 0), textcoords="offset points", **style)


def _visited(floor: FloorPlan | Building | None, track: Trajectory) -> tuple[FloorPlan, ...]:
    """The floors of a walk, the lowest first; the lowest of the building if none is known."""
    if floor is None:
        return ()
    floors = Building.around(floor).floors
    return tuple(f for f in floors if f.label in track.floor) or floors[:1]


def _draw_walk(
    axes: Axes, estimate: Estimate, truth: Trajectory | None, label: str | None, floor: FloorPlan | None
) -> None:
    """Draw the part of a walk on the floor with this label; all of it without a label."""
    track = _on(estimate.trajectory, label)
    if estimate.dead_reckoning is not estimate.trajectory:
        reckoned = _on(estimate.dead_reckoning, label)
        axes.plot(*reckoned.T, color=GREY, lw=1.2, ls="--", label="dead reckoning, rigidly aligned")
    draw_uncertainty(axes, estimate.trajectory, label, floor)
    for number, (probability, route) in enumerate(estimate.routes[1:]):
        named = "other routes, with probability" if number == 0 else None
        path = _on(route, label)
        axes.plot(*path.T, color=OTHER, lw=1.2, label=named)
        axes.annotate(f"{probability:.0%}", path[-1], color=OTHER, clip_on=True)
    _draw_fixes(axes, estimate, label)
    if label in (None, estimate.trajectory.floor[0]):
        _draw_beacons(axes, estimate)
        _draw_untimed(axes, estimate)
    axes.plot(*track.T, color=BLUE, lw=2.2, label=_name_of(estimate), solid_joinstyle="round")
    _draw_truth(axes, truth, label, "surveyed points", "true path")
    marks: dict[str, Any] = {"mec": BLUE, "mew": 1.5, "ls": "none", "zorder": 3}
    axes.plot(*track[0], marker="o", ms=8, mfc="white", label="start", **marks)
    axes.plot(*track[-1], marker="s", ms=7, mfc=BLUE, label="end", **marks)


def _name_of(estimate: Estimate) -> str:
    """The name of the track, by what determined it."""
    if estimate.dead_reckoning is estimate.trajectory:
        return "smoothed positions"
    if len(estimate.fixes) > 1 and estimate.calibration is None and sum(f.weight > 0 for f in estimate.fixes) <= 1:
        return "dead reckoning from the first fix"
    measured = bool(estimate.routes) or any(estimate.reports.values())
    return "most probable walk" if measured else "walk by its steps alone"


def _draw_truth(axes: Axes, truth: Trajectory | None, label: str | None, few: str, many: str) -> None:
    """Draw the truth: crosses for a few surveyed points, a line for a path. few, many: names of these."""
    if truth is not None:
        points = len(truth) <= MANY
        style: dict[str, Any] = {"marker": "x", "ms": 7, "mew": 1.6, "ls": "none"} if points else {"lw": 1.0}
        axes.plot(*_on(truth, label).T, color=TRUTH, label=few if points else many, **style)


def _on(track: Trajectory, label: str | None) -> Array:
    """Positions ``(n, 2)`` [m], NaN where the walk is on another floor."""
    elsewhere = np.array([label is not None and floor not in ("", label) for floor in track.floor], dtype=bool)
    return np.where(elsewhere[:, None], np.nan, track.position)


def picture_bytes(figure: Figure, dpi: float = 120) -> bytes:
    """A figure as PNG; letters that no font has are drawn as boxes."""
    content = io.BytesIO()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph")
        figure.savefig(content, format="png", dpi=dpi)
    return content.getvalue()


CYCLE = ("#1f5fbf", "#d1602b", "#2a9d6f", "#b0458a", "#c9a227", "#7b4fa6", "#5b5b5b", "#36a9c9")  # of trajectories
LINE_STYLES = ("-", "--", "-.", ":")  # styles, so that grey prints differ too


@rc_context(STYLE)
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
        for (name, track), colour, dashes in zip(tracks.items(), cycle(CYCLE), cycle(LINE_STYLES), strict=False):
            axes.plot(*_on(track, label).T, color=colour, ls=dashes, label=printable(name))
        _draw_truth(axes, truth, label, "truth", "truth")
        axes.set_title(printable(label or ""))
        draw_scale(axes)
    _draw_legend(figure, canvases)
    return figure


@rc_context(STYLE)
def plot_plan(*floors: FloorPlan, bottom: float = 0.6) -> Figure:
    """Draw all floors, the lowest at the lower left: walkable and solid areas. bottom: space below [inch]."""
    corners = np.concatenate([floor.corners for floor in floors])
    figure, canvases = _canvas(corners, around=0.02, bottom=bottom, count=len(floors))
    for axes, floor in zip(canvases, floors, strict=True):
        draw_plan(axes, floor)
        axes.set_title(printable(f"{floor.label}   walkable {floor.walkable_area:.0f} m²"))
    return figure


@rc_context(STYLE)
def plot_ways(paths: PathNetwork) -> Figure:
    """Draw ways on foot, as wide as their class is."""
    figure, (axes,) = _canvas(np.concatenate(paths.lines), around=0.02, bottom=0.6, count=1)
    _draw_ways(axes, paths)
    draw_scale(axes)
    axes.set_title(printable(repr(paths)))
    return figure


def _draw_ways(axes: Axes, paths: PathNetwork) -> None:
    """Draw ways below everything else: bands of their width, and lines that remain visible."""
    bands = [
        shapely.buffer(shapely.LineString(line), half, quad_segs=2)
        for line, half in zip(paths.lines, (paths.width / 2).tolist(), strict=True)
    ]
    _draw_shape(axes, shapely.GeometryCollection(bands), facecolor=WALKABLE_COLOUR, edgecolor="none")
    axes.add_collection(LineCollection(list(paths.lines), colors=EDGES, linewidths=0.6), autolim=False)


@rc_context(STYLE)
def plot_conversion(ignored: shapely.Geometry, *floors: FloorPlan) -> Figure:
    """Draw what was understood of a plan, floor by floor: kinds of areas, and in red the lines that were ignored."""
    figure = plot_plan(*floors, bottom=0.9)
    _draw_shape(figure.axes[0], ignored, edgecolor=RED, ls="--")
    fills = {
        "corridor, free space": WALKABLE_COLOUR,
        "room, lift": ROOM,
        "door": OPENING,
        "stairs": STAIRS_COLOUR,
        "solid": SOLID_FILL,
    }
    marks: list[Artist] = [Patch(facecolor=colour, edgecolor=EDGES, label=name) for name, colour in fills.items()]
    marks += [Line2D([], [], color=EDGES, label="wall"), Line2D([], [], color=RED, ls="--", label="ignored")]
    figure.legend(handles=marks, ncols=4)
    return figure


@rc_context(STYLE)
def plot_regions(regions: Sequence[tuple[Array, Array, Mask]], chosen: Sequence[tuple[float, float]]) -> Figure:
    """Draw the feasible region of (R_d, R_s) at each turn, and the chosen pair: [map-matching] Figs. 7, 8, 12.

    regions: R_d ``(d,)`` and R_s ``(s,)`` that were tried, evenly spaced, and True for feasible pairs ``(d, s)``. A
    dashed frame surrounds all pairs that were tried, each of which is drawn as a cell of their grid.
    """
    figure = Figure(figsize=(LONGEST_SIDE, 0.7 * LONGEST_SIDE), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot(xlabel="R_d, factor of heading changes", ylabel="R_s, factor of step lengths")
    turns = zip(regions, chosen, cycle(CYCLE), strict=False)
    for number, ((R_d, R_s, feasible), pair, colour) in enumerate(turns, start=1):
        label = f"turn {number}: {np.count_nonzero(feasible)} of {feasible.size} pairs feasible"
        tried = shapely.envelope(_cells_of(R_d, R_s, np.ones_like(feasible)))
        _draw_shape(axes, shapely.boundary(tried), edgecolor=colour, lw=0.8, ls="--")
        _draw_shape(axes, _cells_of(R_d, R_s, feasible), facecolor=colour, edgecolor=colour, lw=0.5, alpha=0.4)
        axes.plot(*pair, marker="o", ms=7, mfc=colour, mec="black", ls="none", label=label, zorder=5)
    axes.plot(1.0, 1.0, marker="+", ms=9, color=TRUTH, ls="none", label="no correction")
    axes.autoscale_view()
    figure.legend(loc="outside lower center", ncols=2)
    return figure


def _cells_of(R_d: Array, R_s: Array, mask: Mask) -> shapely.Geometry:
    """The union of the grid cells around some pairs ``(d, s)``; a lone pair has a cell of 0.005."""
    half = np.concatenate([np.diff(R_d[:2]), np.diff(R_s[:2]), [0.005]])[0] / 2
    d, s = np.nonzero(mask)
    cells = shapely.box(R_d[d] - half, R_s[s] - half, R_d[d] + half, R_s[s] + half)
    return shapely.union_all(cells, grid_size=half / 10)  # edges of neighbours differ by rounding


def draw_plan(axes: Axes, floor: FloorPlan) -> None:
    """Draw the walkable and solid areas of a plan [m], with the names that fit."""
    axes.set_facecolor(OUTDOORS)
    for layer in plan_layers(floor):
        _draw_shape(axes, layer.shape, facecolor=layer.fill, edgecolor=layer.stroke, lw=8 * layer.width)
    for beacon in floor.of_kind(BEACON):
        axes.plot(*shapely.get_coordinates(beacon.shape)[:1].T, marker="^", ms=5, color=RED, ls="none")
    (west, east), (south, north) = axes.get_xlim(), axes.get_ylim()
    inches = axes.get_window_extent().width / axes.figure.dpi
    letter = 0.06 * (east - west) / inches  # [m] wide, at 6 points
    for area in floor.of_kind(*SOLID, *CLOSED, *OPEN):
        if area.name.isascii() and area.name.isprintable() and area.is_polygon:
            shown = shapely.intersection(area.shape, shapely.box(west, south, east, north))
            x0, y0, x1, y1 = shapely.bounds(shown)
            if shapely.area(shown) > 0 and len(area.name) * letter < x1 - x0 and 2 * letter < y1 - y0:
                [place] = shapely.get_coordinates(shapely.point_on_surface(shown))
                style: dict[str, Any] = {"color": "#6b655b", "ha": "center", "va": "center", "clip_on": True}
                axes.annotate(area.name, place, fontsize=6, zorder=1, **style)


def _draw_shape(axes: Axes, geometry: shapely.Geometry, **style: Any) -> None:
    """Draw the polygons of a geometry with their holes as one collection, and its lines as another."""
    parts = shapely.get_parts(shapely.get_parts(geometry))
    patches = [
        PathPatch(
            Path.make_compound_path(*(Path(shapely.get_coordinates(r), closed=True) for r in shapely.get_rings(p)))
        )
        for p in parts[shapely.get_dimensions(parts) == 2]
    ]
    if patches:
        axes.add_collection(PatchCollection(patches, match_original=False, **style))
    lines = [shapely.get_coordinates(p) for p in parts[shapely.get_dimensions(parts) == 1]]
    if lines:
        axes.add_collection(LineCollection(lines, **style))


def draw_uncertainty(axes: Axes, trajectory: Trajectory, label: str | None, floor: FloorPlan | None = None) -> None:
    """Draw the union of the 95 % ellipses of the steps; on a plan, its walkable part."""
    whole = shapely.union_all(region(trajectory, np.isfinite(_on(trajectory, label)[:, 0]), floor))
    _draw_shape(axes, whole, facecolor=BAND, lw=0, alpha=0.3, label="95 % region")


def _draw_fixes(axes: Axes, estimate: Estimate, label: str | None) -> None:
    """Draw fixes, paler with less weight, each with a line to the walk at its time."""
    track, time = estimate.trajectory, np.array([f.time for f in estimate.fixes])
    here = np.isfinite(_on(track, label)[nearest(track.time, time), 0])
    if not here.any():
        return
    *place, weight = np.array([(f.x, f.y, f.weight) for f in estimate.fixes])[here].T
    at = interpolate(time[here], track.time, track.position)
    share = min(1.0, MANY / len(at))
    gaps = list(np.stack([np.column_stack(place), at], axis=1))
    axes.add_collection(LineCollection(gaps, color=RED, lw=0.8 * share, alpha=0.2 + 0.4 * share))
    name = "fix" + (" (hollow: rejected)" if weight.min() <= REPORTS.rejected else "")
    style: dict[str, Any] = {"s": max(42 * share, 5), "edgecolors": RED, "label": name, "zorder": 2}
    axes.scatter(*place, c=to_rgba_array([RED] * len(at), 0.15 + 0.85 * weight), **style)


def _draw_beacons(axes: Axes, estimate: Estimate) -> None:
    """Draw the estimated positions of the beacons with their names, misplaced ones in another colour."""
    for colour, moved, label in ((RADIO, False, "beacons"), (RED, True, "misplaced beacons")):
        group = [b for b in estimate.beacons if b.misplaced == moved]
        for number, b in enumerate(group):
            style: dict[str, Any] = {"ls": "none", "mfc": "white", "mec": colour, "label": None if number else label}
            axes.plot(b.x, b.y, marker="D", **style)
            axes.annotate(printable(b.label), (b.x, b.y), (5, 5), textcoords="offset points", color=colour)


def _draw_untimed(axes: Axes, estimate: Estimate) -> None:
    """Draw places without a time, those that were not visited in another colour."""
    for colour, off, label in ((BLUE, False, "place without a time"), (RED, True, "place not visited")):
        if group := [(place.x, place.y) for place in estimate.untimed if (place.weight < REPORTS.rejected) == off]:
            style: dict[str, Any] = {"ls": "none", "mfc": "white", "mec": colour, "label": label}
            axes.plot(*np.array(group).T, marker="D", **style)


def _canvas(points: Array, around: float, bottom: float, count: int = 1) -> tuple[Figure, list[Axes]]:
    """A figure with ``count`` axes of equal scale that show points ``(n, 2)`` [m] and their surroundings.

    Axes fill rows from the lower left. around: margin as a share of the size; bottom: space for labels and legend
    [inch]. pyplot is not used: it is slow to import and keeps all figures in memory.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    shown = high - low + 2 * max(2.0, around * float(np.max(high - low)))
    scale = LONGEST_SIDE / float(shown.max())  # [inch/m]
    shown = np.maximum(shown, SHORTEST_SIDE / scale)
    corners = (low + high) / 2 + np.outer((-0.5, 0.5), shown)
    each = shown * scale + (1.0, bottom + 0.35)  # [inch] with labels, title and legend
    columns = min(count, max(1, round(np.sqrt(count * each[1] / each[0]))))
    size = each * (columns, -(-count // columns))
    figure = Figure(figsize=size)
    FigureCanvasAgg(figure)
    for n in range(count):
        row, column = divmod(n, columns)
        place = (np.array([column, row]) * each + (0.85, bottom)) / size
        limits: dict[str, Any] = {"xlim": corners[:, 0], "ylim": corners[:, 1], "aspect": "equal"}
        figure.add_axes((*place, *(shown * scale / size)), xlabel="x [m]", ylabel="y [m]", **limits)
    return figure, figure.axes
