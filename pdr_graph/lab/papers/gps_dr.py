"""[gps-dr]: GPS and dead reckoning by gait analysis, with and without outages of the GPS.

The paper's chain is `paper_steps` and `position_filter`: gravity by a Kalman filter (2.1, `GravityFilter`), forward
axis by principal component (2, `principal_axis`), steps by the pattern of both accelerations (2.2, `vertical_forward`),
strides linear in the vertical amplitude with a person's constants (2.3, `by_amplitude`), the two tests of the magnetic
field and the heading filter (3, `causal_north`), and the position filter (4). The product has the same tests of the
field (`gait.compass`), one filter for heading, stride and position (`kalman_filter`), and smoothers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pdr_graph.errors import count as counted
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.kalman import kalman_filter, kalman_smoother
from pdr_graph.estimation.smoother import smooth
from pdr_graph.frames import EarthField, Frame, earth_field
from pdr_graph.gait.compass import dip_error, magnetic_headings, measured_field, predicted_field
from pdr_graph.gait.heading import Direction, Forward, forward_acceleration, forward_axis
from pdr_graph.gait.steps import GaitSignals, detect_steps, gait_signals
from pdr_graph.gait.walker import StepFeatures, by_amplitude, regression
from pdr_graph.geometry import interpolate, unit, wrap_angle
from pdr_graph.inertial.attitude import Attitude, required
from pdr_graph.io.validation import RADIUS_68
from pdr_graph.lab.papers.attitude_filters import GravityFilter, run_filter
from pdr_graph.lab.papers.gait_methods import accumulate_turn, peak_pairs, principal_axis, vertical_forward
from pdr_graph.lab.papers.result_table import FIRST_SEED, ResultTable
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.priors import NORTH
from pdr_graph.types import GNSS, Array, Fixes, Mask, Recording, Trajectory
from pdr_graph.walk import Options, read

SIMULATED_WALKS, QUICK_WALKS = 40, 6
RECORDING = "nju_phyphox_outdoor"  # of a phone in the hand
ROUTE_CORNERS = [[260, 0], [260, 150], [120, 150], [120, 250], [290, 290]]  # 1650 m with the way back
ROUTE_CORNERS += [[290, 420], [60, 420], [-40, 330], [-40, 110], [0, 0]]
GPS_ACCURACY, GPS_HDOP = 5.0, 0.9  # [m] 68 % and median, of a receiver at 1 Hz
FIRST_OUTAGE, LAST_FIXES = 120.0, 30.0  # [s] from the start to the first outage, from the last to the end
OUTAGES = {"20 s": 20.0, "2 min": 120.0}
STRAIGHT = 30.0  # [s] of the first straight walk, which calibrates the forward axis
CALIBRATION_TIME = 120.0  # [s] of the recorded walk with GPS speeds as strides, for the person's constants

NORTH_DRIFT = 0.03  # [rad/√s] of a phone's gyroscope, whose bias is not estimated: least north errors on seeds 0 to 11

HELD, ALONE = "GPS alone, last position", "paper: dead reckoning from the last fix"
FILTER, IN_METRES = "paper: Kalman filters, causal", "the same, σ of a fix = HDOP [m]"
OTHER_AXIS, TRUE_COURSE = (
    "paper's filters, forward axis by the product",
    "paper's filters, true headings (from the truth)",
)
PRODUCT_ALONE, EKF = "product: dead reckoning from the last fix", "product: Kalman filter, causal"
RTS, BY_GRAPH = "product: RTS smoother", "**product: graph**"
Axis = Callable[[Attitude, Array, Mask, float], Forward]
Rows = list[tuple[str, ...]]


@dataclass(frozen=True)
class Walk:
    """A walk with GPS.

    fixes: with the sigma of the receiver's accuracy; hdop: ``(f,)`` of each, without rows if it is not known; stride:
    the person's constants of `by_amplitude`; truth: positions once a second.
    """

    recording: Recording
    frame: Frame
    fixes: Fixes
    hdop: Array
    stride: Mapping[str, float]
    truth: Trajectory

    @property
    def earth(self) -> EarthField:
        """The field of the earth at the start."""
        lon, lat = self.frame.to_lonlat(self.fixes.position[:1])[0].tolist()
        return earth_field(lat, lon, self.recording.epoch)


# The paper's chain


@dataclass(frozen=True)
class PaperSteps:
    """Secs. 2 and 3: time ``(n,)`` [s], displacement ``(n, 2)`` [m] and stride variance ``(n,)`` [m²] of each step."""

    time: Array
    displacement: Array
    variance: Array

    @property
    def track(self) -> Trajectory:
        """Dead reckoning from the origin."""
        return _trajectory(self.time, np.cumsum(self.displacement, axis=0))


def first_straight(attitude: Attitude, start: float = -np.inf) -> tuple[Mask, float]:
    """The samples ``(n,)`` of the calibration walk, after `start` [s], and a step's duration [s] (`peak_pairs`)."""
    bounces = peak_pairs(attitude)
    first = bounces.time[bounces.time > start][0]
    return (attitude.time > first) & (attitude.time < first + STRAIGHT), bounces.usual_step


