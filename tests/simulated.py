"""A short walk with a phone in the hand and uniform samples, for tests that build their own recordings."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from plans import ARCADE

from pdr_graph import FloorPlan, detect_steps
from pdr_graph.frames import enu
from pdr_graph.gait.walker import Walker
from pdr_graph.lab.simulation.recorders import write
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.types import LONLAT, Fixes, Recording, Signal

RATE = 50.0  # [Hz]
START = 1.7e9  # Unix time [s]
ROUTE = np.array([(2.5, 18.0), (6.8, 18.2), (6.8, 27.8), (27.6, 27.6), (27.9, 8.0), (40.0, 7.7)])  # [m] in the arcade
GYRO_BIAS = np.array([0.003, -0.002, 0.002])  # [rad/s]


@dataclass(frozen=True)
class Walk:
    """Measurements of the phone in device axes, and the truth: vertical, position [m], heading [rad], landings [s]."""

    time: np.ndarray
    acceleration: np.ndarray
    angular_rate: np.ndarray
    up: np.ndarray
    position: np.ndarray
    heading: np.ndarray
    landings: np.ndarray


def scenario(route, seed=0, **more):
    """A scenario with two seconds of standing before and after a route."""
    corners = [[float(x), float(y)] for x, y in route]
    given = {"seed": seed, "start": START, "route": [corners[0], {"stand": 2}, {"to": corners[1:]}, {"stand": 2}]}
    return Scenario.of(given | more)


@cache
def scenario_walk(name, **changes):
    """The simulation of a scenario of the package, and the steps of its recording; nobody changes them."""
    made = simulate(replace(Scenario.load(name), **changes))
    return made, detect_steps(made.recording(), Walker(height=made.walker.height))


@cache
def walk_in_the_arcade():
    """The steps, the true trajectory and the plan of a walk of 40 s through the arcade."""
    route = [[2.5, 18.0], {"stand": 2}, {"to": [[6.8, 18.2], [6.8, 27.8], [27.6, 27.6], [27.9, 8.0]]}, {"stand": 2}]
    made = simulate(Scenario.of({"route": route, "plan": str(ARCADE), "phone": {"rate": RATE}}))
    return detect_steps(made.recording("accelerometer", "gyroscope")), made.truth, FloorPlan.load(ARCADE)


def walk_along(route, seed=0):
    walk = simulate(scenario(route, seed, phone={"rate": RATE}))
    random, every = np.random.default_rng(seed), round(walk.body.rate / RATE)
    acceleration, angular_rate = walk.motion.acceleration[::every], walk.motion.angular_rate[::every]
    return Walk(
        time=walk.body.time[::every],
        acceleration=acceleration + random.normal(0, 0.05, acceleration.shape),
        angular_rate=angular_rate + GYRO_BIAS + random.normal(0, 0.003, angular_rate.shape),
        up=walk.motion.R_world_device.inv().apply([0.0, 0.0, 1.0])[::every],
        position=walk.body.position[::every],
        heading=walk.body.heading[::every],
        landings=walk.body.landings,
    )


def with_receiver(walk, every):
    """A recording of accelerometer, gyroscope and a fix of 2 m every so many samples, where latitude is 48 degrees."""
    places = enu(48.0, 11.0).to_lonlat(walk.position[::every])
    sources = ("GNSS",) * len(places)
    fixes = Fixes(walk.time[::every], places, np.full(len(places), 2.0), (), LONLAT, sources)
    signals = {"accelerometer": Signal(walk.time, walk.acceleration), "gyroscope": Signal(walk.time, walk.angular_rate)}
    return Recording("walk", 0.0, START, **signals, fixes=fixes)


def indoor_location(folder, route, seed=0):
    """Write a walk as the Indoor Location Competition's recorder does, with fixes and truth."""
    more = {"recorder": "indoor_location", "fixes": {"period": 10.0, "outliers": 0.2}, "phone": {"rate": RATE}}
    write(simulate(scenario(route, seed, **more)), folder)
    return folder


def arcade(folder, seed=1, **more):
    """Write a walk of 27 s through maps/arcade.geojson as Sensor Logger does, with eight fixes and the truth."""
    given = {"seed": seed, "start": 1777629600.0, "plan": str(ARCADE), "phone": {"rate": RATE}}
    route = [[2.5, 18.0], {"stand": 2}, {"to": [[6.8, 18.2], [6.8, 27.8], [20.0, 27.7]]}, {"stand": 2}]
    given |= {"route": route, "fixes": {"period": 4.0, "sigma": 1.0}}
    write(simulate(Scenario.of(given | more)), folder)
    return folder
