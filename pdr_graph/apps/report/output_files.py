"""``pdr-graph smooth``: the files of a walk: trajectory, picture, report and summary; with a truth, scores."""

from __future__ import annotations

import gc
import platform
from dataclasses import asdict, fields, replace
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from pdr_graph.apps.report.content import position_sources
from pdr_graph.apps.report.evaluation import circular_error, coverage, evaluate, pair
from pdr_graph.errors import Stages
from pdr_graph.estimation.calibration import posterior_profile
from pdr_graph.estimation.results import is_located, is_usual
from pdr_graph.estimation.verdict import independent_positions, teaches_profile
from pdr_graph.geometry import horizontal_sigma, protection_level, resample
from pdr_graph.io import gpx, writers
from pdr_graph.options import Options
from pdr_graph.types import Estimate, Trajectory
from pdr_graph.walk import Evidence, Result, estimate, observe, read
from pdr_graph.whole_files import output_folder

LONGEST_SOURCES = 0.3  # share of the estimate's time for the tracks of its sources; each takes 3 to 10 % on IPIN 2023
PROTECTION = {"95": 0.95, "999": 0.999}  # name of each protection level -> its probability
REPORT = "report.html"
KNOWN_AT_ONCE = "live, known at once"  # name of the track of current poses in reports
REPORTED = ("fixes", "beacons", "headings")  # kinds that every summary has, even without measurements
KEYED_KINDS = (*REPORTED, "ranges")  # kinds with a key of the summary; reports of others are under "reports"


def smooth_recording(
    recording: Path, out: Path, options: Options | None = None, report: bool = True
) -> tuple[str, ...]:
    """Reconstruct one walk; write trajectory, picture, report and summary to ``out``.

    report: False writes everything else, and removes the report of an earlier walk from ``out``. Returns what could not
    be estimated or written, a line each; empty if all went well. Raises InputError if an input cannot be used.
    """
    stage = Stages()
    keep_modules()
    with stage("reading"):
        evidence = read(recording, options)
    with stage("steps"):
        evidence = observe(evidence)
    with output_folder(out, without=() if report else (REPORT,)) as staged:
        with stage("estimate"):
            result = estimate(evidence)
        return write(staged, result, stage, report)


@cache
def keep_modules() -> None:
    """Leave imported modules out of garbage collection; once, since what later calls freeze is never collected."""
    gc.freeze()


def write(out: Path, result: Result, stage: Stages, report: bool = True) -> tuple[str, ...]:
    """Write trajectory, picture, walker, report and summary to ``out``; returns what is missing, a line each.

    report: False leaves ``report.html`` out.
    """
    evidence, estimate, missing = result.evidence, result.estimate, result.missing
    options, walker = evidence.options, evidence.walker
    with stage("write"):
        write_tracks(out, result)
        if result.steps is not None and teaches_profile(estimate):
            walker = replace(walker, profile=posterior_profile(estimate, result.steps, walker.profile))
            origin = f"learnt from {evidence.walk.source}: {_taught_by(estimate)}; for --walker of the next walk"
            walker.save(out / "walker.toml", origin)
        missing += _write_picture(out / "figure.png", evidence, estimate)
    summary = summarize(result) | live_scores(result) | {"seconds": stage.seconds}
    summary |= {"settings": options.describe() | {"walker": evidence.walker.describe()}, "missing": list(missing)}
    with stage("report"):
        if report:
            seconds = stage.seconds.get("estimate", 0.0)
            missing += write_report(out, result, summary, seconds)
        truth = options.truth
        if truth is not None and _truth_beside(evidence, estimate) is None:
            missing += (f"scores: {truth.name} lies elsewhere than the walk, or nothing says where the walk was",)
    writers.write_summary(out / "summary.json", summary | {"missing": list(missing)})
    return missing


def _taught_by(estimate: Estimate) -> str:
    """The number of independent positions, and their kinds."""
    number = independent_positions(estimate)
    kinds = ", ".join(f"{kind} {n:.3g}" for kind, n in number.items())
    return f"{sum(number.values()):.3g} independent positions ({kinds})"


def write_tracks(out: Path, result: Result) -> None:
    """Write the trajectory in all formats, the truth beside it, and the routes if there are several."""
    evidence, estimate = result.evidence, result.estimate
    walk, frame, rate = evidence.walk, evidence.frame, evidence.options.rate
    trajectory = resample(estimate.trajectory, rate) if rate else estimate.trajectory
    writers.write_trajectory(out / "trajectory.csv", trajectory, walk.clock_origin)
    writers.write_tum(out / "trajectory.tum", trajectory if rate else dense(trajectory), walk.clock_origin)
    if (truth := _truth_beside(evidence, estimate)) is not None:
        writers.write_tum(out / "truth.tum", truth, walk.clock_origin)
    if len(estimate.routes) > 1:
        writers.write_routes(out / "routes.csv", estimate.routes, walk.clock_origin)
    if frame.georeferenced:
        writers.write_geojson(
            out / "trajectory.geojson", replace(estimate, trajectory=trajectory), frame, walk.clock_origin
        )
        gpx.write(out / "trajectory.gpx", trajectory, frame, walk.epoch, walk.source, result.steps)


