"""Which route of a plan a walk took, and how sure the estimate says it is: with the first position, with both ends, and
without any position.
"""

from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np
from conditions import INDOORS, MAPS, loaded, recordings, route_between_walls, walk_along, with_steps
from tables import HELD_BACK, publish, table

from pdr_graph import WalkGraph, smooth
from pdr_graph.geometry import interpolate
from pdr_graph.types import Fixes, Headings

DRAWN = (("mall", None), ("arcade", None), ("office", None), ("two_floors", "1"))  # of maps/, and their labels
MALLS, PLANS, RECORDED = "simulated, real malls", "simulated, drawn", "Microsoft's fifteen recordings"
PLACED, UNPLACED = (60.0, 200.0), (120.0, 400.0)  # [m] walked with a position and without, where the floor has as much
WALKS = {PLACED: 6, UNPLACED: 3}  # on each floor
SIGMA = 0.5  # [m] of a position that is given
NOTHING = "no position"
GIVEN = {  # rows of the truth whose position is given, and True with the compass
    "first position, compass": ([0], True),
    "first position": ([0], False),
    "first and last, compass": ([0, -1], True),
    f"{NOTHING}, compass": ([], True),
    NOTHING: ([], False),
}
WRONG = 5.0  # [m] mean distance from the truth: aisles lie eight apart and more, walks in the right one err by two
SURE = 0.9
BINS = (0.0, 0.5, 0.7, 0.9, 0.97, 1.0)


@dataclass(frozen=True)
class Outcome:
    """Estimate of a walk.

    errors: mean distance from the truth of each listed route, the most probable first [m]; walled: True if a wall lies
    between the first route and the truth; stated: probability of the first route.
    """

    plan: str
    given: str
    stated: float
    errors: tuple[float, ...]
    walled: bool

    @property
    def right(self):
        """True if the first route is near the truth."""
        return self.errors[0] < WRONG


def routes(data):
    """The tables."""
    jobs = [partial(recorded, data, name) for name in recordings(data, "microsoft")]
    for kind, floors in floors_of(data).items():
        for number, floor in enumerate(floors, start=10 * (kind == PLANS)):
            for lengths, count in WALKS.items():
                seeds = HELD_BACK + 1000 * number + np.arange(count)
                jobs += [partial(simulated, kind, floor, lengths, int(seed)) for seed in seeds]
    with ProcessPoolExecutor() as pool:
        outcomes = [outcome for some in pool.map(_call, jobs) for outcome in some]
    unplaced = [outcome for outcome in outcomes if outcome.given.startswith(NOTHING)]
    placed = [outcome for outcome in outcomes if outcome not in unplaced]
    publish("results/routes.md", "routes", tables(placed))
    publish("results/routes.md", "no position", tables(unplaced))


def tables(outcomes):
    """Table of the outcomes by plan and what is given, and how far the stated probability is right."""
    names = [(plan, given) for plan in (MALLS, PLANS, RECORDED) for given in GIVEN]
    by_name = {key: [o for o in outcomes if (o.plan, o.given) == key] for key in names}
    rows = [described(key, some) for key, some in by_name.items() if some]
    rows.append(described(("**all**", ""), outcomes))
    return f"{table(HEADER, rows)}\n\n{reliability(outcomes)}"


def _call(job):
    return list(job())


def floors_of(data):
    """Path and label of each floor, by kind of plan."""
    real = sorted({path.parent for path in (data / "ms_indoor20").glob("site*/*/*.txt")})
    drawn = [(MAPS / f"{name}.geojson", label) for name, label in DRAWN]
    return {MALLS: [(path, None) for path in real], PLANS: drawn}


def simulated(kind, floor, lengths, seed):
    """Outcomes of a simulated walk of a length in a range [m], by what is given."""
    path, label = floor
    random, plan = np.random.default_rng((seed, 7)), loaded(path, label)
    corners = route_between_walls(path, label, random, lengths)
    content = {"plan": str(path.resolve()), "floor": plan.label}
    walk = walk_along(corners, INDOORS, seed, random, plan, content)
    truth, random = walk.truth, np.random.default_rng((seed, 8))
    for name, (rows, compass) in GIVEN.items():
        if (lengths == UNPLACED) is not name.startswith(NOTHING):
            continue
        place = truth.position[rows] + SIGMA * random.standard_normal((len(rows), 2))
        fixes = Fixes(truth.time[rows], place, np.full(len(rows), SIGMA))
        graph = WalkGraph(walk.steps, fixes, headings=walk.headings if compass else None, floor=plan)
        yield outcome(kind, name, smooth(graph), truth, plan)


def recorded(data, name):
    """Outcomes of a Microsoft recording without its waypoints."""
    walk = recordings(data, "microsoft")[name]
    evidence = with_steps(replace(walk, evidence=replace(walk.evidence, fixes=Fixes.none()))).evidence
    for compass in (True, False):
        given = evidence if compass else replace(evidence, headings=Headings.none())
        estimate = smooth(given.graph())
        name = f"{NOTHING}, compass" if compass else NOTHING
        yield outcome(RECORDED, name, estimate, walk.truth, walk.evidence.building.floors[0])


def outcome(kind, given, estimate, truth, plan):
    """Errors of the routes of an estimate, and whether a wall lies between the first and the truth."""
    tracks = [track for _, track in estimate.routes] or [estimate.trajectory]
    places = [interpolate(truth.time, track.time, track.position) for track in tracks]
    errors = tuple(float(np.hypot(*(place - truth.position).T).mean()) for place in places)
    walled = bool(plan.crosses_wall(places[0], truth.position).any())
    return Outcome(kind, given, float(estimate.probability), errors, walled)


HEADER = ["plan", "given", "walks", "within 5 m", "a listed route within 5 m", "in a wrong aisle", "mean stated"]
HEADER += ["stated over 90 %", "of these over 5 m off"]


def described(names, some):
    """Row about some outcomes."""
    sure = [o for o in some if o.stated > SURE]
    columns = [o.right for o in some], [min(o.errors) < WRONG for o in some]
    columns += [o.walled and not o.right for o in some], [o.stated for o in some]
    shares = [f"{100 * np.mean(column):.0f} %" for column in columns]
    return [*names, len(some), *shares, len(sure), sum(not o.right for o in sure)]


def reliability(some):
    """How often the first route is right, by the probability that is stated."""
    stated, right = np.array([(o.stated, o.right) for o in some]).T
    rows = []
    for low, high in pairwise(BINS):
        here = ((stated > low) | (low == 0)) & (stated <= high)
        if here.any():
            share = [f"{100 * values[here].mean():.0f} %" for values in (stated, right)]
            rows.append([f"{100 * low:.0f}–{100 * high:.0f} %", here.sum(), *share])
    rows.append(["**Brier score**", len(some), f"{np.mean((stated - right) ** 2):.3f}", ""])
    return table(["stated", "walks", "mean stated", "within 5 m"], rows)
