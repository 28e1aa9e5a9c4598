"""The current pose of the live navigator beside the causal filter and the smoothed walk."""

import gc
import os
import sys
import time
import tomllib
import warnings
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import islice

import numpy as np
import shapely
from conditions import (
    DISTURBANCE,
    HELP,
    INDOORS,
    OUTDOORS,
    WAYPOINT_NOISE,
    Given,
    Walk,
    errors_at,
    events,
    gaps,
    helped_walks,
    ipin21_walks,
    ipin2023_walks,
    measured,
    nju_walks,
    percentiles,
    route_of,
    simulated_recording,
    simulated_walk,
)
from tables import HELD_BACK, is_wanted, marked, publish, table

from pdr_graph import FloorPlan, WalkGraph, kalman_filter, smooth
from pdr_graph.apps.report.evaluation import circular_error, heading_error, pair
from pdr_graph.frames import Frame, frame_of
from pdr_graph.gait.step_chunks import concatenate_steps
from pdr_graph.geometry import interpolate
from pdr_graph.io.loading import load
from pdr_graph.io.tables import read_beacons
from pdr_graph.lab.simulation.scenario import Scenario, scenario_file
from pdr_graph.online.interface import Pose, Samples, events_of, trajectory_of
from pdr_graph.online.navigator import Navigator
from pdr_graph.types import Beacons, Fixes, Headings, Recording, Steps, Trajectory

LAG = 60.0  # [s]
MOST_RATIO, SHARE_OF_ROWS = 1.0, 0.95  # of the filter's mean error, in so many rows
LEAST_COVERAGE, MOST_OUTSIDE, MOST_JITTER, LONGEST = 0.87, 0.01, 0.2, 0.030  # targets: shares, [m], [s]
ACCURACY = ["walk", "given", "walks", "places", "current pose [m]", "filter [m]", "pose / filter", "in 90 %"]
ACCURACY += ["lag 60 s [m]", "batch [m]"]
BEHAVIOUR = ["walk", "given", "first pose [s]", "within 5 m [s]", "within 0.5 rad [s]", "jump in a minute [m]"]
BEHAVIOUR += ["outside", "jitter [m]", "push and pose, CPU [ms]"]


STANDING = 60.0  # [s] in which a walker stands still
STANDS_AT = (0.0, 0.5)  # share of the corners passed when the walker stands: odd seeds begin so, others pause half-way
LENGTH = (80.0, 140.0)  # [m] of walks from samples
PHONE = {"rate": 50, "disturbance": DISTURBANCE}
COURSE_TIME, LEAST_SPEED = 1.0, 0.3  # [s] to either side; [m/s] below which a place has no direction
OWN = 60_000  # first seed of the walks of this table, beside those of others
FROM_STEPS = {  # name: setting, sources, walks
    "outdoors": (OUTDOORS, ("GNSS",), 8),
    "outdoors, GNSS with speed": (OUTDOORS, ("GNSS and speed",), 8),
    "indoors, fixes every 30 s": (INDOORS, ("user fixes",), 8),
    "indoors, start, compass, plan": (INDOORS, ("start", "plan"), 8),
    "indoors, GNSS, beacons": (INDOORS, ("GNSS", "beacons"), 6),
}
SEEDS = (0, 0, 1, 2, 3)  # thousands of the seeds of each: with and without speed the walks are the same
FROM_SAMPLES = {  # name: setting, what the scenario has, walks
    "indoors, samples, fixes every 30 s, plan, a minute's stand": (INDOORS, {"fixes": {"period": 30.0}}, 6),
}
SCENARIO_FILES = {  # what the scenario's file does not have
    "mall": {"fixes": {"period": 30.0, "sigma": 2.0}},
}

# Scores

NEAR, POINTED = 5.0, 0.5  # [m] and [rad] within which a place and a direction are right
MINUTE = 60.0  # [s]
ON_THE_EDGE = 0.05  # [m] beyond the walkable area that a place may be, by the plan's own precision
STILL, LEAST_STAND = 0.05, 50.0  # [m] within which a walker stands; [s] of a stand whose jitter is measured
SETTLING = 5.0  # [s] after the last step, until a stand is known to be one


