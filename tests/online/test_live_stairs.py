"""Steps on stairs are as long as the treads on a walk under way, although a climb shows seconds after it began."""

from functools import cache

import numpy as np
import pytest

from pdr_graph import detect_steps
from pdr_graph.estimation.floors import floors_along
from pdr_graph.inertial.barometer import with_stair_lengths
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.online.interface import Samples, events_of
from pdr_graph.online.navigator import Navigator
from pdr_graph.types import Fixes


@cache
def climbing():
    """A walk up the stairs and down in the lift: its recording, and the steps of the batch."""
    recording = simulate(Scenario.load("stairs")).recording()
    steps = detect_steps(recording)
    floors = floors_along(steps, recording.barometer, "1", Fixes.none(), None)
    return recording, steps, with_stair_lengths(steps, floors.climbs, floors.kinds)


def walked(nav):
    """Length of the dead reckoning. [m]"""
    return float(np.hypot(*np.diff(nav.finish().dead_reckoning.position, axis=0).T).sum())


@pytest.mark.parametrize("lag", [None, 20.0])
def test_live_steps_on_stairs_are_those_of_the_batch(lag):
    recording, level, batch = climbing()
    nav = Navigator(lag=lag)
    for event in events_of(recording):
        nav.push(event)
    assert level.length.sum() - batch.length.sum() > 3.0
    assert walked(nav) == pytest.approx(batch.length.sum(), abs=0.8)


def test_a_barometer_that_stops_on_the_stairs_does_not_shorten_the_rest_of_the_walk():
    recording, level, batch = climbing()
    on = np.flatnonzero(batch.length != level.length)
    stop, nav = level.time[on[0]] + 9.0, Navigator(lag=None)
    for event in events_of(recording):
        if not (isinstance(event, Samples) and event.sensor == "barometer" and event.time[-1] > stop):
            nav.push(event)
    assert nav._floors.pressure.shape == (0, 2)  # it has noticed
    steps = nav._graph.graph.window.steps.steps  # the certain ones
    usual = level.length[(level.time > stop + 8.0) & (level.time < steps.time[-1] + 0.2)].sum()
    assert steps.length[steps.time > stop + 8.0].sum() == pytest.approx(usual, rel=0.03)
