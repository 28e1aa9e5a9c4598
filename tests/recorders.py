"""One short walk in the files of each supported phone recorder."""

import tempfile
import zipfile
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import simulated

from pdr_graph.frames import enu

SPEED = 1.25  # [m/s] of each fix
UNIX = 1_700_000_000.0
FRAME = enu(49.45, 11.1)
G = 9.80665


@dataclass(frozen=True)
class Sample:
    """True samples: time [s] from 0, acceleration with gravity, gravity, angular rate, field, pressure, fixes."""

    time: np.ndarray
    acceleration: np.ndarray
    gravity: np.ndarray
    angular_rate: np.ndarray
    field: np.ndarray
    pressure: np.ndarray
    fix_time: np.ndarray
    lonlat: np.ndarray
    accuracy: np.ndarray
    bearing: np.ndarray


def sample(seed=0, route=((0.0, 0.0), (14.0, 0.0), (14.0, 7.0))):
    """Samples of a walk, by default twenty seconds around a corner, the top of the phone raised by 0.6 rad."""
    walk = simulated.walk_along(np.array(route), seed=seed)
    n = len(walk.time)
    every = slice(25, None, 50)
    return Sample(
        time=walk.time,
        acceleration=walk.acceleration.round(5),
        gravity=np.tile([0.0, G * np.sin(0.6), G * np.cos(0.6)], (n, 1)).round(5),
        angular_rate=walk.angular_rate.round(5),
        field=np.tile([5.0, 20.0, -40.0], (n, 1)),
        pressure=np.full(n, 1013.25),
        fix_time=walk.time[every],
        lonlat=FRAME.to_lonlat(walk.position[every]).round(8),
        accuracy=np.full(len(walk.time[every]), 4.53),
        bearing=np.degrees(np.arctan2(*np.gradient(walk.position, axis=0)[every].T)).round(1) % 360,
    )


def table(header, *columns, delimiter=",", decimal=".", quote='"', form="{:.9E}"):
    """A CSV as phyphox writes it: quoted names, scientific numbers."""
    rows = [delimiter.join(form.format(v).replace(".", decimal) for v in row) for row in np.column_stack(columns)]
    return "\n".join([delimiter.join(f"{quote}{name}{quote}" for name in header), *rows]) + "\n"


def xyz(unit, name="{}"):
    return ["Time (s)", *(f"{name.format(axis)} ({unit})" for axis in ("x", "y", "z"))]


def phyphox(s, **style):
    """The files of a multi-sensor experiment."""
    location = ["Latitude (°)", "Longitude (°)", "Height (m)", "Velocity (m/s)", "Direction (°)"]
    zero = np.zeros(len(s.fix_time))
    return {
        "Accelerometer.csv": table(xyz("m/s^2", "Acceleration {}"), s.time, s.acceleration, **style),
        "Gyroscope.csv": table(xyz("rad/s", "Gyroscope {}"), s.time, s.angular_rate, **style),
        "Magnetometer.csv": table(xyz("µT", "Magnetic field {}"), s.time, s.field, **style),
        "Pressure.csv": table(["Time (s)", "Pressure (hPa)"], s.time, s.pressure, **style),
        "Location.csv": table(
            ["Time (s)", *location, "Horizontal Accuracy (m)", "Vertical Accuracy (m)"],
            *(s.fix_time, s.lonlat[:, 1], s.lonlat[:, 0], zero, zero + SPEED, s.bearing, s.accuracy, zero),
            **style,
        ),
        "meta/device.csv": '"property","value"\n"deviceModel","Pixel 6a"\n',
    }


def nanoseconds(header, time, *columns):
    """A Sensor Logger table: Unix nanoseconds as integers, seconds elapsed, then the columns."""
    rows = [
        ",".join([f"{round((UNIX + t) * 1e9)}", f"{t:.6f}", *(f"{v}" for v in row)])
        for t, row in zip(time, np.column_stack(columns), strict=True)
    ]
    return "\n".join([f"time,seconds_elapsed,{header}", *rows]) + "\n"


