"""The page in headless Chromium: a walk as it is posted; then layout, themes, keyboard, floors with canned poses."""

import asyncio
import json
import socket
import threading
import time
from contextlib import asynccontextmanager, contextmanager
from dataclasses import replace

import numpy as np
import pytest
import simulated
import uvicorn
from browser import chromium
from live_page import PATIENCE, SOFTWARE_GL, LivePage
from plans import MAPS
from running_server import RunningServer
from stand_in_server import QuietHandler, served
from streamed_walks import bodies

from pdr_graph.apps.serve.access import Access
from pdr_graph.apps.serve.application import Server, application
from pdr_graph.apps.serve.publishing import Hub, nowhere, path_columns, plan_layers
from pdr_graph.floor.plan_files import Building
from pdr_graph.frames import METRES_PER_DEGREE, Frame
from pdr_graph.types import Trajectory

pytestmark = [pytest.mark.timeout(120), pytest.mark.thorough]
MAP = MAPS / "arcade.geojson"
ARCADE, TWO_FLOORS = (Building.load(MAPS / f"{name}.geojson") for name in ("arcade", "two_floors"))
FRAME = ARCADE.floors[0].frame
WALK = simulated.walk_along(np.array([(2.5, 18.0), (6.8, 18.2), (6.8, 27.8), (27.6, 27.6)]), seed=4)
HOSTILE = '<img src=x onerror="window.hacked=1"><b>A&B</b>'
SILENT = {"issues": ["gyroscope: silent for 4 s"], "health": {"accelerometer": "100 Hz", "gyroscope": "silent for 4 s"}}
SMALLEST_TARGET = 40  # [px]
LEAST_CONTRAST = 4.5  # WCAG 2.2 level AA, text
FIRST = "[...page.walkers.values()][0]"
FOLLOWING = "return document.getElementById('follow').getAttribute('aria-pressed') === '{}'"


@pytest.fixture(scope="module")
def browser():
    """Chromium that reaches this machine alone."""
    with chromium(offline=False, arguments=SOFTWARE_GL) as found:
        yield found


# A walk as it is posted


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
    page.until(f"return page.walkers.size === 1 && {FIRST}.pose.message >= 25")
    page.settle()
    # the dot is where the display position is, and near the truth
    assert page.dot_is_at(walker["display"])
    truth = WALK.position[np.searchsorted(WALK.time, 25) - 1]
    error = np.hypot(*(FRAME.from_lonlat(np.array([walker["display"]]))[0] - truth))
    assert error < 4 * walker["sigma"] + 2.0, "of the estimate"
    # the state in words, the sensors, the accuracy
    text = page.text("#walkers")
    for part in (walker["name"], walker["state"], f"± {walker['sigma']:.1f} m", "accelerometer", "gyroscope", "50 Hz"):
        assert part in text
    page.drawn("current", "region", "ground", "walkable")
    assert page.errors == []
    foreign, requests = page.foreign(server.url)
    assert foreign == []
    assert requests > 5, "a control: requests are seen"
    # the cone points along the heading
    shape, turned = page.run(
        "const c = document.querySelector('.cone'); return ['d', 'transform'].map(a => c.getAttribute(a))"
    )
    assert walker["heading_sigma"] < 1.0
    assert shape.startswith("M0 0L")
    assert float(turned[7:-1]) == pytest.approx(walker["bearing"])
    # a page that is opened later has the path so far
    again = LivePage(page.browser, server.url)
    again.shows(1)
    again.drawn("current")


# What another site's page makes the browser ask for; {n} counts the devices
ATTACKS = """<!doctype html><title>another site</title>
<img src="{url}1"><img src="{url}2" referrerpolicy="no-referrer"><iframe src="{url}3"></iframe>
<script src="{url}4"></script><link rel="prefetch" href="{url}5"><link rel="stylesheet" href="{url}6">
<img src="/redirected?{url}7"><video src="{url}8"></video><object data="{url}9"></object>
<form id="form" target="there" action="{target}/owntracks" method="post" enctype="text/plain">
<input name='{{"_type":"location","lat":1,"lon":2,"tst":{now},"tid":"' value='ev"}}'></form>
<iframe name="there"></iframe>
<script>
  document.getElementById('form').submit();
  fetch("{url}10", {{mode: "no-cors", referrerPolicy: "no-referrer"}}).catch(() => 0);
  const body = '{{"_type":"location","lat":1,"lon":2,"tst":{now}}}';
  fetch("{target}/owntracks", {{mode: "no-cors", method: "POST", body}}).catch(() => 0);
  navigator.sendBeacon("{target}/osmand", "id=ev11&lat=1&lon=2&timestamp={now}");
  for (let n = 0; n < 210; n++) {{
    const frame = document.createElement('iframe');
    frame.src = "{url}" + (100 + n); document.body.append(frame);
  }}
</script>"""


