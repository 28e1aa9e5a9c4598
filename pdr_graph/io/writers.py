"""Writers of trajectories as CSV, TUM and GeoJSON, and of the summary. `gpx` writes GPX."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pdr_graph.frames import Frame
from pdr_graph.storage import write_text
from pdr_graph.types import Array, Estimate, Steps, Trajectory
from pdr_graph.whole_files import write_file

TRAJECTORY_HEADER = "time,x,y,heading,floor,sigma_x,sigma_y,cov_xy,sigma_heading"
ROUTES_HEADER = "route,probability,time,x,y,heading,floor"
STEPS_HEADER = "time,length,turn,sigma_length,sigma_turn,confidence"


def write_trajectory(path: Path, trajectory: Trajectory, clock_origin: float) -> None:
    """Write ``trajectory.csv``: time on the recorder's clock [s], metres, radians, covariance in the output axes."""
    lines = [TRAJECTORY_HEADER, *trajectory_rows(trajectory, clock_origin)]
    write_text(path, "\n".join(lines) + "\n")


def trajectory_rows(trajectory: Trajectory, clock_origin: float) -> Iterator[str]:
    """The rows of ``trajectory.csv``; nan where there is no covariance. clock_origin: is added to all times [s]."""
    covariance = trajectory.covariance
    if covariance is None:
        covariance = np.full((len(trajectory), 3, 3), np.nan)
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    table = np.column_stack(
        [trajectory.time + clock_origin, trajectory.position, trajectory.heading, sigma, covariance[:, 0, 1]]
    )
    for (t, x, y, heading, sx, sy, sh, xy), floor in zip(table.tolist(), trajectory.floor, strict=True):
        yield f"{t:.4f},{x:.4f},{y:.4f},{heading:.5f},{cell(floor)},{sx:.4f},{sy:.4f},{xy:.6g},{sh:.5f}"


def write_routes(path: Path, routes: Sequence[tuple[float, Trajectory]], clock_origin: float) -> None:
    """Write ``routes.csv``: the routes that a walk can have taken, each with its probability [s, m, rad]."""
    lines = [ROUTES_HEADER]
    for number, (probability, track) in enumerate(routes, 1):
        table = np.column_stack([track.time + clock_origin, track.position, track.heading]).tolist()
        for (t, x, y, heading), floor in zip(table, track.floor, strict=True):
            lines.append(f"{number},{probability:.4f},{t:.4f},{x:.4f},{y:.4f},{heading:.5f},{cell(floor)}")
    write_text(path, "\n".join(lines) + "\n")


def write_tum(path: Path, trajectory: Trajectory, clock_origin: float) -> None:
    """Write ``trajectory.tum`` for evo and similar tools: ``time x y z qx qy qz qw``, z = 0, heading about z.

    Rows without a heading have the identity rotation.
    """
    half = np.nan_to_num(trajectory.heading) / 2
    table = np.column_stack([trajectory.time + clock_origin, trajectory.position, np.sin(half), np.cos(half)])
    rows = "%.6f %.4f %.4f 0 0 0 %.8f %.8f\n" * len(table) % tuple(table.ravel().tolist())
    path.write_text(rows, encoding="ascii")


def write_steps(path: Path, steps: Steps, clock_origin: float) -> None:
    """Write one row per step: end [s], length [m], heading change since the row before [rad], sigmas, confidence."""
    lines = [STEPS_HEADER]
    sigmas = steps.sigma_length, steps.sigma_turn
    table = np.stack([steps.time + clock_origin, steps.length, steps.turn, *sigmas, steps.confidence], axis=1)
    lines += [
        f"{t:.4f},{length:.4f},{turn:.6f},{sl:.4f},{st:.6f},{sure:.3f}" for t, length, turn, sl, st, sure in table
    ]
    write_file(path, "\n".join(lines) + "\n")


def write_geojson(path: Path, estimate: Estimate, frame: Frame, clock_origin: float) -> None:
    """Write ``trajectory.geojson`` (RFC 7946): the track as a LineString with a point per row, then the fixes."""
    track = frame.to_lonlat(estimate.trajectory.position)
    line = {"times": (estimate.trajectory.time + clock_origin).round(3).tolist(), "kind": "trajectory"}
    features = [_feature("LineString", track, line)]
    if estimate.fixes:
        places = frame.to_lonlat(np.array([(f.x, f.y) for f in estimate.fixes]))
        for fix, place in zip(estimate.fixes, places, strict=True):
            about = {"kind": "fix", "time": fix.time + clock_origin, "sigma": fix.sigma}
            about |= {"residual": fix.residual, "weight": fix.weight, "reason": fix.reason}
            features.append(_feature("Point", place, about))
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}), encoding="utf-8")


def write_summary(path: Path, summary: dict[str, Any]) -> None:
    """Write ``summary.json``."""
    write_text(path, json.dumps(summary, indent=2, ensure_ascii=False, allow_nan=False) + "\n")


def cell(text: str) -> str:
    """A text as a cell of a CSV, quoted where necessary."""
    return '"' + text.replace('"', '""') + '"' if any(c in text for c in ',"\n') else text


def _feature(kind: str, lonlat: Array, properties: dict[str, Any]) -> dict[str, Any]:
    geometry = {"type": kind, "coordinates": np.round(lonlat, 8).tolist()}
    return {"type": "Feature", "geometry": geometry, "properties": properties}
