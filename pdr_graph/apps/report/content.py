"""The content of the report of one walk."""

from __future__ import annotations

import time as clock
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from itertools import cycle
from typing import Any

import numpy as np

from pdr_graph.apps.report import charts_and_tables, page
from pdr_graph.apps.report.charts_and_tables import FEW, Table, chart, line, table
from pdr_graph.apps.report.evaluation import METRICS, error_text, scores_of_track
from pdr_graph.apps.report.page import (
    CENTIMETRE,
    CENTIRADIAN,
    CENTISECOND,
    MAXIMUM_MARKS,
    ON_EVERY_MAP,
    OTHER,
    PERCENT,
    RADIO,
    SURROUNDINGS,
    TRUTH,
    bands,
    column,
    maps_of,
    runs,
    thinned,
    track,
)
from pdr_graph.errors import count, percent, printable
from pdr_graph.estimation.factors.base import poses_at
from pdr_graph.estimation.factors.registry import kind_of, locating_kinds
from pdr_graph.estimation.gps_track import without_data
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.optimizer import solve_robust
from pdr_graph.estimation.results import is_usual, used_fixes
from pdr_graph.estimation.smoother import poses_of_rows
from pdr_graph.floor.building import Building
from pdr_graph.geometry import interpolate, nearest, protection_level, row_times, wrap_angle
from pdr_graph.notebook_html import BLUE, GREY, RED
from pdr_graph.priors import INITIAL, REPORTS, VERDICTS
from pdr_graph.types import Array, Estimate, FixReport, OneLineRepr, Recording, Steps, Trajectory, time_span

CAUSAL = "#2fa37d"  # colour of causal tracks
DASHES = {GREY: "dash", OTHER: "dashdot"}  # of tracks that have the lightness of others; those of sources are dotted
DEAD_RECKONING = "dead reckoning, rigidly aligned"
RESULT_NAMES = {
    "graph": "graph",
    "filter": "filter",
    "rts": "filter, smoothed",
    "pdr": DEAD_RECKONING,
    "live": "in hindsight, smoothed",
}  # of the results of each method
SOURCE_COLOURS = ("#c2408a", "#b8860b", "#00868b", "#6b8e23", "#8b5a2b", "#556b8d")  # of sources, in order
PERCENTILES_HEAD = "error 50 / 75 / 95 %"


