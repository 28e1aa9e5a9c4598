"""Long synthetic walks for tests and benchmarks: steps, fixes, and both as events of a live walk."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from walks import part

from pdr_graph import dead_reckon
from pdr_graph.geometry import interpolate, length_along
from pdr_graph.types import Fixes, Steps

LOOP = Path(__file__).resolve().parent.parent / "maps" / "loop.geojson"
PERIOD = 0.53  # [s] per step
LOOP_LOW, LOOP_HIGH = np.array([1.25, 1.25]), np.array([43.75, 26.75])  # [m] corners of the centre line of LOOP


def walk(n, every):
    """``n`` measured steps, with a fix of 3 m sigma every ``every`` steps, between step times."""
    return walk_and_truth(n, every)[:2]


def walk_and_truth(n, every, seed=0):
    """Steps and fixes of `walk`, and the true trajectory."""
    random = np.random.default_rng(seed)
    time_, sigma_length, sigma_turn = PERIOD * np.arange(1, n + 1), np.full(n, 0.07), np.full(n, 0.02)

    def steps(length, turn):
        pauses = np.zeros(n)
        return Steps(0.0, time_[-1] + 0.5, time_, np.full(n, PERIOD), length, turn, pauses, sigma_length, sigma_turn)

    length, turn = random.normal(0.7, 0.05, n), random.normal(0, 0.1, n)
    truth = dead_reckon(steps(length, turn))
    at = np.arange(every, n + 1, every)
    place = truth.position[at] + random.normal(0, 3, (len(at), 2))
    fixes = Fixes(truth.time[at] - 0.1, place, np.full(len(at), 3.0), ("",) * len(at))
    measured = steps(length * 0.95 + random.normal(0, 0.07, n), turn * 0.99 + random.normal(0, 0.02, n) - 0.0005)
    return measured, fixes, truth


def held_by_walls(n, period=PERIOD):
    """Laps of a corridor loop, ``n`` steps of ``period`` [s], with a fix of 3 m every 30 steps."""
    sides = (LOOP_HIGH - LOOP_LOW) / 0.7
    corners = np.cumsum(np.resize([sides[0], sides[1]], n)).astype(int)
    turn, random = np.zeros(n), np.random.default_rng(0)
    turn[corners[corners < n]] = np.pi / 2
    ones = np.ones(n)
    time_ = period * np.arange(1, n + 1)
    steps = Steps(0.0, time_[-1] + 0.5, time_, period * ones, 0.7 * ones, turn, 0 * ones, 0.07 * ones, 0.02 * ones)
    way = np.cumsum(0.7 * ones) % (2 * (LOOP_HIGH - LOOP_LOW).sum())
    knots = np.array([LOOP_LOW, [LOOP_HIGH[0], LOOP_LOW[1]], LOOP_HIGH, [LOOP_LOW[0], LOOP_HIGH[1]], LOOP_LOW])
    place = interpolate(way, length_along(knots), knots)
    at = np.arange(0, n, 30)
    fixes = Fixes(time_[at], place[at] + random.normal(0, 3, (len(at), 2)), np.full(len(at), 3.0), ("",) * len(at))
    return steps, fixes


def live_events(steps, fixes):
    """Yield each step as it ends, and each fix before the step in which it was taken."""
    steps, fix = replace(steps, end=float(steps.time[-1])), 0
    for k, end in enumerate(steps.time.tolist()):
        while fix < len(fixes) and fixes.time[fix] <= end:
            yield fixes[fix : fix + 1]
            fix += 1
        yield part(steps, k, k + 1)