def _write_picture(path: Path, evidence: Evidence, estimate: Estimate) -> tuple[str, ...]:
    """Write ``figure.png``; returns why there is none: without it the result is still useful."""
    try:
        from pdr_graph.apps.report.plotting import picture_bytes, plot

        title = f"{evidence.walk.source}   {_length(estimate):.0f} m"
        truth = _truth_beside(evidence, estimate)
        picture = picture_bytes(plot(estimate, evidence.building, truth, title, evidence.paths))
    except Exception as error:
        return (f"{path.name} ({type(error).__name__}: {error})",)
    path.write_bytes(picture)
    return ()


TUM_RATE = 60.0  # [Hz] so that a row is within 0.01 s of any time, as evo matches by default
MOST_TUM_ROWS = 500_000  # 2.3 h; longer walks have the rows of trajectory.csv


def dense(trajectory: Trajectory) -> Trajectory:
    """The trajectory at TUM_RATE, without covariance; that of `trajectory` if it were more than MOST_TUM_ROWS."""
    rows = float(np.ptp(trajectory.time)) * TUM_RATE
    return resample(replace(trajectory, covariance=None), TUM_RATE) if rows <= MOST_TUM_ROWS else trajectory


def write_report(out: Path, result: Result, summary: dict[str, Any], seconds: float = 0.0) -> tuple[str, ...]:
    """Write ``report.html``; returns what could not be written. seconds: computing time of the estimate [s]."""
    try:
        from pdr_graph.apps.report.content import WalkReport, content
        from pdr_graph.apps.report.page import page

        evidence, estimate = result.evidence, result.estimate
        longest = max(LONGEST_SOURCES * seconds, 1.0)  # least sources [s] that these tracks may always take
        shown = WalkReport(
            evidence.walk,
            evidence.building,
            estimate,
            evidence.options.method,
            summary,
            result.steps,
            result.causal() if result.live is None else {KNOWN_AT_ONCE: result.live},
            _truth_beside(evidence, estimate),
            () if result.graph is None else position_sources(result.graph, estimate, longest),
        )
        html = page(content(shown))
    except Exception as error:  # without a report the result is still useful
        return (f"{REPORT} ({type(error).__name__}: {error})",)
    (out / REPORT).write_bytes(html)
    return ()


def summarize(result: Result) -> dict[str, Any]:
    """Return the part of ``summary.json`` about the walk itself."""
    evidence, estimate = result.evidence, result.estimate
    walk, building = evidence.walk, evidence.building
    track = estimate.trajectory
    crossings = None if building is None else int(building.crosses_wall(track.position, track.floor).sum())
    climbs = (
        []
        if (floors := evidence.floors) is None
        else zip(floors.climbs.start, floors.climbs.end, floors.climbs.height, floors.kinds, strict=True)
    )
    origin = walk.clock_origin
    packages = {name: version(name) for name in ("pdr_graph", "gtsam", "numpy", "vqf")}
    return {
        "verdict": result.verdict.describe(),
        "recording": walk.source,
        "steps": result.step_count if result.steps is None else int((~result.steps.is_gap).sum()),
        "distance": round(_length(estimate), 3),
        **_finite({"distance_sigma": round(_length_sigma(result), 3)}),
        "duration": round(float(np.ptp(track.time)), 3),
        "sigma": _median_sigma(track) if is_located(estimate) else None,
        "frame": evidence.frame.describe(),
        "floor": track.floor[0] or None,
        "floors": [label for label, before in zip(track.floor, ("", *track.floor), strict=False) if label != before],
        "climbs": [
            {"start": float(t + origin), "end": float(u + origin), "height": float(h), "kind": kind}
            for t, u, h, kind in climbs
        ],
        "calibration": _calibration(estimate, walk.clock_origin),
        "independent_positions": {kind: round(n, 1) for kind, n in independent_positions(estimate).items()},
        "teaches_profile": result.steps is not None and teaches_profile(estimate),
        **_reports_by_kind(estimate, origin),
        "scores": scores_of(evidence, estimate),
        "wall_crossings": crossings,
        **_finite({"probability": round(estimate.probability, 3)}),
        "routes": [
            {"probability": round(share, 3), "begin": path.position[0].round(2).tolist()}
            | {"end": path.position[-1].round(2).tolist()}
            for share, path in estimate.routes
        ],
        "protection": protection_of(estimate),
        "optimum": _finite({"cost": estimate.cost, "iterations": estimate.iterations, "converged": estimate.converged}),
        "warnings": list(dict.fromkeys([*sorted([*estimate.warnings, *result.issues], key=is_usual), *evidence.notes])),
        "versions": packages | {"python": platform.python_version()},
    }