def live(data, wanted=(), walks=None, first=HELD_BACK):
    """Both tables. wanted: words of which a row has one; walks: simulated, in each row; first: seed of the first."""
    rows = [group for group in groups(data, walks, first) if is_wanted(group.title, wanted)]
    if not rows:
        raise SystemExit(f"no row has {' or '.join(map(repr, wanted))} in its name")
    found = scores_by_group(rows)
    rows = [(group, pooled(scores), len(scores)) for group, scores in zip(rows, found, strict=True)]
    accuracy = table(ACCURACY, [accuracy_row(*row) for row in rows])
    behaviour = table(BEHAVIOUR, [behaviour_row(*row[:2]) for row in rows])
    publish("results/live.md", "live", f"{accuracy}\n\n{targets([score for _, score, _ in rows])}")
    publish("results/live.md", "live behaviour", behaviour)


def scores_by_group(rows):
    """The scores of the walks of each group."""
    found = []
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        futures = [[pool.submit(score_case, case) for case in group.cases] for group in rows]
        for group, waiting in zip(rows, futures, strict=True):
            began = time.time()
            scores = [one.result() for one in waiting]
            found.append(scores)
            print(f"{group.title}: {len(found[-1])} walks, {time.time() - began:.0f} s", file=sys.stderr, flush=True)
    return found


def score_case(make):
    """The score of one walk."""
    warnings.simplefilter("ignore")
    case = make()
    return score_of(case, followed(case), smooth(case.graph()).trajectory)


def accuracy_row(group, score, walks):
    """Cells of the first table; those that miss a target are bold."""
    pose, filtered, lag, batch = (said(score.errors[name]) for name in ("pose", "filter", "lag", "batch"))
    share = marked(f"{100 * coverage(score):.0f} %", coverage(score) < LEAST_COVERAGE)
    beside = marked(f"{ratio(score):.2f}", ratio(score) > MOST_RATIO)
    return [group.name, group.given, walks, len(score.inside), pose, filtered, beside, share, lag, batch]


def behaviour_row(group, score):
    """Cells of the second table; those that miss a target are bold."""
    outside, jitter = outside_share(score), score.jitter.max(initial=0.0)
    times = [until(getattr(score, name)) for name in ("first", "near", "pointed")]
    return [
        group.name,
        group.given,
        *times,
        median_and_most(score.jumps),
        "—" if np.isnan(outside) else marked(f"{100 * outside:.1f} %", outside > MOST_OUTSIDE),
        marked(median_and_most(score.jitter, 2), jitter > MOST_JITTER),
        milliseconds(score.cpu),
    ]


def targets(scores):
    """How many rows reach each target, as text."""
    with_plan = [outside_share(score) for score in scores if not np.isnan(outside_share(score))]
    near = [ratio(score) <= MOST_RATIO for score in scores]
    covered = [coverage(score) >= LEAST_COVERAGE for score in scores]
    within = [share <= MOST_OUTSIDE for share in with_plan]
    return (
        f"The pose's mean error is at most {MOST_RATIO} times the filter's in {sum(near)} of {len(near)} rows (asked: "
        f"{100 * SHARE_OF_ROWS:.0f} %); its 90 % region has at least {100 * LEAST_COVERAGE:.0f} % in {sum(covered)} of "
        f"{len(covered)}; at most {100 * MOST_OUTSIDE:.0f} % of its places are outside the walkable area in "
        f"{sum(within)} of {len(within)} with a plan."
    )


def ratio(score):
    """The pose's mean error in the filter's."""
    return score.errors["pose"].mean() / score.errors["filter"].mean()


def coverage(score):
    """How often the truth is in the pose's 90 % region."""
    return score.inside.mean()


def outside_share(score):
    """How often the pose is outside the walkable area; NaN without a plan."""
    return score.outside.mean() if len(score.outside) else np.nan


def said(errors):
    return percentiles(errors) if len(errors) else "no pose"


