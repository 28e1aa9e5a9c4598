"""Walks whose steps, lengths or directions are known: ``strides`` (foot sensor), ``ridi`` (camera), simulated ones."""

from dataclasses import dataclass

import numpy as np
from python_calamine import CalamineWorkbook
from scipy.ndimage import gaussian_filter1d
from scipy.signal import StateSpace, butter, filtfilt, find_peaks, lsim

from pdr_graph import WalkGraph, detect_steps, smooth
from pdr_graph.apps.report.evaluation import circular_error, in_region, pair, stated_covariance
from pdr_graph.gait.heading import walking_direction
from pdr_graph.geometry import interpolate
from pdr_graph.inertial.attitude import attitude_of
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.types import Fixes, Recording, Signal, Trajectory

RATE = 50.0  # [Hz] of made samples
GRID = 0.02  # [s] of the visual-inertial positions
HEAD_SWAY = 0.25  # [s] Gaussian that smooths these positions: a path is not longer for the sway of the phone


@dataclass(frozen=True)
class TrueWalk:
    """A recording with its true number of steps and length [m], by another sensor; track: true path, if known."""

    name: str
    recording: Recording
    steps: int
    length: float
    track: Trajectory | None = None


def strides(data):
    """Yield the walks of ``strides``: 0.3 to 1.5 m/s, in the hand. Strides that the foot sensor merged are counted."""
    for path in sorted((data / "strides").glob("*.txt")):
        with path.open() as file:
            rows = np.array([line.split()[1:] for line in file if line.startswith("test")], dtype=float)
        rows = rows[np.append(True, np.diff(rows[:, 9]) > 0)]
        first = np.flatnonzero(np.diff(rows[:, 11]) > 0) + 1
        length = rows[first, 10]
        usual = np.median(length)
        whole = sum(max(1, round(each / usual)) for each in length[:-1].tolist())
        last = 2 if length[-1] > 0.75 * usual else 1
        time = (rows[:, 9] - rows[0, 9]) / 1000
        yield TrueWalk(
            path.stem.removeprefix("PDR_Raw_2018-10-"),
            recording_of(path.name, time, rows[:, :3], rows[:, 3:6]),
            2 * whole + last,
            float(rows[:, 12].max()),
        )


def ridi(data):
    """Yield the walks of ``ridi``: pocket, bag, hand, body. Steps are maxima of |a| about its strongest frequency."""
    for path in sorted((data / "ridi").glob("*.xlsx")):
        column = columns(path)
        time = column["time"] - column["time"][0]
        acceleration, rate, position = (
            np.column_stack([column[f"{name}_{axis}"] for axis in "xyz"]) for name in ("acce", "gyro", "pos")
        )
        yield TrueWalk(
            path.stem,
            recording_of(path.name, time, acceleration, rate),
            *visual_inertial(time, position, np.linalg.norm(acceleration, axis=1)),
            track=Trajectory(time, position[:, :2], np.full(len(time), np.nan)),
        )


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


def recording_of(name, time, acceleration, rate):
    """A recording of accelerometer and gyroscope."""
    return Recording(name, 0.0, None, accelerometer=Signal(time, acceleration), gyroscope=Signal(time, rate))


def visual_inertial(time, position, magnitude):
    """True number of steps and length [m] of a walk with known positions ``(n, 3)`` [m]."""
    grid = np.arange(0, time[-1], GRID)
    x, y = (np.interp(grid, time, position[:, axis]) for axis in (0, 1))
    speed = np.hypot(np.gradient(x, GRID), np.gradient(y, GRID))
    moving = gaussian_filter1d(speed, 0.5 / GRID) > 0.25
    level = np.interp(grid, time, magnitude)
    level -= gaussian_filter1d(level, 0.8 / GRID)
    frequency = np.fft.rfftfreq(8 * len(grid), GRID)
    power = np.abs(np.fft.rfft(level * np.hanning(len(grid)), 8 * len(grid)))
    walked = (frequency > 1.2) & (frequency < 2.6)
    strongest = frequency[walked][np.argmax(power[walked])]
    band = butter(2, [0.7 * strongest, 1.35 * strongest], fs=1 / GRID, btype="band")
    landed, _ = find_peaks(filtfilt(*band, level), height=0.2)
    x, y = (gaussian_filter1d(values, HEAD_SWAY / GRID)[::5] for values in (x, y))
    return int(moving[landed].sum()), float(np.hypot(np.diff(x), np.diff(y)).sum())


def columns(path):
    """The columns of numbers of a workbook's first sheet, by name."""
    head, *rows = CalamineWorkbook.from_path(path).get_sheet_by_index(0).to_python()
    return {
        name: np.array(column, dtype=float) for name, column in zip(head, zip(*rows, strict=True), strict=True) if name
    }
