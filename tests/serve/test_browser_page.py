"""The page in headless Chromium: layout, themes, keyboard, floors, frames, and what it asks for. Poses are canned."""

import asyncio
import threading
import time
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import uvicorn
from browser import chromium
from live_page import PATIENCE, LivePage, browser_of
from stand_in_server import QuietHandler, served

from pdr_graph.apps.serve.access import Access
from pdr_graph.apps.serve.application import Server, application
from pdr_graph.apps.serve.publishing import Hub, plan_layers
from pdr_graph.floor.plan_files import Building
from pdr_graph.frames import METRES_PER_DEGREE, Frame

pytestmark = [pytest.mark.timeout(90), pytest.mark.thorough]
MAPS = Path(__file__).parents[2] / "maps"
HOSTILE = '<img src=x onerror="window.hacked=1"><b>A&B</b>'
SMALLEST_TARGET = 40  # [px]
LEAST_CONTRAST = 4.5  # WCAG 2.2 level AA, text
NEAR = 2.0  # [px]


class CannedServer:
    """The application without phones: poses are published by the test."""

    def __init__(self):
        self.hub, self.loop, self.plan = Hub(), None, None
        self.server = Server(self.hub, Access({}))
        config = uvicorn.Config(application(self.server), port=0, log_level="critical", timeout_graceful_shutdown=0)
        self.uvicorn = uvicorn.Server(config)
        self.thread = threading.Thread(target=lambda: asyncio.run(self._serve()), daemon=True)
        self.started = threading.Event()
        self.thread.start()
        assert self.started.wait(PATIENCE)
        self.url = f"http://127.0.0.1:{self.uvicorn.servers[0].sockets[0].getsockname()[1]}"

    def reset(self, plan=None, tiles=None, tokens=None):
        """Forget all walkers, and take another plan, tile server and tokens."""
        self.plan, self.server.plan, self.server.tiles = plan, plan_layers(plan), tiles
        self.server.access = Access(tokens or {})
        done = threading.Event()
        self.loop.call_soon_threadsafe(lambda: ([self.hub.forget(id_) for id_ in list(self.hub.walkers)], done.set()))
        assert done.wait(PATIENCE)

    async def _serve(self):
        self.loop = asyncio.get_running_loop()
        serving = asyncio.create_task(self.uvicorn.serve())
        while not self.uvicorn.started:
            await asyncio.sleep(0.01)
        self.started.set()
        await serving

    def publish(self, name, *arguments):
        self.loop.call_soon_threadsafe(getattr(self.hub, name), *arguments)

    def pose(self, id_="one", x=5.0, y=18.0, **more):
        """Publish a pose at a place [m] of the plan's frame."""
        frame = self.plan.floors[0].frame if self.plan else Frame()
        lon, lat = frame.to_lonlat(np.array([[x, y]]))[0].tolist() if frame.georeferenced else (None, None)
        region = {"probability": 0.9, "semi_major": 3.0, "semi_minor": 2.0, "angle": 0.4}
        pose = {"id": id_, "name": "Pixel 7", "state": "running", "time": time.time(), "message": 1, "x": x, "y": y}
        pose |= {"lon": lon, "lat": lat, "sigma": 1.4, "heading": 0.0, "heading_sigma": 0.2, "floor": "", "modes": []}
        pose |= {"region": region, "display": [x, y] if lon is None else [lon, lat], "bearing": 90.0, "steps": 20}
        pose |= {"notes": [], "missing": [], "issues": [], "health": {"accelerometer": "100 Hz"}, "ignored": {}}
        self.publish("pose", "owner", pose | more)

    def path(self, id_="one", *places, floor=""):
        """Publish a path through places [m] of a frame without georeference, half of it finalised."""
        x, y = np.array(places).T.tolist()
        columns = {"time": [0.0] * len(x), "x": x, "y": y, "lon": None, "lat": None, "floor": [floor] * len(x)}
        half = len(x) // 2
        parts = [{k: v and v[rows] for k, v in columns.items()} for rows in (slice(half), slice(half, None))]
        self.publish("path", {"id": id_, "from": 0, "finalised": parts[0], "current": parts[1]})

    def end(self):
        self.uvicorn.should_exit = True
        self.thread.join(PATIENCE)


