"""The pipeline of one walk: observe, estimate; and what a walk along a known line, or several walks, teach."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pdr_graph.contradiction import OK, Contradiction
from pdr_graph.errors import InputError, one_line
from pdr_graph.estimation.ambiguity.plan_hypotheses import begun_on
from pdr_graph.estimation.calibration import calibrate, prior_of
from pdr_graph.estimation.factors.beacon_rssi import levels_along
from pdr_graph.estimation.factors.heading_prior import START, heading_reports
from pdr_graph.estimation.floors import Floors, floors_along
from pdr_graph.estimation.gps_track import follow
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.kalman import kalman_filter, kalman_smoother
from pdr_graph.estimation.results import FIRST_ONLY, POSITIONS_ALONE, missing_of
from pdr_graph.estimation.smoother import estimated, smooth
from pdr_graph.floor.building import Building
from pdr_graph.floor.plan_files import read_route
from pdr_graph.gait.compass import magnetic_headings
from pdr_graph.gait.steps import detect_steps, gait_signals
from pdr_graph.gait.walker import Profile, Walker
from pdr_graph.geometry import interpolate
from pdr_graph.inertial.barometer import with_stair_lengths
from pdr_graph.inputs import Inputs
from pdr_graph.io.loading import load
from pdr_graph.io.tables import read_trajectory
from pdr_graph.measurements import by_type
from pdr_graph.outputs import Result
from pdr_graph.plausibility import check_floors
from pdr_graph.priors import INITIAL
from pdr_graph.types import Beacons, Estimate, Fixes, FixReport, Headings, Sightings, Signal, Steps, Trajectory
from pdr_graph.walk_options import Options
from pdr_graph.whole_files import write_file

if TYPE_CHECKING:
    from pdr_graph.estimation.fingerprinting import RadioMap

OPEN = "the direction of dead reckoning from one fix is open"
SMOOTHED = ("graph", "rts")  # methods whose report also shows the causal filter
NO_ACCELEROMETER = "steps: there is no accelerometer, so that this is the fixes alone, smoothed"


@dataclass(frozen=True)
class Evidence:
    """All measurements of one walk, in one frame.

    steps: None without an accelerometer; floors: of every step, None if unknown; measurements: tables of any other
    kinds; profile: of the walker, which has already corrected the steps; others: the same walk begun on other floors,
    if nothing says on which.
    """

    steps: Steps | None
    fixes: Fixes
    headings: Headings = field(default_factory=Headings.none)
    building: Building | None = None
    floors: Floors | None = None
    measurements: tuple[Any, ...] = ()
    profile: Profile | None = None
    others: tuple[Evidence, ...] = ()

    def graph(self) -> WalkGraph | None:
        """Build the factor graph of the walk; None without steps."""
        if self.steps is None:
            return None
        return WalkGraph(
            self.steps,
            self.fixes,
            headings=self.headings,
            floor=self.building,
            floors=self.floors.labels if self.floors else None,
            measurements=self.measurements,
            prior=prior_of(self.profile),
        )


def observe(inputs: Inputs, options: Options | None = None) -> Evidence:
    """Detect steps, headings, floors and beacon levels; no steps if the walk has fixes but no accelerometer.

    Raises InputError if there are neither steps nor fixes, or if the floor of the walk is unknown.
    """
    options, walk = options or Options(), inputs.walk
    steps, headings = None, Headings.none()
    if walk.has_acceleration or not len(inputs.fixes):
        gaits = gait_signals(walk)
        steps = detect_steps(gaits, inputs.walker)
        headings = magnetic_headings(gaits, inputs.frame, inputs.near)
        if inputs.start_heading is not None and len(steps):
            row = (steps.time[:1], np.array([inputs.start_heading]), np.array([INITIAL.heading_sigma]), (START,))
            headings = Headings.concatenate([Headings(*row), headings])
    evidence = Evidence(steps, inputs.fixes, headings, inputs.building, profile=inputs.walker.profile)
    evidence = with_measurements(evidence, walk.measurements)
    evidence = with_floors(evidence, walk.barometer, options.floor, options.plan)
    return with_beacon_levels(evidence, walk.bluetooth, inputs.beacons)


def with_measurements(evidence: Evidence, tables: Sequence[Any]) -> Evidence:
    """Add tables of measurements of any kinds, those of one kind as one table; headings join the compass headings."""
    headings = [table for table in tables if isinstance(table, Headings)]
    others = [table for table in tables if not isinstance(table, Headings)]
    return replace(
        evidence,
        headings=Headings.concatenate([evidence.headings, *headings]) if headings else evidence.headings,
        measurements=by_type((*evidence.measurements, *others)),
    )


def with_floors(evidence: Evidence, barometer: Signal | None, start_floor: str | None, plan: Path | None) -> Evidence:
    """Estimate the floor of every step by barometer and fixes, and shorten the steps on stairs to the treads.

    start_floor: label of the floor where the walk began, or None; plan: for messages. Raises InputError if the building
    has no such floor, or if it has several and that of the walk is unknown.
    """
    building, steps, fixes = evidence.building, evidence.steps, evidence.fixes
    if building is not None:
        check_floors(plan or Path("--map"), building, start_floor)
    if steps is None:
        return evidence
    only = building.labels[0] if building is not None and len(building.labels) == 1 else ""
    start = only or start_floor or next((label for label in fixes.floor if label), "")
    begun = [_begun_on(evidence, steps, barometer, start)]
    if building is not None and not start and not len(fixes) and not evidence.measurements:
        every = {label: _begun_on(evidence, steps, barometer, label) for label in building.labels}
        begun = [one for label, one in every.items() if one.floors and one.floors.labels[0] == label] or begun
    floors = begun[0].floors
    if building is not None and len(building.labels) > 1 and (floors is None or not all(floors.labels)):
        several = f"{len(building.labels)} floors, {', '.join(building.labels)[:80]}"
        raise InputError(plan or "--map", "", several, "--floor, the label of the one on which the walk begins")
    return replace(begun[0], others=tuple(begun[1:]))


def _begun_on(evidence: Evidence, steps: Steps, barometer: Signal | None, start: str) -> Evidence:
    """The walk with the floor of every step, if it began on the one with the label ``start``."""
    floors = floors_along(steps, barometer, start, evidence.fixes, evidence.building)
    return replace(evidence, steps=with_stair_lengths(steps, floors.climbs, floors.kinds), floors=floors)


def with_beacon_levels(evidence: Evidence, heard: Sightings | None, beacons: Beacons | None) -> Evidence:
    """Add the mean levels of surveyed beacons along the walk; beacons: in its frame."""
    if evidence.steps is None or heard is None or beacons is None:
        return evidence
    levels = levels_along(heard, beacons, evidence.steps)
    return replace(evidence, measurements=(levels, *evidence.measurements))


def estimate(evidence: Evidence, method: str = "graph") -> Result:
    """Estimate the walk by ``graph``, ``filter``, ``rts`` or ``pdr``; without steps, smooth the fixes alone."""
    graph, found = evidence.graph(), None
    if graph is None:
        return Result(follow(evidence.fixes), (NO_ACCELEROMETER,))
    if evidence.others:
        possible = {graph: evidence, **{other.graph(): other for other in evidence.others}}
        graph, found = begun_on([graph for graph in possible if graph is not None])
        evidence = possible[graph]
    failed, walk = (), None
    if method == "graph":
        try:
            walk = smooth(graph) if found is None else estimated(graph, found)
        except RuntimeError as error:  # by GTSAM, for a system that it cannot solve
            failed = (f"the graph ({str(error).splitlines()[0]}): this is the filter's walk",)
    elif method == "pdr":
        walk = _dead_reckoned(graph)
    elif method == "rts":
        walk = kalman_smoother(graph)
    walk = walk or kalman_filter(graph)
    if "headings" not in walk.reports:
        walk = _with_headings(walk, graph.headings.headings)
    missing = failed or (() if method == "pdr" else missing_of(walk, len(evidence.fixes)))
    return Result(
        estimate=walk,
        missing=(*graph.steps.unknown, *missing),
        graph=graph,
        steps=graph.steps,
        floors=evidence.floors,
        profile=evidence.profile,
        causal=partial(_filter_track, graph) if method in SMOOTHED else None,
    )


def causal_tracks(evidence: Evidence, method: str) -> Mapping[str, Trajectory] | None:
    """The causal tracks of the result of `estimate` by name; None if they are not known before it."""
    graph = evidence.graph()
    if graph is None or method not in SMOOTHED:
        return {}
    return None if evidence.others else _filter_track(graph)


def positions_alone(fixes: Fixes) -> Result:
    """Smooth the fixes of a recording without any sensor, as of a GPX track: all that it has, so nothing is missing."""
    return Result(follow(fixes), issues=(POSITIONS_ALONE,))


def _filter_track(graph: WalkGraph) -> Mapping[str, Trajectory]:
    """The causal filter's track, which the report shows beside a smoothed estimate; it needs a position to begin at."""
    return {} if graph.unplaced else {"filter": kalman_filter(graph).trajectory}


