"""Several trajectories of one walk side by side: their scores as a table, against a truth or against the first."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pdr_graph.errors import InputError, count, one_line
from pdr_graph.evaluation import TOLERANCE, evaluate, pair
from pdr_graph.floor.building import Building
from pdr_graph.io.likely_causes import clock_hint
from pdr_graph.io.tables import read_trajectory
from pdr_graph.types import OneLineRepr, Trajectory

RESULT = ("trajectory.csv", "summary.json")  # of an output folder of smooth and replay


@dataclass(frozen=True)
class Comparison(OneLineRepr):
    """Scores of several trajectories.

    reference: name of the truth, or of the first trajectory; scores: of ``evaluate`` by name, with ``distance`` [m] and
    ``duration`` [s]. They count equal samples only if ``n`` is the same.
    """

    reference: str
    scores: Mapping[str, Mapping[str, Any]]

    def _summary(self) -> list[str]:
        return [f"against {self.reference!r}", count(len(self.scores), "trajectory").replace("ys", "ies")]


def compare(
    tracks: Mapping[str, Trajectory], truth: Trajectory | None, reference: str = "", floor: Building | None = None
) -> Comparison:
    """Score each of several trajectories against the truth; without one, all others against the first.

    reference: name of the truth. Raises InputError if a trajectory has no sample at a time of the reference.
    """
    first = next(iter(tracks))
    against, name = (tracks[first], first) if truth is None else (truth, reference)
    scored = tracks if truth is not None else {other: track for other, track in tracks.items() if other != first}
    for other, track in scored.items():
        if not len(pair(track, against).time):
            span, expected = (f"{t[0]:.3f} to {t[-1]:.3f}" for t in (track.time, against.time))
            hint = clock_hint((track.time[0], track.time[-1]), (against.time[0], against.time[-1]))
            raise InputError(other, "time", f"{span}{hint}", f"times within {TOLERANCE} s of {name}, {expected}")
    scores = {other: _scores(track, against, floor) for other, track in scored.items()}
    return Comparison(name, scores)


def _scores(track: Trajectory, against: Trajectory, floor: Building | None) -> dict[str, Any]:
    """The scores of one trajectory; the floor error is unknown for one without floors, as all of TUM's are."""
    scores = _size(track) | evaluate(track, against, floor)
    return scores if any(track.floor) else scores | {"fe": None}


def _size(track: Trajectory) -> dict[str, float]:
    """Distance [m] and duration [s] of a trajectory."""
    distance = float(np.hypot(*np.diff(track.position, axis=0).T).sum())
    return {"distance": round(distance, 3), "duration": round(float(np.ptp(track.time)), 3)}


HEADING = "he"  # in radians in the scores, in degrees for people
# Heading of a column: key of its score, key of the statistic, digits
COLUMNS: dict[str, tuple[str, str, int]] = {
    "distance [m]": ("distance", "", 1),
    "CE50 [m]": ("ce", "p50", 2),
    "CE75 [m]": ("ce", "p75", 2),
    "CE95 [m]": ("ce", "p95", 2),
    "CE max [m]": ("ce", "max", 2),
    "HE50 [°]": (HEADING, "p50", 1),
    "EAG [m/s]": ("eag", "", 4),
    "VE [m/s]": ("ve", "", 3),
    "CA [m]": ("ca", "", 2),
    "OE": ("oe", "", 4),
    "FE": ("fe", "", 3),
    "samples": ("n", "", 0),
}


def table(comparison: Comparison) -> str:
    """The scores as a text: a row per trajectory, a column per metric; those that no row has are left out."""
    rows = [[_cell(scores, *column) for column in COLUMNS.values()] for scores in comparison.scores.values()]
    used = [n for n in range(len(COLUMNS)) if any(row[n] for row in rows)]
    heads = list(COLUMNS)
    lines = [["", *(heads[n] for n in used)]]
    names = [one_line(name) for name in comparison.scores]
    lines += [[name, *(row[n] or "—" for n in used)] for name, row in zip(names, rows, strict=True)]
    widths = [max(len(line[n]) for line in lines) for n in range(len(lines[0]))]
    aligned = (
        [line[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(line[1:], widths[1:], strict=True))]
        for line in lines
    )
    return "\n".join(["  ".join(cells).rstrip() for cells in aligned] + [f"against {one_line(comparison.reference)}"])


def _cell(scores: Mapping[str, Any], key: str, statistic: str, digits: int) -> str:
    value = scores[key]
    value = value[statistic] if statistic and value is not None else value
    if value is None:
        return ""
    return f"{np.degrees(value) if key == HEADING else value:.{digits}f}"


def read_tracks(paths: Sequence[Path]) -> dict[str, Trajectory]:
    """The trajectories of files and of output folders of ``smooth`` and ``replay``, by the shortest different names.

    Raises InputError if a file cannot be read, or if folders have different frames.
    """
    frames = {}
    tracks = {}
    for name, path in zip(_names(paths), paths, strict=True):
        file = path / RESULT[0] if path.is_dir() else path
        if path.is_dir() and not file.exists():
            expected = "an output folder of smooth or replay, or a trajectory as CSV or TUM"
            raise InputError(path, "", f"a folder without {RESULT[0]}", expected)
        tracks[name] = read_trajectory(file)
        frame = _frame(file.with_name(RESULT[1]))
        if frame is not None:
            frames[path] = frame
    for path, frame in frames.items():
        first = next(iter(frames))
        if frame != frames[first]:
            found = ", ".join(f"{key} {value}" for key, value in frame.items())
            raise InputError(path, "frame", found, f"that of {first}: results with one plan, or with the same fixes")
    return tracks


def _frame(summary: Path) -> dict[str, Any] | None:
    """The frame of a result; None without a summary."""
    try:
        return dict(json.loads(summary.read_text(encoding="utf-8"))["frame"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _names(paths: Sequence[Path]) -> list[str]:
    """A name of each path: its last part, or as many as make them different."""
    for parts in range(1, max(len(path.parts) for path in paths) + 1):
        names = ["/".join(path.parts[-parts:]) for path in paths]
        if len(set(names)) == len(names):
            return names
    twice = next(path for path in paths if paths.count(path) > 1)
    raise InputError(twice, "", "the same trajectory twice", "different trajectories")