@pytest.fixture(scope="module")
def browser():
    with browser_of() as found:
        yield found


@pytest.fixture(scope="module")
def canned():
    server = CannedServer()
    yield server
    server.end()


ARCADE, TWO_FLOORS = (Building.load(MAPS / f"{name}.geojson") for name in ("arcade", "two_floors"))


@pytest.fixture
def arcade(canned):
    """The server with a plan and a walker."""
    canned.reset(ARCADE)
    canned.pose()
    return canned


def shown(browser, server, *arguments):
    page = LivePage(browser, server.url, *arguments)
    page.until("return document.querySelectorAll('.pin').length > 0")
    page.settle()
    return page


def test_the_page_fits_a_phone_in_both_directions_and_a_screen(browser, arcade):
    page = shown(browser, arcade, 320, 568)
    for width, height in ((320, 568), (390, 844), (844, 390), (1280, 800)):
        page.resize(width, height)
        page.until(f"return window.innerWidth === {width}")
        page.settle()
        check_layout(page, width, height)


def check_layout(page, width, height):
    """Everything is in the window, large enough to touch, and not on the walker."""
    assert page.run("return document.documentElement.scrollWidth") <= width
    boxes = page.run(
        "return [...document.querySelectorAll('#panel, #tools, #tools button, .walker')].map(element => {"
        "const r = element.getBoundingClientRect(); return [element.id, r.left, r.top, r.right, r.bottom]; })"
    )
    for name, left, top, right, bottom in boxes:
        assert min(left, top, width - right, height - bottom) >= 0, name
    smallest = page.run(
        "return Math.min(...[...document.querySelectorAll('button')].filter(b => b.offsetParent).map(b => {"
        "const r = b.getBoundingClientRect(); return Math.min(r.width, r.height); }))"
    )
    assert smallest >= SMALLEST_TARGET
    covered = page.run(
        "const p = document.getElementById('panel').getBoundingClientRect(), t = arguments[0];"
        "return t[0] > p.left && t[0] < p.right && t[1] > p.top && t[1] < p.bottom",
        page.dot(),
    )
    assert not covered, "the panel lies on the walker"


def test_on_a_phone_the_details_are_a_tap_away(browser, arcade):
    silent = {"issues": ["gyroscope: silent for 4 s"], "health": {"gyroscope": "silent for 4 s"}}
    arcade.pose(**silent)
    page = shown(browser, arcade, 390, 844)
    arcade.pose(**silent)  # again: after 5 s without a pose the page says "no data"
    page.until("return /▲ gyroscope/.test(document.querySelector('.state').textContent)")
    assert page.run("return document.querySelector('.detail').hidden")
    page.run("document.querySelector('.walker').click()")
    page.until("return !document.querySelector('.detail').hidden")
    assert page.run("return document.querySelector('dd.issue').textContent") == "silent for 4 s"
    page.run("document.querySelector('.walker').click()")
    page.until("return document.querySelector('.detail').hidden")


def luminance(colour):
    """Relative luminance of "rgb(r, g, b)" by WCAG."""
    channels = np.array([float(part) for part in colour[colour.index("(") + 1 : -1].split(",")[:3]]) / 255
    linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    return float(linear @ (0.2126, 0.7152, 0.0722))


def test_texts_are_legible_in_both_themes(browser, arcade):
    arcade.pose(issues=["gyroscope: silent for 4 s"], health={"accelerometer": "100 Hz", "gyroscope": "silent for 4 s"})
    page = shown(browser, arcade, 390, 844)
    page.run("document.querySelector('.walker').click()")
    page.until("return document.querySelector('.detail li')")
    for theme in ("light", "dark"):
        page.dress(theme)
        page.until(f"return matchMedia('(prefers-color-scheme: {theme})').matches")
        check_contrast(page, theme)