def until(seconds):
    """Median and longest of some times ``(w,)`` [s]; "never" where it is infinite, a dash without truth."""
    seconds = seconds[~np.isnan(seconds)]
    both = [np.median(seconds), seconds.max()] if len(seconds) else []
    return " / ".join(f"{value:.0f}" if np.isfinite(value) else "never" for value in both[: len(seconds)]) or "—"


def median_and_most(values, digits=1):
    return " / ".join(f"{v:.{digits}f}" for v in (np.median(values), values.max())) if len(values) else "—"


def milliseconds(seconds):
    """Median, 99 % and longest; bold if that is too long."""
    text = " / ".join(f"{1e3 * v:.1f}" for v in np.percentile(seconds, [50, 99, 100]))
    return marked(text, seconds.max() > LONGEST)


# Cases


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
    """A row of the table. cases: functions that return a `Case` each."""

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
            make = partial(mall, given=given, plan=plan)
            cases = [partial(_case, make, data, n) for n in range(len(helped_walks(data, given)))]
            yield Group("Microsoft", with_plan(given, plan), tuple(cases))
    for make in (eight, museum, campus):
        names = [(case.name, case.given) for case in make(data)]
        for n, (name, given) in enumerate(names):
            yield Group(name, given, (partial(_case, make, data, n),))


def _case(make, data, number):
    return next(islice(make(data), number, None))


def with_plan(given, plan):
    return f"{given}, plan" if plan else given


def museum(data):
    """IPIN 2023, by the phone's GNSS, without and with beacons."""
    folder = data / "ipin2023_track3"
    for walk in ipin2023_walks(data):
        recording = load(folder / f"{walk.name}.txt")
        frame = frame_of(recording.fixes)
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
    return Case("NJU campus", walk.name, walk, recording, frame_of(recording.fixes))


def eight(data):
    """IPIN21's figure of eight, without and with its plan; its truth is dense enough for directions."""
    recording = load(data / "ipin21_hcu" / "eight")
    for walk in ipin21_walks(data):
        walk = replace(walk, truth=with_course(walk.truth))
        yield Case("IPIN21, eight", walk.name, walk, recording, walk.floor.frame)
        yield Case("IPIN21, eight", f"{walk.name}, plan", walk, recording, walk.floor.frame, walk.floor)


def mall(data, given, plan):
    """Microsoft's walks by what is given of their waypoints, with or without the plan."""
    for recording, walk in helped_walks(data, given):
        floor = walk.floor if plan else None
        name = with_plan(given, plan)
        yield Case("Microsoft", name, walk, recording, walk.floor.frame, floor, noise=WAYPOINT_NOISE)


def with_course(truth):
    """A dense truth with the direction of the way from 1 s before each place to 1 s after; NaN where it stands."""
    before, after = (
        np.stack([np.interp(truth.time + by, truth.time, v) for v in truth.position.T], 1)
        for by in (-COURSE_TIME, COURSE_TIME)
    )
    way = after - before
    course = np.arctan2(way[:, 1], way[:, 0])
    return replace(truth, heading=np.where(np.hypot(*way.T) > 2 * COURSE_TIME * LEAST_SPEED, course, np.nan))


def simulated_groups(walks, first):
    """Rows of simulated walks: of steps, of raw samples, and the scenarios of the package."""
    for number, (name, (_, _, usual)) in zip(SEEDS, FROM_STEPS.items(), strict=True):
        seeds = OWN + first + 1000 * number + np.arange(walks or usual)
        yield Group("simulated", name, tuple(partial(from_steps, name, int(seed)) for seed in seeds))
    for number, (name, (_, _, usual)) in enumerate(FROM_SAMPLES.items(), start=1 + max(SEEDS)):
        seeds = OWN + first + 1000 * number + np.arange(walks or usual)
        yield Group("simulated", name, tuple(partial(from_samples, name, int(seed)) for seed in seeds))
    for name in SCENARIO_FILES:
        yield Group("scenario", name, (partial(of_scenario, name),))


