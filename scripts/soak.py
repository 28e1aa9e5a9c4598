"""A walk of 72 hours in minutes: latency and memory of the live navigator in every 6 hours.

    python scripts/soak.py [HOURS]

In every hour the walker walks laps of maps/loop between its walls for ten minutes and hears its beacons. Then there is
a step a minute and a fix every ten; every fifth hour ends with half an hour without data. Steps, fixes and scans are
pushed, not samples. Idle moments are used by `Navigator.review`.
"""

import gc
import resource
import sys
import time
import warnings
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))

from synthetic_walks import LOOP, held_by_walls, live_events

from pdr_graph import FloorPlan
from pdr_graph.gait.step_chunks import gap, shifted
from pdr_graph.online.interface import Scan
from pdr_graph.online.navigator import Navigator
from pdr_graph.types import Beacons, Fixes, Sightings, Steps

HOUR, BLOCK, WALKING, SILENCE = 3600.0, 6, 600.0, 1800.0  # [s], hours of a row, [s] of walking, [s] without data
PERIOD, LAG = 0.5, 60.0  # [s]
BEACONS, NEAR = 60, 12.0  # number; [m] within which they are heard


def resident():
    """Memory of this process now [MB]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 1e6


def hour(number, beacons):
    """Yield the events of an hour: a walk, rest, and sometimes silence."""
    begin, random = number * HOUR, np.random.default_rng(number)
    steps, fixes = held_by_walls(int(WALKING / PERIOD), period=PERIOD)
    for event in live_events(shifted(steps, begin), fixes.shifted(begin)):
        yield event
        if isinstance(event, Steps) and event.end % 4.0 < PERIOD:
            place = np.array([np.interp(event.end - begin, fixes.time, axis) for axis in fixes.position.T])
            near = np.flatnonzero(np.hypot(*(beacons.position - place).T) < NEAR)
            names, levels = tuple(beacons.name[n] for n in near), random.uniform(-95, -60, len(near))
            yield Scan("bluetooth", Sightings(np.full(len(near), event.end - 0.1), names, levels))
    now, end, one = begin + float(steps.time[-1]), begin + HOUR, np.ones(1)
    rest = np.arange(now + 60.0, end - (SILENCE if number % 5 == 4 else 0.0), 60.0)
    for count, moment in enumerate(rest.tolist(), start=1):
        at = np.array([moment])
        yield Steps(now, moment, at, 0.6 * one, 0.1 * one, 0 * one, 0 * one, 0.07 * one, 0.05 * one)
        now = moment
        if count % 10 == 0:
            yield Fixes(at - 1.0, fixes.position[-1:] + random.normal(0, 3, 2), 3.0 * one)
    yield gap(now, end)


def main(hours):
    """Print a row for every BLOCK."""
    warnings.simplefilter("ignore")
    place = held_by_walls(200, period=PERIOD)[1].position
    place = place[np.linspace(0, len(place) - 1, BEACONS).astype(int)]
    names = tuple(f"b{n}" for n in range(BEACONS))
    beacons = Beacons(names, place, np.ones(BEACONS), ("",) * BEACONS, names)
    nav, took = Navigator(FloorPlan.load(LOOP), lag=LAG, beacons=beacons, executor=None), []
    print("hours, events, push p50 / p99 / max [ms], pose p99 [ms], review max [ms], MB, keyframes, restarts")
    for number in range(hours):
        for count, event in enumerate(hour(number, beacons)):
            moments = [time.process_time()]
            for work in (lambda event=event: nav.push(event), lambda: nav.pose, nav.review):
                work()
                moments.append(time.process_time())
            took.append(1e3 * np.diff(moments))
            assert nav.pose is None or np.isfinite([nav.pose.x, nav.pose.y, *nav.pose.covariance.ravel()]).all()
            if count % 200 == 0:
                nav.finalized()
        if (number + 1) % BLOCK == 0 or number + 1 == hours:
            gc.collect()
            push, pose, review = np.array(took).T
            spread, status = " / ".join(f"{p:.1f}" for p in np.percentile(push, [50, 99, 100])), nav.status
            cells = [number + 1, len(took), spread, f"{np.percentile(pose, 99):.1f}", f"{review.max():.0f}"]
            print(*cells, f"{resident():.0f}", status.keyframes, status.restarts, sep=", ", flush=True)
            took = []


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 72)