def check_contrast(page, theme):
    """Texts have enough contrast, and the map has the theme."""
    found = page.run(
        """
        const ground = element => { const c = getComputedStyle(element).backgroundColor;
            return /, 0\\)$/.test(c) ? ground(element.parentElement) : c; };
        return [...document.querySelectorAll('.name, .sigma, .state, dt, dd, .detail li, #tools button')]
            .filter(e => e.offsetParent).map(e => [e.className, getComputedStyle(e).color, ground(e)]);
        """
    )
    assert len(found) > 8
    for name, text, ground in found:
        light, dark = sorted((luminance(text), luminance(ground)), reverse=True)
        assert (light + 0.05) / (dark + 0.05) > LEAST_CONTRAST, name
    light = "true" if theme == "light" else "false"
    outside = "parseInt(page.state.map.getPaintProperty('outside', 'background-color').slice(1, 3), 16)"
    page.until(f"return ({outside} > 128) === {light}")


def test_the_keyboard_does_all(browser, arcade):
    page = shown(browser, arcade)
    reached = set()
    for _ in range(12):
        page.press("Tab")
        reached.add(page.run("const e = document.activeElement; return e.id || e.className"))
    assert {"closer", "farther", "follow", "everything", "walker"} <= reached
    zoom = page.run("return page.state.map.getZoom()")
    page.press("+")
    page.until(f"return page.state.map.getZoom() > {zoom + 0.5} && !page.state.map.isMoving()")
    page.press("f")
    page.until("return document.getElementById('follow').getAttribute('aria-pressed') === 'false'")
    page.press("0")
    page.until(f"return Math.abs(page.state.map.getZoom() - {zoom}) < 0.3")
    page.press("f")
    page.until("return page.state.following")


def test_a_key_chooses_a_walker_and_a_forgotten_one_disappears(browser, canned):
    canned.reset(ARCADE)
    canned.pose("one", name="first")
    canned.pose("two", x=30.0, name="second")
    page = shown(browser, canned)
    page.until("return page.walkers.size === 2")
    for key, name in (("2", "second"), ("1", "first")):
        page.press(key)
        page.until(f"return document.querySelector('[aria-expanded=true] .name')?.textContent === '{name}'")
        page.until(f"return document.querySelector('.chosen .name')?.textContent === '{name}'")
    colours = page.run("return [...document.querySelectorAll('.pin .dot')].map(dot => dot.getAttribute('fill'))")
    assert len(set(colours)) == 2
    canned.publish("forget", "two")
    page.until("return page.walkers.size === 1 && document.querySelectorAll('.pin').length === 1")


def test_the_map_follows_its_walker_until_it_is_dragged(browser, arcade):
    page = shown(browser, arcade)
    page.run("page.state.map.jumpTo({center: [135.001, 35.001], zoom: 21})")
    arcade.pose(x=6.0)
    inside = "const p = page.state.map.project([...page.walkers.values()][0].at);"
    page.until(f"{inside} return p.x > 0 && p.x < 800 && p.y > 0 && p.y < 600")
    page.run("page.state.map.fire('dragstart')")
    page.until("return document.getElementById('follow').getAttribute('aria-pressed') === 'false'")
    page.run("document.getElementById('follow').click()")
    page.until("return page.state.following")