@dataclass(frozen=True)
class WalkReport(OneLineRepr):
    """The data of a walk report.

    method: of ``pdr-graph smooth``, or "live"; summary: the content of ``summary.json``; steps: None if there are none;
    causal: causal tracks (estimated from earlier data only) by name; truth: in the frame of the estimate, drawn and
    scored; sources: of position, each with its own track.
    """

    walk: Recording
    building: Building | None
    estimate: Estimate
    method: str
    summary: Mapping[str, Any]
    steps: Steps | None = None
    causal: Mapping[str, Trajectory] = field(default_factory=dict)
    truth: Trajectory | None = None
    sources: Sequence[PositionSource] = ()

    def _summary(self) -> list[str]:
        return [repr(self.walk.source), self.name, *time_span(self.estimate.trajectory)]

    @property
    def name(self) -> str:
        """Name of the result: the method, or "smoothed positions" without steps."""
        return RESULT_NAMES[self.method] if self.summary["steps"] else "smoothed positions"

    @property
    def tracks(self) -> dict[str, tuple[str, Trajectory]]:
        """All tracks, name -> (colour, path), the result first."""
        tracks = {self.name: (BLUE, self.estimate.trajectory)}
        others = self.estimate.routes[1:]
        tracks |= {f"route {n + 2}, {percent(share)}": (OTHER, path) for n, (share, path) in enumerate(others)}
        tracks |= {name: (CAUSAL, path) for name, path in self.causal.items()}
        reckoned = {DEAD_RECKONING: (GREY, self.estimate.dead_reckoning)} if self.summary["steps"] else {}
        return tracks | (reckoned if self.method != "pdr" else {})

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the floors visited, the lowest first; ``("",)`` without a plan."""
        if self.building is None:
            return ("",)
        visited = set(self.estimate.trajectory.floor)
        return tuple(label for label in self.building.labels if label in visited) or self.building.labels[:1]


def content(report: WalkReport) -> dict[str, Any]:
    """The content of the page, in the form documented in ``web/content.js``."""
    estimate, summary, labels = report.estimate, report.summary, report.labels
    path, walk = estimate.trajectory, report.walk
    fixes = [estimate.fixes[row] for row in thinned(len(estimate.fixes), MAXIMUM_MARKS).tolist()]
    fix_labels = [_fix_label(fix) for fix in fixes]
    parts = ["live" if report.method == "live" else report.name]
    if walk.epoch is not None:
        parts.append(f"{datetime.fromtimestamp(walk.epoch, UTC):%Y-%m-%d %H:%M} UTC")
    calibration = estimate.calibration
    return {
        "title": printable(walk.source),
        "subtitle": ", ".join(parts),
        "verdict": summary["verdict"],
        "headline": _headline(summary, estimate.probability),
        "missing": summary["missing"],
        **_remarks(report),
        "north": summary["frame"]["kind"] != "local",
        "start": float(path.time[0]),
        "end": float(path.time[-1]),
        "maps": list(_maps(report)),
        "tracks": _tracks(report),
        "marks": [
            *_fixes(fixes, fix_labels, path, labels),
            *_beacons(estimate),
            *_untimed(estimate),
            *_headings(report),
        ],
        "charts": [
            charts_and_tables.sigma(report.tracks),
            *([] if report.truth is None else [charts_and_tables.errors(report.tracks, report.truth)]),
            *([charts_and_tables.residuals(fixes, fix_labels)] if fixes else []),
            *([] if calibration is None else charts_and_tables.calibration_charts(calibration, float(path.time[-1]))),
            *([charts_and_tables.floors(path, labels)] if len(labels) > 1 else []),
            *([] if walk.barometer is None else [charts_and_tables.height(walk.barometer)]),
            *([] if report.steps is None else charts_and_tables.gait(report.steps)),
            *_protection_charts(path, summary["protection"]),
        ],
        "tables": [
            *_accuracy_tables(report),
            *_source_tables(report.sources, path),
            *_protection_tables(summary["protection"]),
            *charts_and_tables.walk_tables(walk, fixes, estimate, summary),
        ],
    }


def _remarks(report: WalkReport) -> dict[str, list[str]]:
    """Warnings, those of the estimate first; and notes: of the reader, and what most walks leave open."""
    lines, first = report.summary["warnings"], report.estimate.warnings
    notes = [line for line in lines if line in report.walk.notes or is_usual(line)]
    warnings = sorted((line for line in lines if line not in notes), key=lambda line: line not in first)
    return {"warnings": warnings, "notes": notes}


def _headline(summary: Mapping[str, Any], probability: float) -> list[list[str]]:
    """Key figures of the walk, as [name, value]."""
    floors = [label for label in summary["floors"] if label]
    figures = [
        *_error_figures(summary),
        ["distance", f"{summary['distance']:,.0f} m"],
        ["duration", charts_and_tables.clock(summary["duration"])],
        ["fixes", f"{len(summary['fixes']):,}"],
    ]
    if summary["steps"]:
        stated = percent(probability) if np.isfinite(probability) else "no other route was tried"
        figures += [["steps", f"{summary['steps']:,}"], ["probability of this route", stated]]
    figures += [["floors" if len(floors) > 1 else "floor", " → ".join(floors)]] if floors else []
    crossed = summary["wall_crossings"]
    return figures + ([["steps through walls", f"{crossed}"]] if crossed is not None else [])


def _error_figures(summary: Mapping[str, Any]) -> list[list[str]]:
    """Errors of the walk against the truth, as [name, value]; of a live walk those of both tracks, or its sigma."""
    scores, live = summary["scores"], summary.get("live")
    if live is None:
        named = {PERCENTILES_HEAD: scores["ce"] if scores else None}
    elif live["error"] is None:
        first, median = f"{live['first_pose']:.1f} s", f"{live['sigma']:.1f} m"
        return [["live: first pose after", first], ["live: median sigma", median]]
    else:
        named = {f"live, known at once: {PERCENTILES_HEAD}": live["error"]}
        named |= {"in hindsight, smoothed": live["hindsight"]["error"]}
    return [[name, error_text({**error, "in_90": None})] for name, error in named.items() if error]


def _maps(report: WalkReport) -> Iterator[dict[str, Any]]:
    """A map of each floor visited, cropped to the part of the walk on it and to the fixes that were used.

    A plan that is hardly larger is shown as a whole.
    """
    path = report.estimate.trajectory
    on = np.array(maps_of(path.floor, report.labels))
    used = np.array([(f.time, f.x, f.y) for f in report.estimate.fixes if f.weight > 0.5]).reshape(-1, 3)
    for n, label in enumerate(report.labels):
        floor, here = None if report.building is None else report.building[label], (on == n) | (on == ON_EVERY_MAP)
        near = here[nearest(path.time, used[:, 0])]
        shown = np.concatenate([path.position[here], used[near, 1:]])
        low, high = shown.min(axis=0), shown.max(axis=0)
        margin = max(5.0, SURROUNDINGS * float(np.max(high - low)))  # [m]
        low, high = low - margin, high + margin
        if floor is not None:
            south_west, north_east = np.minimum(low, floor.corners[0] - 1.0), np.maximum(high, floor.corners[1] + 1.0)
            if (north_east - south_west < 1.3 * (high - low)).all():
                low, high = south_west, north_east
        corners = [low.round(2).tolist(), high.round(2).tolist()]
        yield {"name": label, "corners": corners, "plan": page.plan_drawing(floor) if floor else None}


def _tracks(report: WalkReport) -> list[dict[str, Any]]:
    """All tracks in drawing order: the result last, with its 95 % band; truth below, or its few points on top."""
    labels, result = report.labels, report.estimate.trajectory
    drawn, sources = list[dict[str, Any]](), list[dict[str, Any]]()
    for name, (colour, path) in reversed(report.tracks.items()):
        many = len(path) > 2000  # many: rows above which lines are drawn thinner
        style = {
            "dash": DASHES.get(colour, "solid"),
            "walker": colour != GREY,
            "lead": path is result,
            "width": 0.7 if many else 1.4,
        }
        if path is result:
            floors = [None if report.building is None else report.building[label] for label in labels]
            style |= {"width": 1.4 if many else 2.6, "bands": bands(path, maps_of(path.floor, labels), floors)}
            walked = bool(report.summary["steps"])
            style |= {"gaps": _gaps(report.steps, [] if walked else report.estimate.fixes)}
        drawn.append(track(name, colour, path, maps_of(path.floor, labels), **style))
    for source, colour in zip(report.sources, cycle(SOURCE_COLOURS), strict=False):
        if source.track is not None:
            on = maps_of(source.track.floor, labels)
            sources.append(track(f"by {source.name} alone", colour, source.track, on, width=1.3, dash="dot"))
    if report.truth is None:
        return [*sources, *drawn]
    few = len(report.truth) <= FEW  # surveyed points
    style = {"mode": "markers", "symbol": "x-thin"} if few else {"width": 1.0}
    on = maps_of(report.truth.floor, labels)
    truth = track("surveyed" if few else "truth", TRUTH, replace(report.truth, covariance=None), on, **style)
    return [*sources, *drawn, truth] if few else [truth, *sources, *drawn]


def _gaps(steps: Steps | None, fixes: Sequence[FixReport]) -> list[list[float]]:
    """Start and end [s] of each time without samples, or without positions in a recording of positions alone."""
    if fixes:
        time = np.array([fix.time for fix in fixes])
        begins, ends, lost = time[:-1], time[1:], without_data(time)
    elif steps is not None:
        begins, ends, lost = np.append(steps.start, steps.time[:-1]), steps.time, steps.is_gap
    else:
        return []
    return np.stack([begins, ends], axis=1)[lost].round(2).tolist()


def _fix_label(fix: FixReport) -> str:
    """The hover text of a fix."""
    residual = f"residual {fix.residual:.2f} m, " if np.isfinite(fix.residual) else ""
    return f"{residual}sigma {fix.sigma:.2f} m; weight {fix.weight:.2f}\n{fix.reason}"


def _fixes(
    fixes: Sequence[FixReport], fix_labels: Sequence[str], path: Trajectory, labels: Sequence[str]
) -> list[dict[str, Any]]:
    """Fixes, paler with less weight, each with a line to the walk at its time."""
    if not fixes:
        return []
    time, x, y, weight = np.array([(f.time, f.x, f.y, f.weight) for f in fixes]).T
    floors = [path.floor[row] for row in nearest(path.time, time).tolist()]
    to_x, to_y = (column(axis, CENTIMETRE) for axis in interpolate(time, path.time, path.position).T)
    marks = _marks("fixes, by weight", RED, np.stack([x, y], axis=1), fix_labels)
    marks |= {"on": runs(maps_of(floors, labels)), "symbol": "circle", "weight": column(weight, PERCENT)}
    return [marks | {"time": column(time, CENTISECOND), "to_x": to_x, "to_y": to_y}]


def _beacons(estimate: Estimate) -> list[dict[str, Any]]:
    """Estimated places of the beacons; those far from their listed place in another colour."""
    drawn = []
    for name, colour, moved in (("beacons", RADIO, False), ("misplaced beacons", RED, True)):
        group = [b for b in estimate.beacons if b.misplaced == moved and np.isfinite([b.x, b.y]).all()]
        if group:
            place = np.array([(b.x, b.y) for b in group])
            drawn.append(_marks(name, colour, place, [f"{b.label}\n{b.reason}" for b in group]))
            drawn[-1] |= {"on": [[ON_EVERY_MAP, len(group)]], "symbol": "diamond-open"}
    return drawn


def _untimed(estimate: Estimate) -> list[dict[str, Any]]:
    """Places without a time, with the time that was found; those off the walk in another colour."""
    drawn = []
    for name, colour, off in (("places without a time", BLUE, False), ("places not visited", RED, True)):
        if group := [place for place in estimate.untimed if (place.weight < REPORTS.rejected) == off]:
            labels = [f"{place.label}\nat {place.time:.0f} s, {place.reason}" for place in group]
            drawn.append(_marks(name, colour, np.array([(place.x, place.y) for place in group]), labels))
            drawn[-1] |= {"on": [[ON_EVERY_MAP, len(group)]], "symbol": "diamond-open"}
    return drawn


def _headings(report: WalkReport) -> list[dict[str, Any]]:
    """Magnetic headings as arrows at the walk's position."""
    headings = report.summary["headings"]
    if not headings:
        return []
    path = report.estimate.trajectory
    time = np.array([row["time"] for row in headings]) - report.walk.clock_origin
    heading = np.array([row["heading"] for row in headings])
    floors = [path.floor[row] for row in nearest(path.time, time).tolist()]
    labels = [
        f"magnetic heading, residual {np.degrees(row['residual']):+.0f}°, sigma {np.degrees(row['sigma']):.0f}°"
        for row in headings
    ]
    marks = _marks("magnetic headings", RADIO, interpolate(time, path.time, path.position), labels)
    marks |= {"on": runs(maps_of(floors, report.labels)), "symbol": "arrow", "heading": column(heading, CENTIRADIAN)}
    return [marks | {"time": column(time, CENTISECOND)}]


