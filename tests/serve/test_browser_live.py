"""The page in headless Chromium, with the real server and a walk that is posted as the app does."""

import time
from dataclasses import replace

import numpy as np
import pytest
import simulated
from live_page import LivePage, browser_of
from plans import MAPS
from running_server import RunningServer
from streamed_walks import bodies

from pdr_graph.floor.plan_files import FloorPlan

pytestmark = [pytest.mark.timeout(120), pytest.mark.thorough]
MAP = MAPS / "arcade.geojson"
FRAME = FloorPlan.load(MAP).frame
NEAR = 3.0  # [px]
WALK = simulated.walk_along(np.array([(2.5, 18.0), (6.8, 18.2), (6.8, 27.8), (27.6, 27.6)]), seed=4)


@pytest.fixture(scope="module")
def browser():
    with browser_of() as found:
        yield found


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    running = RunningServer(tmp_path_factory.mktemp("server") / "out", "--map", str(MAP))
    yield running
    running.kill()


@pytest.fixture
def page(browser, server):
    for walker in server.walkers():
        server.ask(f"/walkers/{walker['id']}", method="DELETE")
    return LivePage(browser, server.url)


def messages():
    """The walk in the plan's frame, a message a second, by a clock that is right."""
    recording = simulated.with_receiver(WALK, every=250)
    fixes = replace(recording.fixes, position=FRAME.to_lonlat(WALK.position[::250]))
    return bodies(replace(recording, fixes=fixes, epoch=time.time() - WALK.time[-1]))


def test_a_walk_being_posted_is_on_the_map(page, server):
    server.post(*messages()[:25])
    walker = server.published(25)
    page.until("return page.walkers.size === 1 && [...page.walkers.values()][0].pose.message >= 25")
    page.settle()
    # the dot is where the display position is, and near the truth
    there = page.run("const p = page.state.map.project(arguments[0]); return [p.x, p.y]", walker["display"])
    assert np.hypot(*np.subtract(page.dot(), there)) < NEAR
    truth = WALK.position[np.searchsorted(WALK.time, 25) - 1]
    error = np.hypot(*(FRAME.from_lonlat(np.array([walker["display"]]))[0] - truth))
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
    shape, turned = (
        page.run(f"return document.querySelector('.cone').getAttribute('{a}')") for a in ("d", "transform")
    )
    assert walker["heading_sigma"] < 1.0
    assert shape.startswith("M0 0L")
    assert float(turned[7:-1]) == pytest.approx(walker["bearing"])
    # a page that is opened later has the path so far
    again = LivePage(page.browser, server.url)
    again.until("return page.walkers.size === 1")
    again.until("return page.state.map.queryRenderedFeatures({layers: ['current']}).length > 0")


def test_a_server_that_restarts_is_found_again(page, server):
    walk = messages()
    server.post(*walk[:15])
    page.until("return page.walkers.size === 1")
    server.kill()
    page.until("return /trying again/.test(document.getElementById('notice').textContent)")
    server.start(server.port)
    server.post(*walk[15:20])
    page.until("return document.getElementById('notice').hidden")
    page.until("return [...page.walkers.values()][0].pose.message >= 20")
    assert page.run("return page.walkers.size") == 1
