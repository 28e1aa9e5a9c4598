"""Scores of a walk against ground truth: key figures, and the table of the report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pdr_graph.evaluation import error_text, evaluate
from pdr_graph.floor.building import Building
from pdr_graph.report.charts_and_tables import Table, table
from pdr_graph.types import Trajectory

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
PERCENTILES = "error 50 / 75 / 95 %"


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
    return [[PERCENTILES, error_text({**scores["ce"], "in_90": None})]]


def _live_figures(live: Mapping[str, Any]) -> list[list[str]]:
    """Key figures of the current poses, and of the walk in hindsight. live: of the summary."""
    error, smoothed = live["error"], live["hindsight"]["error"]
    if error is None:
        return [
            ["live: first pose after", f"{live['first_pose']:.1f} s"],
            ["live: median sigma", f"{live['sigma']:.1f} m"],
        ]
    figures = [[f"live, known at once: {PERCENTILES}", error_text({**error, "in_90": None})]]
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
