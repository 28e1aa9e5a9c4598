"""The routes: what is posted is published; every fault has a status code and one line."""

import base64
import errno
import gzip
import hashlib
import json
import re
import time
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from starlette.testclient import TestClient
from streamed_walks import bodies, finished_recording, local_server, outdoors, until, used

import pdr_graph
from pdr_graph.apps.serve import application, reception
from pdr_graph.apps.serve.access import OWNER, is_foreign, load_tokens
from pdr_graph.apps.serve.live_walk import read_session, write_session
from pdr_graph.apps.serve.reception import Limits
from pdr_graph.apps.serve.serving import Recorder, Settings, build
from pdr_graph.errors import InputError
from pdr_graph.io.loading import load
from pdr_graph.lab.simulation.streaming import message
from pdr_graph.types import Signal

WALK = bodies(outdoors())
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


@pytest.fixture
def guarded(tmp_path):
    """A server as `client`, of one test."""
    with TestClient(build(Settings(tmp_path, workers=0, tokens=TOKENS, limits=LIMITS)), headers=OWN) as client:
        yield client


@pytest.fixture
def local(tmp_path):
    """A server without tokens."""
    with local_server(tmp_path) as client:
        yield client


def first_message(session):
    return WALK[0].replace(b"walk-one", session.encode())


def post(client, body, path="/sensorlogger", **options):
    return client.post(path, content=body, **options)


def one_line(answer, status):
    assert answer.status_code == status, answer.text
    assert answer.text.strip()
    assert answer.text.count("\n") <= 1
    return answer.text


@pytest.fixture(scope="module")
def walker(client):
    """The pose of a walker after a whole walk."""
    for body in WALK:
        assert post(client, body, params={"platform": "android"}).status_code == 200
    return until(lambda: used(client, len(WALK), "walk-one"))


def test_a_pose_has_all_that_the_contract_names(walker):
    assert {"id", "name", "state", "time", "lon", "lat", "x", "y", "sigma", "heading", "floor"} <= walker.keys()
    assert walker["state"] in ("initialising heading", "running")
    assert walker["time"] == pytest.approx(1_700_000_000 + 20, abs=4)
    assert walker["lat"] == pytest.approx(48.0, abs=1e-3)
    assert walker["steps"] > 15
    assert walker["region"]["semi_major"] >= walker["region"]["semi_minor"] > 0
    assert walker["health"]["accelerometer"].endswith("Hz")


def test_sensors_that_fall_silent_are_named_while_positions_go_on(local):
    walk = outdoors(30.0)
    stopped = {name: Signal(s.time[s.time < 12], s.values[s.time < 12]) for name, s in walk.signals.items()}
    posted = bodies(replace(walk, **stopped), "stopped")
    for body in posted:
        assert post(local, body).status_code in (200, 499)
    pose = until(lambda: used(local, len(posted)))
    for text in pose["health"].values():
        assert re.fullmatch(r"silent for \d+ s", text)
    assert any(line.startswith("all sensors: silent for") for line in pose["issues"])
    assert pose["state"] == "fixes alone"
    assert pose["time"] == pytest.approx(walk.epoch + walk.fixes.time[-1], abs=0.01)


def test_the_geojson_of_a_walk_has_both_parts_and_the_pose(client, walker):
    answer = client.get("/walkers/walk-one.geojson")
    assert answer.headers["content-type"].startswith("application/geo+json")
    features = until(lambda: (found := client.get(answer.url).json()["features"])[1]["geometry"] and found)
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
    assert described["info"]["version"] == pdr_graph.__version__
    assert "/sensorlogger" in client.get("/api").text


READ = ("/", "/app", "/walkers", "/walkers/x", "/events", "/plan", "/openapi.json", "/web/x")
WRITTEN = ("/sensorlogger", "/owntracks", "/overland", "/osmand", "/walkers/walk-one/finish")


