"""The walk while it is under way beside the batch, from raw samples, for docs/accuracy.md."""

import tomllib
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from microsoft import helped_walks
from recorded import WAYPOINT_NOISE, Walk, gaps, ipin21_walks, ipin2023_walks, nju_walks, percentiles
from tables import publish, table

from pdr_graph import FloorPlan, WalkGraph, detect_steps, io, kalman_filter, magnetic_headings, smooth
from pdr_graph.estimation.factors.beacon_rssi import levels_along
from pdr_graph.evaluation import circular_error, pair
from pdr_graph.frames import Frame, enu
from pdr_graph.gait.signals import gait_signals
from pdr_graph.geometry import interpolate
from pdr_graph.inputs import Options, read
from pdr_graph.io.beacons import read_beacons
from pdr_graph.online.interface import Samples, events_of
from pdr_graph.online.navigator import Navigator
from pdr_graph.simulation.recorders import write
from pdr_graph.simulation.scenario import Scenario
from pdr_graph.simulation.simulate import simulate
from pdr_graph.types import Beacons, Recording, Trajectory

SCENARIOS = Path(__file__).resolve().parents[1] / "scenarios"
SIMULATED = {  # what the scenario's file does not have
    "arcade": {},
    "mall": {"fixes": {"period": 30.0, "sigma": 2.0}},
    "loop": {"fixes": {"period": 15.0, "sigma": 3.0}},
}
LAG = 60.0  # [s]
ASKED = 1.3  # times the batch's error
EVERY = 1.0  # [s] at which the truth of a simulated walk is told


@dataclass(frozen=True)
class Case:
    """A walk for the back end, and the recording that it is of.

    name, given: of its row; plan, beacons: None where none is given; noise: of its truth, per axis [m].
    """

    name: str
    given: str
    walk: Walk
    recording: Recording
    frame: Frame
    plan: FloorPlan | None = None
    beacons: Beacons | None = None
    noise: float = 0.0


@dataclass(frozen=True)
class Live:
    """A walk as the navigator told it. smoothed: at its end; causal: each pose at the time that it is of; asked: when
    that was asked for, by the newest sample [s].
    """

    smoothed: Trajectory
    causal: Trajectory
    asked: np.ndarray


def live(data):
    """The table of all walks, and that of a competition's view."""
    groups = [[case] for case in [*museum(data), *campus(data), *eight(data), *simulated_walks()]]
    groups += [list(mall(data, given, plan=True)) for given in ("first and last", "first only")]
    rows, ratios, view = [], [], []
    for cases in groups:
        told = [{**offline(case), **online(case)} for case in cases]
        names = [name for name in told[0] if name != "asked"]
        errors = {name: errors_of([one[name] for one in told], cases) for name in names}
        ratios.append(errors["lag"].mean() / errors["batch"].mean())
        inside = [gaps(one["causal"], case.walk.truth, case.noise)[1] for one, case in zip(told, cases, strict=True)]
        cells = [percentiles(errors[name]) for name in names]
        share = f"{100 * np.concatenate(inside).mean():.0f} %"
        rows.append([cases[0].name, cases[0].given, *cells[:3], share, *cells[3:], f"{ratios[-1]:.2f}"])
        if cases[0].given.startswith("GNSS"):
            view.append([cases[0].name, cases[0].given, *in_time(cases[0], told[0])])
    header = ["walk", "given", "batch [m]", "filter, causal [m]", "live, causal [m]", "in 90 %", "live, lag 60 s [m]"]
    text = table([*header, "live, all open [m]", "mean, lag 60 s / batch"], rows)
    within = np.mean(np.array(ratios) <= ASKED)
    text += (
        f"\n\nAt lag 60 s the mean is at most {ASKED} times the batch's in {100 * within:.0f} % of {len(rows)} rows."
    )
    header = ["walk", "given", "landmarks", "the newest pose [m]", "the last position of GNSS [m]"]
    publish("accuracy.md", "live", f"{text}\n\n{table(header, view)}")


def offline(case):
    """All at once, and by the filter."""
    walk = case.walk
    graph = partial(WalkGraph, walk.steps, walk.fixes, headings=walk.headings)
    batch = smooth(graph(levels=walk.levels, floor=case.plan)).trajectory
    return {"batch": batch, "filter": kalman_filter(graph()).trajectory}


def online(case):
    """Pushed in order of time, with a lag and with all of the walk open."""
    lagged = followed(case, LAG)
    tracks = {"causal": lagged.causal, "lag": lagged.smoothed, "open": followed(case, None).smoothed}
    return tracks | {"asked": lagged.asked}


