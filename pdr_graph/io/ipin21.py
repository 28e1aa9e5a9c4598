"""The folders of IPIN21Data (HafenCity University Hamburg): ``acc.csv``, ``gyr.csv``, ``mag.csv``, ``bar.csv``.

Unix milliseconds and values, separated by spaces, without a header. Positions beside them are metres in UTM zone 32N.
"""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath

import numpy as np

from pdr_graph.errors import InputError
from pdr_graph.io.delimited import TextRows
from pdr_graph.io.source import Source
from pdr_graph.io.validation import build_recording, surveyed
from pdr_graph.types import UTM_32N, Array, Fixes, Recording

NAME = "IPIN21Data"
SENSOR_FILES = {"acc.csv": "accelerometer", "gyr.csv": "gyroscope", "mag.csv": "magnetometer", "bar.csv": "barometer"}
FIRST_ROW = re.compile(rb"^\s*1[0-9.]+(?:e\+12)?[0-9]*[ \t]+-?[0-9.]+(?:e[+-][0-9]+)?(?:[ \t]|\r?\n)")
FIX_NAME = re.compile(r"err(\d+(?:\.\d+)?)m?$")


def recognizes(source: Source) -> bool:
    """True if the folder has the files of the data set, with rows of Unix milliseconds."""
    name = source.named("acc.csv", "gyr.csv")
    return name is not None and bool(FIRST_ROW.match(source.head(name)))


def read(source: Source) -> Recording:
    """Read one walk. The authors' track, a position per step, becomes ``truth``.

    The simulated fixes in the folder are alternatives, which are not read: the user chooses one with ``--fixes``.
    """
    tables = {sensor: _sensor(source, name) for file, sensor in SENSOR_FILES.items() if (name := source.named(file))}
    track = next((n for n in source.names if PurePosixPath(n).name.lower().startswith("groundtruth")), None)
    alternatives = [n for n in source.names if FIX_NAME.search(PurePosixPath(n).stem)]
    notes = (
        [f"{len(alternatives)} sets of simulated fixes in the folder: choose one with --fixes"] if alternatives else []
    )
    truth = None
    if track is not None:
        rows = _numbers(source.where(track), source.text(track), 3)
        truth = surveyed(rows[:, 0], rows[:, 1:3], epsg=UTM_32N)
    return build_recording(str(source.path), source.path.stem, tables, 0.0, truth=truth, notes=notes)


def is_fixes(head: bytes) -> bool:
    """True if the first bytes of a file are those of simulated fixes: Unix milliseconds, east, north, height."""
    return bool(re.match(rb"\s*1\.?[0-9]+(?:e\+12)?,[0-9.]+(?:e\+05)?,[0-9.]+(?:e\+06)?,", head))


def read_fixes(path: Path, text: str) -> Fixes:
    """Read simulated fixes. The name of the file states the 3-D error; its variance per axis is a third."""
    stated = FIX_NAME.search(path.stem)
    if stated is None:
        raise InputError(path, "its name", repr(path.stem), "a name that states the error, as 'freq10_s_err5m.csv'")
    rows = _numbers(str(path), text, 3)
    sigma = np.full(len(rows), float(stated[1]) / np.sqrt(3))
    return Fixes(rows[:, 0], rows[:, 1:3], sigma, ("",) * len(rows), UTM_32N)


def _sensor(source: Source, name: str) -> Array:
    """Times [s] and values of one sensor's file."""
    return _numbers(source.where(name), source.text(name), 1 if name.lower().endswith("bar.csv") else 3)


def _numbers(where: str, text: str, values: int) -> Array:
    """Times [s] and values ``(n, 1 + values)`` of a file without a header."""
    delimiter = next((d for d in "\t, " if d in text.strip().partition("\n")[0]), " ")
    rows = TextRows(where, text.encode(), delimiter=delimiter)
    return rows.floats(range(1 + values)) * ([0.001] + values * [1.0])