@pytest.mark.parametrize("host", ["127.0.0.1", "other.test"])
def test_a_page_beside_the_server_stores_nothing(browser, server, host):
    """The page of another port, and of another site: to a server of this machine, which has no token."""
    for walker in server.walkers():
        server.ask(f"/walkers/{walker['id']}", method="DELETE")
    now = round(time.time())
    url = f"{server.url}/osmand?lat=1&lon=2&timestamp={now}&id=ev"
    page = ATTACKS.format(url=url, target=server.url, now=now).encode()

    class Site(QuietHandler):
        def do_GET(self):
            _, redirected, target = self.path.partition("/redirected?")
            self.send_response(302 if redirected else 200)
            self.send_header("Location" if redirected else "Content-Type", target or "text/html")
            self.end_headers()
            self.wfile.write(b"" if redirected else page)

    with served(Site) as site:
        browser.get_log("performance")
        browser.get(f"http://{host}:{site.server_port}/")
        end, statuses = time.monotonic() + PATIENCE, list[int]()
        while len(statuses) < 212 and time.monotonic() < end:
            said = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
            answers = [m["params"]["response"] for m in said if m["method"] == "Network.responseReceived"]
            statuses += [answer["status"] for answer in answers if answer["url"].startswith(server.url)]
            time.sleep(0.1)
        browser.get("about:blank")
    assert len(statuses) >= 212, "the frames and some of the others, a control"
    assert set(statuses) == {403}
    assert server.walkers() == []
    assert server.ask(f"/osmand?lat=1&lon=2&timestamp={now}&id=phone")[0] == 200, "the owner's next walk"
    assert [walker["name"] for walker in server.walkers()] == ["phone"]


def test_a_server_that_restarts_is_found_again(page, server):
    walk = messages()
    server.post(*walk[:15])
    page.shows(1)
    server.kill()
    page.until("return /trying again/.test(document.getElementById('notice').textContent)")
    server.start(server.port)
    server.post(*walk[15:20])
    page.until("return document.getElementById('notice').hidden")
    page.until(f"return {FIRST}.pose.message >= 20")
    page.shows(1)


# Canned poses


class CannedServer:
    """The application without phones: poses are published by the test."""

    def __init__(self):
        self.hub, self.plan, self.started = Hub(), None, threading.Event()
        self.server = Server(self.hub, Access({}))
        config = uvicorn.Config(
            application(self.server, self._lifespan), log_level="critical", timeout_graceful_shutdown=0
        )
        self.uvicorn, listening = uvicorn.Server(config), socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{listening.getsockname()[1]}"
        self.thread = threading.Thread(target=self.uvicorn.run, args=([listening],), daemon=True)
        self.thread.start()
        assert self.started.wait(PATIENCE)

    @asynccontextmanager
    async def _lifespan(self, _):
        self.loop = asyncio.get_running_loop()
        self.started.set()
        yield

    def end(self):
        self.uvicorn.should_exit = True
        self.thread.join(PATIENCE)

    def reset(self, plan=None, tiles=None, tokens=None):
        """Forget all walkers, and take another plan, tile server and tokens."""
        self.plan, self.server.plan, self.server.tiles = plan, plan_layers(plan), tiles
        self.server.access = Access(tokens or {})
        done = threading.Event()
        self.loop.call_soon_threadsafe(lambda: ([self.hub.forget(id_) for id_ in list(self.hub.walkers)], done.set()))
        assert done.wait(PATIENCE)

    def publish(self, name, *arguments):
        self.loop.call_soon_threadsafe(getattr(self.hub, name), *arguments)

    def pose(self, id_="one", x=5.0, y=18.0, **more):
        """Publish a pose at a place [m] of the plan's frame; nowhere without x."""
        pose = {"id": id_, "name": "Pixel 7", "state": "running", "message": 1, "steps": 20, **nowhere()}
        pose |= {"notes": [], "missing": [], "issues": [], "health": {"accelerometer": "100 Hz"}, "ignored": {}}
        if x is not None:
            frame = self.plan.floors[0].frame if self.plan else Frame()
            lon, lat = frame.to_lonlat(np.array([[x, y]]))[0].tolist() if frame.georeferenced else (None, None)
            region = {"probability": 0.9, "semi_major": 3.0, "semi_minor": 2.0, "angle": 0.4}
            pose |= {"time": time.time(), "x": x, "y": y, "lon": lon, "lat": lat, "sigma": 1.4, "region": region}
            pose |= {"heading": 0.0, "heading_sigma": 0.2, "bearing": 90.0}
            pose |= {"display": [x, y] if lon is None else [lon, lat]}
        self.publish("pose", "owner", pose | more)


