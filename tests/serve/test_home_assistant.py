"""Phones as devices of Home Assistant, through Mosquitto."""

import asyncio
import contextlib
import json
import re

import numpy as np
import pytest
import shapely
from plans import plan
from scipy.stats import norm
from stand_in_server import QuietHandler, served
from streamed_walks import bodies, outdoors, soon

from pdr_graph.apps.serve import home_assistant as module
from pdr_graph.apps.serve.access import OWNER
from pdr_graph.apps.serve.home_assistant import (
    PREFIX,
    STATUS,
    Alert,
    MotionSensors,
    alert,
    announce,
    motion_of,
    phone_of,
    rooms_of,
    state_of,
)
from pdr_graph.apps.serve.publishing import MOST_SUBSCRIBERS, Hub, nowhere, region
from pdr_graph.apps.serve.pulling import Sources, broker_of
from pdr_graph.apps.serve.sensor_messages import SENSOR_LOGGER
from pdr_graph.apps.serve.serving import Settings, build
from pdr_graph.errors import InputError
from pdr_graph.floor.building import Building

aiomqtt = pytest.importorskip("aiomqtt")
HOME = Building.of(
    plan(
        ("room", "Kitchen", shapely.box(0, 0, 5, 4)),
        ("room", "Bath", shapely.box(5, 0, 8, 4)),
        ("corridor", shapely.box(0, 4, 8, 6)),
    )
)


def pose(x, y, sigma=1.0, **more):
    """The event of a walker at a place."""
    at = {"x": x, "y": y, "sigma": sigma, "time": 1.7e9, "region": region(np.diag([sigma**2] * 2))}
    return {"id": "walk", "name": "Pixel 7", "state": "running", **nowhere(), **at, **more}


def test_the_confidence_of_a_room_is_the_probability_of_the_position_in_it():
    """Against the normal distribution itself: at 1 m from the wall between two rooms, with 1 m per axis."""
    rooms = rooms_of(pose(4.0, 2.0), HOME)
    along, across = norm.cdf([0, 5, 8], 4.0, 1.0), norm.cdf([0, 4, 6], 2.0, 1.0)
    kitchen, bath = np.diff(along) * (across[1] - across[0])
    corridor = (along[2] - along[0]) * (across[2] - across[1])
    whole = kitchen + bath + corridor
    assert rooms == pytest.approx({"Kitchen": kitchen / whole, "Bath": bath / whole, "": corridor / whole}, abs=0.02)
    assert next(iter(rooms)) == "Kitchen"
    assert state_of(pose(4.0, 2.0), HOME)["confidence"] == round(100 * rooms["Kitchen"])


def test_all_routes_count_and_nothing_is_said_where_nothing_is_known():
    place = {"region": region(0.01 * np.eye(2))}
    routes = [{"probability": 0.7, "x": 6.5, "y": 2.0, **place}, {"probability": 0.3, "x": 2.0, "y": 2.0, **place}]
    assert rooms_of(pose(5.1, 2.0, modes=routes), HOME) == pytest.approx({"Bath": 0.7, "Kitchen": 0.3})
    for unknown in (rooms_of(pose(2.0, 2.0), None), rooms_of(pose(900.0, 2.0), HOME), rooms_of(nowhere(), HOME)):
        assert unknown == {}
    hallway = state_of(pose(2.0, 5.0, 0.1), HOME)
    assert (hallway["room"], hallway["confidence"], hallway["rooms"]) == (None, None, {})
    assert hallway["accuracy"] == pytest.approx(0.2)


