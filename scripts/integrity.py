"""Does a stated region hold what it says, whatever one of the sources does? Of whole walks, and of the live pose.

Simulated walks with honest sources and with one that is wrong, and real recordings.
"""

import warnings
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from accuracy_page import regions
from conditions import (
    INDOORS,
    LOOPS,
    NETWORK_LIES,
    OUTDOORS,
    events,
    measured,
    recordings,
    simulated_walk,
    smoothed,
    walks_given,
)
from live import HELP, THINNED, eights
from tables import HELD_BACK, is_wanted, marked, publish, table

from pdr_graph import smooth, verdict
from pdr_graph.apps.bench.data_sets import given
from pdr_graph.apps.report.evaluation import pair, stated_covariance
from pdr_graph.geometry import REGION_90, squared_distance
from pdr_graph.online.interface import trajectory_of
from pdr_graph.online.navigator import Navigator
from pdr_graph.types import Estimate, Steps
from pdr_graph.walk import observe

WALKS, FEWER = 40, 15  # of each family; of those in which a walk takes 3 to 30 s:
LONG = ("GNSS, beacons", "beacons, GNSS", "beacons", "plan")


@dataclass(frozen=True)
class Row:
    """A row of the table: what the estimate is given, and without what it is compared to see harm (None: nothing)."""

    given: tuple[str, ...]
    without: tuple[str, ...] | None = None

    @property
    def name(self):
        return ", ".join(self.given)


def rows_of(given, lies, without=None):
    """A row without a lie, and one for each lie of the last source."""
    return [Row((*given[:-1], f"{given[-1]}: {lie}" if lie else given[-1]), without) for lie in ("", *lies)]


LISTS = ("a pair swapped", "one moved", "one missing", "one off near the walk", "three on another floor")
LISTS += ("of another floor", "of another building", "another phone")
RECEIVER = ("10 m off", "jumping", "20 m off from half-way on", "5 s late", "frozen for a minute", "3 times as sure")
RECEIVER += ("half as far", "of two people")
USER = ("clock 2 s off", "of two people")
PLAN = ("5 m shifted", "a door missing", "of another floor")
NO_COMPASS = "compass: none"
NETWORK = "network"  # the family with a table of its own
FAMILIES = {  # the setting and the rows of walks that are compared with each other; each family has its own walks
    "GNSS, beacons": (
        INDOORS,
        [
            Row(("GNSS",)),
            Row(("GNSS: 10 m off",)),
            *rows_of(("GNSS", "beacons"), LISTS, ("GNSS",)),
        ],
    ),
    "beacons, GNSS": (
        INDOORS,
        [
            *rows_of(("beacons", "GNSS"), RECEIVER, ("beacons",)),
            Row(("beacons", "GNSS and speed: not following"), ("beacons",)),
        ],
    ),
    "beacons": (INDOORS, rows_of(("beacons",), LISTS)),
    "outdoors": (
        OUTDOORS,
        [*rows_of(("GNSS",), RECEIVER), *rows_of(("GNSS and speed",), ("courses 90° off", "not following"), ("GNSS",))],
    ),
    "fixes": (
        INDOORS,
        [
            Row((NO_COMPASS, "user fixes")),
            Row(("user fixes",), (NO_COMPASS, "user fixes")),
            Row(("compass: 40° off", "user fixes"), (NO_COMPASS, "user fixes")),
            Row(("gyroscope: drifts by 1.9°/s", "user fixes")),
            Row((NO_COMPASS, "gyroscope: drifts by 1.9°/s", "user fixes")),
            Row(("stride: 40 % off", "user fixes")),
            Row(("profile", "user fixes"), ("user fixes",)),
            Row(("profile: of somebody else", "user fixes"), ("user fixes",)),
            *rows_of(("user fixes",), USER, None)[1:],
            *rows_of(("user fixes", "start"), ("8 m off",), ("user fixes",)),
        ],
    ),
    "ends": (
        INDOORS,
        [
            Row(("start",)),
            Row(("profile: of somebody else", "start"), ("start",)),
            Row(("compass: 40° off", "start")),
            Row(("start", "end"), ("start",)),
            Row((NO_COMPASS, "start", "end")),
            Row(("compass: 40° off", "start", "end"), (NO_COMPASS, "start", "end")),
            Row(("gyroscope: drifts by 1.9°/s", "start", "end")),
        ],
    ),
    "ranges": (
        INDOORS,
        [*rows_of(("ranges", "start"), ("8 m off",), ("ranges",)), Row(("start", "ranges: clock 2 s off"), ("start",))],
    ),
    "radio map": (
        INDOORS,
        [*rows_of(("start", "radio map"), ("a part rebuilt",), ("start",)), Row(("radio map", "plan"), ("radio map",))],
    ),
    "plan": (
        INDOORS,
        [
            *rows_of(("user fixes", "plan"), PLAN, ("user fixes",)),
            Row(("start", "end", "plan"), ("start", "end")),
            *rows_of(("start", "plan"), PLAN, ("start",)),
            Row(("start: 8 m off", "user fixes", "plan"), ("user fixes", "plan")),
            Row(("start: 8 m off", "plan"), ("start: 8 m off",)),
            Row((NO_COMPASS, "start", "plan"), (NO_COMPASS, "start")),
            Row(("stride: 40 % off", "user fixes", "plan")),
        ],
    ),
    "loops": (
        LOOPS,
        [Row(("start", "end")), Row((NO_COMPASS, "start", "end")), Row(("compass: 40° off", "start", "end"))],
    ),
    NETWORK: (
        INDOORS,
        [
            Row(("start", "end")),
            *rows_of(("start", "end", "network"), tuple(NETWORK_LIES)[1:], ("start", "end")),
            Row(("user fixes", "network"), ("user fixes",)),
        ],
    ),
}
LIE = ": "  # in the name of a source that lies


