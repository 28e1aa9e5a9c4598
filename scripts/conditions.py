"""The walks of the experiments: recordings of the bench, simulated walks, and what a source may do wrong.

A walk is a `BenchWalk`: its evidence with the steps, and its truth.
"""

import os
import zlib
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import shapely
from aisles import aisles_of
from scipy.signal import lfilter
from shapely.affinity import scale, translate

from pdr_graph import FloorPlan, detect_steps, smooth
from pdr_graph.apps.bench.data_sets import BenchWalk, given, recorded, walks_of
from pdr_graph.estimation.factors.beacon_rssi import levels_along
from pdr_graph.floor.building import Building
from pdr_graph.floor.cells import WALL, Area
from pdr_graph.frames import Frame
from pdr_graph.gait.compass import compass_measurements
from pdr_graph.gait.learned import Velocities
from pdr_graph.gait.steps import gait_signals
from pdr_graph.gait.walker import Profile, Walker
from pdr_graph.geometry import interpolate, length_along, rotation, unit, wrap_angle
from pdr_graph.io.indoor_location import WAYPOINT_SIGMA
from pdr_graph.io.tables import SURVEY_SIGMA
from pdr_graph.lab.simulation.body import Body
from pdr_graph.lab.simulation.recorders import write
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.sensors import (
    BLUETOOTH,
    RandomPattern,
    Receiver,
    Transmitter,
    gnss_fixes,
    receptions,
)
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.types import (
    NONE,
    Beacons,
    Drifts,
    Fixes,
    Headings,
    Ranges,
    Recording,
    Steps,
    Trajectory,
    last_time,
    take,
)
from pdr_graph.walk import Evidence, Options, observe, read

ROOT = Path(__file__).resolve().parents[1]
MAPS = ROOT / "maps"
DATA = Path(os.environ.get("PDR_GRAPH_DATA", ROOT.parent / "shared" / "data"))

# Recordings


def percentiles(errors):
    return " / ".join(f"{p:.2f}" for p in np.percentile(errors, [50, 75, 95]))


@cache
def recordings(data, of):
    """The walks of a data set of the bench by name, as they are read."""
    return {name: read() for name, read in walks_of(of, data)}


def malls(data):
    """All mall recordings at hand without their plans, those of the bench and two more on each of 13 floors."""
    for path in sorted(data.glob("ms_indoor20/site*/*/*.txt")) + sorted(data.glob("ms_more/site*/*/*.txt")):
        name = f"{path.parent.parent.name}/{path.parent.name} {path.stem[:12]}"
        yield name, partial(recorded, path, Options(), WAYPOINT_SIGMA)


@cache
def walks_given(data, of, what):
    """The walks of a data set that are given something, by name, with their steps; without those that lack it."""
    walks = {name: given(walk, what) for name, walk in recordings(data, of).items()}
    return {name: with_steps(walk) for name, walk in walks.items() if walk is not None}


def with_steps(walk):
    """A walk with its steps, headings and what else its samples say."""
    return replace(walk, evidence=observe(walk.evidence))


def smoothed(walk):
    """The estimate of a walk by the graph."""
    return smooth(walk.evidence.graph())


def scattered(fixes, share, random):
    """Fixes of which some are each somewhere else, and which these are."""
    wild = random.permutation(len(fixes)) < round(share * len(fixes))
    off = random.uniform(NEAR, WIDE, (len(fixes), 1)) * unit(random.uniform(0, 2 * np.pi, len(fixes)))
    return replace(fixes, position=fixes.position + wild[:, None] * off), wild


# Simulated walks