def sensor_logger(s, platform="android", standardised=False):
    """The files of one export; on iOS accelerations have the opposite sign and the uncalibrated one is in g."""
    flipped = -1.0 if platform == "ios" and not standardised else 1.0
    user, zyx = s.acceleration - s.gravity, "z,y,x"
    backwards = slice(None, None, -1)
    files = {
        "Accelerometer.csv": nanoseconds(zyx, s.time, flipped * user[:, backwards]),
        "Gravity.csv": nanoseconds(zyx, s.time, flipped * s.gravity[:, backwards]),
        "Gyroscope.csv": nanoseconds(zyx, s.time, s.angular_rate[:, backwards]),
        "Magnetometer.csv": nanoseconds(zyx, s.time, s.field[:, backwards]),
        "Barometer.csv": nanoseconds("relativeAltitude,pressure", s.time, 0 * s.pressure, s.pressure),
        "Location.csv": nanoseconds(
            "bearingAccuracy,horizontalAccuracy,speed,bearing,longitude,latitude",
            *(s.fix_time, 0 * s.accuracy, s.accuracy, 0 * s.accuracy + SPEED, s.bearing, s.lonlat),
        ),
        "Annotation.csv": "time,seconds_elapsed,text,millisecond_press_duration\n",
        "Metadata.csv": "version,device name,recording epoch time,recording time,recording timezone,platform,"
        "appVersion,device id,sensors,sampleRateMs,standardisation,platform version\n"
        f"3,Phone,1700000000000,2023-11-14_22-13-20,Europe/Berlin,{platform},1.64,id,Accelerometer|Gravity,10|10,"
        f"{str(standardised).lower()},1\n",
    }
    if platform == "android":
        files["TotalAcceleration.csv"] = nanoseconds(zyx, s.time, s.acceleration[:, backwards])
    raw = s.acceleration * (flipped if standardised or platform == "android" else -1 / G)
    return files | {"AccelerometerUncalibrated.csv": nanoseconds(zyx, s.time, raw[:, backwards])}


def get_sensor_data(s, unit=1.0, boot=65093.5):
    """A log whose sensors have their own clock, since boot; each GNSS epoch is written twice."""
    rows = []
    for tag, values, factor in (("ACCE", s.acceleration, unit), ("GYRO", s.angular_rate, 1), ("MAGN", s.field, 1)):
        rows += [
            (t, f"{tag};{t + 0.004:.4f};{t + boot:.4f};{x * factor:.5f};{y * factor:.5f};{z * factor:.5f};3")
            for t, (x, y, z) in zip(s.time, values, strict=True)
        ]
    rows += [(t, f"PRES;{t:.4f};{t + boot:.4f};{p:.4f};3") for t, p in zip(s.time, s.pressure, strict=True)]
    for t, (lon, lat), accuracy, bearing in zip(s.fix_time, s.lonlat, s.accuracy, s.bearing, strict=True):
        gnss = f"{int(UNIX + t)}.0000;{lat:.8f};{lon:.8f};346.000;{bearing};{accuracy:.2f};{SPEED};22;19"
        rows += [(t, f"GNSS;{t + d:.4f};{gnss}") for d in (0.0, 0.01)]
    rows.append((3.0, "WIFI;3.0000;65096.5;a;network;00:11:22:33:44:55;2437;-61;"))
    rows.append((4.0, "BLE4;4.0000;iBeacon;BE:AC:20:23:00:01;-90;0;1;1;11111111-1111-BEAC-2023-111111111111"))
    rows.append((5.0, "POSI;5.0000;1;49.450000000000;11.100000000000;-2;100"))
    head = ["% LogFile created by the 'GetSensorData' App for Android.", "% "]
    return "\n".join(head + [row for _, row in sorted(rows, key=lambda r: r[0])]) + "\n"