def _marks(name: str, colour: str, place: Array, labels: Sequence[str]) -> dict[str, Any]:
    """Marks on a map at positions ``(n, 2)`` [m], with hover texts."""
    x, y = (column(axis, CENTIMETRE) for axis in place.T)
    return {"name": name, "colour": colour, "x": x, "y": y, "text": list(labels)}


def _accuracy_tables(report: WalkReport) -> Iterator[Table]:
    """The metrics of each track, where a sample has ground truth."""
    if report.truth is None:
        return
    paths = {name: path for name, (_, path) in report.tracks.items()}
    scores = [scores_of_track(path, report.truth, report.building) for path in paths.values()]
    rows = [
        [f"{metric.name}: {metric.meaning}" if metric.meaning else metric.name, metric.unit, *texts]
        for metric in METRICS[1:]
        if any(texts := [metric.text(values) for values in scores])
    ]
    if scores[0]["n"]:
        yield table("Accuracy against ground truth", ["metric", "unit", *paths], rows)


def _source_tables(sources: Sequence[PositionSource], shown: Trajectory) -> Iterator[Table]:
    """The table of the sources: what each says, and how much of it was used. shown: the result."""
    if not sources:
        return
    rows = []
    for source in sources:
        far = [f"{far:.1f} m" if np.isfinite(far) else "" for far in source.distances(shown)]
        weight = f"{source.weight:.0%}" if np.isfinite(source.weight) else ""
        rows.append([source.name, f"{source.measurements:,}", *far, weight, source.remark])
    head = ["source", "measurements", "median distance", "largest", "weight used", "status"]
    note = "Distance of the track by steps, headings and one source alone from the result. These tracks have no plan "
    note += "and are dotted on the map; zoom out for a distant one."
    skipped = [source.name for source in sources if source.track is None and np.isfinite(source.weight)]
    note += f" Not estimated by itself: {', '.join(skipped)}." if skipped else ""
    yield table("Which source says what", head, rows, note=note)