NEAR, WIDE = 50.0, 500.0  # [m] that an outlier is off
PLANS = ("mall", "arcade", "campus")  # of maps/, one walk after the other
WAYS = (140.0, 260.0)  # [m] walked: two to four minutes
STANDS = 2  # stops of 5 to 15 s
EVERY = 100  # samples between two rows of the truth: 1 s
LEG, TURN = (25.0, 80.0), 1.2  # [m] and [rad] (sigma) of the legs of a walk outdoors
LOOP, SIDES, NARROW, CLOSE = (100.0, 300.0), (3, 7), 0.4, (1.0, 6.0)  # [m] of a loop; its sides; width; [m] left open
INDOORS, OUTDOORS, LOOPS = "indoors", "outdoors", "loops"
RECEIVERS = {INDOORS: Receiver(accuracy=8.0), OUTDOORS: Receiver(accuracy=4.5)}
LATE_RECEIVER = Receiver(accuracy=4.5, latency=2.0, correlation=120.0, smoothing=4.0)  # as phones are at their worst
BEACONS, BESIDE, POWER = 9, 4.0, 2.0  # of a museum; [m] around the walk; [dB] by which their powers differ
HELD, USER, PERIOD = 0.5, 1.5, 30.0  # [m] sigma of a known start or end; [m], [s] of the user's fixes
SCAN, MAP_SIGMA, MAP_LENGTH, MAP_WHITE = 4.0, 3.0, 8.0, 0.5  # [s] radio map; [m] sigma, correlation; share of white
ANCHORS, RANGE, NLOS, LATE = 4, 0.3, 0.2, 2.0  # anchors; [m] sigma; share without line of sight, [m] these are longer
NETWORK_EVERY, NETWORK_SIGMA, NETWORK_LASTS, NETWORK_GAIN = 0.1, 0.3, 1.0, 0.1  # [s], [m/s], [s], sigma of its log

# What a source may do wrong
FAR = 12.0  # [m] at least between two beacons that are swapped, or from a beacon to where it was moved
BUILDING = 30.0  # [m] by which a list of another building is off
OFF, JUMP, DELAY, FROZEN = 10.0, 20.0, 5.0, 60.0  # [m], [m], [s], [s] of a receiver
ASTRAY = 3.0  # [σ] that a receiver is off throughout which does not follow its walk
FOLLOWED = 0.5  # share of the way that a receiver follows indoors, as three of IPIN 2023's logs have it
LATE_FIXES = "late"  # 2 s late, smoothed by the receiver, with errors that stay for two minutes
CLOCK = 2.0  # [s] by which the clock of another device is late
WEAKER, FLATTER = -10.0, 0.8  # [dB] and factor of the levels about their mean, of another phone
ANOTHERS = (0.85, 1.15)  # strides by the profile of another walker
LEARNT, SPEED = (0.02, 0.002, 0.02), 1.3  # sigmas [-, rad/m, -] of a profile's coefficients, [m/s] of its walk
DRIFT = np.radians(1.9)  # [rad/s] of a gyroscope, as in the museum's Trial27
JUMPS, JUMP_TIME, TREMBLE, CONFIDENT = 3, 15.0, 0.2, 3.0  # jumps of so many s; [m] of a frozen place; factor
REBUILT, MOVED_MAP = 0.4, 12.0  # share of the floor; [m] by which its fingerprints are elsewhere
COMPASS, MISPLACED, STRIDE, SHIFT = np.radians(40.0), 8.0, 1.4, 5.0  # [rad], [m], factor, [m]
THICK, WIDEST = 0.3, 6.0  # [m] wall where the plan lacks a door; [m] to each side at most


SPACING = 6.0  # [m] between the places where a walker may change sides
SWAY = 0.35  # of the clearance, by which they keep off the middle of an aisle
NEAREST = 0.45  # [m] to a wall
STRAIGHT = 1.5  # log-odds of going straight on against turning back, at an intersection
ATTEMPTS = 400
WALKER_STRIDE = 0.06  # by which strides err besides the simulator's own differences, to be as far off as real ones
DISTURBANCE = 14.0  # [µT] of the magnetic field by steel


def simulated_recording(scenario, plan=None):
    """Return the walk of a scenario as its recorder writes it.

    Its fixes are those of the receiver and of the user; its truth has a row a second.
    """
    made = simulate(scenario)
    with TemporaryDirectory() as folder:
        write(made, Path(folder))
        evidence = read(Path(folder), Options(plan=plan))
    shift = scenario.start - evidence.walk.clock_origin
    users = [] if made.user_fixes is None else [made.user_fixes.shifted(shift)]
    fixes = Fixes.concatenate([made.frame.place(evidence.walk.fixes), *users])
    truth = made.truth[:: round(1 / np.median(np.diff(made.truth.time)))]
    truth = Trajectory(truth.time + shift, truth.position, truth.heading)
    return with_steps(BenchWalk(replace(evidence, frame=made.frame, fixes=fixes), truth))


