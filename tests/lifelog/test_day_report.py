"""The report of a day, in a browser without network."""

from dataclasses import replace
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from browser import Page, chromium
from made_days import HERE, MIDNIGHT, NOWHERE, day, outing, overview_of, stay

from pdr_graph.apps.lifelog.day import GAP, STANDING, VEHICLE, WALKING
from pdr_graph.apps.lifelog.report import content
from pdr_graph.apps.lifelog.timeline import STAY, TimelineEntry
from pdr_graph.apps.report.page import page

ZONE = ZoneInfo("America/Santiago")
HOUR = 3600.0
STROLL = [(WALKING, 300.0, 0.0), (STANDING, 600.0, 0.0), (WALKING, 300.0, 1.5)]
LATE = MIDNIGHT + 15 * HOUR
SHOP = "Kiosk <1> & Co"
ARROW = 8.0  # [px] as of the walk's report, and the turn of the arrow


@pytest.fixture(scope="module")
def browser():
    with chromium() as found:
        yield found


def made():
    looked = stay(320.0, 880.0, (375.0, 0.0), facing=((SHOP, 0.8), ("Bank", 0.1)))
    ride = outing([(VEHICLE, 600.0, 0.7), (GAP, 300.0, 0.7), *STROLL], epoch=LATE, start=(400.0, 300.0))
    return day(outing(STROLL, stays=[looked]), ride)


@pytest.fixture(scope="module")
def report(browser, tmp_path_factory):
    path = tmp_path_factory.mktemp("day") / "report.html"
    path.write_bytes(page(content(overview_of(made()), ZONE, ["steps: none"], ["GNSS was poor"])))
    return Page(browser, path)


def test_the_page_opens_without_an_error_or_a_request(report):
    report.slide(MIDNIGHT + 9.1 * HOUR)
    assert report.errors == []
    assert report.asked_for[0] == []


def test_the_slider_moves_the_walker_along_the_day(report):
    """To the rows of the outings: east at 1.25 m/s from (0, 0) at nine."""
    report.slide(MIDNIGHT + 9 * HOUR + 200.0)
    assert np.hypot(*np.subtract(report.walker, (250.0, 0.0))) * report.metre < ARROW
    report.slide(LATE + 100.0)
    there = np.array([400.0, 300.0]) + 1000.0 * np.array([np.cos(0.7), np.sin(0.7)])
    assert np.hypot(*np.subtract(report.walker, there)) * report.metre < ARROW
    report.slide(MIDNIGHT + 12 * HOUR)
    assert report.walker is None, "no position"
    assert report.run("return document.getElementById('readout').textContent") == "no data"
    report.slide(LATE + 750.0)
    assert report.walker is None, "a gap within an outing"


def test_the_clock_is_that_of_the_zone(report):
    report.slide(MIDNIGHT + 9.25 * HOUR)
    assert report.run("return document.getElementById('clock').textContent") == "09:15:00"


def test_stays_have_names_and_probabilities(report):
    report.slide(MIDNIGHT + 9 * HOUR + 500.0)
    assert f"{SHOP} 80%" in report.run("return document.getElementById('readout').textContent")
    assert f"{SHOP} 80%" in report.run("return document.getElementById('tables').innerText")


def test_the_page_has_no_file_names_hashes_or_paths():
    """Like the files beside it."""
    plan = outing([(WALKING, 20.0, 0.0)], plan="/home/anna/secret/mall.geojson", floor="1")
    html = page(content(overview_of(day(plan, *made().outings)), ZONE, [], [])).decode()
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


@pytest.mark.parametrize(
    "outings",
    [
        (),
        (outing(STROLL, frame=NOWHERE),),
        (outing([(GAP, 900.0, 0.0)]),),
        (outing(STROLL, frame=HERE, plan="gone.geojson"),),
    ],
)
def test_days_of_any_kind_have_a_page(browser, tmp_path, outings):
    (tmp_path / "report.html").write_bytes(page(content(overview_of(day(*outings)), ZONE, [], [])))
    assert Page(browser, tmp_path / "report.html").errors == []
