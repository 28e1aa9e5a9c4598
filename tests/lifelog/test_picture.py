"""Pictures and pages of days and periods: every part is on a map, nothing is fetched unasked, files are private."""

import http.server
import io
import re
import stat
import threading
from collections import defaultdict
from dataclasses import replace
from datetime import date
from html import unescape
from xml.etree import ElementTree

import commands
import numpy as np
import pytest
from browser import ShownPage, chromium
from hypothesis import given, settings
from hypothesis import strategies as st
from made_days import HERE, MIDNIGHT, NOWHERE, day, outing, overview_of, stay
from matplotlib.image import imsave

from pdr_graph.apps.lifelog import maps
from pdr_graph.apps.lifelog.day import ACTIVITIES, GAP, STANDING, VEHICLE, WALKING, rows_of
from pdr_graph.apps.lifelog.local_time import period_of
from pdr_graph.apps.lifelog.maps import (
    ENLARGED_SHARE,
    MercatorFrame,
    TileServer,
    check_template,
    floor_of,
    panels,
    tiles,
)
from pdr_graph.apps.lifelog.overview import overview
from pdr_graph.apps.lifelog.overview_page import page
from pdr_graph.apps.lifelog.picture import COLOURS, GROUPS, HEAT, blocks, offset_text, pictures
from pdr_graph.apps.lifelog.show import Choice, show
from pdr_graph.apps.lifelog.store import Store
from pdr_graph.apps.lifelog.timeline import STAY, TimelineEntry
from pdr_graph.errors import InputError
from pdr_graph.geometry import length_along

MALL = "maps/mall.geojson"
HOUR = 3600.0
STROLL = [(WALKING, 300.0, 0.0), (WALKING, 300.0, 1.5)]
FILES = {"busy.csv", "dwell.csv", "overview.html", "days.csv", "places.csv", "visits.csv", "hours.csv"}
DAY_FILES = {"timeline.csv", "day.geojson"}
SVG = "{http://www.w3.org/2000/svg}"
DAY = {"day": "2024-05-16"}


