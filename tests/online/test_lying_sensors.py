"""Sensors and receivers that lie to `Navigator`: the region holds, or the verdict says that something is wrong.

A walk outdoors with GNSS once a second, of 4.5 m. What is promised of each lie: docs/limits.md.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from simulated import scenario

from pdr_graph.geometry import REGION_90, interpolate
from pdr_graph.inertial.attitude import NO_GYROSCOPE
from pdr_graph.io.validation import RADIUS_68
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.online.interface import Samples, events_of
from pdr_graph.online.navigator import Navigator
from pdr_graph.types import Fixes

ROUTE = [(0, 0), (35, 10), (45, 50), (5, 60), (-10, 40)]
LATER = 45.0  # [s] from which some lie


@cache
def walk():
    """The events of the walk and its truth."""
    made = simulate(scenario(ROUTE, seed=1, phone={"rate": 50}, gnss={"accuracy": 4.5}))
    gnss = replace(made.gnss.fixes, sigma=made.gnss.accuracy / RADIUS_68, source=("GNSS",) * len(made.gnss.accuracy))
    recording = replace(made.recording("accelerometer", "gyroscope", "magnetometer"), fixes=gnss)
    return list(events_of(recording, packet=0.5)), made.frame, made.truth


def samples(change, *sensors):
    """A lie of sensors: their values changed, by times and values."""
    sensors = sensors or ("gyroscope",)

    def lie(event):
        if isinstance(event, Samples) and event.sensor in sensors:
            return [replace(event, values=change(event.time, event.values))]
        return [event]

    return lie


def fixes(change):
    """A lie of the receiver."""
    return lambda event: [change(event) if isinstance(event, Fixes) else event]


def silent(begin, end=np.inf):
    """All sensors stop for a time [s], or for good, while the receiver goes on."""
    return lambda event: [event] if isinstance(event, Fixes) or not begin < event.time[-1] < end else []


def bursts(time, values):
    shaken = time % 40 < 0.5
    return np.where(shaken[:, None], 1e3 * np.sign(np.sin(1e5 * time))[:, None], values)


def some_missing(time, values):
    return np.where(np.random.default_rng(int(1e3 * time[0])).random(values.shape) < 0.01, np.nan, values)


def moved(fix):
    return replace(fix, position=fix.position + np.where(fix.time[:, None] > LATER, 21.0, 0.0))


def ahead(seconds):
    return fixes(lambda fix: replace(fix, time=fix.time + seconds))


# name: the lie, least share of poses in their region, whether the verdict must not be "ok"
LIES = {
    "honest": (lambda event: [event], 0.95, False),
    "each packet twice": (lambda event: [event, event], 0.95, False),
    "1 % of the samples NaN": (samples(some_missing, "gyroscope", "accelerometer"), 0.95, False),
    "gyroscope in degrees": (samples(lambda _, values: np.degrees(values)), 0.95, False),
    "bursts of the gyroscope": (samples(bursts), 0.9, False),
    "gyroscope hangs": (samples(lambda time, values: np.where(time[:, None] > LATER, 0.1, values)), 0.85, False),
    "all sensors stop": (silent(LATER), 0.85, False),
    "all sensors stop for half a minute": (silent(LATER, LATER + 30.0), 0.85, False),
    "accelerations of the opposite sign": (samples(lambda _, values: -values, "accelerometer"), 0.95, False),
    "axes of the gyroscope swapped": (samples(lambda _, values: values[:, [1, 0, 2]]), 0.85, False),
    "clock of the receiver 5 s ahead": (ahead(5.0), 0.85, False),
    "clock of the receiver 40 s ahead": (ahead(40.0), 0.75, False),
    "gyroscope of the wrong sign": (samples(lambda _, values: -values), 0.0, True),
    "receiver 30 m off from one moment on": (fixes(moved), 0.0, True),
}


def lived(lie):
    """Share of the poses in their region of 90 %, and the navigator."""
    events, frame, truth = walk()
    nav, poses = Navigator(frame=frame), []
    for event in events:
        for one in lie(event):
            nav.push(one)
        if isinstance(event, Fixes) and nav.pose is not None and nav.pose.placed:
            poses.append(nav.pose)
    time = np.array([pose.time for pose in poses])
    off = np.array([[pose.x, pose.y] for pose in poses]) - interpolate(time, truth.time, truth.position)
    covariance = np.array([pose.covariance[:2, :2] for pose in poses])
    distance = np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariance), off)
    return np.mean(distance < REGION_90), nav


@pytest.mark.thorough
@pytest.mark.parametrize("name", LIES)
def test_no_lie_of_a_sensor_is_wrong_and_sure(name):
    lie, least, doubted = LIES[name]
    share, nav = lived(lie)
    assert share >= least
    assert nav.status.verdict.state != "ok" or not doubted
    assert (NO_GYROSCOPE in nav.unknown) == (name == "gyroscope hangs")
