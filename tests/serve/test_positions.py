"""Apps that send positions: the documented examples of each."""

import json

import pytest

from pdr_graph.apps.serve.sensor_messages import parse_positions
from pdr_graph.errors import InputError

OWNTRACKS = {"_type": "location", "tid": "ne", "lat": 48.8584, "lon": 2.2945, "tst": 1_700_000_000, "acc": 15, "vel": 5}
OVERLAND = {
    "locations": [
        {
            "type": "Feature",
            "geometry": {"type": "Point", "coordinates": [-122.030581, 37.3318]},
            "properties": {
                "timestamp": "2015-10-01T08:00:00-0700",
                "altitude": 0,
                "speed": 4,
                "horizontal_accuracy": 30,
                "vertical_accuracy": -1,
                "motion": ["driving", "stationary"],
                "device_id": "phone",
            },
        },
        {"type": "Feature", "geometry": None, "properties": {"action": "will_terminate"}},
    ]
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


def test_owntracks_gives_its_location():
    name, fixes = parse_positions("owntracks", json.dumps({**OWNTRACKS, "topic": "owntracks/ann/pixel"}).encode())
    assert name == "pixel"
    assert fixes.time[0] == 1_700_000_000
    assert fixes.position[0].tolist() == [2.2945, 48.8584]
    assert fixes.sigma[0] == pytest.approx(15 / 1.51)


def test_owntracks_omits_an_accuracy_of_zero():
    _, fixes = parse_positions("owntracks", json.dumps({k: v for k, v in OWNTRACKS.items() if k != "acc"}).encode())
    assert len(fixes) == 1


@pytest.mark.parametrize("kind", ["beacon", "steps", "transition", "waypoint", "lwt", "encrypted", "card", "status"])
def test_other_messages_of_owntracks_give_no_position(kind):
    assert len(parse_positions("owntracks", json.dumps({"_type": kind, "tst": 1}).encode())[1]) == 0


def test_overland_gives_its_points_and_leaves_out_events():
    name, fixes = parse_positions("overland", json.dumps(OVERLAND).encode())
    assert (name, len(fixes)) == ("phone", 1)
    assert fixes.position[0].tolist() == [-122.030581, 37.3318]
    assert fixes.time[0] == 1443711600


def test_overland_marks_invalid_positions_by_a_negative_accuracy():
    place = json.loads(json.dumps(OVERLAND))
    place["locations"][0]["properties"]["horizontal_accuracy"] = -1
    assert len(parse_positions("overland", json.dumps(place).encode())[1]) == 0


@pytest.mark.parametrize("time", ["1714555800", "1714555800000", "2024-05-01T09:30:00Z", "2024-05-01T11:30:00+02:00"])
def test_osmand_has_seconds_milliseconds_or_iso_times(time):
    query = f"id=123456&lat=48.1&lon=11.5&timestamp={time.replace('+', '%2B')}&hdop=0&altitude=3&speed=10&accuracy=8"
    name, fixes = parse_positions("osmand", query.encode())
    assert name == "123456"
    assert fixes.time[0] == 1714555800


def test_osmand_takes_a_location_of_both():
    _, fixes = parse_positions("osmand", b"deviceid=7&location=48.1,11.5&timestamp=1714555800")
    assert fixes.position[0].tolist() == [11.5, 48.1]


def test_traccar_client_sends_json():
    name, fixes = parse_positions("osmand", json.dumps(TRACCAR).encode())
    assert (name, fixes.time[0]) == ("12345", 1714555800)
    assert fixes.sigma[0] == pytest.approx(6.2 / 1.51)


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


@pytest.mark.parametrize("protocol", ["owntracks", "overland", "osmand"])
def test_absurd_numbers_give_no_position(protocol):
    body = {
        "owntracks": b'{"_type":"location","lat":91,"lon":0,"tst":1}',
        "overland": b'{"locations":[{"properties":{"timestamp":"x"},"geometry":{"coordinates":[1,2]}},3,null]}',
        "osmand": b"id=1&lat=1e300&lon=2&timestamp=3",
    }[protocol]
    assert len(parse_positions(protocol, body)[1]) == 0