def test_motion_that_begins_is_evidence_of_a_room_and_no_more():
    """A sensor that lies, as by somebody else, does not overrule a sure position; one that stays on says nothing."""
    sensors, likely, unsure = (
        MotionSensors({"hall": "Bath"}),
        {"Kitchen": 0.9, "Bath": 0.1},
        {"Kitchen": 0.6, "Bath": 0.4},
    )
    topic = "homeassistant/binary_sensor/hall/state"
    assert sensors.weighed(unsure, 0.0) == unsure, "no state yet"
    sensors.take(topic, b"on", 0.0)
    sensors.take("homeassistant/binary_sensor/other/state", b"on", 0.0)
    assert next(iter(sensors.weighed(unsure, 5.0))) == "Bath"
    assert sensors.weighed(likely, 5.0)["Kitchen"] == pytest.approx(0.9 / (0.9 + 3 * 0.1))
    assert sensors.weighed(unsure, 40.0) == pytest.approx(unsure), "somebody was there a minute ago"
    sensors.take(topic, b"on", 41.0)
    assert sensors.weighed(unsure, 42.0) == pytest.approx(unsure), "said again"
    sensors.take(topic, b"off", 50.0)
    assert sensors.weighed(unsure, 51.0)["Bath"] < 0.4
    sensors.take(topic, b"unavailable", 52.0)
    sensors.take(topic, b"on", -np.inf)  # retained: of any age
    assert sensors.weighed(unsure, 53.0) == pytest.approx(unsure)
    assert sensors.weighed({}, 53.0) == {}


@pytest.mark.parametrize("pair", ["hall", "hall=Attic", "Hall Way=Bath", "=Bath"])
def test_a_motion_sensor_needs_a_room_of_the_plan(pair):
    with pytest.raises(InputError, match=r"--motion.*Kitchen"):
        motion_of(broker_of("mqtt://h"), [pair], HOME)
    assert motion_of(broker_of("mqtt://h"), ["hall=bath"], HOME).rooms == {"hall": "Bath"}


def test_a_phone_keeps_its_topics_from_walk_to_walk_and_users_have_their_own():
    assert phone_of(OWNER, "Pixel 7") == phone_of(OWNER, "pixel/7") == "pixel_7"
    assert phone_of("bob", "Pixel 7") == phone_of("bob", "Pixel 7")
    several = [("bob", "pixel 7"), (OWNER, "bob_pixel_7"), ("bob pixel", "7"), ("李", "alice"), (OWNER, "alice")]
    several += [(OWNER, "+#/"), (OWNER, "李"), ("+", "#")]
    assert len({phone_of(*each) for each in several}) == len(several)
    assert all(re.fullmatch("[a-z0-9_]+", phone_of(*each)) for each in several)
    with pytest.raises(InputError, match="--home-assistant"):
        broker_of("http://home", option="--home-assistant")


@contextlib.asynccontextmanager
async def home_assistant(port):
    """What Home Assistant has: the last message of each topic."""
    topics = {}

    async def listen():
        while True:
            with contextlib.suppress(aiomqtt.MqttError):  # the broker begins
                async with aiomqtt.Client("127.0.0.1", port) as client:
                    await client.subscribe("#")
                    async for message in client.messages:
                        topics[str(message.topic)] = bytes(message.payload)
            await asyncio.sleep(0.05)

    task = asyncio.create_task(listen())
    try:
        yield topics
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


def decoded(topics, phone="pixel_7"):
    """Discovery message and state of a phone."""
    config = topics[f"homeassistant/device/{PREFIX}_{phone}/config"]
    return json.loads(config), json.loads(topics[f"{PREFIX}/{phone}/state"])


