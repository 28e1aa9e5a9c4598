"""A lifelog beside the truth: stays of simulated days, and the shop fronts at which somebody stopped.

Days of GPS are those of tests/lifelog/gps_days.py, GeoLife's beside trackintel's recipe, and MobilityNet's, whose
sections were timed by hand, beside stay points; days indoors are in a mall, and in a market hall with narrow aisles.
"""

import csv
import json
import re
import sys
import warnings
from dataclasses import dataclass
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import shapely
from conditions import DATA, MAPS, ROOT
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from tables import publish, table

from pdr_graph.apps.lifelog.build import build
from pdr_graph.apps.lifelog.day import STANDING, VEHICLE, WALKING, Stay
from pdr_graph.apps.lifelog.diary import detailed, diary
from pdr_graph.apps.lifelog.facts import VISITED, Correction
from pdr_graph.apps.lifelog.ingest import add
from pdr_graph.apps.lifelog.observation import observe
from pdr_graph.apps.lifelog.past.importing import import_past
from pdr_graph.apps.lifelog.reconstruct import estimate_walk
from pdr_graph.apps.lifelog.sessions import Session
from pdr_graph.apps.lifelog.stays import stays_of
from pdr_graph.apps.lifelog.stays_and_legs import LIKELIER, OTHERWISE, SHORTEST_VISIT, VISIT_RADIUS, on_sphere
from pdr_graph.apps.lifelog.store import RecordingOptions, Store
from pdr_graph.apps.lifelog.timeline import STAY as STAY_ROW
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.floor.plan_files import Building
from pdr_graph.frames import enu
from pdr_graph.geometry import interpolate, rotation
from pdr_graph.lab.simulation.recorders import write
from pdr_graph.lab.simulation.scenario import SHOP_FRONT, Scenario
from pdr_graph.lab.simulation.simulate import simulate

ENTRANCE = {"mall": (42.0, 12.5), "market": (70.0, 25.0)}  # [m]
SIGMA_ENTRANCE, STAND = 1.5, 3.0  # [m] per axis of a fix while one stands there, and for how long [s]
VISITS, WAITS = 10, 2  # a day; who waits stands somewhere in an aisle, turned anywhere, and looks at nothing
STAY = (8.0, 60.0)  # [s]
FROM_CORNER = 0.5  # [m] of a front before which nobody stands
GRID, KEPT = 0.5, 0.8  # [m] between places where one walks, and that they keep from walls
TOWARDS = 1.2, 4.0  # [m] before a front, from where one goes straight to it
NARROW = 4.0  # [m] of an aisle
HEIGHT, HOLDS, PLATFORMS = (1.52, 1.95), ("hand", "trouser pocket"), ("android", "ios")
BINS = np.array([0.0, 0.05, 0.2, 0.4, 0.6, 0.8, 0.9, 1.0])  # of stated probabilities
OVERLAP = 0.5  # intersection over union from which two stays are one
LENGTHS = {"5 to 15 min": (300.0, 900.0), "15 to 60 min": (900.0, 3600.0), "longer": (3600.0, np.inf)}
PEOPLE, DAYS = range(1, 13), 4  # of the simulation; constants were chosen on the real days


def lifelog(days=20):
    """The tables of stays and of visits."""
    publish("results/lifelog.md", "lifelog-timed-days", timed_days())
    publish("results/lifelog.md", "lifelog-places", places_of_days())
    publish("results/lifelog.md", "lifelog-recipe", beside_the_recipe())
    publish("results/lifelog.md", "lifelog-simulated-days", simulated_days())
    seen = [day(MAPS / f"{'market' if seed % 2 else 'mall'}.geojson", seed) for seed in range(days)]
    publish("results/lifelog.md", "lifelog-visits", f"{by_aisle(seen)}\n\n{reliability(seen)}")


@dataclass(frozen=True)
class Halt:
    """What somebody truly stopped for. name: "" for nothing; start, end: [s]; position ``(2,)`` and aisle: how wide
    it is there [m]; stay: what was found of it, None if nothing was.
    """

    name: str
    start: float
    end: float
    position: np.ndarray
    aisle: float
    stay: Stay | None = None

    @property
    def right(self):
        """True if the likeliest front is the one."""
        return self.stay is not None and self.stay.facing[:1] != () and self.stay.facing[0][0] == self.name

    @property
    def error(self):
        """Distance of the stay from where one was. [m]"""
        return np.inf if self.stay is None else float(np.hypot(*(self.stay.position - self.position)))

    @property
    def stated(self):
        """All answers with their probabilities and whether they are right; "" is nothing."""
        if self.stay is None:
            return []
        facing = dict(self.stay.facing)
        facing[""] = 1 - sum(facing.values())
        return [(p, name == self.name) for name, p in facing.items()]


