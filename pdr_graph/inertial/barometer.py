"""Air pressure as height: when the phone went up or down, by how much, and whether by stairs, lift or escalator.

Weather changes the pressure by up to 1 hPa (8 m) an hour, fifty times slower than stairs; noise and gusts are as fast
as stairs but do not last. So a median removes spikes from the height (it keeps edges, a mean would not), and a climb is
a run in which the rate exceeds a low threshold, with a high one exceeded somewhere in it. The height of a climb is the
difference of the medians over some seconds before and after it, so that weather between climbs has no effect.

Steps on stairs are as long as the treads: stride models are fitted on level ground and overestimate them by half.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d, median_filter

from pdr_graph.errors import count
from pdr_graph.inertial.attitude import runs
from pdr_graph.priors import CLIMB, KIND, TREADS
from pdr_graph.types import Array, Index, Mask, OneLineRepr, Signal, Steps

CELL = 0.5  # [s] interval of the heights
SCALE_HEIGHT = 287.05 * 293.15 / 9.80665  # [m] R T / g of dry air at 20 °C, that of buildings; 1 % less at 17 °C


@dataclass(frozen=True)
class Climbs(OneLineRepr):
    """Height changes ``(c,)`` in order: start, end [s]; height, positive upwards, and its standard deviation [m]."""

    start: Array
    end: Array
    height: Array
    sigma: Array

    def __len__(self) -> int:
        return len(self.start)

    def _summary(self) -> list[str]:
        return [count(len(self), "climb"), f"{np.abs(self.height).sum():.1f} m up and down"]

    def __getitem__(self, which: Mask | Index) -> Climbs:
        """A selection of climbs."""
        return Climbs(*(values[which] for values in vars(self).values()))

    @classmethod
    def none(cls) -> Climbs:
        """No climbs: 0 rows."""
        return cls(*(np.empty(0) for _ in range(4)))


def height_of(pressure: Array) -> Array:
    """Height ``(n,)`` [m] above the first of pressures ``(n,)`` [hPa], in air at 20 °C.

    The hypsometric equation, (R T / g) ln(p₀ / p): AMS Glossary of Meteorology, "hypsometric equation".
    """
    return SCALE_HEIGHT * np.log(pressure[0] / pressure)


def climbs(barometer: Signal) -> Climbs:
    """The climbs in a barometer's samples: on stairs, in a lift, on an escalator or a ramp."""
    if len(barometer) < 2 or barometer.time[-1] - barometer.time[0] < CLIMB.level:
        return Climbs.none()
    time, height, quiet = _without_gusts(barometer)

    # Runs of grid cells in which the height rises or falls. The Gaussian of the rate is wide enough that noise seldom
    # exceeds the high threshold: the derivative of a Gaussian of width s has a noise of noise / (2 π^¼ s^1.5)
    change = np.diff(height_of(barometer.values[:, 0]))
    noise = 1.4826 * float(np.median(np.abs(change))) / np.sqrt(2 * barometer.rate)  # [m] of a mean over one second
    seconds = max(CLIMB.rate, (noise * CLIMB.quiet / CLIMB.fast / 2.66) ** (2 / 3))
    rate = gaussian_filter1d(quiet, seconds / CELL, order=1, mode="nearest") / CELL
    spans: list[tuple[int, int, int]] = []
    for direction in (1, -1):
        for a, b in np.transpose(runs(direction * rate > CLIMB.slow)).tolist():
            if np.max(direction * rate[a:b]) > CLIMB.fast:
                spans.append((a, b, direction))
    joined: list[tuple[int, int, int]] = []
    for a, b, direction in sorted(spans):
        if joined and joined[-1][2] == direction and (a - joined[-1][1]) * CELL < CLIMB.pause:
            joined[-1] = (joined[-1][0], b, direction)
        else:
            joined.append((a, b, direction))

    # First and last cells of each climb; those with a level shorter than a gust between them are one climb
    edges = list[tuple[int, int]]()
    for a, b, _ in joined:
        total = quiet[b - 1] - quiet[a]
        if abs(total) > CLIMB.least / 2:
            share, edge = (quiet[a:b] - quiet[a]) / total, min(CLIMB.edge / abs(total), 1 / 8)
            middle = int(np.argmax(share >= 0.5))
            begin = a + int(np.flatnonzero(share[: middle + 1] <= edge)[-1])
            end = max(a + middle + int(np.argmax(share[middle:] >= 1 - edge)), begin + 1)
            if edges and (begin - edges[-1][1]) * CELL <= CLIMB.gust:
                begin = edges.pop()[0]
            edges.append((begin, end))

    # Heights from the levels before and after each climb
    window, rows = round(CLIMB.level / CELL), []
    ends = [0, *(b for _, b in edges)], [*(a for a, _ in edges[1:]), len(height) - 1]
    for (a, b), before, behind in zip(edges, *ends, strict=False):
        low, sigma_low = _level(height[min(max(a - window, before), a) : a + 1])
        high, sigma_high = _level(height[b : max(min(b + window, behind), b) + 1])
        sigmas = [sigma_low, sigma_high, CLIMB.weather * float(time[b] - time[a]), CLIMB.placement]
        rows.append((time[a], time[b], high - low, np.linalg.norm(sigmas)))
    found = Climbs(*np.array(rows).reshape(-1, 4).T)
    lasting = np.minimum(found.start - time[0], time[-1] - found.end) > CLIMB.gust
    lasting |= found.end - found.start > CLIMB.gust  # at the ends of a recording a gust looks like a level
    return found[lasting & (np.abs(found.height) > np.maximum(CLIMB.least, CLIMB.certain * found.sigma))]


