"""One walk from files to files: what ``pdr-graph smooth`` does, stage by stage."""

from __future__ import annotations

import json
import platform
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pdr_graph import io
from pdr_graph.errors import InputError
from pdr_graph.estimation.beacons import Levels, levels
from pdr_graph.estimation.closures import Closures
from pdr_graph.estimation.filters import kalman_filter
from pdr_graph.estimation.fixes_alone import follow
from pdr_graph.estimation.floors import Floors, floors_along
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.profiles import posterior_profile, prior_of
from pdr_graph.estimation.reports import is_a_guess
from pdr_graph.estimation.rts import kalman_smoother
from pdr_graph.estimation.smoothers import smooth
from pdr_graph.floor.building import Building
from pdr_graph.floor.route import read_route
from pdr_graph.frames import Frame
from pdr_graph.gait.gait import gait_of
from pdr_graph.gait.heading import magnetic_headings
from pdr_graph.gait.pdr import detect_steps
from pdr_graph.gait.profile import Profile
from pdr_graph.gait.treads import on_treads
from pdr_graph.gait.walker import Walker
from pdr_graph.geometry import interpolate, resample, wrap_angle
from pdr_graph.inputs import Inputs, placed_beacons, read_inputs
from pdr_graph.io import gpx, writers
from pdr_graph.io.tables import read_trajectory
from pdr_graph.types import Estimate, Fixes, FixReport, Headings, Recording, Signal, Steps, Trajectory

if TYPE_CHECKING:
    from pdr_graph.estimation.radio_map import RadioMap

FASTEST_RATE = 1000.0  # [Hz]


@dataclass
class Stages:
    """Wall time of each stage [s]; on a terminal, the stage under way is shown."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Time one stage."""
        started = time.perf_counter()
        if sys.stderr.isatty():
            from rich.console import Console

            with Console(stderr=True).status(f"{name} …"):
                yield
        else:
            yield
        self.seconds[name] = round(time.perf_counter() - started, 4)


def smooth_recording(
    recording: Path,
    out: Path,
    plan: Path | None = None,
    fixes: Path | None = None,
    walker: Path | None = None,
    method: str = "graph",
    use_recorded_fixes: bool = True,
    rate: float | None = None,
    gnss_latency: float = 0.0,
    floor_label: str | None = None,
    beacons: Path | None = None,
    radio_map: Path | None = None,
    truth: Path | None = None,
) -> tuple[str, ...]:
    """Reconstruct one walk and write trajectory, picture, report and summary to ``out``.

    Arguments as of ``pdr-graph smooth``; truth: only drawn and scored. Returns what could not be estimated or written;
    empty if all went well. Raises InputError if an input cannot be used.
    """
    check_rate(rate)
    stage = Stages()

    with stage("reading"):
        given = read_inputs(recording, plan, fixes, walker, use_recorded_fixes, gnss_latency, beacons, radio_map)
        given = with_truth(given, truth)
    out.mkdir(parents=True, exist_ok=True)
    walk, known, building, frame, located = given.walk, given.walker, given.building, given.frame, given.fixes
    with stage("steps"):
        steps, headings = _observe(given)
        floors = floors_walked(walk.barometer, steps, located, building, floor_label, plan)
        if steps is not None and floors is not None:
            steps = on_treads(steps, floors.climbs, floors.kinds)
    with stage("estimate"):
        heard = _levels(walk, steps, frame, given.notes)
        graph = None if steps is None else walk_graph(steps, located, headings, building, floors, heard, known)
        estimate, missing = _estimate(graph, located, method)
    with stage("write"):
        missing += write_results(out, given, estimate, rate)
        if steps is not None and estimate.calibration is not None and estimate.calibration.learnt[-1, 0]:
            learnt = replace(known, profile=posterior_profile(estimate, steps, known.profile))
            learnt.save(out / "walker.toml", f"what {walk.source} taught of its walker, for --walker of the next walk")

    settings = {"method": method, "walker": known.describe(), "recorded_fixes": use_recorded_fixes, "rate": rate}
    settings |= {"gnss_latency": gnss_latency, "floor": floor_label}
    paths = {"map": plan, "fixes": fixes, "beacons": beacons, "radio_map": radio_map, "truth": truth}
    settings |= {name: str(path) if path else None for name, path in paths.items()}
    summary = summarize(walk, steps, headings, building, floors, frame, estimate)
    summary |= {"seconds": stage.seconds, "settings": settings, "missing": list(missing)}
    summary["warnings"] = [*given.notes, *estimate.warnings]
    with stage("report"):
        missing += write_report(out, given, estimate, summary, method, steps, partial(_filtered, graph, method))
        missing += unscored(truth, given, estimate)
    writers.write_summary(out / "summary.json", summary | {"missing": list(missing)})
    return missing


