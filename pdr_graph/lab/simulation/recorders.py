"""Writers of a simulated walk in the file format of a recorder, with the truth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pdr_graph.geometry import interpolate
from pdr_graph.io.writers import cell
from pdr_graph.types import STANDARD_GRAVITY, Array
from pdr_graph.whole_files import output_folder

if TYPE_CHECKING:
    from pdr_graph.lab.simulation.simulate import Simulation


def write(walk: Simulation, folder: Path) -> None:
    """Write the recording, ``truth.csv``, ``steps.csv``, ``events.csv``, and ``gnss.csv``, ``fixes.csv`` if any.

    Times in all of them are on the recorder's clock. A plan of one file is copied there, as ``plan.geojson``,
    ``plan.osm`` or ``plan.zip``.
    """
    with output_folder(folder) as staged:
        plan, start, body = walk.scenario.plan, walk.scenario.start, walk.body
        if plan is not None and plan.is_file():
            suffix = plan.suffix if plan.suffix in (".osm", ".zip") else ".geojson"
            (staged / f"plan{suffix}").write_bytes(plan.read_bytes())
        RECORDERS[walk.scenario.recorder](walk, staged)
        truth, every = walk.truth, slice(None, None, max(1, round(body.rate / 10)))  # at 10 Hz
        columns = [start + truth.time[every], *truth.position[every].T, truth.heading[every]]
        columns += [*walk.frame.to_lonlat(truth.position[every])[:, ::-1].T, [cell(f) for f in truth.floor[every]]]
        form = "%.3f,%.4f,%.4f,%.5f,%.9f,%.9f,%s"
        _table(staged / "truth.csv", "time,x,y,heading,lat,lon,floor", form, *columns)
        _table(staged / "steps.csv", "time,length", "%.3f,%.4f", start + body.landings, body.lengths)
        events = [(start + e.start, start + e.end, e.kind, cell(e.what)) for e in body.events]
        _table(staged / "events.csv", "start,end,kind,what", "%.3f,%.3f,%s,%s", *zip(*events, strict=True))
        if walk.gnss is not None:
            fixes = walk.gnss.fixes
            columns = [start + fixes.time, *fixes.position.T, walk.gnss.accuracy, walk.gnss.hdop]
            _table(staged / "gnss.csv", "time,x,y,accuracy,hdop", "%.3f,%.3f,%.3f,%.2f,%.2f", *columns)
        if walk.user_fixes is not None:
            fixes = walk.user_fixes
            columns = [start + fixes.time, *fixes.position.T, fixes.sigma]
            form = "%.3f,%.3f,%.3f,%.3f,%s"
            _table(staged / "fixes.csv", "time,x,y,sigma,floor", form, *columns, [cell(f) for f in fixes.floor])


def sensor_logger(walk: Simulation, folder: Path) -> None:
    """Write a folder as exported by Sensor Logger: a table per sensor, columns z, y, x, signs of the platform."""
    ios, start = walk.scenario.platform == "ios", walk.scenario.start

    def table(name: str, header: str, time: Array, values: Array, form: str = "%.7f") -> None:
        """Write Unix nanoseconds, seconds since the start, and values ``(n, k)``."""
        line = ",".join(["%.0f", "%.9f", *[form] * values.shape[1]])
        _table(folder / name, f"time,seconds_elapsed,{header}", line, np.round((start + time) * 1e9), time, *values.T)

    for sensor, signal in walk.signals.items():
        values = signal.values[:, ::-1]
        if sensor == "accelerometer":
            up = walk.motion.R_world_device.inv().apply([0.0, 0.0, STANDARD_GRAVITY])
            gravity = interpolate(signal.time, walk.motion.time, up)[:, ::-1]
            sign = -1.0 if ios else 1.0
            table("Accelerometer.csv", "z,y,x", signal.time, sign * (values - gravity))
            table("Gravity.csv", "z,y,x", signal.time, sign * gravity)
            if not ios:
                table("TotalAcceleration.csv", "z,y,x", signal.time, values)
        elif sensor == "barometer":
            relative = 8.43 * (values[:1] - values)  # [m] per hPa near the ground
            table("Barometer.csv", "relativeAltitude,pressure", signal.time, np.hstack([relative, values]))
        else:
            table(f"{sensor.capitalize()}.csv", "z,y,x", signal.time, values)
    if walk.gnss is not None:
        names = "bearingAccuracy,speedAccuracy,verticalAccuracy,horizontalAccuracy,speed,bearing,altitude"
        lonlat, unknown = walk.frame.to_lonlat(walk.gnss.fixes.position), np.zeros(len(walk.gnss.fixes))
        motion = walk.gnss.fixes.speed, bearing(walk.gnss.fixes.course)
        values = np.column_stack([*[unknown] * 3, walk.gnss.accuracy, *motion, unknown, lonlat])
        table("Location.csv", f"{names},longitude,latitude", walk.gnss.fixes.time, values, "%.9f")
    radios = {("Bluetooth.csv", "id,rssi"): walk.bluetooth, ("WiFi.csv", "bssid,level"): walk.wifi}
    for (name, header), heard in radios.items():
        if heard is not None:
            columns = [(start + heard.time) * 1e9, heard.time, heard.transmitter, heard.rssi]
            _table(folder / name, f"time,seconds_elapsed,{header}", "%.0f,%.6f,%s,%.0f", *columns)
    rates = "|".join([str(round(1000 / walk.scenario.phone.rate))] * len(walk.signals))
    header = "version,device name,recording epoch time,recording time,recording timezone,platform,appVersion,device id,"
    header += "sensors,sampleRateMs,standardisation,platform version"
    row = f"3,Simulated,{start * 1000:.0f},,UTC,{walk.scenario.platform},1.47.1,simulated,"
    _table(folder / "Metadata.csv", header, "%s", [row + f"{'|'.join(walk.signals)},{rates},false,0"])


def phyphox(walk: Simulation, folder: Path) -> None:
    """Write a folder as exported by phyphox: a table per sensor, times from the start, ``meta/time.csv``."""

    def table(name: str, header: Sequence[str], *columns: Array) -> None:
        titles = ",".join(f'"{title}"' for title in ("Time (s)", *header))
        _table(folder / f"{name}.csv", titles, ",".join(["%.9E"] * len(columns)), *columns)

    names = {"accelerometer": ("Accelerometer", "m/s^2"), "gyroscope": ("Gyroscope", "rad/s")}
    names |= {"magnetometer": ("Magnetometer", "µT"), "barometer": ("Pressure", "hPa")}
    for sensor, signal in walk.signals.items():
        name, unit = names[sensor]
        axes = "X" if sensor == "barometer" else "XYZ"
        table(name, [f"{axis} ({unit})" for axis in axes], signal.time, *signal.values.T)
    if walk.gnss is not None:
        lon, lat = walk.frame.to_lonlat(walk.gnss.fixes.position).T
        header = ["Latitude (°)", "Longitude (°)", "Height (m)", "Velocity (m/s)", "Direction (°)"]
        motion = walk.gnss.fixes.speed, bearing(walk.gnss.fixes.course)
        columns = [walk.gnss.fixes.time, lat, lon, np.zeros(len(lon)), *motion, walk.gnss.accuracy]
        table("Location", [*header, "Horizontal Accuracy (m)"], *columns)
    start, end = walk.scenario.start, walk.body.time[-1]
    events = [f'"START",0.0,{start:.3f},""', f'"PAUSE",{end:.9E},{start + end:.3f},""']
    (folder / "meta").mkdir(exist_ok=True)
    _table(folder / "meta" / "time.csv", '"event","experiment time","system time","system time text"', "%s", events)


def indoor_location(walk: Simulation, folder: Path) -> None:
    """Write one file as in the Indoor Location Competition 2.0, with a waypoint of the truth every eight seconds."""
    start, rows = walk.scenario.start, list[tuple[int, str]]()
    kinds = {"accelerometer": "ACCELEROMETER", "gyroscope": "GYROSCOPE", "magnetometer": "MAGNETIC_FIELD"}
    for sensor in filter(walk.signals.__contains__, kinds):
        signal = walk.signals[sensor]
        ms = np.round((start + signal.time) * 1000).astype(int)
        samples = zip(ms.tolist(), signal.values.tolist(), strict=True)
        rows += [(t, f"{t}\tTYPE_{kinds[sensor]}\t{x:.6f}\t{y:.6f}\t{z:.6f}\t3") for t, (x, y, z) in samples]
    every = round(8 * walk.body.rate)
    for t, (x, y) in zip(walk.body.time[::every], walk.body.position[::every], strict=True):
        ms = round((start + t) * 1000)
        rows.append((ms, f"{ms}\tTYPE_WAYPOINT\t{x:.4f}\t{y:.4f}"))
    head = f"#\tstartTime:{start * 1000:.0f}\n#\tSiteID:simulated\tSiteName:simulated\tFloorName:{walk.body.floors[0]}"
    lines = [line for _, line in sorted(rows, key=lambda row: row[0])]
    _table(folder / "walk.txt", head, "%s", [*lines, f"#\tendTime:{(start + walk.body.time[-1]) * 1000:.0f}"])


def bearing(course: Array) -> Array:
    """Degrees clockwise from north, 0 to 360, of courses counter-clockwise from east ``(n,)`` [rad]."""
    return np.degrees(np.pi / 2 - course) % 360


RECORDERS: dict[str, Callable[[Simulation, Path], None]] = {
    "sensor_logger": sensor_logger,
    "phyphox": phyphox,
    "indoor_location": indoor_location,
}


def _table(path: Path, header: str, line: str, *columns: Sequence[Any] | Array) -> None:
    """Write a text file of a header and rows, each in the format `line` of its values."""
    rows = zip(*(np.asarray(column).tolist() for column in columns), strict=True)
    with path.open("w", encoding="utf-8") as file:
        file.write(header + "\n")
        while block := list(islice(rows, 50_000)):  # formatted by one string: five times as fast as row by row
            file.write((f"{line}\n" * len(block)) % tuple(chain.from_iterable(block)))
