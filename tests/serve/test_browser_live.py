"""The page in headless Chromium, with the real server and a simulated phone that posts as the app does."""

import contextlib
import os
import subprocess
import sys
import threading
import time
import urllib.parse
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from live_page import LivePage, browser_of
from simulated_phone import SimulatedPhone, fetched

from pdr_graph.floor.plan_files import FloorPlan

pytestmark = pytest.mark.timeout(120)
MAP = Path(__file__).parents[2] / "maps" / "arcade.geojson"
ROUTE = [(2.5, 18.0), (6.8, 18.2), (6.8, 27.8), (27.6, 27.6)]
START = 40.0  # [s] for the server to accept connections
PATIENCE = 30.0  # [s] for a pose to arrive
PROGRAM = "from pdr_graph.apps.cli import main; main()"
NEAR = 3.0  # [px]


class RunningServer:
    """`pdr-graph serve` in a process."""

    def __init__(self, folder, *options, port=0):
        self.folder, self.options = folder, options
        self.begin(port)

    def begin(self, port):
        command = [
            sys.executable,
            "-c",
            PROGRAM,
            "serve",
            "--port",
            str(port),
            "--out",
            str(self.folder),
            *self.options,
        ]
        with (self.folder.parent / "stderr").open("ab") as errors:
            self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True)
        first = []
        reading = threading.Thread(target=lambda: first.append(self.process.stdout.readline()), daemon=True)
        reading.start()
        reading.join(START)
        if not first or not first[0]:
            self.end()
            raise AssertionError((self.folder.parent / "stderr").read_text())
        self.url = first[0].split()[-1].rstrip("/")
        self.port = urllib.parse.urlsplit(self.url).port

    def end(self):
        self.process.terminate()
        try:
            self.process.wait(10)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait(10)

    def until(self, condition):
        """Wait until a condition holds for the list of walkers, which is returned."""
        end = time.monotonic() + PATIENCE
        while not condition(walkers := fetched(f"{self.url}/walkers")):
            assert time.monotonic() < end, walkers
            time.sleep(0.1)
        return walkers

    def forget_all(self):
        for walker in fetched(f"{self.url}/walkers"):
            request = urllib.request.Request(f"{self.url}/walkers/{walker['id']}", method="DELETE")
            urllib.request.urlopen(request, timeout=10).close()


@pytest.fixture(scope="module")
def browser():
    with browser_of() as found:
        yield found


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    running = RunningServer(tmp_path_factory.mktemp("server") / "out", "--map", str(MAP))
    yield running
    running.end()


@pytest.fixture
def page(browser, server):
    server.forget_all()
    return LivePage(browser, server.url)


@pytest.fixture(scope="module")
def frame():
    return FloorPlan.load(MAP).frame


def posted(server, phone, seconds):
    """Post some seconds of a walk; returns the walker when all was used."""
    phone.post(server.url, 0, seconds)
    (walker,) = server.until(lambda walkers: walkers and walkers[0]["message"] >= seconds)
    return walker


def test_without_a_phone_the_page_says_what_to_enter(page, server):
    page.until("return !document.getElementById('empty').hidden")
    assert page.run("return document.getElementById('address').textContent") == f"{server.url}/sensorlogger"