def _protection_charts(track: Trajectory, levels: Mapping[str, Any] | None) -> Iterator[dict[str, Any]]:
    """Chart of the 95 % protection levels of a track [m]; levels: those of ``summary.json``, None without any."""
    if levels is not None and track.covariance is not None:
        rows = thinned(len(track), charts_and_tables.CHART_ROWS)
        both = protection_level(track.covariance[rows], np.nan_to_num(track.heading[rows]), 0.95).T
        axes = zip(("along", "across"), (BLUE, RADIO), both, strict=True)
        lines = [line(axis, colour, track.time[rows], values) for axis, colour, values in axes]
        yield chart("protection level 95 %", "m", *lines, from_zero=True)


def _protection_tables(levels: Mapping[str, Mapping[str, float]] | None) -> Iterator[Table]:
    """The protection levels of ``summary.json``, None without any."""
    if levels is not None:
        rows = [
            [f"{name} %", axis, *(f"{levels[f'{axis}_{key}'][share]:.1f} m" for share in ("median", "worst"))]
            for name, key in (("95", "95"), ("99.9", "999"))
            for axis in ("along", "across")
        ]
        note = "Distance along and across the walking direction that holds the error with a probability."
        yield table("Protection level", ["probability", "direction", "median", "worst"], rows, note=note)


