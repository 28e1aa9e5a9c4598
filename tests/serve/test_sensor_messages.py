"""Messages of Sensor Logger as samples: the events of a session are those of its recording."""

import csv
import json

import numpy as np
import pytest

from pdr_graph.apps.serve.sensor_messages import Intake, parse, parse_positions
from pdr_graph.errors import InputError
from pdr_graph.io.loading import load
from pdr_graph.lab.simulation.recorders import write
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.lab.simulation.streaming import batches, message
from pdr_graph.online.interface import Samples, Scan, events_of
from pdr_graph.types import STANDARD_GRAVITY, Recording, Signal


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


def sample(name, time=1_700_000_000_000_000_000, **values):
    return {"name": name, "time": time, "values": values}


RAW = sample("accelerometeruncalibrated", x=0.0, y=0.0, z=-9.8)


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


def intake_of(*samples):
    """What has taken one message in, and its events."""
    intake = Intake("sensorlogger")
    return intake, intake.events(message("s", 0, samples))


def equal(one, other, tolerance=0.0):
    def near(a, b):
        return a.shape == b.shape and np.allclose(a, b, rtol=0, atol=tolerance, equal_nan=True)

    if type(one) is not type(other) or not near(one.time, other.time):
        return False
    if isinstance(one, Samples):
        return one.sensor == other.sensor and near(one.values, other.values)
    return all(near(getattr(one, name), getattr(other, name)) for name in ("position", "sigma", "speed", "course"))


@pytest.mark.parametrize("period", [0.37, 5.0])
def test_events_of_messages_are_those_of_the_recording(export, walk, period):
    """To the bit, wherever the messages end: what is estimated live is what `replay` estimates."""
    expected, found = list(events_of(walk)), taken(streamed(export, period))
    assert len(expected) > 1000
    assert all(equal(*pair) for pair in zip(expected, found, strict=True))


def test_an_iphone_gives_the_same_samples_as_an_android_phone(walk):
    one, other = taken(bodies(walk)), taken(bodies(walk, ios=True))
    assert all(equal(*pair, tolerance=1e-6) for pair in zip(one, other, strict=True))


@pytest.mark.parametrize(
    ("payload", "platform", "expected"),
    [
        ([sample("accelerometer", x=1.0, y=0.0, z=0.5), sample("gravity", x=0.0, y=0.0, z=9.8)], "", [1.0, 0.0, 10.3]),
        (
            [sample("accelerometer", x=0.1, y=0.0, z=0.0), sample("gravity", x=0.0, y=0.0, z=-1.0)],
            "",
            [-0.1 * STANDARD_GRAVITY, 0.0, STANDARD_GRAVITY],
        ),
        ([RAW], "android", [0.0, 0.0, -9.8]),
        ([RAW], "ios", [0.0, 0.0, 9.8]),
        ([RAW], "", [0.0, 0.0, 9.8]),
        ([RAW | {"accuracy": 3}], "", [0.0, 0.0, -9.8]),
    ],
    ids=[
        "accelerometer and gravity are added",
        "gravity in g into the screen is an iPhone",
        *("stated Android", "stated iPhone", "gravity into the screen is an iPhone", "accuracies are Android's"),
    ],
)
def test_total_acceleration_has_the_signs_of_its_platform(payload, platform, expected):
    (event,) = taken([message("s", 0, payload)], platform=platform)
    assert event.sensor == "accelerometer"
    assert np.allclose(event.values, [expected])


def test_without_gravity_the_accelerometer_is_linear_and_advice_says_so():
    intake, events = intake_of(*(sample("accelerometer", 10**18 + n * 10**7, x=0.1, y=0.2, z=0.3) for n in range(300)))
    assert {event.sensor for event in events} == {"linear_acceleration"}
    for name in ("Gravity", "Gyroscope"):
        assert any(f"switch on {name}" in line for line in intake.advice)


def test_other_sensors_are_ignored_and_counted():
    intake, _ = intake_of(sample("pedometer", steps=4), sample("battery"), sample("pedometer", steps=5))
    assert intake.ignored == {"pedometer": 2, "battery": 1}


def test_bluetooth_is_a_scan_without_receptions_of_no_level():
    heard = sample("bluetooth", id="AA:BB", rssi=-60), sample("bluetooth", id="C")
    events = taken([message("s", 0, [sample("gyroscope", x=0, y=0, z=0), *heard])])
    assert [event.heard.transmitter for event in events if isinstance(event, Scan)] == [("AA:BB",)]


@pytest.mark.parametrize("values", ['{"x":null,"y":1,"z":2}', '{"x":"a","y":1,"z":2}', '{"y":1,"z":2}'])
def test_values_that_are_no_numbers_are_counted_and_left_out(values):
    good = json.dumps(sample("gyroscope", x=0.1, y=0.2, z=0.3))
    bad = f'{{"name":"gyroscope","time":1700000000000000001,"values":{values}}}'
    intake = Intake("sensorlogger")
    intake.events(f'{{"messageId":0,"sessionId":"s","payload":[{good},{bad}]}}'.encode())
    assert intake.unusable == {"gyroscope": 1}


def test_times_years_away_are_left_out():
    intake, _ = intake_of(sample("gyroscope", x=0, y=0, z=0), sample("gyroscope", 9 * 10**18, x=0, y=0, z=0))
    assert intake.unusable == {"gyroscope": 1}


