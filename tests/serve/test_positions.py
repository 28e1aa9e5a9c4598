"""Apps that send positions: the documented examples of each."""

import json

import pytest

from pdr_graph.apps.serve.sensor_messages import parse_positions
from pdr_graph.errors import InputError

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