@pytest.fixture(autouse=True)
def no_network(monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("a request")

    monkeypatch.setattr(maps, "ask", refuse)


def drawn(chosen, template=""):
    """The parts of the picture of an overview as elements of SVG, and the line of a failure."""
    server = TileServer(template)
    return [ElementTree.fromstring(part.svg) for part in pictures(chosen, server)], server.failure


def maps_of(parts):
    """The maps among the parts of a picture."""
    return [part for part in parts if part.get("aria-label") == "map"]


def chosen_from(log, *persons, place="", **period):
    return show(log, Choice(persons, period_of(**period), place), write=False).overview


def indoors(floor, epoch, start=(20.0, 20.0)):
    """A walk of some metres on a plan."""
    return outing([(WALKING, 20.0, 0.0)], epoch=epoch, plan=MALL, floor=floor, start=start)


def is_drawn(overview):
    """True for a picture of well-formed SVG with finite numbers, not too high."""
    parts, failure = drawn(overview)
    text = b"".join(map(ElementTree.tostring, parts))
    height = sum(float(part.get("viewBox").split()[3]) for part in parts)
    return b"<rect" in text and b"nan" not in text and not failure and height < 3000


@pytest.mark.parametrize(
    ("persons", "choice"),
    [
        (("Ada",), {"week": "2024-W20"}),
        (("Ada",), {"place": "1"}),
        (("Ada", "Ben"), DAY),
        (("Ada", "Ben"), {"month": "2024-05"}),
        (("Ada", "Ben"), {"place": "1", "year": "2024"}),
    ],
    ids=str,
)
def test_every_period_can_be_drawn(month_log, choice, persons):
    assert is_drawn(chosen_from(month_log, *persons, **choice))


@pytest.mark.parametrize(
    "made",
    [
        day(),
        day(outing([(WALKING, 1.0, 0.0)])),
        day(replace(outing(STROLL), segments=())),
        day(outing(STROLL, frame=NOWHERE), outing(STROLL, epoch=MIDNIGHT + 20 * HOUR)),
        day(outing([(STANDING, 40_000.0, 0.0)], stays=[stay(0, 40_000, facing=[("店" * 40, 0.5)])])),
        day(indoors("1", MIDNIGHT), outing([(VEHICLE, 3000.0, 0.0)], epoch=MIDNIGHT + HOUR)),
        day(replace(indoors("1", MIDNIGHT), plan="nowhere.geojson")),
        day(replace(outing(STROLL), trajectory=replace(outing(STROLL).trajectory, covariance=None))),
        day(*(outing(STROLL, epoch=MIDNIGHT + n * HOUR, start=(n * 5000.0, 0.0)) for n in range(9))),
    ],
    ids=["nothing", "a step", "one fix", "nowhere", "a name", "a plan and a ride", "no plan", "no covariance", "many"],
)
def test_every_day_can_be_drawn(made):
    assert is_drawn(overview_of(made))


def test_walks_far_apart_have_enlarged_maps_and_walks_near_each_other_share_one():
    def maps_with(start):
        later = outing(STROLL, epoch=MIDNIGHT + 15 * HOUR, start=start)
        return panels(overview_of(day(outing(STROLL), later)))

    assert len(maps_with((100.0, 100.0))) == 1
    whole, *places = maps_with((30_000.0, 0.0))
    assert [panel.letter for panel in (whole, *places)] == ["A", "B", "C"]
    assert whole.width > 30_000
    for place in places:
        assert place.width < ENLARGED_SHARE * whole.width
        assert any((place.corners[0] < way[0].position[0]).all() for way in place.ways)


def test_a_time_without_data_is_drawn_on_every_map_that_it_leaves():
    later = outing(STROLL, epoch=MIDNIGHT + 15 * HOUR, start=(30_000.0, 0.0))
    parts, _ = drawn(overview_of(day(outing(STROLL), later)))
    dotted = [[path for path in one.iter("path") if "unseen" in path.get("class", "")] for one in maps_of(parts)]
    assert [len(paths) for paths in dotted] == [1, 1, 1]


@given(seed=st.integers(0, 10**6))
@settings(max_examples=20, deadline=None)
def test_every_walk_is_on_some_map(seed):
    """Each row is within the corners of a map; the map of everything has all."""
    random = np.random.default_rng(seed)
    outings = []
    for n in range(random.integers(1, 4)):
        legs = [
            (str(random.choice(ACTIVITIES)), float(random.uniform(10, 900)), float(random.uniform(-3, 3)))
            for _ in range(4)
        ]
        outings.append(outing([*legs, *STROLL], epoch=MIDNIGHT + n * 4 * HOUR, start=random.uniform(-5000, 5000, 2)))
    whole, *_ = panels(overview_of(day(*outings)))
    for way in (track for own in whole.ways for track in own):
        assert ((way.position >= whole.corners[0]) & (way.position <= whole.corners[1])).all()


def test_each_floor_has_a_map_of_its_own_tracks_and_a_change_of_floor_is_on_both():
    first, second = indoors("1", MIDNIGHT + 9 * HOUR), indoors("2", MIDNIGHT + 10 * HOUR)
    first = replace(first, stays=(stay(0, 5, (20, 20), floor="1"),))
    one, other = panels(overview_of(day(first, second)))
    assert (one.floor, other.floor) == ("1", "2")
    assert (len(one.dots), len(other.dots)) == (1, 0)
    assert {d.floor for d in one.drawn} == {"1"}
    track = replace(first.trajectory, floor=tuple("1" if t < 10 else "2" for t in first.trajectory.time))
    changed = panels(overview_of(day(replace(first, trajectory=track))))
    assert [panel.floor for panel in changed] == ["1", "2"]


def test_places_far_apart_have_maps_of_their_own_with_all_their_places_and_tracks(month_log):
    """Tracks are as long as the rides and walks of the month, simplified to 10 m, by kind."""
    month = chosen_from(month_log, "Ada", month="2024-05")
    berlin, tokyo = regions = panels(month)
    assert [region.frame.latitude for region in regions] == pytest.approx([52.5, 35.7], abs=0.1)
    for region in (berlin, tokyo):
        assert np.ptp(region.corners, axis=0).max() < 30_000
        at = np.array([dot.position for dot in region.dots])
        assert ((at > region.corners[0]) & (at < region.corners[1])).all()
    for kind, total in ((VEHICLE, "ridden"), (WALKING, "walked")):
        lengths = [length_along(part.track.position)[-1] for own in regions for part in own.drawn if part.kind == kind]
        flown = sum(row.distance for day in month.days for row in day.entries if row.kind == kind and row.mode)
        gone = sum(getattr(day.totals, total) for day in month.days)
        assert sum(lengths) == pytest.approx(gone - flown, rel=0.02)


def shops():
    """A day with many stays on one spot."""
    random = np.random.default_rng(2)
    stays = [stay(n, n + 1, random.normal(0, 40, 2), [(f"Shop number {n}", 0.9)]) for n in range(0, 590, 20)]
    return overview_of(day(outing(STROLL, stays=stays)))


LABELS = """
const shown = [...document.querySelectorAll('.pin .label')].filter((one) => one.style.visibility === 'visible');
return shown.map((one) => one.getBoundingClientRect()).map((box) => [box.left, box.top, box.right, box.bottom]);
"""


@pytest.mark.thorough
def test_labels_do_not_overlap_and_stay_on_their_map(browser, tmp_path):
    """Measured by the browser, also on an enlarged map and on a phone."""
    shown = DayPage(browser, tmp_path, shops())
    for width, enlarged in ((1280, False), (1280, True), (400, False)):
        shown.resize(width)
        shown.run(f"document.querySelectorAll('.zoom button')[{0 if enlarged else 1}].click()")
        boxes = np.array(shown.run(LABELS))
        [left, top, right, bottom] = shown.run(
            "const box = document.querySelector('figure.map svg').getBoundingClientRect();"
            "return [box.left, box.top, box.right, box.bottom]"
        )
        assert len(boxes) > 3
        low, high = boxes[:, :2], boxes[:, 2:]
        apart = ((low[:, None] >= high) | (low >= high[:, None])).any(axis=2)
        assert apart[~np.eye(len(boxes), dtype=bool)].all()
        assert (low >= np.array([left, top]) - 1).all()
        assert (high <= np.array([right, bottom]) + 1).all()


@pytest.mark.thorough
@pytest.mark.parametrize("made", [day(outing(STROLL)), None], ids=["a walk", "a day with rides"])
def test_a_map_has_a_scale_bar_of_its_label_and_an_arrow_to_the_north(browser, tmp_path, month_log, made):
    overview = overview_of(made) if made else chosen_from(month_log, "Ada", **DAY)
    assert "▲" in "".join(maps_of(drawn(overview)[0])[0].itertext())
    shown = DayPage(browser, tmp_path, overview)
    for _ in range(2):
        pixels, text, metre = shown.run(
            "const map = document.querySelector('figure.map'), ground = map.querySelector('.ground');"
            "return [map.querySelector('.bar').getBBox().width, map.querySelector('.scale-bar text').textContent,"
            "ground.width.baseVal.value / ground.viewBox.baseVal.width / ground.dataset.metres]"
        )
        number, unit = text.split()
        assert re.fullmatch("[125]0*|0.[125]", number)
        assert pixels == pytest.approx(float(number) * {"m": 1, "km": 1000}[unit] * metre, rel=1e-3)
        shown.run("document.querySelector('.zoom button').click()")


def test_mercator_is_metric_at_its_middle_and_across_the_date_line():
    frame = MercatorFrame(52.5, 13.4)
    metres = frame.from_lonlat(HERE.to_lonlat(np.zeros((1, 2))))
    assert frame.position(frame.shares(metres)) == pytest.approx(metres, abs=1e-3)
    east = MercatorFrame(0.0, 179.9).from_lonlat(np.array([[-179.9, 0.0]]))
    assert east[0] == pytest.approx((0.2 * 111_319.5, 0.0), rel=1e-4)


def test_offsets_are_written_as_people_do():
    assert [offset_text(h * 3600) for h in (0, 2, -4, 5.5, -3.5)] == ["UTC+0", "UTC+2", "UTC-4", "UTC+5:30", "UTC-3:30"]


# Files


@pytest.mark.parametrize(
    ("persons", "period", "names"),
    [(("Ada",), DAY, FILES | DAY_FILES), ((), {"week": "2024-W20"}, FILES | {"flows.csv"})],
    ids=["day", "week"],
)
def test_files_are_for_their_owner_alone_and_the_page_needs_nothing_else(month_log, tmp_path, persons, period, names):
    out = tmp_path / "out"
    show(month_log, Choice(persons, period_of(**period)), out)
    assert {file.name for file in out.iterdir()} == names
    assert stat.S_IMODE(out.stat().st_mode) == 0o700
    assert all(stat.S_IMODE(file.stat().st_mode) == 0o600 for file in out.iterdir())
    html = unescape((out / "overview.html").read_text())
    assert "default-src 'none'" in html
    assert html.count("<script") == 1
    assert not re.search(r'(?:src|href)="(?!#|data:)', html.replace('xlink:href="#', 'href="#'))
    assert "/home/" not in html, "paths of recordings"


def stored(folder, name, frame=HERE):
    """A lifelog in which a person and a place have a name."""
    own = stay(320.0, 4000.0, (375.0, 0.0), [(name, 0.9)])
    legs = [(WALKING, 300.0, 0.0), (STANDING, 3700.0, 0.0), (WALKING, 300.0, 0.0)]
    with Store(folder / "days.db", new=True) as store:
        store.put_day(rows_of(replace(day(outing(legs, frame=frame, stays=[own])), person=name), "key", ["5f3b" * 16]))
    return folder / "days.db"


def test_names_are_text_in_the_page(tmp_path):
    evil = "<script>alert(1)</script>"
    overview = chosen_from(stored(tmp_path, evil))
    html = page(overview, "", [evil])[0].decode()
    assert html.count("<script") == 1, "its own"
    assert "alert(1)" in html
    assert evil not in html


def test_a_day_without_an_absolute_position_has_a_map_in_its_own_frame(tmp_path):
    shown = show(stored(tmp_path, 'A"&B', NOWHERE), Choice(), tmp_path / "out").overview
    [panel] = panels(shown)
    assert not panel.frame.georeferenced
    [drawn_map] = maps_of(drawn(shown)[0])
    assert 'A"&B' in "".join(drawn_map.itertext())
    assert "▲" not in "".join(drawn_map.itertext())


def test_the_command_prints_text_and_writes_a_folder_named_after_the_period(month_log):
    result = commands.run("lifelog", "show", month_log, "--week", "2024-W20", "--person", "Ada")
    assert result.code == 0, result.errors
    assert result.output.splitlines()[-1] == f"-> {month_log.parent / 'days-2024-W20' / 'overview.html'}"
    assert result.output.startswith("Ada  2024-W20 (2024-05-13 to 2024-05-19)")


# Tiles of a map server


class StandIn(http.server.BaseHTTPRequestHandler):
    """Answers every request with a picture, or as its server's `answer` says."""

    def do_GET(self):
        self.server.asked.append((self.path, self.headers["User-Agent"]))
        self.send_response(self.server.status)
        self.end_headers()
        self.wfile.write(self.server.content)

    def log_message(self, *_):
        pass


@pytest.fixture
def server(monkeypatch):
    monkeypatch.undo()
    picture = io.BytesIO()
    imsave(picture, np.full((256, 256, 3), 0.5), format="png")
    own = http.server.ThreadingHTTPServer(("127.0.0.1", 0), StandIn)
    own.asked, own.status, own.content = [], 200, picture.getvalue()
    own.template = f"http://127.0.0.1:{own.server_port}/{{z}}/{{x}}/{{y}}.png"
    threading.Thread(target=own.serve_forever, daemon=True).start()
    yield own
    own.shutdown()
    own.server_close()


def test_tiles_are_fetched_from_the_given_address_alone_and_are_part_of_the_page(month_log, server):
    parts, failure = drawn(chosen_from(month_log, "Ada", **DAY), server.template)
    assert not failure
    assert 0 < len(server.asked) <= len(maps_of(parts)) * maps.MAX_TILES
    assert all(agent.startswith("pdr_graph/") for _, agent in server.asked)
    ground = maps_of(parts)[0].find(f"{SVG}svg") or maps_of(parts)[0].find("svg")
    images = [[float(one.get(name)) for name in ("x", "y", "width", "height")] for one in ground.iter("image")]
    x, y, width, height = np.array(images).T
    assert (x.min(), y.min()) <= (0, 0)
    assert (x + width).max() >= float(ground.get("width"))
    assert (y + height).max() >= float(ground.get("height"))
    assert all(one.get("href").startswith("data:image/png;base64,") for one in ground.iter("image"))


def test_a_tile_is_where_its_number_says(server):
    """The tile 1/1/0 is the north-eastern quarter of the world."""
    found = tiles(server.template, MercatorFrame(0.0, 0.0), np.array([[1e5, 1e5], [1.9e7, 1.9e7]]), 256)
    [tile] = [tile for tile in found if np.allclose(tile.corners[0], 0.0, atol=1.0)]
    assert tile.corners[1] == pytest.approx(np.pi * maps.MERCATOR_RADIUS * np.ones(2))


@pytest.mark.parametrize(("status", "content"), [(404, b""), (200, b"no picture"), (200, b"x" * 3_000_000)])
def test_a_server_without_tiles_is_one_line_and_asked_three_times(month_log, server, status, content):
    server.status, server.content = status, content
    parts, line = drawn(chosen_from(month_log, "Ada", **DAY), server.template)
    assert line.startswith("no tiles: http://127.0.0.1")
    assert len(server.asked) == maps.MAX_FAILURES
    assert maps_of(parts)


@pytest.mark.parametrize("template", ["file:///etc/{z}/{x}/{y}", "https://tile.example.org/", "ftp://a/{z}/{x}/{y}"])
def test_another_address_is_refused(template):
    with pytest.raises(InputError, match="expected a web address such as"):
        check_template(template)


# The page of a day, in a browser without network

ERRAND = [(WALKING, 300.0, 0.0), (STANDING, 600.0, 0.0), (WALKING, 300.0, 1.5)]
LATE = MIDNIGHT + 15 * HOUR
SHOP = "Kiosk <1> & Co"


@pytest.fixture(scope="module")
def browser():
    with chromium() as found:
        yield found


class DayPage(ShownPage):
    """The page of an overview in a browser."""

    def __init__(self, browser, folder, shown, remarks=()):
        self.browser, path = browser, folder / "overview.html"
        path.write_bytes(page(shown, "", remarks)[0])
        self.resize(1280)
        browser.get_log("browser"), browser.get_log("performance")
        browser.get(path.resolve().as_uri())
        self.until("return document.readyState === 'complete'")

    def resize(self, width):
        size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 600}
        self.browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        self.run("window.drawn = 0; const tick = () => { drawn += 1; requestAnimationFrame(tick); }; tick()")
        self.until("return drawn > 3")

    def slide(self, time):
        """Set the slider as a hand does."""
        self.run(
            "const s = document.getElementById('slider'); s.value = arguments[0]; s.dispatchEvent(new Event('input'))",
            time,
        )

    def text(self, name):
        return self.run(f"return document.getElementById('{name}').innerText")

    @property
    def walker(self):
        """Where the walker is on the map of the most time (x, y) [m] from its north-west corner; None if nowhere."""
        return self.run(
            """
            const ground = document.querySelector('.ground'), mark = ground.querySelector('.walker').parentNode;
            if (mark.style.display === 'none') return null;
            const { e, f } = mark.transform.baseVal[0].matrix;
            return [e * ground.dataset.metres, -f * ground.dataset.metres];
            """
        )