def paper_gait(recording: Recording, axis: Axis = principal_axis) -> tuple[GaitSignals, Array]:
    """Sec. 2: attitude and steps, and the direction of each step in the attitude's world ``(n,)`` [rad].

    The forward axis is one of the device, by the first `STRAIGHT` seconds of walking. axis: the forward-axis method.
    """
    attitude = run_filter(recording, GravityFilter)
    straight, step = first_straight(attitude)
    turned = accumulate_turn(attitude, step).heading
    ahead = turned[straight] + axis(attitude, turned, straight, step).angle
    level = np.column_stack([unit(ahead), np.zeros(len(ahead))])
    in_device = Rotation.from_quat(attitude.R_world_device.as_quat()[straight]).inv().apply(level).mean(axis=0)

    forward = attitude.R_world_device.apply(in_device)
    heading = np.unwrap(np.arctan2(forward[:, 1], forward[:, 0]))
    landings = vertical_forward(attitude, forward_acceleration(attitude, heading, Forward(0.0, 0.0)))
    course = np.interp(landings.time - landings.period / 2, attitude.time, heading)
    return GaitSignals(recording, attitude, landings, Direction(heading, np.zeros(len(heading)))), course


def causal_north(attitude: Attitude, field: Array, earth: EarthField) -> Array:
    """Sec. 3: direction of true north in the attitude's world at each sample ``(n,)`` [rad], counter-clockwise from x.

    field: ``(n, 3)`` in device axes [µT]. A Kalman filter whose prediction is the gyroscope, by which the attitude's
    world stands still, and whose observation is the magnetic heading. Both tests widen the observation's covariance;
    the paper prints no formula. The process noise is `NORTH_DRIFT`, where the paper lets the tests set it too.
    """
    world = attitude.R_world_device.apply(field)
    predicted = predicted_field(field[:-1], attitude.angular_rate[1:], attitude.period)
    apart = np.arctan2(np.linalg.norm(np.cross(predicted, field[1:]), axis=1), np.sum(predicted * field[1:], axis=1))
    errors = np.stack([dip_error(world, earth.dip), np.append(apart[:1], apart)])
    observed = np.arctan2(world[:, 1], world[:, 0]) + earth.declination
    variance = NORTH.undisturbed**2 + np.sum(errors**2, axis=0) / np.cos(earth.dip) ** 2
    variance = variance * (1 + 2 * NORTH.alike / attitude.period)  # samples in one disturbance err alike
    state, P, Q = float(observed[0]), float(variance[0]), NORTH_DRIFT**2 * attitude.period
    states = np.empty(len(observed))
    for k, (measured, R) in enumerate(zip(observed.tolist(), variance.tolist(), strict=True)):
        P += Q
        gain = P / (P + R)
        state += gain * float(wrap_angle(measured - state))
        P *= 1 - gain
        states[k] = state
    return states


