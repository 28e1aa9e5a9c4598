"""Pictures and pages of days and periods: every part is on a map, nothing is fetched unasked, files are private."""

import http.server
import io
import re
import stat
import threading
import warnings
from collections import defaultdict
from dataclasses import replace
from datetime import date
from zoneinfo import ZoneInfo

import commands
import numpy as np
import pytest
from browser import Page, chromium
from hypothesis import given, settings
from hypothesis import strategies as st
from made_days import HERE, MIDNIGHT, NOWHERE, day, outing, overview_of, stay
from matplotlib.image import imsave

from pdr_graph.apps.lifelog import maps
from pdr_graph.apps.lifelog.day import ACTIVITIES, GAP, STANDING, VEHICLE, WALKING, rows_of
from pdr_graph.apps.lifelog.local_time import period_of
from pdr_graph.apps.lifelog.maps import ENLARGED_SHARE, MercatorFrame, check_template, panels, tiles
from pdr_graph.apps.lifelog.picture import GROUPS, _blocks, offset_text, picture
from pdr_graph.apps.lifelog.report import content, page
from pdr_graph.apps.lifelog.show import Choice, show
from pdr_graph.apps.lifelog.store import Store
from pdr_graph.apps.lifelog.timeline import STAY, TimelineEntry
from pdr_graph.apps.report.page import page as report_page
from pdr_graph.apps.report.plotting import picture_bytes
from pdr_graph.errors import InputError
from pdr_graph.geometry import length_along

MALL = "maps/mall.geojson"
HOUR = 3600.0
STROLL = [(WALKING, 300.0, 0.0), (WALKING, 300.0, 1.5)]
FILES = {"busy.csv", "dwell.csv", "overview.html", "overview.png", "days.csv", "places.csv", "visits.csv", "hours.csv"}
REPORT = {"report.html", "timeline.csv", "day.geojson", "day.png"}
DAY = {"day": "2024-05-16"}


@pytest.fixture(autouse=True)
def no_network(monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("a request")

    monkeypatch.setattr(maps, "ask", refuse)


def drawn(chosen, template=""):
    """The picture of an overview, drawn, and its failures."""
    figure, failures = picture(chosen, template)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph")  # where no font has Japanese
        figure.canvas.draw()
    return figure, failures


def chosen_from(log, *persons, place="", **period):
    return show(log, Choice(persons, period_of(**period), place), write=False).overview


def indoors(floor, epoch, start=(20.0, 20.0)):
    """A walk of some metres on a plan."""
    return outing([(WALKING, 20.0, 0.0)], epoch=epoch, plan=MALL, floor=floor, start=start)


def is_drawn(overview):
    figure, failures = drawn(overview)
    something = np.ptp(np.asarray(figure.canvas.buffer_rgba())[:, :, :3]) > 100
    return something and not failures and figure.get_figheight() < 30


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


def test_labels_do_not_overlap_and_stay_on_their_map():
    """Measured by the renderer, with many stays on one spot."""
    random = np.random.default_rng(2)
    stays = [stay(n, n + 1, random.normal(0, 40, 2), [(f"Shop number {n}", 0.9)]) for n in range(0, 590, 20)]
    figure, _ = drawn(overview_of(day(outing(STROLL, stays=stays))))
    axes = figure.axes[0]
    boxes = [t.get_window_extent() for t in axes.texts if t.get_text().startswith("Shop")]
    assert len(boxes) > 5
    for n, box in enumerate(boxes):
        assert not any(box.overlaps(other) for other in boxes[:n])
        assert axes.bbox.contains(box.x0, box.y0)
        assert axes.bbox.contains(box.x1, box.y1)


@pytest.mark.parametrize("made", [day(outing(STROLL)), None], ids=["a walk", "a day with rides"])
def test_a_map_has_a_scale_bar_of_its_label_and_an_arrow_to_the_north(month_log, made):
    figure, _ = drawn(overview_of(made) if made else chosen_from(month_log, "Ada", **DAY))
    axes = figure.axes[0]
    bar = next(line for line in axes.lines if line.get_linewidth() == 2.5)
    texts = [text.get_text() for text in axes.texts]
    [label] = [text for text in texts if re.fullmatch(r"[125]0* k?m", text)]
    number, unit = label.split()
    assert np.ptp(bar.get_xdata()) == pytest.approx(float(number) * {"m": 1, "km": 1000}[unit])
    assert "▲\nN" in texts


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
    [(("Ada",), DAY, FILES | REPORT), ((), {"week": "2024-W20"}, FILES | {"flows.csv"})],
    ids=["day", "week"],
)
def test_files_are_for_their_owner_alone_and_the_page_needs_nothing_else(month_log, tmp_path, persons, period, names):
    out = tmp_path / "out"
    show(month_log, Choice(persons, period_of(**period)), out)
    assert {file.name for file in out.iterdir()} == names
    assert stat.S_IMODE(out.stat().st_mode) == 0o700
    assert all(stat.S_IMODE(file.stat().st_mode) == 0o600 for file in out.iterdir())
    html = (out / "overview.html").read_text()
    assert "default-src 'none'" in html
    assert "<script" not in html
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
    html = page(overview, picture_bytes(drawn(overview)[0], file_format="svg"), [evil]).decode()
    assert "<script" not in html
    assert "&lt;script&gt;" in html


