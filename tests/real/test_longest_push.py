"""No push of a process is long, from its first on, on recordings."""

from dataclasses import replace

import numpy as np
import pytest
from lives import life

from pdr_graph.online.interface import events_of
from pdr_graph.options import Options
from pdr_graph.types import Fixes
from pdr_graph.walk import read

LONGEST = 0.15  # [s] of CPU on a machine under load; alone they take half
WALKS = {
    "mall, plan, one fix": ("ms_indoor20/site2/F6/5dd4b80e44333f00067aaf7c.txt", True),
    "GNSS at 1 Hz": ("nju_phyphox_outdoor", False),
    "GNSS and beacons": ("ipin2023_track3/IPIN2023_T3_TrainingTrial01_repetition01.txt", False),
}


@pytest.mark.parametrize("name", WALKS)
def test_no_push_is_long(name, data, tmp_path):
    """The first minute and a half."""
    file, with_plan = data / WALKS[name][0], WALKS[name][1]
    plan = file.parent if with_plan else None
    given = read(file, Options(plan=plan))
    fixes, truth = given.fixes, given.walk.truth
    if with_plan:
        fixes = Fixes(truth.time[:1], truth.position[:1], np.ones(1))
    events = [event for event in events_of(replace(given.walk, fixes=fixes)) if time_of(event) < 90.0]
    longest, loaded, steps = life(events, plan or "", tmp_path)
    assert not loaded
    assert longest < LONGEST
    assert steps > 30


def time_of(event):
    """When an event is over. [s]"""
    return float((event.heard if hasattr(event, "heard") else event).time[-1])