def paper_steps(walk: Walk, axis: Axis = principal_axis) -> PaperSteps:
    """Secs. 2 and 3 for a walk: strides by the person's constants, headings by the filter. axis: see `paper_gait`."""
    gait, course = paper_gait(walk.recording, axis)
    attitude, landings = gait.attitude, gait.landings
    field = measured_field(required(walk.recording, "magnetometer"), attitude.time)
    north = np.interp(landings.time, attitude.time, causal_north(attitude, field, walk.earth))
    length, sigma = by_amplitude(StepFeatures(gait), **walk.stride)
    east = walk.frame.bearing_of_east(walk.fixes.position[0])
    return PaperSteps(landings.time, length[:, None] * unit(course - north + np.pi / 2 + east), sigma**2)


def position_filter(steps: PaperSteps, fixes: Fixes) -> Trajectory:
    """Sec. 4: a Kalman filter of the position (x, y) from the first fix on.

        predict   p ← p + L e(θ),   P ← P + σ_L² I     of the stride's variance alone
        correct   with a fix,       R = σ² I           of the receiver's HDOP

    A row per step and per later fix. The paper derives the process covariance from the stride alone. That it is the
    same to the side as ahead is our reading.
    """
    time = np.concatenate([steps.time, fixes.time])
    order = np.argsort(time, kind="stable")
    order = order[time[order] > fixes.time[0]]
    p, P = fixes.position[0], float(fixes.sigma[0] ** 2)
    rows = np.empty((len(order), 2))
    for row, event in zip(rows, order.tolist(), strict=True):
        n = event - len(steps.time)
        if n < 0:
            p, P = p + steps.displacement[event], P + steps.variance[event]
        else:
            gain = P / (P + fixes.sigma[n] ** 2)
            p, P = p + gain * (fixes.position[n] - p), (1 - gain) * P
        row[:] = p
    return _trajectory(time[order], rows)


def _trajectory(time: Array, position: Array) -> Trajectory:
    return Trajectory(time, position, np.full(len(time), np.nan))


# Walks


def simulated(seed: int, manner: str = "fast") -> Walk:
    """The walk of Sec. 4: 1650 m with ten turns, the phone in the hand; each seed is another person and phone.

    Nine tenths of a fix's error stay for 50 s. The person's strides of the calibration walk are known, as in the paper.
    """
    route = [[0, 0], {"stand": 5}, {"to": ROUTE_CORNERS, "manner": manner}, {"stand": 5}]
    gnss = {"accuracy": GPS_ACCURACY, "hdop": GPS_HDOP}
    walk = simulate(Scenario.of({"seed": seed, "route": route, "phone": {"rate": 50}, "gnss": gnss}))
    assert walk.gnss is not None
    fixes = replace(walk.gnss.fixes, source=(GNSS,) * len(walk.gnss.fixes))
    truth = walk.truth[:: round(walk.body.rate)]
    recording = replace(walk.recording(), epoch=walk.scenario.start)
    return Walk(recording, walk.frame, fixes, walk.gnss.hdop, calibration_walk(seed, manner), truth)


def calibration_walk(seed: int, manner: str = "fast") -> dict[str, float]:
    """Sec. 2.3: a person's constants by regression over a walk of 180 m at three paces whose strides are known."""
    route: list = [[0, 0], {"stand": 3}]
    for n, pace in enumerate(("slow", "normal", manner), 1):
        route += [{"to": [60 * n, 0], "manner": pace}, {"stand": 3}]
    walk = simulate(Scenario.of({"seed": seed, "route": route, "phone": {"rate": 50}}))
    gait, _ = paper_gait(walk.recording())
    landed = gait.landings.time
    step = np.abs(landed[:, None] - walk.body.landings).argmin(axis=1)
    same = np.abs(landed - walk.body.landings[step]) < gait.landings.period / 2
    return regression(StepFeatures(gait).vertical[same], walk.body.lengths[step][same])


def recorded(path: Path) -> Walk:
    """A recording with GPS, whose fixes are the truth as well. Strides for the constants: GPS speed × time per step."""
    evidence = read(path, Options())
    gait, _ = paper_gait(evidence.walk)
    landings, fixes = gait.landings, evidence.fixes
    first = landings.time < fixes.time[0] + CALIBRATION_TIME
    known = np.interp(landings.time, fixes.time, fixes.speed) * landings.period
    stride = regression(StepFeatures(gait).vertical[first], known[first])
    truth = _trajectory(fixes.time, fixes.position)
    return Walk(evidence.walk, evidence.frame, fixes, np.empty(0), stride, truth)


