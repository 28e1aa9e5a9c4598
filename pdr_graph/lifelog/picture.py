"""The picture of a day: maps of where it was, and below them its hours."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import tzinfo

from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from pdr_graph.errors import one_line
from pdr_graph.lifelog.day import Day
from pdr_graph.lifelog.panels import panels
from pdr_graph.lifelog.parts import UNSEEN
from pdr_graph.lifelog.picture_hours import draw_hours
from pdr_graph.lifelog.picture_map import draw_map
from pdr_graph.lifelog.picture_style import COLOURS, families
from pdr_graph.lifelog.timeline import PASSING, STAY, WORDS, Entry, in_words, timeline, totals

WIDTH, HOURS, HEAD, MARGIN = 13.0, 1.9, 0.7, 0.15  # [inch] of the picture; heights of its hours and head
MAP_HEIGHT = (7.0, 5.0, 4.4)  # [inch] of one map in a row, of two, of three


def picture(day: Day, zone: tzinfo) -> Figure:
    """Maps of a day with its tracks by kind, their 95 % regions and its stays; below, its hours in a time zone.

    Without the pyplot machinery, which is slow to load and keeps every figure alive.
    """
    with rc_context({"font.family": families()}):
        return _drawn(day, zone)


def _drawn(day: Day, zone: tzinfo) -> Figure:
    maps, entries = panels(day), timeline(day)
    columns = 2 if len(maps) == 4 else min(max(len(maps), 1), 3)
    height, lines = MAP_HEIGHT[columns - 1], -(-len(maps) // columns)
    total = HEAD + lines * height + HOURS
    figure = Figure(figsize=(WIDTH, total), facecolor="white")
    FigureCanvasAgg(figure)
    for n, panel in enumerate(maps):
        row, column = divmod(n, columns)
        beside = min(columns, len(maps) - row * columns)  # the last row's maps share its width
        wide, high = (WIDTH - MARGIN) / beside - MARGIN, height - 2.5 * MARGIN
        left, bottom = MARGIN + column * (wide + MARGIN), HOURS + (lines - 1 - row) * height + MARGIN
        axes = figure.add_axes((left / WIDTH, bottom / total, wide / WIDTH, high / total))
        draw_map(axes, panel, maps, zone, wide / high)
    if entries:
        draw_hours(figure.add_axes((0.03, 0.55 / total, 0.94, (HOURS - 0.75) / total)), day, entries, zone)
    _draw_head(figure, day, entries, total)
    return figure


def _draw_head(figure: Figure, day: Day, entries: Sequence[Entry], height: float) -> None:
    """Whose day it is, its sums, and what the colours mean."""
    whose = f"{one_line(day.person)}   {day.date}"
    figure.text(0.012, 1 - 0.25 / height, whose, fontsize=13, weight="bold", va="center")
    figure.text(0.012, 1 - 0.52 / height, "     ".join(in_words(totals(day, entries))), fontsize=9.5, va="center")
    kinds = [kind for kind in COLOURS if any(entry.kind == kind for entry in entries)]
    names, place = [WORDS.get(kind, kind) for kind in kinds], (0.995, 1 - 0.05 / height)
    style = {"ncols": max(len(kinds), 1), "frameon": False, "fontsize": 9, "handlelength": 1.6, "columnspacing": 1.2}
    figure.legend([_mark(kind) for kind in kinds], names, loc="upper right", bbox_to_anchor=place, **style)


def _mark(kind: str) -> Line2D:
    if kind in (STAY, PASSING):
        return Line2D([], [], marker="o", ms=8 if kind == STAY else 5, color=COLOURS[kind], ls="none")
    return Line2D([], [], color=COLOURS[kind], lw=2.5, ls=":" if kind in UNSEEN else "-")
