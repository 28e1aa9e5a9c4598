"""Replay of a recording as if it were live, with latency and memory: ``pdr-graph replay``."""

from __future__ import annotations

import gc
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import replace
from functools import cache, partial
from inspect import Parameter, signature
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from pdr_graph.apps.report.output_files import REPORT, write
from pdr_graph.apps.report.rerun_view import RerunView
from pdr_graph.errors import InputError, Stages, shows_progress
from pdr_graph.estimation.factors.fixes import duplicates
from pdr_graph.estimation.results import outside_warnings
from pdr_graph.estimation.verdict import missing_of
from pdr_graph.floor.plan_files import plan_fingerprint
from pdr_graph.gait.step_counter import one_by_one
from pdr_graph.gait.steps import gait_signals
from pdr_graph.inertial.units import SURE_ODDS
from pdr_graph.io.tables import beside, read_beacons
from pdr_graph.io.writers import write_summary, write_trajectory
from pdr_graph.online.filter_beside import disagree
from pdr_graph.online.interface import NO_DATA, NO_STEPS, Event, LiveEstimator, Pose, events_of, trajectory_of
from pdr_graph.online.journal import Journal
from pdr_graph.options import LIVE, Options
from pdr_graph.plausibility import check_beacons_on_plan
from pdr_graph.priors import FIXES
from pdr_graph.storage import fingerprint
from pdr_graph.types import OUTSIDE, Fixes, FixReport, Trajectory
from pdr_graph.walk import (
    Evidence,
    Result,
    beacons_on_plan,
    fixes_alone,
    read,
    read_plan,
    read_radio_map,
    without_acceleration,
)
from pdr_graph.whole_files import output_folder

if TYPE_CHECKING:
    from pdr_graph.floor.building import Building
    from pdr_graph.floor.paths import PathNetwork

PERCENTILES = {"median": 50.0, "p95": 95.0, "p99": 99.0, "p99.9": 99.9, "max": 100.0}
MEMORY_INTERVAL = 50.0  # [s] of the walk between measurements of the memory, doubled at MOST_MEASUREMENTS
MOST_MEASUREMENTS = 200
MEGABYTE = 1e6
Value = TypeVar("Value")


class Latency:
    """Computing time per step [s]: pushing: of all events since the step before; posing: of the current pose."""

    def __init__(self) -> None:
        self.pushing, self.posing = list[float](), list[float]()
        self.memory = list[tuple[float, float]]()  # time of the walk [s], resident [MB]
        self._since, self._every = 0.0, MEMORY_INTERVAL

    def push(self, push: Callable[[Any], None], event: Any) -> None:
        """Call ``push`` with an event; its time counts for the next step."""
        began = time.perf_counter()
        push(event)
        self._since += time.perf_counter() - began

    def step(self, pose: Callable[[], Value]) -> Value:
        """Call ``pose`` and close the times of this step."""
        began = time.perf_counter()
        current = pose()
        self.posing.append(time.perf_counter() - began)
        self.pushing.append(self._since)
        self._since = 0.0
        return current

    def measure_memory(self, now: float) -> None:
        """Measure the memory if it is due. now: time of the walk [s]."""
        if _process() is None:
            return
        if not self.memory or now >= self.memory[-1][0] + self._every:
            self.memory.append((round(now, 1), round(_process().memory_info().rss / MEGABYTE, 2)))
        if len(self.memory) > MOST_MEASUREMENTS:
            self.memory, self._every = self.memory[::2], 2 * self._every

    def describe(self) -> dict[str, Any]:
        """The content of ``latency.json``: milliseconds per step, megabytes."""
        return {
            "steps": len(self.pushing),
            "push": _spread(self.pushing),
            "pose": _spread(self.posing),
            "peak_memory": None if (peak := _peak_memory()) is None else round(peak / MEGABYTE, 2),
            "memory": [{"time": now, "resident": resident} for now, resident in self.memory],
            "units": {"push": "ms per step", "pose": "ms per step", "memory": "MB", "time": "s"},
        }


@cache
def _process() -> Any:
    """The present process, of psutil, which measures its memory; None where psutil does not load."""
    with suppress(ImportError):
        import psutil

        return psutil.Process()
    return None


def _peak_memory() -> float | None:
    """The most memory that this process had at any time [bytes]; None where nothing measures it."""
    try:
        import resource
    except ImportError:  # Windows
        return getattr(_process() and _process().memory_info(), "peak_wset", None)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def _spread(seconds: list[float]) -> dict[str, float] | None:
    if not seconds:
        return None
    values = np.percentile(1000 * np.array(seconds), list(PERCENTILES.values()))
    return {name: round(value, 4) for name, value in zip(PERCENTILES, values.tolist(), strict=True)}