def climbed_share(barometer: Signal | None, of: Climbs, at: Array) -> Array:
    """Share ``(c, m)`` of each climb that is done at times ``at (m,)`` [s]: 0 before it, 1 after it, never falling.

    Without a barometer the share grows evenly.
    """
    if barometer is None or not len(of):
        return np.clip((at - of.start[:, None]) / np.maximum(of.end - of.start, CELL)[:, None], 0, 1)
    time, _, quiet = _without_gusts(barometer)
    below, above = np.interp(of.start, time, quiet), np.interp(of.end, time, quiet)
    within = np.clip(at, of.start[:, None], of.end[:, None])
    evenly = (within - of.start[:, None]) / (of.end - of.start)[:, None]
    rise = np.where(np.abs(above - below) > CLIMB.edge, above - below, np.inf)[:, None]
    share = np.where(np.isfinite(rise), (np.interp(within, time, quiet) - below[:, None]) / rise, evenly)
    share = np.where(at >= of.end[:, None], 1.0, np.where(at <= of.start[:, None], 0.0, np.clip(share, 0, 1)))
    return np.maximum.accumulate(share, axis=1)


def _without_gusts(barometer: Signal) -> tuple[Array, Array, Array]:
    """Time [s], height [m] and height without spikes [m] on the grid, each ``(n,)``; long gaps are shortened to 5 s."""
    step = np.diff(barometer.time)
    spent = np.append(0.0, np.cumsum(np.minimum(step, 5.0)))
    height = height_of(barometer.values[:, 0])
    cell = (spent / CELL).astype(int)
    samples = np.bincount(cell)
    filled = np.flatnonzero(samples)
    mean = np.bincount(cell, height)[filled] / samples[filled]
    middle = np.bincount(cell, barometer.time)[filled] / samples[filled]
    grid = np.arange(len(samples))
    height = np.interp(grid, filled, mean)
    quiet = median_filter(height, 2 * round(CLIMB.gust / CELL) + 1, mode="nearest")
    return np.interp(grid, filled, middle), height, quiet