def test_a_clock_that_is_set_back_loses_nothing_that_waited(walk):
    late = bodies(walk)
    earlier = [body.replace(b'"time": 17', b'"time": 16') for body in late[10:]]
    count = sum(len(event.time) for event in taken(late[:10]) + taken(late[10:]) if isinstance(event, Samples))
    both = taken(late[:10] + earlier)
    assert sum(len(event.time) for event in both if isinstance(event, Samples)) == count


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
        (b'{"messageId":1,"sessionId":"s","payload":[{"name":"gyroscope","time":1,"values":{"x":1e400}}]}', "number"),
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


# Apps that send positions: the documented examples of each

OWNTRACKS = {"_type": "location", "tid": "ne", "lat": 48.8584, "lon": 2.2945, "tst": 1_700_000_000, "acc": 15, "vel": 5}
OVERLAND = {
    "timestamp": "2015-10-01T08:00:00-0700",
    "altitude": 0,
    "speed": 4,
    "horizontal_accuracy": 30,
    "vertical_accuracy": -1,
    "motion": ["driving", "stationary"],
    "device_id": "phone",
}
TRACCAR = {
    "device_id": "12345",
    "location": {
        "timestamp": "2024-05-01T09:30:00.000Z",
        "coords": {"latitude": 48.1, "longitude": 11.5, "accuracy": 6.2, "speed": -1, "heading": -1, "altitude": 500},
        "is_moving": True,
        "battery": {"level": 0.5, "is_charging": False},
    },
}
QUERY = "id=12345&lat=48.1&lon=11.5&timestamp={}&hdop=0&altitude=3&speed=10&accuracy=6.2"
PLACE = ("12345", 1714555800, [11.5, 48.1], 6.2)


def overland(**more):
    """A batch of a position and an event."""
    point = {"type": "Point", "coordinates": [-122.030581, 37.3318]}
    place = {"type": "Feature", "geometry": point, "properties": OVERLAND | more}
    return {"locations": [place, {"type": "Feature", "geometry": None, "properties": {"action": "will_terminate"}}]}


def encoded(body):
    return body.encode() if isinstance(body, str) else json.dumps(body).encode()


@pytest.mark.parametrize(
    ("protocol", "body", "expected"),
    [
        ("owntracks", OWNTRACKS | {"topic": "owntracks/ann/pixel"}, ("pixel", 1_700_000_000, [2.2945, 48.8584], 15)),
        ("overland", overland(), ("phone", 1443711600, [-122.030581, 37.3318], 30)),
        ("osmand", QUERY.format("1714555800"), PLACE),
        ("osmand", QUERY.format("1714555800000"), PLACE),
        ("osmand", QUERY.format("2024-05-01T09:30:00Z"), PLACE),
        ("osmand", QUERY.format("2024-05-01T11:30:00%2B02:00"), PLACE),
        ("osmand", "deviceid=12345&location=48.1,11.5&timestamp=1714555800&accuracy=6.2", PLACE),
        ("osmand", TRACCAR, PLACE),
    ],
    ids=["OwnTracks", "Overland", "seconds", "milliseconds", "ISO", "ISO with zone", "location of both", "Traccar"],
)
def test_the_documented_example_gives_its_position(protocol, body, expected):
    name, fixes = parse_positions(protocol, encoded(body))
    assert (name, fixes.time.tolist(), fixes.position.tolist()) == (expected[0], [expected[1]], [expected[2]])
    assert fixes.sigma[0] == pytest.approx(expected[3] / 1.51)


def test_owntracks_omits_an_accuracy_of_zero():
    exact = {key: value for key, value in OWNTRACKS.items() if key != "acc"}
    assert len(parse_positions("owntracks", encoded(exact))[1]) == 1


@pytest.mark.parametrize(
    ("protocol", "body"),
    [
        *(
            ("owntracks", {"_type": kind, "tst": 1})
            for kind in ("beacon", "steps", "transition", "waypoint", "lwt", "encrypted", "card", "status")
        ),
        ("owntracks", '{"_type":"location","lat":91,"lon":0,"tst":1}'),
        ("overland", overland(horizontal_accuracy=-1)),  # it marks invalid positions
        ("overland", '{"locations":[{"properties":{"timestamp":"x"},"geometry":{"coordinates":[1,2]}},3,null]}'),
        ("osmand", "id=1&lat=1e300&lon=2&timestamp=3"),
    ],
)
def test_other_messages_and_absurd_numbers_give_no_position(protocol, body):
    assert len(parse_positions(protocol, encoded(body))[1]) == 0


@pytest.mark.parametrize(
    ("protocol", "body"),
    [
        ("owntracks", b'{"_type":"location","lat":48}'),
        ("owntracks", b'{"lat":48}'),
        ("owntracks", b'{"_type":'),
        ("overland", b'{"locations":1}'),
        ("overland", b"null"),
        ("osmand", b"lat=1&lon=2&timestamp=3"),
        ("osmand", b"id=1&lat=x&lon=2&timestamp=3"),
        ("osmand", b"id=1&lat=1&lon=2"),
        ("osmand", b"\xff"),
        ("osmand", b'{"device_id":"1"}'),
        ("osmand", b'{"device_id":"1","location":{"coords":{"latitude":1}}}'),
        ("osmand", b'{"location":{"coords":{}}}'),
    ],
)
def test_what_is_malformed_is_refused_in_one_line(protocol, body):
    with pytest.raises(InputError) as refused:
        parse_positions(protocol, body)
    assert "\n" not in str(refused.value)