@dataclass(frozen=True)
class Seen:
    """A day. halts: what truly was; false: stays where one walked, passes: slow ones, of which there are none."""

    halts: list[Halt]
    false: list[Stay]
    passes: list[Stay]

    @property
    def visits(self):
        """The halts before fronts."""
        return [halt for halt in self.halts if halt.name]


def day(plan, seed):
    """A day, from the phone's log to what was found of its halts."""
    scenario, fronts = drawn_day(plan, seed)
    walk = simulate(scenario)
    steps, track, looks, epoch = estimated(walk, plan, seed)
    found = stays_of(steps, track, Building.load(plan), looks)
    later = scenario.start - epoch
    halts, truth = [], walk.truth
    for event, front in zip((e for e in walk.body.events if e.kind in ("visit", "stand")), fronts, strict=True):
        start, end = event.start + later, event.end + later
        place = interpolate(np.array([(event.start + event.end) / 2]), truth.time, truth.position)[0]
        own = max(found, key=lambda s: min(end, s.end) - max(start, s.start))
        own = own if min(end, own.end) - max(start, own.start) > (end - start) / 2 and not own.passing else None
        halts.append(Halt(event.what, start, end, place, front, own))
    other = [s for s in found if not any(s.start < h.end and s.end > h.start for h in halts)]
    stays, passes = ([s for s in other if s.passing == passing] for passing in (False, True))
    return Seen(halts[1:-1], stays, passes)


def estimated(walk, plan, seed):
    """Steps, trajectory and looks, from the phone's log with a fix at the entrance; and when the log begins."""
    place = ENTRANCE[plan.stem] + np.random.default_rng([seed, 1]).normal(0, SIGMA_ENTRANCE, 2)
    time = walk.scenario.start + STAND / 2
    with TemporaryDirectory() as folder:
        write(walk, Path(folder))
        entrance = Path(folder) / "entrance.csv"
        entrance.write_text(f"time,x,y,sigma\n{time:.3f},{place[0]:.3f},{place[1]:.3f},{SIGMA_ENTRANCE}\n")
        seen = observe(Path(folder), RecordingOptions(plan=plan, fixes=entrance))
    found = estimate_walk(Session((("", seen),)), None, None)
    return found.graph.steps, found.estimate.trajectory, found.looks, seen.epoch


def drawn_day(plan, seed):
    """A scenario of somebody who goes from front to front, and how wide the aisle is at each halt [m]."""
    random = np.random.default_rng([seed, 0])
    ways = ways_of(plan)
    entrance = np.array(ENTRANCE[plan.stem])
    at, route, aisles = entrance, [entrance.tolist(), {"stand": STAND}], [np.nan]
    for visiting in random.permutation(np.arange(VISITS + WAITS) < VISITS):
        stay, at_place = float(random.uniform(*STAY)), ways.front if visiting else ways.place
        name, before, place, aisle = at_place(random, at)
        route.append({"to": [corner.tolist() for corner in ways.shortest(at, before)]})
        route += (
            [{"visit": name, "stay": stay}]
            if visiting
            else [{"turn": float(random.uniform(-180, 180))}, {"stand": stay}]
        )
        aisles.append(aisle)
        at = place
    route += [{"to": [corner.tolist() for corner in ways.shortest(at, entrance)]}, {"stand": STAND}]
    given = {
        "seed": seed,
        "plan": str(plan),
        "platform": str(random.choice(PLATFORMS)),
        "route": route,
        "walker": {"height": float(random.uniform(*HEIGHT)), "sex": str(random.choice(["f", "m"]))},
        "phone": {"hold": str(random.choice(HOLDS))},
        "wifi": {"access_points": 12},
    }
    return Scenario.of(given, plan), [*aisles, np.nan]


@cache
def ways_of(plan):
    """Of a plan's only floor."""
    return Ways.of(Building.load(plan).floors[0])