def test_floors_are_shown_one_at_a_time(browser, canned):
    canned.reset(TWO_FLOORS)
    canned.pose(floor="1")
    page = shown(browser, canned)
    rooms = "return page.state.map.queryRenderedFeatures({layers: ['room', 'walkable']}).map(f => f.properties.floor)"
    checked = "return document.querySelector('#floors [aria-checked=true]').textContent"
    page.until(f"{rooms}.length")
    page.until("return new Set(" + rooms.removeprefix("return ") + ").size === 1")
    assert set(page.run(rooms)) == {"1"}
    assert page.run("return [...document.getElementById('floors').children].map(b => b.textContent)") == ["2", "1"]
    page.press("PageUp")
    page.until(f"{checked} === '2'")
    page.until("return document.querySelector('.pin.elsewhere')")
    page.until("return " + rooms.removeprefix("return ") + ".every(floor => floor === '2')")
    page.until(f"{rooms}.length")
    page.run("document.querySelectorAll('#floors button')[1].click()")
    assert page.run(checked) == "1"
    canned.pose(floor="2")  # the walker climbs the stairs: the map follows
    page.until(f"{checked} === '2'")
    page.run("document.querySelector('#floors [aria-checked=true]').focus()")
    page.press("ArrowDown")
    page.until(f"{checked} === '1'")


def test_a_plan_without_georeference_is_drawn_in_metres(browser, canned):
    floors = ARCADE.floors
    canned.reset(Building.of(*[replace(floor, frame=Frame()) for floor in floors]))
    canned.pose(x=10.0, y=20.0)
    canned.path("one", (5.0, 18.0), (7.0, 18.0), (8.0, 19.0), (10.0, 20.0))
    page = shown(browser, canned)
    lonlat = (np.array([10.0, 20.0]) / METRES_PER_DEGREE).tolist()
    there = page.run("const p = page.state.map.project(arguments[0]); return [p.x, p.y]", lonlat)
    assert np.hypot(*np.subtract(page.dot(), there)) < NEAR
    for layer in ("ground", "walkable", "finalised", "current"):
        page.until(f"return page.state.map.queryRenderedFeatures({{layers: ['{layer}']}}).length > 0")


def test_the_ways_that_remain_are_faint_and_the_heading_is_not_shown(browser, arcade):
    region = {"probability": 0.9, "semi_major": 1.5, "semi_minor": 1.0, "angle": 0.0}
    modes = [{"probability": p, "x": x, "y": 18.0, "lon": 135.00005, "lat": 35.00016, "heading": 0.0, "region": region}
             for p, x in ((0.6, 5.0), (0.39, 8.0), (0.01, 9.0))]  # fmt: skip
    arcade.pose(state="initialising heading", modes=modes)
    page = shown(browser, arcade)
    page.until("return [...page.walkers.values()][0].regions().length === 3")  # two ways and the whole
    weights = page.run("return [...page.walkers.values()][0].regions().map(f => f.properties.weight)")
    assert weights[1] < weights[0] < weights[2]
    assert not page.run("return document.querySelector('.cone').getAttribute('d')")
    # Again: after 5 s without a pose the page says "no data"
    arcade.pose(state="initialising heading", modes=modes)
    page.until("return /initialising heading/.test(document.querySelector('.state').textContent)")


def test_before_the_first_position_the_state_is_shown_and_a_grid_of_ten_metres(browser, canned):
    canned.reset()
    unknown = ("x", "y", "lon", "lat", "sigma", "heading", "heading_sigma", "region", "display", "bearing")
    canned.pose(**dict.fromkeys(unknown), state="waiting")
    page = LivePage(browser, canned.url)
    page.until("return document.querySelector('.state')?.textContent === 'waiting'")
    canned.pose()
    page.until("return page.state.map.queryRenderedFeatures({layers: ['grid']}).length > 0")
    assert page.errors == []


def test_a_name_is_text(browser, arcade):
    arcade.pose(name=HOSTILE, issues=[HOSTILE], health={HOSTILE: HOSTILE}, missing=[HOSTILE])
    page = shown(browser, arcade)
    page.until("return document.querySelector('.name').textContent.includes('onerror')")
    assert page.run("return window.hacked") is None
    assert page.run("return document.querySelectorAll('#panel img, .pin img').length") == 0