def replay_recording(
    recording: Path,
    out: Path,
    options: Options | None = None,
    kind: Any = None,
    report: bool = True,
    rerun: Path | None = None,
) -> tuple[str, ...]:
    """Push a recording through a navigator; write poses, latency, smoothed trajectory, picture, report and summary.

    kind: class of the navigator, by default ``Navigator``; report: False writes everything else, and removes the report
    of an earlier walk from ``out``; rerun: file ``.rrd`` of Rerun, which its viewer follows.
    Returns what could not be estimated or written, a line each.
    Raises InputError if an input cannot be used.
    """
    options = replace(options or Options(), method=LIVE)
    stage, latency = Stages(), Latency()
    with stage("reading"):
        evidence = read(recording, options)
        events, outside = events_within(evidence)
    with output_folder(out, without=() if report else (REPORT,)) as staged:
        with stage("opening"):
            nav = _opened(evidence, len(events), kind)
        gc.freeze()  # otherwise a full garbage collection takes 60 ms of some push
        with nav if isinstance(nav, Journal) else nullcontext():
            done = nav.count if isinstance(nav, Journal) else 0
            began = time.perf_counter()
            shown: Iterable[Event] = events[done:]
            if shows_progress():
                from rich.console import Console
                from rich.progress import track

                shown = track(events[done:], "replay", console=Console(stderr=True))
            view = None if rerun is None else RerunView(rerun, evidence.building, evidence.other_fixes)
            beside = list[tuple[Pose, Pose]]()
            causal = walked(nav, shown, latency, None if view is None else partial(view.show, nav), beside)
            stage.seconds["replay"] = round(time.perf_counter() - began, 4)
            with stage("finish"):
                result = _finished(nav, evidence, outside)
        if view is not None:
            view.path(result.estimate.trajectory)
            view.close()
        write_trajectory(staged / "causal.csv", causal, evidence.walk.clock_origin)
        filtered = trajectory_of([pose for _, pose in beside])
        write_trajectory(staged / "filtered.csv", filtered, evidence.walk.clock_origin)
        write_summary(staged / "latency.json", latency.describe())
        begins = "causal.csv, filtered.csv and latency.json begin after them"
        issues = *result.issues, *((f"{done} events were in the journal: {begins}",) if done else ())
        live = causal if len(causal) else None
        result = replace(result, issues=issues, live=live, beside=disagreement(beside))
        return write(staged, result, stage, report)


def events_within(evidence: Evidence) -> tuple[list[Event], Fixes]:
    """Events of a walk in the order of arrival; and the fixes that are none, from too long before or after the
    recording. Steps are events where a counter measured them, not where samples show them.
    """
    walk, fixes = evidence.walk, evidence.other_fixes
    counted = None if walk.has_acceleration else evidence.steps
    start = min((float(signal.time[0]) for signal in walk.signals.values()), default=-np.inf)
    end = max((float(signal.time[-1]) for signal in walk.signals.values()), default=np.inf)
    outside = (fixes.time < start - FIXES.longest_overhang) | (fixes.time > end + FIXES.longest_overhang)
    tables = (*walk.measurements, *(() if counted is None else one_by_one(counted)))
    return list(events_of(replace(walk, fixes=fixes[~outside], measurements=tables))), fixes[outside]


def navigator_of(options: Options, evidence: Evidence | None = None, kind: Any = None) -> partial[Any]:
    """What creates the navigator of a walk. evidence: of a recorded walk; without it the walk is still to come.

    kind: class of the navigator, by default ``Navigator``. Raises InputError if a file cannot be used.
    """
    if evidence is not None:
        known = {"floor": evidence.building, "walker": evidence.walker, "frame": evidence.frame}
        known |= {"beacons": evidence.beacons, "radio_map": evidence.radio_map}
        known |= {} if evidence.paths is None else {"paths": evidence.paths}
        odds = evidence.walk.sign_odds
        if odds is not None and odds <= -SURE_ODDS and (kind is None or takes(kind, "platform")):
            known["platform"] = "android"  # whose sign the reader converts to
        if evidence.start_heading is not None:  # another class of navigator need not have it
            known["start_heading"] = evidence.start_heading
    else:
        building = read_plan(options)
        beacons = read_beacons(options.beacons) if options.beacons else beacons_on_plan(building)
        if building and options.beacons and beacons:
            check_beacons_on_plan(options.beacons, beacons, building)
        known = {"floor": building, "walker": options.person(), "beacons": beacons}
        known["radio_map"] = read_radio_map(options, building)
        known |= {} if options.paths is None else {"paths": _paths(options.paths, building)}
    if kind is None:
        from pdr_graph.online.navigator import Navigator

        kind = Navigator
    return partial(kind, **known, lag=options.lag, start_floor=options.floor)


def takes(kind: Callable[..., Any], name: str) -> bool:
    """True if a class of navigators has an argument of a name."""
    arguments = signature(kind).parameters
    return name in arguments or any(argument.kind is Parameter.VAR_KEYWORD for argument in arguments.values())


