"""A short walk with a phone in the hand whose samples are on a grid, for tests that build recordings of their own."""

from dataclasses import dataclass

import numpy as np

from pdr_graph.simulation.recorders import write
from pdr_graph.simulation.scenario import Scenario
from pdr_graph.simulation.simulate import simulate

RATE = 50.0  # [Hz]
START = 1.7e9  # Unix time [s]
GYRO_BIAS = np.array([0.003, -0.002, 0.002])  # [rad/s]


@dataclass(frozen=True)
class Walk:
    """What the phone felt, and the truth: time [s], device axes, the vertical, position [m], heading, landings [s]."""

    time: np.ndarray
    acceleration: np.ndarray
    angular_rate: np.ndarray
    up: np.ndarray
    position: np.ndarray
    heading: np.ndarray
    landings: np.ndarray


def scenario(route, seed=0, **more):
    """Two seconds of standing before and after a route."""
    corners = [[float(x), float(y)] for x, y in route]
    given = {"seed": seed, "start": START, "route": [corners[0], {"stand": 2}, {"to": corners[1:]}, {"stand": 2}]}
    return Scenario.of(given | more)


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


def indoor_location(folder, route, seed=0):
    """A walk as the Indoor Location Competition's recorder has it, with fixes and truth beside it."""
    more = {"recorder": "indoor_location", "fixes": {"period": 10.0, "wild": 0.2}, "phone": {"rate": RATE}}
    write(simulate(scenario(route, seed, **more)), folder)
    return folder