def made():
    looked = stay(320.0, 880.0, (375.0, 0.0), facing=((SHOP, 0.8), ("Bank", 0.1)))
    ride = outing([(VEHICLE, 600.0, 0.7), (GAP, 300.0, 0.7), *ERRAND], epoch=LATE, start=(400.0, 300.0))
    return day(outing(ERRAND, stays=[looked]), ride)


@pytest.fixture(scope="module")
def report(browser, tmp_path_factory):
    return DayPage(browser, tmp_path_factory.mktemp("day"), overview_of(made()), ["missing: steps: none"])


@pytest.mark.thorough
def test_the_page_of_a_day_opens_without_an_error_or_a_request(report):
    report.slide(MIDNIGHT + 9.1 * HOUR)
    assert report.errors == []
    assert report.asked_for[0] == []
    assert "missing: steps: none" in report.run("return document.body.innerText")


@pytest.mark.thorough
def test_the_slider_moves_the_walker_along_the_day_by_the_clock_of_the_zone(report):
    """To the rows of the outings: east at 1.25 m/s from (0, 0) at nine."""
    report.slide(MIDNIGHT + 9 * HOUR)
    begin, ride = np.array(report.walker), np.array([400.0, 300.0]) + 1000 * np.array([np.cos(0.7), np.sin(0.7)])
    for time, there in ((MIDNIGHT + 9 * HOUR + 200.0, (250.0, 0.0)), (LATE + 100.0, ride)):
        report.slide(time)
        assert report.walker - begin == pytest.approx(there, rel=0.01, abs=2.0)
    assert report.text("clock").startswith("15:01:40   riding")
    report.slide(MIDNIGHT + 12 * HOUR)
    assert (report.walker, report.text("clock")) == (None, "12:00:00   no data")
    report.slide(LATE + 750.0)
    assert report.walker is None, "a gap within an outing"
    report.slide(MIDNIGHT + 9 * HOUR + 500.0)
    assert f"{SHOP} 80%" in report.text("clock"), "a stay has its names and probabilities"
    report.run("document.querySelector('tr[data-start]').click()")
    assert report.walker == pytest.approx(begin), "a row leads to its time"


