"""What all maps of a lifelog have: labels that do not overlap, a scale bar, and an arrow to the north."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Polygon
from matplotlib.transforms import Affine2D

from pdr_graph.lifelog.maps import HALO, INK, LABEL_SIZE, label_width
from pdr_graph.types import Array

# Chosen by hand
MAX_LABELS = 14  # per map
SIDES = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1))  # of a point, for its label
ARROW = 24.0  # [pt] length of the arrow to the north
ARROW_INSET = 26.0  # [pt] of its middle from the right and the upper edge
Label = tuple[Array, str, float]  # position (2,), text, and distance of the text from the position [pt]


def draw_labels(axes: Axes, labels: Sequence[Label]) -> None:
    """Draw labels, given in order of importance, beside their points where they overlap nothing; leave out the rest."""
    points = 72.0 / axes.figure.dpi  # [pt] of a pixel
    frame = axes.get_window_extent().get_points() * points
    places = [axes.transData.transform(position) * points for position, _, _ in labels]
    occupied = [_box(at, 2 * away, 2 * away) for at, (_, _, away) in zip(places, labels, strict=True)]
    occupied.append(_box(frame[1] - ARROW_INSET, 1.2 * ARROW, 2 * ARROW))
    for at, (_, text, away) in zip(places[:MAX_LABELS], labels, strict=False):
        boxes = [_box_beside(at, text, away, right, up) for right, up in SIDES]
        free = [b for b in boxes if is_inside(frame, b[0]) and is_inside(frame, b[1]) and not _overlaps(b, occupied)]
        if free:
            occupied.append(free[0])
            x, y = axes.transAxes.inverted().transform(free[0].mean(axis=0) / points)
            style = {"fontsize": LABEL_SIZE, "color": INK, "zorder": 8, "path_effects": HALO}
            axes.text(x, y, text, transform=axes.transAxes, ha="center", va="center", **style)


def _box_beside(at: Array, text: str, away: float, right: int, up: int) -> Array:
    """Corners ``(2, 2)`` [pt] of a text to the right (1) or left (-1) of a point, above (1) or below (-1) it."""
    wide, high = label_width(text), 1.2 * LABEL_SIZE
    return _box(at + np.array([right * (away + 2 + wide / 2), up * (away + 1 + high / 2)]), wide, high)


def _box(middle: Array, wide: float, high: float) -> Array:
    """Corners ``(2, 2)`` of a box about its middle."""
    half = np.array([wide / 2, high / 2])
    return np.stack([middle - half, middle + half])


def _overlaps(box: Array, others: Sequence[Array]) -> bool:
    return any((box[0] < other[1]).all() and (box[1] > other[0]).all() for other in others)


def draw_scale(axes: Axes, low: Array, high: Array) -> None:
    """Draw a scale bar of a round length, at most a fifth of the map's width."""
    about = (high[0] - low[0]) / 5
    power = 10.0 ** np.floor(np.log10(about))
    length = float(power * max(n for n in (1, 2, 5) if n * power <= about))
    x, y = low + 0.03 * (high - low)
    axes.plot([x, x + length], [y, y], color=INK, lw=2.5, solid_capstyle="butt", zorder=9)
    label = f"{length / 1000:g} km" if length >= 1000 else f"{length:g} m"
    text = axes.annotate(label, (x + length, y), (4, 0), textcoords="offset points", va="center", fontsize=8, zorder=9)
    text.set_path_effects(HALO)


def draw_north(axes: Axes, east: float = 0.0) -> None:
    """Draw an arrow to the north in the upper right corner. east: direction of east from +x [rad]."""
    right, upper = (np.array(axes.get_window_extent().max) / axes.figure.dpi).tolist()  # [inch]
    inches = Affine2D().rotate(east).translate(-ARROW_INSET, -ARROW_INSET).scale(1 / 72).translate(right, upper)
    points = inches + axes.figure.dpi_scale_trans
    shape = ARROW * np.array([(0, 0.5), (0.22, -0.3), (0, -0.15), (-0.22, -0.3)])
    style = {"fc": INK, "ec": "white", "lw": 0.8, "zorder": 9, "clip_on": False}
    axes.add_patch(Polygon(shape, closed=True, transform=points, **style))
    axes.text(
        0, -0.55 * ARROW, "N", transform=points, fontsize=8, ha="center", va="center", zorder=9, color=INK
    ).set_path_effects(HALO)


def filled(corners: Array, aspect: float) -> Array:
    """Corners ``(2, 2)`` with the same middle, enlarged to an aspect ratio [m]."""
    half = (corners[1] - corners[0]) / 2
    half = np.array([max(half[0], half[1] * aspect), max(half[1], half[0] / aspect)])
    return corners.mean(axis=0) + np.stack([-half, half])


def is_inside(corners: Array, position: Array) -> bool:
    """True if a position ``(2,)`` lies between corners ``(2, 2)``."""
    return bool(np.all((position >= corners[0]) & (position <= corners[1])))
