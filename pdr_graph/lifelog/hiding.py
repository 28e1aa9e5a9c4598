"""Which rows of an outing are shown when some places are hidden: those outside, but for what points at the places.

A track that ends where a hidden area begins still points at something. So it ends earlier: where the area is not
straight on, or where it is as far away as the area is wide from its middle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pdr_graph.lifelog.day import Outing
from pdr_graph.lifelog.private_places import PrivatePlace
from pdr_graph.types import Array, Index, Mask, Trajectory

SHORTEST = 60.0  # [s] between two hidden stretches for which it is worth showing anything
LEG = 30.0  # [m] over which a track's direction is taken
AT_ONCE = 50  # rows that are looked at, from the end of a track on
MOST_BEHIND = 1000  # rows among which a leg begins: it takes half a kilometre of steps to stand for so many


@dataclass(frozen=True)
class Hidden:
    """What of an outing's rows is hidden. cut, blurred: ``(n,)``; broken: ``(n - 1,)`` between rows; lonlat [deg]."""

    lonlat: Array
    cut: Mask
    blurred: Mask
    broken: Mask


@dataclass(frozen=True)
class Run:
    """Rows from ``first`` to ``last`` that are shown; beside: at its start, at its end, is what is hidden."""

    first: int
    last: int
    beside: tuple[bool, bool]


def hidden_rows(outing: Outing, cut: Sequence[PrivatePlace], blur: Sequence[PrivatePlace]) -> Hidden:
    """What some places hide of an outing, in which nothing is both cut and blurred."""
    lonlat = outing.frame.to_lonlat(outing.trajectory.position)
    nothing = np.zeros(len(lonlat), dtype=bool)
    of_cut = np.any([nothing, *(place.hides(lonlat) for place in cut)], axis=0)
    of_blur = np.any([nothing, *(place.hides(lonlat) for place in blur)], axis=0) & ~of_cut
    broken = np.any([nothing[1:], *(place.crossed(lonlat) for place in (*cut, *blur))], axis=0)
    return Hidden(lonlat, of_cut, of_blur, broken)


def shown_runs(track: Trajectory, hidden: Hidden, places: Sequence[PrivatePlace]) -> list[Run]:
    """What is shown, in order."""
    shown = np.flatnonzero(~(hidden.cut | hidden.blurred))
    apart = np.flatnonzero((np.diff(shown) > 1) | hidden.broken[shown[:-1]])
    runs = [
        Run(first := int(r[0]), last := int(r[-1]), (first > 0, last < len(track) - 1))
        for r in np.split(shown, apart + 1)
        if len(r)
    ]
    turned = [_turned(track, run, hidden.lonlat, places) for run in runs if _is_long(track, run)]
    return [run for run in turned if _is_long(track, run)]


def _is_long(track: Trajectory, run: Run) -> bool:
    return not any(run.beside) or float(track.time[run.last] - track.time[run.first]) >= SHORTEST


def _turned(track: Trajectory, run: Run, lonlat: Array, places: Sequence[PrivatePlace]) -> Run:
    """A run without what at its ends points at what is hidden there."""
    own = np.arange(run.first, run.last + 1)
    if run.beside[1]:
        own = _turned_away(track.position, lonlat, own, places)
    if run.beside[0]:
        own = _turned_away(track.position, lonlat, own[::-1], places)[::-1]
    return replace(run, first=int(own[0]), last=int(own[-1])) if len(own) else replace(run, last=run.first)


def _turned_away(position: Array, lonlat: Array, own: Index, places: Sequence[PrivatePlace]) -> Index:
    """Rows up to the last one from which the hidden area is not straight on, or which is far from it."""
    if not len(own):
        return own
    place = min(places, key=lambda p: p.away(lonlat[own[-1:]])[0])
    for after in range(len(own), 0, -AT_ONCE):
        number = range(max(after - AT_ONCE, 0), after)
        behind = [own[_behind(position[own[max(0, n - MOST_BEHIND) : n + 1]], n)] for n in number]
        here = lonlat[own[number]]
        good = np.flatnonzero((place.away(here) > 2 * place.radius) | ~place.ahead(here, lonlat[behind]))
        if len(good):
            return own[: number[good[-1]] + 1]
    return own[:0]


def _behind(position: Array, number: int) -> int:
    """The last of the rows ``(n, 2)`` up to that number that is a LEG away from it, else the first of them."""
    away = np.flatnonzero(np.hypot(*(position - position[-1]).T) >= LEG)
    return number + 1 - len(position) + (int(away[-1]) if len(away) else 0)
