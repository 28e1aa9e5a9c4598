"""Walks for the table of the live navigator: real recordings with a reference, and simulated walks."""

import tomllib
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import topology
from integrity_live import events
from integrity_walks import (
    INDOORS,
    OUTDOORS,
    USER,
    Given,
    at_times,
    measured,
    route_of,
    simulated_walk,
    with_fixes,
)
from microsoft import HELP, helped_walk, helped_walks, recording_at, recording_paths
from recorded import SIGMA, WAYPOINT_NOISE, Walk, ipin21_walks, ipin2023_walks, nju_walks

from pdr_graph import FloorPlan, WalkGraph, detect_steps, magnetic_headings, smooth
from pdr_graph.estimation.factors.beacon_rssi import levels_along
from pdr_graph.frames import Frame, enu
from pdr_graph.gait.steps import gait_signals
from pdr_graph.io.loading import load
from pdr_graph.io.tables import read_beacons
from pdr_graph.lab.simulation.recorders import write
from pdr_graph.lab.simulation.scenario import Scenario, scenario_file
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.online.interface import events_of
from pdr_graph.types import Beacons, Fixes, Headings, Recording, Trajectory
from pdr_graph.walk import Options, read

SPARSE = 60.0  # [s] between the fixes of a user who gives few
STANDING = 60.0  # [s] in which a walker stands still
STANDS_AT = (0.0, 0.5)  # share of the corners passed when the walker stands: odd seeds begin so, others pause half-way
LENGTH = (80.0, 140.0)  # [m] of walks from samples
PHONE = {"rate": 50, "disturbance": topology.DISTURBANCE}
APF_SCALE = 4.3197  # [m] per unit of its drawing
APF_START, APF_HEADING, APF_SIGMA = (8.0, 26.75), -np.pi / 2, 0.1  # [m], [rad], [rad]: stated by the survey of the walk


@dataclass(frozen=True)
class Case:
    """A walk for the live navigator, and what the batch gets of it.

    name, given: of its row; walk: of the front end of the batch, with fixes and truth; frame: of the poses; plan,
    beacons: None where none is given; recording: whose samples are pushed, None to push the steps of ``walk``;
    noise: of the truth, per axis [m].
    """

    name: str
    given: str
    walk: Walk
    recording: Recording | None
    frame: Frame | None
    plan: FloorPlan | None = None
    beacons: Beacons | None = None
    noise: float = 0.0

    def events(self):
        """What is pushed, in the order of arrival."""
        if self.recording is None:
            walk = self.walk
            return events(Given(walk.steps, walk.fixes, walk.headings, walk.levels))
        return events_of(replace(self.recording, fixes=self.walk.fixes))

    @property
    def begin(self):
        """Time of the first sample. [s]"""
        if self.recording is None:
            return self.walk.steps.start
        return min(float(signal.time[0]) for signal in self.recording.signals.values())

    def graph(self):
        """The factor graph of the batch."""
        walk = self.walk
        return WalkGraph(walk.steps, walk.fixes, headings=walk.headings, levels=walk.levels, floor=self.plan)


@dataclass(frozen=True)
class Group:
    """A row of the table. cases: functions that return a `Case` each, or None where nothing is left to be scored."""

    name: str
    given: str
    cases: tuple

    @property
    def title(self):
        """By which the row is chosen."""
        return f"{self.name}: {self.given}"


def groups(data, walks, first):
    """All rows. walks: number of simulated ones in each, None for the usual; first: seed of the first."""
    return [*recorded_groups(data), *simulated_groups(walks, first)]


def recorded_groups(data):
    """Rows of real recordings."""
    for given in HELP:
        for plan in (True, False):
            cases = [partial(mall_case, path, given, plan) for path in recording_paths(data)]
            yield Group("Microsoft", with_plan(given, plan), tuple(cases))
    for make in (eight, museum, campus):
        names = [(case.name, case.given) for case in _cases(make, data)]
        for n, (name, given) in enumerate(names):
            yield Group(name, given, (partial(_case, make, data, n),))
    for plan in (False, True):
        yield Group("APF", with_plan("its start and its first heading", plan), (partial(apf, data, plan),))


@cache
def _cases(make, data):
    return list(make(data))


def _case(make, data, number):
    return _cases(make, data)[number]


