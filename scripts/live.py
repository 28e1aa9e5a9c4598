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

import numpy as np
import shapely
from conditions import (
    DISTURBANCE,
    INDOORS,
    LATE_RECEIVER,
    OUTDOORS,
    events,
    measured,
    percentiles,
    recordings,
    route_of,
    simulated_recording,
    simulated_walk,
    smoothed,
    with_steps,
)
from tables import HELD_BACK, is_wanted, marked, publish, table

from pdr_graph import WalkGraph, kalman_filter
from pdr_graph.apps.bench.data_sets import BenchWalk, given
from pdr_graph.apps.bench.matrix import places
from pdr_graph.apps.replay import events_within, navigator_of
from pdr_graph.apps.report.evaluation import circular_error, heading_error, pair
from pdr_graph.gait.step_chunks import concatenate_steps
from pdr_graph.geometry import interpolate
from pdr_graph.lab.simulation.scenario import Scenario, scenario_file
from pdr_graph.lab.simulation.sensors import gnss_fixes
from pdr_graph.online.interface import Pose, Samples, trajectory_of
from pdr_graph.online.navigator import Navigator
from pdr_graph.types import Fixes, Headings, Steps, Trajectory

THINNED = tuple(f"one in {every} s" for every in (10, 30, 60, 120))
MOST_RATIO, SHARE_OF_ROWS = 1.0, 0.95  # of the filter's mean error, in so many rows
LEAST_COVERAGE, MOST_OUTSIDE, MOST_JITTER, LONGEST = 0.87, 0.01, 0.2, 0.030  # targets: shares, [m], [s]
ACCURACY = ["walk", "given", "walks", "places", "current pose [m]", "filter [m]", "pose / filter", "in 90 %"]
ACCURACY += ["receiver [m]", "pose / receiver", "lag 60 s [m]", "batch [m]"]
MOST_OF_RECEIVER = 0.85, 0.8  # of the receiver's error, in the median and at 95 %
OFTEN = 2.0  # [s] between the fixes of a receiver that is an estimate by itself
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
    "outdoors, late GNSS": (OUTDOORS, ("GNSS: late",), 8),
    "outdoors, late GNSS with speed": (OUTDOORS, ("GNSS and speed: late",), 8),
    "indoors, fixes every 30 s": (INDOORS, ("user fixes",), 8),
    "indoors, start, compass, plan": (INDOORS, ("start", "plan"), 8),
    "indoors, GNSS, beacons": (INDOORS, ("GNSS", "beacons"), 6),
}
SEEDS = (0, 0, 0, 0, 1, 2, 3)  # thousands of the seeds of each: outdoors the walks are the same
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
            found.append([score for one in waiting if (score := one.result()) is not None])
            print(f"{group.title}: {len(found[-1])} walks, {time.time() - began:.0f} s", file=sys.stderr, flush=True)
    return found


def score_case(make):
    """The score of one walk; None for one that lacks what is to be given."""
    warnings.simplefilter("ignore")
    walk = make()
    return None if walk is None else score_of(walk, followed(walk), smoothed(walk).trajectory)


def accuracy_row(group, score, walks):
    """Cells of the first table; those that miss a target are bold."""
    pose, filtered, lag, batch = (said(score.errors[name]) for name in ("pose", "filter", "lag", "batch"))
    share = marked(f"{100 * coverage(score):.0f} %", coverage(score) < LEAST_COVERAGE)
    beside = marked(f"{ratio(score):.2f}", ratio(score) > MOST_RATIO)
    return [
        group.name,
        group.given,
        walks,
        len(score.inside),
        pose,
        filtered,
        beside,
        share,
        *by_receiver(score),
        lag,
        batch,
    ]


def by_receiver(score):
    """The receiver's errors, and the pose's in them in the median and at 95 %; dashes without a receiver."""
    if np.isnan(score.errors["receiver"]).any():
        return "—", "—"
    both = np.divide(*(np.percentile(score.errors[name], (50, 95)) for name in ("pose", "receiver")))
    return said(score.errors["receiver"]), marked(" / ".join(f"{r:.2f}" for r in both), (both > MOST_OF_RECEIVER).any())


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


# Walks


@dataclass(frozen=True)
class Group:
    """A row of the table. cases: functions that return a walk each, or None."""

    name: str
    given: str
    cases: tuple

    @property
    def title(self):
        """By which the row is chosen."""
        return f"{self.name}: {self.given}"


HELP = {  # of the bench, and how the tables call it
    "every second": "every second waypoint",
    "first and last": "first and last",
    "first": "first only",
}
GNSS = {"recorded, no beacons": "GNSS", "recorded": "GNSS, beacons"}


def groups(data, walks, first):
    """All rows. walks: number of simulated ones in each, None for the usual; first: seed of the first."""
    return [*recorded_groups(data), *simulated_groups(walks, first)]


def recorded_groups(data):
    """Rows of real recordings."""
    for what, name in HELP.items():
        for plan in (", plan", ""):
            cases = [partial(recorded, data, "microsoft", each, what + plan) for each in recordings(data, "microsoft")]
            yield Group("Microsoft", name + plan, tuple(cases))
    for name, each, what in eights(data):
        yield Group("IPIN21, eight", name, (partial(recorded, data, "ipin21", each, what),))
    for each in recordings(data, "ipin2023"):
        for what, name in GNSS.items():
            yield Group(each, name, (partial(recorded, data, "ipin2023", each, what),))
    museum = [partial(recorded, data, "museum", each, "recorded, no beacons") for each in recordings(data, "museum")]
    yield Group("museum, ten logs", "GNSS", tuple(museum))
    for what in THINNED:
        yield Group("NJU campus", what, (partial(recorded, data, "nju", "campus", what),))
    yield Group("NJU campus", "late GNSS", tuple(partial(beside_its_gps, data, seed) for seed in range(4)))


