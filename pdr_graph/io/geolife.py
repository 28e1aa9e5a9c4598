"""GeoLife trajectories (Microsoft Research), ``.plt``: positions of a day, no other sensor."""

from __future__ import annotations

import numpy as np

from pdr_graph.io.delimited import TextRows
from pdr_graph.io.source import Source
from pdr_graph.io.validation import build_recording, plausible_times, receiver_fixes
from pdr_graph.types import DAY_LENGTH, Array, Fixes, Recording

NAME = "GeoLife"
EPOCH_1899 = -2_209_161_600.0  # [s] Unix time of 1899-12-30, where days count from


def recognizes(source: Source) -> bool:
    """True if the first line is that of a GeoLife trajectory."""
    return source.single is not None and source.head(source.single).startswith(b"Geolife trajectory")


def read(source: Source) -> Recording:
    """Read one trajectory as a recording of fixes alone."""
    notes: list[str] = []
    fixes = read_fixes(source, notes)
    return build_recording(str(source.path), source.path.stem, {}, 0.0, fixes, notes=notes)


def read_fixes(source: Source, notes: list[str]) -> Fixes:
    """Read positions as fixes at Unix times [s]. The format has no accuracy."""
    name = source.single or ""
    rows = TextRows(source.where(name), (source.utf8(name).split(b"\n", 6) + [b""] * 7)[6], 7)  # after 6 header lines
    lat, lon, days = rows.floats((0, 1, 4)).T
    time: Array = np.round(days * DAY_LENGTH + EPOCH_1899)  # whole seconds; the decimals of a day are not exact
    time[~plausible_times(time)] = np.nan
    return receiver_fixes(np.column_stack([time, lat, lon, np.full(len(time), np.nan)]), notes, "GeoLife")