@pytest.mark.thorough
def test_a_map_is_enlarged_and_dragged(report):
    box = "return document.querySelector('.ground').getAttribute('viewBox').split(' ').map(Number)"
    whole = report.run(box)
    report.run("document.querySelector('.zoom button').click()")
    left, top, width, height = report.run(box)
    assert (width, height) == pytest.approx((whole[2] / 2, whole[3] / 2))
    assert (left, top) == pytest.approx((whole[2] / 4, whole[3] / 4)), "about its middle"
    drag = "document.querySelector('figure.map svg').dispatchEvent(new PointerEvent('pointer{}', {}))"
    report.run(drag.format("down", "{bubbles: true, clientX: 300, clientY: 300}"))
    report.run(drag.format("move", "{bubbles: true, clientX: 330, clientY: 300, buttons: 1}"))
    assert report.run(box)[0] < left
    report.run("document.querySelectorAll('.zoom button')[1].click()")
    assert report.run(box) == pytest.approx(whole)


def test_the_page_has_no_file_names_hashes_or_paths():
    """Like the files beside it."""
    plan = outing([(WALKING, 20.0, 0.0)], plan="/home/anna/secret/mall.geojson", floor="1")
    html = page(overview_of(day(plan, *made().outings)), "", [])[0].decode()
    assert "no plan: its file cannot be read" in html
    for secret in ("/home", "from home", "secret", "mall.geojson", "5f3b"):
        assert secret not in html, secret