@dataclass(frozen=True, eq=False)
class Ways:
    """Where one can go on a floor, some way off its walls.

    free: all of that; places: on a grid ``(n, 2)`` [m]; graph: how far each is from those around it [m].
    fronts: straight pieces ``(f, 2, 2)`` of shops' borders with an aisle on the left [m], names: whose.
    """

    floor: FloorPlan
    free: shapely.Geometry
    places: np.ndarray
    graph: csr_array
    fronts: np.ndarray
    names: tuple[str, ...]

    @classmethod
    def of(cls, floor):
        """Of a floor."""
        low, high = floor.corners
        axes = [np.arange(a + GRID / 2, b, GRID) for a, b in zip(low, high, strict=True)]
        places = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
        free = shapely.buffer(floor.walkable, -KEPT)
        shapely.prepare(free)
        places = places[shapely.contains_xy(free, *places.T)]
        points = shapely.points(places)
        i, j = shapely.STRtree(points).query(points, predicate="dwithin", distance=1.5 * GRID)
        graph = csr_array((np.hypot(*(places[i] - places[j]).T), (i, j)), shape=(len(places),) * 2)
        drawn = [(a.name, piece) for a in floor.of_kind("shop") if a.name for piece in pieces(a.shape, floor.walkable)]
        names, fronts = zip(*drawn, strict=True)
        return cls(floor, free, places, graph, np.array(fronts), names)

    def front(self, random, at):
        """A shop's name, a place some way before its front, the one at it, and how wide the aisle is there [m]."""
        length = np.hypot(*(self.fronts[:, 1] - self.fronts[:, 0]).T) - 2 * FROM_CORNER
        while True:
            n = random.choice(len(self.names), p=length / length.sum())
            a, b = self.fronts[n]
            along = (b - a) / np.hypot(*(b - a))
            ahead = np.array([-along[1], along[0]])
            on = a + (FROM_CORNER + length[n] * random.random()) * along
            aisle = self.aisle(on, ahead)
            near, far = TOWARDS[0], min(TOWARDS[1], aisle - KEPT)
            place = on + SHOP_FRONT * ahead
            if far > near and np.hypot(*(place - at)) > TOWARDS[1]:
                return self.names[n], on + random.uniform(near, far) * ahead, place, aisle

    def place(self, random, at):
        """Nothing's name, and somewhere."""
        while True:
            place = self.places[random.integers(len(self.places))]
            if np.hypot(*(place - at)) > TOWARDS[1]:
                return "", place, place, np.nan

    def aisle(self, on, ahead):
        """How far it is from a front to what is opposite. [m]"""
        begin = on + 0.01 * ahead
        across = shapely.intersection(shapely.LineString([begin, begin + 200 * ahead]), self.floor.walkable)
        return float(shapely.length(min(shapely.get_parts(across), key=shapely.Point(begin).distance)))

    def shortest(self, start, end):
        """The corners of the shortest way from a place to another, without the first."""
        first, last = (int(np.argmin(np.hypot(*(self.places - place).T))) for place in (start, end))
        before = dijkstra(self.graph, indices=first, return_predecessors=True)[1]
        way = [last]
        while way[-1] != first:
            way.append(int(before[way[-1]]))
        corners = [start, *self.straight(self.places[way[::-1]]), end]
        return [b for a, b in pairwise(corners) if np.hypot(*(b - a)) > GRID]

    def straight(self, way):
        """As few of the places ``(n, 2)`` of a way as one can walk straight between."""
        corners, at = [way[0]], 0
        while at < len(way) - 1:
            ahead = way[at + 1 :]
            lines = shapely.linestrings(np.stack([np.broadcast_to(way[at], ahead.shape), ahead], axis=1))
            at += 1 + int(np.flatnonzero(shapely.covers(self.free, lines))[-1])
            corners.append(way[at])
        return corners


def pieces(shop, walkable):
    """The straight pieces ``(2, 2)`` of a shop's border that have something walkable before them, on their left."""
    corners = shapely.get_coordinates(shapely.normalize(shop))  # clockwise: what is outside is on the left
    for a, b in pairwise(corners):
        along = (b - a) / np.hypot(*(b - a))
        beside = shapely.LineString([a, b] + 0.01 * np.array([-along[1], along[0]]))
        for part in shapely.get_parts(shapely.intersection(beside, walkable)):
            if shapely.length(part) > 3 * FROM_CORNER:
                ends = shapely.get_coordinates(part)[[0, -1]]
                yield ends[np.argsort(ends @ along)]


def by_aisle(seen):
    """How many visits were found and named right, where aisles are narrow and where they are wide."""
    visits = [v for one in seen for v in one.visits]
    sides = {"≤ 4 m": [v for v in visits if v.aisle <= NARROW + 0.05]}
    sides["wider"] = [v for v in visits if v.aisle > NARROW + 0.05]
    rows = [[aisle, *scored(own)] for aisle, own in (sides | {"all": visits}).items()]
    header = ["aisle", "visits", "found", "named right", "probability stated", "off [m]: median", "90 %"]
    return table(header, rows)


def scored(visits):
    """Cells of a table."""
    error = [v.error for v in visits]
    stated = np.mean([v.stay.facing[0][1] if v.stay and v.stay.facing else 0.0 for v in visits])
    shares = (np.mean([v.stay is not None for v in visits]), np.mean([v.right for v in visits]), stated)
    return [len(visits), *(f"{100 * s:.0f} %" for s in shares), *(f"{np.quantile(error, q):.1f}" for q in (0.5, 0.9))]