def _paths(path: Path, building: Building | None) -> PathNetwork:
    """The ways of a file for a walk still to come. Raises InputError for a plan that is not on the map."""
    from pdr_graph.floor.paths import PathNetwork  # with the readers of its formats

    if building is not None and not building.floors[0].frame.georeferenced:
        raise InputError(path, "", "a plan without latitude and longitude beside it", "a plan with them, or ways alone")
    return PathNetwork.load(path)


def _opened(evidence: Evidence, events: int, kind: Any) -> Any:
    """The navigator of a walk, new or resumed from the journal if the options name one."""
    options = evidence.options
    create = navigator_of(options, evidence, kind)
    if options.journal is None:
        return create()
    recording = evidence.walk.source
    files = {"fixes": options.fixes, "walker file": options.walker, "list beside it": beside(Path(recording))}
    settings = {"recording": recording, "events": events, "walker": evidence.walker.describe()}
    settings |= journal_settings(options, files) | {"recorded_fixes": options.recorded_fixes}
    settings |= {} if options.start_heading is None else {"start_heading": options.start_heading}
    return Journal.open(options.journal, create, settings)


def journal_settings(options: Options, files: Mapping[str, Path | None]) -> dict[str, Any]:
    """What must not change while a journal is continued: fingerprints of input files, lag and floor.

    files: further ones beside plan, beacons and radio map, by name.
    """
    files = {"beacons": options.beacons, "radio_map": options.radio_map, "paths": options.paths, **files}
    settings = {name: fingerprint(path) for name, path in files.items() if path}
    settings |= {"map": plan_fingerprint(options.plan, options.scale)} if options.plan else {}
    return settings | {"lag": options.lag, "floor": options.floor}


def walked(
    nav: LiveEstimator,
    events: Iterable[Event],
    latency: Latency,
    show: Callable[[Pose], None] | None = None,
    beside: list[tuple[Pose, Pose]] | None = None,
) -> Trajectory:
    """Push all events; returns the causal poses: the first, one at the detection of each step, and the last.

    show: called with each; beside: gets each with the pose of the filter, where the navigator has one. Between events
    the estimator reviews, as an app does beside the walk; that is not part of the latency.
    """
    poses, most = list[Pose](), nav.steps

    def add(pose: Pose) -> None:
        poses.append(pose)
        filtered = getattr(nav, "filtered", None)  # another class of navigator need not have it
        if beside is not None and filtered is not None:
            beside.append((pose, filtered))
        if show is not None:
            show(pose)

    for event in events:
        latency.push(nav.push, event)
        nav.review()
        pose = None
        if nav.steps > most:  # a maximum, since provisional steps may be withdrawn
            most = nav.steps
            pose = latency.step(lambda: nav.pose)
        elif not poses:
            pose = nav.pose
        if pose is not None:
            add(pose)
            latency.measure_memory(pose.time)
    last = nav.pose
    if last is not None and poses and last.time > poses[-1].time:
        add(last)
    return trajectory_of(poses)


def disagreement(beside: Sequence[tuple[Pose, Pose]]) -> dict[str, int]:
    """Numbers of poses of the filter, and of those that disagree with the current pose, see `filter_beside`."""
    apart = [
        disagree(np.array([pose.x, pose.y]), pose.covariance[:2, :2], np.array([by.x, by.y]), by.covariance[:2, :2])
        for pose, by in beside
        if pose.placed
    ]
    return {"poses": len(beside), "disagree": sum(apart)}


def _finished(nav: LiveEstimator, evidence: Evidence, outside: Fixes) -> Result:
    """The smoothed walk with what could not be estimated; the smoothed fixes alone if there are no steps.

    outside: fixes that were not pushed since they lie outside the recording. Raises InputError if there are neither
    steps nor fixes, or if the samples cannot be used.
    """
    estimate, steps, status = nav.finish(), nav.steps, nav.status
    issues = tuple(line for line in status.issues if not line.endswith((NO_DATA, NO_STEPS)))
    if not len(estimate.trajectory):
        if evidence.walk.has_acceleration or not len(evidence.fixes):
            gait_signals(evidence.walk)
        if not len(evidence.fixes):
            expected = "accelerometer samples of a second or more"
            raise InputError(evidence.walk.source, "", "neither steps nor fixes", expected)
        return fixes_alone(evidence, issues)
    late = outside.time[~duplicates(outside)]
    issues += outside_warnings(late, float(estimate.trajectory.time[0]), float(estimate.trajectory.time[-1]))
    reports = [
        FixReport(t, x, y, sigma, float("nan"), 0.0, OUTSIDE, source)
        for t, (x, y), sigma, source in zip(
            outside.time, outside.position.tolist(), outside.sigma.tolist(), outside.source, strict=True
        )
    ]
    fixes = tuple(sorted((*estimate.fixes, *reports), key=lambda fix: fix.time)) if reports else estimate.fixes
    estimate = replace(estimate, reports={**estimate.reports, "fixes": fixes})
    missing = (*status.unknown, *without_acceleration(evidence.walk), *missing_of(estimate, len(evidence.fixes)))
    return Result(evidence, estimate, missing, step_count=steps, issues=issues)