@pytest.mark.parametrize(("method", "paths"), [("GET", READ), ("POST", WRITTEN)])
def test_nothing_is_readable_or_writable_without_a_token(client, method, paths):
    for path in paths:
        for header in ("", "Bearer wrong", "Basic eDp5"):
            answer = client.request(method, path, headers={"Authorization": header})
            assert "token" in one_line(answer, 401), path


@pytest.mark.parametrize(
    "request_options",
    [
        {"params": {"token": TOKENS["ann"]}, "headers": {"Authorization": ""}},
        {"headers": {"Authorization": "", "Cookie": f"pdr_graph_token={TOKENS['ann']}"}},
        {"headers": ANN},
        {"auth": ("anyone", TOKENS["ann"])},
    ],
    ids=["query", "cookie", "bearer", "basic"],
)
def test_a_token_is_taken_in_four_ways(client, request_options):
    assert client.get("/walkers", **request_options).status_code == 200


def test_a_user_sees_and_changes_only_the_own_walkers(client, walker):
    assert client.get("/walkers", headers=ANN).json() == []
    for path in ("/walkers/walk-one", "/walkers/walk-one.geojson", "/walkers/walk-one/recording"):
        one_line(client.get(path, headers=ANN), 404)
    one_line(client.delete("/walkers/walk-one", headers=ANN), 404)
    one_line(post(client, b"", "/walkers/walk-one/finish", headers=ANN), 404)
    assert "another user" in one_line(post(client, WALK[0], headers=ANN), 403)
    assert client.get("/walkers/walk-one").json()["message"] == walker["message"]


def test_pages_of_other_sites_are_refused(client):
    body = first_message("foreign")
    one_line(post(client, body, headers={"Origin": "https://example.org"}), 403)
    assert post(client, body, headers={"Origin": "http://testserver"}).status_code in (200, 499)
    assert is_foreign({"sec-fetch-site": "cross-site", "sec-fetch-mode": "no-cors", "host": "x"})
    client.delete("/walkers/foreign")


