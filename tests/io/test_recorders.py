"""Each reader returns the samples that were written: one walk in every format, compared with itself."""

import re

import numpy as np
import pytest
from recorders import (
    SPEED,
    UNIX,
    G,
    device_motion,
    edinburgh,
    get_sensor_data,
    gnss_logger,
    in_folder,
    in_zip,
    ipin21,
    movella,
    nanoseconds,
    phyphox,
    ridi,
    sample,
    sensor_log,
    sensor_logger,
    strides,
    table,
    workbook,
    xyz,
)
from refusals import refused

from pdr_graph import detect_steps
from pdr_graph.io.loading import load
from pdr_graph.io.validation import RADIUS_68
from pdr_graph.types import LONLAT


@pytest.fixture(scope="module")
def sampled():
    return sample()


def assert_is_the_walk(walk, sampled, start, clock_tolerance=1e-6):
    """Signals equal to the digits written, times from the first sample, fixes with place, time and sigma."""
    assert walk.clock_origin == pytest.approx(start + sampled.time[0], abs=1e-2)
    for signal, values in ((walk.accelerometer, sampled.acceleration), (walk.gyroscope, sampled.angular_rate)):
        assert signal.time == pytest.approx(sampled.time - sampled.time[0], abs=clock_tolerance)
        assert signal.values == pytest.approx(values, abs=2e-5)
    at = walk.fixes.time + walk.clock_origin - start
    assert at == pytest.approx(sampled.fix_time, abs=1e-2)
    assert walk.fixes.epsg == LONLAT
    assert walk.fixes.position == pytest.approx(sampled.lonlat, abs=1e-8)
    assert walk.fixes.sigma == pytest.approx(sampled.accuracy / RADIUS_68, rel=1e-6)
    assert walk.fixes.speed == pytest.approx(SPEED)
    assert np.exp(1j * walk.fixes.course) == pytest.approx(np.exp(1j * np.radians(90 - sampled.bearing)))


@pytest.mark.parametrize(
    "style",
    [{}, {"delimiter": ";"}, {"delimiter": "\t", "decimal": ","}, {"delimiter": ";", "decimal": ",", "quote": ""}],
    ids=["comma", "semicolon", "tab, decimal comma", "semicolon, decimal comma, no quotes"],
)
def test_reader_phyphox(tmp_path, sampled, style):
    walk = load(in_folder(tmp_path / "walk", phyphox(sampled, **style)))
    assert_is_the_walk(walk, sampled, 0.0)
    assert walk.epoch is None, "without meta/time.csv there is no clock"
    assert walk.magnetometer.values[3] == pytest.approx([5, 20, -40])
    assert walk.barometer.values[0] == pytest.approx(1013.25)


def test_reader_phyphox_restores_pauses(tmp_path, sampled):
    """Paused after 8 s for 100 s: the export joins the parts, meta/time.csv has the times of both."""
    events = f'"START",0.0,{UNIX}\n"PAUSE",8.0,{UNIX + 8}\n"START",8.0,{UNIX + 108}\n"PAUSE",20.0,{UNIX + 120}\n'
    files = phyphox(sampled) | {"meta/time.csv": '"event","experiment time","system time"\n' + events}
    walk = load(in_zip(tmp_path / "walk.zip", files, top="Walk 2023-11-14 22-13-20/"))
    assert walk.clock_origin == walk.epoch == pytest.approx(UNIX)
    expected = np.where(sampled.time >= 8.0, sampled.time + 100.0, sampled.time)
    assert walk.accelerometer.time == pytest.approx(expected, abs=1e-6)
    assert np.diff(walk.fixes.time).max() == pytest.approx(101.0, abs=1e-6)
    assert any("1 gap, the longest of 100.02 s" in note for note in walk.notes)