def _filtered(graph: WalkGraph | None, method: str) -> dict[str, Trajectory]:
    """The causal filter's track, for what had all of the walk before it to be seen beside."""
    return {"filter": kalman_filter(graph).trajectory} if graph is not None and method in ("graph", "rts") else {}


def check_rate(rate: float | None) -> None:
    """Raise InputError where a trajectory cannot be resampled so often."""
    if rate is not None and not 0 < rate <= FASTEST_RATE:
        raise InputError("--rate", "", f"{rate}", f"a rate above 0 and up to {FASTEST_RATE:.0f} Hz")


def calibrate_walker(recording: Path, route: Path, out: Path, walker: Path | None = None) -> tuple[Profile, int]:
    """The profile of a walker who followed a known line, written to ``out`` with a picture beside it; and how often
    round they went.

    Raises InputError if an input cannot be used.
    """
    from pdr_graph.estimation.calibration import calibrate  # it takes scipy.optimize, long to import
    from pdr_graph.plotting import plot

    walk, known = io.load(recording), Walker.load(walker) if walker else Walker()
    if walk.gyroscope is None:
        raise InputError(recording, "gyroscope", "no samples", "its turns, to tell them from the route's")
    steps = detect_steps(walk, replace(known, profile=None))
    line = read_route(route)
    profile, estimate, laps = calibrate(steps, line, walk.source)
    replace(known, profile=profile).save(out, f"{walk.source} along {route.name}, {laps} times")
    said = Trajectory(np.arange(float(len(line))), line, np.zeros(len(line)), ("",) * len(line))
    title = f"{walk.source} along {route.name}   {profile.residual:.2f} m from it (rms)"
    plot(replace(estimate, fixes=()), truth=said, title=title).savefig(out.with_suffix(".png"), dpi=120)
    return profile, laps


def learn_radio_map(walks: Sequence[tuple[Path, Path]], out: Path) -> RadioMap:
    """What recordings heard where, each with the folder that ``pdr-graph smooth`` wrote of it, written to ``out``.

    Raises InputError if an input cannot be used, or the walks are not all in one frame.
    """
    from pdr_graph.estimation.radio_map import RadioMap  # it takes scipy.optimize, long to import

    learnt, frames = [], []
    for recording, folder in walks:
        walk, track = io.load(recording), read_trajectory(folder / "trajectory.csv")
        track = replace(track, time=track.time - walk.clock_origin)
        if track.time[-1] < 0 or track.time[0] > max(s.time[-1] for s in walk.signals.values()):
            raise InputError(folder, "trajectory.csv", "times of another walk", f"those of {walk.source}")
        learnt.append((track, walk))
        frames.append(_frame_of(folder / "summary.json"))
        if frames[-1] != frames[0]:
            raise InputError(folder, "frame", f"{frames[-1]}", f"that of {walks[0][1]}, {frames[0]}: one plan for all")
    try:
        found = RadioMap.learn(learnt, frames[0])
    except ValueError as error:
        raise InputError(out, "", str(error).removeprefix("found "), "more walks or longer ones") from None
    found.save(out)
    return found


