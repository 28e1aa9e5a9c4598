"""The content of the report of one walk."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

import numpy as np

from pdr_graph.apps.report import charts_and_tables, integrity, page
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
from pdr_graph.apps.report.sources import PositionSource
from pdr_graph.errors import percent, printable
from pdr_graph.estimation.gps_track import without_data
from pdr_graph.estimation.results import is_usual
from pdr_graph.floor.building import Building
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.geometry import interpolate, nearest
from pdr_graph.notebook_html import BLUE, GREY, RED
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
WHOLE_PLAN, RIM = 1.3, 1.0  # a plan up to this many times as large as what is shown is whole; [m] around it
USED_WEIGHT = 0.5  # weight from which a fix is within the map as it opens
FEW = 50  # surveyed points up to which they are drawn as markers, not as a line


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
    paths = {name: path for name, (_, path) in report.tracks.items()}
    accuracy = None if report.truth is None else integrity.scored(paths, report.truth, report.building)
    fixes = [estimate.fixes[row] for row in thinned(len(estimate.fixes), MAXIMUM_MARKS).tolist()]
    fix_labels = [_fix_label(fix) for fix in fixes]
    return {
        "title": printable(report.walk.source),
        "subtitle": _subtitle(report),
        "verdict": summary["verdict"],
        "headline": _headline(summary, estimate.probability),
        "missing": summary["missing"],
        **_remarks(report),
        "offsets": None,
        "north": summary["frame"]["kind"] != "local",
        "start": float(estimate.trajectory.time[0]),
        "end": float(estimate.trajectory.time[-1]),
        "maps": _maps(report),
        "tracks": _tracks(report),
        "marks": [*_fixes(fixes, fix_labels, estimate.trajectory, labels), *_beacons(estimate), *_headings(report)],
        "charts": [
            *charts_and_tables.walk_charts(
                report.walk,
                report.tracks,
                fixes,
                fix_labels,
                estimate.calibration,
                report.steps,
                report.truth,
                labels,
            ),
            *integrity.protection_charts(estimate.trajectory, summary["protection"]),
        ],
        "tables": [
            *([accuracy] if accuracy is not None else []),
            *integrity.source_tables(report.sources, estimate.trajectory),
            *integrity.protection_tables(summary["protection"]),
            *charts_and_tables.walk_tables(report.walk, fixes, estimate, summary),
        ],
    }


def _remarks(report: WalkReport) -> dict[str, list[str]]:
    """Warnings, those of the estimate first; and notes: of the reader, and what most walks leave open."""
    lines, first = report.summary["warnings"], report.estimate.warnings
    notes = [line for line in lines if line in report.walk.notes or is_usual(line)]
    warnings = sorted((line for line in lines if line not in notes), key=lambda line: line not in first)
    return {"warnings": warnings, "notes": notes}


def _subtitle(report: WalkReport) -> str:
    """The method, and the date and time of the start if known."""
    parts = ["live" if report.method == "live" else report.name]
    if report.walk.epoch is not None:
        parts.append(f"{datetime.fromtimestamp(report.walk.epoch, UTC):%Y-%m-%d %H:%M} UTC")
    return ", ".join(parts)


def _headline(summary: Mapping[str, Any], probability: float) -> list[list[str]]:
    """Key figures of the walk, as [name, value]."""
    floors = [label for label in summary["floors"] if label]
    figures = [
        *integrity.error_figures(summary),
        ["distance", f"{summary['distance']:,.0f} m"],
        ["duration", charts_and_tables.clock(summary["duration"])],
        ["fixes", f"{len(summary['fixes']):,}"],
    ]
    if summary["steps"]:
        stated = percent(probability) if np.isfinite(probability) else "unknown"
        figures += [["steps", f"{summary['steps']:,}"], ["probability of this route", stated]]
    figures += [["floors" if len(floors) > 1 else "floor", " → ".join(floors)]] if floors else []
    crossed = summary["wall_crossings"]
    return figures + ([["steps through walls", f"{crossed}"]] if crossed is not None else [])


def _maps(report: WalkReport) -> list[dict[str, Any]]:
    """A map of each floor visited, cropped to the part of the walk on it and to the fixes that were used."""
    floors = () if report.building is None else tuple(report.building[label] for label in report.labels)
    path = report.estimate.trajectory
    on = np.array(maps_of(path.floor, report.labels))
    used = np.array([(f.time, f.x, f.y) for f in report.estimate.fixes if f.weight > USED_WEIGHT]).reshape(-1, 3)
    maps = []
    for n, label in enumerate(report.labels):
        here = (on == n) | (on == ON_EVERY_MAP)
        near = here[nearest(path.time, used[:, 0])]
        corners = _around(np.concatenate([path.position[here], used[near, 1:]]), floors[n] if floors else None)
        maps.append({"name": label, "corners": corners, "plan": page.plan_drawing(floors[n]) if floors else None})
    return maps


def _around(position: Array, floor: FloorPlan | None) -> list[list[float]]:
    """South-west and north-east corner [m] of a box around positions ``(n, 2)``, with a margin.

    A plan that is hardly larger is shown as a whole.
    """
    low, high = position.min(axis=0), position.max(axis=0)
    margin = max(5.0, SURROUNDINGS * float(np.max(high - low)))  # smallest margin [m]: shown around a walk
    low, high = low - margin, high + margin
    if floor is not None:
        west_south, east_north = np.minimum(low, floor.corners[0] - RIM), np.maximum(high, floor.corners[1] + RIM)
        if (east_north - west_south < WHOLE_PLAN * (high - low)).all():
            low, high = west_south, east_north
    return [low.round(2).tolist(), high.round(2).tolist()]


def _tracks(report: WalkReport) -> list[dict[str, Any]]:
    """All tracks in drawing order: the result last, with its 95 % band; truth below, or its few points on top."""
    labels, result = report.labels, report.estimate.trajectory
    drawn = []
    for name, (colour, path) in reversed(report.tracks.items()):
        many = len(path) > 2000  # many: rows above which lines are drawn thinner
        style = {
            "dash": DASHES.get(colour, "solid"),
            "walker": colour != GREY,
            "lead": path is result,
            "width": 0.7 if many else 1.4,
        }
        if path is result:
            style |= {"width": 1.4 if many else 2.6, "bands": bands(path, maps_of(path.floor, labels), len(labels))}
            walked = bool(report.summary["steps"])
            style |= {"gaps": _gaps(report.steps) if walked else _gaps_of_fixes(report.estimate.fixes)}
        drawn.append(track(name, colour, path, maps_of(path.floor, labels), **style))
    drawn = [*integrity.source_tracks(report.sources, labels), *drawn]
    truth = [] if report.truth is None else [_truth(report.truth, labels)]
    return [*drawn, *truth] if report.truth is not None and len(report.truth) <= FEW else [*truth, *drawn]


def _gaps(steps: Steps | None) -> list[list[float]]:
    """Start and end of each time without samples [s]."""
    if steps is None or not steps.is_gap.any():
        return []
    begins = np.append(steps.start, steps.time[:-1])
    return np.stack([begins, steps.time], axis=1)[steps.is_gap].round(2).tolist()


def _gaps_of_fixes(fixes: Sequence[FixReport]) -> list[list[float]]:
    """Start and end of each time without positions [s], in a recording of positions alone."""
    time = np.array([fix.time for fix in fixes])
    lost = np.flatnonzero(without_data(time))
    return np.stack([time[lost], time[lost + 1]], axis=1).round(2).tolist()


def _truth(truth: Trajectory, labels: Sequence[str]) -> dict[str, Any]:
    """The truth as a line, or as markers if it has few points."""
    few = len(truth) <= FEW
    style = {"mode": "markers", "symbol": "x-thin"} if few else {"width": 1.0}
    return track("surveyed" if few else "truth", TRUTH, truth, maps_of(truth.floor, labels), **style)


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
