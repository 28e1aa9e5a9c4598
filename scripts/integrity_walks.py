"""Simulated walks and what each source measures of them, honest or with a lie, for the table of integrity."""

import zlib
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import shapely
import topology
from shapely.affinity import scale, translate

from pdr_graph import FloorPlan, WalkGraph, detect_steps, magnetic_headings
from pdr_graph.estimation.factors.beacon_rssi import levels_along
from pdr_graph.floor.cells import WALL, Area
from pdr_graph.gait.steps import gait_signals
from pdr_graph.geometry import interpolate, rotation, unit
from pdr_graph.io.tables import SURVEY_SIGMA
from pdr_graph.lab.simulation.body import Body
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.sensors import (
    BLUETOOTH,
    FLOOR_LOSS,
    RandomPattern,
    Receiver,
    Transmitter,
    gnss_fixes,
    receptions,
)
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.types import Beacons, Fixes, Headings, Levels, Ranges, Steps, Trajectory

PLANS = ("mall", "arcade", "campus")  # of maps/, one walk after the other
WAYS = (140.0, 260.0)  # [m] walked: two to four minutes
STANDS = 2  # stops of 5 to 15 s
EVERY = 100  # samples between two rows of the truth: 1 s
LEG, TURN = (25.0, 80.0), 1.2  # [m] and [rad] (sigma) of the legs of a walk outdoors
LOOP, SIDES, NARROW, CLOSE = (100.0, 300.0), (3, 7), 0.4, (1.0, 6.0)  # [m] of a loop; its sides; width; [m] left open
INDOORS, OUTDOORS, LOOPS = "indoors", "outdoors", "loops"
RECEIVERS = {INDOORS: Receiver(accuracy=8.0), OUTDOORS: Receiver(accuracy=4.5)}
BEACONS, BESIDE, POWER = 9, 4.0, 2.0  # of a museum; [m] around the walk; [dB] by which their powers differ
HELD, USER, PERIOD = 0.5, 1.5, 30.0  # [m] sigma of a known start or end; [m], [s] of the user's fixes
SCAN, MAP_SIGMA, MAP_LENGTH, MAP_WHITE = 4.0, 3.0, 8.0, 0.5  # [s] radio map; [m] sigma, correlation; share of white
ANCHORS, RANGE, NLOS, LATE = 4, 0.3, 0.2, 2.0  # anchors; [m] sigma; share without line of sight, [m] these are longer

# Lies
FAR = 12.0  # [m] at least between two beacons that are swapped, or from a beacon to where it was moved
BUILDING = 30.0  # [m] by which a list of another building is off
OFF, JUMP, DELAY, FROZEN = 10.0, 20.0, 5.0, 60.0  # [m], [m], [s], [s] of a receiver
JUMPS, JUMP_TIME, TREMBLE, CONFIDENT = 3, 15.0, 0.2, 3.0  # jumps of so many s; [m] of a frozen place; factor
REBUILT, MOVED_MAP = 0.4, 12.0  # share of the floor; [m] by which its fingerprints are elsewhere
COMPASS, MISPLACED, STRIDE, SHIFT = np.radians(40.0), 8.0, 1.4, 5.0  # [rad], [m], factor, [m]
THICK, WIDEST = 0.3, 6.0  # [m] wall where the plan lacks a door; [m] to each side at most


@dataclass(frozen=True)
class SimulatedWalk:
    """A walk as the front end saw it, with its truth; body: for radios; plan: None outdoors."""

    setting: str
    seed: int
    steps: Steps
    headings: Headings
    truth: Trajectory
    body: Body
    plan: FloorPlan | None

    def generator(self, name):
        """The random numbers of one source, the same whatever else is used."""
        return np.random.default_rng((self.seed, zlib.crc32(name.encode())))