@pytest.mark.anyio
@pytest.mark.timeout(60)
async def test_a_phone_is_announced_moves_ends_and_is_forgotten(port):
    hub = Hub()
    async with home_assistant(port) as topics:
        work = asyncio.create_task(announce(broker_of(f"mqtt://127.0.0.1:{port}"), hub, HOME, {"pixel_7"}.copy, print))
        await soon(lambda: topics.get(STATUS) == b"online")
        hub.pose(OWNER, pose(2.0, 2.0))
        await soon(lambda: f"{PREFIX}/pixel_7/status" in topics)
        discovery, state = decoded(topics)
        assert (state["room"], state["rooms"]["Kitchen"] > 0.9) == ("Kitchen", True)
        components = discovery["components"]
        assert {each["platform"] for each in components.values()} == {"sensor"}, "no latitude, no tracker"
        assert len({each["unique_id"] for each in components.values()}) == len(components)
        assert all(each["value_template"] == f"{{{{ value_json.{key} }}}}" for key, each in components.items())
        assert set(components) <= set(state)
        assert {each["topic"] for each in discovery["availability"]} <= topics.keys()
        hub.pose(OWNER, pose(6.5, 2.0, 0.5, lon=11.5, lat=48.1, id="next walk", time=1.7e9 + 60))
        await soon(lambda: f"{PREFIX}/pixel_7/position" in topics and decoded(topics)[1]["room"] == "Bath")
        tracker = decoded(topics)[0]["components"]["position"]
        assert tracker["platform"] == "device_tracker"
        position = json.loads(topics[tracker["json_attributes_topic"]])
        assert position == {"latitude": 48.1, "longitude": 11.5, "gps_accuracy": 0.8}
        hub.pose(OWNER, pose(2.0, 2.0, id="walk", time=1.7e9 + 1))  # the walk before, read late
        hub.pose(OWNER, pose(6.5, 2.0, 0.5, lon=11.5, lat=48.1, id="next walk", time=1.7e9 + 61, state="finished"))
        await soon(lambda: topics[f"{PREFIX}/pixel_7/status"] == b"offline")
        assert decoded(topics)[1]["room"] == "Bath"
        hub.forget("next walk")
        await soon(lambda: topics[f"homeassistant/device/{PREFIX}_pixel_7/config"] == b"")
        hub.close()
        await soon(lambda: topics[STATUS] == b"offline")
        await work


@pytest.mark.anyio
@pytest.mark.timeout(60)
async def test_a_server_announces_the_phones_that_post_to_it(tmp_path, port):
    sources = Sources(home=broker_of(f"mqtt://127.0.0.1:{port}"))
    app = build(Settings(tmp_path / "serve", workers=0, sources=sources))
    async with home_assistant(port) as topics:
        async with app.router.lifespan_context(app):
            for body in bodies(outdoors())[:6]:
                app.state.server.reception.receive(SENSOR_LOGGER, OWNER, body)
            await soon(lambda: any(topic.endswith("/position") for topic in topics))
            phone = next(topic.split("/")[1] for topic in topics if topic.endswith("/position"))
            discovery, state = decoded(topics, phone)
            assert "position" in discovery["components"]
            assert state["room"] is None, "there is no plan"
            assert 0 < state["accuracy"] < 20
        await soon(lambda: topics[STATUS] == b"offline")


@pytest.mark.anyio
@pytest.mark.timeout(60)
async def test_a_phone_that_was_deleted_while_the_broker_was_away_is_removed(port, monkeypatch):
    monkeypatch.setattr(module, "RETAINED_TIME", 0.5)
    address, here, gone = broker_of(f"mqtt://127.0.0.1:{port}"), f"{PREFIX}/here/status", f"{PREFIX}/gone/status"
    async with home_assistant(port) as topics:
        async with aiomqtt.Client("127.0.0.1", port) as client:
            for topic in (here, gone, f"{PREFIX}/gone/position", f"homeassistant/device/{PREFIX}_gone/config"):
                await client.publish(topic, b"online", retain=True)
        hub = Hub()
        work = asyncio.create_task(announce(address, hub, HOME, {"here"}.copy, print))
        await soon(lambda: topics.get(gone) == b"")
        await soon(lambda: topics[f"homeassistant/device/{PREFIX}_gone/config"] == b"")
        await soon(lambda: topics[f"{PREFIX}/gone/position"] == b"")
        hub.close()
        await work
        assert topics[here] == b"online"


@pytest.mark.anyio
async def test_a_server_ends_at_the_moment_of_news():
    """Cancelled when the wait has its answer but has not gone on, which `asyncio.wait_for` of Python 3.11 swallows."""
    for steps in range(5):
        hub = Hub()
        subscriber = hub.subscribe(OWNER, connection=False)

        async def listen(subscriber=subscriber):
            while await subscriber.wait(60.0):
                list(subscriber.events())

        task = asyncio.create_task(listen())
        await asyncio.sleep(0.01)
        hub.pose(OWNER, pose(2.0, 2.0))
        for _ in range(steps):
            await asyncio.sleep(0)
        task.cancel()
        done, _ = await asyncio.wait([task], timeout=5.0)
        assert done, f"cancelled {steps} turns of the loop after the news"