@cache
def loaded(path, label):
    """A floor, read once."""
    return FloorPlan.load(path, label)


@cache
def aisles(path, label):
    """The aisles of a floor, derived once, see `aisles_of`."""
    return aisles_of(loaded(path, label))


def route_between_walls(path, label, random, lengths):
    """Corners ``(k, 2)`` [m] of a random route along the aisles of a floor. lengths: shortest and longest [m]."""
    floor, (links, lines) = loaded(path, label), aisles(path, label)
    wanted = min(np.exp(random.uniform(*np.log(lengths))), sum(map(_length, lines)))
    for attempt in range(ATTEMPTS):
        line = _wandered(links, lines, wanted, random)
        if _length(line) < wanted * (1 - attempt / ATTEMPTS):
            continue
        corners = _swayed(line, floor, random)
        if corners is not None:
            return corners
    raise SystemExit(f"no way of {wanted:.0f} m on floor {floor.label}")


def _wandered(links, lines, wanted, random):
    """A line from one aisle to the next, never back, of a length if the floor has it."""
    length = np.array([_length(line) for line in lines])
    link = int(random.choice(len(lines), p=length / length.sum()))
    node = int(links[link, random.integers(2)])
    line = _leaving(links, lines, link, node)
    line = _cut(line, random.uniform(0, 0.8) * length[link], length[link])
    node = int(links[link].sum() - node)
    while _length(line) < wanted:
        ahead = [n for n in np.flatnonzero((links == node).any(axis=1)).tolist() if n != link]
        if not ahead:
            break
        ways = [_leaving(links, lines, n, node) for n in ahead]
        turns = np.array([_course(w, 0) for w in ways]) - _course(line, -1)
        weight = np.exp(STRAIGHT * np.cos(turns))
        chosen = int(random.choice(len(ahead), p=weight / weight.sum()))
        link, node = ahead[chosen], int(links[ahead[chosen]].sum() - node)
        line = np.concatenate([line, ways[chosen][1:]])
    return _cut(line, 0.0, wanted)


def _leaving(links, lines, link, node):
    """The line of an aisle from one of its ends."""
    return lines[link] if links[link, 0] == node else lines[link][::-1]


def _swayed(line, floor, random):
    """Corners of a walk beside a line ``(m, 2)``, None if it comes too near to walls."""
    smooth = shapely.simplify(shapely.linestrings(line), 0.3)
    points = shapely.get_coordinates(shapely.segmentize(smooth, SPACING))
    aside = random.standard_normal(points.shape) * SWAY * np.maximum(floor.distance.at(points)[0] - NEAREST, 0)[:, None]
    for _ in range(6):
        moved = points + aside
        legs = np.stack([moved[:-1], moved[1:]], axis=1)
        looked = moved[:-1, None] + np.linspace(0, 1, 40)[:, None] * (moved[1:] - moved[:-1])[:, None]
        near = floor.distance.at(looked.reshape(-1, 2))[0].reshape(-1, 40).min(axis=1) < NEAREST
        near |= floor.crosses_wall(*legs.transpose(1, 0, 2))
        if not near.any():
            return moved[np.append(True, np.hypot(*np.diff(moved, axis=0).T) > 0.5)]
        aside[np.append(near, False) | np.append(False, near)] *= 0.5
    return None


def _length(line):
    return float(length_along(line)[-1])


def _course(line, leg):
    return np.arctan2(*np.diff(line, axis=0)[leg][::-1])


def _cut(line, begin, end):
    along = length_along(line)
    inside = (along > begin + 0.5) & (along < end - 0.5)
    return interpolate(np.concatenate([[begin], along[inside], [min(end, along[-1])]]), along, line)


@dataclass(frozen=True)
class SimulatedWalk:
    """A walk as the front end saw it, with its truth; body: for radios; plan: None outdoors; frame: drift [rad/s] and
    angle [rad] of the gyroscope's level frame.
    """

    setting: str
    seed: int
    steps: Steps
    headings: Headings
    drifts: Drifts
    truth: Trajectory
    body: Body
    plan: FloorPlan | None
    frame: np.ndarray

    def generator(self, name):
        """The random numbers of one source, the same whatever else is used."""
        return np.random.default_rng((self.seed, zlib.crc32(name.encode())))