def reliability(seen):
    """How often answers were right that were given with about the same probability."""
    stated = np.array([answer for one in seen for halt in one.halts for answer in halt.stated])
    probability, right = stated.T
    which = np.digitize(probability, BINS[1:-1])
    rows, gaps = [], []
    for n in np.unique(which):
        own = which == n
        mean, share = probability[own].mean(), right[own].mean()
        gaps.append(own.sum() * abs(mean - share))
        rows.append([f"{BINS[n]:.2f}–{BINS[n + 1]:.2f}", int(own.sum()), f"{mean:.3f}", f"{share:.3f}"])
    stays = sum(halt.stay is not None for one in seen for halt in one.halts)
    brier = np.sum((probability - right) ** 2) / stays
    waits = [halt.stated[-1][0] for one in seen for halt in one.halts if not halt.name and halt.stay]
    told = f"Brier score {brier:.3f} per stay, expected calibration error {sum(gaps) / len(stated):.3f}. "
    told += f"Of {len(waits)} waits before nothing that were found, nothing has {np.mean(waits):.2f} on average. "
    told += f"Stays where nobody stood: {sum(len(one.false) for one in seen)}; "
    told += f"slow passes where nobody was slow: {sum(len(one.passes) for one in seen)}."
    return table(["stated", "answers", "mean stated", "right"], rows) + "\n\n" + told


# Stays of days of GPS


@dataclass(frozen=True)
class Comparison:
    """Stays ``(start, end)`` [s] of a diary beside others."""

    ours: list
    others: list

    @property
    def matched(self):
        """Pairs (ours, other) of one stay."""
        left, found = list(self.ours), []
        for other in self.others:
            best = max(left, key=lambda one: overlap(one, other), default=None)
            if best is not None and overlap(best, other) >= OVERLAP:
                found.append((best, other))
                left.remove(best)
        return found

    @property
    def times(self):
        """Sum of ours and of the others [s]."""
        return tuple(sum(end - start for start, end in stays) for stays in (self.ours, self.others))


def overlap(one, other):
    """Intersection over union of two stays."""
    return (min(one[1], other[1]) - max(one[0], other[0])) / (max(one[1], other[1]) - min(one[0], other[0]))


def diary_days(recordings, log):
    """The days of a diary of recordings."""
    add(log, recordings)
    build(log)
    with Store(log) as store:
        return diary(store, "me").days


def diary_stays(recordings, log):
    """The stays at places of a diary, joined over midnights, and its number of rows."""
    days, found = diary_days(recordings, log), []
    for row in (row for day in days for row in day.entries if row.kind == STAY_ROW and row.place_number > 0):
        if found and row.start - found[-1][1] < 1 and row.place_number == found[-1][2]:
            found[-1] = (found[-1][0], row.end, row.place_number)
        else:
            found.append((row.start, row.end, row.place_number))
    return [stay[:2] for stay in found], sum(len(day.entries) for day in days)


def simulated_days(people=PEOPLE, days=DAYS):
    """The stays of simulated days beside the true ones."""
    made = [simulated_person(person, days) for person in people]
    found = [comparison for comparison, _ in made]
    rows = [lengths_row(name, bounds, found) for name, bounds in LENGTHS.items()]
    ours, others = np.sum([comparison.times for comparison in found], axis=0)
    matched, true, all_ = (
        sum(map(len, own)) for own in zip(*((c.matched, c.others, c.ours) for c in found), strict=True)
    )
    text = table(["true stays", "number", "missed", "start and end off: median", "90 %"], rows)
    text += f"\n\nF1 {2 * matched / (true + all_):.2f}; {all_ - matched} stays of {len(people) * days} days are at no "
    text += f"true one of 5 min or more; time at places {100 * (ours / others - 1):+.1f} %; "
    return text + f"{sum(count for _, count in made) / len(people) / days:.0f} rows a day."


def lengths_row(name, bounds, found):
    """The row of the true stays of some lengths."""
    own = [(a, b) for comparison in found for a, b in comparison.others if bounds[0] <= b - a < bounds[1]]
    hit = [pair for comparison in found for pair in comparison.matched if pair[1] in own]
    off = np.abs([np.subtract(one, other) for one, other in hit]) / 60
    times = [f"{np.quantile(off, share):.1f} min" for share in (0.5, 0.9)]
    return [name, str(len(own)), str(len(own) - len(hit)), *times]


def simulated_person(person, days, stays=diary_stays):
    """Stays of a diary, or by another recipe, beside the true ones, and its number of rows."""
    sys.path.append(str(ROOT / "tests" / "lifelog"))
    from gps_days import gps_day, true_stays

    made = [gps_day(person, number) for number in range(days)]
    with TemporaryDirectory() as folder:
        for number, day in enumerate(made):
            day.write(Path(folder) / "raw" / f"{number}.plt")
        ours, count = stays([Path(folder) / "raw"], Path(folder) / "log")
    return Comparison(ours, [stay[:2] for stay in true_stays(made, SHORTEST_VISIT)]), count


