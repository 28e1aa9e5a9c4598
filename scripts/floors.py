"""Which floor each step is on: a museum's stairs, walks that stay on one floor, and simulated buildings."""

from dataclasses import dataclass

import numpy as np
from tables import publish, table

from pdr_graph import detect_steps
from pdr_graph.estimation.floors import floors_along
from pdr_graph.inertial.attitude import runs
from pdr_graph.io.loading import load
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.sensors import standard_pressure
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.types import Fixes, Signal

SEEDS = range(200, 240)  # the settings were chosen on others
BAROMETERS = {  # noise [hPa] of a sample, rate [Hz], gusts a minute
    "5 Hz, noise 0.01 hPa": (0.01, 5.0, 0.0),
    "5 Hz, noise 0.03 hPa, a gust a minute": (0.03, 5.0, 1.0),
    "20 Hz, noise 0.1 hPa, a gust a minute": (0.1, 20.0, 1.0),
    "1 Hz, noise 0.03 hPa, a gust a minute": (0.03, 1.0, 1.0),
    "1 Hz, noise 0.1 hPa, a gust a minute": (0.1, 1.0, 1.0),
}
ALTITUDE = 50.0  # [m]
WEATHER = 1.0  # [hPa] an hour, at most
GUST, LASTS = (0.1, 0.6), (1.0, 4.0)  # [hPa], [s]
ON_A_FLOOR = 0.3  # [m] from its height


@dataclass(frozen=True)
class Heights:
    """What a plan would tell."""

    labels: tuple[str, ...]
    heights: np.ndarray


def floors(data):
    """The tables."""
    recorded(data)
    simulated()


def recorded(data):
    """Real walks. The floor where each began is given, as competitions give it; their landmarks only score."""
    rows = []
    paths = [*sorted((data / "ipin2023_track3").glob("*Trial*.txt")), data / "nju_phyphox_outdoor"]
    for path in [*paths, data / "ipin21_hcu" / "eight"]:
        walk = load(path)
        steps, truth = detect_steps(walk), walk.truth
        known = truth is not None and any(truth.floor)
        found = floors_along(steps, walk.barometer, truth.floor[0] if known else "0", Fixes.none(), None)
        labels = np.array(found.labels[1:-1])
        if known:
            between, nearest = landmark_floors(steps, truth)
        else:
            between = nearest = np.full(len(steps), "0", dtype=object)
        told = between != ""
        share = f"{100 * np.mean(labels[told] == between[told]):.1f} % of {told.sum()}"
        everywhere = f"{100 * np.mean(labels == nearest):.1f} % of {len(labels)}"
        went = ", ".join(f"{k} {h:+.1f} m" for k, h in zip(found.kinds, found.climbs.height, strict=True))
        rows.append([path.stem, went or "none", share, everywhere, len(labels) - told.sum()])
    header = ["walk", "climbs found", "right floor", "of all steps: that of the nearest landmark", "between floors"]
    publish("results/floors.md", "floors", table(header, rows))


def landmark_floors(steps, truth):
    """Of each step the floor of the landmarks before and after it, "" where they differ; and that of the nearest."""
    before = np.clip(np.searchsorted(truth.time, steps.time, side="right") - 1, 0, len(truth) - 1)
    after = np.clip(np.searchsorted(truth.time, steps.time), 0, len(truth) - 1)
    floor = np.array(truth.floor, dtype=object)
    nearest = np.argmin(np.abs(steps.time[:, None] - truth.time), axis=1)
    return np.where(floor[before] == floor[after], floor[before], ""), floor[nearest]


def simulated():
    """Walks through buildings whose storeys differ, up and down stairs and lifts, with stops half-way."""
    walks, rows = [building_walk(seed) for seed in SEEDS], []
    for name, barometer in BAROMETERS.items():
        for helped in ("", "heights of a plan"):
            scores = [score(*walk, barometer, helped) for walk in walks]
            right, of, on_stairs, stairs, missed, climbs, invented, whole = np.sum(scores, axis=0)
            rows.append([name, helped or "the start's label", f"{100 * right / of:.1f} % of {of}"])
            rows[-1] += [f"{100 * on_stairs / stairs:.1f} % of {stairs}", f"{missed} of {climbs}", invented]
            rows[-1] += [f"{whole} of {len(walks)}"]
    header = ["barometer", "known", "right floor, steps on floors", "on stairs", "climbs missed", "invented"]
    publish("results/floors.md", "floors simulated", table([*header, "walks all right"], rows))


