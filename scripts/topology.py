"""Which aisle, and how sure: many simulated walks on real and drawn floors, and what the estimate says of itself."""

from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import shapely
from tables import publish, table

from pdr_graph import FloorPlan, WalkGraph, detect_steps, magnetic_headings, smooth
from pdr_graph.floor.network import Network
from pdr_graph.gait.steps import gait_signals
from pdr_graph.geometry import interpolate, length_along
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.types import Fixes, Headings, Steps, Trajectory

MAPS = Path(__file__).resolve().parents[1] / "maps"
DRAWN = ("mall", "arcade", "office", "two_floors")
WAYS = (60.0, 200.0)  # [m] walked, where the floor has as much
SPACING = 6.0  # [m] between the places where a walker may change sides
SWAY = 0.35  # of the clearance, by which they keep off the middle of an aisle
NEAREST = 0.45  # [m] to a wall
STRAIGHT = 1.5  # log-odds of going straight on against turning back, at an intersection
ATTEMPTS = 400
STRIDE = 0.06  # by which walkers' strides err besides the simulator's own differences, to be as far off as real ones
EVERY = 20  # samples, of the truth
DISTURBANCE = 14.0  # [µT] of the magnetic field by steel
WALKS = 20  # on each floor
SEEDS = 500  # the constants were chosen on walks with smaller ones
SIGMA = 0.5  # [m] of a position that is given
GIVEN = {  # which positions, and whether the compass
    "first position, compass": ([0], True),
    "first position": ([0], False),
    "first and last, compass": ([0, -1], True),
}
WRONG = 5.0  # [m] mean distance from the truth: aisles lie eight apart and more, walks in the right one err by two
SURE = 0.9
BINS = (0.0, 0.5, 0.7, 0.9, 0.97, 1.0)


@dataclass(frozen=True)
class Walk:
    """A simulated walk, as the front end saw it, and its truth."""

    floor: FloorPlan
    steps: Steps
    headings: Headings
    truth: Trajectory


@dataclass(frozen=True)
class Outcome:
    """What became of a walk: its kind of plan, what was given, the probability stated, the mean error [m], and whether
    a wall was between estimate and truth."""

    plan: str
    given: str
    probability: float
    error: float
    walled: bool

    @property
    def wrong(self):
        """Elsewhere, be it in the same open hall."""
        return self.error > WRONG

    @property
    def in_wrong_aisle(self):
        """Elsewhere, and behind walls."""
        return self.wrong and self.walled