def gnss_logger(s, fix="Fix,Provider,LatitudeDegrees,LongitudeDegrees,AltitudeMeters,SpeedMps,AccuracyMeters,Bearing"):
    """A log with uncalibrated sensors and their bias, and fixes of two providers."""
    bias = 0.25
    lines = ["# ", "# Header Description:", f"# {fix},UnixTimeMillis,SpeedAccuracyMps", "# "]
    for kind in ("UncalAccel", "UncalGyro", "UncalMag"):
        lines.append(f"# {kind},utcTimeMillis,elapsedRealtimeNanos,X,Y,Z,BiasX,BiasY,BiasZ")
    for kind, values in (("UncalAccel", s.acceleration), ("UncalGyro", s.angular_rate), ("UncalMag", s.field)):
        for t, (x, y, z) in zip(s.time, values + bias, strict=True):
            when = f"{round((UNIX + t) * 1e3)},{round((t + 500) * 1e9)}"
            lines.append(f"{kind},{when},{x:.6f},{y:.6f},{z:.6f},{bias},{bias},{bias}")
    for t, (lon, lat), accuracy, bearing in zip(s.fix_time, s.lonlat, s.accuracy, s.bearing, strict=True):
        for provider in ("GPS", "NLP"):
            lines.append(
                f"Fix,{provider},{lat:.8f},{lon:.8f},346.0,{SPEED},{accuracy:.2f},{bearing},{(UNIX + t) * 1e3:.0f},0.5"
            )
    return "\n".join(lines) + "\n"


def gpx(s):
    """A track of the positions alone."""
    point = '<trkpt lat="{:.8f}" lon="{:.8f}"><time>{}Z</time></trkpt>'
    times = [datetime.fromtimestamp(UNIX + t, UTC).replace(tzinfo=None).isoformat() for t in s.fix_time]
    points = "".join(point.format(lat, lon, time) for (lon, lat), time in zip(s.lonlat, times, strict=True))
    head = '<?xml version="1.0"?><gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1">'
    return f"{head}<trk><trkseg>{points}</trkseg></trk></gpx>"


def geolife(s):
    """The positions alone; times to the second, in days since 1899-12-30."""
    head = "Geolife trajectory\nWGS 84\nAltitude is in Feet\nReserved 3\n0,2,255,My Track,0,0,2,8421376\n0\n"
    days = (np.round(UNIX + s.fix_time) + 2_209_161_600) / 86_400
    rows = zip(s.lonlat, days, strict=True)
    return head + "".join(f"{lat:.8f},{lon:.8f},0,492,{day:.10f},2023-11-14,22:13:20\n" for (lon, lat), day in rows)


def past_day(s):
    """The positions alone, as `lifelog import` keeps a day of them."""
    rows = zip(s.fix_time, s.lonlat, s.accuracy, strict=True)
    lines = [
        f"{round((UNIX + t) * 1e3)},{round(lat * 1e7)},{round(lon * 1e7)},{round(accuracy * 100)},gps\n"
        for t, (lon, lat), accuracy in rows
    ]
    head = f"# pdr_graph past, {len(lines)} positions, 0 receptions, me\n"
    return f"{head}milliseconds,lat_e7,lon_e7,accuracy_cm,source\n{''.join(lines)}"


def columns(*arrays, delimiter=" ", form="{:.12e}"):
    return "\n".join(delimiter.join(form.format(v) for v in row) for row in np.column_stack(arrays)) + "\n"


def indoor_location(s, route=((1.0, 18.0), (4.0, 18.0))):
    """A log of the Indoor Location Competition, of at most as many samples as `s`, of another walk."""
    with tempfile.TemporaryDirectory() as folder:
        lines = (simulated.indoor_location(Path(folder), route) / "walk.txt").read_text().splitlines()
    return "\n".join([*lines[:-1][: 2 + 3 * len(s.time)], lines[-1]]) + "\n"


def oxford_steps(s):
    """A file of the validation set, with nanoseconds since boot."""
    ns = s.time * 1e9 + 1e12
    counts = np.zeros((3, len(s.time)))
    return columns(ns, s.acceleration, *counts, delimiter=",", form="{:.0f}")


def ipin21(s):
    """The files of a folder, with a ground truth."""
    ms = 1.7e12 + s.time * 1e3
    files = {
        "acc.csv": columns(ms, s.acceleration),
        "gyr.csv": columns(ms, s.angular_rate),
        "bar.csv": columns(ms, s.pressure),
    }
    return files | {"GroundTruthEight.csv": columns(ms[:3], *np.full((3, 3), 5e5), delimiter="\t", form="{:.3f}")}


def strides(s):
    """A walk of the stride data: Unix milliseconds after the sensors, then stride, number and way."""
    ms, none = np.round((UNIX + s.time) * 1e3), np.zeros((len(s.time), 3))
    rows = columns(s.acceleration, s.angular_rate, s.field, ms, none, form="{:.17g}").splitlines()
    return "\n".join(f"test {row}" for row in rows) + "\n"