def with_plan(given, plan):
    return f"{given}, plan" if plan else given


def museum(data):
    """IPIN 2023, by the phone's GNSS, without and with beacons."""
    folder = data / "ipin2023_track3"
    for walk in ipin2023_walks(data):
        recording = load(folder / f"{walk.name}.txt")
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
    recording = load(data / "nju_phyphox_outdoor")
    lon, lat = recording.fixes.position[0]
    return Case("NJU campus", walk.name, walk, recording, enu(lat, lon))


def eight(data):
    """IPIN21's figure of eight, without and with its plan; its truth is dense enough for directions."""
    recording = load(data / "ipin21_hcu" / "eight")
    for walk in ipin21_walks(data):
        walk = replace(walk, truth=with_course(walk.truth))
        yield Case("IPIN21, eight", walk.name, walk, recording, walk.floor.frame)
        yield Case("IPIN21, eight", f"{walk.name}, plan", walk, recording, walk.floor.frame, walk.floor)


def mall(data, given, plan):
    """Microsoft's walks by what is given of their waypoints, with or without the plan."""
    yield from (_in_mall(recording, walk, given, plan) for recording, walk in helped_walks(data, given))


def mall_case(path, given, plan):
    """One of them; None if all its waypoints are given."""
    recording, walk = helped_walk(recording_at(path), given)
    return _in_mall(recording, walk, given, plan) if len(walk.truth) else None


def _in_mall(recording, walk, given, plan):
    floor = walk.floor if plan else None
    return Case("Microsoft", with_plan(given, plan), walk, recording, walk.floor.frame, floor, noise=WAYPOINT_NOISE)


def apf(data, plan):
    """A walk by its start and first heading; its reference is the walk smoothed, given that it ends where it began.

    plan: with the walls of its building, drawn as bare lines.
    """
    recording = load(data / "apf_pdr" / "walk")
    steps = detect_steps(recording)
    start, end = np.array([steps.start + 1.0]), np.array([steps.end])
    heading = Headings(start, np.array([APF_HEADING]), np.array([APF_SIGMA]))
    fix = Fixes(start, np.array([APF_START]), np.array([SIGMA]))
    ends = Fixes.concatenate([fix, replace(fix, time=end)])
    floor = FloorPlan.load(data / "apf_pdr" / "cad_lines.csv", scale=APF_SCALE)
    track = smooth(WalkGraph(steps, ends, headings=heading, floor=floor)).trajectory
    rows = np.searchsorted(track.time, np.arange(track.time[0], track.time[-1]))
    truth = replace(track[np.unique(rows)], covariance=None)
    floor = floor if plan else None
    walk = Walk("walk", steps, heading, fix, truth, floor)
    given = with_plan("its start and its first heading", plan)
    return Case("APF", given, walk, replace(recording, measurements=(heading,)), Frame(), floor)


COURSE_TIME, LEAST_SPEED = 1.0, 0.3  # [s] to either side; [m/s] below which a place has no direction


def with_course(truth):
    """A dense truth with the direction of the way from 1 s before each place to 1 s after; NaN where it stands."""
    before, after = (
        np.stack([np.interp(truth.time + by, truth.time, v) for v in truth.position.T], 1)
        for by in (-COURSE_TIME, COURSE_TIME)
    )
    way = after - before
    course = np.arctan2(way[:, 1], way[:, 0])
    return replace(truth, heading=np.where(np.hypot(*way.T) > 2 * COURSE_TIME * LEAST_SPEED, course, np.nan))


OWN = 60_000  # first seed of the walks of this table, beside those of others
FROM_STEPS = {  # name: setting, sources, walks; "sparse fixes" are SPARSE apart
    "outdoors": (OUTDOORS, ("GNSS",), 40),
    "indoors, fixes every 30 s": (INDOORS, ("user fixes",), 40),
    "indoors, fixes every 60 s, plan": (INDOORS, ("sparse fixes", "plan"), 40),
    "indoors, start, compass, plan": (INDOORS, ("start", "plan"), 30),
    "indoors, GNSS, beacons": (INDOORS, ("GNSS", "beacons"), 10),
}
FROM_SAMPLES = {  # name: setting, what the scenario has, walks
    "outdoors, samples, a minute's stand": (OUTDOORS, {"gnss": {"accuracy": 4.5}}, 20),
    "indoors, samples, fixes every 30 s, plan, a minute's stand": (INDOORS, {"fixes": {"period": 30.0}}, 20),
}
SCENARIO_FILES = {  # what the scenario's file does not have
    "arcade": {},
    "mall": {"fixes": {"period": 30.0, "sigma": 2.0}},
    "loop": {"fixes": {"period": 15.0, "sigma": 3.0}},
}


