"""The floor of each step by the barometer: museum walks with stairs, a campus, and simulated buildings."""

from concurrent.futures import ProcessPoolExecutor
from types import SimpleNamespace

import numpy as np
from conditions import recordings
from scipy.ndimage import binary_closing
from tables import HELD_BACK, publish, table

from pdr_graph import detect_steps
from pdr_graph.estimation.floors import floors_along
from pdr_graph.inertial.attitude import runs
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.sensors import standard_pressure
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.types import Fixes, Signal

WALKS = 24  # simulated
START, PLAN = "the start's label", "heights of a plan"
CASES = {  # noise [hPa] of a sample, rate [Hz], gusts a minute; what is known of the storeys
    "5 Hz, noise 0.03 hPa, a gust a minute": ((0.03, 5.0, 1.0), (START, PLAN)),
    "20 Hz, noise 0.1 hPa, a gust a minute": ((0.1, 20.0, 1.0), (PLAN,)),
    "1 Hz, noise 0.1 hPa, a gust a minute": ((0.1, 1.0, 1.0), (START, PLAN)),
}
ALTITUDE = 50.0  # [m]
WEATHER = 1.0  # [hPa] an hour, at most
GUST, LASTS = (0.1, 0.6), (1.0, 4.0)  # [hPa], [s]
ON_A_FLOOR = 0.3  # [m] from its height
CLIMBING, SEPARATE = 0.02, 2.0  # [m/s] least rate of a climb; [s] of level walking between two climbs


def floors(data):
    """The tables."""
    recorded(data)
    simulated()


def recorded(data):
    """Real walks, those of the same climbs together. The floor where each begins is given; landmarks only score."""
    groups = {}
    for name, walk in (recordings(data, "museum") | recordings(data, "nju")).items():
        recording = walk.evidence.walk
        steps, truth = detect_steps(recording), walk.truth
        start = truth.floor[0] if len(truth) else "0"
        found = floors_along(steps, recording.barometer, start, Fixes.none(), None)
        true = floors_between_landmarks(steps, truth) if len(truth) else np.full(len(steps), "0", dtype=object)
        climbs = ", ".join(f"{k} {h:+.1f} m" for k, h in zip(found.kinds, found.climbs.height, strict=True))
        right = np.array(found.labels[1:-1]) == true
        groups.setdefault(climbs or "none", []).append((name.split("_")[0], right[true != ""], np.sum(true == "")))
    rows = []
    for climbs, walks in groups.items():
        names, right, between = zip(*walks, strict=True)
        right = np.concatenate(right)
        share = f"{100 * right.mean():.1f} % of {len(right)}"
        rows.append([names[0] if len(names) == 1 else f"{len(names)} museum walks", climbs, share, sum(between)])
    publish("results/floors.md", "floors", table(["walk", "climbs found", "right floor", "between floors"], rows))


def floors_between_landmarks(steps, truth):
    """The floor of the landmarks before and after each step ``(n,)``, "" where these differ."""
    before = np.clip(np.searchsorted(truth.time, steps.time, side="right") - 1, 0, len(truth) - 1)
    after = np.clip(np.searchsorted(truth.time, steps.time), 0, len(truth) - 1)
    floor = np.array(truth.floor, dtype=object)
    return np.where(floor[before] == floor[after], floor[before], "")


def simulated():
    """Walks through buildings whose storeys differ, up and down stairs and lifts, with stops half-way."""
    with ProcessPoolExecutor() as pool:
        scores = np.array(list(pool.map(scores_of, range(HELD_BACK, HELD_BACK + WALKS))))
    rows, names = [], [(name, known) for name, (_, ways) in CASES.items() for known in ways]
    for (name, known), counts in zip(names, scores.sum(axis=0).tolist(), strict=True):
        right, level, right_on_stairs, on_stairs, missed, climbs, invented, whole = counts
        rows.append([name, known, f"{100 * right / level:.1f} % of {level}"])
        rows[-1] += [f"{100 * right_on_stairs / on_stairs:.1f} % of {on_stairs}", f"{missed} of {climbs}", invented]
        rows[-1].append(f"{whole} of {WALKS}")
    header = ["barometer", "known", "right floor, steps on floors", "on stairs", "climbs missed", "invented"]
    publish("results/floors.md", "floors simulated", table([*header, "walks all right"], rows))


def scores_of(seed):
    """Counts ``(cases, 8)`` of one simulated walk."""
    walk, steps, plan = building_walk(seed)
    return [score(walk, steps, plan, seed, case, known) for case, ways in CASES.values() for known in ways]


