"""Attack the live navigator with hostile streams, for docs/reliability.md: latency, memory, and what the status says.

    python scripts/hostile_streams.py [--write] [--limit SECONDS] [--idle] [PART OF A NAME …]

Each attack has a process of its own. Nothing is computed in idle moments: a push has all the work that is due; but with
--idle, as `replay` and `serve` do, whose times are not those of a push.
"""

import argparse
import multiprocessing
import time
import traceback
import warnings
from array import array

import numpy as np
from live_speed import resident
from stream_attacks import ATTACKS
from tables import publish, table

from pdr_graph.online.interface import Samples, Scan
from pdr_graph.online.navigator import Navigator
from pdr_graph.types import Steps

LIMIT = 300.0  # [s] of CPU time, after which an attack is broken off
HANDED_OUT = 100  # poses after which finalised rows are taken away
OF_PUSH = ["push p99 [ms]", "max", "first half, p99", "second half, p99"]
HEADER = ["attack", "events", "walk [h]", *OF_PUSH, "pose p99 [ms]", "MB grown", "the status says"]


def attack(name, limit, idle):
    """One row of the table."""
    warnings.simplefilter("ignore")
    stream = ATTACKS[name]()
    nav, push, pose, memory = Navigator(**stream.options), array("d"), array("d"), array("d")
    issues, now, began, end = {}, 0.0, time.process_time(), ""
    try:
        for event in stream.events:
            before = time.process_time()
            nav.push(event)
            push.append(time.process_time() - before)
            if idle:
                nav.review()
            now = max(now, moment(event, now))
            if len(push) % 50 == 0:
                issues |= look(nav, pose)
                if len(pose) % HANDED_OUT == 0:
                    nav.finalized()
                    memory.append(resident())
            if time.process_time() - began > limit:
                end = f"broken off after {limit:.0f} s; "
                break
        issues |= look(nav, pose)
        nav.finish()
    except Exception as error:
        traceback.print_exc()
        end = f"**{type(error).__name__}** at {now:.0f} s; "
    missing = "" if stream.said in " ".join(issues) else f"**no word of {stream.said!r}**; "
    took, memory = np.append(0.0, push) * 1e3, np.append(memory, resident())
    half = len(took) // 2
    p99 = [f"{np.percentile(part, 99):.1f}" for part in (took[:half], took[half:]) if len(part)]
    said = end + missing + "; ".join(issues)
    grown = memory[-1] - memory[len(memory) // 2]
    return [name, len(took), f"{now / 3600:.2f}", f"{np.percentile(took, 99):.1f}", f"{took.max():.0f}", *p99,
            f"{1e3 * np.percentile(np.append(0.0, pose), 99):.1f}", f"{grown:.0f}", said]  # fmt: skip


def moment(event, now):
    """The time of an event [s], as far as it is one of this walk."""
    if isinstance(event, Steps):
        return event.end
    if isinstance(event, (Samples, Scan)):
        return now
    return float(event.time[-1]) if len(event.time) and abs(event.time[-1] - now) < 3600 else now


def look(nav, pose):
    """Ask for pose and status: time taken appended; the issues, without their numbers."""
    before = time.process_time()
    here = nav.pose
    pose.append(time.process_time() - before)
    assert here is None or np.isfinite([here.x, here.y, here.heading, *here.covariance.ravel()]).all()
    return {" ".join(w for w in line.split() if not w[0].isdigit()): None for line in nav.status.issues}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", help="parts of names")
    parser.add_argument("--limit", type=float, default=LIMIT, help="CPU time of one attack [s]")
    parser.add_argument("--idle", action="store_true", help="long answers in idle moments between the events")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    names = [name for name in ATTACKS if not options.names or any(part in name for part in options.names)]
    rows = []
    for name in names:
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            rows.append(pool.apply(attack, (name, options.limit, options.idle)))
        print(*rows[-1], sep=" | ", flush=True)
    publish("reliability.md", "hostile streams", table(HEADER, rows))


if __name__ == "__main__":
    main()
