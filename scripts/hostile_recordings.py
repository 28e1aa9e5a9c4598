"""Recordings: endless lines, encodings, hours at 400 Hz, changes of rate and unit, clocks that jump, saturation."""

import numpy as np
import pyarrow
from hostile_attack import EITHER, REFUSED, USED, Attack, honest
from pyarrow.csv import write_csv
from recorders import UNIX, get_sensor_data, sample, sensor_logger, table, xyz

from pdr_graph.types import STANDARD_GRAVITY

MB = 1_000_000
HEAD = b'"Time (s)","Acceleration x (m/s^2)","Acceleration y (m/s^2)","Acceleration z (m/s^2)"\n'
FIRST_LINES = {
    "phyphox": HEAD + b"0,",
    "sensor logger": b"time,seconds_elapsed,z,y,x\n1,",
    "GetSensorData": b"ACCE;0.1;0.1;",
    "indoor location": b"#\tstartTime:1\n1\tTYPE_ACCELEROMETER\t",
    "GPX": b'<?xml version="1.0"?><gpx version="1.1"><trk><name>',
    "GeoLife": b"Geolife trajectory\nWGS 84\nAltitude is in Feet\nReserved 3\n0,2,255,My Track,0,0,2,8421376\n0\n",
}
NAMES = {"GPX": "t.gpx", "GeoLife": "t.plt"}