def integrity(data, wanted=(), walks=None, first=HELD_BACK):
    """The tables. wanted: words of which a row's name has one; walks: of each family; first: seed of the first walk."""
    rows = [
        (name, row)
        for name, (_, some) in FAMILIES.items()
        for row in some
        if name != NETWORK and is_wanted(f"{name}: {row.name}", wanted)
    ]
    found = scores_by_row(rows, walks, first)
    lines = [
        [FAMILIES[name][0], row.name, *cells(found[name, row.given], row.without and found[name, row.without])]
        for name, row in rows
    ]
    publish("results/integrity.md", "integrity", regions(["", "given", *HEADER], lines))
    honest = [(name, row) for name, row in rows if LIE not in row.name.removeprefix(NO_COMPASS)]
    sharp = [[FAMILIES[name][0], row.name, *sharpness(found[name, row.given])] for name, row in honest]
    publish("results/integrity.md", "integrity sharpness", table(["", "given", *SHARPNESS], sharp))
    groups = {"nothing lies": [], "a source lies": []}
    for name, row in rows:
        if any(source.startswith("plan") for source in row.given):
            lies = any(LIE in source for source in row.given)
            groups["a source lies" if lies else "nothing lies"] += found[name, row.given]
    if any(groups.values()):
        groups = {name: scores for name, scores in groups.items() if scores}
        publish("results/integrity.md", "integrity probability", reliability(groups))
    integrity_network(wanted, walks, first)
    if not wanted:
        recorded(data)


def integrity_network(wanted=(), walks=None, first=HELD_BACK):
    """The table of walks with a network of the user's own; arguments as of `integrity`."""
    rows = [(NETWORK, row) for row in FAMILIES[NETWORK][1] if is_wanted(row.name, wanted)]
    found = scores_by_row(rows, walks, first)
    lines = [[row.name, *cells(found[name, row.given], row.without and found[name, row.without])] for name, row in rows]
    publish("results/integrity.md", "integrity network", regions(["given", *HEADER], lines))


def scores_by_row(rows, walks, first):
    """The scores of all walks by family and what is given, also without the sources that rows are compared with."""
    jobs = []
    for name in dict.fromkeys(name for name, _ in rows):
        needed = dict.fromkeys(given for of, row in rows if of == name for given in (row.given, row.without) if given)
        count = walks or (FEWER if name in LONG else WALKS)
        jobs += [(name, first + 1000 * list(FAMILIES).index(name) + seed, tuple(needed)) for seed in range(count)]
    found = {}
    with ProcessPoolExecutor() as pool:
        for (name, _, _), scores in zip(jobs, pool.map(scores_of, jobs), strict=True):
            for given, one in scores.items():
                found.setdefault((name, given), []).append(one)
    return found


def scores_of(job):
    """The scores of one walk by what is given."""
    family, seed, needed = job
    warnings.simplefilter("ignore")
    walk = simulated_walk(FAMILIES[family][0], seed)
    return {given: score(smooth(measured(walk, given).graph()), walk.truth) for given in needed}


# Scores