def topology(data):
    """The tables."""
    jobs = [
        (kind, path, label, SEEDS + 1000 * number + n)
        for kind, places in floors(data).items()
        for number, (path, label) in enumerate(places, start=10 * (kind == "drawn"))
        for n in range(WALKS)
    ]
    with ProcessPoolExecutor() as pool:
        found = [outcome for outcomes in pool.map(outcomes_of, jobs, chunksize=WALKS // 2) for outcome in outcomes]
    rows = [
        described([plan, given], [o for o in found if (o.plan, o.given) == (plan, given)])
        for plan in floors(data)
        for given in GIVEN
    ]
    header = ["plan", "given", "walks", "within 5 m", "in the right aisle", "stated over 90 %", "of these over 5 m off"]
    rows.append(described(["**all**", ""], found))
    publish("results/topology.md", "topology", table([*header, "in a wrong aisle"], rows))
    publish("results/topology.md", "reliability", reliability(found))


def described(names, some):
    """A row about some outcomes."""
    sure = [o for o in some if o.probability > SURE]
    right = [f"{100 * np.mean([not bad for bad in bads]):.0f} %" for bads in zip(*_bad(some), strict=True)]
    return [*names, len(some), *right, len(sure), *(sum(bads) for bads in zip(*_bad(sure), strict=True))]


def _bad(some):
    return [(o.wrong, o.in_wrong_aisle) for o in some]


def reliability(found):
    """How often walks are right that say how sure they are."""
    stated, right = np.array([(o.probability, not o.wrong) for o in found]).T
    rows = []
    for low, high in pairwise(BINS):
        here = (stated > low) & (stated <= high)
        if here.any():
            share = [f"{100 * values[here].mean():.0f} %" for values in (stated, right)]
            rows.append([f"{100 * low:.0f}–{100 * high:.0f} %", here.sum(), *share])
    rows.append(["**Brier score**", len(found), f"{np.mean((stated - right) ** 2):.3f}", ""])
    return table(["stated", "walks", "mean stated", "within 5 m"], rows)


def outcomes_of(job):
    """What became of one walk, by what was given."""
    kind, path, label, seed = job
    walk, random = walked(path, label, seed), np.random.default_rng((seed, 8))
    truth, outcomes = walk.truth, []
    for name, (which, compass) in GIVEN.items():
        at = truth.position[which] + SIGMA * random.standard_normal((len(which), 2))
        fixes = Fixes(truth.time[which], at, np.full(len(which), SIGMA), ("",) * len(which))
        headings = walk.headings if compass else None
        estimate = smooth(WalkGraph(walk.steps, fixes, headings=headings, floor=walk.floor))
        track = estimate.trajectory
        true = interpolate(track.time, truth.time, truth.position)
        error = np.hypot(*(track.position - true).T).mean()
        walled = walk.floor.crosses_wall(track.position, true).any()
        outcomes.append(Outcome(kind, name, estimate.probability, float(error), bool(walled)))
    return outcomes


def floors(data):
    """Kinds of plan, and the floors of each."""
    real = sorted({path.parent for path in (data / "ms_indoor20").glob("site*/*/*.txt")})
    drawn = [(MAPS / f"{name}.geojson", None) for name in DRAWN[:-1]] + [(MAPS / "two_floors.geojson", "1")]
    return {"real malls": [(path, None) for path in real], "drawn": drawn}


def walked(path, label, seed):
    """A walk by somebody on a floor, somewhere."""
    random = np.random.default_rng((seed, 7))
    floor = loaded(path, label)
    corners = route(floor, random)
    given = {
        "seed": seed,
        "plan": str(Path(path).resolve()),
        "floor": floor.label,
        "route": [corners[0].tolist(), {"stand": 2}, {"to": corners[1:].tolist()}, {"stand": 2}],
        "phone": {"rate": 50, "disturbance": DISTURBANCE},
    }
    walk = simulate(Scenario.of(given))
    gaits = gait_signals(walk.recording())
    steps = detect_steps(gaits)
    stride = np.exp(STRIDE * random.standard_normal())
    steps = replace(steps, length=stride * steps.length, sigma_length=stride * steps.sigma_length)
    return Walk(floor, steps, magnetic_headings(gaits, floor.frame, corners[0]), walk.truth[::EVERY])


@cache
def loaded(path, label):
    """A floor, whose network is found only once."""
    return FloorPlan.load(path, label)


def route(floor, random, ways=WAYS):
    """Corners ``(k, 2)`` [m] of a random way of a length between `ways` along the network of a floor."""
    network = floor.network
    total = sum(map(_length, network.lines))
    wanted = min(np.exp(random.uniform(*np.log(ways))), total)
    for attempt in range(ATTEMPTS):
        line = _wandered(network, wanted, random)
        if _length(line) < wanted * (1 - attempt / ATTEMPTS):
            continue
        corners = _swayed(line, floor, random)
        if corners is not None:
            return corners
    raise SystemExit(f"no way of {wanted:.0f} m on floor {floor.label}")


def _wandered(network: Network, wanted, random):
    """A line from one link to the next, never back, of a length if the network has it."""
    length = np.array([_length(line) for line in network.lines])
    link = int(random.choice(len(network), p=length / length.sum()))
    node = int(network.links[link, random.integers(2)])
    line = network.leaving(link, node)
    line = _cut(line, random.uniform(0, 0.8) * length[link], length[link])
    node = int(network.links[link].sum() - node)
    while _length(line) < wanted:
        ahead = [n for n in np.flatnonzero((network.links == node).any(axis=1)).tolist() if n != link]
        if not ahead:
            break
        ways = [network.leaving(n, node) for n in ahead]
        turns = np.array([_course(w, 0) for w in ways]) - _course(line, -1)
        weight = np.exp(STRAIGHT * np.cos(turns))
        chosen = int(random.choice(len(ahead), p=weight / weight.sum()))
        link, node = ahead[chosen], int(network.links[ahead[chosen]].sum() - node)
        line = np.concatenate([line, ways[chosen][1:]])
    return _cut(line, 0.0, wanted)


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