# Trackintel's recipe

SILENCE = 15.0  # [min] longest within a stay point of the recipe
RECORDED = 60.0  # [s] longest between two positions whose labelled mode counts


def beside_the_recipe(people=PEOPLE, days=DAYS):
    """Stays and modes of a diary and by trackintel, beside the truth where there is one, and beside each other."""
    folders = [[DATA / "geolife_sample" / person] for person in ("000", "001", "005", "010")]
    rows = []
    by = {
        "the diary": diary_stays,
        f"trackintel, silences up to {SILENCE:.0f} min": recipe,
        "trackintel, any silence": partial(recipe, silence=1e6),
    }
    for name, stays in by.items():
        found = [simulated_person(person, days, stays)[0] for person in people]
        rows.append([f"{len(people) * days} simulated days", name, "true stays", *scores(found)])
    for name, stays in list(by.items())[1:]:
        found = [Comparison(stays_of_folder(own, diary_stays), stays(own, None)[0]) for own in folders]
        rows.append(["4 days of GeoLife", "the diary", name, *scores(found)])
    labelled = labelled_modes(DATA / "geolife_sample" / "010")
    with TemporaryDirectory() as folder:
        fine = detailed(row for day in diary_days(folders[-1], Path(folder) / "log") for row in day.entries)
        ours = [(row.start, row.end, MODES.get(row.kind)) for row in fine]
    for name, modes in (("the diary", ours), ("trackintel", recipe_modes(folders[-1]))):
        right = [mode_at(modes, time) == mode for time, _, mode in labelled]
        lasts = [duration for _, duration, _ in labelled]
        cells = [f"{np.average(right, weights=lasts):.2f}", "", f"{sum(lasts) / 60:.0f} min"]
        rows.append(["GeoLife 010", name, "labels: on foot or riding", *cells])
    return table(["days", "by", "beside", "F1", "time: these", "those"], rows)


def scores(found):
    """Cells of stays beside others: F1, and the times of both."""
    matched, others, ours = (
        sum(map(len, own)) for own in zip(*((c.matched, c.others, c.ours) for c in found), strict=True)
    )
    times = np.sum([comparison.times for comparison in found], axis=0) / 60
    return [f"{2 * matched / (ours + others):.2f}", *(f"{time:,.0f} min" for time in times)]


def stays_of_folder(recordings, stays):
    """The stays of recordings by a recipe."""
    with TemporaryDirectory() as folder:
        return stays(recordings, Path(folder) / "log")[0]


def positionfixes(recordings):
    """The positions of GeoLife files, as trackintel has them."""
    import geopandas
    import pandas
    import trackintel

    files = sorted(file for folder in recordings for file in folder.glob("*.plt"))
    names = ["lat", "lon", "zero", "altitude", "days", "date", "time"]
    rows = pandas.concat([pandas.read_csv(file, skiprows=6, header=None, names=names) for file in files])
    rows["tracked_at"], rows["user_id"] = pandas.to_datetime(rows.date + " " + rows.time, utc=True), 0
    rows = rows.sort_values("tracked_at", ignore_index=True)
    points = geopandas.points_from_xy(rows.lon, rows.lat)
    fixes = geopandas.GeoDataFrame(rows[["user_id", "tracked_at"]], geometry=points, crs=4326).rename_geometry("geom")
    return trackintel.Positionfixes(fixes)


def staypoints(recordings, silence=SILENCE):
    """Positions and stay points of 100 m and 5 min by trackintel; silence: longest within one [min]."""
    from trackintel.preprocessing import generate_staypoints

    options = {"dist_threshold": 100, "time_threshold": 5.0, "gap_threshold": silence, "include_last": True}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return generate_staypoints(positionfixes(recordings), method="sliding", **options)


def recipe(recordings, _log, silence=SILENCE):
    """Stays by trackintel: its stay points, merged at one location within 10 min; and their number."""
    from trackintel.preprocessing import generate_locations

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        stays, _ = generate_locations(
            staypoints(recordings, silence)[1], epsilon=100, num_samples=1, agg_level="dataset"
        )
    found = []
    for stay in stays.sort_values("started_at").itertuples():
        start, end = stay.started_at.timestamp(), stay.finished_at.timestamp()
        if found and found[-1][2] == stay.location_id and start - found[-1][1] < 600:
            found[-1] = (found[-1][0], end, stay.location_id)
        else:
            found.append((start, end, stay.location_id))
    return [stay[:2] for stay in found], len(found)


MODES = {WALKING: True, VEHICLE: False}  # True: on foot