def eights(data):
    """Rows of IPIN21's figure of eight with its track as truth: name of the row, walk, what it is given."""
    sets = [name for name in recordings(data, "ipin21") if name != "landmarks"]
    for name, each, what in [("the start, alone", sets[0], "first"), *((each, each, "recorded") for each in sets)]:
        for plan in ("", ", plan"):
            yield name + plan, each, what + plan


def recorded(data, of, name, what):
    """A walk of the bench that is given something; None if it lacks it."""
    walk = given(recordings(data, of)[name], what)
    if walk is None:
        return None
    return with_course(with_steps(walk)) if of == "ipin21" else with_steps(walk)


def beside_its_gps(data, seed):
    """The campus walk, whose GPS is its truth, with a simulated receiver."""
    [walk] = recordings(data, "nju").values()
    fixes = walk.evidence.fixes
    truth = Trajectory(fixes.time, fixes.position, np.full(len(fixes), np.nan))
    fixes = gnss_fixes(truth, LATE_RECEIVER, np.random.default_rng(seed)).fixes
    evidence = replace(walk.evidence, fixes=replace(fixes, source=("GNSS",) * len(fixes)))
    return with_steps(replace(walk, evidence=evidence, truth=truth))


def with_course(walk):
    """A walk of a dense truth, with the direction of the way from 1 s before each place to 1 s after; NaN where it
    stands.
    """
    truth = walk.truth
    before, after = (
        np.stack([np.interp(truth.time + by, truth.time, v) for v in truth.position.T], 1)
        for by in (-COURSE_TIME, COURSE_TIME)
    )
    way = after - before
    course = np.arctan2(way[:, 1], way[:, 0])
    course[np.hypot(*way.T) <= 2 * COURSE_TIME * LEAST_SPEED] = np.nan
    return replace(walk, truth=replace(truth, heading=course))


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
    walk = simulated_walk(setting, seed)
    return BenchWalk(measured(walk, sources), walk.truth)


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
    return simulated_recording(Scenario.of(content | {"route": [*route, {"stand": 3.0}]}), content.get("plan"))


def of_scenario(name):
    """A walk through a drawn building, with its plan, fixes and beacons."""
    path = scenario_file(name)
    content = tomllib.loads(path.read_text()) | SCENARIO_FILES[name]
    scenario = Scenario.of(content, path)
    return simulated_recording(scenario, scenario.plan)


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

    def _log_steps(self, steps, *more):
        self.chunks.append(steps)
        self.walked += float(steps.length.sum())
        self._append(steps, *more)

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


def followed(walk):
    """The run of a walk; the pose is asked for after each packet of acceleration, or each step."""
    evidence = walk.evidence
    kind = partial(LoggingNavigator, epoch=evidence.walk.epoch, executor=None)
    nav, asks, taken = navigator_of(evidence.options, evidence, kind)(), [], np.zeros(2)
    arriving = events_within(evidence)[0] if evidence.walk.signals else list(events(evidence))
    gc.collect()
    gc.freeze()  # otherwise a full garbage collection takes 30 ms of some step
    for event in arriving:
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


def score_of(walk, run, batch):
    """The score of a run. batch: the trajectory of the whole walk at once."""
    cpu, empty, evidence = np.array([ask.cpu for ask in run.asks]), np.empty(0), walk.evidence
    if not run.shown:
        never = np.inf
        errors = {name: empty for name in ("pose", "filter", "receiver", "lag", "batch")}
        return WalkScore(errors, empty, never, never, never, empty, empty, empty, cpu)
    truth, causal = walk.truth, run.causal
    begin = min((float(signal.time[0]) for signal in evidence.walk.signals.values()), default=evidence.steps.start)
    errors, inside = errors_of(walk, run, batch)
    return WalkScore(
        errors=errors,
        inside=inside,
        first=run.shown[0].time - begin,
        near=time_to_near(causal, truth) - begin,
        pointed=time_to_pointed(causal, truth) - begin,
        jumps=by_minute(run.shown, jumps(run)),
        outside=outside(causal.position, evidence.building),
        jitter=jitter(run.shown, standing(truth)),
        cpu=cpu,
    )


def errors_of(walk, run, batch):
    """Errors by estimate where all have one ``(n,)`` [m], and whether the truth is in the pose's 90 % region."""
    truth, tracks = walk.truth, {"pose": run.causal, "lag": run.smoothed, "batch": batch}
    scores = {name: places(track, truth, walk.noise) for name, track in tracks.items()}
    errors = {name: score[0] for name, score in scores.items()}
    errors["filter"] = np.hypot(*(run.filtered(truth.time) - truth.position).T)
    receiver = receiver_errors(walk.evidence.fixes, truth)
    known = np.isfinite(list(errors.values())).all(axis=0) & (np.isfinite(receiver) | np.isnan(receiver).all())
    errors["receiver"] = receiver
    return {name: values[known] for name, values in errors.items()}, scores["pose"][1][known] == 1


def receiver_errors(fixes, truth):
    """Errors ``(n,)`` [m] of the last fix at each time of the truth; NaN if no receiver states its position often."""
    if not any(fixes.source) or np.median(np.diff(fixes.time)) > OFTEN:
        return np.full(len(truth), np.nan)
    last = np.searchsorted(fixes.time, truth.time, side="right") - 1
    return np.where(last >= 0, np.hypot(*(fixes.position[last] - truth.position).T), np.nan)


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


def outside(place, building):
    """Whether each place ``(n, 2)`` is outside the walkable area; empty without a plan."""
    if building is None:
        return np.empty(0, dtype=bool)
    area = shapely.buffer(building.floors[0].walkable, ON_THE_EDGE)
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
