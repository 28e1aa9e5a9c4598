"""Tables of ranges to anchors: UWB, Wi-Fi RTT, BLE ranging."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pdr_graph.errors import InputError
from pdr_graph.io.tables import check_clock, check_rows, read_table
from pdr_graph.types import Beacons, Ranges, Recording

RANGE_SIGMA = 0.3  # [m] of a range with line of sight, if the table has no sigma; chosen by hand
ANCHOR_SIGMA = 0.1  # [m] per axis of an anchor's place whose list states none: tape or laser; chosen by hand
MAXIMUM_RANGE = 1000.0  # [m]; a larger distance is in other units


def read_ranges(path: Path, recording: Recording, anchors: Beacons) -> Ranges:
    """Read a table of ranges ``time,anchor,range[,sigma]``, sorted by time.

    time: on the recorder's clock [s]; anchor: a name in the list of anchors; range, sigma: [m]. anchors: in the frame
    of the walk. Raises InputError naming the row, also if no range lies within the recording.
    """
    numbers, words = read_table(path, [("time", "range")], optional=("sigma",), words=("anchor",), recording=recording)
    time, distance = numbers["time"] - recording.clock_origin, numbers["range"]
    sigma = np.nan_to_num(numbers.get("sigma", np.full(len(time), np.nan)), nan=RANGE_SIGMA)
    least_most = f"metres, from 0 to {MAXIMUM_RANGE:.0f}"
    check_rows(path, (distance < 0) | (distance > MAXIMUM_RANGE), distance, "range", least_most)
    check_rows(path, sigma <= 0, sigma, "sigma", "a standard deviation above 0 m")
    number = {label.lower(): m for m, label in enumerate(anchors.label)}
    anchor = np.array([number.get(name.lower(), -1) for name in words["anchor"]], dtype=np.intp)
    if (anchor < 0).any():
        unknown = words["anchor"][int(np.argmax(anchor < 0))]
        expected = f"one of {', '.join(anchors.label)[:80]}"
        raise InputError(path, f"data row {int(np.argmax(anchor < 0)) + 1}, anchor", f"{unknown[:40]!r}", expected)
    order = np.argsort(time, kind="stable")
    check_clock(path, time, recording)
    measured = time[order], anchor[order], distance[order], sigma[order]
    return Ranges(*measured, anchors.label, anchors.position, anchors.sigma)
