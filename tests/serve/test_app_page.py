"""The example app in headless Chromium: a phone's sensors, as the browser gives them, come back as a dot."""

import json
import shutil
import subprocess
import time
from dataclasses import replace

import numpy as np
import pytest
import simulated
from browser import PATIENCE, ShownPage, chromium
from plans import MAPS
from running_server import RunningServer, certificate
from streamed_walks import bodies, until

from pdr_graph.floor.plan_files import Building
from pdr_graph.io.validation import RADIUS_68

pytestmark = [pytest.mark.timeout(180), pytest.mark.thorough]
MAP = MAPS / "arcade.geojson"
FRAME = Building.load(MAP).floors[0].frame
SIMULATED = simulated.walk_along(simulated.ROUTE[:4], seed=4)

# The events of a phone with given samples: time [ms of Unix time], acceleration [m/s²], rate [deg/s]; up in its axes
EVENTS = """
const [samples, sign] = arguments;
const now = Date.now() - performance.now();
for (const [time, ax, ay, az, alpha, beta, gamma, x, y, z] of samples) {
  const tilt = { alpha: 0, beta: Math.asin(y) * 180 / Math.PI, gamma: Math.atan2(-x, z) * 180 / Math.PI };
  dispatchEvent(new DeviceOrientationEvent("deviceorientation", tilt));
  const accelerationIncludingGravity = { x: sign * ax, y: sign * ay, z: sign * az };
  const measured = { accelerationIncludingGravity, rotationRate: { alpha, beta, gamma }, interval: 20 };
  const event = new DeviceMotionEvent("devicemotion", measured);
  Object.defineProperty(event, "timeStamp", { value: time - now });
  dispatchEvent(event);
}
"""
POSITIONS = "navigator.geolocation.watchPosition = (found, failed) => { Object.assign(window, { found, failed }); };"
SENSORS = ("accelerometer", "linear-acceleration", "gyroscope", "relative-orientation")


@pytest.fixture(scope="module")
def browser():
    with chromium(offline=False) as found:
        yield found


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    running = RunningServer(tmp_path_factory.mktemp("server") / "out", "--map", str(MAP))
    yield running
    running.kill()


class AppPage(ShownPage):
    """The app, open; stubbed: positions come from the test."""

    def __init__(self, browser, url, query="", stubbed=True):
        self.browser = browser
        browser.set_page_load_timeout(PATIENCE)
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", SCREEN)
        browser.get("about:blank")
        browser.get_log("browser")
        browser.get(f"{url}/app{query}")
        self.until("return document.documentElement.dataset.ready === 'yes'")
        if stubbed:
            self.run(POSITIONS)

    def start(self):
        self.run("document.getElementById('start').click()")
        self.until("return app.state.watching && app.state.running")
        return self.run("return app.state.session")

    def says(self, pattern, element="issues"):
        """Wait until a line matches a pattern of JavaScript."""
        self.until(f"return /{pattern}/.test(document.getElementById('{element}').textContent)")

    def walk(self, recording, up, sign=1, begin=0, until=1000):
        """Dispatch the samples of a recording, then its positions, second by second of the walk."""
        accelerometer, gyroscope, fixes = recording.accelerometer, recording.gyroscope, recording.fixes
        columns = (
            1000.0 * (recording.epoch + accelerometer.time),
            accelerometer.values,
            np.degrees(gyroscope.values),
            up,
        )
        rows = np.column_stack(columns)
        for second in range(begin, int(min(until, accelerometer.time[-1])) + 1):
            part = rows[np.floor(accelerometer.time) == second]
            self.run(EVENTS, part.tolist(), sign)
            for n in np.flatnonzero(np.floor(fixes.time) == second):
                lon, lat = fixes.position[n].tolist()
                coords = {"latitude": lat, "longitude": lon, "accuracy": RADIUS_68 * float(fixes.sigma[n])}
                coords |= {"speed": None, "heading": None}
                stamp = 1000.0 * (recording.epoch + float(fixes.time[n]))
                self.run("found({coords: arguments[0], timestamp: arguments[1]})", coords, stamp)


SCREEN = {"width": 390, "height": 844, "deviceScaleFactor": 1, "mobile": True}