def building_walk(seed):
    """A walk of four to six climbs of one to four storeys; with its steps and the building's floors."""
    random = np.random.default_rng(seed)
    storeys = random.uniform(2.9, 4.3) * random.uniform(0.93, 1.07, 9)
    heights = np.concatenate([[0.0], np.cumsum(storeys)])
    heights, here, y = heights - heights[4], 4, 0.0
    route = [[0, 0], {"stand": 10}, {"to": [20, 0]}]
    for _ in range(random.integers(4, 7)):
        there = int(np.clip(here + random.choice([-1, 1]) * random.choice([1, 1, 1, 2, 2, 3, 4]), 0, 9))
        if there == here:
            continue
        climb = heights[there] - heights[here]
        if random.random() < 0.4:
            route += [{"stand": 8}, {"lift": str(there - 4), "climb": climb}, {"stand": 2}]
        else:
            pauses = random.random() < 0.4
            y = flights(route, y, here, there, heights, random.uniform(5, 40) if pauses else 0.0)
        y += 5.0
        route += [{"to": [[random.uniform(0, 15), y], [20, y]]}]
        if random.random() < 0.4:
            route += [{"stand": random.uniform(5, 40)}]
        here = there
    phone = {"rate": 50, "hold": str(random.choice(["hand", "trouser pocket", "swinging arm", "bag"]))}
    walk = simulate(Scenario.of({"seed": int(seed), "floor": "0", "route": route, "phone": phone}))
    plan = Heights(tuple(str(n - 4) for n in range(10)), heights)
    return walk, detect_steps(walk.recording("accelerometer", "gyroscope")), plan, seed


def flights(route, y, here, there, heights, pause):
    """Stairs of two flights a storey, with a stop on the first landing if there is a pause [s]. Where they end."""
    way = int(np.sign(there - here))
    for storey in range(here, there, way):
        half = (heights[storey + way] - heights[storey]) / 2
        route += [{"stairs": str(storey - 4), "to": [[24, y], [24, y + 1.5]], "climb": half}]
        if pause and storey == here:
            route += [{"stand": pause}]
        y += 1.5
        route += [{"stairs": str(storey + way - 4), "to": [[20, y], [20, y + 1.5]], "climb": half}]
        y += 1.5
    return y


def score(walk, steps, plan, seed, barometer, helped):
    """Counts: steps on floors right, of; steps on stairs right, of; climbs missed, of, invented; the walk is right."""
    signal = weathered(walk, seed, *barometer)
    found = floors_along(steps, signal, "0", Fixes.none(), plan if helped else None)
    height = np.interp(steps.time, walk.body.time, walk.body.height)
    nearest = np.argmin(np.abs(height[:, None] - plan.heights), axis=1)
    right = np.array(found.labels[1:-1]) == np.array(plan.labels)[nearest]
    level = np.abs(height - plan.heights[nearest]) < ON_A_FLOOR
    start, end = true_climbs(walk)
    meets = (found.climbs.start[:, None] < end + 2) & (found.climbs.end[:, None] > start - 2)
    missed, invented = np.sum(~meets.any(axis=0)), np.sum(~meets.any(axis=1))
    whole = right[level].all()
    return np.array(
        [right[level].sum(), level.sum(), right[~level].sum(), np.sum(~level), missed, len(start), invented, whole]
    )


def true_climbs(walk):
    """Starts and ends [s] of when the walker's height changed, with what is less than 2 s apart as one."""
    every = max(1, round(walk.body.rate / 10))
    time, height = walk.body.time[::every], walk.body.height[::every]
    moving = np.abs(np.gradient(height, time)) > 0.02
    first, after = runs(~moving)
    for a, b in zip(first, after, strict=True):
        if time[min(b, len(time) - 1)] - time[a] < 2.0:
            moving[a:b] = True
    first, after = runs(moving)
    return time[first], time[np.minimum(after, len(time) - 1)]


def weathered(walk, seed, noise, rate, gusts):
    """A barometer's samples of the walk's own height, with noise, weather and draughts [hPa]."""
    random = np.random.default_rng(1000 + seed)
    end = walk.body.time[-1]
    time = np.arange(0, end, 1 / rate)
    height = ALTITUDE + np.interp(time, walk.body.time, walk.body.height)
    pressure = standard_pressure(height)
    pressure += random.uniform(-WEATHER, WEATHER) * time / 3600 + random.normal(0, noise, len(time))
    for at in random.uniform(0, end, random.poisson(gusts * end / 60)):
        lasts = random.uniform(*LASTS)
        shape = np.sin(np.pi * np.clip((time - at) / lasts, 0, 1))
        pressure += random.choice([-1, 1]) * random.uniform(*GUST) * shape
    return Signal(time, pressure[:, None])