def test_a_walker_without_news_is_stale_and_its_age_is_told(browser, arcade):
    arcade.pose(time=time.time() - 300)
    page = shown(browser, arcade)
    page.until("return document.querySelector('.state').textContent === 'no data for 5 min'")
    page.until("return +getComputedStyle(document.querySelector('.pin.stale svg')).opacity < 0.6")
    arcade.pose(message=2)
    page.until("return !document.querySelector('.pin.stale')")


def test_finished_walks_stand_behind_those_under_way(browser, canned):
    canned.reset(ARCADE)
    canned.pose("old", name="old", state="finished")
    canned.pose("new", name="new", x=20.0)
    page = shown(browser, canned)
    page.until("return document.querySelector('[aria-expanded=true] .name')?.textContent === 'new'")
    page.until("return document.querySelectorAll('.pin').length === 2")
    tops = page.run("return ['old', 'new'].map(name => [...document.querySelectorAll('.name')]"
                    ".find(e => e.textContent === name).getBoundingClientRect().top)")  # fmt: skip
    assert tops[1] < tops[0]
    assert page.run("return [...page.walkers.values()].map(w => w.regions().length)") == [0, 1]


@pytest.mark.parametrize("token", ["", "0123456789abcdef"], ids=["open", "guarded"])
def test_without_a_phone_the_page_says_what_to_enter(browser, canned, token):
    """And the token of a guarded server is shown nowhere, and in no history."""
    canned.reset(tokens={"owner": token} if token else {})
    page = LivePage(browser, f"{canned.url}/?token={token}" if token else canned.url)
    page.until("return !document.getElementById('empty').hidden")
    expected = f"{canned.url}/sensorlogger" + ("?token=…" if token else "")
    assert page.run("return document.getElementById('address').textContent") == expected
    if token:
        assert page.run("return location.search") == ""
        assert token not in page.run("return document.body.textContent + document.cookie")
    assert page.errors == []


@contextmanager
def tile_server():
    """A tile server, which lists the paths that were asked for; its tiles are no pictures."""
    asked = []

    class Handler(QuietHandler):
        def do_GET(self):
            asked.append(self.path)
            self.send_response(204)
            self.send_header("Access-Control-Allow-Origin", "*")
            self.end_headers()

    with served(Handler) as server:
        yield f"http://127.0.0.1:{server.server_port}", asked


def test_tiles_come_from_the_chosen_server_and_nothing_else_from_outside(browser, canned):
    with tile_server() as (tiles, asked):
        canned.reset(ARCADE, tiles=f"{tiles}/{{z}}/{{x}}/{{y}}.png")
        canned.pose()
        page = shown(browser, canned)
        page.until("return page.state.map.getLayer('tiles') !== undefined")
        foreign, _ = page.foreign(canned.url, tiles)
        assert foreign == []
        assert "tiles: 127.0.0.1" in page.run("return document.querySelector('.maplibregl-ctrl-attrib').textContent")
        assert asked


def test_the_policy_allows_no_request_to_outside(browser, arcade):
    """Control: what a script of the page would ask of another host is refused."""
    page = shown(browser, arcade)
    page.run(
        "window.refused = 0; document.addEventListener('securitypolicyviolation', () => { window.refused += 1; });"
    )
    page.run(
        "fetch('https://example.org/').catch(() => 0); const i = new Image(); i.src = 'https://example.org/x.png';"
    )
    page.until("return window.refused === 2")


def test_without_webgl_the_list_works(arcade):
    with chromium(offline=False, arguments=("--disable-3d-apis",)) as browser:
        browser.set_page_load_timeout(PATIENCE)
        page = LivePage(browser, arcade.url, 390, 844)
        page.until("return document.querySelectorAll('.walker').length === 1")
        assert "no WebGL" in page.run("return document.getElementById('notice').textContent")
        assert page.errors == []