FIXES_SOURCE, PLAN_SOURCE = "fixes", "plan"  # names of sources: fixes without a receiver, and the floor plan
MOST_NAMED = 5  # beacons that a remark names


@dataclass(frozen=True)
class PositionSource(OneLineRepr):
    """One position source of a walk.

    name: the receiver of fixes, or the kind of measurement; measurements: their number without duplicates; weight: mean
    share of their information that the estimate used, 0 to 1, NaN for a plan; remark: whether the source was overruled,
    and why; track: the walk by steps, headings and this source alone, without the plan; None if it was not estimated.
    """

    name: str
    measurements: int
    weight: float
    remark: str
    track: Trajectory | None = None

    def distances(self, track: Trajectory) -> tuple[float, float]:
        """Median and largest distance [m] of the source's track from the rows of another; NaN without a track."""
        if self.track is None:
            return float("nan"), float("nan")
        apart = np.hypot(*(self.track.position - track.position).T)
        return float(np.median(apart)), float(apart.max())

    def _summary(self) -> list[str]:
        return [self.name, count(self.measurements, "measurement"), self.remark]


def position_sources(graph: WalkGraph, estimate: Estimate, seconds: float = np.inf) -> tuple[PositionSource, ...]:
    """The sources of position in an estimate of ``graph``, each with its own track; empty for fewer than two.

    seconds: computing time after which no further track is estimated [s].
    """
    tables = list(_tables(graph, estimate))
    if len(tables) + (graph.floor is not None) < 2:
        return ()
    sources, until = list[PositionSource](), clock.perf_counter() + seconds
    for name, data, reports in tables:
        track = _alone(graph, data, estimate.trajectory) if clock.perf_counter() < until else None
        sources.append(PositionSource(name, *_use(name, reports, estimate), track))
    return (*sources, *_plan(graph, estimate))