def _frame_of(summary: Path) -> dict[str, Any]:
    try:
        frame = json.loads(summary.read_text(encoding="utf-8"))["frame"]
    except (ValueError, KeyError, TypeError):
        frame = None
    if not isinstance(frame, dict):
        raise InputError(summary, "frame", "none", "the frame of a walk, as pdr-graph smooth writes it")
    return frame


def _observe(given: Inputs) -> tuple[Steps | None, Headings]:
    """Steps and headings; no steps where nothing recorded them and the fixes are all there is."""
    if len(given.fixes) and not given.walk.has_acceleration:
        return None, Headings.none()
    gaits = gait_of(given.walk)
    return detect_steps(gaits, given.walker), magnetic_headings(gaits, given.frame, given.near)


def floors_walked(
    barometer: Signal | None,
    steps: Steps | None,
    fixes: Fixes,
    building: Building | None,
    begins: str | None,
    plan: Path | None,
) -> Floors | None:
    """The floor of every step, by barometer and fixes, where it may change or is told; None without steps.

    begins: label of the floor where the walk began, if it is known; plan: for messages. Raises InputError if the
    building has no such floor, or several and nothing says on which the walk was.
    """
    if building is not None and len(building.labels) > 1 and begins is not None and begins not in building.labels:
        raise InputError(plan or "--map", "", f"the floors {', '.join(building.labels)[:80]}", f"a floor {begins!r}")
    if steps is None:
        return None
    only = building.labels[0] if building is not None and len(building.labels) == 1 else ""
    start = only or begins or next((label for label in fixes.floor if label), "")
    found = floors_along(steps, barometer, start, fixes, building)
    if building is not None and not all(found.labels):
        several = f"{len(building.labels)} floors, {', '.join(building.labels)[:80]}"
        raise InputError(plan or "--map", "", several, "--floor, the label of the one on which the walk begins")
    return found


def _levels(walk: Recording, steps: Steps | None, frame: Frame, notes: list[str]) -> Levels | None:
    """How loud the surveyed beacons were along the walk."""
    if steps is None or walk.bluetooth is None or (beacons := placed_beacons(walk, frame, notes)) is None:
        return None
    return levels(walk.bluetooth, beacons, steps)


def walk_graph(
    steps: Steps,
    fixes: Fixes,
    headings: Headings,
    building: Building | None,
    floors: Floors | None,
    heard: Levels | None,
    walker: Walker,
    closures: Closures | None = None,
) -> WalkGraph:
    """All that is known of one walk; steps as the walker's profile corrects them."""
    prior, labels = prior_of(walker.profile), floors.labels if floors else None
    return WalkGraph(
        steps, fixes, headings=headings, floor=building, floors=labels, levels=heard, closures=closures, prior=prior
    )


def _estimate(graph: WalkGraph | None, fixes: Fixes, method: str) -> tuple[Estimate, tuple[str, ...]]:
    """The walk by one method, and what of it could not be had; without a graph there are no steps."""
    if graph is None:
        return follow(fixes), ("steps: there is no accelerometer, so that this is the fixes alone, smoothed",)
    if method == "graph":
        estimate, missing = smoothed(graph)
    elif method == "pdr":
        estimate, missing = _dead_reckoned(graph), ()
    else:
        estimate = (kalman_filter if method == "filter" else kalman_smoother)(graph)
        missing = _unplaced(graph, estimate)
    return estimate, (*graph.steps.unknown, *missing)


def smoothed(graph: WalkGraph) -> tuple[Estimate, tuple[str, ...]]:
    """The most probable walk, the filter's where there is none; and what could not be had."""
    try:
        estimate = smooth(graph)
    except RuntimeError as error:  # GTSAM's, of a system it cannot solve
        return kalman_filter(graph), (f"the graph ({str(error).splitlines()[0]}): this is the filter's walk",)
    return estimate, (*_unplaced(graph, estimate), *(() if estimate.converged else ("a settled optimum",)))


