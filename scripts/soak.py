"""A walk of 72 hours in minutes: latency and memory of the live navigator per 6 hours, for docs/reliability.md.

    python scripts/soak.py [--hours H] [--walking M] [--write]

Steps, fixes and scans of beacons are pushed, not samples. In every hour the walker walks laps of maps/loop between its
walls for some minutes and hears its beacons; else a step a minute and a fix every ten; now and then all is silent for
half an hour. Idle moments are used by `Navigator.review`, whose time is a column of its own.
"""

import argparse
import gc
import time
import warnings
from array import array

import numpy as np
from live_speed import LAG, LOOP, resident
from stream_attacks import PERIOD, heard, later
from synthetic_walks import held_by_walls
from tables import publish, table

from pdr_graph import FloorPlan
from pdr_graph.gait.step_chunks import gap
from pdr_graph.online.navigator import Navigator
from pdr_graph.types import Beacons, Fixes, Steps

HOUR, BLOCK = 3600.0, 6 * 3600.0  # [s]
WALKING = 10.0  # [min] of each hour
SILENT_HOURS, SILENCE = 5, 1800.0  # each fifth hour ends with a silence [s]
BEACONS, NEAR, SCANS = 60, 12.0, 4.0  # number; [m] within which they are heard; [s] between scans
HANDED_OUT = 200  # events after which finalised rows are taken away
OF_PUSH = ["push p50 [ms]", "p99", "max"]
HEADER = ["hours", "events", *OF_PUSH, "pose p99 [ms]", "review max [ms]", "RSS [MB]", "keyframes", "restarts"]


def beacons(place):
    """Beacons along the laps."""
    at = place[np.linspace(0, len(place) - 1, BEACONS).astype(int)]
    names = tuple(f"b{n}" for n in range(BEACONS))
    return Beacons(names, at, np.ones(BEACONS), ("",) * BEACONS, names)


def hour_of(begin, walking, number, listed):
    """Events of an hour that begins at ``begin`` [s]: a walk, rest, and sometimes silence."""
    steps, fixes = held_by_walls(int(60 * walking / PERIOD), period=PERIOD)
    fix = 0
    for k in range(len(steps)):
        end = float(steps.time[k])
        while fix < len(fixes) and fixes.time[fix] <= end:
            yield later(fixes[fix : fix + 1], begin)
            fix += 1
        columns = {name: v[k : k + 1] for name, v in vars(steps).items() if isinstance(v, np.ndarray)}
        yield later(Steps(end - PERIOD, end, **columns), begin)
        if end % SCANS < PERIOD:
            place = np.array([np.interp(end, fixes.time, axis) for axis in fixes.position.T])
            near = np.flatnonzero(np.hypot(*(listed.position - place).T) < NEAR)
            yield later(heard(end - 0.1, near), begin)
    place, now = fixes.position[-1:], begin + float(steps.time[-1])
    until = begin + HOUR - (SILENCE if number % SILENT_HOURS == SILENT_HOURS - 1 else 0.0)
    count = 0
    while now + 60.0 <= until:
        one, count = np.ones(1), count + 1
        at = np.array([now + 60.0])
        yield Steps(now, now + 60.0, at, 0.6 * one, 0.1 * one, 0 * one, 0 * one, 0.07 * one, 0.05 * one)
        now += 60.0
        if count % 10 == 0:
            yield Fixes(at - 1.0, place + np.random.default_rng(count).normal(0, 3, 2), 3.0 * one)
    if now < begin + HOUR:
        yield gap(now, begin + HOUR)


def soak(hours, walking):
    """Yield a row of the table for every BLOCK."""
    listed = beacons(held_by_walls(200, period=PERIOD)[1].position)
    nav = Navigator(FloorPlan.load(LOOP), lag=LAG, beacons=listed)
    push, pose, review, count = array("d"), array("d"), array("d"), 0
    for number in range(int(hours)):
        for event in hour_of(number * HOUR, walking, number, listed):
            moments = [time.process_time()]
            nav.push(event)
            moments.append(time.process_time())
            here = nav.pose
            moments.append(time.process_time())
            nav.review()
            moments.append(time.process_time())
            assert here is None or np.isfinite([here.x, here.y, *here.covariance.ravel()]).all()
            for column, took in zip((push, pose, review), np.diff(moments), strict=True):
                column.append(1e3 * took)
            count += 1
            if count % HANDED_OUT == 0:
                nav.finalized()
        if (number + 1) * HOUR % BLOCK == 0 or number + 1 == int(hours):
            gc.collect()
            status = nav.status
            spread = [f"{np.percentile(push, q):.1f}" for q in (50, 99, 100)]
            row = [f"{max(0, number - 5)} to {number + 1}", len(push), *spread, f"{np.percentile(pose, 99):.1f}"]
            yield [*row, f"{max(review):.0f}", f"{resident():.0f}", status.keyframes, status.restarts]
            push, pose, review = array("d"), array("d"), array("d")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--hours", type=float, default=72.0)
    parser.add_argument("--walking", type=float, default=WALKING, help="minutes of each hour")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    rows, began = [], time.process_time()
    for row in soak(options.hours, options.walking):
        rows.append(row)
        print(*row, sep=" | ", flush=True)
    took = (time.process_time() - began) / 60
    said = f"{options.hours:.0f} h, {options.walking:g} min of walking an hour: {took:.1f} min of CPU time."
    publish("reliability.md", "soak", f"{said}\n\n{table(HEADER, rows)}")


if __name__ == "__main__":
    main()