def from_steps(name, seed):
    """A simulated walk whose steps, measurements and headings are pushed in their time."""
    setting, sources, _ = FROM_STEPS[name]
    simulated = simulated_walk(setting, seed)
    given = measured(simulated, sources)
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
    recording, walk, frame, beacons = simulated_recording(scenario, plan)
    return Case(name, given, walk, recording, frame, walk.floor, beacons)


# Runs


class LoggingNavigator(Navigator):
    """A navigator that logs what its front end gives: chunks of certain steps, and headings as they are set.

    headings: rows of number, time [s], heading and sigma [rad]; an infinite sigma removes that number.
    """

    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        self.chunks, self.headings, self.fixes = list[Steps](), list[tuple](), list[Fixes]()
        self.walked = 0.0  # by the certain steps [m]
        self._set, self._graph.set_heading = self._graph.set_heading, self._log_heading
        self._append, self._graph.extend = self._graph.extend, self._log_steps

    def push(self, event):
        """Push an event; headings and fixes among them are logged."""
        if isinstance(event, Headings):
            rows = zip(event.time, event.heading, event.sigma, strict=True)
            self.headings += [(len(self.headings) + n, *row) for n, row in enumerate(rows)]
        elif isinstance(event, Fixes):
            self.fixes.append(event)
        super().push(event)

    def _log_heading(self, number, time, heading, sigma):
        self.headings.append((number, time, heading, sigma))
        self._set(number, time, heading, sigma)

    def _log_steps(self, steps, floor):
        self.chunks.append(steps)
        self.walked += float(steps.length.sum())
        self._append(steps, floor)

    @property
    def provisional(self):
        """The steps that may still change; None if there are none."""
        return self._tail


@dataclass(frozen=True)
class Ask:
    """A pose that was asked for, and what was known then.

    time: of the newest sample [s]; pose: None before there is one; anchored: False while only its shape is known, not
    where it is; display: ``(2,)`` place that is drawn [m], None without; walked: length of all steps so far [m];
    chunks, headings, fixes: how many of each the front end had given; tail:
    provisional steps; cpu, wall: seconds of the pushes since the last one, and of the pose.
    """

    time: float
    pose: Pose | None
    anchored: bool
    display: np.ndarray | None
    walked: float
    chunks: int
    headings: int
    fixes: int
    tail: Steps | None
    cpu: float
    wall: float


@dataclass(frozen=True)
class Run:
    """A walk as the navigator followed it.

    smoothed: with a lag, at the end; chunks, headings, fixes: all that there were.
    """

    asks: list[Ask]
    smoothed: Trajectory
    chunks: list[Steps]
    headings: list[tuple]
    fixes: list[Fixes]

    @cached_property
    def shown(self):
        """The asks whose pose has a place."""
        return [ask for ask in self.asks if ask.anchored]

    @cached_property
    def current(self):
        """Of the shown ones, the last of each pose's time; their times increase."""
        time = np.array([ask.pose.time for ask in self.shown])
        later = np.append(np.minimum.accumulate(time[::-1])[::-1][1:], np.inf)
        return [ask for ask, last in zip(self.shown, time < later, strict=True) if last]

    @property
    def causal(self):
        """The current poses at the times that they are of."""
        return trajectory_of([ask.pose for ask in self.current])

    def filtered(self, time):
        """Positions ``(n, 2)`` [m] by the causal filter at some times [s], from what was known when the pose of that
        time was asked for; NaN where there was nothing. It runs again for every change of the headings.
        """
        position = np.full((len(time), 2), np.nan)
        if not self.current:
            return position
        pose_time = np.array([ask.pose.time for ask in self.current])
        which = np.minimum(np.searchsorted(pose_time, time), len(pose_time) - 1)
        known = np.array([(ask.headings, min(ask.fixes, 1)) for ask in self.current])[which]
        for version in np.unique(known, axis=0):
            rows = np.flatnonzero((known == version).all(axis=1))
            track = self._filter_of(self.current[which[rows].max()])
            if track is not None:
                position[rows] = interpolate(time[rows], track.time, track.position)
        return position

    def _filter_of(self, ask):
        chunks = [*self.chunks[: ask.chunks], *([] if ask.tail is None else [ask.tail])]
        if not chunks:
            return None
        rows = {number: row for number, *row in self.headings[: ask.headings]}
        rows = np.array(sorted(row for row in rows.values() if np.isfinite(row[2]))).reshape(-1, 3)
        fixes = Fixes.concatenate(self.fixes[: ask.fixes])
        graph = WalkGraph(concatenate_steps(chunks), fixes, headings=Headings(*rows.T))
        return kalman_filter(graph).trajectory