def test_reader_phyphox_in_other_languages_and_one_table(tmp_path, sampled):
    """German names, all sensors in one table, the shorter columns end in NaN."""
    half = sampled.angular_rate.copy()
    half[400:] = np.nan
    names = ["Zeit (s)", *(f"Beschleunigung {a} (m/s²)" for a in "xyz"), "Absolutbeschleunigung (m/s²)"]
    names += ["Zeit (s)", *(f"Drehrate {a} (rad/s)" for a in "xyz")]
    absolute = np.linalg.norm(sampled.acceleration, axis=1)
    path = tmp_path / "Rohdaten.csv"
    path.write_text(table(names, sampled.time, sampled.acceleration, absolute, sampled.time, half))
    walk = load(path)
    assert walk.accelerometer.values == pytest.approx(sampled.acceleration, abs=1e-6)
    assert len(walk.gyroscope) == 400
    assert walk.gyroscope.values == pytest.approx(sampled.angular_rate[:400], abs=1e-6)


def test_reader_phyphox_without_gravity_still_gives_all_steps(tmp_path, sampled):
    user = sampled.acceleration - sampled.gravity
    text = table(xyz("m/s^2", "Linear Acceleration {}"), sampled.time, user)
    walk = load(in_folder(tmp_path / "a", {"Raw Data.csv": text}))
    assert walk.accelerometer is None
    assert walk.linear_acceleration.values == pytest.approx(user, abs=1e-6)
    complete = load(in_folder(tmp_path / "b", phyphox(sampled)))
    found = detect_steps(walk)
    assert len(found) == len(detect_steps(complete))
    assert len(found.unknown) == 2, "turns and the vertical"


@pytest.mark.parametrize(("platform", "standardised"), [("android", False), ("ios", False), ("ios", True)])
@pytest.mark.parametrize("without", [(), ("TotalAcceleration.csv",), ("TotalAcceleration.csv", "Gravity.csv")])
def test_reader_sensor_logger(tmp_path, sampled, platform, standardised, without):
    """Equal from both platforms: from the total acceleration, from its two parts, and from the uncalibrated one."""
    files = {n: t for n, t in sensor_logger(sampled, platform, standardised).items() if n not in without}
    if "Gravity.csv" in without:
        del files["Accelerometer.csv"]
    walk = load(in_zip(tmp_path / "walk.zip", files))
    assert_is_the_walk(walk, sampled, UNIX)
    assert walk.epoch == walk.clock_origin
    assert walk.barometer.values[0] == pytest.approx(1013.25)


@pytest.mark.parametrize("platform", ["android", "ios"])
def test_reader_sensor_logger_without_metadata_infers_the_platform_from_gravity(tmp_path, sampled, platform):
    """The screen of a carried phone faces up: gravity into the screen is the sign of iOS."""
    left_out = ("Metadata.csv", "TotalAcceleration.csv")
    files = {n: t for n, t in sensor_logger(sampled, platform).items() if n not in left_out}
    walk = load(in_folder(tmp_path / "walk", files))
    assert_is_the_walk(walk, sampled, UNIX)
    assert any("no Metadata.csv" in note for note in walk.notes)


@pytest.mark.parametrize("platform", ["android", "ios"])
def test_reader_sensor_logger_of_2021(tmp_path, sampled, platform):
    """Its tables have nanoseconds alone, its metadata no names of standards."""
    files = sensor_logger(sampled, platform)
    files = {name: re.sub(r"(?m)^(time|\d{19}),[^,]*,", r"\1,", text) for name, text in files.items()}
    files["Metadata.csv"] = f"version,device name,recording time,platform\n2,Phone,2021-11-12_21-13-19,{platform}\n"
    del files["AccelerometerUncalibrated.csv"]
    files.pop("TotalAcceleration.csv", None)
    assert not any("seconds_elapsed" in text for text in files.values())
    assert_is_the_walk(load(in_zip(tmp_path / "walk.zip", files)), sampled, UNIX)


def test_of_two_tables_of_a_sensor_the_longer_one_is_used_and_named(tmp_path, sampled):
    """Calibrated before uncalibrated, GPS before network, unless it is less than half as long."""
    files = sensor_logger(sampled)
    whole, short = files["Gyroscope.csv"], "\n".join(files["Gyroscope.csv"].split("\n")[:9]) + "\n"
    for first, second in ((whole, whole.replace("0.", "9.")), (short, whole)):
        pair = {"Gyroscope.csv": first, "GyroscopeUncalibrated.csv": second}
        walk = load(in_zip(tmp_path / "walk.zip", files | pair))
        assert_is_the_walk(walk, sampled, UNIX)
        assert any("GyroscopeUncalibrated.csv is used" in note for note in walk.notes) == (first == short)


