"""Positions that a receiver reported, as fixes."""

from __future__ import annotations

import numpy as np

from pdr_graph.types import LONLAT, Array, Fixes, Trajectory

RADIUS_68 = 1.51  # [σ per axis] the radius that holds 68 % of a circular normal distribution: a phone's "accuracy"
EXTRAPOLATED, FEWEST = 1.5, 4  # times as far off as it says is a position of fewer satellites than one takes
USUAL_ACCURACY = 7.5  # [m] 68 % radius of a phone outdoors, where the log has none


def receiver_fixes(table: Array, notes: list[str], source: str = "GNSS", satellites: Array | None = None) -> Fixes:
    """Fixes of a receiver's rows: time [s], latitude [deg], longitude [deg], accuracy (68 % radius) [m].

    table: ``(n, 4)`` in any order. satellites: ``(n,)`` that each position was made of, NaN where unknown: beside a
    stated accuracy their number tells no more on real walks, unless they were too few.

    Left out and noted: rows without a position or off the globe, rows with a negative accuracy, by which iOS marks a
    position as invalid, and repeats of an epoch. An accuracy of zero or none is unknown.
    """
    if satellites is not None:
        few = satellites < FEWEST
        table = np.column_stack([table[:, :3], np.where(few, EXTRAPOLATED, 1.0) * table[:, 3]])
    time, lat, lon, accuracy = table.T
    valid = np.isfinite(table[:, :3]).all(axis=1) & (np.abs(lat) <= 90) & (np.abs(lon) <= 180)
    valid &= ~(accuracy < 0) & ~((lat == 0) & (lon == 0))
    if not valid.all():
        notes.append(f"{source}: {int((~valid).sum())} of {len(table)} positions were marked invalid or missing")
    table = table[valid][np.argsort(time[valid], kind="stable")]
    repeated = np.zeros(len(table), dtype=bool)
    repeated[1:] = np.diff(table[:, 0]) == 0
    if repeated.any():
        notes.append(f"{source}: {int(repeated.sum())} repeats of an epoch were left out")
    time, lat, lon, accuracy = table[~repeated].T
    unknown = ~(accuracy > 0) | np.isinf(accuracy)
    if unknown.any():
        notes.append(
            f"{source}: {int(unknown.sum())} positions have no accuracy: {USUAL_ACCURACY} m (68 %) was assumed"
        )
    sigma = np.where(unknown, USUAL_ACCURACY, accuracy) / RADIUS_68
    return Fixes(time, np.column_stack([lon, lat]), sigma, ("",) * len(time), LONLAT, (source,) * len(time))


def surveyed(time: Array, position: Array, floor: tuple[str, ...] | None = None, epsg: int | None = None) -> Trajectory:
    """A truth of places that someone surveyed: headings are unknown."""
    return Trajectory(time, position, np.full(len(time), np.nan), floor or ("",) * len(time), epsg=epsg)