def recipe_modes(recordings):
    """Start, end [s] and mode of trackintel's triplegs: slow ones are on foot."""
    from trackintel.analysis import predict_transport_mode
    from trackintel.preprocessing import generate_triplegs

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        fixes, stays = staypoints(recordings)
        _, legs = generate_triplegs(fixes, stays, gap_threshold=SILENCE)
        legs = predict_transport_mode(legs, method="simple-coarse")
    return [
        (a.timestamp(), b.timestamp(), m == "slow_mobility")
        for a, b, m in zip(legs.started_at, legs.finished_at, legs["mode"], strict=True)
    ]


def labelled_modes(folder):
    """Middle and duration of each interval of recorded positions [s] that has a label, and whether it is on foot.

    Of labels within each other the shorter counts.
    """
    import pandas

    labels = pandas.read_csv(folder / "labels.txt", sep="\t")
    spans = [
        pandas.to_datetime(labels[name], format="%Y/%m/%d %H:%M:%S", utc=True) for name in ("Start Time", "End Time")
    ]
    labels = [
        (a.timestamp(), b.timestamp(), m == "walk")
        for a, b, m in zip(*spans, labels["Transportation Mode"], strict=True)
    ]
    time = np.array([moment.timestamp() for moment in positionfixes([folder]).tracked_at])
    found = []
    for a, b in pairwise(time.tolist()):
        mode = mode_at(sorted(labels, key=lambda label: label[1] - label[0]), (a + b) / 2)
        if mode is not None and 0 < b - a <= RECORDED:
            found.append(((a + b) / 2, b - a, mode))
    return found


def mode_at(spans, time):
    """The mode of the first span ``(start, end, mode)`` around a time, None without any."""
    return next((mode for start, end, mode in spans if start <= time <= end), None)


# Days whose sections were timed by hand

WALK, RIDE, WAIT, NOTHING = "walk", "ride", "stop", "no data"
KINDS = {WALKING: WALK, VEHICLE: RIDE, STAY_ROW: WAIT, STANDING: WAIT}
SLOWEST_RIDE = 15 / 3.6  # [m/s] of the recipe's legs, over a minute


def timed_days():
    """Walks, rides and waits of the diary and of stay points, by phone."""
    rows = []
    for phone in sorted((DATA / "mobilitynet").iterdir()):
        files = sorted(phone.glob("*.rec"))
        for name, found in (("the diary", diary_rows(files)), ("stay points", stay_point_rows(files))):
            rows.append([phone.name.removeprefix("ucb-sdb-"), len(files), name, *timed_scores(found, files)])
    header = ["phone", "days", "by", "walks", "named", "of their time", "of that with positions", "of rides"]
    return f"{table([*header, 'waits', 'found', 'others', 'F1', 'no data'], rows)}\n\n{probabilities()}"


TIMED = 0.5  # least share of a row that is within sections timed by hand
ANSWERS = [(kind, *others) for kind, (_, *others) in OTHERWISE.items()]


def probabilities():
    """How right the probabilities of rows are at their moments: as shipped, and by other phones and days."""
    rows = [row for phone in sorted((DATA / "mobilitynet").iterdir()) for row in timed_rows(phone)]
    phones, days = (list(dict.fromkeys(row[n] for row in rows)) for n in (0, 1))
    folds = {"all days, as shipped": None} | {f"{phone}, by the other phone": [(0, phone)] for phone in phones}
    folds["each day, by the others"] = [(1, day) for day in days]
    cells = []
    for name, held in folds.items():
        judged = []
        for n, value in held or [(None, None)]:
            own = [row for row in rows if n is None or row[n] == value]
            lasts = {kind: fitted(rows, own, kind) for kind in OTHERWISE} if held else None
            judged += [(row, row[3] / (row[3] + (lasts[row[2]] if held else OTHERWISE[row[2]][0]))) for row in own]
        cells.append([name, len(judged), *judgement(judged)])
    return table(["rows", "number", "hours", "stated", "right", "Brier", "ECE"], cells)


def timed_rows(phone):
    """Phone, day, kind, duration [s] and share of the moments ``(3,)`` at its ANSWERS of each row that was timed."""
    files = sorted(phone.glob("*.rec"))
    kinds, found = {WALK: WALKING, RIDE: VEHICLE, WAIT: STAY_ROW}, []
    for file in files:
        sections = [(float(r["begin"]), float(r["end"]), r["kind"]) for r in truth_of(file)]
        for row in diary_entries([file]):
            if not row.likely:
                continue
            times = {kinds[k]: t for k, t in times_within(sections, row.start, row.end).items() if k in kinds}
            answers = next(own for own in ANSWERS if own[0] == (STAY_ROW if row.kind == STANDING else row.kind))
            if sum(times.values()) >= TIMED * row.duration:
                shares = np.array([times[kind] for kind in answers]) / sum(times.values())
                found.append((phone.name.removeprefix("ucb-sdb-"), file.stem, answers[0], row.duration, shares))
    return found