def test_of_two_tables_of_a_phyphox_export_the_one_during_the_positions_is_used(tmp_path, sampled):
    """Neither the shortest name nor the number of rows matters where only another one is of the walk."""
    files = phyphox(sampled)
    [(name, text)] = [(n, t) for n, t in files.items() if n.startswith("Accel")]
    head, *rows = text.splitlines()
    tomorrow = [re.sub(r"^[\d.]+", lambda time: repr(float(time[0]) + 86_400), row) for row in rows]
    for other in (tomorrow, rows[::9]):
        walk = load(in_zip(tmp_path / "walk.zip", files | {"A.csv": "\n".join([head, *other]) + "\n"}))
        assert_is_the_walk(walk, sampled, 0.0)
        assert any("A.csv" in note and f"{name} ({len(rows)} rows) is used" in note for note in walk.notes)


def test_reader_sensor_logger_leaves_out_invalid_positions(tmp_path, sampled):
    """iOS marks them with a negative accuracy."""
    accuracy = sampled.accuracy.copy()
    accuracy[[2, 5]] = -1
    location = nanoseconds("horizontalAccuracy,longitude,latitude", sampled.fix_time, accuracy, sampled.lonlat)
    walk = load(in_folder(tmp_path / "walk", sensor_logger(sampled, "ios") | {"Location.csv": location}))
    assert len(walk.fixes) == len(sampled.fix_time) - 2
    assert any(f"2 of {len(sampled.fix_time)} positions are invalid" in note for note in walk.notes)


def test_reader_sensor_logger_reads_one_table(tmp_path, sampled):
    path = tmp_path / "walking3.csv"
    path.write_text(nanoseconds("z,y,x", sampled.time, sampled.acceleration[:, ::-1]))
    assert load(path).accelerometer.values == pytest.approx(sampled.acceleration)


def test_reader_sensor_logger_does_not_read_what_the_walk_does_not_use(tmp_path, sampled):
    """Android writes the acceleration three times: with gravity, without, and gravity alone."""
    broken = {name: "time,seconds_elapsed,z,y,x\n1,2,three,4,5\n" for name in ("Accelerometer.csv", "Gravity.csv")}
    files = sensor_logger(sampled) | broken
    assert_is_the_walk(load(in_folder(tmp_path / "walk", files)), sampled, UNIX)
    del files["TotalAcceleration.csv"]
    refused(load, in_folder(tmp_path / "needed", files), "three")


@pytest.mark.parametrize("unit", [1.0, 1 / G], ids=["IPIN", "xDR, in g"])
def test_reader_get_sensor_data(tmp_path, sampled, unit):
    path = tmp_path / "logfile.txt"
    path.write_text(get_sensor_data(sampled, unit))
    walk = load(path)
    # five digits in g are ten times as coarse in m/s²
    assert walk.accelerometer.values == pytest.approx(sampled.acceleration, abs=1e-4)
    assert walk.clock_origin == pytest.approx(0.004, abs=1e-4), "the app's clock, as a whole"
    assert walk.accelerometer.time == pytest.approx(sampled.time, abs=1e-4)
    assert walk.gyroscope.values == pytest.approx(sampled.angular_rate, abs=1e-5)
    assert walk.fixes.time + walk.clock_origin == pytest.approx(sampled.fix_time, abs=1e-4)
    assert walk.epoch == pytest.approx(UNIX, abs=0.6), "GNSS seconds are whole here"
    assert any("duplicate epochs" in note for note in walk.notes)
    assert any("is g" in note for note in walk.notes) == (unit != 1.0)
    assert walk.wifi.transmitter == ("00:11:22:33:44:55",)
    assert walk.bluetooth.rssi.tolist() == [-90.0]
    assert walk.truth.floor == ("-2",)
    assert walk.truth.position == pytest.approx(np.array([[11.1, 49.45]]))


def test_reader_get_sensor_data_uses_the_apps_clock_if_the_sensors_clock_stands_still(tmp_path, sampled):
    path = tmp_path / "logfile.txt"
    stuck = [line for line in get_sensor_data(sampled).splitlines() if "GYRO" not in line]
    stuck += [f"GYRO;{t:.4f};0.0;0.1;0.2;0.3;3" for t in sampled.time]
    path.write_text("\n".join(stuck) + "\n")
    walk = load(path)
    assert np.diff(walk.gyroscope.time) == pytest.approx(0.02, abs=1e-3)
    assert any("its clock and the app's differ" in note for note in walk.notes)