def simulated_walk(setting, seed):
    """Walk of a setting: another walker, phone and route for each seed."""
    random = np.random.default_rng((seed, 7))
    plan, corners, content = route_of(setting, seed, random, WAYS)
    return walk_along(corners, setting, seed, random, plan, content)


def walk_along(corners, setting, seed, random, plan, content):
    """Walk along corners ``(k, 2)`` [m] with a few stops. content: what the scenario says of the plan."""
    content = content | {"seed": seed, "phone": {"rate": 50, "disturbance": DISTURBANCE}}
    simulation = simulate(Scenario.of(content | {"route": with_stands(corners, random)}))
    gaits = gait_signals(simulation.recording())
    steps, factor = detect_steps(gaits), np.exp(WALKER_STRIDE * random.standard_normal())
    steps = replace(steps, length=factor * steps.length, sigma_length=factor * steps.sigma_length)
    headings, drifts = compass_measurements(gaits, simulation.frame, corners[0])
    time, course = gaits[0].attitude.time, gaits[0].direction.heading
    frame = np.polyfit(time, course - np.interp(time, simulation.body.time, simulation.body.heading), 1)
    truth = simulation.truth[::EVERY]
    return SimulatedWalk(setting, seed, steps, headings, drifts, truth, simulation.body, plan, frame)


def route_of(setting, seed, random, length):
    """The plan, None without; the corners of a route ``(k, 2)`` [m]; and what the scenario says of the plan.

    length: shortest and longest, indoors [m].
    """
    if setting != INDOORS:
        return None, (route_outdoors if setting == OUTDOORS else nearly_closed)(random), {}
    path = MAPS / f"{PLANS[seed % len(PLANS)]}.geojson"
    plan = loaded(path, None)
    return plan, route_between_walls(path, None, random, length), {"plan": str(path), "floor": plan.label}


def route_outdoors(random):
    """Corners ``(k, 2)`` [m] of a walk without a plan."""
    wanted = np.exp(random.uniform(*np.log(WAYS)))
    corners, course, walked = [np.zeros(2)], random.uniform(-np.pi, np.pi), 0.0
    while walked < wanted:
        leg = random.uniform(*LEG)
        corners.append(corners[-1] + leg * unit(np.array(course)))
        course, walked = course + random.normal(0, TURN), walked + leg
    return np.array(corners)


def nearly_closed(random):
    """Corners ``(k, 2)`` [m] of a walk without a plan that ends a few metres from its start: around, or back again."""
    wanted = np.exp(random.uniform(*np.log(LOOP)))
    if random.random() < 0.5:
        sides = int(random.integers(*SIDES))
        course = 2 * np.pi * (np.arange(sides) + random.uniform(-0.3, 0.3, sides)) / sides
        around = random.uniform(0.6, 1.4, (sides, 1)) * unit(course) * [1.0, random.uniform(NARROW, 1.0)]
        turned = rotation(random.uniform(-np.pi, np.pi))
        corners = np.concatenate([around, around[:1]])[:: random.choice([-1, 1])] @ turned
    else:
        out = route_outdoors(random)
        corners = np.concatenate([out, out[-2::-1]])
    corners = corners * wanted / np.hypot(*np.diff(corners, axis=0).T).sum()
    corners[-1] += random.uniform(*CLOSE) * unit(np.array(random.uniform(-np.pi, np.pi)))
    return corners


def with_stands(corners, random):
    """A route along corners with a few stops."""
    stops = np.sort(random.choice(np.arange(1, len(corners) - 1), min(STANDS, len(corners) - 2), replace=False))
    route = [corners[0].tolist(), {"stand": 3}]
    for begin, end in pairwise([1, *(stops + 1).tolist(), len(corners)]):
        route += [{"to": corners[begin:end].tolist()}, {"stand": float(random.uniform(5, 15))}]
    return route


