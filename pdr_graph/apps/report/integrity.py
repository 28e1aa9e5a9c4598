"""How far a walk can be trusted: tracks and table of its position sources, protection levels, scores against truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pdr_graph.apps.report.charts_and_tables import CHART_ROWS, Table, line, table
from pdr_graph.apps.report.evaluation import error_text, evaluate
from pdr_graph.apps.report.page import RADIO, maps_of, thinned, track
from pdr_graph.apps.report.sources import PositionSource
from pdr_graph.floor.building import Building
from pdr_graph.geometry import protection_level
from pdr_graph.notebook_html import BLUE
from pdr_graph.types import Trajectory

SOURCE_COLOURS = ("#c2408a", "#b8860b", "#00868b", "#6b8e23", "#8b5a2b", "#556b8d")  # of sources, in order
CHARTED = 0.95  # probability of the protection level that is drawn; others are multiples of it
ALONE = "by {} alone"  # name of a source's track


def source_tracks(sources: Sequence[PositionSource], labels: Sequence[str]) -> list[dict[str, Any]]:
    """A thin track for each source that has one; labels: of the maps."""
    style = {"width": 1.3, "dash": "dot"}
    return [
        track(ALONE.format(one.name), colour, one.track, maps_of(one.track.floor, labels), **style)
        for one, colour in zip(sources, np.resize(SOURCE_COLOURS, len(sources)).tolist(), strict=True)
        if one.track is not None
    ]


def source_tables(sources: Sequence[PositionSource], shown: Trajectory) -> list[Table]:
    """The table of the sources: what each says, and how much of it was used. shown: the result."""
    if not sources:
        return []
    rows = []
    for one in sources:
        median, largest = one.distances(shown)
        weight = f"{one.weight:.0%}" if np.isfinite(one.weight) else ""
        rows.append([one.name, f"{one.measurements:,}", _metres(median), _metres(largest), weight, one.remark])
    head = ["source", "measurements", "median distance", "largest", "weight used", "status"]
    note = "Distance of the track by steps, headings and one source alone from the result. These tracks have no plan "
    note += "and are dotted on the map; zoom out for a distant one."
    skipped = [one.name for one in sources if one.track is None and np.isfinite(one.weight)]
    note += f" Not estimated by itself: {', '.join(skipped)}." if skipped else ""
    return [table("Which source says what", head, rows, note=note)]


def protection_charts(track: Trajectory, levels: Mapping[str, Any] | None) -> list[dict[str, Any]]:
    """Chart of the protection levels of a track [m]; levels: those of ``summary.json``, None if there are none."""
    if levels is None or track.covariance is None:
        return []
    rows = thinned(len(track), CHART_ROWS)
    both = protection_level(track.covariance[rows], np.nan_to_num(track.heading[rows]), CHARTED).T
    lines = [
        line(axis, colour, track.time[rows], values)
        for axis, colour, values in zip(("along", "across"), (BLUE, RADIO), both, strict=True)
    ]
    return [{"title": f"protection level {100 * CHARTED:g} %", "unit": "m", "lines": lines, "from_zero": True}]


def protection_tables(levels: Mapping[str, Mapping[str, float]] | None) -> list[Table]:
    """The protection levels of ``summary.json``, None if there are none."""
    if levels is None:
        return []
    rows = [
        [f"{name} %", axis, *(_metres(levels[f"{axis}_{name.replace('.', '')}"][key]) for key in ("median", "worst"))]
        for name in ("95", "99.9")
        for axis in ("along", "across")
    ]
    note = "Distance along and across the walking direction that holds the error with a probability."
    return [table("Protection level", ["probability", "direction", "median", "worst"], rows, note=note)]


def _metres(value: float) -> str:
    return f"{value:.1f} m" if np.isfinite(value) else ""


SCORES = {  # key in the result of `evaluate` -> label, unit
    ("ce", "p50"): ("CE50: median horizontal error", "m"),
    ("ce", "p75"): ("CE75", "m"),
    ("ce", "p95"): ("CE95", "m"),
    ("he", "p50"): ("HE50: median heading error", "°"),
    ("eag",): ("EAG: error accumulation gradient", "m/s"),
    ("ve",): ("VE: speed error", "m/s"),
    ("ca",): ("CA: distance of the most frequent error from 0", "m"),
    ("oe",): ("OE: share of steps leaving the walkable area", ""),
    ("fe",): ("FE: share on the correct floor", ""),
    ("n",): ("samples with ground truth", ""),
}
PERCENTILES_HEAD = "error 50 / 75 / 95 %"


def scored(tracks: Mapping[str, Trajectory], truth: Trajectory, building: Building | None) -> Table | None:
    """The metrics of each track; None where no sample has ground truth."""
    scores = [_evaluated(path, truth, building) for path in tracks.values()]
    if not scores[0]["n"]:
        return None
    rows = [[label, unit, *(_score(values, key) for values in scores)] for key, (label, unit) in SCORES.items()]
    return table("Accuracy against ground truth", ["metric", "unit", *tracks], [row for row in rows if any(row[2:])])


def error_figures(summary: Mapping[str, Any]) -> list[list[str]]:
    """Errors of the walk against the truth, as [name, value]; of a live walk those of both tracks, or its sigma."""
    scores = summary["scores"]
    if "live" in summary:
        return _live_figures(summary["live"])
    if scores is None or scores["ce"] is None:
        return []
    return [[PERCENTILES_HEAD, error_text({**scores["ce"], "in_90": None})]]


def _live_figures(live: Mapping[str, Any]) -> list[list[str]]:
    """Key figures of the current poses, and of the walk in hindsight. live: of the summary."""
    error, smoothed = live["error"], live["hindsight"]["error"]
    if error is None:
        return [
            ["live: first pose after", f"{live['first_pose']:.1f} s"],
            ["live: median sigma", f"{live['sigma']:.1f} m"],
        ]
    figures = [[f"live, known at once: {PERCENTILES_HEAD}", error_text({**error, "in_90": None})]]
    return figures + ([] if smoothed is None else [["in hindsight, smoothed", error_text({**smoothed, "in_90": None})]])


def _evaluated(path: Trajectory, truth: Trajectory, building: Building | None) -> Mapping[str, Any]:
    """The metrics of one track; a track without floor labels (dead reckoning) has no floor score."""
    scores = evaluate(path, truth, building)
    return scores if any(path.floor) else {**scores, "fe": None}


def _score(scores: Mapping[str, Any], key: tuple[str, ...]) -> str:
    value: Any = scores
    for name in key:
        value = value[name] if value is not None else None
    if value is None or isinstance(value, int):
        return "" if value is None else f"{value:d}"
    return f"{np.degrees(value):.1f}" if SCORES[key][1] == "°" else f"{value:.3f}"