def workbook(names, *values):
    """The files of a workbook of one sheet with a header."""
    main, office = "http://schemas.openxmlformats.org", "officeDocument/2006/relationships"
    relation = f'<Relationship Id="r" Type="{main}/{office}/{{}}" Target="{{}}"/>'
    relations = f'<Relationships xmlns="{main}/package/2006/relationships">{relation}</Relationships>'
    header = "".join(f'<c t="inlineStr"><is><t>{name}</t></is></c>' for name in names)
    cells = ["".join(f"<c><v>{value:.17g}</v></c>" for value in row) for row in np.column_stack(values).tolist()]
    rows = "\n".join(f"<row>{row}</row>" for row in [header, *cells])
    sheet, space = '<sheet name="a" sheetId="1" r:id="r"/>', f'xmlns="{main}/spreadsheetml/2006/main"'
    return {
        "[Content_Types].xml": f'<Types xmlns="{main}/package/2006/content-types"/>',
        "_rels/.rels": relations.format("officeDocument", "xl/workbook.xml"),
        "xl/_rels/workbook.xml.rels": relations.format("worksheet", "worksheets/s.xml"),
        "xl/workbook.xml": f'<workbook {space} xmlns:r="{main}/{office}"><sheets>{sheet}</sheets></workbook>',
        "xl/worksheets/s.xml": f"<worksheet {space}><sheetData>{rows}</sheetData></worksheet>",
    }


def ridi(s):
    """A workbook with a camera's track of a straight walk."""
    names = [f"{name}_{axis}" for name in ("acce", "gyro", "magnet", "pos") for axis in "xyz"]
    track = SPEED * s.time[:, None] * [1.0, 0.0, 0.0]
    return workbook(["time", *names], s.time + 500, s.acceleration, s.angular_rate, s.field, track)


def edinburgh(s):
    """A log whose sensors have nanoseconds since boot and, late by the phone, Unix milliseconds; a scan of Wi-Fi."""
    rows = list[tuple[float, str]]()
    for tag, values in (("a", s.acceleration), ("g", s.angular_rate), ("m", s.field)):
        for t, (x, y, z) in zip(s.time.tolist(), values.tolist(), strict=True):
            when = f't="{(UNIX + t) * 1e3:.0f}" st="{(t + 500) * 1e9:.0f}"'
            rows.append((t, f'<{tag} {when} x="{x!r}" y="{y!r}" z="{z!r}" />'))
    rows.append((3.0, f'<wr t="{(UNIX + 3) * 1e3:.0f}">\n<r b="00:11:22:33:44:55" s="-61" c="6" />\n</wr>'))
    lines = [row for _, row in sorted(rows, key=lambda row: row[0])]
    return "\n".join(['<data phone="a" building="undefined" t="2023-11-14 22:13:20.000">', *lines, "</data>\n"])


def sensor_log(s, version=5):
    """A log of SensorLog on an iPhone: a row for each sample, in which other sensors have their last one; G, kPa.

    Version 1 has no units in its names and spaces in its times. The counter has counted 100 before, and 2 a second.
    """
    times, last = s.time + 5432.1, np.searchsorted(s.fix_time, s.time, side="right") - 1
    at, known = np.maximum(last, 0), (last >= 0)[:, None]
    place, speed = s.lonlat[:, ::-1], np.full(len(s.fix_time), SPEED)
    fixes = np.column_stack([s.fix_time + UNIX, place, s.accuracy, speed, s.bearing])
    columns = {
        "accelerometerTimestamp_sinceReboot(s)": times,
        **{f"accelerometerAcceleration{axis}(G)": -s.acceleration[:, n] / G for n, axis in enumerate("XYZ")},
        "motionTimestamp_sinceReboot(s)": times,
        **{f"motionRotationRate{axis}(rad/s)": s.angular_rate[:, n] for n, axis in enumerate("XYZ")},
        **{f"motionMagneticField{axis}(µT)": s.field[:, n] for n, axis in enumerate("XYZ")},
        "altimeterTimestamp_sinceReboot(s)": times + 7e8,  # of the year 2001
        "altimeterPressure(kPa)": s.pressure / 10,
        **dict(zip(LOCATED, (fixes[at] * known).T, strict=True)),
    }
    stamps = [datetime.fromtimestamp(UNIX + t, UTC).isoformat(timespec="microseconds") for t in s.time]
    counted = [(n, datetime.fromtimestamp(UNIX + n / 2, UTC).isoformat()) for n in (2 * s.time).astype(int).tolist()]
    if version == 1:
        stamps = [stamp.replace("T", " ").replace("+00:00", " +0000") for stamp in stamps]
        columns = {name.split("(")[0]: column for name, column in columns.items()}
    head = ["loggingTime(txt)", *columns, "pedometerNumberofSteps(N)", "pedometerEndDate(txt)"]
    rows = zip(stamps, np.column_stack([*columns.values()]).tolist(), counted, strict=True)
    lines = [",".join([stamp, *map(repr, row), str(100 + n), end]) for stamp, row, (n, end) in rows]
    return "\n".join([",".join(head), *lines]) + "\n"


