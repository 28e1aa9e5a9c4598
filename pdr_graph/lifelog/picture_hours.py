"""The hours of a day's picture: blocks from left to right, with the names of places above."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timedelta, tzinfo

from matplotlib.axes import Axes
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter, date2num
from matplotlib.patches import Rectangle

from pdr_graph.lifelog.day import Day
from pdr_graph.lifelog.parts import UNSEEN
from pdr_graph.lifelog.picture_style import COLOURS, INK, LABEL, LETTER, short, width
from pdr_graph.lifelog.timeline import STAY, Entry
from pdr_graph.plotting import RADIO

ROWS = 3  # of names
WHOLE_DAY = 12 * 3600.0  # [s] from which on all 24 hours are shown
AROUND = 0.02  # of less than that, share shown before and after


def draw_hours(axes: Axes, day: Day, entries: Sequence[Entry], zone: tzinfo) -> None:
    """A day's entries, at least one, by the clock of a time zone."""
    begin, end = _span(day, entries, zone)
    axes.set(xlim=(_date(begin, zone), _date(end, zone)), yticks=[])
    axes.xaxis_date(zone)
    locator = AutoDateLocator(tz=zone, minticks=5, maxticks=13)
    axes.xaxis.set(major_locator=locator, major_formatter=ConciseDateFormatter(locator, tz=zone, show_offset=False))
    axes.tick_params(labelsize=8.5)
    for side in ("left", "right", "top"):
        axes.spines[side].set_visible(False)
    for entry in entries:
        _draw_block(axes, entry, zone)
    axes.set_ylim(0, 1.1 + 0.5 * _draw_names(axes, entries, end - begin, zone))


def _span(day: Day, entries: Sequence[Entry], zone: tzinfo) -> tuple[float, float]:
    """Unix times from and to which the hours are drawn: all of a long day, what there is of a short one."""
    first, last = entries[0].start, max(entry.end for entry in entries)
    if last - first <= WHOLE_DAY:
        return first - AROUND * (last - first), last + AROUND * (last - first)
    midnight = datetime.fromisoformat(day.date).replace(tzinfo=zone)
    return min(midnight.timestamp(), first), max((midnight + timedelta(days=1)).timestamp(), last)


def _date(time: float, zone: tzinfo) -> float:
    return float(date2num(datetime.fromtimestamp(time, zone)))


def _draw_block(axes: Axes, entry: Entry, zone: tzinfo) -> None:
    """A coloured block, wide enough to be seen; a dotted line where nobody recorded."""
    left, right, colour = _date(entry.start, zone), _date(entry.end, zone), COLOURS[entry.kind]
    if entry.kind in UNSEEN:
        axes.plot([left, right], [0.5, 0.5], color=colour, lw=1.5, ls=":", zorder=1)
    else:
        axes.add_patch(Rectangle((left, 0.12), right - left, 0.76, fc=colour, ec=colour, lw=0.6, zorder=2))
    if entry.kind == STAY:  # the next may be one too
        axes.plot([right, right], [0.12, 0.88], color="white", lw=0.7, zorder=3)


def _draw_names(axes: Axes, entries: Sequence[Entry], span: float, zone: tzinfo) -> int:
    """Names of stays, the longest stays first, in rows, of which it returns the number; left out where is no room."""
    per_point = span / (axes.get_window_extent().width * 72 / axes.figure.dpi)  # [s]
    rows: list[list[tuple[float, float]]] = []
    for stay in sorted((e for e in entries if e.kind == STAY and e.facing), key=lambda e: e.start - e.end):
        name, middle = short(stay.facing[0][0]), (stay.start + stay.end) / 2
        half = (width(name) / 2 + LETTER) * per_point
        own = (middle - half, middle + half)
        row = next((n for n, others in enumerate(rows) if all(own[1] < a or own[0] > b for a, b in others)), len(rows))
        if row < ROWS:
            rows += [[]] * (row == len(rows))
            rows[row] = [*rows[row], own]
            at, level = _date(middle, zone), 1.1 + 0.5 * row
            axes.plot([at, at], [0.9, level], color=RADIO, lw=0.5, zorder=1)
            axes.text(at, level, name, fontsize=LABEL, ha="center", va="bottom", color=INK)
    return len(rows)