def test_a_walk_being_posted_is_on_the_map(page, server, frame):
    phone = SimulatedPhone(ROUTE, frame, seed=4)
    walker = posted(server, phone, 25)
    page.until("return page.walkers.size === 1 && [...page.walkers.values()][0].pose.message >= 25")
    page.settle()
    # the dot is where the display position is, and near the truth
    x, y = page.dot()
    there = page.run("const p = page.state.map.project(arguments[0]); return [p.x, p.y]", walker["display"])
    assert np.hypot(x - there[0], y - there[1]) < NEAR
    error = np.hypot(*(frame.from_lonlat(np.array([walker["display"]]))[0] - phone.position(24)))
    assert error < 4 * walker["sigma"] + 2.0, "of the estimate"
    # the state in words, the sensors, the accuracy
    text = page.run("return document.getElementById('walkers').textContent")
    for part in (walker["name"], walker["state"], f"± {walker['sigma']:.1f} m", "accelerometer", "gyroscope", "50 Hz"):
        assert part in text
    # path, region and plan are drawn
    page.until("return page.state.map.queryRenderedFeatures({layers: ['current']}).length > 0")
    for layer in ("region", "ground", "walkable"):
        assert page.run(f"return page.state.map.queryRenderedFeatures({{layers: ['{layer}']}}).length"), layer
    assert page.errors == []
    foreign, requests = page.foreign(server.url)
    assert foreign == []
    assert requests > 5, "a control: requests are seen"
    # the cone points along the heading
    cone = page.run(
        "const c = document.querySelector('.cone'); return [c.getAttribute('d'), c.getAttribute('transform')]"
    )
    assert walker["heading_sigma"] < 1.0
    assert cone[0].startswith("M0 0L")
    assert float(cone[1][7:-1]) == pytest.approx(walker["bearing"])
    # a page that is opened later has the path so far
    again = LivePage(page.browser, server.url)
    again.until("return page.walkers.size === 1")
    again.until("return page.state.map.queryRenderedFeatures({layers: ['current']}).length > 0")


def test_a_sensor_that_falls_silent_is_marked(page, server, frame):
    posted(server, SimulatedPhone(ROUTE, frame, seed=4, silent=("gyroscope", 12)), 25)
    page.until("return [...document.querySelectorAll('dd.issue')].some(d => /silent|no data/.test(d.textContent))")


def test_a_server_that_restarts_is_found_again(page, server, frame):
    phone = SimulatedPhone(ROUTE, frame, seed=4)
    posted(server, phone, 15)
    page.until("return page.walkers.size === 1")
    server.process.kill()
    server.process.wait(10)
    page.until("return /trying again/.test(document.getElementById('notice').textContent)")
    server.begin(server.port)
    phone.post(server.url, 15, 20)
    page.until("return document.getElementById('notice').hidden")
    page.until("return [...page.walkers.values()][0].pose.message >= 20")
    assert page.run("return page.walkers.size") == 1


def test_two_phones_have_two_colours_and_a_forgotten_one_disappears(page, server, frame):
    for n in range(2):
        SimulatedPhone(ROUTE, frame, seed=n, session=f"walk-000{n}", name=f"phone{n}").post(server.url, 0, 12)
    page.until("return page.walkers.size === 2 && document.querySelectorAll('.pin').length === 2")
    colours = page.run("return [...document.querySelectorAll('.pin .dot')].map(dot => dot.getAttribute('fill'))")
    assert len(set(colours)) == 2
    request = urllib.request.Request(f"{server.url}/walkers/walk-0000", method="DELETE")
    with contextlib.closing(urllib.request.urlopen(request, timeout=10)):
        pass
    page.until("return page.walkers.size === 1 && document.querySelectorAll('.pin').length === 1")


if os.environ.get("PDR_GRAPH_PICTURES"):

    def test_pictures(browser, server, frame):
        """For people: PDR_GRAPH_PICTURES=FOLDER."""
        server.forget_all()
        phone = SimulatedPhone(ROUTE, frame, seed=4)
        for seconds in (4, 25):
            phone.post(server.url, 0 if seconds == 4 else 4, seconds)
            server.until(lambda walkers, least=seconds: walkers and walkers[0]["message"] >= least)
            for width, height in ((390, 844), (1280, 800)):
                for theme in ("light", "dark"):
                    page = LivePage(browser, server.url, width, height, theme)
                    page.until("return page.walkers.size === 1")
                    page.settle()
                    page.picture(f"{os.environ['PDR_GRAPH_PICTURES']}/{seconds}-{width}-{theme}.png")
