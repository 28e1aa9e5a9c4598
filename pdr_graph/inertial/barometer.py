"""Air pressure as height: when the phone went up or down, and by how much.

Pressure wanders with the weather, by up to 1 hPa (8 m) an hour, but that is fifty times slower than stairs; noise and
gusts are as fast, but do not last. A climb is therefore looked for in the rate of a height from which spikes were
taken by a median, which keeps edges as a mean would not, with two thresholds: a run of a low rate, so that its ends
are found, that somewhere is a high one. How high it went is the difference of the medians of a few seconds before and
after, next to it: what the weather does while nobody climbs never enters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d, median_filter

from pdr_graph.inertial.attitude import runs
from pdr_graph.types import Array, Index, Mask, Signal

# R T / g of dry air at 20 °C, that of buildings; 1 % less at 17 °C. [m]
SCALE_HEIGHT = 287.05 * 293.15 / 9.80665
GRID = 0.5  # [s] at which the height is looked at
LONGEST_GAP = 5.0  # [s]; a longer gap counts as one of so long
GUST = 4.5  # [s] that a spike may last, half the median's window; a lift rides one storey in four, and stays
RATE = 2.0  # [s] Gaussian over which a rate is taken
SLOW, FAST = 0.03, 0.06  # [m/s]; weather 0.002, a walked ramp of 6 % 0.08, stairs and escalators 0.2–0.5, lifts 0.5–5
PAUSE = 4.0  # [s] within a climb, to turn on a landing
LEVEL = 10.0  # [s] before and after a climb over which its ends' heights are taken
LEAST = 0.8  # [m]; a phone taken from a pocket to the ear rises by 0.6
CERTAIN = 2.0  # [sigma] that a climb is higher than its own noise: one missed costs more than one invented
QUIET = 3.0  # [sigma] of a rate's noise that are not a high rate
EDGE = 0.3  # [m] from its levels where a climb is said to begin and end; at most an eighth of it
CORRELATED = 3.0  # [s] over which errors of a height are alike
PLACE = 0.2  # [m] by which a phone is held otherwise than before, or a draught is as long as what a level is taken of
WEATHER = 8.5 / 3600  # [m/s]: 1 hPa an hour


@dataclass(frozen=True)
class Climbs:
    """Changes of level ``(c,)`` in order: from start to end [s], by height [m] up, within sigma [m]."""

    start: Array
    end: Array
    height: Array
    sigma: Array

    def __len__(self) -> int:
        return len(self.start)

    def __getitem__(self, which: Mask | Index) -> Climbs:
        """Some of them."""
        return Climbs(*(values[which] for values in vars(self).values()))

    @classmethod
    def none(cls) -> Climbs:
        """No climb at all."""
        return cls(*(np.empty(0) for _ in range(4)))


def height_of(pressure: Array) -> Array:
    """Height ``(n,)`` [m] above the first of pressures ``(n,)`` [hPa], of air of one temperature.

    The hypsometric equation, (R T / g) ln(p₀ / p): AMS Glossary of Meteorology, "hypsometric equation".
    """
    return SCALE_HEIGHT * np.log(pressure[0] / pressure)


def climbs(barometer: Signal) -> Climbs:
    """When the phone went up or down a flight of stairs, in a lift, on an escalator or a ramp."""
    if len(barometer) < 2 or barometer.time[-1] - barometer.time[0] < LEVEL:
        return Climbs.none()
    time, height, quiet = _without_gusts(barometer)
    first, after = _moving(quiet, _noise(barometer))
    likely = np.abs(quiet[after - 1] - quiet[first]) > LEAST / 2
    first, last = _without_false_levels(*_edges(quiet, first[likely], after[likely]))
    found = _measured(time, height, first, last)
    lasting = np.minimum(found.start - time[0], time[-1] - found.end) > GUST
    lasting |= found.end - found.start > GUST  # at the ends of a recording a gust looks like a level
    return found[lasting & (np.abs(found.height) > np.maximum(LEAST, CERTAIN * found.sigma))]


def done(barometer: Signal | None, of: Climbs, at: Array) -> Array:
    """How much ``(c, m)`` of each climb was done at times ``at (m,)`` [s]: 0 before, 1 after, never falling.

    Without a barometer climbs go on evenly.
    """
    if barometer is None or not len(of):
        return np.clip((at - of.start[:, None]) / np.maximum(of.end - of.start, GRID)[:, None], 0, 1)
    time, _, quiet = _without_gusts(barometer)
    below, above = np.interp(of.start, time, quiet), np.interp(of.end, time, quiet)
    within = np.clip(at, of.start[:, None], of.end[:, None])
    evenly = (within - of.start[:, None]) / (of.end - of.start)[:, None]
    rise = np.where(np.abs(above - below) > EDGE, above - below, np.inf)[:, None]
    share = np.where(np.isfinite(rise), (np.interp(within, time, quiet) - below[:, None]) / rise, evenly)
    share = np.where(at >= of.end[:, None], 1.0, np.where(at <= of.start[:, None], 0.0, np.clip(share, 0, 1)))
    return np.maximum.accumulate(share, axis=1)


def _without_gusts(barometer: Signal) -> tuple[Array, Array, Array]:
    """Time [s] and height [m] on a grid, and the height without spikes ``(n,)``. Long gaps take LONGEST_GAP."""
    step = np.diff(barometer.time)
    spent = np.append(0.0, np.cumsum(np.minimum(step, LONGEST_GAP)))
    height = height_of(barometer.values[:, 0])
    cell = (spent / GRID).astype(int)
    count = np.bincount(cell)
    filled = np.flatnonzero(count)
    mean = np.bincount(cell, height)[filled] / count[filled]
    middle = np.bincount(cell, barometer.time)[filled] / count[filled]
    grid = np.arange(len(count))
    height = np.interp(grid, filled, mean)
    return np.interp(grid, filled, middle), height, median_filter(height, 2 * round(GUST / GRID) + 1, mode="nearest")


def _noise(barometer: Signal) -> float:
    """Noise of the height, of a mean over one second [m]: from one sample to the next nobody climbs far."""
    change = np.diff(height_of(barometer.values[:, 0]))
    return 1.4826 * float(np.median(np.abs(change))) / np.sqrt(2 * barometer.rate)


def _moving(quiet: Array, noise: float) -> tuple[Index, Index]:
    """First cells, and those after the last, in which the height ``(n,)`` rises or falls; in order.

    The rate is taken over so long that noise [m] seldom makes it a high one: that of a Gaussian's derivative of width
    s is noise / (2 π^¼ s^1.5).
    """
    seconds = max(RATE, (noise * QUIET / FAST / 2.66) ** (2 / 3))
    rate = gaussian_filter1d(quiet, seconds / GRID, order=1, mode="nearest") / GRID
    spans: list[tuple[int, int, int]] = []
    for way in (1, -1):
        first, after = runs(way * rate > SLOW)
        spans += [(a, b, way) for a, b in zip(first, after, strict=True) if np.max(way * rate[a:b]) > FAST]
    joined: list[tuple[int, int, int]] = []
    for a, b, way in sorted(spans):
        if joined and joined[-1][2] == way and (a - joined[-1][1]) * GRID < PAUSE:
            joined[-1] = (joined[-1][0], b, way)
        else:
            joined.append((a, b, way))
    edges = np.array(joined, dtype=int).reshape(-1, 3)
    return edges[:, 0], edges[:, 1]


def _edges(quiet: Array, first: Index, after: Index) -> tuple[Index, Index]:
    """First and last cells between which most of a climb was made, that was seen from ``first`` to ``after``."""
    begin, end = first.copy(), after - 1
    for n, (a, b) in enumerate(zip(first, after, strict=True)):
        share = (quiet[a:b] - quiet[a]) / (quiet[b - 1] - quiet[a])
        edge = min(EDGE / abs(quiet[b - 1] - quiet[a]), 1 / 8)
        middle = int(np.argmax(share >= 0.5))
        begin[n] = a + np.flatnonzero(share[: middle + 1] <= edge)[-1]
        end[n] = a + middle + np.argmax(share[middle:] >= 1 - edge)
    return begin, np.maximum(end, begin + 1)


def _without_false_levels(first: Index, last: Index) -> tuple[Index, Index]:
    """The same with those joined, up or down, between which the height stayed no longer than in a gust."""
    stays = (first[1:] - last[:-1]) * GRID > GUST
    if not len(first):
        return first, last
    return first[np.append(True, stays)], last[np.append(stays, True)]


def _measured(time: Array, height: Array, first: Index, last: Index) -> Climbs:
    """Climbs from cells ``first`` to ``last``, by the levels beside them."""
    window, rows = round(LEVEL / GRID), []
    earliest = np.maximum(first - window, np.append(0, last[:-1]))
    latest = np.minimum(last + window, np.append(first[1:], len(height) - 1))
    for a, b, left, right in zip(first, last, earliest, latest, strict=True):
        before, doubt_before = _level(height[min(left, a) : a + 1])
        behind, doubt_behind = _level(height[b : max(right, b) + 1])
        doubts = [doubt_before, doubt_behind, WEATHER * float(time[b] - time[a]), PLACE]
        rows.append((time[a], time[b], behind - before, np.linalg.norm(doubts)))
    return Climbs(*np.array(rows).reshape(-1, 4).T)


def _level(height: Array) -> tuple[float, float]:
    """The median of some heights, and its standard deviation."""
    middle = float(np.median(height))
    spread = 1.4826 * float(np.median(np.abs(height - middle)))
    return middle, 1.25 * spread / np.sqrt(max(1.0, len(height) * GRID / CORRELATED))