def events(evidence):
    """Measurements in their time, and each step as it ends."""
    tables = [evidence.fixes, evidence.headings, *evidence.measurements]
    steps, begin = evidence.steps, -np.inf
    for n in range(len(steps)):
        columns = {name: v[n : n + 1] for name, v in vars(steps).items() if isinstance(v, np.ndarray)}
        start = steps.start if n == 0 else float(steps.time[n - 1])
        yield Steps(start, float(steps.time[n]), **columns)
        for data in tables:
            rows = np.flatnonzero((last_time(data) > begin) & (last_time(data) <= steps.time[n]))
            if len(rows):
                yield take(data, rows)
        begin = steps.time[n]


def measured(walk, sources):
    """The evidence that sources such as "GNSS" or "beacons: swapped pair" give of a walk; the phone's compass unless it
    is off.
    """
    given = seen(walk)
    for source in sources:
        name, _, lie = source.partition(": ")
        given = SOURCES[name](given, walk, lie, walk.generator(name))
    return given


def seen(walk):
    """A walk by its steps and headings alone."""
    nothing = Recording(walk.setting, 0.0, None), Walker(), None, Frame(), Fixes.none()
    return Evidence(*nothing, steps=walk.steps, headings=walk.headings, measurements=(walk.drifts,))


def with_table(given, table):
    return replace(given, measurements=(*given.measurements, table))


def with_fixes(given, fixes):
    return replace(given, fixes=Fixes.concatenate([given.fixes, fixes]))


def gnss(given, walk, lie, random):
    """The phone's receiver, its positions alone."""
    alone = gnss_and_speed(seen(walk), walk, lie, random).fixes
    return with_fixes(given, replace(alone, speed=NONE, course=NONE))


def gnss_and_speed(given, walk, lie, random):
    """The phone's receiver with speed and course; the positions are the same."""
    random = walk.generator("GNSS")
    receiver = LATE_RECEIVER if lie == LATE_FIXES else RECEIVERS[walk.setting]
    fixes = gnss_fixes(walk.body, receiver, random).fixes
    fixes = RECEIVER_LIES[lie](fixes, random) if lie in RECEIVER_LIES else fixes
    inside = (fixes.time >= walk.steps.start) & (fixes.time <= walk.steps.end)
    return with_fixes(given, replace(fixes, source=("GNSS",) * len(fixes))[inside])


def any_direction(random):
    return unit(random.uniform(-np.pi, np.pi))


def jumping(fixes, random):
    """Some intervals elsewhere, each in another direction."""
    position = fixes.position.copy()
    for begin in random.uniform(0, fixes.time[-1] - JUMP_TIME, JUMPS):
        there = (fixes.time >= begin) & (fixes.time < begin + JUMP_TIME)
        position[there] += JUMP * any_direction(random)
    return replace(fixes, position=position)


def displaced(fixes, random):
    """The right place at first, from half-way on another that stays as far off."""
    half = fixes.time > (fixes.time[0] + fixes.time[-1]) / 2
    return replace(fixes, position=fixes.position + half[:, None] * JUMP * any_direction(random))


def frozen(fixes, random):
    """A place that the receiver holds while the walker walks on."""
    begin = random.uniform(0.1, 0.9) * (fixes.time[-1] - FROZEN)
    held = (fixes.time >= begin) & (fixes.time < begin + FROZEN)
    position = fixes.position.copy()
    position[held] = position[np.argmax(held)] + random.normal(0, TREMBLE, (int(held.sum()), 2))
    return replace(fixes, position=position)


def shrunk(fixes):
    """A receiver that follows half of the way."""
    middle = fixes.position.mean(axis=0)
    return replace(fixes, position=middle + FOLLOWED * (fixes.position - middle))


def not_following(fixes, random):
    """Off throughout by so many stated sigmas, with the course of something else, as one of IPIN 2023's ten logs."""
    position = fixes.position + ASTRAY * np.median(fixes.sigma) * any_direction(random)
    return replace(fixes, position=position, course=wrap_angle(fixes.course + np.pi / 2))


def alternating(fixes):
    """Every second fix is of another walker, who goes the same way backwards."""
    position = np.where(np.arange(len(fixes))[:, None] % 2, fixes.position[::-1], fixes.position)
    return replace(fixes, position=position)


