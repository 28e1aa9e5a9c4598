"""The construction of a navigator loads what its pushes need: none of a process's life is long."""

from dataclasses import replace

import numpy as np
import pytest
from lives import life

from pdr_graph.online.interface import events_of
from pdr_graph.options import Options
from pdr_graph.types import Fixes
from pdr_graph.walk import read

LONGEST = 0.1  # [s] of CPU


@pytest.mark.parametrize("with_plan", [False, True])
def test_no_push_of_a_process_is_long(with_plan, arcade_walk, tmp_path):
    plan = arcade_walk / "plan.geojson"
    given = read(arcade_walk, Options(plan=plan, fixes=arcade_walk / "fixes.csv"))
    longest, loaded, steps = life(
        events_of(replace(given.walk, fixes=given.fixes)), plan if with_plan else "", tmp_path
    )
    assert not loaded
    assert longest < LONGEST
    assert steps > 30


def test_no_push_with_fixes_on_earth_is_long(arcade_walk, tmp_path):
    """The first of them defines the frame, by the map projections."""
    walk = read(arcade_walk, Options()).walk
    time = np.arange(5.0, 40.0)
    place = np.array([11.5755, 48.1374]) + 1e-5 * time[:, None]
    fixes = Fixes(time, place, np.full(len(time), 5.0), ("gps",) * len(time), epsg=4326)
    longest, loaded, _ = life(events_of(replace(walk, fixes=fixes)), "", tmp_path)
    assert not loaded
    assert longest < LONGEST
