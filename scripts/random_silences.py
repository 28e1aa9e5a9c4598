"""Silences of all sensors at random places of a walk: exceptions and the longest push, for docs/reliability.md.

    python scripts/random_silences.py [--count N] [--samples] [--seed N]

The walk is the arcade's, as samples at 100 Hz or as its steps. Silences are of 10 s to an hour.
Nothing is computed in idle moments: a push has all the work that is due.
"""

import argparse
import time
import traceback
import warnings

import numpy as np
from live_speed import said_events
from stream_attacks import arcade, later, recording

from pdr_graph import detect_steps
from pdr_graph.gait.step_chunks import gap
from pdr_graph.online.interface import events_of
from pdr_graph.online.navigator import Navigator
from pdr_graph.types import Fixes, Steps

SHORTEST, LONGEST = 10.0, 3600.0  # [s] silences
LAG = 60.0  # [s]


def silenced(events, at, seconds):
    """Events with a silence from the first one at ``at`` [s] on; all is later by ``seconds`` afterwards."""
    silent = False
    for event in events:
        first = event.start if isinstance(event, Steps) else float(event.time[0])
        if first >= at and not silent and not isinstance(event, Fixes):
            silent = True
            if isinstance(event, Steps):
                yield gap(event.start, event.start + seconds)
        yield later(event, seconds) if silent else event


def longest_push(events, options):
    """The longest push, and the time of its event in the walk, [s]; poses are looked at now and then."""
    nav, longest, when = Navigator(lag=LAG, **options), 0.0, 0.0
    for n, event in enumerate(events):
        before = time.process_time()
        nav.push(event)
        took = time.process_time() - before
        if took > longest:
            longest, when = took, event.end if isinstance(event, Steps) else float(event.time[-1])
        if n % 20 == 0 and (pose := nav.pose) is not None:
            assert np.isfinite([pose.x, pose.y, *pose.covariance.ravel()]).all(), "pose not finite"
    track = nav.finish().trajectory
    assert np.isfinite(track.position).all(), "walk not finite"
    return longest, when


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--samples", action="store_true", help="push samples instead of steps")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    walk, random = recording(), np.random.default_rng(options.seed)
    events = list(events_of(walk) if options.samples else said_events(detect_steps(walk), walk.fixes))
    end = float(walk.accelerometer.time[-1])
    for plan in (True, False):
        took, failed = [], 0
        for _ in range(options.count):
            at, seconds = random.uniform(5, end - 5), SHORTEST * (LONGEST / SHORTEST) ** random.random()
            try:
                took.append((*longest_push(silenced(events, at, seconds), arcade() if plan else {}), at, seconds))
            except Exception:
                failed += 1
                print(f"at {at:.1f} s, {seconds:.1f} s, plan {plan}")
                traceback.print_exc()
        worst = max(took)
        print(f"plan {plan}: {options.count} silences, {failed} exceptions; the longest push: median of walks "
              f"{np.median([t[0] for t in took]):.2f} s, max {worst[0]:.2f} s (at {worst[1]:.0f} s; silence of "
              f"{worst[3]:.0f} s at {worst[2]:.0f} s)", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
