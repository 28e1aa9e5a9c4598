"""Which floor each step is on: the most probable way through the storeys, of what barometer and fixes tell.

A hidden Markov model whose states are the floors and the landings between them, at quarters of a storey. They change
at climbs alone, by about the climb's height; while nobody climbs nothing changes, whatever the weather does. A landing
is a state so that a stop half-way up the stairs is neither a floor nor forgotten: the next climb goes on from there.
Without a plan the height of a storey is unknown and about the same for all, with one the scale of its heights is: the
likeliest of several is taken.

The floor is the nearest one in height: on stairs it changes half-way, and who passes a floor is on it for a moment.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import groupby

import numpy as np

from pdr_graph.estimation.storeys import FloorHeights, Storeys, of_building, unknown
from pdr_graph.gait.climbing import DRAUGHT, RAMP, kinds
from pdr_graph.geometry import row_times
from pdr_graph.inertial.barometer import Climbs, climbs, done
from pdr_graph.types import Array, Fixes, Index, Signal, Steps
from pdr_graph.viterbi import viterbi

LANDINGS = 4  # to a storey
OFF, SCALE = 0.4, 0.06  # [m] and of the height, by which storeys differ from what was assumed, each on its own
CHANGE, STOREY = 0.5, 0.3  # cost of another floor, and of each storey on the way: short climbs are more usual
LANDING, LANDING_TIME, MOST_LANDING = 1.0, 60.0, 2.0  # cost of a stop between floors; it grows with time [s]
OTHER_FLOOR = 1.4  # cost of a fix on another floor: one in five hears a beacon through the ceiling
ALIKE = 5  # fixes on one floor that count: those of one place err together
START = 5.0  # cost of another floor than the one said to begin on; four fixes that agree say otherwise
UNSEEN = 10.0  # [m]: how far a climb went that no barometer saw


@dataclass(frozen=True)
class Floors:
    """Where the walk was in height, a row per row of the trajectory ``(n + 2,)``.

    labels: the floor's, "" where it has none; level: which of ``storeys``, the building's floors if there is a plan,
    whose heights have the scale that fits the walk;
    height: above the start by the barometer's climbs alone [m]; sigma: of that [m]; climbs and what kinds they were.
    """

    labels: tuple[str, ...]
    level: Index
    height: Array
    sigma: Array
    storeys: Storeys
    climbs: Climbs
    kinds: tuple[str, ...]


def floors_of(
    steps: Steps, barometer: Signal | None, start: str, fixes: Fixes, building: FloorHeights | None
) -> tuple[str, ...]:
    """The floor's label on each row of the trajectory: the start, every step's end, the end. "" where unknown.

    steps: of the walk; barometer: what tells climbs, None without; start: label of the floor where the walk began, ""
    if unknown; fixes: those with a floor tell too; building: whose labels and heights these are, None without a plan.
    """
    return floors_along(steps, barometer, start, fixes, building).labels


def floors_along(
    steps: Steps, barometer: Signal | None, start: str, fixes: Fixes, building: FloorHeights | None
) -> Floors:
    """The floors of a walk, and how they were found."""
    # When the walker went up or down, and on what
    seen = _where_fixes_change(fixes) if barometer is None else climbs(barometer)
    kind = kinds(steps, seen) if barometer is not None else ("",) * len(seen)
    none = {DRAUGHT} if building is not None else {DRAUGHT, RAMP}  # without a plan a ramp is a hill
    used = seen[np.array([k not in none for k in kind], dtype=bool)]

    # Which storey the walker was on between climbs
    if building is not None:
        likely = of_building(building, start)
    else:
        likely = unknown(start, fixes.floor, float(np.abs(np.cumsum(used.height)).max(initial=0.0)))
    alike = [list(group) for _, group in groupby(likely, key=lambda s: s.labels)]
    storeys, way, _ = min((_most_probable(group, used, fixes, steps) for group in alike), key=lambda found: found[2])

    # Which on every row
    rows = row_times(steps)
    rising = np.diff(way)
    level = _nearest(storeys.heights, way[0] + rising @ done(barometer, used, rows))
    told = storeys.begin is not None or len(_said(storeys, fixes)[0]) or len(storeys.labels) == 1
    labels = tuple(storeys.labels[n] if told else "" for n in level)
    real = seen[np.array([k != DRAUGHT for k in kind], dtype=bool)]
    share = done(barometer, real, rows)
    sigma = np.sqrt(real.sigma**2 @ share**2)
    return Floors(labels, level, real.height @ share, sigma, storeys, seen, kind)


def _most_probable(alike: list[Storeys], used: Climbs, fixes: Fixes, steps: Steps) -> tuple[Storeys, Array, float]:
    """The likeliest of storeys that differ in their heights alone, and where the walk was then, and what it costs.

    Where: heights ``(c + 1,)`` [m] of floors or landings before, between and after the climbs.
    """
    one = alike[0]
    place = np.stack([_floors_and_landings(s.heights) for s in alike])
    nearest = np.stack([_nearest(s.heights, at) for s, at in zip(alike, place, strict=True)])
    floor = np.take_along_axis(np.stack([s.heights for s in alike]), nearest, axis=1)
    landing = np.abs(place - floor) > 1e-9
    begin = np.append(steps.start, used.end)
    end = np.append(used.start, steps.end)
    said, time = _said(one, fixes)
    costs = [
        _of_fixes(said, time, len(one.labels), a, b)[nearest]
        + landing * min(LANDING + max(b - a, 0.0) / LANDING_TIME, MOST_LANDING)
        for a, b in zip(begin, end, strict=True)
    ]
    if one.begin is not None:
        costs[0] = costs[0] + START * (nearest != one.begin)
    costs[0] = costs[0] + MOST_LANDING * landing  # walks begin on floors
    moved, passed = place[:, None] - place[:, :, None], np.abs(nearest[:, None] - nearest[:, :, None])
    further = CHANGE * (passed > 0) + STOREY * passed
    moves = [_of_climb(moved, h, s) + further for h, s in zip(used.height, used.sigma, strict=True)]
    states, cost = viterbi(costs, moves)
    total = cost + [s.cost for s in alike]
    best = int(np.argmin(total))
    return alike[best], place[best, states[best]], float(total[best])


def _of_climb(moved: Array, height: float, sigma: float) -> Array:
    """Cost of having moved up so far [m] by a climb of so much."""
    variance = OFF**2 + sigma**2 + (SCALE * moved) ** 2
    return 0.5 * ((height - moved) ** 2 / variance + np.log(variance))


def _of_fixes(said: Index, time: Array, count: int, begin: float, end: float) -> Array:
    """Cost ``(f,)`` of each of ``count`` storeys by those that fixes at ``time`` said, from begin to end [s]."""
    heard = np.bincount(said[(time >= begin) & (time <= end)], minlength=count)
    total = int(heard.sum())
    return OTHER_FLOOR * min(total, ALIKE) * (1 - heard / max(total, 1))


def _said(storeys: Storeys, fixes: Fixes) -> tuple[Index, Array]:
    """Which storey each fix that knows one says, and when [s]."""
    index = {label: n for n, label in enumerate(storeys.labels) if label}
    which = np.array([index.get(label, -1) for label in fixes.floor], dtype=int)
    return which[which >= 0], fixes.time[which >= 0]


def _where_fixes_change(fixes: Fixes) -> Climbs:
    """Where a walker may have gone up or down without a barometer: between fixes of different floors."""
    known = np.flatnonzero([bool(label) for label in fixes.floor])
    known = known[np.argsort(fixes.time[known], kind="stable")]
    label = np.array(fixes.floor, dtype=object)[known]
    other = label[:-1] != label[1:]
    start, end = fixes.time[known[:-1][other]], fixes.time[known[1:][other]]
    return Climbs(start, end, np.zeros(len(start)), np.full(len(start), UNSEEN))


def _floors_and_landings(heights: Array) -> Array:
    """Heights ``(4 (f - 1) + 1,)`` [m] of all floors and of quarters between."""
    last = len(heights) - 1
    return np.interp(np.arange(LANDINGS * last + 1) / LANDINGS, np.arange(last + 1), heights)


def _nearest(heights: Array, at: Array) -> Index:
    """The floor nearest to each height; the lower of two that are as near."""
    return np.argmin(np.abs(at[:, None] - heights), axis=1)