RECEIVER_LIES = {
    "10 m off": lambda fixes, random: replace(fixes, position=fixes.position + OFF * any_direction(random)),
    "jumping": jumping,
    "20 m off from half-way on": displaced,
    "5 s late": lambda fixes, random: fixes.shifted(DELAY),
    "frozen for a minute": frozen,
    "half as far": lambda fixes, random: shrunk(fixes),
    "of two people": lambda fixes, random: alternating(fixes),
    "not following": not_following,
    "3 times as sure": lambda fixes, random: replace(fixes, sigma=fixes.sigma / CONFIDENT),
    "courses 90° off": lambda fixes, random: replace(fixes, course=wrap_angle(fixes.course + np.pi / 2)),
}


def beacons(given, walk, lie, random):
    """Levels of nine beacons about the walk, and their list."""
    low, high = walk.truth.position.min(axis=0) - BESIDE, walk.truth.position.max(axis=0) + BESIDE
    places = spread(low, high, BEACONS, random)
    power = -59.0 + random.normal(0, POWER, BEACONS)
    below = random.choice(BEACONS, 3, replace=False)
    if lie == "three on another floor":
        power[below] -= 15.0  # [dB] through a ceiling, as the simulator has it
    elif lie == "one off near the walk":
        gap = walk.truth.position[:, None] - places
        power[np.argmin(np.hypot(*gap.transpose(2, 0, 1)).min(axis=0))] = -np.inf
    transmitters = [Transmitter(f"b{n}", place, power=power[n]) for n, place in enumerate(places)]
    heard = receptions(walk.body, transmitters, BLUETOOTH, random, random)
    listed, kept = places + random.normal(0, SURVEY_SIGMA, places.shape), np.arange(BEACONS)
    near = np.flatnonzero([name in heard.transmitter for name in (t.name for t in transmitters)])
    one = int(random.choice(near))
    apart = np.hypot(*(listed - listed[one]).T)
    if lie == "a pair swapped":
        other = int(random.choice(near[apart[near] > min(FAR, apart[near].max() - 1e-9)]))
        listed[[one, other]] = listed[[other, one]]
    elif lie == "one moved":
        grid = random.uniform(low, high, (1000, 2))
        distance = np.hypot(*(grid - listed[one]).T)
        listed[one] = grid[np.argmax(distance > min(FAR, distance.max() - 1e-9))]
    elif lie == "one missing":
        kept = np.delete(kept, one)
    elif lie == "of another floor":
        listed = spread(low, high, BEACONS, random)
    elif lie == "of another building":
        listed = listed + BUILDING * any_direction(random)
    if lie == "another phone":
        heard = replace(heard, rssi=FLATTER * (heard.rssi - heard.rssi.mean()) + heard.rssi.mean() + WEAKER)
    names = tuple(f"b{n}" for n in kept)
    listing = Beacons(names, listed[kept], np.full(len(kept), SURVEY_SIGMA), ("",) * len(kept), names)
    return with_table(given, levels_along(heard, listing, walk.steps))


def spread(low, high, count, random):
    """Places ``(count, 2)`` [m] in a box, each as far from the others as the best of ten."""
    places = [random.uniform(low, high)]
    while len(places) < count:
        drawn = random.uniform(low, high, (10, 2))
        nearest = np.hypot(*(drawn[:, None] - np.array(places)).transpose(2, 0, 1)).min(axis=1)
        places.append(drawn[np.argmax(nearest)])
    return np.array(places)


def at_times(walk, time, sigma, random, source=""):
    """Independent fixes of the truth."""
    place = interpolate(time, walk.truth.time, walk.truth.position) + random.normal(0, sigma, (len(time), 2))
    return Fixes(time, place, np.full(len(time), sigma), source=(source,) * len(time))


def user_fixes(given, walk, lie, random):
    """Positions that the user knows; of another device or two people under a lie."""
    fixes = at_times(walk, np.arange(5.0, walk.truth.time[-1] - 5, PERIOD), USER, random)
    return with_fixes(given, USER_LIES[lie](fixes) if lie else fixes)


USER_LIES = {"clock 2 s off": lambda fixes: fixes.shifted(CLOCK), "of two people": alternating}