def _with_headings(walk: Estimate, headings: Headings) -> Estimate:
    """Report the residuals of headings along an estimate that does not report them itself."""
    track = walk.trajectory
    heading = np.interp(headings.time, track.time, np.unwrap(track.heading))
    reports = heading_reports(headings, heading, np.ones(len(headings)))
    return replace(walk, reports={**walk.reports, "headings": reports})


def _dead_reckoned(graph: WalkGraph) -> Estimate:
    """Dead reckoning through the first fix, neither rotated nor scaled: the graph with that fix alone."""
    used, fixes = graph.positions.used, graph.positions.fixes
    first = int(np.argmax(used)) if used.any() else 0
    alone = smooth(WalkGraph(graph.steps, fixes[first : first + 1], prior=graph.prior))
    track = alone.trajectory
    at = interpolate(fixes.time, track.time, track.position)
    distance = np.hypot(*(fixes.position - at).T)
    reports = [
        FixReport(t, x, y, sigma, d, 0.0, FIRST_ONLY)
        for t, (x, y), sigma, d in zip(
            fixes.time.tolist(), fixes.position.tolist(), fixes.sigma.tolist(), distance.tolist(), strict=True
        )
    ]
    reports[first : first + 1] = alone.fixes
    track = replace(track, floor=graph.floors)
    direction = Contradiction("route", "other directions", 2 * np.pi, "rad", OPEN, "--method graph uses all fixes")
    found = (*alone.contradictions, direction)
    reports_of_kinds = {"fixes": tuple(reports)}
    return replace(alone, trajectory=track, reports=reports_of_kinds, probability=float("nan"), contradictions=found)


