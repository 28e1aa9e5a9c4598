"""Receivers in rooms that hear the phone, by ESPresense's messages and bermuda's states, through Mosquitto."""

import asyncio
import contextlib
import json
import time
from dataclasses import replace
from functools import cache, partial
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from streamed_walks import bodies, local_server, outdoors, soon

from pdr_graph.apps.serve import reception
from pdr_graph.apps.serve.access import OWNER
from pdr_graph.apps.serve.live_walk import LOG, write_recording
from pdr_graph.apps.serve.pulling import Sources, broker_of
from pdr_graph.apps.serve.receivers import heard, receivers_of, take
from pdr_graph.apps.serve.sensor_messages import SENSOR_LOGGER
from pdr_graph.apps.serve.serving import Settings, build, read_inputs
from pdr_graph.errors import InputError
from pdr_graph.io.loading import load
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.online.journal import read_entries
from pdr_graph.options import Options

aiomqtt = pytest.importorskip("aiomqtt")
MALL = Path(__file__).resolve().parents[2] / "maps" / "mall.geojson"
PHONE, DEVICE, TOPIC = "phone_simulate", "phone:alice", "espresense/devices/phone:alice"
# As version 4 writes them, and version 2
NEW = {"mac": "6f1e", "id": DEVICE, "rssi@1m": -71, "rssi": -64.5, "rxAdj": 0, "distance": 0.65, "var": 0.1, "int": 266}
OLD = {"id": DEVICE, "name": "Alice", "rssi@1m": -59, "rssi": -70, "raw": 2.37, "distance": 2.1, "speed": 0}


def espresense(content):
    return heard(f"{TOPIC}/kitchen", json.dumps(content).encode())


def state(entity, value):
    return heard(f"homeassistant/sensor/{entity}/state", value.encode())


def test_levels_of_both_sources():
    assert espresense(NEW) == (DEVICE, "kitchen", -64.5)
    assert espresense(OLD) == (DEVICE, "kitchen", -70.0)
    assert state("alice_unfiltered_distance_to_kitchen", "10.0") == ("alice", "kitchen", -85.0)


@pytest.mark.parametrize("rssi", [0, 127, -200, None, "?", [], True])
def test_what_is_no_level_is_left_out(rssi):
    assert espresense(NEW | {"rssi": rssi}) is None


def test_what_is_no_reception_is_left_out():
    assert espresense({"id": DEVICE, "distance": 0}) is None
    assert heard(f"{TOPIC}/kitchen/battery", b'{"battery": 50}') is None
    assert heard("espresense/rooms/kitchen/status", b"online") is None
    for value in ("0", "-1", "unavailable", "nan", "1e99", "", "\xff", "[" * 5000):
        assert state("alice_unfiltered_distance_to_kitchen", value) is None
    assert state("alice_distance_to_kitchen", "2.0") is None, "smoothed, and the same reception"
    assert state("alice_area", "2.0") is None


@pytest.mark.parametrize(
    ("pairs", "places", "text"),
    [
        (["pixel_7"], ["a"], "PHONE=DEVICE"),
        (["Pixel 7=x"], ["a"], "pdr_graph/PHONE/state"),
        (["pixel_7=a/+"], ["a"], "espresense/devices/DEVICE"),
        (["a=x", "b=x"], ["a"], "a and b, expected a device of one phone"),
        (["a=x"], [], "no places of receivers"),
    ],
)
def test_options_are_refused_with_what_is_missing(pairs, places, text):
    with pytest.raises(InputError, match="--heard-as") as refused:
        receivers_of(broker_of("mqtt://h"), pairs, places)
    assert text in str(refused.value)


def test_receivers_need_a_broker():
    with pytest.raises(InputError, match="--home-assistant"):
        receivers_of(None, ["a=x"], ["a"])


@cache
def mall():
    """The messages of 30 s of a walk without a fix, what the receivers say after each, and where it then is [m]."""
    walk = simulate(replace(Scenario.load("mall"), seed=12))
    heard_by, (plan, beacons) = walk.bluetooth, read_inputs(Options(plan=MALL))
    names, second = np.array(heard_by.transmitter), heard_by.time.astype(int)
    at = [{name: (second == n) & (names == name) for name in beacons.name} for n in range(30)]
    levels = [{name: np.median(heard_by.rssi[rows]) for name, rows in each.items() if rows.any()} for each in at]
    there = np.array([np.interp(30.0, walk.truth.time, axis) for axis in walk.truth.position.T])
    return bodies(walk.recording())[:30], levels, there, plan, beacons


@contextlib.asynccontextmanager
async def walked(folder, port, monkeypatch, late):
    """A server and its walker at the end of the walk in the mall. late: of the phone's clock [s]."""
    messages, levels, _, plan, beacons = mall()
    now, ticks, published = sample_time(messages[0]), count(), 0
    clock = SimpleNamespace(time=lambda: now + 1e-5 * next(ticks), monotonic=time.monotonic)
    monkeypatch.setattr(reception, "time", clock)
    receivers = receivers_of(broker_of(f"mqtt://127.0.0.1:{port}"), [f"{PHONE}={DEVICE}"], beacons.name)
    app = build(Settings(folder, Options(plan=MALL), workers=0, sources=Sources(receivers=receivers)), plan)
    async with aiomqtt.Client("127.0.0.1", port) as nodes, app.router.lifespan_context(app):
        while not receivers.unplaced:  # nobody listens yet
            await nodes.publish(f"{TOPIC}/garage", json.dumps(NEW))
            await asyncio.sleep(0.05)
        for body, heard_now in zip(messages, levels, strict=True):
            now = sample_time(body) + late + 1.3  # a second of samples, and their way
            app.state.server.reception.receive(SENSOR_LOGGER, OWNER, body)
            for name, level in heard_now.items():
                await nodes.publish(f"{TOPIC}/{name}", json.dumps(NEW | {"rssi": level}))
            published += len(heard_now)
            await soon(partial(all_logged, app.state.server.reception, published))
        [walker] = app.state.server.hub.walkers.values()
        await soon(lambda: walker.pose["message"] >= len(messages) + published)
        yield app.state.server, walker


