"""What the server fetches by itself: from a stand-in phone with phyphox, a broker, and a study."""

import asyncio
import json
import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest
import simulated
from mqtt_broker import Broker, running
from phyphox_phone import Phone, serving
from starlette.testclient import TestClient

from pdr_graph.apps.serve.pulling import TOPIC, Sources, broker_of
from pdr_graph.apps.serve.serving import Settings, build
from pdr_graph.apps.serve.study import StudyReports
from pdr_graph.frames import enu
from pdr_graph.io.loading import load

pytestmark = pytest.mark.timeout(60)
PATIENCE = 30.0  # [s]
LOCAL = "http://127.0.0.1"
UNIX = 1_700_000_000.0
FRAME = enu(49.45, 11.08)


@pytest.fixture(scope="module")
def walk():
    return simulated.walk_along(np.array([[0.0, 0.0], [14.0, 0.0]]), seed=3)


def until(condition):
    """Wait for a condition that is not false, and return it."""
    end = time.monotonic() + PATIENCE
    while not (found := condition()):
        assert time.monotonic() < end
        time.sleep(0.05)
    return found


def record(phone, walk, begin, end):
    """The app records some seconds of a walk."""
    for row in np.flatnonzero((walk.time >= begin) & (walk.time < end)):
        at = round(float(walk.time[row]), 6)
        phone.record("accelerometer", at, *walk.acceleration[row].tolist())
        phone.record("gyroscope", at, *walk.angular_rate[row].tolist())
        if row % 250 == 0:
            lon, lat = FRAME.to_lonlat(walk.position[row : row + 1])[0].tolist()
            phone.record("location", at, lat, lon, 300.0, 3.0)


def walker_of(client, messages):
    """The only walker when so many messages were used; None before."""
    walkers = client.get("/walkers").json()
    return walkers[0] if walkers and walkers[0]["message"] >= messages else None


def test_a_phone_with_phyphox_is_a_walker_and_goes_on_after_a_restart(tmp_path, walk):
    phone = Phone()
    phone.start(0.0, UNIX)
    record(phone, walk, 0, 8)
    with serving(phone) as url:
        settings = Settings(tmp_path, workers=0, sources=Sources(phyphox=(url,)))
        with TestClient(build(settings), base_url=LOCAL) as client:
            first = until(lambda: walker_of(client, 1))
            assert first["name"] == "Fairphone 5"
            assert first["lat"] == pytest.approx(49.45, abs=1e-3)
            assert {"accelerometer", "gyroscope"} <= set(first["health"])
        record(phone, walk, 8, float(walk.time[-1]))
        with TestClient(build(settings), base_url=LOCAL) as client:
            again = until(lambda: walker_of(client, 2))
            assert again["id"] == first["id"]
            client.post(f"/walkers/{first['id']}/finish").raise_for_status()
            until(lambda: walker_of(client, 2)["state"] == "finished")
            answer = until(lambda: client.get(f"/walkers/{first['id']}/recording").content[:2] == b"PK")
            assert answer
            (tmp_path / "walk.zip").write_bytes(client.get(f"/walkers/{first['id']}/recording").content)
    recording = load(tmp_path / "walk.zip")
    np.testing.assert_allclose(recording.accelerometer.time, walk.time[:-1], atol=1e-4)
    np.testing.assert_allclose(recording.accelerometer.values, walk.acceleration[:-1], atol=1e-5)


@contextmanager
def brokering():
    """A broker on a thread of its own; yields its port and a function that publishes as the app does."""
    import aiomqtt

    loop, ready, ports, broker = asyncio.new_event_loop(), threading.Event(), [], Broker()
    stop = asyncio.Event()

    async def serve():
        async with running(broker) as port:
            ports.append(port)
            ready.set()
            await stop.wait()

    async def publish(body):
        async with asyncio.timeout(PATIENCE), aiomqtt.Client("127.0.0.1", ports[0]) as phone:
            await phone.publish(TOPIC, body)

    thread = threading.Thread(target=loop.run_until_complete, args=(serve(),), daemon=True)
    thread.start()
    assert ready.wait(PATIENCE)
    try:
        until_subscribed = lambda: until(lambda: broker.subscribers.get(TOPIC))  # noqa: E731
        yield (
            ports[0],
            until_subscribed,
            lambda body: asyncio.run_coroutine_threadsafe(publish(body), loop).result(PATIENCE),
        )
    finally:
        loop.call_soon_threadsafe(stop.set)
        thread.join(PATIENCE)
        loop.close()


def test_messages_of_a_broker_are_walkers_and_others_are_ignored(tmp_path, walk):
    pytest.importorskip("aiomqtt")
    payload = [
        {
            "name": "accelerometeruncalibrated",
            "time": round(1e9 * (UNIX + at)),
            "values": dict(zip("xyz", xyz, strict=True)),
        }
        for at, xyz in zip(walk.time[:100].tolist(), walk.acceleration[:100].tolist(), strict=True)
    ]
    message = {"messageId": 0, "sessionId": "by-mqtt", "deviceId": "one", "payload": payload}
    with brokering() as (port, until_subscribed, publish):
        sources = Sources(broker=broker_of(f"mqtt://127.0.0.1:{port}"))
        with TestClient(build(Settings(tmp_path, workers=0, sources=sources)), base_url=LOCAL) as client:
            until_subscribed()
            publish(b"no JSON")
            publish(json.dumps(message).encode())
            assert until(lambda: walker_of(client, 1))["id"] == "by-mqtt"


def test_a_study_is_off_unless_it_is_configured(tmp_path):
    call = {"studyId": "s", "uploadId": "u", "secretCode": "c"}
    with TestClient(build(Settings(tmp_path, workers=0)), base_url=LOCAL) as client:
        assert client.post("/study", json=call).status_code == 404


def test_a_call_of_a_study_is_stored_and_others_are_refused(tmp_path):
    reports = StudyReports(
        tmp_path / "study", ["mine"], say=lambda text: None, api="http://127.0.0.1:9/api", pause=60.0
    )
    with TestClient(build(Settings(tmp_path, workers=0, sources=Sources(study=reports))), base_url=LOCAL) as client:
        call = {"studyId": "mine", "uploadId": "u", "secretCode": "c"}
        assert client.post("/study", json=call).status_code == 200
        assert client.post("/study", json=call | {"studyId": "other"}).status_code == 400
        assert client.post("/study", content=b"x").status_code == 400
    assert len(list((tmp_path / "study").glob("*.json"))) == 1, "the cloud could not be reached: it is tried again"


def test_a_phone_that_is_not_there_keeps_nothing_from_starting(tmp_path):
    settings = Settings(tmp_path, workers=0, sources=Sources(phyphox=("http://127.0.0.1:9",)))
    with TestClient(build(settings), base_url=LOCAL) as client:
        assert client.get("/walkers").json() == []