@pytest.fixture(scope="module")
def canned():
    server = CannedServer()
    yield server
    server.end()


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
        "return [...document.querySelectorAll('#panel, #tools, #tools button, .walker, button')]"
        ".filter(e => e.offsetParent || e.matches('#panel, #tools')).map(e => { const r = e.getBoundingClientRect();"
        "return [e.id, e.tagName, r.left, r.top, r.right, r.bottom]; })"
    )
    inside = {"panel", "tools", "closer", "farther", "follow", "everything"}
    assert inside <= {name for name, *_ in boxes}
    for name, tag, left, top, right, bottom in boxes:
        assert min(left, top, width - right, height - bottom) >= 0, name
        if tag == "BUTTON":
            assert min(right - left, bottom - top) >= SMALLEST_TARGET, name
        if name == "panel":
            x, y = page.dot()
            assert not (left < x < right and top < y < bottom), "the panel lies on the walker"


def test_on_a_phone_the_details_are_a_tap_away(browser, arcade):
    arcade.pose(**SILENT)
    page = shown(browser, arcade, 390, 844)
    arcade.pose(**SILENT)  # again: after 5 s without a pose the page says "no data"
    page.until("return /▲ gyroscope/.test(document.querySelector('.state').textContent)")
    for hidden in ("true", "false", "true"):
        page.until(f"return document.querySelector('.detail').hidden === {hidden}")
        page.click(".walker")
    assert page.text("dd.issue") == "silent for 4 s"


def luminance(colour):
    """Relative luminance of "rgb(r, g, b)" by WCAG."""
    channels = np.array([float(part) for part in colour[colour.index("(") + 1 : -1].split(",")[:3]]) / 255
    linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    return float(linear @ (0.2126, 0.7152, 0.0722))


def test_texts_are_legible_in_both_themes(browser, arcade):
    arcade.pose(**SILENT)
    page = shown(browser, arcade, 390, 844)
    page.click(".walker")
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
    page.until(FOLLOWING.format("false"))
    page.press("0")
    page.until(f"return Math.abs(page.state.map.getZoom() - {zoom}) < 0.3")
    page.press("f")
    page.until(FOLLOWING.format("true"))


def test_a_key_chooses_a_walker_and_a_forgotten_one_disappears(browser, canned):
    canned.reset(ARCADE)
    canned.pose("one", name="first")
    canned.pose("two", x=30.0, name="second")
    page = shown(browser, canned)
    page.shows(2)
    for key, name in (("2", "second"), ("1", "first")):
        page.press(key)
        page.says("[aria-expanded=true] .name", name)
        page.says(".chosen .name", name)
    colours = page.run("return [...document.querySelectorAll('.pin .dot')].map(dot => dot.getAttribute('fill'))")
    assert len(set(colours)) == 2
    canned.publish("forget", "two")
    page.shows(1)


def test_the_map_follows_its_walker_until_it_is_dragged(browser, arcade):
    page = shown(browser, arcade)
    page.run("page.state.map.jumpTo({center: [135.001, 35.001], zoom: 21})")
    arcade.pose(x=6.0)
    page.until(f"const p = page.state.map.project({FIRST}.at); return p.x > 0 && p.x < 800 && p.y > 0 && p.y < 600")
    page.run("page.state.map.fire('dragstart')")
    page.until(FOLLOWING.format("false"))
    page.click("#follow")
    page.until(FOLLOWING.format("true"))


def test_floors_are_shown_one_at_a_time(browser, canned):
    canned.reset(TWO_FLOORS)
    canned.pose(floor="1")
    page = shown(browser, canned)
    rooms = "page.state.map.queryRenderedFeatures({layers: ['room', 'walkable']}).map(f => f.properties.floor)"
    checked = "#floors [aria-checked=true]"
    page.until(f"return String([...new Set({rooms})]) === '1'")
    assert page.run("return [...document.getElementById('floors').children].map(b => b.textContent)") == ["2", "1"]
    page.press("PageUp")
    page.says(checked, "2")
    page.until("return document.querySelector('.pin.elsewhere')")
    page.until(f"return String([...new Set({rooms})]) === '2'")
    page.click("#floors button:last-child")
    page.says(checked, "1")
    canned.pose(floor="2")  # the walker climbs the stairs: the map follows
    page.says(checked, "2")
    page.run(f"document.querySelector('{checked}').focus()")
    page.press("ArrowDown")
    page.says(checked, "1")


