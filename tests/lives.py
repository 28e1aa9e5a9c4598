"""Whole lives of processes with one navigator: how long the longest push is."""

import json
import pickle
import subprocess
import sys

LIFE = """
import json, pickle, sys, time
from pathlib import Path
from pdr_graph import FloorPlan, Navigator
file, plan = sys.argv[1:]
events = pickle.loads(Path(file).read_bytes())
nav, longest, loaded = Navigator(FloorPlan.load(plan) if plan else None, executor=None), 0.0, set()
there = set(sys.modules)
for event in events:
    began = time.thread_time()
    nav.push(event)
    nav.pose, nav.status
    longest = max(longest, time.thread_time() - began)
    nav.review()
    loaded |= set(sys.modules) - there
print(json.dumps([longest, sorted(loaded), nav.steps]))
"""


def life(events, plan, folder):
    """Longest push with its pose [s], the modules that pushes loaded, and the steps, of a process of its own."""
    file = folder / "events"
    file.write_bytes(pickle.dumps(list(events)))
    line = [sys.executable, "-c", LIFE, str(file), str(plan)]
    ended = subprocess.run(line, capture_output=True, text=True, timeout=300, check=True)
    return json.loads(ended.stdout)