def fitted(rows, without, kind):
    """Time [s] of a row of a kind that is something else, most probable by the rows but those of `without`."""
    held = set(map(id, without))
    lasts, right = np.array([(r[3], r[4][0]) for r in rows if r[2] == kind and id(r) not in held]).T
    trial = np.geomspace(5, 2000, 400)[:, None]
    stated = lasts / (lasts + trial)
    gain = (lasts * (right * np.log(stated) + (1 - right) * np.log(1 - stated))).sum(axis=1)
    return float(trial[np.argmax(gain), 0])


def judgement(judged):
    """Cells of rows with the probability stated of each: hours, stated and right, Brier score of a kind, ECE."""
    lasts, right = np.array([row[3] for row, _ in judged]), np.array([row[4] for row, _ in judged])
    own = np.array([p for _, p in judged])
    stated = np.column_stack([own, LIKELIER * (1 - own), (1 - LIKELIER) * (1 - own)])
    brier = np.average(np.mean(stated**2 - 2 * stated * right + right, axis=1), weights=lasts)
    which = np.minimum((10 * own).astype(int), 9)
    gaps = [abs((lasts * (own - right[:, 0]))[which == n].sum()) for n in range(10)]
    shares = [f"{np.average(own, weights=lasts):.2f}", f"{np.average(right[:, 0], weights=lasts):.2f}"]
    return [f"{lasts.sum() / 3600:.1f}", *shares, f"{brier:.3f}", f"{sum(gaps) / lasts.sum():.3f}"]


def truth_of(file):
    """The sections of a day that were timed by hand."""
    return list(csv.DictReader(file.with_suffix(".truth.csv").open()))


def timed_scores(found, files):
    """Cells of rows ``(start, end, kind)`` beside the sections of the files; of walks and waits of SHORTEST_VISIT."""
    truth = [row for file in files for row in truth_of(file)]
    sections = [(float(row["begin"]), float(row["end"]), row["kind"]) for row in truth]
    named = [times_within(found, *section[:2]) for section in sections]
    every = list(zip(sections, named, strict=True))
    walks = [own for (a, b, kind), own in every if kind == WALK and b - a >= SHORTEST_VISIT]
    waits = [(a, b) for a, b, kind in sections if kind == WAIT and b - a >= SHORTEST_VISIT]
    stays = [(a, b) for a, b, kind in found if kind == WAIT and b - a >= SHORTEST_VISIT]
    hits = len(Comparison(stays, waits).matched)
    # A stay that is mostly walking and riding; between the sections nothing is known
    moving = [times_within([s for s in sections if s[2] != WAIT], *stay) for stay in stays]
    others = sum(own[NOTHING] < own[WALK] + own[RIDE] for own in moving)
    walked, seen = (sum(sum(own.values()) - less * own[NOTHING] for own in walks) for less in (0, 1))
    on_foot = sum(own[WALK] for own in walks)
    ridden = [own for (_, _, kind), own in every if kind == RIDE]
    shares = on_foot / walked, on_foot / seen, sum(own[RIDE] for own in ridden) / sum(sum(o.values()) for o in ridden)
    right = sum(max(own, key=own.get) == WALK for own in walks)
    silent = sum(own[NOTHING] for own in named) / 60
    f1 = 2 * hits / (len(waits) + hits + others)
    return [
        len(walks),
        right,
        *(f"{100 * s:.0f} %" for s in shares),
        len(waits),
        hits,
        others,
        f"{f1:.2f}",
        f"{silent:.0f} min",
    ]


def times_within(rows, start, end):
    """Time [s] of each kind between two times."""
    own = dict.fromkeys((WALK, RIDE, WAIT), 0.0)
    for a, b, kind in rows:
        if kind in own:
            own[kind] += max(0.0, min(b, end) - max(a, start))
    return own | {NOTHING: end - start - sum(own.values())}


PLACES, OFF, APART = 30, (300.0, 3000.0), 200.0  # of each kind a day; of false ones, and least from the way [m]


def places_of_days():
    """Receipts and photos where the other phone of the same day was, and false ones, beside the diary of one."""
    phones = sorted((DATA / "mobilitynet").iterdir())
    rows = []
    for phone, other in (phones, phones[::-1]):
        counts = {}
        for file in sorted(phone.glob("*.rec")):
            if (other / file.name).exists():
                for kind, text in judged_places(file, other / file.name):
                    counts.setdefault(kind, []).append(text)
        for kind, texts in counts.items():
            seen = [text for text in texts if "no data then" not in text]
            fits = sum("does not fit" not in text for text in seen)
            why = sum("time zone" in text for text in seen), sum("another time?" in text for text in seen)
            rows.append(
                [phone.name.removeprefix("ucb-sdb-"), kind, len(texts), len(seen), fits, len(seen) - fits, *why]
            )
    return table(["phone", "place", "given", "with data", "fit", "do not fit", "zone named", "other time named"], rows)


