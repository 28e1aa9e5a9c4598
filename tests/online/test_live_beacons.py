"""A live walk that only the plan's beacons place, without any fix."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from tiers import thorough

from pdr_graph import FloorPlan, evaluate
from pdr_graph.io.tables import drawn_beacons
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.online.interface import Samples, Scan, events_of
from pdr_graph.online.navigator import Navigator
from pdr_graph.types import Sightings

ROOT = Path(__file__).resolve().parents[2]
END = 22.0  # [s] of the walk


@cache
def mall():
    """The plan of the mall, its beacons, the events of a walk's first 22 s, and its truth."""
    plan = FloorPlan.load(ROOT / "maps" / "mall.geojson")
    walk = simulate(replace(Scenario.load("mall"), seed=12))
    recording = replace(walk.recording(), bluetooth=walk.bluetooth)
    beacons = drawn_beacons([(area, "1") for area in plan.of_kind("beacon")], recording)
    events = tuple(event for event in events_of(recording) if moment(event) < END)
    return plan, beacons, events, walk.truth


def moment(event):
    return float((event.heard if isinstance(event, Scan) else event).time[-1])


def navigated(events):
    """The last pose and the smoothed trajectory."""
    plan, beacons, _, _ = mall()
    nav = Navigator(plan, beacons=beacons, epoch=1.7e9)
    for event in events:
        nav.push(event)
    return nav.pose, nav.finish().trajectory


@cache
def plain():
    return navigated(mall()[2])


def test_the_compass_tells_the_direction_without_a_fix():
    """The georeferenced plan says where on earth it is."""
    truth, (pose, trajectory) = mall()[3], plain()
    there = [float(np.interp(pose.time, truth.time, axis)) for axis in truth.position.T]
    assert np.hypot(pose.x - there[0], pose.y - there[1]) < 5.0
    assert abs(pose.heading) < 3 * np.sqrt(pose.covariance[2, 2]) < 0.9
    assert evaluate(trajectory, truth)["ce"]["p50"] < 3.0  # the batch has 1.4 m


@pytest.mark.thorough
def test_without_a_magnetometer_the_direction_stays_open_and_is_said_to():
    blind = [one for one in mall()[2] if not (isinstance(one, Samples) and one.sensor == "magnetometer")]
    assert len(navigated(blind)[0].modes) > 6


@pytest.mark.parametrize("radio", ["wifi", thorough("bluetooth")])
def test_access_points_with_the_addresses_of_beacons_are_no_beacons(radio):
    """Their levels led the walk 60 m astray; as advertisements they count."""
    _, beacons, events, _ = mall()
    far_away = Sightings(np.full(3, 10.0), beacons.name[5:8], np.full(3, -50.0))
    place = next(n for n, event in enumerate(events) if moment(event) > 10.0)
    _, trajectory = navigated([*events[:place], Scan(radio, far_away), *events[place:]])
    assert np.array_equal(trajectory.position, plain()[1].position) == (radio == "wifi")