def test_a_place_without_a_track_has_a_map_of_its_own():
    """A stay that the person states, far from all recordings."""
    shown = overview_of(made())
    [own] = shown.diaries
    there = TimelineEntry(STAY, LATE + 2 * HOUR, LATE + 3 * HOUR, latitude=-25.0, longitude=-71.0, sigma=15.0)
    shown = replace(shown, diaries=(replace(own, visits=(*own.visits, there)),))
    stated, *_ = panels(shown)
    assert [dot.time for dot in stated.dots] == [HOUR], "the map with the most time"
    first, *_ = maps_of(drawn(shown)[0])
    assert not [path for path in first.iter("path") if "track" in path.get("class", "").split()]


@pytest.mark.thorough
@pytest.mark.parametrize(
    "outings",
    [
        (),
        (outing(ERRAND, frame=NOWHERE),),
        (outing([(GAP, 900.0, 0.0)]),),
        (outing(ERRAND, frame=HERE, plan="gone.geojson"),),
    ],
)
def test_days_of_any_kind_have_a_page(browser, tmp_path, outings):
    assert DayPage(browser, tmp_path, overview_of(day(*outings))).errors == []


def test_the_picture_the_rows_and_the_totals_of_a_day_agree(month_log):
    """Hours drawn, rows and totals by kind, and the times at the places on the maps."""
    for on in [f"2024-05-{number:02d}" for number in range(1, 20)]:
        if on == "2024-05-11":
            continue
        shown = chosen_from(month_log, "Ada", day=on)
        [own] = shown.days
        drawn, lasts, gone = (defaultdict(float) for _ in range(3))
        for group, start, end, _ in blocks(shown, date.fromisoformat(on), own):
            drawn[group] += 3600 * (end - start)
        for row in own.entries:
            lasts[GROUPS[row.kind]] += row.duration
            gone[GROUPS[row.kind]] += row.distance
        totals = own.totals
        for group, total in (("walking", totals.walking), ("riding", totals.riding), ("staying", totals.staying)):
            assert drawn[group] == pytest.approx(total, abs=1.0)
            assert lasts[group] == pytest.approx(total, abs=1e-3)
        assert gone["walking"] + gone["staying"] == pytest.approx(totals.walked)
        assert gone["riding"] == pytest.approx(totals.ridden)
        dots = sum(dot.time for dot in maps._places(shown))
        assert dots == pytest.approx(totals.staying, abs=1.0)


