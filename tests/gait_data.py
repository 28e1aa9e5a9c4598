"""Walks whose steps, lengths or directions are known: ``strides`` (foot sensor), ``ridi`` (camera), simulated ones."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.signal import StateSpace, lsim

from pdr_graph import WalkGraph, detect_steps, smooth
from pdr_graph.apps.bench import data_sets
from pdr_graph.apps.report.evaluation import circular_error, in_region, pair, stated_covariance
from pdr_graph.gait.heading import walking_direction
from pdr_graph.geometry import interpolate
from pdr_graph.inertial.attitude import attitude_of
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.types import Fixes, Recording, Trajectory

RATE = 50.0  # [Hz] of made samples


@dataclass(frozen=True)
class TrueWalk:
    """A recording with its true number of steps and length [m], by another sensor; track: true path, if known."""

    name: str
    recording: Recording
    steps: int
    length: float
    track: Trajectory | None = None


def strides(data):
    """Yield the walks of ``strides``: 0.3 to 1.5 m/s, in the hand."""
    yield from (true_walk(name, read()) for name, read in data_sets.strides(data))


def ridi(data):
    """Yield the walks of ``ridi``: pocket, bag, hand, body."""
    yield from (true_walk(name, read()) for name, read in data_sets.ridi(data))


def true_walk(name, walk):
    return TrueWalk(name, walk.evidence.walk, walk.steps, walk.length, walk.truth)


def given_start(walk, share=0.25, sigma=0.2):
    """Fixes at the start of a walk with a true path, and after a share of its time, which tell the direction."""
    time = np.array([0.2, share * walk.track.time[-1]])
    return Fixes(time, interpolate(time, walk.track.time, walk.track.position), np.full(2, sigma))


def scored(walk, every=0.5):
    """Errors ``(n,)`` [m] of a walk with a true path, smoothed with `given_start`, and True where its region has it."""
    found = smooth(WalkGraph(detect_steps(walk.recording), given_start(walk))).trajectory
    time = np.arange(every, walk.track.time[-1] - every, every)
    place = interpolate(time, walk.track.time, walk.track.position)
    pairs = pair(found, Trajectory(time, place, np.full(len(time), np.nan)))
    return circular_error(pairs), in_region(pairs, stated_covariance(found, pairs.time))


def put_away(angle, seed):
    """The direction of a simulated walker who stands, turns by an angle [deg], puts the phone into a pocket and goes on
    for 25 m; and its error at the end [rad].
    """
    onwards = {0: [50, 0], 90: [25, 25], 180: [0, 0]}[angle]
    stand = {"stand": 1, "turn": angle} if angle else {"stand": 1}
    route = [[0, 0], {"stand": 2}, {"to": [[25, 0]]}, stand, {"hold": "trouser pocket"}, {"to": [onwards]}]
    walk = simulate(Scenario.of({"seed": seed, "route": route, "phone": {"rate": 50}}))
    attitude = attitude_of(walk.recording("accelerometer", "gyroscope"))
    direction = walking_direction(attitude, 1 / walk.walker.cadence)
    true = np.interp(attitude.time, walk.body.time, walk.body.heading)
    return direction, direction.heading[-1] - direction.heading[0] - (true[-1] - true[0])


def in_hand(up, seed=0):
    """Samples of a phone held steadily, with a vertical acceleration ``up (n,)`` [m/s²] in addition to gravity."""
    random, n = np.random.default_rng(seed), len(up)
    t = np.arange(n) / RATE
    return t, np.array([0.5, 3.0, 9.3]) + up[:, None] * [0.0, 0.3, 0.95] + random.normal(0, 0.1, (n, 3))


def quarter_car(speed, roughness, seconds=240, seed=0):
    """Vertical acceleration ``(n,)`` of a car's body on a road (ISO 8608, Gd(0.1 1/m) = ``roughness`` [m³])."""
    random, dt = np.random.default_rng(seed), 1 / (4 * RATE)
    slope = 2 * np.pi * 0.1 * np.sqrt(roughness * speed / 2 / dt) * random.normal(size=round(seconds / dt))
    road = np.cumsum(slope) * dt
    road -= gaussian_filter1d(road, 5 / dt)
    body, wheel, spring, tyre, damper = 300.0, 40.0, 20e3, 180e3, 1500.0
    of_body = [-spring / body, -damper / body, spring / body, damper / body]
    of_wheel = [spring / wheel, damper / wheel, -(spring + tyre) / wheel, -damper / wheel]
    A = np.array([[0, 1, 0, 0], of_body, [0, 0, 0, 1], of_wheel])
    car = StateSpace(A, [[0], [0], [0], [tyre / wheel]], A[1:2], [[0]])
    return lsim(car, road, np.arange(len(road)) * dt)[1][::4]


def waved(frequency, angle, lever=0.6, seconds=60.0, rate=RATE, seed=0):
    """Times and accelerations of a phone at the end of an arm [m] that swings by an angle [rad] while nobody walks."""
    random, t = np.random.default_rng(seed), np.arange(0, seconds, 1 / rate)
    at = angle * (1 + 0.1 * np.sin(0.7 * t)) * np.sin(2 * np.pi * frequency * t)
    x, z = (np.gradient(np.gradient(v, 1 / rate), 1 / rate) for v in (lever * np.sin(at), -lever * np.cos(at)))
    along, across = (z + 9.81) * np.cos(at) - x * np.sin(at), x * np.cos(at) + (z + 9.81) * np.sin(at)
    return t, np.column_stack([np.zeros(len(t)), across, along]) + random.normal(0, 0.08, (len(t), 3))
