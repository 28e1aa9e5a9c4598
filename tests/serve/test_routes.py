"""The routes: what is posted is published; every fault has a status code and one line."""

import gzip
import json
import time

import numpy as np
import pytest
import simulated
from starlette.testclient import TestClient

import pdr_graph
from pdr_graph.apps.serve.access import OWNER, is_foreign, load_tokens
from pdr_graph.apps.serve.application import document
from pdr_graph.apps.serve.reception import Limits
from pdr_graph.apps.serve.serving import Settings, build
from pdr_graph.errors import InputError
from pdr_graph.io.loading import load
from pdr_graph.lab.simulation.streaming import batches, message

PATIENCE = 30.0  # [s]
LOCAL = "http://127.0.0.1"
TOKENS = {OWNER: "owner-token-0123456789", "ann": "ann-token-01234567890"}
OWN, ANN = ({"Authorization": f"Bearer {TOKENS[user]}"} for user in (OWNER, "ann"))
LIMITS = Limits(body=1 << 20, samples=2000, rate=1e6, burst=3.0, sessions=12)
PLACE = {"_type": "location", "lat": 48.1, "lon": 11.5, "tst": 1_700_000_000, "acc": 10, "tid": "xy"}


@pytest.fixture(scope="module")
def client(tmp_path_factory):
    """A server with two users; estimates in a thread."""
    folder = tmp_path_factory.mktemp("serve")
    with TestClient(build(Settings(folder, workers=0, tokens=TOKENS, limits=LIMITS)), headers=OWN) as client:
        client.folder = folder
        yield client


@pytest.fixture(scope="module")
def walk():
    """Twenty seconds with a fix every four."""
    return simulated.with_receiver(simulated.walk_along(np.array([[0.0, 0.0], [16.0, 0.0]]), seed=2), every=200)


def bodies(walk, session):
    return [message(session, n, payload) for n, payload in enumerate(batches(walk))]


def post(client, body, path="/sensorlogger", **options):
    return client.post(path, content=body, **options)