@pytest.mark.parametrize("header", [None, "Fix,Provider,Latitude,Longitude,Altitude,Speed,Accuracy,Bearing"])
def test_reader_gnss_logger(tmp_path, sampled, header):
    """Uncalibrated sensors minus their bias; the fixes of one provider, with columns by the names in the header."""
    path = tmp_path / "gnss_log.txt"
    path.write_text(gnss_logger(sampled, header) if header else gnss_logger(sampled))
    walk = load(path)
    assert_is_the_walk(walk, sampled, UNIX)
    assert any("other providers" in note for note in walk.notes)


def test_the_latency_of_the_receiver_shifts_fixes_only(tmp_path, sampled):
    folder = in_folder(tmp_path / "walk", phyphox(sampled))
    early, late = load(folder, gnss_latency=2.5), load(folder)
    assert early.fixes.time == pytest.approx(late.fixes.time - 2.5)
    assert early.accelerometer.time == pytest.approx(late.accelerometer.time)


def test_the_steps_of_a_walk_are_the_same_from_every_recorder(tmp_path, sampled):
    (tmp_path / "a.txt").write_text(get_sensor_data(sampled))
    (tmp_path / "b.txt").write_text(gnss_logger(sampled))
    sources = [tmp_path / "a.txt", tmp_path / "b.txt", in_folder(tmp_path / "c", phyphox(sampled))]
    sources.append(in_zip(tmp_path / "d.zip", sensor_logger(sampled, "ios")))
    steps = [detect_steps(load(source)) for source in sources]
    for other in steps[1:]:
        assert other.time == pytest.approx(steps[0].time, abs=1e-3)
        assert other.length == pytest.approx(steps[0].length, abs=1e-3)
        assert other.turn == pytest.approx(steps[0].turn, abs=1e-3)


def test_a_folder_of_several_recordings_raises(tmp_path, sampled):
    files = {f"{part}/{name}": text for part in "ab" for name, text in sensor_logger(sampled).items()}
    refused(load, in_folder(tmp_path / "walks", files), "one recording at a time")


@pytest.mark.parametrize("version", [1, 5])
def test_reader_sensor_log(tmp_path, sampled, version):
    (tmp_path / "walk.csv").write_text(sensor_log(sampled, version), encoding="utf-8")
    walk = load(tmp_path / "walk.csv")
    assert_is_the_walk(walk, sampled, UNIX, clock_tolerance=2e-5)
    assert walk.magnetometer.values[3] == pytest.approx([5, 20, -40])
    assert walk.barometer.values[0] == pytest.approx(1013.25)
    assert walk.step_counter.values[[0, -1], 0] == pytest.approx([100, 100 + int(2 * sampled.time[-1])])


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["Chrome", "Safari"])
def test_reader_device_motion(tmp_path, sampled, sign):
    """Pages of browsers: alpha is about x (w3c/deviceorientation#43), and Safari has the signs of iOS."""
    (tmp_path / "walk.csv").write_text(device_motion(sampled, sign))
    walk = load(tmp_path / "walk.csv")
    assert walk.epoch == pytest.approx(UNIX + sampled.time[0], abs=1e-3)
    assert walk.accelerometer.values == pytest.approx(sampled.acceleration, abs=1e-5)
    assert walk.gyroscope.values == pytest.approx(sampled.angular_rate, abs=1e-5)
    turned = sum(step for step in detect_steps(walk).turn)
    assert turned == pytest.approx(np.pi / 2, abs=0.2), "left around the corner, so that the axes are right"


@pytest.mark.parametrize("device", ["DOT", "MTi", "MTw"])
def test_reader_movella(tmp_path, sampled, device):
    """°/s and wrapping µs of a DOT, rad/s and ticks of an MTi, numbered packets of an MTw."""
    (tmp_path / "walk.csv").write_text(movella(sampled, device), encoding="utf-8")
    walk = load(tmp_path / "walk.csv")
    assert walk.accelerometer.time == pytest.approx(sampled.time - sampled.time[0], abs=1e-4)
    assert walk.accelerometer.values == pytest.approx(sampled.acceleration, abs=1e-5)
    assert walk.gyroscope.values == pytest.approx(sampled.angular_rate, abs=1e-5)
    assert walk.magnetometer is None, "its unit is the field at the factory"


