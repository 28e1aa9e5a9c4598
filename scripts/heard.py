"""Receivers in the rooms of a home that hear the phone, simulated: the room and the place of the live pose.

python scripts/heard.py [--write]

Levels have shadowing by the body (7 dB), a pattern of the place (3 dB over 4 m, so correlated along the walk), fading
(4 dB), and 4 dB for each wall between, of which the estimate knows nothing. Walkers differ in height, hold and tour.
Nothing is given but the plan and the receivers: no start, no fix.
"""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import shapely
from tables import publish, table

from pdr_graph.apps.replay import navigator_of
from pdr_graph.apps.serve.home_assistant import MotionSensors, rooms_of
from pdr_graph.apps.serve.publishing import pose_json
from pdr_graph.frames import enu
from pdr_graph.geometry import interpolate
from pdr_graph.lab.simulation.recorders import write
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.online.interface import Samples, events_of
from pdr_graph.options import Options
from pdr_graph.types import take
from pdr_graph.walk import estimate, observe, read

PLACE = (135.0, 35.0)
ROOMS = {  # west, south, east, north [m]
    "kitchen": (0.0, 0.0, 4.0, 3.8),
    "bath": (4.0, 0.0, 7.0, 3.8),
    "office": (7.0, 0.0, 12.0, 3.8),
    "living room": (0.0, 5.2, 5.0, 9.4),
    "bedroom": (5.0, 5.2, 9.0, 9.4),
    "nursery": (9.0, 5.2, 12.0, 9.4),
}
HALL = (0.0, 3.8, 12.0, 5.2)
WALL_LOSS, DOOR, HOLD = 4.0, 0.9, 30.0  # [dB], [m], [s] of a motion sensor
SURE, STILL = 0.9, 0.3  # probability of a room; [m/s] below which somebody stands
SETTLED, SEEDS, VISITS, STANDS = 20.0, range(3), 5, (8.0, 20.0)  # [s] before the pose counts; walks; rooms of a tour
HOLDS = ("hand", "trouser pocket")
# Seed of a walk; sigma per axis of a mark on a plan, and of a place by it [m]
SURVEYOR, MARKED, SURVEYED = 100, 0.7, 1.5


def middle(name):
    """The middle of a room, and of its door [m]."""
    west, south, east, north = ROOMS[name]
    x = (west + east) / 2
    return np.array([x, (south + north) / 2]), np.array([x, HALL[1] if south < HALL[1] else HALL[3]])


def home(folder):
    """Write the plan; returns its file."""
    frame = enu(PLACE[1], PLACE[0])

    def feature(kind, name, shape):
        shape = shapely.transform(shape, frame.to_lonlat)
        return {
            "type": "Feature",
            "properties": {"kind": kind, "name": name},
            "geometry": shapely.geometry.mapping(shape),
        }

    areas = [feature("corridor", "hall", shapely.box(*HALL))]
    for name, box in ROOMS.items():
        _, (x, y) = middle(name)
        door = shapely.LineString([(x - DOOR / 2, y), (x + DOOR / 2, y)])
        areas += [feature("room", name, shapely.box(*box)), feature("door", "", door)]
    plan = {"type": "FeatureCollection", "pdr_graph": {"origin": PLACE, "floor": "0"}, "features": areas}
    (folder / "home.geojson").write_text(json.dumps(plan))
    return folder / "home.geojson"


def receivers(seed=0):
    """A receiver beside a wall of each room [m]: the same in all walks."""
    random = np.random.default_rng([seed, 5])
    places = {}
    for name, (west, south, east, north) in ROOMS.items():
        side = random.integers(2)
        x, y = random.uniform(west + 0.3, east - 0.3), (south + 0.2 if south < HALL[1] else north - 0.2)
        places[name] = (west + 0.2, (south + north) / 2) if side else (x, y)
    return places