def published(client, id_, until, **options):
    """The pose of a walker as soon as ``until`` holds of it."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        pose = next((pose for pose in client.get("/walkers", **options).json() if pose["id"] == id_), None)
        if pose is not None and until(pose):
            return pose
        time.sleep(0.05)
    raise AssertionError(f"{id_}: {pose}")


def one_line(answer, status):
    assert answer.status_code == status, answer.text
    assert answer.text.strip()
    assert answer.text.count("\n") <= 1
    return answer.text


@pytest.fixture(scope="module")
def walker(client, walk):
    """The pose of a walker after a whole walk."""
    messages = bodies(walk, "walk-one")
    for body in messages:
        assert post(client, body, params={"platform": "android"}).status_code == 200
    return published(client, "walk-one", lambda pose: pose["message"] == len(messages))


def test_a_pose_has_all_that_the_contract_names(walker):
    assert {"id", "name", "state", "time", "lon", "lat", "x", "y", "sigma", "heading", "floor"} <= walker.keys()
    assert walker["state"] in ("initialising heading", "running")
    assert walker["time"] == pytest.approx(1_700_000_000 + 20, abs=4)
    assert walker["lat"] == pytest.approx(48.0, abs=1e-3)
    assert walker["steps"] > 15
    assert walker["region"]["semi_major"] >= walker["region"]["semi_minor"] > 0
    assert walker["health"]["accelerometer"].endswith("Hz")


def test_the_geojson_of_a_walk_has_both_parts_and_the_pose(client, walker):
    answer = client.get("/walkers/walk-one.geojson")
    assert answer.headers["content-type"].startswith("application/geo+json")
    for _ in range(100):
        features = client.get("/walkers/walk-one.geojson").json()["features"]
        if features[1]["geometry"]:
            break
        time.sleep(0.05)
    assert [feature["properties"]["part"] for feature in features] == ["finalised", "current", "pose"]
    line = np.array(features[1]["geometry"]["coordinates"])
    assert np.allclose(line, [11.0, 48.0], atol=1e-3)
    assert len(line) == len(features[1]["properties"]["times"])


def test_the_pose_as_a_nav_sat_fix(client, walker):
    fix = client.get("/walkers/walk-one.navsatfix").json()
    assert fix["latitude"] == client.get("/walkers/walk-one").json()["lat"]
    assert fix["position_covariance"][0] == pytest.approx(walker["sigma"] ** 2, rel=0.5)
    assert fix["header"]["frame_id"] == "walk-one"


def test_a_websocket_has_the_same_events(client, walker):
    with client.websocket_connect("/socket") as socket:
        events = [socket.receive_json() for _ in range(2)]
    assert {event["event"] for event in events} <= {"pose", "path"}


def test_the_description_has_every_route(client):
    routes = {
        (method.lower(), route.path)
        for route in client.app.routes
        for method in getattr(route, "methods", None) or (["GET"] if hasattr(route, "endpoint") else [])
        if method != "HEAD"
    }
    described = client.get("/openapi.json").json()
    assert routes == {(method, path) for path, operations in described["paths"].items() for method in operations}
    assert described["openapi"].startswith("3.1")
    assert "/sensorlogger" in client.get("/api").text


@pytest.mark.parametrize("path", ["/", "/walkers", "/walkers/x", "/events", "/plan", "/openapi.json", "/web/x"])
def test_nothing_is_readable_without_a_token(client, path):
    one_line(client.get(path, headers={"Authorization": ""}), 401)
    one_line(client.get(path, headers={"Authorization": "Bearer wrong"}), 401)


@pytest.mark.parametrize("path", ["/sensorlogger", "/owntracks", "/overland", "/osmand", "/walkers/walk-one/finish"])
def test_nothing_is_writable_without_a_token(client, path):
    assert "token" in one_line(post(client, b"{}", path, headers={"Authorization": "Basic eDp5"}), 401)


@pytest.mark.parametrize("how", ["query", "bearer", "basic", "cookie"])
def test_a_token_is_taken_in_four_ways(client, how):
    token, options = TOKENS["ann"], {"headers": {"Authorization": ""}}
    if how == "query":
        options["params"] = {"token": token}
    elif how == "cookie":
        options["headers"]["Cookie"] = f"pdr_graph_token={token}"
    elif how == "bearer":
        options["headers"]["Authorization"] = f"Bearer {token}"
    else:
        options = {"headers": {}, "auth": ("anyone", token)}
    assert client.get("/walkers", **options).status_code == 200


def test_a_user_sees_and_changes_only_the_own_walkers(client, walker, walk):
    assert client.get("/walkers", headers=ANN).json() == []
    for path in ("/walkers/walk-one", "/walkers/walk-one.geojson", "/walkers/walk-one/recording"):
        one_line(client.get(path, headers=ANN), 404)
    one_line(client.delete("/walkers/walk-one", headers=ANN), 404)
    one_line(post(client, b"", "/walkers/walk-one/finish", headers=ANN), 404)


def test_the_session_of_another_user_is_refused(client, walker, walk):
    number = walker["message"]
    assert "another user" in one_line(post(client, bodies(walk, "walk-one")[0], headers=ANN), 403)
    assert client.get("/walkers/walk-one").json()["message"] == number


def test_pages_of_other_sites_are_refused(client, walk):
    body = bodies(walk, "foreign")[0]
    one_line(post(client, body, headers={"Origin": "https://example.org"}), 403)
    assert post(client, body, headers={"Origin": "http://testserver"}).status_code in (200, 499)
    assert is_foreign({"sec-fetch-site": "cross-site", "sec-fetch-mode": "no-cors", "host": "x"})
    client.delete("/walkers/foreign")


@pytest.mark.parametrize(
    "body", [b"", b"{", b'{"messageId":1,"sessionId":"bad","payload":[{"na', b"[1]", b"\xff", b"[" * 50_000, b"null"]
)
@pytest.mark.parametrize("path", ["/sensorlogger", "/owntracks", "/overland", "/osmand"])
def test_a_malformed_message_is_refused(client, path, body):
    one_line(post(client, body, path), 400)
    assert client.get("/walkers/bad").status_code == 404


def test_a_body_that_is_too_large_is_refused(client):
    one_line(post(client, b" " * (LIMITS.body + 1)), 413)

    def endless():
        for _ in range(1000):
            yield b" " * 10_000

    one_line(post(client, endless()), 413)


def test_a_bomb_is_refused(client):
    bomb = gzip.compress(b" " * (50 << 20))
    assert len(bomb) < LIMITS.body
    one_line(post(client, bomb, headers={"Content-Encoding": "gzip"}), 413)
    one_line(post(client, b"no gzip", headers={"Content-Encoding": "gzip"}), 400)
    one_line(post(client, b"x", headers={"Content-Encoding": "br"}), 415)


def test_a_compressed_message_is_taken(client, walk):
    body = gzip.compress(bodies(walk, "compressed")[0])
    assert post(client, body, headers={"Content-Encoding": "gzip"}).status_code == 200
    client.delete("/walkers/compressed")


def test_too_many_samples_are_refused(client):
    payload = [{"name": "x", "time": 1}] * (LIMITS.samples + 1)
    assert "samples" in one_line(post(client, message("many", 1, payload)), 413)


def test_a_flood_is_refused_and_told_when_to_come_again(client):
    sample = {"name": "gyroscope", "time": 10**18, "values": {"x": 0.0, "y": 0.0, "z": 0.0}, "pad": "x" * 900_000}
    answers = [post(client, message("flood", n, [sample])) for n in range(8)]
    refused = [answer for answer in answers if answer.status_code == 429]
    assert refused
    assert int(refused[0].headers["Retry-After"]) >= 1
    client.delete("/walkers/flood")


def test_too_many_sessions_of_a_user_are_refused(client, walk):
    body = bodies(walk, "SESSION")[0]
    answers = [post(client, body.replace(b"SESSION", b"many%04d" % n), headers=ANN) for n in range(LIMITS.sessions + 1)]
    assert [answer.status_code for answer in answers[:-1]] == [200] * LIMITS.sessions
    assert "sessions" in one_line(answers[-1], 429)
    assert post(client, bodies(walk, "walk-one")[-1]).status_code == 200  # the others are unharmed
    for n in range(LIMITS.sessions):
        assert client.delete(f"/walkers/many{n:04d}", headers=ANN).status_code == 204


def test_a_session_of_any_name_stays_in_its_folder(client, walk):
    for name in ("../../evil", "a/b", "", "x" * 10_000, "ünï", "con", "."):
        answer = post(client, json.dumps({"messageId": 0, "sessionId": name, "payload": []}).encode())
        assert answer.status_code == (400 if name == "" else 200)
    inside = [path.name for path in (client.folder / "sessions").iterdir()]
    assert all(name.replace("-", "").replace("_", "").isalnum() for name in inside)
    assert sorted(path.name for path in client.folder.iterdir()) == ["sessions"]
    for pose in client.get("/walkers").json():
        if pose["id"] != "walk-one":
            client.delete(f"/walkers/{pose['id']}")


def test_what_is_degraded_is_shown_to_the_user_of_the_phone_once(client):
    values = {"x": 0.1, "y": 0.0, "z": 0.0}
    samples = [{"name": "accelerometer", "time": 10**18 + n * 10**7, "values": values} for n in range(300)]
    answers = []
    for n in range(60):
        answers.append(post(client, message("poor", n, samples if n == 0 else [])))
        if answers[-1].status_code == 499:
            break
        time.sleep(0.1)
    assert "switch on Gravity" in answers[-1].text
    assert post(client, message("poor", 100, [])).status_code == 200
    assert client.delete("/walkers/poor").status_code == 204


def test_each_app_gets_the_answer_that_it_expects(client):
    assert post(client, json.dumps(PLACE).encode(), "/owntracks", headers={"X-Limit-D": "pixel"}).json() == []
    assert post(client, b'{"_type":"lwt","tst":1}', "/owntracks").json() == []
    point = {"type": "Point", "coordinates": [11.5, 48.1]}
    properties = {"timestamp": "2024-05-01T09:30:00Z", "horizontal_accuracy": 5, "device_id": "iphone"}
    place = {"locations": [{"type": "Feature", "geometry": point, "properties": properties}]}
    assert post(client, json.dumps(place).encode(), "/overland").text == '{"result":"ok"}'
    query = {"id": "7", "lat": "48.1", "lon": "11.5", "timestamp": "1714555800", "accuracy": "5"}
    assert client.get("/osmand", params=query).status_code == 200
    assert post(client, "&".join(f"{k}={v}" for k, v in query.items()).encode(), "/osmand").status_code == 200
    names = {pose["name"]: pose["id"] for pose in client.get("/walkers").json()}
    assert {"xy", "iphone", "7"} <= names.keys()
    pose = published(client, names["xy"], lambda pose: pose["state"] == "fixes alone")
    assert (pose["lat"], pose["lon"]) == pytest.approx((48.1, 11.5))
    assert post(client, b"", f"/walkers/{names['xy']}/finish").status_code == 202
    published(client, names["xy"], lambda pose: pose["state"] == "finished")
    for _ in range(100):
        answer = client.get(f"/walkers/{names['xy']}/recording")
        if answer.status_code == 200:
            break
        time.sleep(0.1)
    assert b"<trkpt" in answer.content
    for name in ("xy", "iphone", "7"):
        client.delete(f"/walkers/{names[name]}")


def test_a_deleted_walk_leaves_no_file(client, walk):
    post(client, bodies(walk, "secret")[0])
    assert (client.folder / "sessions" / "secret").exists()
    assert client.delete("/walkers/secret").status_code == 204
    end = time.monotonic() + PATIENCE
    while (client.folder / "sessions" / "secret").exists():  # the estimating process may be writing
        assert time.monotonic() < end
        time.sleep(0.05)
    one_line(client.get("/walkers/secret"), 404)


def test_files_are_their_owners_alone(client, walker):
    for path in (client.folder / "sessions").rglob("*"):
        assert path.stat().st_mode & 0o077 == 0, path


def test_a_finished_walk_is_a_recording_that_smooth_opens(tmp_path, walk):
    """All samples, as they were sent; after a restart it is still there, and a late message resumes it."""
    messages, settings = bodies(walk, "walk-two"), Settings(tmp_path, workers=0)
    with TestClient(build(settings), base_url=LOCAL) as client:
        for body in messages:
            post(client, body)
        published(client, "walk-two", lambda pose: pose["message"] == len(messages))
        one_line(client.get("/walkers/walk-two/recording"), 409)
        post(client, b"", "/walkers/walk-two/finish")
        published(client, "walk-two", lambda pose: pose["state"] == "finished")
        end = time.monotonic() + PATIENCE
        while (answer := client.get("/walkers/walk-two/recording")).status_code != 200:
            assert time.monotonic() < end
            time.sleep(0.1)
    (tmp_path / "walk.zip").write_bytes(answer.content)
    loaded = load(tmp_path / "walk.zip")
    for sensor, signal in loaded.signals.items():
        assert np.allclose(signal.values, walk.signals[sensor].values, rtol=0, atol=1e-12)
        assert np.allclose(signal.time, walk.signals[sensor].time, rtol=0, atol=1e-6)
    assert len(loaded.fixes) == len(walk.fixes)
    with TestClient(build(settings), base_url=LOCAL) as client:
        pose = published(client, "walk-two", lambda pose: pose["state"] == "finished")
        features = client.get("/walkers/walk-two.geojson").json()["features"]
        assert len(features[0]["geometry"]["coordinates"]) > 15
        post(client, message("walk-two", len(messages), []))
        again = published(client, "walk-two", lambda pose: pose["message"] == len(messages) + 1)
        assert again["steps"] == pose["steps"]


def test_tokens_are_created_once_in_a_file_of_their_owner(tmp_path):
    file = tmp_path / "tokens.json"
    tokens = load_tokens(file, ["ann"], None)
    assert load_tokens(file, [], None) == tokens
    assert min(map(len, tokens.values())) >= 32
    assert file.stat().st_mode & 0o777 == 0o600
    assert load_tokens(file, [], "a-token-of-my-own-choice")[OWNER] == "a-token-of-my-own-choice"
    for short in ("", "short"):
        with pytest.raises(InputError):
            load_tokens(file, [], short)
    file.chmod(0o644)
    with pytest.raises(InputError, match="others can read it"):
        load_tokens(file, [], None)


def test_the_version_is_in_the_description():
    assert document()["info"]["version"] == pdr_graph.__version__


@pytest.mark.parametrize(
    ("host", "headers"),
    [("walks.example.org", {}), ("", {}), ("127.0.0.1:8080", {"X-Forwarded-For": "192.0.2.7"}), ("[", {})],
)
def test_without_tokens_a_proxy_and_other_names_are_refused(tmp_path, host, headers):
    """Behind a proxy all users would be the owner; a name of another site may point to this machine."""
    with TestClient(build(Settings(tmp_path, workers=0)), base_url=LOCAL) as client:
        assert client.get("/walkers").status_code == 200
        assert client.get("/walkers", headers={"Host": "localhost:8080"}).status_code == 200
        refused = client.get("/walkers", headers={"Host": host} | headers)
        assert (refused.status_code, "--token" in refused.text) == (403, True)


@pytest.mark.parametrize(
    "body",
    [
        {"payload": [{"name": "test"}], "deviceId": "ad7e4997"},
        {"messageId": 0, "sessionId": "test", "deviceId": "a", "payload": [{"name": "test", "time": 1, "values": {}}]},
    ],
)
def test_the_apps_test_of_the_address_is_answered_and_makes_no_walker(tmp_path, body):
    """As sk-sensorlogger-plugin, another receiver of the app, recognises it."""
    with TestClient(build(Settings(tmp_path, workers=0)), base_url=LOCAL) as client:
        assert client.post("/sensorlogger", json=body).status_code == 200
        assert client.get("/walkers").json() == []
