"""Leave times out of an observation, so that nothing measured then remains in it.

Steps before and after such a time are separated by a gap, whose ends are all that it shows of the time between.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pdr_graph.frames import Frame, enu
from pdr_graph.gait.step_chunks import gap, shifted
from pdr_graph.types import INSTANT, Array, Mask, Steps, select_rows, take, with_offset

if TYPE_CHECKING:
    from pdr_graph.lifelog.observation import Observation

DELETED = "part of this recording was deleted"  # note of an observation that was cut
AT_END = 2.0  # [s] from either end of a recording, within which its `Ends` were measured
Span = tuple[float, float]
TABLES = ("fixes", "headings", "barometer", "bluetooth", "wifi")  # fields with a row per time


def without_times(observation: Observation, spans: Sequence[Span], note: str) -> Observation | None:
    """The observation without all that was measured in some times; itself if nothing was, None if nothing remains.

    spans: start and end of each, Unix times [s]; note: replaces the notes, which may state what was measured then.
    """
    start, end = observation.epoch, observation.epoch + observation.duration
    inside = [(a - start, b - start) for a, b in _merged(spans) if a < end - INSTANT and b > start + INSTANT]
    if not inside:
        return observation
    begins = next((b for a, b in inside if a <= 0), 0.0)
    ends = next((a for a, b in inside if b >= observation.duration), observation.duration)
    if begins >= ends:
        return None
    cut = _without_rows(observation, inside)
    if cut.steps is None and not len(cut.fixes):
        return None
    return replace(_shifted(_reframed(cut, observation), -begins), duration=ends - begins, notes=(note,))


def _merged(spans: Sequence[Span]) -> list[Span]:
    """The spans in order of time, overlapping ones as one."""
    found: list[Span] = []
    for start, end in sorted(spans):
        if found and start <= found[-1][1]:
            found[-1] = found[-1][0], max(end, found[-1][1])
        else:
            found.append((start, end))
    return found


def _outside(time: Array, spans: Sequence[Span]) -> Mask:
    """True ``(n,)`` for the times that lie in none of the spans; of rows with two times, both."""
    inside = np.any([(time >= a) & (time <= b) for a, b in spans], axis=0)
    return ~(inside if inside.ndim == 1 else inside.any(axis=1))


def _without_rows(part: Observation, spans: Sequence[Span]) -> Observation:
    """The observation without the rows whose time lies in a span [s]."""
    rows: dict[str, Any] = {}
    for name in TABLES:
        table = getattr(part, name)
        rows[name] = table if table is None else select_rows(table, _outside(table.time, spans))
    steps, looks = part.steps, part.looks
    for a, b in spans:
        if steps is not None:
            steps, looks = steps_without(steps, looks, a, b)
    at_ends = any(a <= AT_END or b >= part.duration - AT_END for a, b in spans)
    return replace(
        part,
        **rows,
        steps=steps,
        looks=looks,
        ends=None if at_ends else part.ends,
        measurements=tuple(_table_without(table, spans) for table in part.measurements),
    )


def _table_without(table: Any, spans: Sequence[Span]) -> Any:
    """The measurement table without the rows in the spans, and without the anchors that only these refer to."""
    table = take(table, np.flatnonzero(_outside(table.time, spans)))
    tables = getattr(type(table), "tables", ())
    if not tables:
        return table
    column = type(table).reference
    used, number = np.unique(getattr(table, column), return_inverse=True)
    named = {name: getattr(table, name) for name in tables}
    kept = {n: c[used] if isinstance(c, np.ndarray) else tuple(c[i] for i in used) for n, c in named.items()}
    return replace(table, **kept, **{column: number.astype(np.intp)})


def steps_without(steps: Steps, looks: Array, a: float, b: float) -> tuple[Steps | None, Array]:
    """The steps with a gap from `a` to `b` [s], and the looks for their rows; None if no step remains."""
    begin = steps.time - steps.duration
    dropped, before = (steps.time > a) & (begin < b), int(np.count_nonzero(steps.time <= a))
    a = max(steps.start, min([a, *begin[dropped]]), *steps.time[max(before - 1, 0) : before])
    b = min(steps.end, max([b, *steps.time[dropped]]))
    if a >= b:
        return steps, looks
    columns = {name: column[~dropped] for name, column in vars(steps).items() if isinstance(column, np.ndarray)}
    seen = looks[:-1][~dropped]
    if before < len(seen):  # the next step turns by what it turned itself; the pause before it is partly left out
        columns["turn"][before] -= columns["pause_turn"][before]
        columns["pause_turn"][before] = seen[before] = 0.0
    last = looks[-1] if before < len(seen) else 0.0
    final = steps.final_turn if before < len(seen) else 0.0
    if steps.start < a and b < steps.end:
        row = gap(a, b)
        columns = {name: np.insert(column, before, getattr(row, name)[0]) for name, column in columns.items()}
        seen = np.insert(seen, before, 0.0)
    if not (columns["length"] > 0).any():
        return None, np.empty(0)
    start, end = b if a <= steps.start else steps.start, a if b >= steps.end else steps.end
    return replace(steps, start=start, end=end, **columns, final_turn=final), np.append(seen, last)


def _reframed(part: Observation, whole: Observation) -> Observation:
    """The observation in a frame about its first position, since the frame is about the first of all."""
    if part.frame.kind != "enu" or len(part.fixes) == len(whole.fixes):
        return part
    tables: tuple[Any, ...] = (part.fixes, part.beacons, *part.measurements)
    placed = [table.position for table in tables if hasattr(table, "position")]
    first = next((p[np.isfinite(p).all(axis=1)][:1] for p in placed if np.isfinite(p).all(axis=1).any()), None)
    if first is None:
        return replace(part, frame=Frame())
    lon, lat = part.frame.to_lonlat(first)[0].tolist()
    frame = enu(lat, lon)
    fixes, beacons, *measured = (
        replace(table, position=frame.from_frame(part.frame, table.position)) if hasattr(table, "position") else table
        for table in tables
    )
    return replace(part, frame=frame, fixes=fixes, beacons=beacons, measurements=tuple(measured))


def _shifted(part: Observation, by: float) -> Observation:
    """The observation with `by` seconds added to all times, beginning as much earlier."""
    if not by:
        return part
    tables = {name: getattr(part, name) for name in TABLES}
    moved = {name: table if table is None else replace(table, time=table.time + by) for name, table in tables.items()}
    steps = part.steps
    if steps is not None:
        steps = shifted(steps, by)
    measured = tuple(with_offset(table, by) for table in part.measurements)
    return replace(part, epoch=part.epoch - by, **moved, steps=steps, measurements=measured)