def judged_places(file, other):
    """Kind and text of each receipt and photo that is drawn for a day. other: the file of the true positions."""
    messages = (json.loads(line[line.index("{") :]) for line in other.read_text().splitlines())
    exact = [m for m in messages if m["_type"] == "location" and m.get("acc", 999) <= 100]
    time, lonlat = np.array([m["tst"] for m in exact], float), np.array([(m["lon"], m["lat"]) for m in exact])
    accuracy = np.maximum([m["acc"] / 1.51 for m in exact], 15.0)
    random, frame = np.random.default_rng([len(time), 9]), enu(lonlat[0, 1], lonlat[0, 0])
    way, drawn = frame.from_lonlat(lonlat), []
    for n in random.choice(len(time), min(PLACES, len(time)), replace=False).tolist():
        around = way[n] + rotation(random.uniform(0, 2 * np.pi)) @ [random.uniform(*OFF), 0.0]
        away = np.hypot(*(way - around).T).min() > APART
        clock = 3600 * random.choice([-3, -2, -1, 1, 2, 3])
        day = time[0], time[-1]
        sigma, then = accuracy[n], (time[n], time[n])
        drawn += [("photo", way[n], then, "photo", sigma), ("receipt of the day", way[n], day, "receipt", sigma)]
        drawn += [("photo, clock 1 to 3 h off", way[n], (time[n] + clock, time[n] + clock), "photo", sigma)]
        if away:
            drawn += [("photo by a friend", around, then, "photo", sigma)]
            drawn += [("receipt of somebody else", around, day, "receipt", sigma)]
    with TemporaryDirectory() as folder:
        import_past(Path(folder) / "log", [file])
        build(Path(folder) / "log")
        with Store(Path(folder) / "log") as store:
            for n, (_, place, span, source, radius) in enumerate(drawn):
                longitude, latitude = frame.to_lonlat(place[None])[0].tolist()
                value = {
                    "latitude": latitude,
                    "longitude": longitude,
                    "radius": float(radius),
                    "name": f"#{n}",
                    "source": source,
                }
                store.put_correction(Correction(0, "me", 0.0, VISITED, span[0] - 5.0, span[1] + 5.0, value))
            found = diary(store, "me")
    texts = [text for day in found.days for row in day.entries for _, text in row.evidence] + list(found.doubts)
    return [
        (kind, next((t for t in texts if f"#{n}" in re.split(r"[ ,:]", t)), "no data then"))
        for n, (kind, *_) in enumerate(drawn)
    ]


def diary_entries(files):
    """The entries of a diary of positions."""
    with TemporaryDirectory() as folder:
        import_past(Path(folder) / "log", files)
        build(Path(folder) / "log")
        with Store(Path(folder) / "log") as store:
            return [row for day in diary(store, "me", outings=False).days for row in day.entries]


def diary_rows(files):
    """Start, end and kind of the diary's rows, stays joined over midnights."""
    found = []
    for row in diary_entries(files):
        kind = KINDS.get(row.kind, NOTHING)
        if found and found[-1][2] == kind == WAIT and row.start - found[-1][1] < 1:
            found[-1] = (found[-1][0], row.end, kind)
        else:
            found.append((row.start, row.end, kind))
    return found


def stay_point_rows(files):
    """Stay points of VISIT_RADIUS and SHORTEST_VISIT (Li et al. 2008), and between them walks and rides by speed."""
    found = []
    for file in files:
        messages = (json.loads(line[line.index("{") :]) for line in file.read_text().splitlines())
        place = {m["tst"]: (m["lon"], m["lat"]) for m in messages if m["_type"] == "location"}
        time, sphere = np.array(sorted(place), float), on_sphere(np.array([place[t] for t in sorted(place)]))
        first, stays = 0, []
        while first < len(time):
            away = np.linalg.norm(sphere[first:] - sphere[first], axis=1) > VISIT_RADIUS
            after = first + int(np.argmax(away)) if away.any() else len(time) - 1
            if time[after] - time[first] >= SHORTEST_VISIT:
                stays.append((time[first], time[after], WAIT))
            else:
                after = first + 1
            first = after if after > first else len(time)
        found += stays
        for a, b in zip([time[0], *(s[1] for s in stays)], [*(s[0] for s in stays), time[-1]], strict=True):
            middle = np.arange(a + 5, b, 10)
            ends = [interpolate(middle + side, time, sphere) for side in (-30.0, 30.0)]
            speed = np.linalg.norm(ends[1] - ends[0], axis=1) / 60
            found += [
                (m - 5, min(m + 5, b), RIDE if v > SLOWEST_RIDE else WALK) for m, v in zip(middle, speed, strict=True)
            ]
    return found