# The experiment


def outages(truth: Trajectory, seconds: float) -> list[Mask]:
    """The rows ``(n,)`` of the truth in each outage; many in a walk, with fixes for twice as long between them."""
    start, end = truth.time[[0, -1]]
    begins = np.arange(start + FIRST_OUTAGE, end - seconds - LAST_FIXES, max(FIRST_OUTAGE, 3 * seconds))
    return [(truth.time >= begin) & (truth.time < begin + seconds) for begin in begins]


@dataclass(frozen=True)
class Observed:
    """What both chains observe of a walk, beside the fixes.

    paper: steps and fixes of the paper's filter and its variants by name; graph: of the product's steps and headings,
    with the first fix alone, and its track by the causal filter.
    """

    walk: Walk
    paper: Mapping[str, tuple[PaperSteps, Fixes]]
    graph: WalkGraph
    alone: Trajectory

    @classmethod
    def of(cls, walk: Walk) -> Observed:
        """Detect the steps and headings of a walk."""
        gaits = gait_signals(walk.recording)
        headings = magnetic_headings(gaits, walk.frame, walk.fixes.position[0])
        graph = WalkGraph(detect_steps(gaits), walk.fixes[:1], headings=headings)
        return cls(walk, dict(_of_paper(walk)), graph, kalman_filter(graph).trajectory)

    def tracks(self, kept: Mask) -> dict[str, Trajectory]:
        """The walk by each method, with the fixes of a mask ``(f,)``."""
        fixes, time = self.walk.fixes[kept], self.walk.truth.time
        graph = WalkGraph(self.graph.steps, fixes, headings=self.graph.headings.headings)
        still = _trajectory(time, np.zeros((len(time), 2)))
        filtered = {name: position_filter(steps, of[kept]) for name, (steps, of) in self.paper.items()}
        return {
            HELD: continued(still, fixes, time),
            ALONE: continued(self.paper[FILTER][0].track, fixes, time),
            **filtered,
            PRODUCT_ALONE: continued(self.alone, fixes, time),
            EKF: kalman_filter(graph).trajectory,
            RTS: kalman_smoother(graph).trajectory,
            BY_GRAPH: smooth(graph).trajectory,
        }


def _of_paper(walk: Walk) -> Iterator[tuple[str, tuple[PaperSteps, Fixes]]]:
    """Steps and fixes of each variant of the paper's filter; two of them require a simulation."""
    steps, other, fixes = paper_steps(walk), paper_steps(walk, forward_axis), walk.fixes
    if not len(walk.hdop):
        yield from {FILTER: (steps, fixes), OTHER_AXIS: (other, fixes)}.items()
        return
    by_hdop = replace(fixes, sigma=GPS_ACCURACY / RADIUS_68 * walk.hdop / GPS_HDOP)
    yield FILTER, (steps, by_hdop)
    yield IN_METRES, (steps, replace(fixes, sigma=walk.hdop))
    yield OTHER_AXIS, (other, by_hdop)
    true = np.diff(interpolate(np.append(0.0, steps.time), walk.truth.time, walk.truth.position), axis=0)
    length = np.linalg.norm(steps.displacement, axis=1, keepdims=True)
    along = true / np.maximum(np.linalg.norm(true, axis=1, keepdims=True), 1e-9)
    yield TRUE_COURSE, (replace(steps, displacement=length * along), by_hdop)


def continued(track: Trajectory, fixes: Fixes, time: Array) -> Trajectory:
    """Positions at times ``(n,)`` [s]: the last fix, and from there on the displacement of a track."""
    last = np.maximum(np.searchsorted(fixes.time, time, side="right") - 1, 0)
    since, until = (interpolate(at, track.time, track.position) for at in (fixes.time[last], time))
    return _trajectory(time, fixes.position[last] + until - since)