def simulated_walk(setting, seed):
    """Walk of a setting: another walker, phone and route for each seed."""
    random = np.random.default_rng((seed, 7))
    plan, corners, content = route_of(setting, seed, random, WAYS)
    content |= {"seed": seed, "phone": {"rate": 50, "disturbance": topology.DISTURBANCE}}
    simulation = simulate(Scenario.of(content | {"route": with_stands(corners, random)}))
    gaits = gait_signals(simulation.recording())
    steps, factor = detect_steps(gaits), np.exp(topology.STRIDE * random.standard_normal())
    steps = replace(steps, length=factor * steps.length, sigma_length=factor * steps.sigma_length)
    headings = magnetic_headings(gaits, simulation.frame, corners[0])
    return SimulatedWalk(setting, seed, steps, headings, simulation.truth[::EVERY], simulation.body, plan)


def route_of(setting, seed, random, length):
    """The plan, None without; the corners of a route ``(k, 2)`` [m]; and what the scenario says of the plan.

    length: shortest and longest, indoors [m].
    """
    if setting != INDOORS:
        return None, (route_outdoors if setting == OUTDOORS else nearly_closed)(random), {}
    path = topology.MAPS / f"{PLANS[seed % len(PLANS)]}.geojson"
    plan = topology.loaded(path, None)
    return plan, topology.route(plan, random, length), {"plan": str(path), "floor": plan.label}


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


@dataclass(frozen=True)
class Given:
    """What an estimate is given of a walk."""

    steps: Steps
    fixes: Fixes
    headings: Headings
    levels: Levels | None = None
    ranges: Ranges | None = None
    floor: FloorPlan | None = None

    def graph(self):
        """The factor graph."""
        tables = [] if self.ranges is None else [self.ranges]
        return WalkGraph(
            self.steps,
            self.fixes,
            headings=self.headings,
            levels=self.levels,
            floor=self.floor,
            measurements=tables,
        )


def measured(walk, sources):
    """What sources such as "GNSS" or "beacons: swapped pair" give of a walk; the phone's compass unless it is off."""
    given = Given(walk.steps, Fixes.none(), walk.headings)
    for source in sources:
        name, _, lie = source.partition(": ")
        given = SOURCES[name](given, walk, lie, walk.generator(name))
    return given


def with_fixes(given, fixes):
    return replace(given, fixes=Fixes.concatenate([given.fixes, fixes]))


def gnss(given, walk, lie, random):
    """The phone's receiver."""
    fixes = gnss_fixes(walk.body, RECEIVERS[walk.setting], random).fixes
    fixes = RECEIVER_LIES[lie](fixes, random) if lie else fixes
    inside = (fixes.time >= walk.steps.start) & (fixes.time <= walk.steps.end)
    return with_fixes(given, replace(fixes, source=("GNSS",) * len(fixes))[inside])


def off_throughout(fixes, random):
    return replace(fixes, position=fixes.position + OFF * unit(random.uniform(-np.pi, np.pi)))


def jumping(fixes, random):
    """Some intervals elsewhere, each in another direction."""
    position = fixes.position.copy()
    for begin in random.uniform(0, fixes.time[-1] - JUMP_TIME, JUMPS):
        there = (fixes.time >= begin) & (fixes.time < begin + JUMP_TIME)
        position[there] += JUMP * unit(random.uniform(-np.pi, np.pi))
    return replace(fixes, position=position)


def frozen(fixes, random):
    """A place that the receiver holds while the walker walks on."""
    begin = random.uniform(0.1, 0.9) * (fixes.time[-1] - FROZEN)
    held = (fixes.time >= begin) & (fixes.time < begin + FROZEN)
    position = fixes.position.copy()
    position[held] = position[np.argmax(held)] + random.normal(0, TREMBLE, (int(held.sum()), 2))
    return replace(fixes, position=position)


RECEIVER_LIES = {
    "10 m off": off_throughout,
    "jumping": jumping,
    "5 s late": lambda fixes, random: fixes.shifted(DELAY),
    "frozen for a minute": frozen,
    "3 times as sure": lambda fixes, random: replace(fixes, sigma=fixes.sigma / CONFIDENT),
}