def test_a_plan_without_georeference_is_drawn_in_metres(browser, canned):
    canned.reset(Building.of(*[replace(floor, frame=Frame()) for floor in ARCADE.floors]))
    canned.pose(x=10.0, y=20.0)
    places = np.array([[(5.0, 18.0), (7.0, 18.0)], [(8.0, 19.0), (10.0, 20.0)]])
    parts = [path_columns(Trajectory(np.zeros(2), part, np.zeros(2), ("", "")), None, 0.0) for part in places]
    canned.publish("path", {"id": "one", "from": 0, "finalised": parts[0], "current": parts[1]})
    page = shown(browser, canned)
    assert page.dot_is_at((np.array([10.0, 20.0]) / METRES_PER_DEGREE).tolist(), 2.0)
    page.drawn("ground", "walkable", "finalised", "current")


def test_the_ways_that_remain_are_faint_and_the_heading_is_not_shown(browser, arcade):
    region = {"probability": 0.9, "semi_major": 1.5, "semi_minor": 1.0, "angle": 0.0}
    way = {"y": 18.0, "lon": 135.00005, "lat": 35.00016, "heading": 0.0, "region": region}
    modes = [way | {"probability": p, "x": x} for p, x in ((0.6, 5.0), (0.39, 8.0), (0.01, 9.0))]
    arcade.pose(state="initialising heading", modes=modes)
    page = shown(browser, arcade)
    page.until(f"return {FIRST}.regions().length === 3")  # two ways and the whole
    weights = page.run(f"return {FIRST}.regions().map(f => f.properties.weight)")
    assert weights[1] < weights[0] < weights[2]
    assert not page.run("return document.querySelector('.cone').getAttribute('d')")
    arcade.pose(state="initialising heading", modes=modes)  # again: after 5 s without a pose the page says "no data"
    page.until("return /initialising heading/.test(document.querySelector('.state').textContent)")


def test_before_the_first_position_the_state_is_shown_and_a_grid_of_ten_metres(browser, canned):
    canned.reset()
    canned.pose(x=None, state="waiting")
    page = LivePage(browser, canned.url)
    page.says(".state", "waiting")
    canned.pose()
    page.drawn("grid")
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
    page.says(".state", "no data for 5 min")
    page.until("return +getComputedStyle(document.querySelector('.pin.stale svg')).opacity < 0.6")
    arcade.pose(message=2)
    page.until("return !document.querySelector('.pin.stale')")


def test_finished_walks_stand_behind_those_under_way(browser, canned):
    canned.reset(ARCADE)
    canned.pose("old", name="old", state="finished")
    canned.pose("new", name="new", x=20.0)
    page = shown(browser, canned)
    page.shows(2)
    page.says("[aria-expanded=true] .name", "new")
    tops = page.run(
        "return [...document.querySelectorAll('.name')].map(e => [e.getBoundingClientRect().top, e.textContent])"
    )
    assert next(name for _, name in sorted(tops) if name in ("old", "new")) == "new"
    assert page.run("return [...page.walkers.values()].map(w => w.regions().length)") == [0, 1]


@pytest.mark.parametrize("token", ["", "0123456789abcdef"], ids=["open", "guarded"])
def test_without_a_phone_the_page_says_what_to_enter(browser, canned, token):
    """And the token of a guarded server is shown nowhere, and in no history."""
    canned.reset(tokens={"owner": token} if token else {})
    page = LivePage(browser, f"{canned.url}/?token={token}" if token else canned.url)
    page.until("return !document.getElementById('empty').hidden")
    assert page.text("#address") == f"{canned.url}/sensorlogger" + ("?token=…" if token else "")
    assert page.run("return location.search") == ""
    assert not token or token not in page.run("return document.body.textContent + document.cookie")
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
        assert page.foreign(canned.url, tiles)[0] == []
        assert "tiles: 127.0.0.1" in page.text(".maplibregl-ctrl-attrib")
        assert asked


def test_the_policy_allows_no_request_to_outside(browser, arcade):
    """Control: what a script of the page would ask of another host is refused."""
    page = shown(browser, arcade)
    page.run(
        "window.refused = 0; document.addEventListener('securitypolicyviolation', () => { window.refused += 1; });"
        "fetch('https://example.org/').catch(() => 0); const i = new Image(); i.src = 'https://example.org/x.png';"
    )
    page.until("return window.refused === 2")


def test_without_webgl_the_list_works(arcade):
    with chromium(offline=False, arguments=("--disable-3d-apis",)) as browser:
        page = LivePage(browser, arcade.url, 390, 844)
        page.until("return document.querySelectorAll('.walker').length === 1")
        assert "no WebGL" in page.text("#notice")
        assert page.errors == []