def in_the_arcade():
    """The walk with positions in the plan's frame, by a clock that is right."""
    recording = simulated.with_receiver(SIMULATED, every=250)
    fixes = replace(recording.fixes, position=FRAME.to_lonlat(SIMULATED.position[::250]))
    return replace(recording, fixes=fixes, epoch=round(time.time() - SIMULATED.time[-1]))


def ended(server, session):
    """The path of a walk that is finished: times since its first row [s], and positions [m]."""
    until(lambda: json.loads(server.ask(f"/walkers/{session}")[1]).get("state") == "finished")
    features = json.loads(server.ask(f"/walkers/{session}.geojson")[1])["features"]
    line = np.array(features[0]["geometry"]["coordinates"])
    return np.array(features[0]["properties"]["times"]), FRAME.from_lonlat(line)


@pytest.mark.parametrize("sign", [1, -1], ids=["W3C", "Safari"])
def test_a_walk_through_the_browser_is_that_of_its_samples(browser, server, sign):
    """Whichever sign the browser gives accelerations: the page sees it where it sees which side is up."""
    recording = in_the_arcade()
    page = AppPage(browser, server.url)
    session = page.start()
    page.walk(recording, SIMULATED.up, sign)
    page.until("return app.state.pose?.steps > 20 && !app.state.queue.length")
    assert page.run("return app.state.sign") == sign
    page.run("document.getElementById('start').click()")
    direct = bodies(recording, f"direct{sign}")
    server.post(*direct, path="/sensorlogger?platform=android")
    until(lambda: json.loads(server.ask(f"/walkers/direct{sign}")[1])["message"] >= len(direct))
    server.ask(f"/walkers/direct{sign}/finish", method="POST")
    (time_, path), (expected_time, expected) = ended(server, session), ended(server, f"direct{sign}")
    assert len(path) > 30
    assert np.allclose(time_, expected_time, atol=0.01)
    assert np.abs(path - expected).max() < 0.02
    assert page.errors == []


def emulate(browser, kind, reading):
    browser.execute_cdp_cmd("Emulation.setSensorOverrideReadings", {"type": kind, "reading": reading})


def test_the_browsers_own_sensors_and_positions_arrive_in_the_axes_of_the_phone(browser, server):
    """Chromium's events of emulated sensors: alpha is about x, as in all browsers (w3c/deviceorientation, issue 44)."""
    lon, lat = FRAME.to_lonlat(np.array([[5.0, 18.0]]))[0].tolist()
    for kind in SENSORS:
        browser.execute_cdp_cmd("Emulation.setSensorOverrideEnabled", {"enabled": True, "type": kind})
    browser.execute_cdp_cmd("Browser.grantPermissions", {"permissions": ["geolocation", "sensors"]})
    place = {"latitude": lat, "longitude": lon, "accuracy": 5.0}
    browser.execute_cdp_cmd("Emulation.setGeolocationOverride", place)
    try:
        page = AppPage(browser, server.url, stubbed=False)
        session = page.start()
        emulate(browser, "relative-orientation", {"quaternion": {"x": np.sin(0.25), "y": 0, "z": 0, "w": np.cos(0.25)}})
        tilted = {"x": 0.0, "y": 9.81 * np.sin(0.5), "z": 9.81 * np.cos(0.5)}
        emulate(browser, "accelerometer", {"xyz": tilted})
        emulate(browser, "linear-acceleration", {"xyz": dict.fromkeys("xyz", 0.0)})
        emulate(browser, "gyroscope", {"xyz": {"x": 0.1, "y": 0.2, "z": 0.3}})
        page.until("return app.state.sent > 2 && app.state.pose?.lon")
        assert page.run("return app.state.sign") == 1
        walker = json.loads(server.ask(f"/walkers/{session}")[1])
        assert np.allclose([walker["lon"], walker["lat"]], [lon, lat], atol=1e-5)
        gyroscope = "app.state.packet.findLast(sample => sample.name === 'gyroscope')"
        page.until(f"return {gyroscope}")
        values = page.run(f"return {gyroscope}.values")
        assert [values[axis] for axis in "xyz"] == pytest.approx([0.1, 0.2, 0.3], abs=0.002)
        page.says("±", "state")
        assert page.errors == []
    finally:
        browser.execute_cdp_cmd("Emulation.clearGeolocationOverride", {})
        for kind in SENSORS:
            browser.execute_cdp_cmd("Emulation.setSensorOverrideEnabled", {"enabled": False, "type": kind})


