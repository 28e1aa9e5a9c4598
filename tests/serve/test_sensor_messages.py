"""Messages of Sensor Logger as samples: the events of a session are those of its recording."""

import csv
import json

import numpy as np
import pytest

from pdr_graph.apps.serve.sensor_messages import Intake, parse
from pdr_graph.errors import InputError
from pdr_graph.io.loading import load
from pdr_graph.lab.simulation.recorders import write
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.lab.simulation.streaming import batches, message
from pdr_graph.online.interface import Samples, Scan, events_of
from pdr_graph.types import STANDARD_GRAVITY, Fixes, Recording, Signal


@pytest.fixture(scope="module")
def export(tmp_path_factory):
    """The export of a minute outdoors, with GNSS."""
    folder = tmp_path_factory.mktemp("outdoors")
    scenario = folder / "short.toml"
    scenario.write_text("route = [[0.0, 0.0], [40.0, 0.0], [40.0, 20.0]]\n[gnss]\naccuracy = 4.0\n")
    write(simulate(Scenario.load(scenario)), folder)
    for name in ("TotalAcceleration.csv", "truth.csv", "steps.csv", "events.csv", "gnss.csv", "short.toml"):
        (folder / name).unlink()  # the stream has no total acceleration
    return folder


@pytest.fixture(scope="module")
def walk(export):
    """The same as it is read."""
    return load(export)