def _level(height: Array) -> tuple[float, float]:
    """The median of heights and its standard deviation. [m]"""
    middle = float(np.median(height))
    spread = 1.4826 * float(np.median(np.abs(height - middle)))
    return middle, 1.25 * spread / np.sqrt(max(1.0, len(height) * CELL / CLIMB.correlated))


STAIRS, LIFT, ESCALATOR, RAMP, DRAUGHT = "stairs", "lift", "escalator", "ramp", "draught"


def climb_kinds(steps: Steps, climbs: Climbs) -> tuple[str, ...]:
    """The kind of each climb: stairs, lift, escalator, ramp or draught.

    A draught is a pressure change that no walker can have made: more than half a metre per step.
    """
    seconds = climbs.end - climbs.start
    rate = np.abs(climbs.height) / seconds
    moving, made = np.zeros(len(climbs)), np.zeros(len(climbs))  # time on steps [s]; steps, with fractions at the ends
    if len(steps):
        knots = np.stack([steps.time - steps.duration, steps.time], axis=1).ravel()
        for total, of in ((moving, np.append(0.0, np.cumsum(steps.duration))), (made, np.arange(len(steps) + 1.0))):
            at_knots = np.repeat(of, 2)[1:-1]
            total += np.interp(climbs.end, knots, at_knots) - np.interp(climbs.start, knots, at_knots)
    per_step = np.abs(climbs.height) / np.maximum(made, 1)
    limits = (KIND.highest_step, KIND.highest_stairs, KIND.steepest_ramp)
    on_foot = np.select([per_step > limit for limit in limits], [DRAUGHT, ESCALATOR, STAIRS], RAMP)
    standing = np.where(rate > KIND.slowest_lift, LIFT, ESCALATOR)
    kinds = np.where(moving > KIND.walked * seconds, on_foot, standing)
    return tuple(str(kind) for kind in kinds)


def with_stair_lengths(steps: Steps, climbs: Climbs, kinds: tuple[str, ...]) -> Steps:
    """Shorten the steps on stairs to the depth of a tread: 0.63 m less twice the rise of a step (Blondel's rule).

    climbs, kinds: height changes and their kinds from `climb_kinds`.
    """
    return with_goings(steps, goings_of(steps, climbs, kinds), alike=0.0)


def goings_of(steps: Steps, climbs: Climbs, kinds: tuple[str, ...]) -> Array:
    """The goings of the climbs on stairs ``(k, 3)``: start and end of the climb [s], depth of a tread [m]."""
    rows = []
    for start, end, height, kind in zip(climbs.start, climbs.end, climbs.height, kinds, strict=True):
        count = np.count_nonzero(_steps_during(steps, start, end))
        if kind == STAIRS and count:
            going = TREADS.blondel - 2 * abs(height) / count
            rows.append((start, end, np.clip(going, TREADS.shortest_going, TREADS.longest_going)))
    return np.array(rows).reshape(-1, 3)


def with_goings(steps: Steps, goings: Array, alike: float = 0.02) -> Steps:
    """The steps with those on stairs as long as the treads, unless they are within ``alike`` [m]: then the same object.

    goings: ``(k, 3)``, see `goings_of`.
    """
    if not len(goings):
        return steps
    length, sigma = steps.length.copy(), steps.sigma_length.copy()
    for start, end, going in goings.tolist():
        on = _steps_during(steps, start, end)
        on &= (np.abs(length - going) > alike) | (sigma != TREADS.sigma)
        length[on], sigma[on] = going, TREADS.sigma
    if np.array_equal(length, steps.length) and np.array_equal(sigma, steps.sigma_length):
        return steps
    return replace(steps, length=length, sigma_length=sigma)


def _steps_during(steps: Steps, start: float, end: float) -> Mask:
    """``(n,)`` True for steps between two times [s]."""
    return (steps.time > start) & (steps.time - steps.duration < end) & ~steps.is_gap