def beacons(given, walk, lie, random):
    """Levels of nine beacons about the walk, and their list."""
    low, high = walk.truth.position.min(axis=0) - BESIDE, walk.truth.position.max(axis=0) + BESIDE
    places = spread(low, high, BEACONS, random)
    power = -59.0 + random.normal(0, POWER, BEACONS)
    below = random.choice(BEACONS, 3, replace=False)
    if lie == "three on another floor":
        power[below] -= FLOOR_LOSS
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
    elif lie == "of another building":
        listed = listed + BUILDING * unit(random.uniform(-np.pi, np.pi))
    names = tuple(f"b{n}" for n in kept)
    listing = Beacons(names, listed[kept], np.full(len(kept), SURVEY_SIGMA), ("",) * len(kept), names)
    return replace(given, levels=levels_along(heard, listing, walk.steps))


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
    """Positions that the user knows."""
    return with_fixes(given, at_times(walk, np.arange(5.0, walk.truth.time[-1] - 5, PERIOD), USER, random))


def start(given, walk, lie, random):
    """The known start; misplaced under a lie."""
    fixes = at_times(walk, walk.truth.time[:1], HELD, random)
    away = MISPLACED * unit(random.uniform(-np.pi, np.pi)) if lie else np.zeros(2)
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
        along = true @ unit(random.uniform(-np.pi, np.pi))
        rebuilt = along < np.quantile(along, REBUILT)
        position[rebuilt] += MOVED_MAP * unit(random.uniform(-np.pi, np.pi))
    return with_fixes(given, replace(fixes, position=position, sigma=np.full(len(fixes), MAP_SIGMA)))


def ranges(given, walk, lie, random):
    """Ranges to anchors about the walk, one a second; some without line of sight."""
    low, high = walk.truth.position.min(axis=0) - BESIDE, walk.truth.position.max(axis=0) + BESIDE
    anchors = spread(low, high, ANCHORS, random)
    time = np.arange(1.0, walk.truth.time[-1] - 1)
    true = interpolate(time, walk.truth.time, walk.truth.position)
    which = random.integers(0, ANCHORS, len(time))
    distance = np.hypot(*(anchors[which] - true).T) + random.normal(0, RANGE, len(time))
    distance += (random.random(len(time)) < NLOS) * random.exponential(LATE, len(time))
    sigma, names = np.full(len(time), RANGE), tuple(f"a{n}" for n in range(ANCHORS))
    table = Ranges(time, which, np.maximum(distance, 0), sigma, names, anchors, np.full(ANCHORS, 0.1))
    return replace(given, ranges=table)


def compass(given, walk, lie, random):
    """The phone's compass: none, or off."""
    if lie == "none":
        return replace(given, headings=Headings.none())
    side = random.choice([-1, 1])
    return replace(given, headings=replace(walk.headings, heading=walk.headings.heading + side * COMPASS))


def stride(given, walk, lie, random):
    """Strides too long or too short."""
    factor = random.choice([STRIDE, 1 / STRIDE])
    steps = walk.steps
    return replace(given, steps=replace(steps, length=factor * steps.length, sigma_length=factor * steps.sigma_length))


def plan(given, walk, lie, random):
    """The floor plan."""
    return replace(given, floor=PLAN_LIES[lie](walk, random) if lie else walk.plan)


def shifted_plan(walk, random):
    east, north = SHIFT * unit(random.uniform(-np.pi, np.pi))
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
    other = topology.loaded(topology.MAPS / f"{random.choice(others)}.geojson", None)
    size, wanted = np.diff(other.corners, axis=0)[0], np.diff(walk.plan.corners, axis=0)[0]
    east, north = walk.plan.corners[0] - other.corners[0]
    corner, factors = tuple(walk.plan.corners[0]), wanted / size
    return with_shapes(other, lambda shape: scale(translate(shape, east, north), *factors, origin=corner))


def with_shapes(plan, change):
    """A plan with all its areas changed alike."""
    return replace(plan, areas=tuple(replace(area, shape=change(area.shape)) for area in plan.areas))


PLAN_LIES = {"5 m shifted": shifted_plan, "a door missing": without_door, "of another floor": another_floor}
SOURCES = {
    "GNSS": gnss,
    "beacons": beacons,
    "user fixes": user_fixes,
    "start": start,
    "end": end,
    "radio map": radio_map,
    "ranges": ranges,
    "compass": compass,
    "stride": stride,
    "plan": plan,
}