def visitors(number):
    """An overview of visitors of the mall, each of whom stops first at S0, then at N4, then at S0 or E0."""
    fronts = {"S0": (3.0, 11.0), "N4": (58.0, 49.0), "E0": (72.0, 20.0)}
    diaries = []
    for n in range(number):
        names, now, stays = ("S0", "N4", "S0" if n % 3 else "E0"), 0.0, []
        for name in names:
            stays.append(stay(now + 60, now + 360, fronts[name], [(name, 0.9)], floor="1"))
            now += 400.0
        made = outing(
            [(WALKING, 20.0, 0.0), (STANDING, now, 0.0)], plan=MALL, floor="1", start=fronts["S0"], stays=stays
        )
        diaries += overview_of(replace(day(made), person=f"visitor {n}")).diaries
    return overview(diaries, period_of(day="2024-05-01"))


def test_the_map_of_many_persons_is_the_whole_plan_with_its_flows_and_a_scale_of_its_heat():
    shown = visitors(9)
    [panel] = panels(shown)
    floor, _ = floor_of(panel)
    assert np.abs(panel.corners - floor.corners).max() < 0.03 * np.ptp(floor.corners, axis=0).max()
    went = {"S0 → N4": 9 * 0.81, "N4 → S0": 6 * 0.81, "N4 → E0": 3 * 0.81}
    assert {arrow.text.partition(":")[0]: arrow.number for arrow in panel.arrows} == pytest.approx(went)
    [picture] = maps_of(drawn(shown)[0])
    flows = [group for group in picture.iter("g") if group.get("class") == "flow"]
    assert [flow.find("title").text for flow in flows[::-1]] == [arrow.text for arrow in panel.arrows]
    wide = [float(flow.find("path").get("stroke-width")) for flow in flows]
    assert wide == sorted(wide), "the largest is the widest, and on top"
    [scale] = [group for group in picture.iter("g") if group.get("class") == "heat-scale"]
    shades = [path for path in picture.iter("path") if path.get("fill") == HEAT]
    colours = [box for box in scale.iter("rect") if box.get("fill") == HEAT]
    assert len(shades) == len(colours) > 1