def live_scores(result: Result) -> dict[str, Any]:
    """Return the part of ``summary.json`` about the current poses of a live walk; empty for other walks."""
    live, evidence, walk = result.live, result.evidence, result.evidence.walk
    if live is None or live.covariance is None:
        return {}
    truth, track = _truth_beside(evidence, result.estimate), result.estimate.trajectory
    start = min((float(signal.time[0]) for signal in walk.signals.values()), default=float(track.time[0]))
    return {
        "live": {
            "poses": len(live),
            "first_pose": round(max(0.0, float(live.time[0]) - start), 3),
            "sigma": _median_sigma(live),
            "error": _error(live, truth),
            "hindsight": {"error": _error(track, truth)},
            "filter": dict(result.beside),
        }
    }


def scores_of(evidence: Evidence, estimate: Estimate) -> dict[str, Any] | None:
    """Return the scores of ``pdr-graph evaluate`` and the share of the truth in the 90 % region; None without truth."""
    truth, track = _truth_beside(evidence, estimate), estimate.trajectory
    if truth is None:
        return None
    share = coverage(track, truth)
    return evaluate(track, truth, evidence.building) | {"in_90": None if share is None else round(share, 3)}


def _median_sigma(track: Trajectory) -> float | None:
    """Median standard deviation of the positions per axis [m]; None without covariance."""
    if track.covariance is None or not len(track):
        return None
    return round(float(np.median(horizontal_sigma(track.covariance))), 3)


def _error(track: Trajectory, truth: Trajectory | None) -> dict[str, float | None] | None:
    """Percentiles of the horizontal error [m], and the share of the truth in the 90 % region; None without truth."""
    if truth is None:
        return None
    pairs = pair(track, truth)
    if not pairs.same_floor.any():
        return None
    values = np.percentile(circular_error(pairs.where(pairs.same_floor)), [50, 75, 95]).round(3).tolist()
    share = coverage(track, truth)
    return dict(zip(("p50", "p75", "p95"), values, strict=True)) | {"in_90": None if share is None else round(share, 3)}


def _on_clock(report: Any, clock_origin: float) -> Any:
    """A report with its times on the recorder's clock."""
    others = {"others": tuple(t + clock_origin for t in report.others)} if hasattr(report, "others") else {}
    return replace(report, time=report.time + clock_origin, **others)


def _reports_by_kind(estimate: Estimate, clock_origin: float) -> dict[str, Any]:
    """The reports of KEYED_KINDS by name, times on the recorder's clock; under "reports" those of other kinds."""
    listed: dict[str, list[dict[str, Any]]] = {kind: [] for kind in REPORTED}
    for kind, reports in estimate.reports.items():
        timed = bool(reports) and "time" in {column.name for column in fields(reports[0])}
        shifted = (_on_clock(report, clock_origin) if timed else report for report in reports)
        listed[kind] = [_finite(asdict(report)) for report in shifted]
    others = {kind: rows for kind, rows in listed.items() if kind not in KEYED_KINDS}
    return {kind: rows for kind, rows in listed.items() if kind in KEYED_KINDS} | (
        {"reports": others} if others else {}
    )


def _truth_beside(evidence: Evidence, estimate: Estimate) -> Trajectory | None:
    """The truth in the output frame; None if it cannot be placed there, or lies elsewhere than the walk."""
    truth = evidence.truth
    if truth is None or not (estimate.placed or estimate.fixes or estimate.routes):
        return None
    apart = np.abs(truth.position.mean(axis=0) - estimate.trajectory.position.mean(axis=0))
    near = np.max(apart) < 2 * np.ptp(estimate.trajectory.position, axis=0).max() + 50.0
    return truth if near else None


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


def protection_of(estimate: Estimate) -> dict[str, dict[str, float]] | None:
    """Median and worst protection levels of a walk along and across its direction [m]; None without a position.

    Keys: ``along_95``, ``across_95``, ``along_999``, ``across_999``.
    """
    track = estimate.trajectory
    if track.covariance is None or not is_located(estimate) or not len(track):
        return None
    found = {}
    for name, probability in PROTECTION.items():
        levels = protection_level(track.covariance, np.nan_to_num(track.heading), probability)
        for axis, values in zip(("along", "across"), levels.T, strict=True):
            found[f"{axis}_{name}"] = {
                "median": round(float(np.median(values)), 2),
                "worst": round(float(values.max()), 2),
            }
    return found


def _length(estimate: Estimate) -> float:
    return float(np.hypot(*np.diff(estimate.trajectory.position, axis=0).T).sum())


def _length_sigma(result: Result) -> float:
    """Standard deviation of the length of a walk [m]: strides err alike, missing steps each; NaN without steps."""
    track, calibration, steps = result.estimate.trajectory, result.estimate.calibration, result.steps
    if calibration is None or steps is None or not len(track):
        return float("nan")
    segment = np.maximum(np.searchsorted(calibration.start, track.time[1:], side="right") - 1, 0)
    scale = (calibration.sigma[:, 0] / calibration.value[:, 0])[segment]
    alike = float(np.hypot(*np.diff(track.position, axis=0).T) @ scale)
    return float(np.hypot(alike, np.linalg.norm(steps.sigma_length[~steps.is_gap])))


def _finite(values: dict[str, Any]) -> dict[str, Any]:
    plain = {k: v.tolist() if isinstance(v, np.ndarray | np.generic) else v for k, v in values.items()}
    return {k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in plain.items()}