def tour(seed):
    """A route through rooms of random order, with a stand in each."""
    random = np.random.default_rng([seed, 1])
    names, route, last = list(ROOMS), [], ""
    for _ in range(VISITS):
        name = str(random.choice([each for each in names if each != last]))
        (x, y), (door, wall) = middle(name)
        spot = [x + random.uniform(-1, 1), y + random.uniform(-1, 1)]
        inside = wall + np.sign(y - wall) * 0.4
        if last:
            out, way = middle(last)[1][0], 4.5 + random.uniform(-0.2, 0.2)
            beside = middle(last)[1][1] + np.sign(middle(last)[0][1] - middle(last)[1][1]) * 0.4
            route.append({"to": [[out, beside], [out, way], [door, way], [door, inside], spot]})
        else:
            route.append(spot)
        route.append({"stand": float(random.uniform(*STANDS))})
        last = name
    return route


@cache
def walked(seed):
    """A simulated walk, with what the receivers hear."""
    with TemporaryDirectory() as folder:
        plan, random = home(Path(folder)), np.random.default_rng([seed, 2])
        walker = {"height": float(random.uniform(1.55, 1.9))}
        phone = {"hold": HOLDS[seed % 2]}
        content = {"seed": seed, "plan": str(plan), "route": tour(seed), "walker": walker, "phone": phone}
        walk = simulate(Scenario.of(content | {"beacons": {n: list(map(float, p)) for n, p in receivers().items()}}))
    walls = [
        shapely.difference(shapely.box(*box).exterior, shapely.Point(middle(name)[1]).buffer(DOOR / 2))
        for name, box in ROOMS.items()
    ]
    at, place = interpolate(walk.bluetooth.time, walk.truth.time, walk.truth.position), receivers()
    lines = shapely.linestrings(np.stack([at, [place[name] for name in walk.bluetooth.transmitter]], axis=1))
    crossed = sum(shapely.intersects(wall, lines) for wall in walls)
    level = walk.bluetooth.rssi - WALL_LOSS * np.minimum(crossed, 3)
    return replace(walk, bluetooth=take(replace(walk.bluetooth, rssi=level), level > -97))


def evidence_of(folder, walk, beacons, **options):
    """What is read of a walk. beacons: place [m] and sigma of each receiver."""
    write(walk, folder / "walk")
    rows = [f"{name},{x},{y},{sigma}" for name, ((x, y), sigma) in beacons.items()]
    (folder / "receivers.csv").write_text("beacon,x,y,sigma\n" + "\n".join(rows) + "\n")
    return read(folder / "walk", Options(plan=home(folder), beacons=folder / "receivers.csv", **options))