def start(given, walk, lie, random):
    """The known start; misplaced under a lie."""
    fixes = at_times(walk, walk.truth.time[:1], HELD, random)
    away = MISPLACED * any_direction(random) if lie else np.zeros(2)
    return with_fixes(given, replace(fixes, position=fixes.position + away))


def end(given, walk, lie, random):
    return with_fixes(given, at_times(walk, walk.truth.time[-1:], HELD, random))


def radio_map(given, walk, lie, random):
    """Fixes of a radio map, whose errors depend on the place."""
    fixes = at_times(walk, np.arange(2.0, walk.truth.time[-1] - 2, SCAN), MAP_WHITE * MAP_SIGMA, random, "radio map")
    field, true = (
        RandomPattern.sample(random, MAP_LENGTH, 2),
        interpolate(fixes.time, walk.truth.time, walk.truth.position),
    )
    position = fixes.position + MAP_SIGMA * np.sqrt(1 - MAP_WHITE**2) * field.at(true)
    if lie:
        along = true @ any_direction(random)
        rebuilt = along < np.quantile(along, REBUILT)
        position[rebuilt] += MOVED_MAP * any_direction(random)
    return with_fixes(given, replace(fixes, position=position, sigma=np.full(len(fixes), MAP_SIGMA)))


def ranges(given, walk, lie, random):
    """Ranges to anchors about the walk, one a second; some without line of sight; by a late clock under a lie."""
    low, high = walk.truth.position.min(axis=0) - BESIDE, walk.truth.position.max(axis=0) + BESIDE
    anchors = spread(low, high, ANCHORS, random)
    time = np.arange(1.0, walk.truth.time[-1] - 1)
    late = CLOCK if lie else 0.0
    true = interpolate(time, walk.truth.time, walk.truth.position)
    which = random.integers(0, ANCHORS, len(time))
    distance = np.hypot(*(anchors[which] - true).T) + random.normal(0, RANGE, len(time))
    distance += (random.random(len(time)) < NLOS) * random.exponential(LATE, len(time))
    sigma, names = np.full(len(time), RANGE), tuple(f"a{n}" for n in range(ANCHORS))
    table = Ranges(time + late, which, np.maximum(distance, 0), sigma, names, anchors, np.full(ANCHORS, 0.1))
    return with_table(given, table)


def network(given, walk, lie, random):
    """Velocities by a network, with errors that last for seconds and a gain of its own; or what says something else."""
    time = np.arange(1.0, walk.truth.time[-1] - 1, NETWORK_EVERY)
    place = interpolate(time, walk.body.time, walk.body.position)
    velocity = np.gradient(place[:, 0] + 1j * place[:, 1], time) * np.exp(1j * np.polyval(walk.frame, time))
    kept = np.exp(-NETWORK_EVERY / NETWORK_LASTS)
    noise = random.normal(0, NETWORK_SIGMA * np.sqrt(1 - kept**2), (len(time), 2)) @ [1, 1j]
    velocity *= np.exp(NETWORK_GAIN * random.standard_normal() + 1j * random.uniform(-np.pi, np.pi))
    velocity = NETWORK_LIES[lie](velocity) + lfilter([1.0], [1.0, -kept], noise) * (lie != "zero")
    sigma, frame = np.full((len(time), 2), NETWORK_SIGMA), np.zeros(len(time), dtype=np.intp)
    return with_table(given, Velocities(time, np.column_stack([velocity.real, velocity.imag]), sigma, frame))


NETWORK_LIES = {
    "": lambda velocity: velocity,
    "turned by 90°": lambda velocity: 1j * velocity,
    "zero": lambda velocity: 0 * velocity,
    "half": lambda velocity: velocity / 2,
    "constant": lambda velocity: np.full_like(velocity, 1.1),
    "mirrored": lambda velocity: velocity.conj(),
    "of another walk": lambda velocity: velocity[::-1],
    "turned for 20 s": lambda velocity: velocity * np.where(in_middle(velocity, 20.0), 1j, 1.0),
}


def in_middle(velocity, lasting):
    """True for the velocities of some seconds in the middle of a walk."""
    return np.abs(np.arange(len(velocity)) - len(velocity) / 2) < lasting / 2 / NETWORK_EVERY