def followed(case, lag=LAG):
    """The run of a case; the pose is asked for after each packet of acceleration, or each step."""
    epoch = None if case.recording is None else case.recording.epoch
    nav = LoggingNavigator(case.plan, lag=lag, frame=case.frame, beacons=case.beacons, epoch=epoch, executor=None)
    events, asks, taken = list(case.events()), [], np.zeros(2)
    gc.collect()
    gc.freeze()  # otherwise a full garbage collection takes 30 ms of some step
    for event in events:
        began = clocks()
        nav.push(event)
        taken += clocks() - began
        if isinstance(event, Steps) or (isinstance(event, Samples) and event.sensor == "accelerometer"):
            began = clocks()
            pose = nav.pose
            taken += clocks() - began
            asks.append(ask_of(nav, float(event.time[-1]), pose, taken))
            nav.review()  # an idle moment
            taken = np.zeros(2)
    gc.unfreeze()
    return Run(asks, nav.finish().trajectory, nav.chunks, nav.headings, nav.fixes)


def clocks():
    """CPU time of this thread, and wall time. [s]"""
    return np.array([time.thread_time(), time.perf_counter()])


def ask_of(nav, time, pose, taken):
    """What is known of a navigator whose pose was just asked for."""
    status, tail = nav.status, nav.provisional
    nowhere = status.state == "no absolute position" or (status.state == "waiting" and not status.fixes)
    return Ask(
        time=time,
        pose=pose,
        anchored=pose is not None and not nowhere,
        display=None if pose is None or pose.display is None else np.array(pose.display),
        walked=nav.walked + (0.0 if tail is None else float(tail.length.sum())),
        chunks=len(nav.chunks),
        headings=len(nav.headings),
        fixes=len(nav.fixes),
        tail=tail,
        cpu=float(taken[0]),
        wall=float(taken[1]),
    )


# Scores


@dataclass(frozen=True)
class WalkScore:
    """How the current pose of one walk is off.

    errors: by estimate at the places of the truth that all estimates have ``(n,)`` [m]; inside: of each, whether it is
    in the 90 % region of the pose; first, near, pointed: seconds from the first sample to the first pose, to a place
    within NEAR and to a direction within POINTED, infinite if never, pointed NaN without true directions; jumps: the
    largest of each minute [m]; outside: whether each pose is outside the walkable area, empty without a plan; jitter:
    of each stand of a minute [m]; cpu: of each ask [s].
    """

    errors: dict
    inside: np.ndarray
    first: float
    near: float
    pointed: float
    jumps: np.ndarray
    outside: np.ndarray
    jitter: np.ndarray
    cpu: np.ndarray


def score_of(case, run, batch):
    """The score of a run. batch: the trajectory of the whole walk at once."""
    cpu, empty = np.array([ask.cpu for ask in run.asks]), np.empty(0)
    if not run.shown:
        never = np.inf
        errors = {name: empty for name in ("pose", "filter", "lag", "batch")}
        return WalkScore(errors, empty, never, never, never, empty, empty, empty, cpu)
    truth, causal = case.walk.truth, run.causal
    errors, inside = errors_of(case, run, batch)
    return WalkScore(
        errors=errors,
        inside=inside,
        first=run.shown[0].time - case.begin,
        near=time_to_near(causal, truth) - case.begin,
        pointed=time_to_pointed(causal, truth) - case.begin,
        jumps=by_minute(run.shown, jumps(run)),
        outside=outside(causal.position, case.plan),
        jitter=jitter(run.shown, standing(truth)),
        cpu=cpu,
    )