def test_what_another_program_guessed_is_pale_in_the_calendar_and_dotted_on_the_map():
    """A visit, a ride and another visit that were guessed, then a walk that was recorded."""
    guess = "Google Timeline: HOME, 78 %"
    at = {"sigma": 75.0, "observed": 0.0, "guess": guess, "offset": -4 * HOUR, "end_offset": -4 * HOUR}
    home, work = ({"latitude": -35.0 + north, "longitude": -71.0} for north in (0.0, 0.02))
    hours = MIDNIGHT + HOUR * np.arange(10)
    made = overview_of(day(outing(STROLL, epoch=hours[9])))
    [own] = made.diaries[0].days
    entries = (
        TimelineEntry(STAY, hours[0], hours[7], place_number=1, **home, **at),
        TimelineEntry(VEHICLE, hours[7], hours[8], distance=2200.0, **at),
        TimelineEntry(STAY, hours[8], hours[9], place_number=2, **work, **at),
        *own.entries,
    )
    own = replace(own, entries=entries)
    shown = overview([replace(made.diaries[0], days=(own,))], made.period)
    calendar, *maps_drawn = drawn(shown)[0]
    pale = [block for block in calendar.iter("rect") if block.get("fill-opacity")]
    assert len(pale) == 5, "two for each visit, as without data"
    dotted = [p for one in maps_drawn for p in one.iter("path") if "unseen" in p.get("class", "")]
    assert [path.get("stroke") for path in dotted[:1]] == [COLOURS[VEHICLE]]
    assert sum(ring.get("class") == "guess" for one in maps_drawn[:1] for ring in one.iter("circle")) == 2
    text = page(shown, "", ())[0].decode()
    assert "guessed by another program" in text
    assert "guessed by another program" not in page(made, "", ())[0].decode()
