"""Writers of trajectories as CSV, TUM and GeoJSON, and of the summary. `gpx` writes GPX.

TUM has many numbers a row: they are written equal to the byte to those of Python's ``%.4f``, in a fraction of the time.
Four characters are one 32-bit word, which is looked up. Where a text is shorter it has zero bytes, removed at the end.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdr_graph.frames import Frame
from pdr_graph.storage import write_text
from pdr_graph.types import Array, Estimate, Steps, Trajectory
from pdr_graph.whole_files import write_file

TRAJECTORY_HEADER = "time,x,y,heading,floor,sigma_x,sigma_y,cov_xy,sigma_heading"
ROUTES_HEADER = "route,probability,time,x,y,heading,floor"
STEPS_HEADER = "time,length,turn,sigma_length,sigma_turn"


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
    half, (x, y) = np.nan_to_num(trajectory.heading) / 2, trajectory.position.T
    position = [decimals(trajectory.time + clock_origin, 6), decimals(x, 4, b" "), decimals(y, 4, b" ")]
    rotation = [decimals(np.sin(half), 8, b" 0 0 0 "), decimals(np.cos(half), 8, b" ")]
    path.write_bytes(text_rows([*position, *rotation]))


def write_steps(path: Path, steps: Steps, clock_origin: float) -> None:
    """Write one row per step: its end [s], length [m], heading change since the row before [rad], and both sigmas."""
    lines = [STEPS_HEADER]
    table = np.stack(
        [steps.time + clock_origin, steps.length, steps.turn, steps.sigma_length, steps.sigma_turn], axis=1
    )
    lines += [f"{t:.4f},{length:.4f},{turn:.6f},{sl:.4f},{st:.6f}" for t, length, turn, sl, st in table]
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


Words = NDArray[np.uint32]
GROUP = 4  # digits of a word
THOUSANDS = 10**GROUP
LARGEST_OUTPUT = 1e12  # of numbers


def text_rows(columns: Sequence[Words]) -> bytes:
    """Rows of text, one to a line, from their columns by `decimals`."""
    parts = [*columns, _words(b"\n")[None]]
    rows = np.empty((len(columns[0]), sum(part.shape[1] for part in parts)), np.uint32)
    begin = 0
    for part in parts:
        rows[:, begin : begin + part.shape[1]] = part
        begin += part.shape[1]
    return rows.tobytes().translate(None, b"\0")


def decimals(values: Array, places: int, before: bytes = b"") -> Words:
    """Numbers ``(n,)`` with ``places`` decimals as the characters ``(n, w)`` of a column, each after a text ``before``.

    Raises ValueError for finite numbers that are not below LARGEST_OUTPUT.
    """
    finite = np.isfinite(values)
    size = np.where(finite, np.abs(values), 0.0)
    if not np.all(size < LARGEST_OUTPUT):
        raise ValueError(f"found numbers up to {size.max()}, expected less than {LARGEST_OUTPUT:.0e}")
    whole = np.floor(size)
    scaled = (size - whole) * 10**places  # the difference is exact, so that the product alone is rounded
    carry, fraction = np.divmod(np.rint(scaled).astype(np.int64), 10**places)
    signs = zip(_words(before + b"-"), _words(before + b"\0"), strict=True)
    columns = [np.where(np.signbit(values), minus, plus) for minus, plus in signs]
    columns += [*_whole_number(whole.astype(np.int64) + carry), *_words(b"."), *_digits(fraction, places)]
    texts = np.empty((len(values), len(columns)), np.uint32)
    for place, column in enumerate(columns):
        texts[:, place] = column
    # uncertain: distance from a half, in units of the last digit, at which rounding is left to Python
    by_python = ~finite | (np.abs(scaled - np.floor(scaled) - 0.5) < 1e-6)
    for row in np.flatnonzero(by_python).tolist():
        text = before + b"%.*f" % (places, values[row])
        texts[row] = _words(text.ljust(GROUP * len(columns), b"\0"))
    return texts


def _words(text: bytes) -> Words:
    """A text as words."""
    return np.frombuffer(text + bytes(-len(text) % GROUP), np.uint32)


_CHARACTERS = (np.arange(THOUSANDS)[:, None] // [1000, 100, 10, 1] % 10 + ord("0")).astype(np.uint8)
_LEADING = np.arange(THOUSANDS)[:, None] < [1000, 100, 10, 0]
FULL = _words(_CHARACTERS.tobytes())  # the texts of 0000 to 9999
SHORT = _words(np.where(_LEADING, 0, _CHARACTERS).astype(np.uint8).tobytes())  # the same without leading zeros


def _groups(numbers: NDArray[np.int64], count: int) -> list[NDArray[np.int64]]:
    """The last ``count`` groups of four digits of whole numbers, the highest first."""
    groups = list[NDArray[np.int64]]()
    for _ in range(count):
        numbers, group = np.divmod(numbers, THOUSANDS)
        groups.insert(0, group)
    return groups


def _whole_number(numbers: NDArray[np.int64]) -> list[Words]:
    """The digits of whole numbers without leading zeros."""
    count = -(-len(str(numbers.max(initial=0))) // GROUP)
    columns = list[Words]()
    for place, group in enumerate(_groups(numbers, count)):
        unit = THOUSANDS ** (count - 1 - place)
        column = np.where(numbers >= THOUSANDS * unit, FULL[group], SHORT[group])
        columns.append(np.where(numbers >= unit, column, 0) if unit > 1 else column)
    return columns


def _digits(numbers: NDArray[np.int64], count: int) -> list[Words]:
    """The last ``count`` digits of whole numbers."""
    groups = _groups(numbers * 10 ** (-count % GROUP), -(-count // GROUP))  # the last ends with zeros that are cut
    columns = [FULL[group] for group in groups]
    if count % GROUP:
        columns[-1] = _words((b"\xff" * (count % GROUP)).ljust(GROUP, b"\0")) & columns[-1]
    return columns