def errors(track: Trajectory, truth: Trajectory) -> Array:
    """Horizontal distances ``(n,)`` from the truth [m]."""
    return np.hypot(*(interpolate(truth.time, track.time, track.position) - truth.position).T)


def without_outage(walks: list[Observed]) -> Rows:
    """Rows of the whole walk with all fixes."""
    found: dict[str, list[Array]] = {}
    for each in walks:
        truth, start = each.walk.truth, each.walk.fixes[:1]
        whole = each.tracks(np.ones(len(each.walk.fixes), dtype=bool))
        only_first = {ALONE: each.paper[FILTER][0].track, PRODUCT_ALONE: each.alone}
        whole |= {name: continued(track, start, truth.time) for name, track in only_first.items()}
        for name, track in whole.items():
            found.setdefault(name.replace("last fix", "first fix"), []).append(errors(track, truth))
    return [(name, *_cells(np.concatenate(of)), f"{np.median([e[-1] for e in of]):.1f}") for name, of in found.items()]


def in_outages(walks: list[Observed], seconds: float) -> tuple[int, Rows]:
    """Number of outages, and the rows of the errors within them."""
    found: dict[str, list[Array]] = {}
    for each in walks:
        truth, fixes = each.walk.truth, each.walk.fixes
        cut = outages(truth, seconds)
        begin = np.array([truth.time[mask][0] for mask in cut])
        kept = ~np.any((fixes.time[:, None] >= begin) & (fixes.time[:, None] < begin + seconds), axis=1)
        for name, track in each.tracks(kept).items():
            off = errors(track, truth)
            found.setdefault(name, []).extend(off[mask] for mask in cut)
    rows = [(name, *_cells(np.concatenate(of)), f"{np.median([e[-1] for e in of]):.1f}") for name, of in found.items()]
    return len(next(iter(found.values()))), rows


def _cells(error: Array) -> tuple[str, ...]:
    return f"{error.mean():.1f}", *(f"{value:.1f}" for value in np.percentile(error, [50, 95]))


def experiment(quick: bool = False, data: Path | None = None) -> tuple[ResultTable, ...]:
    """Sec. 4: the walk with GPS, and outages of 20 s and of 2 min; simulated, and of the recording if it is there.

    data: folder with the real recordings; those that are not there have no rows.
    """
    walks = [Observed.of(simulated(FIRST_SEED + n)) for n in range(QUICK_WALKS if quick else SIMULATED_WALKS)]
    minutes = np.mean([np.ptp(each.walk.truth.time) for each in walks]) / 60
    title = f"[gps-dr] Sec. 4: 1650 m in {minutes:.0f} min [paper: 12 min], {len(walks)} simulated walkers"
    header = ("method", "mean [m]", "median [m]", "95 % [m]", "at the end, median [m]")
    tables = [ResultTable("gps-dr", title, header, tuple(without_outage(walks)), NOTE)]
    sets = {"gps-dr": (walks, f"{len(walks)} simulated walks")}
    if data is not None and (path := data / RECORDING).exists():
        sets["gps-dr-recorded"] = [Observed.of(recorded(path))], "a campus walk of 730 m, against its own GPS"
    for name, (each, what) in sets.items():
        for length, seconds in OUTAGES.items():
            outage_count, rows = in_outages(each, seconds)
            title = f"[gps-dr] Sec. 4: error within {counted(outage_count, 'outage')} of {length}, {what}"
            tables.append(ResultTable(f"{name}-{length.replace(' ', '-')}", title, header, tuple(rows)))
    return tuple(tables)


NOTE = (
    "The paper prints tracks and no errors. Our phones are in the hand, with biased magnetometers and gyroscopes; "
    "nine tenths of a fix's error stay for 50 s; strides are known. The paper's filters are worse than the GPS alone "
    "because of their headings: with true headings they are as good. (1) In a quarter of the simulated hands the "
    "acceleration across is larger than along, so the principal component is the wrong axis. (2) The magnetometer is "
    "not calibrated, and steel passes both tests in part. The paper's process covariance knows nothing of the "
    "heading's error; the product has heading, stride and the receiver's systematic error as states. The recorded "
    "walk is scored against the fixes that were cut out."
)