def simulated_groups(walks, first):
    """Rows of simulated walks: of steps, of raw samples, and the scenarios of the package."""
    for number, (name, (_, _, usual)) in enumerate(FROM_STEPS.items()):
        seeds = OWN + first + 1000 * number + np.arange(walks or usual)
        yield Group("simulated", name, tuple(partial(from_steps, name, int(seed)) for seed in seeds))
    for number, (name, (_, _, usual)) in enumerate(FROM_SAMPLES.items(), start=len(FROM_STEPS)):
        seeds = OWN + first + 1000 * number + np.arange(walks or usual)
        yield Group("simulated", name, tuple(partial(from_samples, name, int(seed)) for seed in seeds))
    for name in SCENARIO_FILES:
        yield Group("scenario", name, (partial(of_scenario, name),))


def from_steps(name, seed):
    """A simulated walk whose steps, measurements and headings are pushed in their time."""
    setting, sources, _ = FROM_STEPS[name]
    simulated = simulated_walk(setting, seed)
    given = measured(simulated, [source for source in sources if source != "sparse fixes"])
    if "sparse fixes" in sources:
        time = np.arange(5.0, simulated.truth.time[-1] - 5, SPARSE)
        given = with_fixes(given, at_times(simulated, time, USER, simulated.generator("sparse fixes")))
    walk = Walk(name, given.steps, given.headings, given.fixes, simulated.truth, given.floor, given.levels)
    return Case("simulated", name, walk, None, None, given.floor)


def from_samples(name, seed):
    """A simulated walk from raw samples in which the walker stands still for a minute."""
    setting, more, _ = FROM_SAMPLES[name]
    random = np.random.default_rng((seed, 7))
    _, corners, content = route_of(setting, seed, random, LENGTH)
    content |= {"seed": seed, "phone": PHONE} | more
    stop = max(1, round(STANDS_AT[seed % 2 == 0] * (len(corners) - 1)))
    route = [
        corners[0].tolist(),
        {"to": corners[1:stop].tolist()},
        {"stand": STANDING},
        {"to": corners[stop:].tolist()},
    ]
    route = [item for item in route if item != {"to": []}]
    return simulated("simulated", name, Scenario.of(content | {"route": [*route, {"stand": 3.0}]}), content.get("plan"))


def of_scenario(name):
    """A walk through a drawn building, with its plan, fixes and beacons."""
    path = scenario_file(name)
    content = tomllib.loads(path.read_text()) | SCENARIO_FILES[name]
    scenario = Scenario.of(content, path)
    return simulated("scenario", name, scenario, scenario.plan)


def simulated(name, given, scenario, plan):
    """A scenario as its recorder writes it."""
    made = simulate(scenario)
    with TemporaryDirectory() as folder:
        write(made, Path(folder))
        inputs = read(Path(folder), Options(plan=plan))
    recording, frame, beacons = inputs.walk, made.frame, inputs.beacons
    shift = scenario.start - recording.clock_origin
    users = [] if made.user_fixes is None else [made.user_fixes.shifted(shift)]
    fixes = Fixes.concatenate([frame.place(recording.fixes), *users])
    gaits = gait_signals(recording)
    steps, headings = detect_steps(gaits), magnetic_headings(gaits, frame, fixes.position[0])
    levels = levels_along(recording.bluetooth, beacons, steps) if beacons and recording.bluetooth else None
    every = round(1 / np.median(np.diff(made.truth.time)))
    truth = made.truth[::every]
    truth = Trajectory(truth.time + shift, truth.position, truth.heading)
    floor = inputs.building.floors[0] if inputs.building else None
    walk = Walk(scenario.name, steps, headings, fixes, truth, floor, levels)
    return Case(name, given, walk, recording, frame, floor, beacons)