def one_line(form, letters, size):
    def make(folder):
        path = folder / NAMES.get(form, "long.csv")
        with path.open("wb") as file:
            file.write(FIRST_LINES[form])
            piece = (letters * MB)[:MB]
            for _ in range(size // MB):
                file.write(piece)
        return ["smooth", path, "--out", "OUT/s"], 0

    return make


def header_line(folder):
    path = folder / "long.csv"
    path.write_bytes(HEAD[:-1] + b',"Acceleration q (m/s^2)"' * 1_200_000)
    return ["smooth", path, "--out", "OUT/s"], 0


def sparse(folder):
    path = folder / "long.csv"
    path.write_bytes(HEAD)
    with path.open("r+b") as file:
        file.truncate(999 * MB)
    return ["smooth", path, "--out", "OUT/s"], 999 * MB


def encoded(encoding, mark=b""):
    def make(folder):
        for name, text in honest().items():
            (folder / "walk" / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / "walk" / name).write_bytes(mark + text.encode(encoding, "replace"))
        return ["smooth", folder / "walk", "--out", "OUT/s"], 0

    return make


def hours(folder):
    """Ten hours of accelerometer and gyroscope at 400 Hz, with a step every half second: 0.9 GB."""
    time = np.arange(0, 36_000, 1 / 400)
    swing, sway = np.sin(12.6 * time), np.cos(6.3 * time)
    for name, unit, values in (
        ("Accelerometer", "m/s^2", (swing, sway, 9.8 + 2.5 * swing)),
        ("Gyroscope", "rad/s", (0.2 * sway, 0.1 * swing, 0.05 * np.sin(0.01 * time))),
    ):
        columns = [column.round(4) for column in (time, *values)]
        write_csv(pyarrow.table(columns, names=xyz(unit, name + " {}")), folder / f"{name}.csv")
    return ["smooth", folder, "--out", "OUT/walk"], 0


def changed(change, sensors=("acceleration", "angular_rate"), make_files=None):
    """A walk of phyphox with a change in the middle. change: of (time, values) after the middle."""

    def make(folder):
        s = sample(route=((0.0, 0.0), (60.0, 0.0), (60.0, 40.0)))
        target = folder / "walk"
        target.mkdir()
        for name, values, unit in (
            ("Accelerometer", s.acceleration, "m/s^2"),
            ("Gyroscope", s.angular_rate, "rad/s"),
        ):
            field = "acceleration" if name == "Accelerometer" else "angular_rate"
            time, rows = s.time.copy(), values.copy()
            if field in sensors:
                time, rows = change(time, rows)
            (target / f"{name}.csv").write_text(table(xyz(unit, name + " {}"), time, rows))
        return ["smooth", target, "--out", "OUT/s"], 0

    return make


def second_half(factor):
    def change(time, rows):
        rows[len(rows) // 2 :] *= factor
        return time, rows

    return change


def some_seconds(factor, seconds):
    def change(time, rows):
        rows[(time > 20) & (time < 20 + seconds)] *= factor
        return time, rows

    return change


def thinned(time, rows):
    half = len(time) // 2
    keep = np.append(np.arange(half), np.arange(half, len(time), 2))
    return time[keep], rows[keep]


def doubled(time, rows):
    half = len(time) // 2
    dense = np.arange(time[half], time[-1], (time[1] - time[0]) / 8)
    dense_rows = np.column_stack([np.interp(dense, time, column) for column in rows.T])
    return np.append(time[:half], dense), np.vstack([rows[:half], dense_rows])


def clipped(limit, factor):
    """Livelier motion than the walk's, in a sensor of too small a range."""

    def change(time, rows):
        middle = rows.mean(axis=0)
        return time, np.clip(middle + factor * (rows - middle), -limit, limit)

    return change


def jump(hours, there_and_back=False):
    def change(time, rows):
        half = len(time) // 2
        time[half:] += hours * 3600
        if there_and_back:
            time[half + len(time) // 10 :] -= hours * 3600
        return time, rows

    return change


def wild(values):
    def change(time, rows):
        rows[:: len(rows) // 40][: len(values) * 10] = np.resize(values, (10 * len(values), 1))[
            : len(rows[:: len(rows) // 40])
        ]
        return time, rows

    return change


def sensor_logger_in(unit):
    """Sensor Logger's Unix times in another unit than its nanoseconds."""

    def make(folder):
        for name, text in sensor_logger(sample()).items():
            lines = text.split("\n")
            rows = [line.split(",", 1) for line in lines[1:] if line]
            if lines[0].startswith("time,") and name != "Metadata.csv":
                text = "\n".join([lines[0], *(f"{int(a) // unit},{b}" for a, b in rows)]) + "\n"
            (folder / name).write_text(text)
        return ["smooth", folder, "--out", "OUT/s"], 0

    return make


def indoor_in(unit):
    """Microsoft's Unix times in seconds, µs or ns instead of ms: ``unit`` per second."""

    def make(folder):
        s = sample()
        rows = []
        for kind, values in (("TYPE_ACCELEROMETER", s.acceleration), ("TYPE_GYROSCOPE", s.angular_rate)):
            rows += [
                f"{(UNIX + t) * unit:.0f}\t{kind}\t{x}\t{y}\t{z}\t3"
                for t, (x, y, z) in zip(s.time, values, strict=True)
            ]
        (folder / "t.txt").write_text("\n".join(["#\tstartTime:1", *rows, "#\tendTime:2"]) + "\n")
        return ["smooth", folder / "t.txt", "--out", "OUT/s"], 0

    return make


def phyphox_milliseconds(folder):
    s = sample()
    for name, values, unit in (("Accelerometer", s.acceleration, "m/s^2"), ("Gyroscope", s.angular_rate, "rad/s")):
        (folder / f"{name}.csv").write_text(table(xyz(unit, name + " {}"), s.time * 1000, values))
    return ["smooth", folder, "--out", "OUT/s"], 0


def xdr_unit_change(folder):
    """A log of GetSensorData whose accelerometer changes from m/s² to g in the middle."""
    text = get_sensor_data(sample(route=((0.0, 0.0), (60.0, 0.0), (60.0, 40.0))))
    lines = text.split("\n")
    half = len(lines) // 2
    for n in range(half, len(lines)):
        if lines[n].startswith("ACCE"):
            cells = lines[n].split(";")
            cells[3:6] = [f"{float(v) / STANDARD_GRAVITY:.5f}" for v in cells[3:6]]
            lines[n] = ";".join(cells)
    (folder / "log.txt").write_text("\n".join(lines))
    return ["smooth", folder / "log.txt", "--out", "OUT/s"], 0


G = STANDARD_GRAVITY
RECORDINGS = (
    Attack("phyphox: one line of 1 GB", one_line("phyphox", b"1", 990 * MB)),
    *(
        Attack(f"{form}: one line of 100 MB", one_line(form, b"1", 100 * MB))
        for form in FIRST_LINES
        if form != "phyphox"
    ),
    Attack("phyphox: one line of 100 MB of commas", one_line("phyphox", b",", 100 * MB)),
    Attack("phyphox: one line of 100 MB, beyond the BMP", one_line("phyphox", "😀".encode(), 100 * MB)),
    Attack("phyphox: 100 MB of empty lines", one_line("phyphox", b"\n", 100 * MB)),
    Attack("phyphox: 100 MB of rows of one digit", one_line("phyphox", b"1\n", 100 * MB)),
    Attack("phyphox: 100 MB of quotes", one_line("phyphox", b'"\n', 100 * MB)),
    Attack("phyphox: a header of 30 MB", header_line),
    Attack("phyphox: 1 GB, sparse (NUL)", sparse),
    Attack("phyphox in UTF-16 with its mark", encoded("utf-16"), EITHER),
    Attack("phyphox in UTF-16 without a mark", encoded("utf-16-le"), REFUSED),
    Attack("phyphox in UTF-8 with its mark", encoded("utf-8", b"\xef\xbb\xbf"), USED),
    Attack("phyphox in Latin-1", encoded("latin-1"), EITHER),
    Attack("m/s² to g in mid-walk", changed(second_half(1 / G), ("acceleration",)), REFUSED, "unit"),
    Attack("g to m/s² in mid-walk", changed(lambda t, r: second_half(G)(t, r / G), ("acceleration",)), REFUSED, "unit"),
    Attack("m/s² to g for 10 s", changed(some_seconds(1 / G, 10), ("acceleration",)), REFUSED, "unit"),
    Attack("GetSensorData: m/s² to g in mid-walk", xdr_unit_change, REFUSED, "unit"),
    Attack("rad/s to deg/s in mid-walk", changed(second_half(180 / np.pi), ("angular_rate",)), REFUSED, "unit"),
    Attack("rad/s to deg/s for 10 s", changed(some_seconds(180 / np.pi, 10), ("angular_rate",)), REFUSED, "unit"),
    Attack("half the rate in mid-walk", changed(thinned), USED),
    Attack("eight times the rate in mid-walk", changed(doubled), USED),
    Attack("accelerometer saturated at 2 g", changed(clipped(2 * G, 3), ("acceleration",)), EITHER, "satur"),
    Attack("gyroscope saturated at 250 deg/s", changed(clipped(4.363, 12), ("angular_rate",)), EITHER, "satur"),
    Attack("clock jumps 5 h ahead", changed(jump(5)), EITHER, "gap|leap|go back"),
    Attack("clock jumps 5 h back", changed(jump(-5)), EITHER, "go back"),
    Attack("clock jumps 300 years ahead", changed(jump(24 * 365 * 300)), EITHER, "gap|leap"),
    Attack("clock jumps 5 h ahead and back", changed(jump(5, True)), EITHER, "go back"),
    Attack(
        "one sensor's clock jumps 5 h ahead", changed(jump(5), ("angular_rate",)), EITHER, "gap|leap|ends|no samples"
    ),
    Attack("NaN, infinity and 1e300 among samples", changed(wild([np.nan, np.inf, 1e300, -1e300])), USED),
    *(
        Attack(f"Sensor Logger: Unix {u}", sensor_logger_in(k), EITHER, "nanoseconds|clock|Hz|span|time")
        for u, k in (("µs", 1000), ("ms", 10**6), ("s", 10**9))
    ),
    *(
        Attack(f"Indoor Location: Unix {u}", indoor_in(k), EITHER, "millisec|clock|Hz|span|time")
        for u, k in (("s", 1), ("µs", 10**6), ("ns", 10**9))
    ),
    Attack("phyphox: milliseconds in a column of seconds", phyphox_milliseconds, EITHER, "millisec|Hz"),
    Attack("10 h at 400 Hz", hours, USED),
)
