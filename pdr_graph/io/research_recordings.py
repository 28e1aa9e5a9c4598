"""Recordings of research data sets: GeoLife, the Oxford step counter, IPIN21Data.

GeoLife (Microsoft Research), ``.plt``: positions of a day, no other sensor.

Oxford step counter: an accelerometer alone, without a header. Either a file ``t_ns,ax,ay,az,…`` of the validation set,
or a folder with an ``accelerometer.csv`` of ``t_ns,accuracy,ax,ay,az``. Times are nanoseconds since the phone booted.

IPIN21Data (HafenCity University Hamburg): folders with ``acc.csv``, ``gyr.csv``, ``mag.csv``, ``bar.csv`` of Unix
milliseconds and values, separated by spaces, without a header. Positions beside them are metres in UTM zone 32N.
"""

from __future__ import annotations

import re
from pathlib import PurePosixPath

import numpy as np

from pdr_graph.errors import InputError, count
from pdr_graph.io.delimited import TextRows
from pdr_graph.io.signatures import OXFORD_WITH_ACCURACY
from pdr_graph.io.source import Source
from pdr_graph.io.validation import build_recording, plausible_times, receiver_fixes, surveyed
from pdr_graph.types import DAY_LENGTH, UTM_32N, Array, Fixes, Recording

EPOCH_1899 = -2_209_161_600.0  # [s] Unix time of 1899-12-30, where days count from


def geolife_fixes(source: Source, notes: list[str]) -> Fixes:
    """Read positions of GeoLife as fixes at Unix times [s]. The format has no accuracy."""
    name = source.single or ""
    rows = TextRows(source.where(name), (source.utf8(name).split(b"\n", 6) + [b""] * 7)[6], 7)  # after 6 header lines
    lat, lon, days = rows.floats((0, 1, 4)).T
    time: Array = np.round(days * DAY_LENGTH + EPOCH_1899)  # whole seconds; the decimals of a day are not exact
    time[~plausible_times(time)] = np.nan
    return receiver_fixes(np.column_stack([time, lat, lon, np.full(len(time), np.nan)]), notes, "GeoLife")


def read_oxford(source: Source) -> Recording:
    """Read one recording of the Oxford step counter.

    Leading rows of zeros, from before the phone's filter started, are left out.
    """
    name = source.single or source.named("accelerometer.csv") or ""
    first = 2 if re.match(OXFORD_WITH_ACCURACY, source.head(name)) else 1
    rows = TextRows(source.where(name), source.utf8(name)).floats((0, first, first + 1, first + 2))
    started = np.cumsum(np.any(rows[:, 1:] != 0, axis=1)) > 0
    rows = rows[started] * (1e-9, 1, 1, 1)
    zeros = count(int((~started).sum()), "row")
    notes = [f"accelerometer: {zeros} of zeros at the start left out"] if not started.all() else []
    return build_recording(source.where(name), source.path.stem, {"accelerometer": rows}, None, notes=notes)


IPIN21_FILES = {"acc.csv": "accelerometer", "gyr.csv": "gyroscope", "mag.csv": "magnetometer", "bar.csv": "barometer"}
FIX_NAME = re.compile(r"err(\d+(?:\.\d+)?)m?$")


def read_ipin21(source: Source) -> Recording:
    """Read one walk of IPIN21Data. The authors' track, a position per step, becomes ``truth``.

    The simulated fixes in the folder are alternatives, which are not read: the user chooses one with ``--fixes``.
    """
    files = {sensor: name for file, sensor in IPIN21_FILES.items() if (name := source.named(file))}
    values = {sensor: 1 if sensor == "barometer" else 3 for sensor in files}
    tables = {k: _ipin21_rows(source.where(name), source.text(name), values[k]) for k, name in files.items()}
    track = next((n for n in source.names if PurePosixPath(n).name.lower().startswith("groundtruth")), None)
    alternatives = [n for n in source.names if FIX_NAME.search(PurePosixPath(n).stem)]
    notes = (
        [f"{len(alternatives)} sets of simulated fixes in the folder: choose one with --fixes"] if alternatives else []
    )
    truth = None
    if track is not None:
        rows = _ipin21_rows(source.where(track), source.text(track), 3)
        truth = surveyed(rows[:, 0], rows[:, 1:3], epsg=UTM_32N)
    return build_recording(str(source.path), source.path.stem, tables, 0.0, truth=truth, notes=notes)


def ipin21_fixes(source: Source, notes: list[str]) -> Fixes:
    """Read simulated fixes of IPIN21Data: of Unix milliseconds, east, north and height.

    The name of the file states the 3-D error; its variance per axis is a third.
    """
    path = source.path
    stated = FIX_NAME.search(path.stem)
    if stated is None:
        raise InputError(path, "its name", repr(path.stem), "a name that states the error, as 'freq10_s_err5m.csv'")
    rows = _ipin21_rows(str(path), source.text(source.single or ""), 3)
    sigma = np.full(len(rows), float(stated[1]) / np.sqrt(3))
    return Fixes(rows[:, 0], rows[:, 1:3], sigma, ("",) * len(rows), UTM_32N)


def _ipin21_rows(where: str, text: str, values: int) -> Array:
    """Times [s] and values ``(n, 1 + values)`` of a file without a header."""
    delimiter = next((d for d in "\t, " if d in text.strip().partition("\n")[0]), " ")
    rows = TextRows(where, text.encode(), delimiter=delimiter)
    return rows.floats(range(1 + values)) * ([0.001] + values * [1.0])