def test_a_name_with_dollar_signs_is_drawn_as_it_is(tmp_path):
    """A day without an absolute position has a map in its own frame."""
    [panel] = panels(show(stored(tmp_path, r"A$\frac{$B", NOWHERE), Choice(), tmp_path / "out").overview)
    assert not panel.frame.georeferenced


def test_the_command_prints_text_and_writes_a_folder_named_after_the_period(month_log):
    result = commands.run("lifelog", "show", month_log, "--week", "2024-W20", "--person", "Ada")
    assert result.code == 0, result.errors
    assert result.output.splitlines()[-1] == f"-> {month_log.parent / 'days-2024-W20' / 'overview.html'}"
    assert result.output.startswith("Ada  2024-W20 (2024-05-13 to 2024-05-19)")


# Tiles of a map server


class TileServer(http.server.BaseHTTPRequestHandler):
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
    own = http.server.ThreadingHTTPServer(("127.0.0.1", 0), TileServer)
    own.asked, own.status, own.content = [], 200, picture.getvalue()
    own.template = f"http://127.0.0.1:{own.server_port}/{{z}}/{{x}}/{{y}}.png"
    threading.Thread(target=own.serve_forever, daemon=True).start()
    yield own
    own.shutdown()
    own.server_close()


def test_tiles_are_fetched_from_the_given_address_alone(month_log, server):
    figure, failures = drawn(chosen_from(month_log, "Ada", **DAY), server.template)
    assert not failures
    assert 0 < len(server.asked) <= maps.MAX_TILES
    assert all(agent.startswith("pdr_graph/") for _, agent in server.asked)
    axes = figure.axes[0]
    west, east, south, north = np.array([image.get_extent() for image in axes.images]).T
    assert (west.min() <= min(axes.get_xlim())) & (max(axes.get_xlim()) <= east.max())
    assert (south.min() <= min(axes.get_ylim())) & (max(axes.get_ylim()) <= north.max())


def test_a_tile_is_where_its_number_says(server):
    """The tile 1/1/0 is the north-eastern quarter of the world."""
    found = tiles(server.template, MercatorFrame(0.0, 0.0), np.array([[1e5, 1e5], [1.9e7, 1.9e7]]), 256)
    [tile] = [tile for tile in found if np.allclose(tile.corners[0], 0.0, atol=1.0)]
    assert tile.corners[1] == pytest.approx(np.pi * maps.MERCATOR_RADIUS * np.ones(2))


@pytest.mark.parametrize(("status", "content"), [(404, b""), (200, b"no picture"), (200, b"x" * 3_000_000)])
def test_a_server_without_tiles_is_one_line_and_asked_three_times(month_log, server, status, content):
    server.status, server.content = status, content
    figure, [line] = drawn(chosen_from(month_log, "Ada", **DAY), server.template)
    assert line.startswith("no tiles: http://127.0.0.1")
    assert len(server.asked) == maps.MAX_FAILURES
    assert np.ptp(figure.axes[0].get_xlim()) > 0


@pytest.mark.parametrize("template", ["file:///etc/{z}/{x}/{y}", "https://tile.example.org/", "ftp://a/{z}/{x}/{y}"])
def test_another_address_is_refused(template):
    with pytest.raises(InputError, match="expected a web address such as"):
        check_template(template)


# The report of a day, in a browser without network

ZONE = ZoneInfo("America/Santiago")
ERRAND = [(WALKING, 300.0, 0.0), (STANDING, 600.0, 0.0), (WALKING, 300.0, 1.5)]
LATE = MIDNIGHT + 15 * HOUR
SHOP = "Kiosk <1> & Co"
ARROW = 8.0  # [px] as of the walk's report, and the turn of the arrow


@pytest.fixture(scope="module")
def browser():
    with chromium() as found:
        yield found