def test_messages_wait_while_there_is_no_network_and_arrive_in_order(browser, server):
    recording = in_the_arcade()
    page = AppPage(browser, server.url)
    session = page.start()
    page.walk(recording, SIMULATED.up, until=5)
    page.until("return app.state.sent > 2 && !app.state.queue.length")
    offline = {"offline": True, "latency": 0, "downloadThroughput": 0, "uploadThroughput": 0}
    browser.execute_cdp_cmd("Network.emulateNetworkConditions", offline)
    try:
        page.walk(recording, SIMULATED.up, begin=6, until=12)
        page.says("messages wait: no answer of the server")
        assert page.run("return app.state.queue.length") > 4
    finally:
        online = {"offline": False, "downloadThroughput": -1, "uploadThroughput": -1}
        browser.execute_cdp_cmd("Network.emulateNetworkConditions", offline | online)
    page.until("return !app.state.queue.length")
    sent = page.run("return app.state.sent")
    walker = until(lambda: (found := json.loads(server.ask(f"/walkers/{session}")[1]))["message"] >= sent and found)
    assert page.run("return app.state.lost") == 0
    assert walker["health"]["accelerometer"] == "50 Hz", "no gap"


def test_the_walk_goes_on_when_the_server_restarts(browser, server):
    recording = in_the_arcade()
    page = AppPage(browser, server.url)
    session = page.start()
    page.walk(recording, SIMULATED.up, until=5)
    page.until("return app.state.sent > 2 && !app.state.queue.length")
    server.kill()
    page.walk(recording, SIMULATED.up, begin=6, until=12)
    page.until("return app.state.offline")
    server.start(server.port)
    page.until("return !app.state.queue.length")
    sent = page.run("return app.state.sent")
    page.until(f"return app.state.pose.message >= {sent}")
    assert json.loads(server.ask(f"/walkers/{session}")[1])["health"]["accelerometer"] == "50 Hz", "no gap"


def test_the_app_names_the_silence_of_each_source(browser, server):
    recording = in_the_arcade()
    page = AppPage(browser, server.url)
    page.start()
    page.walk(recording, SIMULATED.up, until=6)
    page.until("return app.state.pose?.time")
    page.says("motion sensors: silent for \\d+ s")
    page.says("the dot is \\d+ s old")
    page.run("failed({message: 'User denied Geolocation'})")
    page.says("position: User denied")
    page.run("found({coords: {latitude: 35.0, longitude: 135.0, accuracy: 5}, timestamp: Date.now()})")
    page.says("^(?!.*User denied)")


@pytest.mark.skipif(not shutil.which("openssl"), reason="no openssl")
def test_one_link_is_enough_by_https_and_by_http_the_page_says_what_it_lacks(tmp_path):
    """With a token, which a cookie has from then on; the certificate of the phone's own network."""
    file, token = tmp_path / "serve.pem", f"?token={'s' * 20}"
    subprocess.run(certificate(file), check=True, capture_output=True)
    recording = in_the_arcade()
    with chromium(offline=False, arguments=("--ignore-certificate-errors",)) as trusting:
        secure = RunningServer(tmp_path / "https", "--token", "s" * 20, "--certificate", str(file))
        try:
            page = AppPage(trusting, secure.url, token)
            assert trusting.current_url == f"{secure.url}/app"
            page.start()
            page.walk(recording, SIMULATED.up, until=6)
            page.until("return app.state.sent > 4 && app.state.pose?.steps > 2")
            assert page.errors == []
        finally:
            secure.kill()
        plain = RunningServer(tmp_path / "http", "--token", "s" * 20)
        try:
            page = AppPage(trusting, f"http://other.test:{plain.port}", token)
            page.says("this address is not secure")
            assert page.run("return document.getElementById('start').disabled")
        finally:
            plain.kill()