def logged(server, session="walk-one"):
    """Number of levels in the log of a walk."""
    return sum(entry.identity < 0 for entry in read_entries(server.root / session / LOG))


def all_logged(server, published):
    return logged(server) >= published


def sample_time(body):
    """Unix time of the first sample of a message [s]."""
    return json.loads(body)["payload"][0]["time"] * 1e-9


@pytest.mark.thorough
@pytest.mark.anyio
@pytest.mark.timeout(120)
@pytest.mark.parametrize("late", [0.0, 7200.0])
async def test_receivers_place_a_phone_that_nothing_else_does(tmp_path, port, monkeypatch, late):
    """Whatever the phone's clock says; a level that the broker kept from yesterday has no say."""
    _, levels, there, _, beacons = mall()
    async with aiomqtt.Client("127.0.0.1", port) as nodes:
        await nodes.publish(f"{TOPIC}/{beacons.name[7]}", json.dumps(NEW | {"rssi": -30}), retain=True)
    async with walked(tmp_path, port, monkeypatch, late) as (_, walker):
        assert walker.pose["message"] == 30 + sum(map(len, levels))
        assert np.hypot(*(there - (walker.pose["x"], walker.pose["y"]))) < 5.0


@pytest.mark.anyio
@pytest.mark.timeout(60)
async def test_states_of_bermuda_are_levels_of_the_walk(tmp_path, port):
    """As Home Assistant's statestream publishes them: retained, of all its sensors."""
    entity = "homeassistant/sensor/alice_unfiltered_distance_to_{}/state".format
    receivers = receivers_of(broker_of(f"mqtt://127.0.0.1:{port}"), [f"{PHONE}=alice"], ["Kitchen"])
    app = build(Settings(tmp_path, workers=0, sources=Sources(receivers=receivers)))
    async with aiomqtt.Client("127.0.0.1", port) as home:
        await home.publish(entity("kitchen"), "1.0", qos=1, retain=True)
    async with aiomqtt.Client("127.0.0.1", port) as home, app.router.lifespan_context(app):
        server = app.state.server.reception
        server.receive(SENSOR_LOGGER, OWNER, bodies(outdoors())[0])
        while not receivers.unplaced:  # nobody listens yet
            await home.publish(entity("garage"), "3.0", retain=True)
            await asyncio.sleep(0.05)
        assert logged(server) == 0, "a state of before the connection is of any age"
        for topic, value in (("sensor/outdoor_temperature", "21.5"), ("sensor/alice_area", "Kitchen")):
            await home.publish(f"homeassistant/{topic}/state", value, retain=True)
        for value in ("10.0", "unavailable", "5.5"):
            await home.publish(entity("kitchen"), value, retain=True)
        await soon(lambda: logged(server) == 2)


@contextlib.contextmanager
def served(folder):
    """A server whose receiver of the kitchen has a place, and what it says."""
    said, receivers = [], receivers_of(broker_of("mqtt://h"), [f"{PHONE}={DEVICE}"], ["Kitchen"])
    with local_server(folder) as client:
        server = client.app.state.server.reception
        yield client, server, lambda room="kitchen": take(receivers, server, (DEVICE, room, -64.5), said.append), said


def post(client, body):
    assert client.post("/sensorlogger", content=body).status_code < 300


def test_levels_are_samples_of_the_walk_on_the_clock_of_the_phone(tmp_path):
    """The clock of the phone is years behind."""
    with served(tmp_path) as (client, server, hears, _):
        for body in bodies(outdoors()):
            post(client, body)
            hears()
        count = len(bodies(outdoors()))
        assert logged(server) == count
        with_levels = load(write_recording(server.root / "walk-one"))
    assert set(with_levels.bluetooth.transmitter) == {"kitchen"}
    assert len(with_levels.bluetooth) == count
    ends = [json.loads(body)["payload"][-1]["time"] * 1e-9 - with_levels.epoch for body in bodies(outdoors())]
    assert with_levels.bluetooth.time == pytest.approx(ends, abs=0.5), "the server is faster than the phone"
    assert len(with_levels.accelerometer) == len(outdoors().accelerometer)


def test_what_cannot_be_given_to_a_walk_is_left_out(tmp_path):
    first, second, *_ = bodies(outdoors())
    with served(tmp_path) as (client, server, hears, said):
        hears()  # nobody walks
        post(client, first)
        hears("garage"), hears("garage")
        assert (logged(server), len(said)) == (0, 1)
        assert "'garage'" in said[0]
        hears()
        assert logged(server) == 1
        client.post("/walkers/walk-one/finish").raise_for_status()
        hears()
        assert logged(server) == 1, "an end is not undone"
        post(client, second)
        hears()
        post(client, first.replace(b"walk-one", b"walk-two"))  # the same phone begins again: its newest walk
        hears()
        assert (logged(server), logged(server, "walk-two")) == (2, 1)
        other = first.replace(b"walk-one", b"walk-three").replace(b'"simulated"', b'"simulate2"')
        post(client, other)
        hears()  # two phones of one name
        assert (logged(server, "walk-two"), logged(server, "walk-three")) == (1, 0)
