"""Errors of headings, simulated walks with known directions, and accelerations of phones whose holder does not walk."""

import re
import xml.etree.ElementTree as ElementTree
from functools import partial

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.signal import StateSpace, lsim

from pdr_graph.apps.bench.data_sets import recording_of
from pdr_graph.gait.compass import LiveCompass
from pdr_graph.gait.heading import walking_direction
from pdr_graph.gait.step_stream import StepStream
from pdr_graph.geometry import wrap_angle
from pdr_graph.inertial.attitude import attitude_of
from pdr_graph.lab.papers.calibration_walk import CountedWalk
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.online.interface import Samples, events_of
from pdr_graph.types import STANDARD_GRAVITY, Headings

RATE = 50.0  # [Hz] of made samples
NEAR = 60.0  # [s] of the walk before and after a heading that it is compared with


def known_places(walk):
    """The truth of a walk of the bench, or every twelfth position of its receiver."""
    return walk.truth if len(walk.truth) else walk.evidence.fixes[::12]


def heading_errors(walk, headings):
    """Errors ``(n,)`` [rad] of the headings of a walk of the bench: the walked path, turned as each says, against the
    truth.
    """
    steps, truth, errors = walk.evidence.steps, known_places(walk), []
    heading = np.cumsum(steps.turn)
    path = np.cumsum(steps.length * np.exp(1j * (heading - steps.turn / 2)))
    for time, stated in zip(headings.time, headings.heading, strict=True):
        near = np.abs(truth.time - time) < NEAR
        walked, true = np.diff(np.interp(truth.time[near], steps.time, path)), np.diff(truth.position[near] @ [1, 1j])
        turned = np.angle(np.sum(true * walked.conj()))
        since_start = np.interp(time, [steps.start, *steps.time], [0.0, *heading])
        errors.append(wrap_angle(stated - since_start - turned))
    return np.array(errors)


def live_headings(evidence):
    """The headings of the live compass as it reports them, and the moment ``(n,)`` of each report [s]."""
    compass, found = LiveCompass(), []
    compass.locate(evidence.frame, evidence.near, evidence.walk.epoch)
    gait = StepStream(listener=compass.update, preview=compass.preview)
    for event in events_of(evidence.walk):
        if isinstance(event, Samples):
            push = compass.push if event.sensor == "magnetometer" else partial(gait.push, event.sensor)
            push(event.time, event.values)
            gait.advance()
            found += [(event.time[-1], one.time, one.value, one.sigma) for one in compass.advance()]
    moment, *columns = np.array([row for row in found if np.isfinite(row[3])]).reshape(-1, 4).T
    return moment, Headings(*columns)


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


def weallwalk(data, pattern="*"):
    """Walks of WeAllWalk with the heel strikes until their last sample."""
    for path in sorted(data.glob(f"weallwalk/iPhoneSensors_{pattern}.csv")):
        route, person, _, tool = re.fullmatch(r"iPhoneSensors_(T\d+)_(ID\d+)_(\w\w)_(\w\w)", path.stem).groups()
        rows = np.loadtxt(path, delimiter=",", usecols=(0, 17, 18, 19, 30, 31, 32))
        rows = rows[np.append(True, np.diff(rows[:, 0]) > 0)]
        tree = ElementTree.parse(path.with_name(f"{route}_{person}_{tool}.xml"))
        steps = sum(float(strike.text) <= rows[-1, 0] for strike in tree.iter("Time"))
        recording = recording_of(path.stem, rows[:, 0], -STANDARD_GRAVITY * rows[:, 4:], rows[:, 1:4])
        yield CountedWalk(f"weallwalk {tool}", person, recording, steps)