def followed(case, lag):
    """A recording through a navigator, its pose asked for after each packet of samples."""
    recording = replace(case.recording, fixes=case.walk.fixes)
    nav = Navigator(case.plan, lag=lag, frame=case.frame, beacons=case.beacons, epoch=recording.epoch)
    poses, asked = [], []
    for event in events_of(recording):
        nav.push(event)
        if isinstance(event, Samples) and event.sensor == "accelerometer" and (pose := nav.pose) is not None:
            poses.append(pose)
            asked.append(event.time[-1])
    time = np.array([pose.time for pose in poses])
    last = np.append(np.diff(time) > 0, True)  # of poses of one time: by all that was measured until then
    causal = Trajectory(
        time=time[last],
        position=np.array([(pose.x, pose.y) for pose in poses])[last],
        heading=np.array([pose.heading for pose in poses])[last],
        floor=("",) * int(last.sum()),
        covariance=np.array([pose.covariance for pose in poses])[last],
    )
    return Live(nav.finish().trajectory, causal, np.array(asked)[last])


def errors_of(tracks, cases):
    """Of several walks together [m]."""
    found = [circular_error(pair(track, case.walk.truth)) for track, case in zip(tracks, cases, strict=True)]
    return np.concatenate(found)


def in_time(case, told):
    """At each landmark, the pose that was known when the walker stood there, and what GNSS had said last."""
    truth, fixes = case.walk.truth, case.walk.fixes
    pose = np.searchsorted(told["asked"], truth.time, side="right") - 1
    fix = np.searchsorted(fixes.time, truth.time, side="right") - 1
    both = (pose >= 0) & (fix >= 0)
    there = told["causal"].position[pose[both]], fixes.position[fix[both]]
    return [int(both.sum()), *(percentiles(np.hypot(*(place - truth.position[both]).T)) for place in there)]


def museum(data):
    """IPIN 2023, by the phone's GNSS, without and with beacons."""
    folder = data / "ipin2023_track3"
    for walk in ipin2023_walks(data):
        recording = io.load(folder / f"{walk.name}.txt")
        lon, lat = recording.fixes.position[0]
        frame = enu(lat, lon)
        beacons = frame.place(read_beacons(folder / "BLE_Locations.csv", recording))
        name = walk.name.removeprefix("IPIN2023_T3_Training")
        yield Case(name, "GNSS", replace(walk, levels=None), recording, frame)
        yield Case(name, "GNSS, beacons", walk, recording, frame, beacons=beacons)


def campus(data):
    """NJU's, with most positions withheld."""
    yield from (on_campus(data, walk) for walk in nju_walks(data))


def on_campus(data, walk):
    """Of NJU's walk with some of its positions."""
    recording = io.load(data / "nju_phyphox_outdoor")
    lon, lat = recording.fixes.position[0]
    return Case("NJU campus", walk.name, walk, recording, enu(lat, lon))


def eight(data):
    """IPIN21's figure of eight, without and with its plan."""
    recording = io.load(data / "ipin21_hcu" / "eight")
    for walk in ipin21_walks(data):
        yield Case("IPIN21, eight", walk.name, walk, recording, walk.floor.frame)
        yield Case("IPIN21, eight", f"{walk.name}, plan", walk, recording, walk.floor.frame, walk.floor)


def mall(data, given, plan):
    """Microsoft's walks by what is given of their waypoints, with or without the plan."""
    said = f"{given}, plan" if plan else given
    for recording, walk in helped_walks(data, given):
        floor = walk.floor if plan else None
        yield Case("Microsoft", said, walk, recording, walk.floor.frame, floor, noise=WAYPOINT_NOISE)


def simulated_walks():
    """Walks through drawn buildings, with their plans, fixes and beacons."""
    for name, more in SIMULATED.items():
        path = SCENARIOS / f"{name}.toml"
        told = tomllib.loads(path.read_text()) | more
        yield simulated(Scenario.of(told, path), SCENARIOS / told["plan"])


def simulated(scenario, plan):
    """A scenario as its recorder has it."""
    made = simulate(scenario)
    with TemporaryDirectory() as folder:
        write(made, Path(folder))
        given = read(Path(folder), Options(plan=plan, fixes=Path(folder) / "fixes.csv"))
    recording, frame, fixes = given.walk, given.frame, given.fixes
    gaits, beacons = gait_signals(recording), given.beacons
    steps, headings = detect_steps(gaits), magnetic_headings(gaits, frame, fixes.position[0])
    heard = levels_along(recording.bluetooth, beacons, steps) if beacons and recording.bluetooth else None
    time = np.arange(0.0, made.truth.time[-1], EVERY)
    place = interpolate(time, made.truth.time, made.truth.position)
    time = time + scenario.start - recording.clock_origin
    truth = Trajectory(time, place, np.zeros(len(time)), ("",) * len(time))
    floor = given.building.floors[0]
    walk = Walk(scenario.name, steps, headings, fixes, truth, floor, heard)
    said = f"{len(fixes)} fixes, plan" + (", beacons" if heard else "")
    return Case(f"simulated, {scenario.name}", said, walk, recording, frame, floor, beacons)