def streamed(folder, period):
    """The rows of an export as messages of a duration [s]."""
    rows = []
    for file in folder.glob("*.csv"):
        for row in csv.DictReader(file.open(encoding="utf-8")) if file.stem != "Metadata" else ():
            time = int(row.pop("time"))
            del row["seconds_elapsed"]
            rows.append((time, sample(file.stem.lower(), time, **{key: float(value) for key, value in row.items()})))
    rows.sort(key=lambda row: row[0])
    groups = {}
    for time, each in rows:
        groups.setdefault(int((time - rows[0][0]) / 1e9 // period), []).append(each)
    return [message("s", n, payload) for n, payload in enumerate(groups.values())]


def bodies(walk, period=1.0, **options):
    return [message("s", n, payload) for n, payload in enumerate(batches(walk, period, **options))]


def taken(bodies, **options):
    """The events of messages."""
    intake = Intake("sensorlogger", **options)
    return [event for body in bodies for event in intake.events(body)] + intake.flush()


def sample(name, time=1_700_000_000_000_000_000, **values):
    return {"name": name, "time": time, "values": values}


def equal(one, other, tolerance=0.0):
    def near(a, b):
        return a.shape == b.shape and np.allclose(a, b, rtol=0, atol=tolerance)

    if type(one) is not type(other) or not near(one.time, other.time):
        return False
    if isinstance(one, Samples):
        return one.sensor == other.sensor and near(one.values, other.values)
    return near(one.position, other.position) and near(one.sigma, other.sigma)


@pytest.mark.parametrize("period", [0.2, 0.37, 1.0, 5.0])
def test_events_of_messages_are_those_of_the_recording(export, walk, period):
    """To the bit, wherever the messages end: what is estimated live is what `replay` estimates."""
    expected, found = list(events_of(walk)), taken(streamed(export, period))
    assert len(expected) > 1000
    assert all(equal(*pair) for pair in zip(expected, found, strict=True))


def test_positions_are_fixes_with_the_sigma_of_their_radius(walk):
    fixes = Fixes.concatenate([event for event in taken(bodies(walk)) if isinstance(event, Fixes)])
    assert np.allclose(fixes.position, walk.fixes.position, rtol=0, atol=1e-12)
    assert np.allclose(fixes.sigma, walk.fixes.sigma)


def test_an_iphone_gives_the_same_samples_as_an_android_phone(walk):
    one, other = taken(bodies(walk)), taken(bodies(walk, ios=True))
    assert all(equal(*pair, tolerance=1e-6) for pair in zip(one, other, strict=True))


def test_total_acceleration_is_the_sum_of_accelerometer_and_gravity():
    payload = [
        *(
            sample(name, time, x=x, y=0.0, z=z)
            for time in (10**18, 10**18 + 10**7)
            for name, x, z in (("accelerometer", 1.0, 0.5), ("gravity", 0.0, 9.8))
        ),
    ]
    (event,) = taken([message("s", 0, payload)])
    assert event.sensor == "accelerometer"
    assert np.allclose(event.values, [[1.0, 0.0, 10.3]] * 2)


def test_gravity_in_g_into_the_screen_is_an_iphone():
    payload = [sample("accelerometer", x=0.1, y=0.0, z=0.0), sample("gravity", x=0.0, y=0.0, z=-1.0)]
    (event,) = taken([message("s", 0, payload)])
    assert np.allclose(event.values, [[-0.1 * STANDARD_GRAVITY, 0.0, STANDARD_GRAVITY]])


def test_the_stated_platform_decides_the_signs():
    payload = [sample("accelerometeruncalibrated", x=0.0, y=0.0, z=-9.8)]
    for platform, z in (("android", -9.8), ("ios", 9.8), ("", 9.8)):
        (event,) = taken([message("s", 0, payload)], platform=platform)
        assert event.values[0, 2] == pytest.approx(z)


def test_accuracies_are_androids():
    payload = [sample("accelerometeruncalibrated", x=0.0, y=0.0, z=-9.8) | {"accuracy": 3}]
    (event,) = taken([message("s", 0, payload)])
    assert event.values[0, 2] == pytest.approx(-9.8)


def test_without_gravity_the_accelerometer_is_linear_and_advice_says_so():
    intake = Intake("sensorlogger")
    times = 10**18 + np.arange(300) * 10**7
    payload = [sample("accelerometer", int(t), x=0.1, y=0.2, z=0.3) for t in times]
    events = intake.events(message("s", 0, payload))
    assert {event.sensor for event in events} == {"linear_acceleration"}
    assert any("switch on Gravity" in line for line in intake.advice)
    assert any("switch on Gyroscope" in line for line in intake.advice)


def test_other_sensors_are_ignored_and_counted():
    intake = Intake("sensorlogger")
    intake.events(message("s", 0, [sample("pedometer", steps=4), sample("battery"), sample("pedometer", steps=5)]))
    assert intake.ignored == {"pedometer": 2, "battery": 1}


def test_bluetooth_is_a_scan_without_receptions_of_no_level():
    payload = [
        sample("gyroscope", x=0, y=0, z=0),
        sample("bluetooth", id="AA:BB", rssi=-60),
        sample("bluetooth", id="C"),
    ]
    events = taken([message("s", 0, payload)])
    scan = next(event for event in events if isinstance(event, Scan))
    assert scan.heard.transmitter == ("AA:BB",)


def test_values_that_are_no_numbers_are_counted_and_left_out():
    intake = Intake("sensorlogger")
    texts = b'{"messageId":0,"sessionId":"s","payload":[%s]}'
    good = json.dumps(sample("gyroscope", x=0.1, y=0.2, z=0.3)).encode()
    for bad in (b'{"x":null,"y":1,"z":2}', b'{"x":"a","y":1,"z":2}', b'{"y":1,"z":2}', b'{"x":1e400,"y":1,"z":1}'):
        body = texts % (good + b',{"name":"gyroscope","time":1700000000000000001,"values":' + bad + b"}")
        try:
            intake.events(body)
        except InputError:  # 1e400 is no number of JSON's usual range
            assert b"1e400" in bad
    assert intake.unusable == {"gyroscope": 3}


def test_a_clock_that_is_set_back_loses_nothing_that_waited(walk):
    late = bodies(walk)
    earlier = [body.replace(b'"time": 17', b'"time": 16') for body in late[10:]]
    count = sum(len(event.time) for event in taken(late[:10]) + taken(late[10:]) if isinstance(event, Samples))
    both = taken(late[:10] + earlier)
    assert sum(len(event.time) for event in both if isinstance(event, Samples)) == count


def test_times_years_away_are_left_out():
    intake = Intake("sensorlogger")
    payload = [sample("gyroscope", x=0, y=0, z=0), sample("gyroscope", 9 * 10**18, x=0, y=0, z=0)]
    intake.events(message("s", 0, payload))
    assert intake.unusable == {"gyroscope": 1}


@pytest.mark.parametrize(
    ("body", "place"),
    [
        (b"", "truncated"),
        (b'{"messageId":1,"sessionId":"s","payload":[{"name":"gyro', "truncated"),
        (b"[1,2]", "object"),
        (b'{"messageId":"1","sessionId":"s","payload":[]}', "messageId"),
        (b'{"messageId":-1,"sessionId":"s","payload":[]}', "messageId"),
        (b'{"messageId":1,"sessionId":"","payload":[]}', "sessionId"),
        (b'{"messageId":1,"sessionId":"s"}', "payload"),
        (b'{"messageId":1,"sessionId":"s","payload":[{"name":"gyroscope"}]}', "time"),
        (b'{"messageId":1,"sessionId":"s","payload":[{"name":"gyroscope","time":NaN}]}', "malformed"),
        (b"\xff\xfe", "invalid"),
        (b"[" * 100_000, ""),
    ],
)
def test_a_malformed_message_is_refused_in_one_line(body, place):
    with pytest.raises(InputError) as refused:
        parse(body)
    assert place in str(refused.value).lower() or place in str(refused.value)
    assert "\n" not in str(refused.value)


def test_nanoseconds_keep_all_their_digits():
    assert parse(message("s", 1, [sample("gyroscope", 1753234909096237317)])).payload[0].time == 1753234909096237317


def test_a_recording_without_a_clock_has_messages_too():
    signal = Signal(np.arange(5) / 10, np.ones((5, 3)))
    assert len(batches(Recording("r", 0.0, None, gyroscope=signal))) == 1
