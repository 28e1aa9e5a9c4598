"""Writers of a simulated walk in the file format of a recorder, with the truth."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pdr_graph.geometry import interpolate
from pdr_graph.io.writers import cell
from pdr_graph.types import STANDARD_GRAVITY, Array
from pdr_graph.whole_files import output_folder

if TYPE_CHECKING:
    from pdr_graph.lab.simulation.simulate import Simulation

TRUTH_RATE = 10.0  # [Hz]
OTHER_PLANS = (".osm", ".zip")  # endings of plans that are no GeoJSON


def write(walk: Simulation, folder: Path) -> None:
    """Write the recording, ``truth.csv``, ``steps.csv``, ``events.csv``, and ``gnss.csv``, ``fixes.csv`` if any.

    Times in all of them are on the recorder's clock. A plan of one file is copied there, as ``plan.geojson``,
    ``plan.osm`` or ``plan.zip``.
    """
    with output_folder(folder) as staged:
        _write(walk, staged)


def _write(walk: Simulation, folder: Path) -> None:
    if walk.scenario.plan is not None and walk.scenario.plan.is_file():
        suffix = walk.scenario.plan.suffix if walk.scenario.plan.suffix in OTHER_PLANS else ".geojson"
        (folder / f"plan{suffix}").write_bytes(walk.scenario.plan.read_bytes())
    RECORDERS[walk.scenario.recorder](walk, folder)
    start, body = walk.scenario.start, walk.body
    every = max(1, round(body.rate / TRUTH_RATE))
    truth = walk.truth
    rows = zip(truth.time[::every], truth.position[::every], truth.heading[::every], truth.floor[::every], strict=True)
    lines = [f"{start + t:.3f},{x:.4f},{y:.4f},{heading:.5f},{cell(floor)}" for t, (x, y), heading, floor in rows]
    _save(folder / "truth.csv", "time,x,y,heading,floor", lines)
    landed = zip(body.landings, body.lengths, strict=True)
    _save(folder / "steps.csv", "time,length", [f"{start + t:.3f},{length:.4f}" for t, length in landed])
    events = [f"{start + e.start:.3f},{start + e.end:.3f},{e.kind},{cell(e.what)}" for e in body.events]
    _save(folder / "events.csv", "start,end,kind,what", events)
    if walk.gnss is not None:
        fixes = zip(walk.gnss.fixes.time, walk.gnss.fixes.position, walk.gnss.accuracy, walk.gnss.hdop, strict=True)
        lines = [f"{start + t:.3f},{x:.3f},{y:.3f},{accuracy:.2f},{hdop:.2f}" for t, (x, y), accuracy, hdop in fixes]
        _save(folder / "gnss.csv", "time,x,y,accuracy,hdop", lines)
    if walk.user_fixes is not None:
        user = walk.user_fixes
        fixes = zip(user.time, user.position, user.sigma, user.floor, strict=True)
        lines = [f"{start + t:.3f},{x:.3f},{y:.3f},{sigma:.3f},{cell(floor)}" for t, (x, y), sigma, floor in fixes]
        _save(folder / "fixes.csv", "time,x,y,sigma,floor", lines)


def sensor_logger(walk: Simulation, folder: Path) -> None:
    """Write a folder as exported by Sensor Logger: a table per sensor, columns z, y, x, signs of the platform."""
    ios = walk.scenario.platform == "ios"
    sign, signals = -1.0 if ios else 1.0, walk.signals
    if "accelerometer" in signals:
        total = signals["accelerometer"]
        gravity = _gravity(walk, total.time)
        _sensor_table(walk, folder / "Accelerometer.csv", "z,y,x", total.time, sign * (total.values - gravity)[:, ::-1])
        _sensor_table(walk, folder / "Gravity.csv", "z,y,x", total.time, sign * gravity[:, ::-1])
        if not ios:
            _sensor_table(walk, folder / "TotalAcceleration.csv", "z,y,x", total.time, total.values[:, ::-1])
    for sensor, name in (("gyroscope", "Gyroscope"), ("magnetometer", "Magnetometer")):
        if sensor in signals:
            signal = signals[sensor]
            _sensor_table(walk, folder / f"{name}.csv", "z,y,x", signal.time, signal.values[:, ::-1])
    if "barometer" in signals:
        pressure = signals["barometer"]
        relative = 8.43 * (pressure.values[:1] - pressure.values)  # [m] per hPa near the ground
        columns = np.column_stack([relative, pressure.values])
        _sensor_table(walk, folder / "Barometer.csv", "relativeAltitude,pressure", pressure.time, columns)
    _location(walk, folder)
    _radios(walk, folder)
    rates = "|".join([str(round(1000 / walk.scenario.phone.rate))] * len(signals))
    header = "version,device name,recording epoch time,recording time,recording timezone,platform,appVersion,device id,"
    header += "sensors,sampleRateMs,standardisation,platform version"
    row = f"3,Simulated,{walk.scenario.start * 1000:.0f},,UTC,{walk.scenario.platform},1.47.1,simulated,"
    _save(folder / "Metadata.csv", header, [row + f"{'|'.join(signals)},{rates},false,0"])


def phyphox(walk: Simulation, folder: Path) -> None:
    """Write a folder as exported by phyphox: a table per sensor, times from the start, ``meta/time.csv``."""
    names = {"accelerometer": ("Accelerometer", "m/s^2"), "gyroscope": ("Gyroscope", "rad/s")}
    names |= {"magnetometer": ("Magnetometer", "µT"), "barometer": ("Pressure", "hPa")}
    for sensor, signal in walk.signals.items():
        name, unit = names[sensor]
        axes = ("X", "P") if sensor == "barometer" else ("X", "Y", "Z")
        header = ['"Time (s)"', *(f'"{axis} ({unit})"' for axis in axes[: signal.values.shape[1]])]
        rows = np.column_stack([signal.time, signal.values])
        _table(folder / f"{name}.csv", ",".join(header), rows, ["%.9E"] * rows.shape[1])
    if walk.gnss is not None:
        lonlat = walk.frame.to_lonlat(walk.gnss.fixes.position)
        unknown = np.zeros(len(lonlat))
        columns = [walk.gnss.fixes.time, lonlat[:, 1], lonlat[:, 0], unknown, unknown, unknown, walk.gnss.accuracy]
        header = '"Time (s)","Latitude (°)","Longitude (°)","Height (m)","Velocity (m/s)","Direction (°)",'
        header += '"Horizontal Accuracy (m)"'
        _table(folder / "Location.csv", header, np.column_stack(columns), ["%.9E"] * 7)
    start, end = walk.scenario.start, walk.body.time[-1]
    events = [f'"START",0.0,{start:.3f},""', f'"PAUSE",{end:.9E},{start + end:.3f},""']
    (folder / "meta").mkdir(exist_ok=True)
    _save(folder / "meta" / "time.csv", '"event","experiment time","system time","system time text"', events)


def indoor_location(walk: Simulation, folder: Path) -> None:
    """Write one file as in the Indoor Location Competition 2.0, with a waypoint of the truth every eight seconds."""
    start, rows = walk.scenario.start, []
    kinds = {"accelerometer": "ACCELEROMETER", "gyroscope": "GYROSCOPE", "magnetometer": "MAGNETIC_FIELD"}
    for sensor, kind in kinds.items():
        if sensor in walk.signals:
            signal = walk.signals[sensor]
            ms = np.round((start + signal.time) * 1000).astype(int)
            samples = zip(ms.tolist(), signal.values.tolist(), strict=True)
            rows += [(t, f"{t}\tTYPE_{kind}\t{x:.6f}\t{y:.6f}\t{z:.6f}\t3") for t, (x, y, z) in samples]
    every = round(8 * walk.body.rate)
    for t, (x, y) in zip(walk.body.time[::every], walk.body.position[::every], strict=True):
        ms = round((start + t) * 1000)
        rows.append((ms, f"{ms}\tTYPE_WAYPOINT\t{x:.4f}\t{y:.4f}"))
    head = f"#\tstartTime:{start * 1000:.0f}\n#\tSiteID:simulated\tSiteName:simulated\tFloorName:{walk.body.floors[0]}"
    lines = [line for _, line in sorted(rows, key=lambda row: row[0])]
    _save(folder / "walk.txt", head, [*lines, f"#\tendTime:{(start + walk.body.time[-1]) * 1000:.0f}"])


RECORDERS: dict[str, Callable[[Simulation, Path], None]] = {
    "sensor_logger": sensor_logger,
    "phyphox": phyphox,
    "indoor_location": indoor_location,
}


def _gravity(walk: Simulation, time: Array) -> Array:
    """Gravity ``(n, 3)`` in device axes [m/s²], without errors."""
    up = walk.motion.R_world_device.inv().apply([0.0, 0.0, STANDARD_GRAVITY])
    return interpolate(time, walk.motion.time, up)


def _location(walk: Simulation, folder: Path) -> None:
    """Write the GNSS fixes as Sensor Logger does."""
    if walk.gnss is None:
        return
    names = (
        "bearingAccuracy,speedAccuracy,verticalAccuracy,horizontalAccuracy,speed,bearing,altitude,longitude,latitude"
    )
    lonlat, n = walk.frame.to_lonlat(walk.gnss.fixes.position), len(walk.gnss.fixes)
    columns = np.column_stack([np.zeros((n, 3)), walk.gnss.accuracy, np.zeros((n, 3)), lonlat])
    _sensor_table(walk, folder / "Location.csv", names, walk.gnss.fixes.time, columns, "%.9f")


def _radios(walk: Simulation, folder: Path) -> None:
    """Write the Bluetooth and Wi-Fi tables of Sensor Logger."""
    for sightings, file, header in (
        (walk.bluetooth, "Bluetooth.csv", "id,rssi"),
        (walk.wifi, "WiFi.csv", "bssid,level"),
    ):
        if sightings is not None:
            rows = zip(sightings.time, sightings.transmitter, sightings.rssi, strict=True)
            start = walk.scenario.start
            lines = [f"{(start + t) * 1e9:.0f},{t:.6f},{name},{rssi:.0f}" for t, name, rssi in rows]
            _save(folder / file, f"time,seconds_elapsed,{header}", lines)


def _sensor_table(walk: Simulation, path: Path, names: str, time: Array, values: Array, form: str = "%.7f") -> None:
    """Write a table of Sensor Logger: Unix nanoseconds, seconds since the start, values."""
    nanoseconds = np.round((walk.scenario.start + time) * 1e9)
    rows = np.column_stack([nanoseconds, time, values])
    _table(path, f"time,seconds_elapsed,{names}", rows, ["%.0f", "%.9f", *[form] * values.shape[1]])


ROWS_AT_ONCE = 50_000  # formatted by one string, which is five times as fast as a string for each row


def _table(path: Path, header: str, rows: Array, forms: list[str]) -> None:
    """Write a CSV of numbers. forms: the format of each column."""
    line = ",".join(forms) + "\n"
    with path.open("w", encoding="utf-8") as file:
        file.write(header + "\n")
        for begin in range(0, len(rows), ROWS_AT_ONCE):
            block = rows[begin : begin + ROWS_AT_ONCE]
            file.write((line * len(block)) % tuple(block.ravel().tolist()))


def _save(path: Path, header: str, lines: list[str]) -> None:
    """Write a text file of a header and lines."""
    path.write_text("\n".join([header, *lines]) + "\n", encoding="utf-8")
