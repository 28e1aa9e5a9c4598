"""The rows of a diary from fine entries: visits, the legs between them, and entries that stay as they are."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import groupby, pairwise

import numpy as np

from pdr_graph.lifelog.day import GAP, VEHICLE, WALKING
from pdr_graph.lifelog.timeline import STAY, TimelineEntry
from pdr_graph.lifelog.visits import Track, Visit, lonlat_of

# Chosen by hand
SHORTEST_GAP = 600.0  # [s] a shorter silence on the way belongs to the walk or ride
FASTEST_WALK = 2.5  # [m/s]
MOVING = (WALKING, VEHICLE)


def rows_of(fine: Sequence[TimelineEntry], visits: Sequence[Visit], track: Track) -> list[TimelineEntry]:
    """The rows of a diary: a stay for each visit, with all entries of its time as parts, and the legs between visits.

    fine: entries of the timeline; visits and track: of the same outings. Entries on a floor plan remain.
    """
    begins = [visit.start for visit in visits]
    bounds = sorted({time for visit in visits for time in (visit.start, visit.end)})
    pieces = [piece for entry in fine for piece in cut(entry, bounds, track)]
    rows: list[TimelineEntry] = []
    for group, own in groupby(pieces, key=lambda piece: _group(piece, visits, begins, track)):
        if group == _ON_PLAN:
            rows += own
        elif group >= 0:
            rows.append(_stay(visits[group], tuple(own)))
        else:
            rows += _legs(list(own), track)
    return rows


_ON_PLAN, _ON_THE_WAY = -2, -1


def _group(piece: TimelineEntry, visits: Sequence[Visit], begins: Sequence[float], track: Track) -> int:
    """Number of the visit of a piece; _ON_PLAN for one that remains as it is, _ON_THE_WAY between visits.

    begins: starts of the visits [s].
    """
    middle = (piece.start + piece.end) / 2
    n = bisect_right(begins, middle) - 1
    if n >= 0 and middle < visits[n].end:
        return n
    rows = track.between(piece.start, piece.end)
    seen = track.plan[rows]
    return _ON_PLAN if piece.kind != GAP and (not len(seen) or seen.any()) else _ON_THE_WAY


def cut(entry: TimelineEntry, times: Sequence[float], track: Track) -> list[TimelineEntry]:
    """The entry, and its parts, in pieces between some times [s]; the distance is divided by the path's length.

    times: in order, each once.
    """
    inside = times[bisect_right(times, entry.start) : bisect_left(times, entry.end)]
    if not inside:
        return [entry]
    edge = [entry.start, *inside, entry.end]
    length = np.array([track.length(a, b) for a, b in pairwise(edge)])
    share = length / length.sum() if length.sum() > 0 else np.diff(edge) / (entry.end - entry.start)
    parts = [piece for part in entry.parts for piece in cut(part, times, track)]
    found = []
    for (start, end), of in zip(pairwise(edge), share.tolist(), strict=True):
        own = tuple(part for part in parts if start <= part.start and part.end <= end)
        piece = replace(entry, start=start, end=end, distance=of * entry.distance, parts=own)
        if own:
            piece = replace(piece, distance=_distance(own) if entry.distance else 0.0, observed=_observed(own))
        found.append(piece)
    return found


def _stay(visit: Visit, parts: tuple[TimelineEntry, ...]) -> TimelineEntry:
    """The row of a visit."""
    longitude, latitude = lonlat_of(visit.middle)
    floor = tuple(dict.fromkeys(label for part in parts for label in part.floor))
    own = TimelineEntry(STAY, visit.start, visit.end, floor=floor, observed=_observed(parts), parts=parts)
    return replace(own, latitude=latitude, longitude=longitude, sigma=visit.sigma)


def _legs(pieces: Sequence[TimelineEntry], track: Track) -> Iterator[TimelineEntry]:
    """The walks, rides and long silences between two visits."""
    longest = max((p.end - p.start for p in pieces if p.kind in MOVING), default=0.0)
    kinds = [_leg_kind(piece, longest, track) for piece in pieces]
    if not any(kinds) and all(piece.kind == GAP for piece in pieces):  # nobody saw how the person went
        kinds = [_kind_at_speed(pieces, track)] * len(pieces)
    kinds = [
        kind or _kind_beside(kinds, n) or piece.kind for n, (kind, piece) in enumerate(zip(kinds, pieces, strict=True))
    ]
    for kind, own in groupby(zip(kinds, pieces, strict=True), key=lambda pair: pair[0]):
        yield _leg(kind, [piece for _, piece in own], track)


def _kind_beside(kinds: Sequence[str], n: int) -> str:
    """Kind of the leg before the nth piece if it is a walk or a ride, else of the one after it; "" without any leg."""
    before = next((kind for kind in reversed(kinds[:n]) if kind), "")
    after = next((kind for kind in kinds[n + 1 :] if kind), "")
    return next((kind for kind in (before, after) if kind in MOVING), before or after)


def _kind_at_speed(gaps: Sequence[TimelineEntry], track: Track) -> str:
    """Kind of a way without data, by the straight line between its ends."""
    start, end = gaps[0].start, gaps[-1].end
    return VEHICLE if track.length(start, end) > FASTEST_WALK * (end - start) else WALKING


def _leg_kind(piece: TimelineEntry, longest: float, track: Track) -> str:
    """Kind of the leg that a piece makes by itself; "" if it belongs to the leg beside it."""
    lasted = piece.end - piece.start
    # shortest jump [m] over a short silence, from which a fast one is a ride
    if piece.kind == GAP and track.length(piece.start, piece.end) > max(FASTEST_WALK * lasted, 300.0):
        return VEHICLE if lasted < SHORTEST_GAP else GAP
    if piece.kind in MOVING:
        # shortest leg [s]: a shorter walk or ride beside a longer one belongs to it
        return piece.kind if lasted >= min(120.0, longest) else ""
    return GAP if piece.kind == GAP and lasted >= SHORTEST_GAP else ""


def _leg(kind: str, pieces: Sequence[TimelineEntry], track: Track) -> TimelineEntry:
    """One row of consecutive pieces; a short silence counts with the straight line between its ends."""
    if len(pieces) == 1 and pieces[0].kind == kind:
        return pieces[0]
    parts = tuple(_bridged(piece, kind, track) if piece.kind == GAP and kind != GAP else piece for piece in pieces)
    distance = 0.0 if kind == GAP else _distance(parts)
    return TimelineEntry(
        kind, pieces[0].start, pieces[-1].end, distance, observed=_observed(parts) if kind != GAP else 1.0, parts=parts
    )


def _bridged(gap: TimelineEntry, kind: str, track: Track) -> TimelineEntry:
    """A short silence as a part of a leg, without data."""
    return replace(gap, kind=kind, distance=track.length(gap.start, gap.end), observed=0.0)


def _distance(parts: Sequence[TimelineEntry]) -> float:
    return float(sum(part.distance for part in parts))


def _observed(parts: Sequence[TimelineEntry]) -> float:
    """Share of the time of parts with data."""
    lasted = np.array([part.end - part.start for part in parts])
    seen = np.array([0.0 if part.kind == GAP else part.observed for part in parts])
    return float(lasted @ seen / max(lasted.sum(), 1e-9))