TIMES, SLACK = 1.25, 0.3  # [-], [m]: no harm if the error is at most TIMES that without the source, plus SLACK
RADII = 3.0  # stated 95 % radii beyond which an error is a broken promise
LEAST_COVERAGE, MOST_BROKEN, LEAST_UNHARMED = 0.85, 0.01, 0.9  # targets
HEADER = ["walks", "error [m]", "in 90 % region", "its radius [m]", "mean over 3 × r95"]
HEADER += ["no harm", "not ok"]


def _radii():
    """Ratios of a Gaussian's two sigmas, and the radius that holds 95 % of it, in the larger one."""
    ratio, angle = np.linspace(0, 1, 51), np.linspace(0, np.pi / 2, 401)
    square = np.cos(angle) ** 2 + ratio[:, None] ** 2 * np.sin(angle) ** 2 + 1e-12
    low, high = np.ones(len(ratio)), np.full(len(ratio), 3.0)
    for _ in range(40):
        middle = (low + high) / 2
        inside = np.trapezoid(1 - np.exp(-0.5 * middle[:, None] ** 2 / square), angle) * 2 / np.pi
        low, high = np.where(inside < 0.95, middle, low), np.where(inside < 0.95, high, middle)
    return ratio, (low + high) / 2


RATIO, RADIUS_95 = _radii()


@dataclass(frozen=True)
class Score:
    """How an estimate is off along a walk.

    error [m], the same in stated sigmas, squared, size of the 90 % region as the radius of a circle of its area [m],
    radius that holds 95 % [m]: ``(n,)``; probability: stated of the route; verdict: the state of the verdict.
    """

    error: np.ndarray
    distance: np.ndarray
    size: np.ndarray
    radius: np.ndarray
    probability: float
    verdict: str

    @property
    def inside(self):
        """Whether each place is in the 90 % region."""
        return self.distance < REGION_90

    @property
    def surprise(self):
        """The logarithmic score [nats]: minus the log of the stated density [1/m²] at the true places."""
        return self.distance / 2 + np.log(2 * np.pi * self.size**2 / REGION_90)

    @property
    def broken(self):
        """The mean error is more than three times the mean stated 95 % radius."""
        return self.error.mean() > RADII * self.radius.mean()

    def harmless(self, without):
        """The walk is about as good as without the source, or better."""
        return self.error.mean() <= TIMES * without.error.mean() + SLACK


def score(estimate, truth, noise=0.0):
    """The score of an estimate. noise: of the truth itself, per axis [m]."""
    track = estimate.trajectory
    pairs = pair(track, truth)
    covariance = stated_covariance(track, pairs.time) + noise**2 * np.eye(2)
    gap = pairs.estimate - pairs.truth
    variance = np.linalg.eigvalsh(covariance)
    small, large = np.sqrt(np.maximum(variance, 1e-12)).T
    return Score(
        error=np.hypot(*gap.T),
        distance=squared_distance(gap, covariance),
        size=np.sqrt(REGION_90 * small * large),
        radius=large * np.interp(small / large, RATIO, RADIUS_95),
        probability=estimate.probability,
        verdict=verdict(estimate).state,
    )


def cells(scores, without):
    """Cells of a row from the scores of its walks; those that miss a target are bold. without: None, or scores."""
    row = [len(scores), *places(scores)]
    broken = [s.broken for s in scores]
    row.append(marked(f"{sum(broken)} of {len(broken)}", np.mean(broken) > MOST_BROKEN))
    unharmed = None if without is None else [s.harmless(w) for s, w in zip(scores, without, strict=True)]
    row.append("—" if unharmed is None else share(unharmed, LEAST_UNHARMED))
    return [*row, share([s.verdict != "ok" for s in scores])]


def places(scores):
    """Cells of all places: errors [m], share in the region with its interval, radius of the region [m]."""
    error, size = (np.concatenate([getattr(s, name) for s in scores]) for name in ("error", "size"))
    errors = " / ".join(f"{p:.1f}" for p in np.percentile(error, [50, 75, 95]))
    return errors, covered([s.inside for s in scores]), f"{np.median(size):.1f}"


LEVELS = ((0.5, 0.45, 0.6), (0.9, 0.87, 0.96), (0.99, 0.97, 1.0))  # and the shares that such a region should hold
SHARPEST = 2.0  # target of the radius of the 90 % region as a multiple of the error that 90 % do not exceed
SHARPNESS = ["50 % region", "90 %", "99 %", "error, 90 % [m]", "its radius [m]", "radius / error", "log score [nats]"]


