"""How time and memory of the graph grow with the walk, from 10³ to 10⁶ steps; each length in a process of its own.

``python scripts/scaling.py STEPS`` prints {"walk", "smooth": [CPU, s], "memory", "before": [MB]} of one.
"""

import json
import re
import subprocess
import sys
import time
from pathlib import Path

from tables import table

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))

from synthetic_walks import walk

from pdr_graph import WalkGraph, smooth

LENGTHS = (1000, 3000, 10_000, 30_000, 100_000, 300_000, 1_000_000)  # steps
EVERY = 30  # steps between fixes
ENOUGH = 2.0  # [s] of CPU after which a measurement is not repeated
MOST_RUNS = 5


def scaling_rows():
    """Time of building and solving, with the covariance of every step, and memory beyond that of the walk itself."""
    rows = []
    for steps in LENGTHS:
        found = json.loads(
            subprocess.run([sys.executable, __file__, str(steps)], check=True, stdout=subprocess.PIPE).stdout
        )
        took, more = found["seconds"], found["memory"] - found["before"]
        rows.append([f"{steps:,}".replace(",", " "), f"{took:.3f}", f"{1e6 * took / steps:.1f}", f"{more:.0f}"])
        rows[-1] += [f"{1e3 * more / steps:.1f}", f"{found['memory']:.0f}"]
    return table(["steps", "CPU [s]", "µs per step", "memory [MB]", "kB per step", "of the process [MB]"], rows)


def measured(steps):
    """The least CPU time of a few runs, and the most memory of this process [MB]."""
    said, fixes = walk(steps, EVERY)
    before, took = _memory(), []
    while len(took) < MOST_RUNS and sum(took) < ENOUGH:
        began = time.process_time()
        smooth(WalkGraph(said, fixes))
        took.append(time.process_time() - began)
    return {"seconds": min(took), "before": before, "memory": _memory()}


def _memory():
    """The most that this program has taken [MB]; ru_maxrss would count what it was forked from."""
    status = Path("/proc/self/status").read_text()
    return int(re.search(r"VmHWM:\s+(\d+)", status)[1]) / 1024


if __name__ == "__main__":
    print(json.dumps(measured(int(sys.argv[1]))) if sys.argv[1:] else scaling_rows())