def calibrate_walker(recording: Path, route: Path, out: Path, walker: Walker | None = None) -> tuple[Profile, int]:
    """Write the profile of a walker who followed a known line to ``out``, with a picture beside it.

    Returns the profile and the number of laps. Raises InputError if an input cannot be used.
    """
    from pdr_graph.plotting import picture_bytes, plot

    walk, person = load(recording), walker or Walker()
    if walk.gyroscope is None:
        raise InputError(recording, "gyroscope", "no samples", "its turns, to tell them from the route's")
    steps = detect_steps(walk, replace(person, profile=None))
    line = read_route(route)
    profile, estimate, laps = calibrate(steps, line, walk.source)
    reference = Trajectory(np.arange(float(len(line))), line, np.zeros(len(line)), ("",) * len(line))
    title = f"{walk.source} along {route.name}   {profile.residual:.2f} m from it (rms)"
    picture = picture_bytes(plot(replace(estimate, reports={}), truth=reference, title=title))
    write_file(out.with_suffix(".png"), picture)
    replace(person, profile=profile).save(out, f"{walk.source} along {route.name}, {laps} times")
    return profile, laps


def learn_radio_map(walks: Sequence[tuple[Path, Path]], out: Path) -> RadioMap:
    """Write a radio map of recordings to ``out``; walks: each recording with the output folder of ``pdr-graph smooth``.

    Raises InputError if an input cannot be used, or if the walks are not all in one frame.
    """
    from pdr_graph.estimation.fingerprinting import RadioMap  # it takes scipy.optimize, long to import

    learnt, frames = [], []
    for recording, folder in walks:
        walk, track = load(recording), read_trajectory(folder / "trajectory.csv")
        track = replace(track, time=track.time - walk.clock_origin)
        if track.time[-1] < 0 or track.time[0] > max(s.time[-1] for s in walk.signals.values()):
            raise InputError(folder, "trajectory.csv", "times of another walk", f"those of {walk.source}")
        learnt.append((track, walk))
        frames.append(_frame_of(folder / "summary.json"))
        if frames[-1] != frames[0]:
            raise InputError(folder, "frame", f"{frames[-1]}", f"that of {walks[0][1]}, {frames[0]}: one plan for all")
    try:
        radio_map = RadioMap.learn(learnt, frames[0])
    except ValueError as error:
        raise InputError(out, "", str(error).removeprefix("found "), "more walks or longer ones") from None
    radio_map.save(out)
    return radio_map


def _frame_of(summary: Path) -> dict[str, Any]:
    """The frame of a smoothed walk. Raises InputError if it has none, or if the walk is not to be trusted."""
    try:
        content = json.loads(summary.read_text(encoding="utf-8"))
        frame, judged = content["frame"], content.get("verdict", {}).get("state", OK)
    except (ValueError, KeyError, TypeError, AttributeError):
        frame, judged = None, OK
    if judged != OK:
        raise InputError(
            summary, "verdict", one_line(f"{judged}"), "walks that are ok: a radio map is as wrong as they"
        )
    if not isinstance(frame, dict):
        raise InputError(summary, "frame", "none", "the frame of a walk, as pdr-graph smooth writes it")
    return frame