def test_many_pages_of_the_owner_do_not_end_the_announcements():
    """Beyond a hundred connections the oldest ends, which the server's own, older than all, must not be."""
    hub = Hub()
    own = hub.subscribe(OWNER, connection=False)
    pages = [hub.subscribe(OWNER) for _ in range(MOST_SUBSCRIBERS + 5)]
    assert [page.ended for page in pages] == [True] * 5 + [False] * MOST_SUBSCRIBERS
    assert not own.ended
    hub.close()
    assert own.ended


@contextlib.contextmanager
def hook(status=204, location=""):
    """A server that keeps what is posted to it."""
    posted = []

    class Handler(QuietHandler):
        def do_POST(self):
            posted.append((self.path, json.loads(self.rfile.read(int(self.headers["Content-Length"])))))
            self.send_response(status)
            if location:
                self.send_header("Location", location)
            self.end_headers()

    with served(Handler) as server:
        yield f"http://127.0.0.1:{server.server_port}", posted


async def alerted(alerts, poses, said, done):
    """Publish poses one after the other to alerts, until something is done."""
    hub = Hub()
    work = asyncio.create_task(alert(alerts, hub, HOME, said.append))
    for each in poses:
        hub.pose(OWNER, each)
        await asyncio.sleep(0.01)
    await soon(done)
    hub.close()
    await work


@pytest.mark.anyio
@pytest.mark.timeout(60)
async def test_an_address_is_asked_once_when_a_phone_enters_its_room():
    """A stray pose in the room is no entry, nor is where the walk begins; going out and in again is one more."""
    inside, outside = (6.5, 2.0, 0.3), (2.0, 2.0, 0.3)
    places = [outside, inside, outside, *[inside] * 4, outside, *[inside] * 3, (900.0, 2.0, 0.3), *[inside] * 3]
    poses = [pose(*place, time=1.7e9 + n) for n, place in enumerate(places)]
    begins = [pose(*inside, time=1.7e9 + n, id="another", name="begins there") for n in range(5)]
    with hook() as (address, posted):
        bath = Alert.of(f"Bath={address}/bath", HOME)
        said = []
        await alerted([bath], [*poses, *begins], said, lambda: len(posted) >= 3)
    assert said == []
    assert {path for path, _ in posted} == {"/bath"}
    assert [about["time"] - 1.7e9 for _, about in posted] == [5.0, 10.0, 14.0]
    assert {(about["event"], about["room"], about["phone"]) for _, about in posted} == {("enter", "Bath", "Pixel 7")}


@pytest.mark.anyio
@pytest.mark.timeout(60)
async def test_no_host_is_asked_that_the_operator_did_not_name(monkeypatch):
    monkeypatch.setattr(module, "RETRY_PAUSE", 0.0)
    entering = [pose(*((2.0, 2.0) if n == 0 else (6.5, 2.0)), 0.3, time=1.7e9 + n) for n in range(5)]
    with hook() as (elsewhere, there), hook(307, f"{elsewhere}/") as (address, posted):
        secret = Alert.of(f"Bath={address}/?token=secret", HOME)
        said = []
        await alerted([secret], entering, said, lambda: said)
    assert (there, len(posted)) == ([], 2)
    assert said == ["--alert Bath: 127.0.0.1: status 307"]


@pytest.mark.parametrize("text", ["Attic=http://host/", "Bath", "Bath=ftp://host/", "Bath=http://", "Bath=http://[x/"])
def test_a_wrong_alert_is_one_line(text):
    with pytest.raises(InputError, match="--alert"):
        Alert.of(text, HOME)
    with pytest.raises(InputError, match="--map"):
        Alert.of("Bath=http://host/", None)