def errors_of(case, run, batch):
    """Errors by estimate where all have one ``(n,)`` [m], and whether the truth is in the pose's 90 % region."""
    truth, causal = case.walk.truth, run.causal
    errors = {
        name: errors_at(track, truth) for name, track in (("pose", causal), ("lag", run.smoothed), ("batch", batch))
    }
    errors["filter"] = np.hypot(*(run.filtered(truth.time) - truth.position).T)
    inside = np.zeros(len(truth), dtype=bool)
    if len(pair(causal, truth).time):
        inside[~np.isnan(errors["pose"])] = gaps(causal, truth, case.noise)[1]
    known = np.isfinite(list(errors.values())).all(axis=0)
    return {name: values[known] for name, values in errors.items()}, inside[known]


def time_to_near(causal, truth):
    """Time [s] of the first place that is within NEAR, as is the next one; infinite if there is none."""
    pairs = pair(causal, truth)
    return _first_twice(pairs.time, circular_error(pairs) <= NEAR)


def time_to_pointed(causal, truth):
    """Time [s] of the first direction within POINTED, as is the next; infinite if there is none, NaN without truth."""
    if not np.isfinite(truth.heading).any():
        return np.nan
    pairs = pair(causal, truth)
    pairs = pairs.where(np.isfinite(pairs.truth_heading))
    return _first_twice(pairs.time, heading_error(pairs) <= POINTED)


def _first_twice(time, right):
    """The first time that is right, as the next one is; the last needs no next."""
    found = np.flatnonzero(right & np.append(right[1:], True))
    return float(time[found[0]]) if len(found) else np.inf


def jumps(run):
    """How much farther the pose moved than the steps from each ask to the next ``(a,)`` [m]."""
    place = np.array([(ask.pose.x, ask.pose.y) for ask in run.shown])
    walked = np.array([ask.walked for ask in run.shown])
    moved = np.hypot(*np.diff(place, axis=0, prepend=place[:1]).T)
    return np.maximum(moved - np.abs(np.diff(walked, prepend=walked[:1])), 0.0)


def by_minute(asks, size):
    """The largest of each minute since the first pose. size: of each ask, or empty [m]"""
    if not len(size):
        return size
    minute = ((np.array([ask.time for ask in asks]) - asks[0].time) // MINUTE).astype(int)
    return np.array([size[minute == n].max() for n in np.unique(minute)])


def outside(place, plan):
    """Whether each place ``(n, 2)`` is outside the walkable area; empty without a plan."""
    if plan is None:
        return np.empty(0, dtype=bool)
    area = shapely.buffer(plan.walkable, ON_THE_EDGE)
    shapely.prepare(area)
    return ~shapely.contains_xy(area, *place.T)


def standing(truth):
    """Intervals [s] of at least LEAST_STAND in which a dense truth does not move."""
    if len(truth) < 2 or np.median(np.diff(truth.time)) > 2.0:
        return []
    still = np.hypot(*np.diff(truth.position, axis=0).T) < STILL * np.diff(truth.time)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
    spans = truth.time[edges].reshape(-1, 2)
    return [tuple(span) for span in spans if span[1] - span[0] >= LEAST_STAND]


def jitter(asks, stands):
    """The largest distance of a pose from the mean pose in each stand ``(s,)`` [m]."""
    time = np.array([ask.time for ask in asks])
    place = np.array([(ask.pose.x, ask.pose.y) for ask in asks])
    still = [place[(time >= begin + SETTLING) & (time < end)] for begin, end in stands]
    return np.array([np.hypot(*(some - some.mean(axis=0)).T).max() for some in still if len(some)])


def pooled(scores):
    """The scores of several walks as one, but for the times and walks, which stay apart in arrays."""
    first = scores[0]
    arrays = ("inside", "jumps", "outside", "jitter", "cpu")
    together = {name: np.concatenate([getattr(one, name) for one in scores]) for name in arrays}
    times = {name: np.array([getattr(one, name) for one in scores]) for name in ("first", "near", "pointed")}
    errors = {name: np.concatenate([one.errors[name] for one in scores]) for name in first.errors}
    return replace(first, errors=errors, **together, **times)