def motion_of(seed, walk, cells, others):
    """When a sensor in each room saw motion begin, each second ``(s,)``: it sees the walker who moves, and goes on for
    HOLD; NaN without. others: another person is at home, half of the time in motion, for 40 s in a room.
    """
    time, random = np.arange(walk.truth.time[-1]), np.random.default_rng([seed, 4])
    at = interpolate(time, walk.truth.time, walk.truth.position)
    moves, cell = np.hypot(*np.gradient(at, axis=0).T) > STILL, cells.at(at)
    room = np.array([cells.cells[n].name for n in cell])
    guest = np.repeat(random.choice([*ROOMS, *[""] * len(ROOMS)], len(time) // 40 + 1), 40)[: len(time)]
    since = {}
    for name in ROOMS:
        seen = (moves & (room == name)) | (others & (guest == name))
        last = np.maximum.accumulate(np.where(seen, time, -np.inf))
        on = time - last < HOLD
        begins = np.where(on & ~np.roll(on, 1), time, -np.inf)
        since[name] = np.where(on, np.maximum.accumulate(begins), np.nan)
    return since


def weighed(rooms, since, now):
    """The most probable room with motion sensors."""
    states = {name: float(each[min(int(now), len(each) - 1)]) for name, each in since.items()}
    return next(iter(MotionSensors({name: name for name in ROOMS}, states).weighed(rooms, now)), "")


def live(seed, beacons):
    """Error [m] of each second of a walk live, whether the room is right, and said with 90 %, whether one walks,
    and whether the room is right with motion sensors, alone and with another person at home.
    """
    walk = walked(seed)
    with TemporaryDirectory() as folder:
        evidence = evidence_of(Path(folder), walk, beacons)
    building, epoch = evidence.building, evidence.walk.epoch
    nav, seconds, due = navigator_of(evidence.options, evidence)(epoch=epoch), [], SETTLED
    cells, truth = building.floors[0].cells, walk.truth
    speed = np.hypot(*np.gradient(truth.position, truth.time, axis=0).T)
    sensors = [motion_of(seed, walk, cells, others) for others in (False, True)]
    for event in events_of(evidence.walk):
        nav.push(event)
        if not (isinstance(event, Samples) and event.sensor == "accelerometer" and event.time[-1] >= due):
            continue
        due, now = due + 1.0, float(event.time[-1]) + epoch - walk.scenario.start
        pose = pose_json({}, nav.pose, nav.status, nav.frame, epoch)
        there = interpolate(np.array([now]), truth.time, truth.position)
        room = cells.cells[cells.at(there)[0]].name
        rooms = rooms_of(pose, building)
        said, share = next(iter(rooms.items()), ("", 0.0))
        seen = [weighed(rooms, each, now) == room for each in sensors]
        error = np.inf if pose["x"] is None else np.hypot(*(there[0] - (pose["x"], pose["y"])))
        seconds.append((error, said == room, share >= SURE, np.interp(now, truth.time, speed) > STILL, *seen))
        nav.review()
    return np.array(seconds, dtype=float)


def surveyed(seed):
    """Places and sigmas of receivers whose list has no places, by a walk on which each stand was marked on the plan."""
    walk = walked(seed)
    random, stands = np.random.default_rng([seed, 3]), [e for e in walk.body.events if e.kind == "stand"]
    time = np.array([(e.start + e.end) / 2 for e in stands])
    marked = interpolate(time, walk.truth.time, walk.truth.position) + random.normal(0, MARKED, (len(time), 2))
    with TemporaryDirectory() as folder:
        file = Path(folder) / "marked.csv"
        rows = (
            f"{t + walk.scenario.start:.2f},{x:.2f},{y:.2f},{MARKED}" for t, (x, y) in zip(time, marked, strict=True)
        )
        file.write_text("\n".join(["time,x,y,sigma", *rows]) + "\n")
        evidence = evidence_of(Path(folder), walk, {name: (("", ""), "") for name in ROOMS}, fixes=file)
        reports = estimate(observe(evidence)).estimate.beacons
    return {report.label: ((report.x, report.y), SURVEYED) for report in reports}


def scored(seconds):
    """Cells of a walk."""
    error, right, sure, walks, alone, others = seconds.T
    walks = walks.astype(bool)
    errors = np.median(error[walks]), np.median(error[~walks]), np.percentile(error, 95)
    shares = right.mean(), right[walks].mean(), sure.mean(), alone.mean(), others.mean()
    return [len(seconds), *(f"{100 * share:.0f} %" for share in shares), *(f"{own:.1f}" for own in errors)]


def heard(seeds=SEEDS):
    """The table of receivers that hear the phone."""
    places = {name: (place, 0.5) for name, place in receivers().items()}
    listed = (("measured, 0.5 m", places), ("by a walk with the phone", surveyed(SURVEYOR)))
    rows = [[name, seed, *scored(live(seed, own))] for name, own in listed for seed in seeds]
    header = [
        "places of receivers",
        "walk",
        "s",
        "room right",
        "while walking",
        "said with 90 %",
        "with motion sensors",
    ]
    header += ["and another person", "walking [m]", "standing [m]", "95 % [m]"]
    publish("results/live.md", "heard", table(header, rows))


if __name__ == "__main__":
    heard()