LOCATED = (
    *("locationTimestamp_since1970(s)", "locationLatitude(WGS84)", "locationLongitude(WGS84)"),
    *("locationHorizontalAccuracy(m)", "locationSpeed(m/s)", "locationCourse(°)"),
)


def device_motion(s, sign=1.0):
    """Events of W3C DeviceMotion as a page writes them: milliseconds, °/s, alpha about x; sign: -1 of Safari."""
    names = [f"accelerationIncludingGravity{axis}" for axis in "XYZ"]
    names = ["timeStamp", *names, "rotationRate.alpha", "rotationRate.beta", "rotationRate.gamma"]
    table = np.column_stack([UNIX * 1e3 + s.time * 1e3, sign * s.acceleration, np.degrees(s.angular_rate)])
    return ",".join(names) + "\n" + columns(table, delimiter=",", form="{:.17g}")


def movella(s, device="DOT", first=2**32 - 5_000_000):
    """A log of a Movella DOT (µs that wrap, °/s), of an MTi (0.1 ms, rad/s), or of an MTw (packets by number)."""
    about = {
        "DOT": "sep=,\nDeviceTag:,1\nOutputRate:,60Hz\n© Movella Technologies B. V. 2005-2025\n\n",
        "MTi": "// General information:\n//  MT Manager version: 2022.2.0\n",
        "MTw": "// Start Time: Unknown\n// Update Rate: 50.0Hz\n",
    }[device]
    ticks = (first + np.round(s.time * (1e6 if device == "DOT" else 1e4))) % 2**32
    names = ["PacketCounter", "SampleTimeFine", *(f"{name}_{axis}" for name in ("Acc", "Gyr", "Mag") for axis in "XYZ")]
    rate = np.degrees(s.angular_rate) if device == "DOT" else s.angular_rate
    fine = np.full(len(ticks), np.nan) if device == "MTw" else ticks
    counter = (np.arange(len(ticks)) + 65_000) % 65_536
    table = np.column_stack([counter, fine, s.acceleration, rate, s.field / 40])
    cut = "," if device == "DOT" else "\t"
    return about + cut.join(names) + "\n" + columns(table, delimiter=cut, form="{:.17g}")


# Of each reader: a file or folder name, and the function that writes a sample as text or as files
EXPORTS = {
    "indoor_location": ("walk.txt", indoor_location),
    "get_sensor_data": ("walk.txt", get_sensor_data),
    "gnss_logger": ("walk.txt", gnss_logger),
    "sensor_logger": ("walk", lambda s: sensor_logger(s, "ios")),
    "phyphox": ("walk.zip", phyphox),
    "named_columns": ("walk.csv", sensor_log),
    "device_motion": ("walk.csv", device_motion),
    "movella": ("walk.csv", movella),
    "ipin21": ("walk", ipin21),
    "oxford_steps": ("walk.csv", oxford_steps),
    "strides": ("walk.txt", strides),
    "ridi": ("walk.zip", ridi),
    "edinburgh": ("walk.xml", edinburgh),
    "geolife": ("walk.plt", geolife),
    "gpx": ("walk.gpx", gpx),
    "past_day": ("walk.csv", past_day),
}


def in_folder(folder: Path, files):
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")
    return folder


def in_zip(path: Path, files, top=""):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in files.items():
            archive.writestr(top + name, text)
    return path