def _tables(graph: WalkGraph, estimate: Estimate) -> Iterator[tuple[str, Any, list[Any]]]:
    """Name, measurements and reports of each source."""
    reports, source = estimate.fixes, np.array(graph.fixes.source, dtype=object)
    for name in dict.fromkeys(graph.fixes.source):
        which = np.flatnonzero(source == name)
        of_source = [reports[n] for n in which.tolist()] if len(reports) == len(graph.fixes) else []
        yield name or FIXES_SOURCE, graph.fixes[which], list(used_fixes(of_source))
    for data in graph.data:
        kind = kind_of(data).name
        if kind in locating_kinds():
            yield kind, data, list(estimate.reports.get(kind, ()))


def _alone(graph: WalkGraph, data: Any, shown: Trajectory) -> Trajectory | None:
    """The walk by steps, headings and one table of measurements; None if these do not determine a position.

    shown: the walk from which the search starts if they leave the direction open.
    """
    alone = WalkGraph.of(graph.steps, [data, graph.headings.headings], prior=graph.prior)
    if not alone.positions.used.any():
        return None
    if alone.sigma_direction > INITIAL.ambiguous:
        poses = poses_at(alone.keyframe_time, shown.time, np.column_stack([shown.position, shown.heading]))
        alone = alone.associated_at(alone.start.replaced(x=poses))
    try:
        rows = poses_of_rows(solve_robust(alone))
    except RuntimeError:  # by GTSAM, for a system that it cannot solve
        return None
    return Trajectory(row_times(graph.steps), rows[:, :2], wrap_angle(rows[:, 2]), graph.floors)


def _use(name: str, reports: list[Any], estimate: Estimate) -> tuple[int, float, str]:
    """The number of a source's measurements, their mean weight, and whether the source was overruled and why."""
    size = np.array([getattr(report, "levels", 1) for report in reports], dtype=float)
    weight = np.array([getattr(report, "weight", float(not getattr(report, "misplaced", False))) for report in reports])
    if not size.sum():
        return 0, 0.0, "not used"
    rejected = [report for report, used in zip(reports, (weight >= REPORTS.rejected).tolist(), strict=True) if not used]
    remark = "used"
    if rejected:
        share = size[weight < REPORTS.rejected].sum() / size.sum()
        verb = "overruled" if share > VERDICTS.most else "used in part"
        remark = f"{verb}: {len(rejected)} of {len(reports)} rejected, {_reason(rejected)}"
    stated = [reason.text for reason in estimate.contradictions if reason.source == name]
    return int(size.sum()), float((weight * size).sum() / size.sum()), "; ".join([remark, *dict.fromkeys(stated)])


def _reason(rejected: list[Any]) -> str:
    """The reason of rejected measurements: names of beacons, else the reason with the largest residual."""
    names = list(dict.fromkeys(report.label for report in rejected if hasattr(report, "label")))
    if names:
        more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
        return f"{', '.join(names[:MOST_NAMED])}{more} not where listed"
    worst = max(rejected, key=lambda report: np.nan_to_num(abs(getattr(report, "residual", 0.0))))
    return f"the worst {getattr(worst, 'reason', 'has no stated reason')}"


def _plan(graph: WalkGraph, estimate: Estimate) -> Iterator[PositionSource]:
    """The floor plan as a source; its measurements are the rows of the walk."""
    if graph.floor is None:
        return
    track, remark = estimate.trajectory, "not used: no position lies near it"
    if graph.walled:
        crossed = int(Building.around(graph.floor).crosses_wall(track.position, track.floor).sum())
        remark = f"used, {crossed} of {len(track)} rows through walls"
    yield PositionSource(PLAN_SOURCE, len(track), float("nan"), remark)