def building_walk(seed):
    """A walk with four to six climbs of one to four storeys, its steps, and labels and heights [m] of the storeys."""
    random = np.random.default_rng(seed)
    heights = np.cumsum([0.0, *(random.uniform(2.9, 4.3) * random.uniform(0.93, 1.07, 9))])
    heights, here, y = heights - heights[4], 4, 0.0
    route = [[0, 0], {"stand": 10}, {"to": [20, 0]}]
    for _ in range(random.integers(4, 7)):
        there = int(np.clip(here + random.choice([-1, 1]) * random.choice([1, 1, 1, 2, 2, 3, 4]), 0, 9))
        if there == here:
            continue
        if random.random() < 0.4:
            route += [{"stand": 8}, {"lift": str(there - 4), "climb": heights[there] - heights[here]}, {"stand": 2}]
        else:
            pause, way = random.uniform(5, 40) if random.random() < 0.4 else 0.0, int(np.sign(there - here))
            for storey in range(here, there, way):  # two flights a storey, with a stop on the first landing
                half = (heights[storey + way] - heights[storey]) / 2
                route += [{"stairs": str(storey - 4), "to": [[24, y], [24, y + 1.5]], "climb": half}]
                route += [{"stand": pause}] if pause and storey == here else []
                route += [{"stairs": str(storey + way - 4), "to": [[20, y + 1.5], [20, y + 3]], "climb": half}]
                y += 3.0
        y, here = y + 5.0, there
        route += [{"to": [[random.uniform(0, 15), y], [20, y]]}]
        route += [{"stand": random.uniform(5, 40)}] if random.random() < 0.4 else []
    phone = {"rate": 50, "hold": str(random.choice(["hand", "trouser pocket", "swinging arm", "bag"]))}
    walk = simulate(Scenario.of({"seed": int(seed), "floor": "0", "route": route, "phone": phone}))
    plan = SimpleNamespace(labels=tuple(str(n - 4) for n in range(10)), heights=heights)
    return walk, detect_steps(walk.recording("accelerometer", "gyroscope")), plan


def score(walk, steps, plan, seed, barometer, known):
    """Counts: steps on floors right, of; steps on stairs right, of; climbs missed, of, invented; 1 for a right walk."""
    signal = weathered(walk, seed, *barometer)
    found = floors_along(steps, signal, "0", Fixes.none(), plan if known == PLAN else None)
    height = np.interp(steps.time, walk.body.time, walk.body.height)
    nearest = np.argmin(np.abs(height[:, None] - plan.heights), axis=1)
    right = np.array(found.labels[1:-1]) == np.array(plan.labels)[nearest]
    level = np.abs(height - plan.heights[nearest]) < ON_A_FLOOR
    start, end = true_climbs(walk)
    meets = (found.climbs.start[:, None] < end + 2) & (found.climbs.end[:, None] > start - 2)
    missed, invented = np.sum(~meets.any(axis=0)), np.sum(~meets.any(axis=1))
    on_stairs = [right[~level].sum(), np.sum(~level)]
    return [right[level].sum(), level.sum(), *on_stairs, missed, len(start), invented, right[level].all()]


def true_climbs(walk):
    """Starts and ends [s] of the changes of the walker's height, joined where less than SEPARATE lies between."""
    every = max(1, round(0.1 * walk.body.rate))
    time, height = walk.body.time[::every], walk.body.height[::every]
    moving = binary_closing(np.abs(np.gradient(height, time)) > CLIMBING, np.ones(round(SEPARATE / 0.1)))
    first, after = runs(moving)
    return time[first], time[np.minimum(after, len(time) - 1)]


def weathered(walk, seed, noise, rate, gusts):
    """Pressure at the walker's height with noise, weather and gusts [hPa]."""
    random = np.random.default_rng(1000 + seed)
    end = walk.body.time[-1]
    time = np.arange(0, end, 1 / rate)
    pressure = standard_pressure(ALTITUDE + np.interp(time, walk.body.time, walk.body.height))
    pressure += random.uniform(-WEATHER, WEATHER) * time / 3600 + random.normal(0, noise, len(time))
    for at in random.uniform(0, end, random.poisson(gusts * end / 60)):
        shape = np.sin(np.pi * np.clip((time - at) / random.uniform(*LASTS), 0, 1))
        pressure += random.choice([-1, 1]) * random.uniform(*GUST) * shape
    return Signal(time, pressure[:, None])