def test_packets_without_times_and_rate_are_refused(tmp_path, sampled):
    (tmp_path / "walk.csv").write_text(movella(sampled, "MTw").replace("Update Rate: 50.0Hz", ""), encoding="utf-8")
    refused(load, tmp_path / "walk.csv", "packets by number alone")


@pytest.mark.parametrize("unit", [1.0, 1000.0], ids=["seconds", "milliseconds"])
def test_the_times_of_a_step_counter_are_in_the_unit_in_which_somebody_walks(tmp_path, unit):
    """Two steps a second, and a rest of an hour, in rows a second apart."""
    time = np.append(np.arange(60.0), 3660.0)
    steps = np.append(2 * np.arange(60), 118)
    path = tmp_path / "wheel.csv"
    rows = "".join(f"{unit * t:.1f};{n};{1.4 * n:.2f}\n" for t, n in zip(time, steps, strict=True))
    path.write_text(f"time;steps;distance\n{rows}")
    counter = load(path).step_counter
    assert counter.values[-1, 0] == 118
    assert counter.time[-1] - counter.time[0] == pytest.approx(59.0)


@pytest.mark.parametrize("of", [strides, ridi, edinburgh])
def test_the_sensors_of_a_walk_of_research_are_those_written(tmp_path, sampled, of):
    content = of(sampled)
    path = tmp_path / "walk"
    walk = load(in_zip(path.with_suffix(".xlsx"), content) if of is ridi else written(path, content))
    for sensor, values in (("accelerometer", "acceleration"), ("gyroscope", "angular_rate"), ("magnetometer", "field")):
        signal = walk.signals[sensor]
        assert signal.time == pytest.approx(sampled.time - sampled.time[0], abs=1.1e-3)
        assert signal.values == pytest.approx(getattr(sampled, values), abs=1e-9)
    assert walk.epoch == (None if of is ridi else pytest.approx(UNIX, abs=1e-3))
    assert walk.notes == ()


def test_truth_and_receptions_of_a_walk_of_research(tmp_path, sampled):
    truth = load(in_zip(tmp_path / "walk.xlsx", ridi(sampled))).truth
    assert truth.position[:, 0] == pytest.approx(SPEED * truth.time)
    assert truth.epsg is None, "axes of the camera"
    wifi = load(written(tmp_path / "walk", edinburgh(sampled))).wifi
    assert (wifi.time, wifi.transmitter, wifi.rssi) == (pytest.approx([3.0], abs=1e-3), ("00:11:22:33:44:55",), [-61.0])


def test_a_track_of_ipin21_needs_no_height(tmp_path, sampled):
    files = ipin21(sampled)
    high = load(in_folder(tmp_path / "a", files)).truth
    files["GroundTruthEight.csv"] = re.sub(r"(?m)\t[^\t]*$", "", files["GroundTruthEight.csv"])
    low = load(in_folder(tmp_path / "b", files)).truth
    assert low.time.tolist() == high.time.tolist()
    assert low.position.tolist() == high.position.tolist()


def test_a_workbook_or_log_that_is_no_walk_of_research_is_refused(tmp_path, sampled):
    counted = workbook(["time", "steps"], sampled.time, sampled.time)
    refused(load, in_zip(tmp_path / "steps.xlsx", counted), "found an Excel file, expected CSV")
    two = {"1.xml": edinburgh(sampled), "2.xml": edinburgh(sampled)}
    refused(load, in_folder(tmp_path / "two", two), "found 2 logs, 1.xml and others, expected one recording at a time")
    refused(load, written(tmp_path / "a", "<data x='1'>\n<b t='1'/></data>"), "found XML of another kind")
    refused(load, written(tmp_path / "b", "test 1 2 3 4 5 6 7 8 9 10\n"), "a text that begins with 'test 1 2 3")


def written(path, text):
    path.write_text(text)
    return path