def made():
    looked = stay(320.0, 880.0, (375.0, 0.0), facing=((SHOP, 0.8), ("Bank", 0.1)))
    ride = outing([(VEHICLE, 600.0, 0.7), (GAP, 300.0, 0.7), *ERRAND], epoch=LATE, start=(400.0, 300.0))
    return day(outing(ERRAND, stays=[looked]), ride)


@pytest.fixture(scope="module")
def report(browser, tmp_path_factory):
    path = tmp_path_factory.mktemp("day") / "report.html"
    path.write_bytes(report_page(content(overview_of(made()), ZONE, ["steps: none"], ["GNSS was poor"])))
    return Page(browser, path)


@pytest.mark.thorough
def test_the_page_of_a_day_opens_without_an_error_or_a_request(report):
    report.slide(MIDNIGHT + 9.1 * HOUR)
    assert report.errors == []
    assert report.asked_for[0] == []


@pytest.mark.thorough
def test_the_slider_moves_the_walker_along_the_day_by_the_clock_of_the_zone(report):
    """To the rows of the outings: east at 1.25 m/s from (0, 0) at nine."""

    def text(name):
        return report.run(f"return document.getElementById('{name}').innerText")

    ride = np.array([400.0, 300.0]) + 1000.0 * np.array([np.cos(0.7), np.sin(0.7)])
    for time, there in ((MIDNIGHT + 9 * HOUR + 200.0, (250.0, 0.0)), (LATE + 100.0, ride)):
        report.slide(time)
        assert np.hypot(*np.subtract(report.walker, there)) * report.metre < ARROW
    report.slide(MIDNIGHT + 12 * HOUR)
    assert (report.walker, text("readout"), text("clock")) == (None, "no data", "12:00:00")
    report.slide(LATE + 750.0)
    assert report.walker is None, "a gap within an outing"
    report.slide(MIDNIGHT + 9 * HOUR + 500.0)
    assert f"{SHOP} 80%" in text("readout"), "a stay has its names and probabilities"
    assert f"{SHOP} 80%" in text("tables")


def test_the_page_has_no_file_names_hashes_or_paths():
    """Like the files beside it."""
    plan = outing([(WALKING, 20.0, 0.0)], plan="/home/anna/secret/mall.geojson", floor="1")
    html = report_page(content(overview_of(day(plan, *made().outings)), ZONE, [], [])).decode()
    written = html[html.index('type="application/json"') : html.index('<script id="library"')]
    for secret in ("/home", "from home", "secret", "mall.geojson", "5f3b"):
        assert secret not in written, secret


def test_a_change_of_daylight_saving_time_is_in_the_offsets():
    """In Santiago clocks went back an hour at midnight of 6 April 2025: 03:00 UTC is 23:00 for the second time."""
    change = 1_743_908_400.0 + 4 * HOUR - HOUR * 4  # 2025-04-06T03:00Z
    late = outing([(WALKING, 1800.0, 0.0)], epoch=change - 900.0)
    offsets = content(overview_of(day(late)), ZONE, [], [])["offsets"]
    assert [by for _, by in offsets] == [-3 * HOUR, -4 * HOUR]
    assert offsets[1][0] == change


def test_a_place_without_a_track_has_a_map_of_its_own():
    """A stay that the person states, far from all recordings."""
    shown = overview_of(made())
    [own] = shown.diaries
    there = TimelineEntry(STAY, LATE + 2 * HOUR, LATE + 3 * HOUR, latitude=-25.0, longitude=-71.0, sigma=15.0)
    shown = replace(shown, diaries=(replace(own, visits=(*own.visits, there)),))
    made_content = content(shown, ZONE, [], [])
    on = [{number for number, _ in part["on"]} for part in made_content["marks"]]
    assert {0} in on, "the map with the most time"
    assert all(0 not in {number for number, _ in line["on"]} for line in made_content["tracks"])


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
    (tmp_path / "report.html").write_bytes(report_page(content(overview_of(day(*outings)), ZONE, [], [])))
    assert Page(browser, tmp_path / "report.html").errors == []


def test_the_picture_the_rows_and_the_totals_of_a_day_agree(month_log):
    """Hours drawn, rows and totals by kind, and the times at the places on the maps."""
    for on in [f"2024-05-{number:02d}" for number in range(1, 20)]:
        if on == "2024-05-11":
            continue
        shown = chosen_from(month_log, "Ada", day=on)
        [own] = shown.days
        drawn, lasts, gone = (defaultdict(float) for _ in range(3))
        for group, start, end in _blocks(shown, date.fromisoformat(on), own):
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