def sharpness(scores):
    """Cells of honest walks: what regions hold, how large they are against the errors, and the logarithmic score."""
    error, distance, size, surprise = (
        np.concatenate([getattr(s, name) for s in scores]) for name in ("error", "distance", "size", "surprise")
    )
    held = [(np.mean(distance < -2 * np.log1p(-level)), low, high) for level, low, high in LEVELS]
    shares = [marked(f"{100 * part:.0f} %", not low <= round(part, 2) <= high) for part, low, high in held]
    reached, radius = np.percentile(error, 90), np.median(size)
    ratio = marked(f"{radius / reached:.1f}", radius > SHARPEST * reached)
    return [*shares, f"{reached:.1f}", f"{radius:.1f}", ratio, f"{np.mean(surprise):.2f}"]


def covered(walks, draws=2000):
    """The share of places in their region, its 95 % bootstrap interval over walks; bold below the target."""
    inside, count = np.array([(w.sum(), len(w)) for w in walks], dtype=float).T
    mean, interval = inside.sum() / count.sum(), ""
    if len(walks) > 1:
        drawn = np.random.default_rng(0).integers(0, len(walks), (draws, len(walks)))
        shares = inside[drawn].sum(axis=1) / count[drawn].sum(axis=1)
        interval = " ({:.0f}–{:.0f})".format(*np.percentile(100 * shares, [2.5, 97.5]))
    return marked(f"{100 * mean:.0f} %{interval}", mean < LEAST_COVERAGE)


def share(holds, least=0.0):
    """How often something holds; bold below the target."""
    return marked(f"{100 * np.mean(holds):.0f} %", np.mean(holds) < least)


BINS = (0.0, 0.5, 0.7, 0.9, 0.97, 1.0)
RIGHT, CALIBRATED = 4.0, 0.05  # [m] mean error of a walk on the right route; target of the expected calibration error


def reliability(groups):
    """How often routes are right by what is stated of them. groups: by name, scores of walks with a plan."""
    rows = []
    for name, scores in groups.items():
        stated = np.array([s.probability for s in scores])
        right = np.array([s.error.mean() < RIGHT for s in scores])
        place = np.clip(np.searchsorted(BINS, stated) - 1, 0, len(BINS) - 2)
        calibration = 0.0
        for n, (low, high) in enumerate(pairwise(BINS)):
            here = place == n
            if here.any():
                calibration += here.mean() * abs(stated[here].mean() - right[here].mean())
                shares = [f"{100 * values[here].mean():.0f} %" for values in (stated, right)]
                rows.append([name, f"{100 * low:.0f}–{100 * high:.0f} %", here.sum(), *shares])
        said = marked(f"{calibration:.3f}", calibration > CALIBRATED)
        rows.append([name, "expected calibration error", len(scores), said, ""])
    return table(["given", "stated", "walks", "mean stated", "right route"], rows)


# Recordings

PUBLISHED, CORRECTED, WRONG = "the published list", "the list put right", "another pair swapped as well"
SWAPS = {
    PUBLISHED: [],
    CORRECTED: [("BLE2", "BLE3")],
    WRONG: [("BLE2", "BLE3"), ("BLE1", "BLE4")],
}


def recorded(data):
    """The table; of logs that have GNSS, harm is that of the beacons."""
    rows = [*malls(data), *museum(data), *eight(data)]
    for what in THINNED:
        rows.append(
            ["NJU campus", what, *cells([scored(walk) for walk in walks_given(data, "nju", what).values()], None)]
        )
    publish("results/integrity.md", "integrity recorded", regions(["recordings", "given", *HEADER], rows))


def scored(walk):
    """The score of a walk."""
    return score(smoothed(walk), walk.truth, walk.noise)


def all_scored(walks):
    """The scores of walks, which are estimated on all cores."""
    with ProcessPoolExecutor() as pool:
        return list(pool.map(scored, walks))


def malls(data):
    """Walks in malls by what is given."""
    for what, name in HELP.items():
        without, with_plan = (all_scored(walks_given(data, "malls", what + plan).values()) for plan in ("", ", plan"))
        yield ["Microsoft", name, *cells(without, None)]
        yield ["Microsoft", f"{name}, plan", *cells(with_plan, without)]


