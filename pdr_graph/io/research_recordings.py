"""Recordings of research data sets: GeoLife, the Oxford step counter, IPIN21Data, strides, RIDI, Edinburgh.

GeoLife (Microsoft Research), ``.plt``: positions of a day, no other sensor.

Oxford step counter: an accelerometer alone, without a header. Either a file ``t_ns,ax,ay,az,…`` of the validation set,
or a folder with an ``accelerometer.csv`` of ``t_ns,accuracy,ax,ay,az``. Times are nanoseconds since the phone booted.

IPIN21Data (HafenCity University Hamburg): folders with ``acc.csv``, ``gyr.csv``, ``mag.csv``, ``bar.csv`` of Unix
milliseconds and values, separated by spaces, without a header. Positions beside them are metres in UTM zone 32N.

Strides (Wang et al., Sensors 2019): rows ``test ax ay az gx gy gz mx my mz ms …`` of Unix milliseconds; the length of
the stride and the way follow.

RIDI (Yan, Shan and Furukawa, ECCV 2018), as workbooks: columns ``time``, ``acce_x``, …, and ``pos_x``, ``pos_y`` of a
camera.

Edinburgh (Wei and Radu, IPIN 2019): XML of elements ``a``, ``g``, ``m`` with ``st`` [ns since boot], ``t`` [Unix ms],
``x``, ``y``, ``z``, and of Wi-Fi scans ``wr`` with ``t``, of ``r`` with ``b`` (address) and ``s`` (level).
"""

from __future__ import annotations

import re
from io import BytesIO
from pathlib import PurePosixPath
from typing import Any

import numpy as np

from pdr_graph.errors import InputError, count
from pdr_graph.io.delimited import TextRows
from pdr_graph.io.signatures import OXFORD_WITH_ACCURACY
from pdr_graph.io.source import Source
from pdr_graph.io.tables import AN_EXCEL_FILE, AS_CSV, workbook_columns
from pdr_graph.io.validation import build_recording, float_of, plausible_times, receiver_fixes, surveyed
from pdr_graph.io.xml_elements import XmlElements
from pdr_graph.types import DAY_LENGTH, UTM_32N, Array, Fixes, Recording, Sightings

EDINBURGH_SENSORS = {"a": "accelerometer", "g": "gyroscope", "m": "magnetometer"}
LARGEST_WORKBOOK = 200_000_000  # [bytes] unpacked, of which cells take ten times as much memory
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
        rows = _ipin21_rows(source.where(track), source.text(track), 2)  # one of their two tracks has no height
        truth = surveyed(rows[:, 0], rows[:, 1:], epsg=UTM_32N)
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


def read_strides(source: Source) -> Recording:
    """Read one walk whose strides a sensor at the foot measured. It has no positions."""
    name = source.single or ""
    rows = TextRows(source.where(name), source.utf8(name), delimiter=" ").floats((10, *range(1, 10))) * (
        [0.001] + 9 * [1]
    )
    sensors = {"accelerometer": (0, 1, 2, 3), "gyroscope": (0, 4, 5, 6), "magnetometer": (0, 7, 8, 9)}
    tables = {sensor: rows[:, columns] for sensor, columns in sensors.items()}
    return build_recording(source.where(name), source.path.stem, tables, 0.0)


RIDI_COLUMNS = {
    "accelerometer": ("time", "acce_x", "acce_y", "acce_z"),
    "gyroscope": ("time", "gyro_x", "gyro_y", "gyro_z"),
    "magnetometer": ("time", "magnet_x", "magnet_y", "magnet_z"),
}
TRACK = "pos_x", "pos_y"


def read_ridi(source: Source) -> Recording:
    """Read one walk of RIDI, seconds since boot. The camera's track [m], in axes of its own, becomes ``truth``.

    Raises InputError for any other workbook.
    """
    size = sum(len(source.content(name)) for name in source.names)  # whatever the archive states
    if size > LARGEST_WORKBOOK:
        raise InputError(source.path, "", f"a workbook of {size // 10**6} MB, unpacked", "a walk of some minutes")
    columns = workbook_columns(source.path)
    needed = list(dict.fromkeys(sum(RIDI_COLUMNS.values(), ())))
    if absent := [name for name in needed if name not in columns]:
        if len(absent) > len(needed) / 2:
            raise InputError(source.path, "", AN_EXCEL_FILE, AS_CSV)
        raise InputError(source.path, f"column {absent[0]}", "no such column, or texts in it", "numbers, as in RIDI")
    tables = {k: np.column_stack([columns[name] for name in names]) for k, names in RIDI_COLUMNS.items()}
    truth = None
    if columns.keys() >= {*TRACK}:
        truth = surveyed(columns["time"], np.column_stack([columns[name] for name in TRACK]))
    return build_recording(str(source.path), source.path.stem, tables, None, truth=truth)


def read_edinburgh(source: Source) -> Recording:
    """Read one walk of Edinburgh. The places of the walk are in another file, which is not read."""
    logs = [name for name in source.names if source.single or name.lower().endswith(".xml")]
    if len(logs) > 1:
        raise InputError(source.path, "", f"{len(logs)} logs, {logs[0]} and others", "one recording at a time")
    where, content, notes = source.where(logs[0]), source.content(logs[0]), set[str]()

    def elements(tag: str) -> list[Any]:
        """All elements of one kind."""
        log = XmlElements(BytesIO(content), where, "data", tag)
        found = list(log)
        notes.update([*log.notes, *(["the file ends in the middle, it is read up to there"] if log.is_cut else [])])
        return found

    def numbers(found: list[Any], *names: str) -> Array:
        """Attributes ``(n, k)``; NaN where one is missing. Raises InputError for a text."""
        texts = [each.get(name, "nan") for each in found for name in names]
        values = np.array([float_of(text) for text in texts])
        if wrong := [text for text, value in zip(texts, values, strict=True) if value != value and text != "nan"]:
            raise InputError(where, f"<{found[0].tag}>", repr(wrong[0][:40]), f"numbers in {', '.join(names)}")
        return values.reshape(-1, len(names))

    tables = {sensor: numbers(elements(tag), "st", "x", "y", "z", "t") for tag, sensor in EDINBURGH_SENSORS.items()}
    clocks = np.concatenate([table[:, [0, 4]] for table in tables.values()]) * (1e-9, 1e-3)
    boot = float(np.nanmedian(np.append(clocks[:, 1] - clocks[:, 0], np.nan))) if len(clocks) else 0.0
    tables = {
        sensor: table[:, :4] * (1e-9, 1, 1, 1) + (boot, 0, 0, 0) for sensor, table in tables.items() if len(table)
    }
    radios = [(scan, radio) for scan in elements("wr") for radio in scan]
    times, levels = numbers([scan for scan, _ in radios], "t")[:, 0] / 1000, numbers([r for _, r in radios], "s")[:, 0]
    rows = np.flatnonzero(np.isfinite(times + levels))
    rows = rows[np.argsort(times[rows], kind="stable")]
    wifi = Sightings(times[rows], tuple(radios[row][1].get("b", "") for row in rows.tolist()), levels[rows])
    return build_recording(where, source.path.stem, tables, 0.0, wifi=wifi, notes=sorted(notes))
