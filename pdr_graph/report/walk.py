"""The report of one walk."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

import numpy as np

from pdr_graph.floor.building import Building
from pdr_graph.geometry import interpolate, nearest
from pdr_graph.plotting import FIX, GREY, RADIO, SURROUNDINGS, TRACK, TRUTH
from pdr_graph.report import charts, plans, tables
from pdr_graph.report.columns import (
    CENTIMETRE,
    CENTIRADIAN,
    CENTISECOND,
    MOST_MARKS,
    PERCENT,
    column,
    runs,
    thinned,
)
from pdr_graph.report.tracks import EVERYWHERE, bands, maps_of, track
from pdr_graph.types import Array, Estimate, FixReport, Recording, Steps, Trajectory

CAUSAL = "#2a8f6d"  # colour of the track that knew only what came before
NAMES = {"graph": "graph", "filter": "filter", "rts": "filter, smoothed", "pdr": "dead reckoning"}  # of the methods
LEAST_AROUND = 5.0  # [m] shown about a walk
FEW = 50  # surveyed points up to which they are marks, not a line
MANY = 2000  # rows above which lines lie over one another


@dataclass(frozen=True)
class Shown:
    """A walk that has been estimated, and what its report shows of it.

    method: as of ``pdr-graph smooth``; summary: as ``summary.json`` has it; steps: None where they are not known one
    by one; causal: tracks, by name, that knew only what came before; truth: in the frame of the estimate, drawn and
    scored.
    """

    walk: Recording
    building: Building | None
    estimate: Estimate
    method: str
    summary: Mapping[str, Any]
    steps: Steps | None = None
    causal: Mapping[str, Trajectory] = field(default_factory=dict)
    truth: Trajectory | None = None

    @property
    def name(self) -> str:
        """What the result is called."""
        return NAMES[self.method] if self.summary["steps"] else "smoothed positions"

    @property
    def tracks(self) -> dict[str, tuple[str, Trajectory]]:
        """Every estimate by its name, with its colour; the result first."""
        found = {self.name: (TRACK, self.estimate.trajectory)}
        found |= {name: (CAUSAL, path) for name, path in self.causal.items()}
        reckoned = {"dead reckoning": (GREY, self.estimate.dead_reckoning)} if self.summary["steps"] else {}
        return found | (reckoned if self.method != "pdr" else {})

    @property
    def labels(self) -> tuple[str, ...]:
        """The floors that the walk was on, the lowest first; one of no name without a plan."""
        if self.building is None:
            return ("",)
        visited = set(self.estimate.trajectory.floor)
        return tuple(label for label in self.building.labels if label in visited) or self.building.labels[:1]


def content(shown: Shown) -> dict[str, Any]:
    """The page, as the head of ``web/content.js`` says."""
    estimate, summary, labels = shown.estimate, shown.summary, shown.labels
    paths = {name: path for name, (_, path) in shown.tracks.items()}
    scores = None if shown.truth is None else tables.scored(paths, shown.truth, shown.building)
    fixes = [estimate.fixes[row] for row in thinned(len(estimate.fixes), MOST_MARKS).tolist()]
    said = [_said(fix) for fix in fixes]
    return {
        "title": shown.walk.source,
        "subtitle": _subtitle(shown),
        "headline": _headline(summary, estimate.probability),
        "missing": summary["missing"],
        "warnings": summary["warnings"],
        "offsets": None,
        "start": float(estimate.trajectory.time[0]),
        "end": float(estimate.trajectory.time[-1]),
        "maps": _maps(shown),
        "tracks": _tracks(shown),
        "marks": [*_fixes(fixes, said, estimate.trajectory, labels), *_beacons(estimate), *_headings(shown)],
        "charts": charts.of_walk(
            shown.walk, shown.tracks, fixes, said, estimate.calibration, shown.steps, shown.truth, labels
        ),
        "tables": tables.of_walk(shown.walk, fixes, estimate.beacons, estimate.calibration, scores, summary),
    }


def _subtitle(shown: Shown) -> str:
    """How and when."""
    said = [shown.name]
    if shown.walk.epoch is not None:
        said.append(f"{datetime.fromtimestamp(shown.walk.epoch, UTC):%Y-%m-%d %H:%M} UTC")
    return ", ".join(said)


def _headline(summary: Mapping[str, Any], probability: float) -> list[list[str]]:
    """The walk in numbers: what, how much."""
    floors = [label for label in summary["floors"] if label]
    said = [
        ["distance", f"{summary['distance']:,.0f} m"],
        ["duration", tables.clock(summary["duration"])],
        ["fixes", f"{len(summary['fixes']):,}"],
    ]
    if summary["steps"]:
        said += [["steps", f"{summary['steps']:,}"], ["probability of this way", f"{probability:.0%}"]]
    said += [["floors" if len(floors) > 1 else "floor", " → ".join(floors)]] if floors else []
    crossed = summary["wall_crossings"]
    return said + ([["steps through walls", f"{crossed}"]] if crossed is not None else [])


def _maps(shown: Shown) -> list[dict[str, Any]]:
    """A map of each floor, about what of the walk was on it."""
    floors = () if shown.building is None else tuple(shown.building[label] for label in shown.labels)
    path = shown.estimate.trajectory
    on = np.array(maps_of(path.floor, shown.labels))
    maps = []
    for n, label in enumerate(shown.labels):
        corners = _around(path.position[(on == n) | (on == EVERYWHERE)])
        maps.append({"name": label, "corners": corners, "plan": plans.drawn(floors[n]) if floors else None})
    return maps


def _around(position: Array) -> list[list[float]]:
    """South-west and north-east corner of what is shown of positions ``(n, 2)``. [m]"""
    low, high = position.min(axis=0), position.max(axis=0)
    margin = max(LEAST_AROUND, SURROUNDINGS * float(np.max(high - low)))
    return [(low - margin).round(2).tolist(), (high + margin).round(2).tolist()]


def _tracks(shown: Shown) -> list[dict[str, Any]]:
    """The estimates, the last of them the result with its band; the truth below them, or its few points on top."""
    labels, result = shown.labels, shown.estimate.trajectory
    drawn = []
    for name, (colour, path) in reversed(shown.tracks.items()):
        reckoned, many = colour == GREY, len(path) > MANY
        style = {
            "dash": "dash" if reckoned else "solid",
            "walker": not reckoned,
            "lead": path is result,
            "width": 0.7 if many else 1.4,
        }
        if path is result:
            style |= {"width": 1.4 if many else 2.6, "bands": bands(path, maps_of(path.floor, labels), len(labels))}
        drawn.append(track(name, colour, path, maps_of(path.floor, labels), **style))
    truth = [] if shown.truth is None else [_truth(shown.truth, labels)]
    return [*drawn, *truth] if shown.truth is not None and len(shown.truth) <= FEW else [*truth, *drawn]


def _truth(truth: Trajectory, labels: Sequence[str]) -> dict[str, Any]:
    few = len(truth) <= FEW
    style = {"mode": "markers", "symbol": "x-thin"} if few else {"width": 1.0}
    return track("surveyed" if few else "truth", TRUTH, truth, maps_of(truth.floor, labels), **style)


def _said(fix: FixReport) -> str:
    away = f"{fix.residual:.2f} m from the walk, " if np.isfinite(fix.residual) else ""
    return f"{away}stated {fix.sigma:.2f} m; weight {fix.weight:.2f}\n{fix.reason}"


def _fixes(
    fixes: Sequence[FixReport], said: Sequence[str], path: Trajectory, labels: Sequence[str]
) -> list[dict[str, Any]]:
    """Fixes, the paler the less they counted, each with a line to where the walk was."""
    if not fixes:
        return []
    time, x, y, weight = np.array([(f.time, f.x, f.y, f.weight) for f in fixes]).T
    floors = [path.floor[row] for row in nearest(path.time, time).tolist()]
    to_x, to_y = (column(axis, CENTIMETRE) for axis in interpolate(time, path.time, path.position).T)
    marks = _marks("fixes, by weight", FIX, np.stack([x, y], axis=1), said)
    marks |= {"on": runs(maps_of(floors, labels)), "symbol": "circle", "weight": column(weight, PERCENT)}
    return [marks | {"time": column(time, CENTISECOND), "to_x": to_x, "to_y": to_y}]


def _beacons(estimate: Estimate) -> list[dict[str, Any]]:
    """Where the walk has the beacons, in colour those that are not where their list says."""
    drawn = []
    for name, colour, moved in (("beacons", RADIO, False), ("misplaced beacons", FIX, True)):
        own = [b for b in estimate.beacons if b.misplaced == moved and np.isfinite([b.x, b.y]).all()]
        if own:
            place = np.array([(b.x, b.y) for b in own])
            drawn.append(_marks(name, colour, place, [f"{b.label}\n{b.reason}" for b in own]))
            drawn[-1] |= {"on": [[EVERYWHERE, len(own)]], "symbol": "diamond-open"}
    return drawn


def _headings(shown: Shown) -> list[dict[str, Any]]:
    """What the magnetometer told, as arrows where the walk was."""
    told = shown.summary["headings"]
    if not told:
        return []
    path = shown.estimate.trajectory
    time = np.array([one["time"] for one in told]) - shown.walk.clock_origin
    heading = np.array([one["heading"] for one in told])
    floors = [path.floor[row] for row in nearest(path.time, time).tolist()]
    said = [
        f"magnetic heading, {np.degrees(one['residual']):+.0f}° from the walk's, sigma {np.degrees(one['sigma']):.0f}°"
        for one in told
    ]
    marks = _marks("magnetic headings", RADIO, interpolate(time, path.time, path.position), said)
    marks |= {"on": runs(maps_of(floors, shown.labels)), "symbol": "arrow", "heading": column(heading, CENTIRADIAN)}
    return [marks | {"time": column(time, CENTISECOND)}]


def _marks(name: str, colour: str, place: Array, said: Sequence[str]) -> dict[str, Any]:
    x, y = (column(axis, CENTIMETRE) for axis in place.T)
    return {"name": name, "colour": colour, "x": x, "y": y, "text": list(said)}