def museum(data):
    """IPIN 2023: GNSS alone, and with each list."""
    alone = all_scored(walks_given(data, "museum", "recorded, no beacons").values())
    yield ["IPIN 2023, all", "GNSS", *cells(alone, None)]
    for name, swaps in SWAPS.items():
        walks = [given(walk, "recorded") for walk in recordings(data, "museum").values()]
        lists = [replace(walk.evidence, beacons=swapped(walk.evidence.beacons, swaps)) for walk in walks]
        walks = [replace(walk, evidence=observe(listed)) for walk, listed in zip(walks, lists, strict=True)]
        yield ["IPIN 2023, all", f"GNSS, beacons: {name}", *cells(all_scored(walks), alone)]


def swapped(listed, pairs):
    """A list with some pairs exchanged. pairs: of labels."""
    position, floor = listed.position.copy(), list(listed.floor)
    for labels in pairs:
        one, other = (listed.label.index(label) for label in labels)
        position[[one, other]] = position[[other, one]]
        floor[one], floor[other] = floor[other], floor[one]
    return replace(listed, position=position, floor=tuple(floor))


def eight(data):
    """IPIN21's figure of eight with each set of simulated fixes."""
    without = []
    for name, each, what in eights(data):
        found = [scored(walks_given(data, "ipin21", what)[each])]
        plan = what.endswith(", plan")
        yield ["IPIN21's eight", name, *cells(found, without if plan else None)]
        without = found


# The live pose

LIVE_WALKS = 10  # of each row
LAG = 60.0  # [s]
LIVE_SEED = 50_000  # first seed of the walks of this table, beside those of others
LIVE_ROWS = {  # what the navigator is given
    OUTDOORS: [("GNSS",), ("GNSS: 10 m off",), ("GNSS: 3 times as sure",)],
    INDOORS: [
        ("GNSS", "beacons"),
        ("GNSS", "beacons: a pair swapped"),
        ("GNSS", "beacons: one moved"),
        ("GNSS", "beacons: of another building"),
        ("GNSS: 10 m off", "beacons"),
        ("user fixes", "start"),
        ("user fixes", "start: 8 m off"),
    ],
}
LIVE_HEADER = ["", "given", "walks", "batch [m]", "in 90 %", "current pose [m]", "in 90 %"]
LIVE_HEADER += ["smoothed, lag 60 s [m]", "in 90 %", "not ok"]


@dataclass(frozen=True)
class Live:
    """Scores of a walk: of the batch, of the current poses, and of the walk smoothed with a lag."""

    batch: Score
    pose: Score
    smoothed: Score


def integrity_live(wanted=(), walks=None, first=HELD_BACK):
    """The table. wanted: words of which a row's name has one; walks: of each row; first: seed of the first walk."""
    jobs, lines = [], []
    for setting, rows in LIVE_ROWS.items():
        rows = [row for row in rows if is_wanted(f"{setting}: {', '.join(row)}", wanted)]
        jobs += [(setting, row, LIVE_SEED + first + seed) for row in rows for seed in range(walks or LIVE_WALKS)]
    found = {}
    with ProcessPoolExecutor() as pool:
        for (setting, row, _), one in zip(jobs, pool.map(live_scores_of, jobs), strict=True):
            found.setdefault((setting, row), []).append(one)
    for (setting, row), some in found.items():
        lines.append([setting, ", ".join(row), len(some), *live_cells(some)])
    publish("results/integrity-live.md", "integrity live", table(LIVE_HEADER, lines))


def live_scores_of(job):
    """The scores of one walk."""
    setting, sources, seed = job
    warnings.simplefilter("ignore")
    walk = simulated_walk(setting, seed)
    given = measured(walk, sources)
    batch = score(smooth(given.graph()), walk.truth)
    poses, estimate = followed(given)
    causal = Estimate(poses, poses, None, {}, 0, float("nan"), True)
    return Live(batch, score(causal, walk.truth), score(estimate, walk.truth))


def followed(given):
    """A walk through a navigator: its pose after each step, and the estimate at its end."""
    nav, poses = Navigator(given.building, lag=LAG), []
    for event in events(given):
        nav.push(event)
        if isinstance(event, Steps) and (pose := nav.pose) is not None:
            poses.append(pose)
    return trajectory_of(poses), nav.finish()


def live_cells(scores):
    """Cells of a row from the scores of its walks; those that miss the target are bold."""
    row = []
    for name in ("batch", "pose", "smoothed"):
        row += places([getattr(one, name) for one in scores])[:2]
    return [*row, share([one.smoothed.verdict != "ok" for one in scores])]