CHROMIUM = {"User-Agent": "Mozilla/5.0 (X11; Linux x86_64) Chrome/140", "Accept": "*/*"}
NAVIGATED = {"Accept": "text/html,application/xhtml+xml,image/avif,*/*;q=0.8", "Sec-Fetch-Mode": "navigate"}
OF_A_PAGE = {
    "image": {"Accept": "image/avif,image/webp,*/*;q=0.8", "Sec-Fetch-Site": "cross-site", "Sec-Fetch-Dest": "image"},
    "image of an old browser, without a referrer": {"Accept": "image/png,*/*;q=0.8"},
    "frame": NAVIGATED | {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Dest": "iframe"},
    "frame from another port": NAVIGATED | {"Sec-Fetch-Site": "same-site", "Sec-Fetch-Dest": "iframe"},
    "address of a link in a mail": NAVIGATED | {"Sec-Fetch-Site": "none", "Sec-Fetch-Dest": "document"},
    "script": {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "no-cors", "Sec-Fetch-Dest": "script"},
    "fetch without CORS": {
        "Sec-Fetch-Site": "same-site",
        "Sec-Fetch-Mode": "no-cors",
        "Referer": "http://127.0.0.1:9/",
    },
    "form": {"Origin": "null"},
    "prefetch": {"Purpose": "prefetch"},
    "old browser": CHROMIUM,
}


@pytest.mark.parametrize("kind", OF_A_PAGE)
def test_what_a_page_makes_a_browser_ask_for_stores_nothing(local, kind):
    """No app sends these headers; on this machine there may be no token that a page cannot know."""
    answer = local.get("/osmand?id=evil&lat=1&lon=2&timestamp=1700000000", headers=OF_A_PAGE[kind])
    one_line(answer, 403)
    for path in ("/sensorlogger", "/owntracks", "/overland", "/osmand"):
        one_line(local.post(path, content=b"{}", headers=OF_A_PAGE[kind]), 403)
    assert local.get("/walkers").json() == []


def test_a_cookie_reads_and_does_not_store_and_has_the_port_in_its_name(client):
    """Browsers send it to every port of the host, and with images of the pages there."""
    page = client.get("/?token=" + TOKENS["ann"], headers={"Host": "testserver:8080"}, follow_redirects=False)
    name = page.headers["set-cookie"].partition("=")[0]
    assert "8080" in name
    own = {"Authorization": "", "Host": "testserver:8080", "Cookie": f"{name}={TOKENS['ann']}"}
    assert client.get("/walkers", headers=own).status_code == 200
    assert client.get("/walkers", headers=own | {"Host": "testserver:8081"}).status_code == 401
    assert client.get("/osmand?id=e&lat=1&lon=2&timestamp=1700000000", headers=own).status_code == 401


def test_the_cookie_stores_for_a_page_of_this_server_alone(guarded):
    """As the app page posts: a browser states the origin of each POST, and no page can claim another one."""
    page = guarded.get("/app?token=" + TOKENS["ann"], follow_redirects=False, headers={"Authorization": ""})
    assert (page.status_code, page.headers["location"]) == (303, "./app")
    cookie = page.headers["set-cookie"].partition(";")[0]
    body, of_page = first_message("page"), {"Authorization": "", "Cookie": cookie, "User-Agent": "Mozilla/5.0"}
    for origin in ("http://testserver:8081", "http://127.0.0.1", "null", "://testserver", ""):
        assert post(guarded, body, headers=of_page | {"Origin": origin}).status_code in (401, 403), origin
    assert post(guarded, body, headers=of_page).status_code == 401
    cross = {"Origin": "http://testserver", "Sec-Fetch-Site": "cross-site"}
    assert post(guarded, body, headers=of_page | cross).status_code == 403
    assert guarded.get("/walkers").json() == []
    assert post(guarded, body, headers=of_page | {"Origin": "http://testserver"}).status_code in (200, 499)
    assert [walker["id"] for walker in guarded.get("/walkers", headers=ANN).json()] == ["page"]


def test_the_app_page_runs_its_own_script_alone(client):
    """Its policy has the hash of each script and style within it, and of nothing else."""
    page = client.get("/app")
    policy = dict(part.split(" ", 1) for part in page.headers["content-security-policy"].split("; "))
    for tag, directive in (("script", "script-src"), ("style", "style-src")):
        parts = re.findall(rf"<{tag}[^>]*>(.*?)</{tag}>", page.text, re.DOTALL)
        hashes = [base64.b64encode(hashlib.sha256(part.encode()).digest()).decode() for part in parts]
        assert policy[directive].split() == ["'self'", *(f"'sha256-{each}'" for each in hashes)]
    assert not re.search(r' on\w+="| style="|<script[^>]* src=', page.text)
    assert "sha256" not in client.get("/").headers["content-security-policy"]


def test_pages_of_other_sites_and_ports_show_nothing_of_an_answer(client):
    """An image would have a size only if its user is logged in."""
    for path in ("/", "/walkers", "/web/page.js", "/plan"):
        assert client.get(path).headers["cross-origin-resource-policy"] == "same-origin"
    headers = {"Sec-Fetch-Site": "same-site", "Sec-Fetch-Mode": "no-cors"}
    assert client.get("/walkers", headers=headers).status_code == 403


def test_the_positions_of_another_user_have_an_id_that_no_message_can_take(guarded):
    place = {"id": "tracker", "lat": 48.1, "lon": 11.5, "timestamp": 1_700_000_000}
    assert guarded.get("/osmand", params=place, headers=ANN).status_code == 200
    [id_] = [each["id"] for each in guarded.get("/walkers").json() if each["name"] == "tracker"]
    assert post(guarded, first_message(id_)).status_code in (200, 499)
    assert guarded.get(f"/walkers/{id_}", headers=ANN).json()["protocol"] == "osmand"


def test_unfinished_messages_of_a_user_are_limited_together(guarded, monkeypatch):
    arriving = guarded.app.state.server.arriving
    monkeypatch.setitem(arriving, "ann", application.ARRIVING * LIMITS.body)
    one_line(post(guarded, first_message("many"), headers=ANN), 429)
    assert post(guarded, first_message("many")).status_code in (200, 499), "another user is not concerned"
    assert arriving["ann"] == application.ARRIVING * LIMITS.body, "what did not stay is not counted"


def test_positions_in_the_address_of_a_post_are_taken_without_the_token(guarded):
    """As Traccar Client up to version 8 sends them."""
    address = f"/osmand?id=old&lat=48&lon=11&timestamp=1700000000&token={TOKENS['ann']}"
    assert guarded.post(address, headers={"Authorization": ""}).status_code == 200
    [id_] = [each["id"] for each in guarded.get("/walkers").json() if each["name"] == "old"]
    logs = list(guarded.app.state.server.reception.root.glob(f"{id_}/*"))
    assert logs
    assert not any(TOKENS["ann"].encode() in log.read_bytes() for log in logs)


def test_positions_of_sensor_logger_alone_are_a_track(local):
    values = {"latitude": 48.0, "longitude": 11.0, "horizontalAccuracy": 5.0}
    for n in range(8):
        values["latitude"] += 2e-4
        sample = {"name": "location", "time": (1_700_000_000 + 40 * n) * 10**9, "values": values}
        body = {"messageId": n, "sessionId": "track", "payload": [sample]}
        assert local.post("/sensorlogger", json=body).status_code in (200, 499)
    content = finished_recording(local, "track")
    assert content.count(b"<trkpt") == 8


def test_all_walks_that_end_together_have_their_recordings(tmp_path):
    """More than one process makes; and those that a server did not make before its end, the next one makes."""
    ids = [f"w{n}" for n in range(Recorder.TASKS + 3)]
    with local_server(tmp_path) as client:
        for n, id_ in enumerate(ids):
            for second in (0, 40):
                place = {"id": id_, "lat": 48 + 1e-4 * second, "lon": 11, "timestamp": 1_700_000_000 + 500 * n + second}
                client.get("/osmand", params=place).raise_for_status()
        walks = [each["id"] for each in client.get("/walkers").json()]
        for id_ in walks:
            client.post(f"/walkers/{id_}/finish").raise_for_status()
        until(lambda: len(recordings(tmp_path)) == len(ids))
        until(lambda: all(read_session(file.parent).recorded for file in recordings(tmp_path)))
    recordings(tmp_path)[0].unlink()
    unmade = recordings(tmp_path)[0].parent
    write_session(unmade, replace(read_session(unmade), recorded=False))
    (unmade / "recording.gpx").unlink()
    with local_server(tmp_path):
        until(lambda: len(recordings(tmp_path)) == len(ids))


def test_the_latest_finished_walks_are_shown_and_the_others_are_kept(tmp_path):
    """Without a word to those who see them: "forgotten" would remove the phone's device from Home Assistant."""
    with local_server(tmp_path, limits=Limits(shown=1)) as client:
        hub = client.app.state.server.hub
        viewer = hub.subscribe(OWNER)
        for n in range(2):
            place = {"id": f"w{n}", "lat": 48.1, "lon": 11.5, "timestamp": 1_700_000_000}
            client.get("/osmand", params=place).raise_for_status()
            [id_] = [each["id"] for each in client.get("/walkers").json() if each["name"] == f"w{n}"]
            client.post(f"/walkers/{id_}/finish").raise_for_status()
            until(lambda id_=id_: hub.walkers[id_].pose["state"] == "finished")
        until(lambda: {each["name"] for each in client.get("/walkers").json()} == {"w1"})
        assert "forgotten" not in {kind for kind, _ in viewer.events()}


def recordings(folder):
    return sorted(folder.glob("sessions/*/recording.*"))


@pytest.mark.parametrize("when", ["9999-12-31T23:59:59Z", "99999999999", "-1", "1e300", "1" * 5000])
def test_positions_of_no_time_are_refused_and_of_a_batch_left_out(local, when):
    place = f"id=walker&lat=48.1&lon=11.5&timestamp={when}"
    if not (when.isdecimal() and len(when) == 11):  # OsmAnd's milliseconds
        one_line(local.post("/osmand", content=place), 400)
    one_line(post(local, json.dumps(PLACE | {"tst": when})[:9000].encode(), "/owntracks"), 400)
    batch = [
        {"geometry": {"type": "Point", "coordinates": [11.5, 48.1]}, "properties": {"timestamp": at, "device_id": "b"}}
        for at in ("9999-12-31T23:59:59Z", "2024-05-01T12:00:00Z")
    ]
    assert local.post("/overland", json={"locations": batch}).status_code == 200
    assert [walker["name"] for walker in local.get("/walkers").json()] == ["b"]


def test_a_silent_session_ends_for_a_new_one_when_a_user_has_the_most(tmp_path):
    """Whose phone was lost, or what said one word: the owner's next walk is not refused."""
    limits = Limits(sessions=5, silent=0.5)
    with local_server(tmp_path, limits=limits) as client:
        for n in range(5):
            assert post(client, first_message(f"silent{n}")).status_code == 200
        one_line(post(client, first_message("too-early")), 429)
        time.sleep(0.6)
        assert post(client, first_message("silent4")[:-1] + b" }").status_code in (200, 499)
        assert post(client, first_message("next-walk")).status_code == 200
        ended = until(lambda: [w["id"] for w in client.get("/walkers").json() if w["state"] == "finished"])
        assert ended == ["silent0"]


def test_a_walk_whose_description_is_gone_is_named_at_the_start(tmp_path, capsys):
    with local_server(tmp_path) as client:
        post(client, first_message("walk-gone"))
    (tmp_path / "sessions" / "walk-gone" / "session.json").unlink()
    with local_server(tmp_path) as client:
        printed = capsys.readouterr()
        assert "walk-gone" in printed.out + printed.err
        assert post(client, WALK[1].replace(b"walk-one", b"walk-gone")).status_code == 200
        assert until(lambda: used(client, 2, "walk-gone"))["message"] == 2, "its messages are there again"


@pytest.mark.parametrize(
    "body", [b"", b"{", b'{"messageId":1,"sessionId":"bad","payload":[{"na', b"[1]", b"\xff", b"[" * 50_000, b"null"]
)
@pytest.mark.parametrize("path", ["/sensorlogger", "/owntracks", "/overland", "/osmand"])
def test_a_malformed_message_is_refused(client, path, body):
    one_line(post(client, body, path), 400)
    assert client.get("/walkers/bad").status_code == 404


def endless():
    for _ in range(1000):
        yield b" " * 10_000


BOMB = gzip.compress(b" " * (50 << 20))
SAMPLES = message("many", 1, [{"name": "x", "time": 1}] * (LIMITS.samples + 1))


@pytest.mark.parametrize(
    ("body", "encoding", "status", "text"),
    [
        (b" " * (LIMITS.body + 1), "identity", 413, "more than 1 MB"),
        (endless(), "identity", 413, "more than 1 MB"),
        (BOMB, "gzip", 413, "more than 1 MB"),
        (b"no gzip", "gzip", 400, "damaged gzip"),
        (b"x", "br", 415, "'br'"),
        (SAMPLES, "identity", 413, "2001 samples"),
    ],
    ids=["too large", "endless", "a bomb", "no gzip", "another encoding", "too many samples"],
)
def test_a_body_that_harms_is_refused(client, body, encoding, status, text):
    assert text in one_line(post(client, body, headers={"Content-Encoding": encoding}), status)


def test_a_compressed_message_is_taken(client):
    body = gzip.compress(first_message("compressed"))
    assert post(client, body, headers={"Content-Encoding": "gzip"}).status_code == 200
    client.delete("/walkers/compressed")


def test_a_flood_is_refused_and_told_when_to_come_again(client):
    sample = {"name": "gyroscope", "time": 10**18, "values": {"x": 0.0, "y": 0.0, "z": 0.0}, "pad": "x" * 900_000}
    answers = [post(client, message("flood", n, [sample])) for n in range(8)]
    refused = [answer for answer in answers if answer.status_code == 429]
    assert refused
    assert int(refused[0].headers["Retry-After"]) >= 1
    client.delete("/walkers/flood")


def test_the_flood_of_a_user_keeps_nobody_else_out(tmp_path, monkeypatch):
    """By requests, and by the bytes of all sessions together."""
    monkeypatch.setattr(application, "REQUESTS", (0.01, 500.0))
    first, second = first_message("one"), first_message("two")
    limits = replace(LIMITS, user_rate=0.01, burst=150.0 * len(first))  # a message and a half at once
    with TestClient(build(Settings(tmp_path, workers=0, tokens=TOKENS, limits=limits)), headers=OWN) as client:
        assert post(client, first, headers=ANN).status_code in (200, 499)
        assert "of a user" in one_line(post(client, second, headers=ANN), 429)
        statuses = [client.get("/walkers", headers=ANN).status_code for _ in range(5)]
        assert statuses == [200] * 3 + [429] * 2
        assert post(client, first_message("three")).status_code in (200, 499)


def test_a_full_disk_takes_no_first_message_and_puts_off_the_end_of_a_walk(tmp_path, monkeypatch):
    full = OSError(errno.ENOSPC, "No space left on device")
    monkeypatch.setattr(reception, "END_AGAIN", 0.2)
    with local_server(tmp_path) as client:
        assert post(client, first_message("earlier")).status_code in (200, 499)
        with monkeypatch.context() as disk:
            disk.setattr(reception, "write_session", Mock(side_effect=full))
            for path, body in (("/sensorlogger", first_message("new")), ("/owntracks", json.dumps(PLACE).encode())):
                answer = post(client, body, path)
                assert "No space" in one_line(answer, 507)
                assert answer.headers["Retry-After"]
            client.post("/walkers/earlier/finish").raise_for_status()
            until(lambda: any("the end is tried again" in issue for issue in used(client, 0)["issues"]))
        assert [each["id"] for each in client.get("/walkers").json()] == ["earlier"]
        until(lambda: used(client, 0)["state"] == "finished" and recordings(tmp_path))
        assert post(client, first_message("new")).status_code in (200, 499)


def test_too_many_sessions_of_a_user_are_refused(client):
    names = [f"many{n:04d}" for n in range(LIMITS.sessions + 1)]
    answers = [post(client, first_message(name), headers=ANN) for name in names]
    assert [answer.status_code for answer in answers[:-1]] == [200] * LIMITS.sessions
    assert "sessions" in one_line(answers[-1], 429)
    assert post(client, WALK[-1]).status_code == 200  # the others are unharmed
    for name in names[:-1]:
        assert client.delete(f"/walkers/{name}", headers=ANN).status_code == 204


def test_a_session_of_any_name_stays_in_its_folder(client):
    """The files are their owner's alone."""
    for name in ("../../evil", "a/b", "", "x" * 10_000, "ünï", "con", "."):
        answer = post(client, json.dumps({"messageId": 0, "sessionId": name, "payload": []}).encode())
        assert answer.status_code == (400 if name == "" else 200)
    inside = [path.name for path in (client.folder / "sessions").iterdir()]
    assert all(name.replace("-", "").replace("_", "").isalnum() for name in inside)
    assert sorted(path.name for path in client.folder.iterdir()) == ["sessions"]
    assert all(path.stat().st_mode & 0o077 == 0 for path in (client.folder / "sessions").rglob("*"))
    for pose in client.get("/walkers").json():
        if pose["id"] != "walk-one":
            client.delete(f"/walkers/{pose['id']}")


def test_a_session_of_three_letters_keeps_its_name(client):
    post(client, first_message("abc"))
    assert client.get("/walkers/abc").status_code == 200
    client.delete("/walkers/abc")


def test_a_second_phone_with_the_name_of_a_session_has_its_own(client):
    """Both number their messages from 0: those of the second were taken for repetitions, and lost with 200."""
    for phone in ("one", "two", "one", "two"):
        message = json.loads(first_message("shared")) | {"deviceId": phone}
        assert post(client, json.dumps(message).encode()).status_code == 200
    found = [pose["id"] for pose in client.get("/walkers").json() if pose["id"] != "walk-one"]
    assert len(found) == 2
    assert "shared" in found
    for id_ in found:
        client.delete(f"/walkers/{id_}")


def test_what_is_degraded_is_shown_to_the_user_of_the_phone_once(client):
    values = {"x": 0.1, "y": 0.0, "z": 0.0}
    samples = [{"name": "accelerometer", "time": 10**18 + n * 10**7, "values": values} for n in range(300)]
    post(client, message("poor", 0, samples))
    numbers = iter(range(1, 1000))
    shown = until(lambda: (found := post(client, message("poor", next(numbers), []))).status_code == 499 and found)
    assert "switch on Gravity" in shown.text
    assert post(client, message("poor", 1000, [])).status_code == 200
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
    pose = until(lambda: (found := client.get(f"/walkers/{names['xy']}").json())["state"] == "fixes alone" and found)
    assert (pose["lat"], pose["lon"]) == pytest.approx((48.1, 11.5))
    assert b"<trkpt" in finished_recording(client, names["xy"])
    for name in ("xy", "iphone", "7"):
        client.delete(f"/walkers/{names[name]}")


def test_a_deleted_walk_leaves_no_file(client):
    post(client, first_message("secret"))
    folder = client.folder / "sessions" / "secret"
    assert folder.exists()
    assert client.delete("/walkers/secret").status_code == 204
    until(lambda: not folder.exists())  # the estimating process may be writing
    one_line(client.get("/walkers/secret"), 404)


def test_a_finished_walk_is_a_recording_that_smooth_opens(tmp_path):
    """All samples, as they were sent; after a restart it is still there, and a late message resumes it."""
    walk = outdoors()
    with local_server(tmp_path) as client:
        for body in WALK:
            post(client, body)
        until(lambda: used(client, len(WALK)))
        one_line(client.get("/walkers/walk-one/recording"), 409)
        (tmp_path / "walk.zip").write_bytes(finished_recording(client, "walk-one"))
    loaded = load(tmp_path / "walk.zip")
    for sensor, signal in loaded.signals.items():
        assert np.allclose(signal.values, walk.signals[sensor].values, rtol=0, atol=1e-12)
        assert np.allclose(signal.time, walk.signals[sensor].time, rtol=0, atol=1e-6)
    assert len(loaded.fixes) == len(walk.fixes)
    with local_server(tmp_path) as client:
        pose = client.get("/walkers/walk-one").json()
        assert pose["state"] == "finished"
        features = client.get("/walkers/walk-one.geojson").json()["features"]
        assert len(features[0]["geometry"]["coordinates"]) > 15
        post(client, message("walk-one", len(WALK), []))
        assert until(lambda: used(client, len(WALK) + 1))["steps"] == pose["steps"]


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


@pytest.mark.parametrize(
    ("host", "headers"),
    [("walks.example.org", {}), ("", {}), ("127.0.0.1:8080", {"X-Forwarded-For": "192.0.2.7"}), ("[", {})],
)
def test_without_tokens_a_proxy_and_other_names_are_refused(local, host, headers):
    """Behind a proxy all users would be the owner; a name of another site may point to this machine."""
    assert local.get("/walkers").status_code == 200
    assert local.get("/walkers", headers={"Host": "localhost:8080"}).status_code == 200
    refused = local.get("/walkers", headers={"Host": host} | headers)
    assert (refused.status_code, "--token" in refused.text) == (403, True)


@pytest.mark.parametrize(
    "body",
    [
        {"payload": [{"name": "test"}], "deviceId": "ad7e4997"},
        {"messageId": 0, "sessionId": "test", "deviceId": "a", "payload": [{"name": "test", "time": 1, "values": {}}]},
    ],
)
def test_the_apps_test_of_the_address_is_answered_and_makes_no_walker(local, body):
    """As sk-sensorlogger-plugin, another receiver of the app, recognises it."""
    assert local.post("/sensorlogger", json=body).status_code == 200
    assert local.get("/walkers").json() == []
