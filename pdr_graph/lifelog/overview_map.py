"""Maps of an overview: places as circles whose area is the time there, tracks as thin lines.

One map has everything within 50 km of each other; places on other continents have a map of their own beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from pdr_graph.errors import one_line
from pdr_graph.lifelog.map_furniture import Label, draw_labels, draw_north, draw_scale, filled
from pdr_graph.lifelog.map_tiles import MercatorFrame, tiles
from pdr_graph.lifelog.maps import COLOURS, HALO, short_name
from pdr_graph.lifelog.overview import Line, Overview
from pdr_graph.lifelog.overview_text import time_text
from pdr_graph.lifelog.period import DAY
from pdr_graph.lifelog.picture import BORDER, PAPER
from pdr_graph.lifelog.place_visits import PlaceSummary, PlaceVisit
from pdr_graph.lifelog.timeline import STAY, duration_text
from pdr_graph.lifelog.visits import on_sphere
from pdr_graph.types import Array

# Chosen by hand
NEIGHBOURS = 50_000.0  # [m] between points that share a map
CELL = 5_000.0  # [m] to which points are rounded before they are grouped
MOST_MAPS = 3
PLACE_SURROUNDINGS = 1_000.0  # [m] shown around the place of an overview of one place
LARGEST_CIRCLE, SMALLEST_CIRCLE = 1500.0, 14.0  # [pt²] of the place with the most time, and of any
DAY_LINE, PERIOD_LINE = (1.8, 0.95), (0.8, 0.5)  # width [pt] and opacity of tracks


@dataclass(frozen=True)
class Circle:
    """A place on a map. lonlat: ``(2,)`` [deg]; label; total: time there [s]."""

    lonlat: Array
    label: str
    total: float


@dataclass(frozen=True)
class Region:
    """What one map shows: its frame, circles, tracks with positions [m], and corners ``(2, 2)`` [m]."""

    frame: MercatorFrame
    circles: tuple[Circle, ...]
    lines: tuple[tuple[str, Array], ...]
    corners: Array


def regions(shown: Overview) -> list[Region]:
    """The maps of an overview, at most MOST_MAPS, that with the most time first."""
    circles = _circles(shown)
    lines = [line for day in shown.days for line in day.lines]
    if shown.place:
        found = [([circle], lines) for circle in circles[:1]]
        return [_region(c, ls, PLACE_SURROUNDINGS, False) for c, ls in found]
    groups = _groups(circles, lines)
    # least size [m] of a map
    return [_region(c, ls, 400.0 / 2, shown.period.kind == DAY) for c, ls in groups[:MOST_MAPS]]


def _circles(shown: Overview) -> list[Circle]:
    """The places, and stays that belong to no place, most time first."""
    several = len(shown.persons) > 1
    located = [place for place in shown.places if np.isfinite(place.latitude)]
    circles = [Circle(np.array([p.longitude, p.latitude]), _place_text(p, several), p.total) for p in located]
    others = [v for v in shown.visits if v.number < 0 and not v.place and np.isfinite(v.latitude)]
    circles += [Circle(np.array([v.longitude, v.latitude]), _visit_text(v, several), v.end - v.start) for v in others]
    return sorted(circles, key=lambda circle: -circle.total)


def _place_text(place: PlaceSummary, several: bool) -> str:
    whose = f"{short_name(place.person)}: " if several else ""
    return f"{whose}{short_name(place.label)}, {time_text(place.total)}"


def _visit_text(visit: PlaceVisit, several: bool) -> str:
    whose = f"{short_name(visit.person)}: " if several else ""
    return f"{whose}{duration_text(visit.end - visit.start)}"


def _groups(circles: Sequence[Circle], lines: Sequence[Line]) -> list[tuple[list[Circle], list[Line]]]:
    """Circles and lines by the map that shows them, that with the most time first."""
    points = np.array([*(circle.lonlat for circle in circles), *(line.lonlat[0] for line in lines)]).reshape(-1, 2)
    if not len(points):
        return []
    every = np.concatenate([points, *(line.lonlat for line in lines)])
    cells, cell_of = np.unique(np.round(on_sphere(every) / CELL), axis=0, return_inverse=True)
    pairs = KDTree(cells).query_pairs(NEIGHBOURS / CELL, output_type="ndarray")
    ones = np.ones(len(pairs))
    _, group_of = connected_components(coo_array((ones, pairs.T), shape=(len(cells), len(cells))), directed=False)
    group = group_of[cell_of.ravel()[: len(points)]]
    time = np.bincount(group, [*(c.total for c in circles), *(1.0 for _ in lines)])
    numbers = [n for n in np.argsort(-time, kind="stable") if (group == n).any()]
    return [
        (
            [circle for circle, own in zip(circles, group, strict=False) if own == n],
            [line for line, own in zip(lines, group[len(circles) :], strict=True) if own == n],
        )
        for n in numbers
    ]


def _region(circles: Sequence[Circle], lines: Sequence[Line], half: float, everything: bool) -> Region:
    """The map of circles and lines. half: least half side [m]; everything: False cuts off the ends of long tracks."""
    lon, lat = (circles[0].lonlat if circles else lines[0].lonlat[0]).tolist()
    frame = MercatorFrame(lat, lon)
    tracks = [(line.kind, frame.from_lonlat(line.lonlat)) for line in lines]
    places = frame.from_lonlat(np.array([circle.lonlat for circle in circles]).reshape(-1, 2))
    # track tails: share of track points on each side that may lie outside the map of more than a day
    tails = 0.0 if everything else 0.02
    ends = [np.quantile(np.concatenate([t for _, t in tracks]), [tails, 1 - tails], axis=0)] if tracks else []
    content = places[:1] if half == PLACE_SURROUNDINGS else np.concatenate([places, *ends])
    low, high = content.min(axis=0), content.max(axis=0)
    # margin share of the size of the content, on each side of a map
    side = np.maximum((high - low) * (0.5 + 0.1), half)
    middle = (low + high) / 2
    return Region(frame, tuple(circles), tuple(tracks), np.stack([middle - side, middle + side]))


def draw_region(axes: Axes, region: Region, aspect: float, title: str, template: str, day: bool) -> list[str]:
    """Draw a map; returns a line for each failure. aspect: width over height; template: of tiles, "" for none."""
    low, high = filled(region.corners, aspect)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xticks=[], yticks=[], facecolor=PAPER)
    for spine in axes.spines.values():
        spine.set_edgecolor(BORDER)
    failures = _draw_tiles(axes, region.frame, np.stack([low, high]), template) if template else []
    width, opacity = DAY_LINE if day else PERIOD_LINE
    for kind in dict.fromkeys(kind for kind, _ in region.lines):
        own = [line for k, line in region.lines if k == kind]
        drawn = LineCollection(own, colors=COLOURS[kind], linewidths=width, alpha=opacity, zorder=4, capstyle="round")
        # many points of tracks, above which a vector graphic has them as pixels
        drawn.set_rasterized(sum(map(len, own)) > 30_000)
        axes.add_collection(drawn, autolim=False)
    draw_labels(axes, _draw_circles(axes, region))
    draw_scale(axes, low, high)
    draw_north(axes)
    style = {"fontsize": 11, "weight": "bold", "zorder": 9, "path_effects": HALO}
    axes.text(0.012, 0.985, one_line(title), transform=axes.transAxes, va="top", **style)
    return failures


def _draw_circles(axes: Axes, region: Region) -> list[Label]:
    """Draw the places; returns their labels, those with the most time first."""
    if not region.circles:
        return []
    places = region.frame.from_lonlat(np.array([circle.lonlat for circle in region.circles]))
    most = max(7200.0, *(circle.total for circle in region.circles))  # least time [s] of the largest circle
    area = [max(LARGEST_CIRCLE * circle.total / most, SMALLEST_CIRCLE) for circle in region.circles]
    axes.scatter(*places.T, s=area, c=COLOURS[STAY], alpha=0.45, edgecolors=COLOURS[STAY], lw=1.0, zorder=6)
    radii = np.sqrt(np.array(area)) / 2
    return [(p, c.label, float(r)) for p, c, r in zip(places, region.circles, radii, strict=True)]


def _draw_tiles(axes: Axes, frame: MercatorFrame, corners: Array, template: str) -> list[str]:
    """Draw the tiles of a map; returns a line if there are none."""
    pixels = axes.get_window_extent().width
    try:
        for tile in tiles(template, frame, corners, pixels):
            (west, south), (east, north) = tile.corners.tolist()
            axes.imshow(
                tile.picture, extent=(west, east, south, north), zorder=1, aspect="equal", interpolation="bilinear"
            )
    except OSError as error:
        return [one_line(f"no tiles: {error}")]
    finally:
        axes.set(xlim=corners[:, 0], ylim=corners[:, 1])
    return []