def _unplaced(graph: WalkGraph, estimate: Estimate) -> tuple[str, ...]:
    """Whether there are fixes, and no place to be had from them."""
    if len(graph.fixes) and not graph.fix_used.any():
        return ("a place: no fix lies within the recording",)
    return ("a place: the fixes contradict the steps and one another",) if is_a_guess(graph, estimate.fixes) else ()


def _dead_reckoned(graph: WalkGraph) -> Estimate:
    """Dead reckoning through the first fix, turned and scaled by nothing: the graph of that fix alone."""
    first = int(np.argmax(graph.fix_used)) if graph.fix_used.any() else 0
    alone = smooth(WalkGraph(graph.steps, graph.fixes[first : first + 1], prior=graph.prior))
    track, fixes = alone.trajectory, graph.fixes
    at = interpolate(fixes.time, track.time, track.position)
    distance = np.hypot(*(fixes.position - at).T)
    reports = [
        FixReport(t, x, y, sigma, d, 0.0, "not used: dead reckoning takes the first fix only")
        for t, (x, y), sigma, d in zip(
            fixes.time.tolist(), fixes.position.tolist(), fixes.sigma.tolist(), distance.tolist(), strict=True
        )
    ]
    reports[first : first + 1] = alone.fixes
    return replace(alone, trajectory=replace(track, floor=graph.floors), fixes=tuple(reports))


def write_results(out: Path, given: Inputs, estimate: Estimate, rate: float | None) -> tuple[str, ...]:
    """The trajectory in all its forms, and the picture; returns what could not be written."""
    walk, frame = given.walk, given.frame
    trajectory = resample(estimate.trajectory, rate) if rate else estimate.trajectory
    writers.write_trajectory(out / "trajectory.csv", trajectory, walk.clock_origin)
    writers.write_tum(out / "trajectory.tum", trajectory, walk.clock_origin)
    if frame.georeferenced:
        writers.write_geojson(
            out / "trajectory.geojson", replace(estimate, trajectory=trajectory), frame, walk.clock_origin
        )
        gpx.write(out / "trajectory.gpx", trajectory, frame, walk.epoch, walk.source)
    try:
        from pdr_graph.plotting import plot

        truth = _truth_beside(given, estimate)
        plot(estimate, given.building, truth, f"{walk.source}   {_length(estimate):.0f} m").savefig(
            out / "figure.png", dpi=120
        )
    except Exception as error:  # a picture must not cost the result
        return (f"figure.png ({type(error).__name__}: {error})",)
    return ()


def write_report(
    out: Path,
    given: Inputs,
    estimate: Estimate,
    summary: dict[str, Any],
    method: str = "graph",
    steps: Steps | None = None,
    causal: Callable[[], dict[str, Trajectory]] = dict,
) -> tuple[str, ...]:
    """``report.html``; causal: tracks, by name, of what knew only what came before. Returns what could not be written.

    Arguments as of ``report.walk.Shown``.
    """
    try:
        from pdr_graph.report.page import page
        from pdr_graph.report.walk import Shown, content

        truth = _truth_beside(given, estimate)
        shown = Shown(given.walk, given.building, estimate, method, summary, steps, causal(), truth)
        (out / "report.html").write_bytes(page(content(shown)))
    except Exception as error:  # a report must not cost the result
        return (f"report.html ({type(error).__name__}: {error})",)
    return ()


def with_truth(given: Inputs, truth: Path | None) -> Inputs:
    """The same with a truth to be drawn and scored, which no estimate looks at.

    Raises InputError if the file cannot be used.
    """
    if truth is None:
        return given
    return replace(given, walk=replace(given.walk, truth=read_trajectory(truth, given.walk)))


def unscored(truth: Path | None, given: Inputs, estimate: Estimate) -> tuple[str, ...]:
    """What is missing where a truth was given and says nothing of the walk."""
    if truth is None or _truth_beside(given, estimate) is not None:
        return ()
    return (f"scores: {truth.name} lies elsewhere than the walk, or nothing says where the walk was",)