def compass(given, walk, lie, random):
    """The phone's compass: none, or off."""
    if lie == "none":
        others = tuple(table for table in given.measurements if not isinstance(table, Drifts))
        return replace(given, headings=Headings.none(), measurements=others)
    side = random.choice([-1, 1])
    return replace(given, headings=replace(walk.headings, heading=walk.headings.heading + side * COMPASS))


def gyroscope(given, walk, lie, random):
    """A gyroscope that drifts, in all turns and in what the compass measures of it."""
    steps, rate = given.steps, DRIFT * random.choice([-1, 1])
    lasting = np.diff(steps.time, prepend=steps.start)
    turned = {
        "turn": steps.turn + rate * lasting,
        "pause_turn": steps.pause_turn + rate * (lasting - steps.duration),
        "final_turn": steps.final_turn + rate * (steps.end - steps.time[-1]),
    }
    tables = [replace(t, drift=t.drift - rate) if isinstance(t, Drifts) else t for t in given.measurements]
    return replace(given, steps=replace(steps, **turned), measurements=tuple(tables))


def stride(given, walk, lie, random):
    """Strides too long or too short."""
    factor = random.choice([STRIDE, 1 / STRIDE])
    steps = walk.steps
    return replace(given, steps=replace(steps, length=factor * steps.length, sigma_length=factor * steps.sigma_length))


def profile(given, walk, lie, random):
    """A profile, learnt on a walk with good positions: the walker's, or somebody else's."""
    true = np.hypot(*np.diff(walk.truth.position, axis=0).T).sum() / walk.steps.length.sum()
    learnt = Profile(true * (random.choice(ANOTHERS) if lie else 1.0) - 1, 0.0, 0.0, np.diag(LEARNT) ** 2, 0.0, SPEED)
    return replace(given, steps=learnt.corrected(walk.steps), walker=Walker(profile=learnt))


def plan(given, walk, lie, random):
    """The floor plan."""
    return replace(given, building=Building.around(PLAN_LIES[lie](walk, random) if lie else walk.plan))


def shifted_plan(walk, random):
    east, north = SHIFT * any_direction(random)
    return with_shapes(walk.plan, lambda shape: translate(shape, east, north))


def without_door(walk, random):
    """A wall across the walk, as wide as the passage."""
    walkable, rows = walk.plan.walkable, np.arange(len(walk.truth) // 4, 3 * len(walk.truth) // 4)
    for row in random.permutation(rows):
        here, across = walk.truth.position[row], rotation(np.pi / 2) @ unit(walk.truth.heading[row])
        line = shapely.linestrings(here + np.array([[-WIDEST], [WIDEST]]) * across)
        parts = shapely.get_parts(shapely.intersection(line, walkable))
        passage = parts[np.argmin(shapely.distance(parts, shapely.points(here)))] if len(parts) else line
        if shapely.length(passage) < WIDEST:
            shape = shapely.buffer(passage, THICK / 2, cap_style="square")
            return replace(walk.plan, areas=(*walk.plan.areas, Area(WALL, "", shape)))
    return walk.plan


def another_floor(walk, random):
    """A plan of other corridors, stretched to the same outline."""
    others = [name for name in PLANS if name != PLANS[walk.seed % len(PLANS)]]
    other = loaded(MAPS / f"{random.choice(others)}.geojson", None)
    size, wanted = np.diff(other.corners, axis=0)[0], np.diff(walk.plan.corners, axis=0)[0]
    east, north = walk.plan.corners[0] - other.corners[0]
    corner, factors = tuple(walk.plan.corners[0]), wanted / size
    return with_shapes(other, lambda shape: scale(translate(shape, east, north), *factors, origin=corner))


def with_shapes(plan, change):
    """A plan with all its areas changed alike."""
    return replace(plan, areas=tuple(replace(area, shape=change(area.shape)) for area in plan.areas))


PLAN_LIES = {"5 m shifted": shifted_plan, "a door missing": without_door, "of another floor": another_floor}
SOURCES = (beacons, user_fixes, start, end, radio_map, ranges, network, compass, gyroscope, stride, profile, plan)
SOURCES = {source.__name__.replace("_", " "): source for source in SOURCES}
SOURCES |= {"GNSS": gnss, "GNSS and speed": gnss_and_speed}
