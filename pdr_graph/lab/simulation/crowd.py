"""Walkers in a hall and what their phones receive: beacons, each other, a terminal; no sensors, only steps and levels.

Each walker goes straight from one random place to the next, some of them switches. Errors of steps are those of
`town_walks`. Levels follow the path loss of the graph's beacons, with a power and an exponent of the hall drawn from
its priors. All phones are of one model, as those of the workers of one firm are.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.ndimage import gaussian_filter1d

from pdr_graph.geometry import interpolate, length_along, row_times, unit, wrap_angle
from pdr_graph.lab.simulation.town_walks import PERIOD, STRIDE, measured_steps
from pdr_graph.priors import BEACONS, INITIAL
from pdr_graph.types import Array, Fixes, Headings, Index, Levels, Steps, Trajectory

WALKERS, DURATION = 12, 300.0  # and the time that they walk [s]
HALL = np.array([90.0, 60.0])  # [m]
WALL_MARGIN = 1.0  # [m] from its walls to the nearest place where a walker turns
BEACON_PLACES = np.array([[22.0, 15.0], [68.0, 15.0], [22.0, 45.0], [68.0, 45.0]])  # [m]
SWITCH_PLACES = np.array([[2.0, 30.0], [88.0, 30.0]])  # [m] beside the doors
TERMINAL, TERMINAL_PLACE = WALKERS, np.array([45.0, 30.0])  # its number among the walkers, and its place [m]
TO_A_SWITCH = 0.15  # share of the legs that lead to a switch: two or three in a walk
SURVEYED = 0.5  # [m] sigma per axis of the places of beacons
PRESSED = 0.75  # [m] the same of a walker about a switch, or about the known start: an arm's length
CORNER_STEPS = 2.0  # [steps] over which corners are cut
SHADOWING, FADING = 7.0, 3.0  # [dB] of a pair of phones: by bodies for a period, and at a moment
PERIOD_OF_SHADOWS = 15.0  # [s]
SENSITIVITY = BEACONS.weakest


@dataclass(frozen=True)
class CrowdWalk:
    """What one walker's phone measures. truth: for scores alone.

    start: the known place; heading: the stated direction there; presses: of switches; levels: of beacons.
    """

    steps: Steps
    truth: Trajectory
    start: Fixes
    heading: Headings
    presses: Fixes
    levels: Levels


@dataclass(frozen=True)
class Receptions:
    """The loudest reception of each pair of phones in each period.

    time: ``(n,)`` [s]; pair: ``(n, 2)`` numbers of walkers, the second may be TERMINAL; rssi: ``(n,)`` [dBm].
    """

    time: Array
    pair: Index
    rssi: Array

    def __len__(self) -> int:
        return len(self.time)


@dataclass(frozen=True)
class Crowd:
    """Walkers at one time in one hall, and the receptions between their phones."""

    walks: tuple[CrowdWalk, ...]
    receptions: Receptions

    def places(self, time: float) -> Array:
        """True places ``(w + 1, 2)`` of the walkers, and of the terminal, at a time [s]. [m]"""
        at = np.array([time])
        walking = [interpolate(at, walk.truth.time, walk.truth.position)[0] for walk in self.walks]
        return np.array([*walking, TERMINAL_PLACE])


def crowd(seed: int, duration: float = DURATION) -> Crowd:
    """Twelve walkers for some time [s]."""
    random = np.random.default_rng(seed)
    power, exponent, shade = random.normal(BEACONS.path_loss, BEACONS.path_loss_sigma)
    beacons = np.column_stack([random.normal(BEACON_PLACES, SURVEYED), random.normal(0, BEACONS.power_sigma, 4)])
    walks = tuple(_walk(random, duration, beacons, (power, exponent, shade)) for _ in range(WALKERS))
    return Crowd(walks, _receptions(walks, random, power, exponent))


def _walk(
    random: np.random.Generator, duration: float, beacons: Array, path_loss: tuple[float, float, float]
) -> CrowdWalk:
    """A walk through the hall. duration [s]; beacons: x, y [m] and power [dB] of each."""
    stride, period = STRIDE * random.normal(1, 0.1), PERIOD * random.normal(1, 0.05)
    n = int(duration / period)
    place, corners = _route(random, stride, n)
    steps = measured_steps(place, random, period)
    move = np.diff(place, axis=0)
    course = np.arctan2(move[:, 1], move[:, 0])
    rows = np.concatenate([place, place[-1:]])
    truth = Trajectory(row_times(steps), rows, np.concatenate([course[:1], course, course[-1:]]))
    start = Fixes(np.zeros(1), place[:1] + random.normal(0, PRESSED, (1, 2)), np.full(1, PRESSED))
    stated = wrap_angle(course[:1] + random.normal(0, INITIAL.heading_sigma, 1))
    heading = Headings(np.zeros(1), np.asarray(stated), np.full(1, INITIAL.heading_sigma), ("start",))
    pressed, switch = corners
    presses = Fixes(truth.time[pressed], SWITCH_PLACES[switch], np.full(len(pressed), PRESSED))
    return CrowdWalk(steps, truth, start, heading, presses, _levels(truth, stride, random, beacons, path_loss))


def _route(random: np.random.Generator, stride: float, n: int) -> tuple[Array, tuple[Index, Index]]:
    """Places ``(n + 1, 2)`` of the feet [m], and the rows at which switches are pressed, with their numbers."""
    goals, switches = [random.uniform(WALL_MARGIN, HALL - WALL_MARGIN)], [-1]
    while length_along(np.array(goals))[-1] < n * stride:
        to_switch = switches[-1] < 0 and random.uniform() < TO_A_SWITCH
        switches.append(int(random.integers(len(SWITCH_PLACES))) if to_switch else -1)
        goals.append(SWITCH_PLACES[switches[-1]] if to_switch else random.uniform(WALL_MARGIN, HALL - WALL_MARGIN))
    line, number = np.array(goals), np.array(switches)
    walked = length_along(line)
    place = gaussian_filter1d(
        interpolate(stride * np.arange(n + 1, dtype=np.float64), walked, line), CORNER_STEPS, axis=0, mode="nearest"
    )
    row = np.rint(walked / stride).astype(np.intp)
    pressed = (number >= 0) & (row <= n)
    return np.asarray(place, dtype=np.float64), (row[pressed], number[pressed])


def _levels(
    truth: Trajectory,
    stride: float,
    random: np.random.Generator,
    beacons: Array,
    path_loss: tuple[float, float, float],
) -> Levels:
    """Mean levels of the beacons by stretches of a walk."""
    row = np.arange(1, len(truth) - 1, max(round(BEACONS.stretch / stride), 1))
    power, exponent, shade = path_loss
    gap = beacons[None, :, :2] - truth.position[row, None]
    distance = np.sqrt(np.sum(gap**2, axis=2) + BEACONS.height**2)
    facing = np.sum(unit(truth.heading[row])[:, None] * gap, axis=2) / distance
    expected = power + beacons[:, 2] - 10 * exponent * np.log10(distance) + shade * facing
    rssi = expected + random.normal(0, BEACONS.level_sigma, expected.shape)
    received, beacon = np.nonzero(rssi > SENSITIVITY)
    labels = tuple(f"beacon {m + 1}" for m in range(len(beacons)))
    surveyed = np.full(len(beacons), SURVEYED)
    return Levels(truth.time[row[received]], beacon, rssi[received, beacon], labels, BEACON_PLACES, surveyed)


def _receptions(walks: tuple[CrowdWalk, ...], random: np.random.Generator, power: float, exponent: float) -> Receptions:
    """The loudest reception of every pair in every period, from one each second."""
    second = np.arange(1.0, min(walk.steps.end for walk in walks))
    of_second = (second // PERIOD_OF_SHADOWS).astype(np.intp)
    still = np.tile(TERMINAL_PLACE, (len(second), 1))
    places = [*(interpolate(second, walk.truth.time, walk.truth.position) for walk in walks), still]
    rows = list[tuple[float, int, int, float]]()
    for i, j in combinations(range(len(places)), 2):
        distance = np.maximum(np.hypot(*(places[i] - places[j]).T), 0.5)
        shadow = random.normal(0, SHADOWING, of_second[-1] + 1)[of_second]
        rssi = power - 10 * exponent * np.log10(distance) + shadow + random.normal(0, FADING, len(second))
        for period in range(of_second[-1] + 1):
            here = np.flatnonzero(of_second == period)
            best = int(here[np.argmax(rssi[here])])
            if rssi[best] > SENSITIVITY:
                rows.append((float(second[best]), i, j, float(rssi[best])))
    rows.sort()
    time, first, other, level = zip(*rows, strict=True)
    return Receptions(np.array(time), np.stack([first, other], axis=1).astype(np.intp), np.array(level))
