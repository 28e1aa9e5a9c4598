"""Merge positions and receptions of several exports. The result does not depend on their order or overlaps.

A position stands for its whole second. Of several in a second the most accurate is kept: the same fix has another
number of decimals in another export. Google's processed path is kept apart from what was measured, and only where
nothing accurate was measured near in time. All rows are of one day.
"""

from __future__ import annotations

import numpy as np

from pdr_graph.io.past_day import CM, GOOGLE_PATH, NO_ACCURACY, WIFI, Rows
from pdr_graph.io.validation import RECEIVER
from pdr_graph.lifelog.past.past_rows import PATH_ACCURACY
from pdr_graph.types import Array, Index, Mask

SECOND_MS = 1000


def merged_positions(rows: Rows) -> Rows:
    """The positions of a day without duplicates, in order of time, measured ones before the path.

    Positions that were computed from receptions are left out.
    """
    rows = rows[rows["source"] != WIFI]
    is_path = rows["source"] == GOOGLE_PATH
    path = rows[is_path]
    measured = _best_of_each_second(rows[~is_path])
    path = path[~_shadowed(path, measured)]
    if not len(path):
        return measured
    both = np.concatenate([measured, _best_of_each_second(path)])
    return both[np.lexsort((both["source"], both["time"]))]


def merged_sightings(rows: Rows) -> Rows:
    """The receptions of a day without duplicates, the strongest of each access point and time, in order of time."""
    rows = rows[np.lexsort((-rows["rssi"].astype(int), rows["mac"], rows["time"]))]
    again = (np.diff(rows["time"]) == 0) & (np.diff(rows["mac"]) == 0)
    return rows[~np.append(False, again)[: len(rows)]]


def changes(before: Rows, after: Rows) -> tuple[int, int]:
    """Number of positions that are new in `after`, and that replace a less accurate one."""
    _, old, now = np.intersect1d(_keys(before), _keys(after), assume_unique=True, return_indices=True)
    return len(after) - len(now), int((before[old] != after[now]).sum())


def assumed_accuracy(rows: Rows) -> Array:
    """The 68 % radius ``(n,)`` [m], where it is unknown that which a reader assumes."""
    return np.where(rows["accuracy"] == NO_ACCURACY, RECEIVER.accuracy, rows["accuracy"] / CM)


def _keys(rows: Rows) -> Index:
    """A number for each position, equal for those of which one is kept."""
    return 2 * (rows["time"] // SECOND_MS) + (rows["source"] == GOOGLE_PATH)


def _best_of_each_second(rows: Rows) -> Rows:
    """The most accurate position of each second; of equally accurate ones always the same one."""
    second = rows["time"] // SECOND_MS
    if (np.diff(second) > 0).all():
        return rows
    ties = (rows["source"], rows["lon"], rows["lat"], rows["time"], rows["accuracy"])
    order = np.lexsort((*ties, assumed_accuracy(rows), second))
    return rows[order][np.append(True, np.diff(second[order]) > 0)[: len(rows)]]


def _shadowed(path: Rows, measured: Rows) -> Mask:
    """True for points of the path near in time to a measured position that is more accurate."""
    times = (measured["time"] // SECOND_MS)[assumed_accuracy(measured) <= PATH_ACCURACY]
    if not len(times):
        return np.zeros(len(path), bool)
    second = path["time"] // SECOND_MS
    after = np.searchsorted(times, second)
    gaps = [np.abs(times[np.clip(after + by, 0, len(times) - 1)] - second) for by in (-1, 0)]
    # shadow [s] from an accurate measurement within which the path is not used; chosen by hand
    return np.minimum(*gaps) <= 300