def _truth_beside(given: Inputs, estimate: Estimate) -> Trajectory | None:
    """The truth, to be drawn where it has a place in the frame and lies where the walk is."""
    truth, frame = given.walk.truth, given.frame
    if truth is None or not estimate.fixes or (truth.epsg is not None and not frame.georeferenced):
        return None
    truth = frame.place(truth)
    apart = np.abs(truth.position.mean(axis=0) - estimate.trajectory.position.mean(axis=0))
    near = np.max(apart) < 2 * np.ptp(estimate.trajectory.position, axis=0).max() + 50.0
    return truth if near else None


def summarize(
    walk: Recording,
    steps: Steps | None,
    headings: Headings,
    building: Building | None,
    floors: Floors | None,
    frame: Frame,
    estimate: Estimate,
) -> dict[str, Any]:
    """What ``summary.json`` says of the walk itself."""
    track = estimate.trajectory
    crossings = None if building is None else int(building.crosses_wall(track.position, track.floor).sum())
    packages = {name: version(name) for name in ("pdr_graph", "gtsam", "numpy", "vqf")}
    return {
        "recording": walk.source,
        "steps": 0 if steps is None else int((steps.length > 0).sum()),
        "distance": round(_length(estimate), 3),
        "duration": round(float(np.ptp(estimate.trajectory.time)), 3),
        "frame": frame.describe(),
        "floor": track.floor[0] or None,
        "floors": [label for label, before in zip(track.floor, ("", *track.floor), strict=False) if label != before],
        "climbs": _climbs(floors, walk.clock_origin),
        "calibration": _calibration(estimate, walk.clock_origin),
        "fixes": [_finite(asdict(replace(f, time=f.time + walk.clock_origin))) for f in estimate.fixes],
        "beacons": [asdict(b) for b in estimate.beacons],
        "headings": _heading_reports(headings, estimate, walk.clock_origin),
        "wall_crossings": crossings,
        "probability": round(estimate.probability, 3),
        "optimum": _finite({"cost": estimate.cost, "iterations": estimate.iterations, "converged": estimate.converged}),
        "versions": packages | {"python": platform.python_version()},
    }


def _heading_reports(headings: Headings, estimate: Estimate, clock_origin: float) -> list[dict[str, float]]:
    track = estimate.trajectory
    at = np.interp(headings.time, track.time, np.unwrap(track.heading))
    return [
        {"time": t + clock_origin, "heading": h, "sigma": s, "residual": r}
        for t, h, s, r in zip(
            headings.time.tolist(),
            headings.heading.tolist(),
            headings.sigma.tolist(),
            wrap_angle(headings.heading - at).tolist(),
            strict=True,
        )
    ]


def _climbs(floors: Floors | None, clock_origin: float) -> list[dict[str, Any]]:
    """When the walker went up or down, how far, and on what."""
    if floors is None:
        return []
    found = floors.climbs
    return [
        {"start": float(t + clock_origin), "end": float(u + clock_origin), "height": float(h), "kind": kind}
        for t, u, h, kind in zip(found.start, found.end, found.height, floors.kinds, strict=True)
    ]


def _calibration(estimate: Estimate, clock_origin: float) -> list[dict[str, Any]]:
    c = estimate.calibration
    if c is None:
        return []
    return [
        {"start": float(c.start[s] + clock_origin)}
        | {
            name: {
                "value": float(c.value[s, n]),
                "sigma": float(c.sigma[s, n]),
                "learnt": bool(c.learnt[s, n]),
            }
            for n, name in enumerate(c.names)
        }
        for s in range(len(c.start))
    ]


def _length(estimate: Estimate) -> float:
    return float(np.hypot(*np.diff(estimate.trajectory.position, axis=0).T).sum())


def _finite(values: dict[str, Any]) -> dict[str, Any]:
    return {k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in values.items()}
