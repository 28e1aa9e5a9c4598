"""The lifelog in its owner's browser: days, forms that correct them, and nothing for anybody else."""

import re
import shutil
import socket
import sys
import threading
from contextlib import contextmanager
from html import escape
from pathlib import Path
from urllib.parse import urlencode

import pytest
import uvicorn
from browser import PATIENCE, ShownPage, chromium
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from stand_in_server import QuietHandler, served
from starlette.testclient import TestClient

sys.path.append(str(Path(__file__).parents[1] / "lifelog"))
from gps_days import gps_day
from made_month import made_store

from pdr_graph.apps.lifelog.build import build
from pdr_graph.apps.lifelog.diary import diary
from pdr_graph.apps.lifelog.ingest import add
from pdr_graph.apps.lifelog.local_time import period_of
from pdr_graph.apps.lifelog.show import Choice, show
from pdr_graph.apps.lifelog.store import Store
from pdr_graph.apps.serve.diary_page import application

TOKEN = "t" * 24
DATE = "2024-05-14"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A lifelog of one simulated day."""
    folder = tmp_path_factory.mktemp("diary")
    gps_day(3).write(folder / "raw" / "0.plt")
    add(folder / "log", [folder / "raw"], person="Ada")
    build(folder / "log")
    return folder / "log"


@pytest.fixture
def page(made):
    """The owner's browser."""
    with TestClient(application(made, TOKEN), cookies={"pdr_graph_token": TOKEN}) as client:
        yield client
    with Store(made) as log:
        for fact in log.corrections():
            log.delete_correction(fact.number)
    build(made)


def form(page, n, action):
    """The hidden fields of a form of an entry."""
    text = page.get("/entry", params={"person": "Ada", "date": DATE, "n": n}).text
    [own] = [f for f in re.findall(r"<form.*?</form>", text) if f'value="{action}"' in f]
    return hidden_fields(own)


def hidden_fields(text):
    """Names and values of the hidden fields of a form."""
    return dict(re.findall(r'<input type="hidden" name="([\w-]+)" value="([^"]*)"', text))


def key(page):
    """The field that every form of the pages has."""
    return {"key": form(page, 0, "split")["key"]}


def day_text(page, **more):
    """The page of the day."""
    return page.get("/", params={"person": "Ada", "date": DATE} | more).text


def rows(page):
    """The cells of the rows of the day."""
    return rows_of(day_text(page))


def rows_of(text):
    """The cells of the rows of a day in its page."""
    return [re.findall(r"<td>(.*?)</td>", row)[:-1] for row in re.findall(r"<tr data-start.*?</tr>", text)]


def test_a_day_has_its_rows_and_its_picture(page):
    assert {"walking", "riding", "stay"} <= {row[3] for row in rows(page)}
    assert page.get("/").text == day_text(page), "the last day is the default"
    assert "<svg" in day_text(page)
    policies = [page.get(path).headers["content-security-policy"] for path in ("/", "/calendar", "/places")]
    assert all("default-src 'none'" in policy for policy in policies)
    assert all(re.search("script-src 'sha256-[^ ]+' 'self';", policy) for policy in policies), "these scripts alone"
    assert "http" not in policies[0], "no other server without --tiles"


def test_the_page_of_a_day_is_the_file_of_lifelog_show_with_links(page, made, tmp_path):
    show(made, Choice(("Ada",), period_of(day=DATE)), tmp_path / "out")
    file = (tmp_path / "out" / "overview.html").read_text()
    for part in (
        r"<h1>.*?</h1>",
        r'<p class="sums">.*?</p>',
        r'(?s)<circle r="\d.*?</circle>',
        "(?s)<script>.*?</script>",
    ):
        assert re.findall(part, file) == re.findall(part, day_text(page)) != []
    assert [re.findall(r"<td>(.*?)</td>", row)[:-1] for row in re.findall(r"<tr data-start.*?</tr>", file)] == rows(
        page
    )
    assert "<a " not in file


def test_the_tiles_are_asked_for_by_the_browser(made):
    """They are no part of the page, as they are of a file."""
    template = "https://tile.example.org/{z}/{x}/{y}.png"
    with TestClient(application(made, TOKEN, template), cookies={"pdr_graph_token": TOKEN}) as page:
        answer = page.get("/", params={"person": "Ada", "date": DATE})
    assert re.search(r'<image href="https://tile\.example\.org/\d+/\d+/\d+\.png"', answer.text)
    assert "img-src 'self' data: blob: https://tile.example.org;" in answer.headers["content-security-policy"]


def test_the_map_of_a_day_has_its_legs_and_stays(page):
    text, own = day_text(page), rows(page)
    legs = re.findall(r'<a href="[^"]*" class="entry" data-n="(\d+)"><path', text)
    assert {own[int(n)][3] for n in legs} >= {"walking", "riding"}
    stays = [n for numbers in re.findall(r'class="entry dot" data-n="([\d ]+)"', text) for n in numbers.split()]
    assert {int(n) for n in stays} == {n for n, row in enumerate(own) if row[3] == "stay"}
    assert page.get("/web/diary.js").status_code == 200


def test_a_form_does_what_the_command_does(page, made):
    stays = [n for n, row in enumerate(rows(page)) if row[3] == "stay"]
    answer = page.post("/correct", data=form(page, stays[1], "name") | {"value": "the office"})
    assert answer.status_code == 200
    assert [row[5] for row in rows(page)].count("the office") == 2, "in the morning and in the afternoon"
    walk = next(n for n, row in enumerate(rows(page)) if row[3] == "walking")
    page.post("/correct", data=form(page, walk, "mode") | {"value": "bus"})
    assert "bus" in {row[3] for row in rows(page)}
    with Store(made) as log:
        assert [fact.kind for fact in log.corrections()] == ["name", "mode"]
        numbers = [fact.number for fact in log.corrections()]
    assert "the office" in page.get("/corrections").text
    for form_of_one in re.findall(r"<form.*?</form>", page.get("/corrections").text):
        assert hidden_fields(form_of_one)["value"] in map(str, numbers)
        assert "undone" in page.post("/correct", data=hidden_fields(form_of_one)).text
    assert "the office" not in page.get("/").text


def test_a_stay_is_merged_with_the_next_stay_and_the_form_says_what_vanishes(page):
    own = rows(page)
    stays = [n for n, row in enumerate(own) if row[3] == "stay"]
    walk = next(n for n, row in enumerate(own) if row[3] == "walking" and stays[0] < n < stays[1])
    text = page.get("/entry", params={"person": "Ada", "date": DATE, "n": stays[0]}).text
    [offer] = re.findall(r"This and the next stay .*?</label>", text)
    assert f"{own[stays[1]][0]}–{own[stays[1]][1]}" in offer
    assert f"{own[walk][0]}–{own[walk][1]}  walking, {own[walk][2]}, {own[walk][4]}" in offer.partition("vanishes")[2]
    assert form(page, stays[0], "merge")["end"] == form(page, stays[1], "split")["end"]
    assert "no longer in the diary" in page.post("/correct", data=form(page, stays[0], "merge")).text
    assert "one stay" not in page.get("/entry", params={"person": "Ada", "date": DATE, "n": walk}).text


def test_the_calendar_and_the_places_lead_to_every_day_and_place(page, made):
    with Store(made) as log:
        own = diary(log, "Ada")
    month = page.get("/calendar", params={"person": "Ada"}).text
    days = set(re.findall(r'href="./\?person=Ada&amp;date=([0-9-]+)"', month))
    assert days == {day.date for day in own.days}
    assert month.count('<a href="./?person=Ada&amp;date=') >= len(days)
    assert '<text x="130" y="' in month
    listed = page.get("/places").text
    numbers = re.findall(r'href="place\?person=Ada&amp;number=(\d+)"', listed)
    assert sorted(numbers) == sorted(str(place.number) for place in own.places)
    for place in own.places:
        text = page.get("/place", params={"person": "Ada", "number": place.number}).text
        assert f"{place.latitude:.5f}, {place.longitude:.5f}" in text
        assert text.count(f"date={DATE}") >= len(place.visits) - 1, "a link for each visit of the day"


def test_a_person_and_a_date_are_chosen_by_a_form_that_has_no_key(page):
    """The key of forms that correct stays in no address and no history."""
    for path, field in (("/", 'type="date" name="date"'), ("/calendar", 'type="month" name="month"')):
        [form] = re.findall(r'<form class="chooser".*?</form>', page.get(path).text)
        assert field in form
        assert 'name="key"' not in form


def test_everybody_is_shown_on_a_day_or_in_its_week_and_filtered_by_name(tmp_path):
    people = [f"Ada {n}" for n in range(8)] + ["Ben"]
    with TestClient(application(made_store(tmp_path / "log", *people, days=6), TOKEN)) as client:
        client.cookies["pdr_graph_token"] = TOKEN

        def shown(**query):
            answer = client.get("/everybody", params=query)
            assert answer.text.count('class="chooser"') == (answer.status_code == 200)
            return answer.status_code, re.findall("<h1>(.*?)</h1>", answer.text)[0], answer.text

        assert shown()[:2] == (200, "9 persons  Monday 2024-05-06")
        status, title, text = shown(date="2024-05-02", span="week")
        assert (status, title) == (200, "9 persons  2024-W18 (2024-04-29 to 2024-05-05)")
        assert '<a href="./?person=Ben&amp;date=2024-05-05">Ben</a>' in text
        assert shown(person="da", span="month")[1] == "8 persons  2024-05 (2024-05-01 to 2024-05-31)"
        assert shown(person="ben")[1] == "Ben  Monday 2024-05-06"
        assert "found &#x27;Eve&#x27;" in shown(person="Eve")[2]
        assert shown(date="2024-05-01", span="<b>")[:2] == shown(date="May")[:2] == (400, "not possible")


@pytest.mark.parametrize(
    ("path", "params"),
    [
        ("/", {"person": "Eve"}),
        ("/", {"date": "1999-01-01"}),
        ("/", {"date": "0001-01-01"}),
        ("/", {"date": "9999-12-20"}),
        ("/", {"date": "<script>"}),
        ("/entry", {"date": DATE, "n": "9999"}),
        ("/entry", {"date": DATE, "n": "-1"}),
        ("/entry", {"date": DATE, "n": "1" * 5000}),
        ("/calendar", {"month": "May"}),
        ("/calendar", {"person": "Eve"}),
        ("/places", {"person": "Eve"}),
        ("/place", {"number": "<script>"}),
    ],
)
def test_a_wrong_address_is_one_line(page, path, params):
    answer = page.get(path, params=params)
    assert (answer.status_code, answer.text.count("expected")) == (400, 1)
    assert answer.text.count("<script") == 1, "its own"


@pytest.mark.parametrize(
    ("fields", "status", "text"),
    [
        ({}, 400, "expected"),
        ({"do": "at"}, 400, "expected"),
        ({"do": "undo", "value": "x"}, 400, "expected"),
        ({"do": "undo", "value": "1" * 5000}, 400, "expected"),
        ({"do": "split", "value": "noon"}, 400, "expected"),
        ({"do": "forget", "sure": ""}, 400, "found no yes"),
        ({"do": "forget-place", "sure": ""}, 400, "found no yes"),
        ({"value": "x" * 20_000}, 413, ""),
    ],
)
def test_a_wrong_form_is_one_line_and_changes_nothing(page, made, fields, status, text):
    walk = next(n for n, row in enumerate(rows(page)) if row[3] == "walking")
    hidden = form(page, walk, "forget") if "sure" in fields else {}
    answer = page.post("/correct", data=key(page) | hidden | fields)
    assert (answer.status_code, text in answer.text) == (status, True)
    with Store(made) as log:
        assert log.corrections() == ()


def test_nobody_else_sees_or_changes_anything(made):
    with TestClient(application(made, TOKEN)) as stranger:
        for path in ("/", "/entry", "/corrections", "/calendar", "/places", "/place?number=1"):
            assert stranger.get(path, follow_redirects=False).status_code == 401
        assert stranger.post("/correct", data={"do": "undo", "value": "1"}).status_code == 401
        assert stranger.get(f"/?token={TOKEN}", follow_redirects=False).status_code == 303
    with TestClient(application(made, TOKEN), cookies={"pdr_graph_token": TOKEN}) as page:
        undo = {"do": "undo", "value": "1"}
        for origin in ("https://evil.example", "null", "http://testserver:8080"):
            foreign = page.post("/correct", data=key(page) | undo, headers={"origin": origin})
            assert foreign.status_code == 403, origin
        for wrong in ({}, {"key": ""}, {"key": "0" * 64}, {"key": TOKEN}):
            assert page.post("/correct", data=undo | wrong).status_code == 403, wrong


# In a browser


class DiaryBrowser(ShownPage):
    """The diary as its owner sees and corrects it."""

    def __init__(self, browser, url):
        self.browser, self.url = browser, url
        browser.get(f"{url}/?token={TOKEN}")

    def open_day(self):
        """Load the page of the day, whole: under load the driver returns from `get` while it is being parsed."""
        self.run("window.former = true")
        self.browser.get(f"{self.url}/?{urlencode({'person': 'Ada', 'date': DATE})}")
        self.until("return !window.former && document.documentElement.dataset.ready === 'yes'")

    @property
    def rows(self):
        """The cells of the rows of the day."""
        self.open_day()
        return self.run(
            "const rows = [...document.querySelectorAll('.the-day tbody tr')];"
            "return rows.map((row) => [...row.cells].map((cell) => cell.innerText))"
        )

    def number(self, kind, nth=0):
        """Number of the row that is the nth of a kind."""
        return [n for n, row in enumerate(self.rows) if row[3] == kind][nth]

    def submit(self, n, action, **values):
        """Press the button of a form of a row; values: of its visible fields. Returns the text of the next page."""
        assert len(self.rows) > n
        self.browser.find_elements(By.LINK_TEXT, "correct")[n].click()
        [form] = self.browser.find_elements(By.XPATH, f"//form[input[@name='do'][@value='{action}']]")
        for name, value in values.items():
            field = form.find_element(By.NAME, name)
            if field.tag_name == "input":
                field.clear()
            field.send_keys(value)
        return self.press(form)

    def press(self, form):
        """Press the button of a form; returns the text of the next page."""
        self.run("window.former = true")
        form.find_element(By.TAG_NAME, "button").click()
        self.until("return !window.former && document.readyState === 'complete'")
        return self.browser.find_element(By.TAG_NAME, "body").text


@contextmanager
def serving(store):
    """The address of the diary on this machine."""
    server = uvicorn.Server(uvicorn.Config(application(store, TOKEN), log_level="critical"))
    listening = socket.create_server(("127.0.0.1", 0))
    thread = threading.Thread(target=server.run, args=([listening],), daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{listening.getsockname()[1]}"
    finally:
        server.should_exit = True
        thread.join(PATIENCE)


@pytest.fixture
def diary_browser(made, tmp_path):
    """A browser with a copy of the lifelog, whose forms it may submit."""
    store = tmp_path / "log"
    shutil.copy(made, store)
    shutil.copytree(f"{made}.d", f"{store}.d")
    with serving(store) as url, chromium(offline=False) as browser:
        yield DiaryBrowser(browser, url), store


@pytest.mark.thorough
@pytest.mark.timeout(180)
def test_every_form_of_the_page_corrects_the_diary_in_a_browser(diary_browser):
    page, _ = diary_browser
    done = set()

    def correct(row, action, **values):
        answer = page.submit(row, action, **values)
        assert answer.splitlines()[1] == "saved", answer
        done.add(action)

    correct(page.number("stay", 1), "name", value="the office")
    assert [row[5] for row in page.rows].count("the office") == 2
    correct(page.number("walking"), "mode", value="bus")
    assert "bus" in {row[3] for row in page.rows}
    before = len(page.rows)
    correct(page.number("stay", 1), "split", value=f"{DATE} 10:30")
    assert len(page.rows) == before + 1
    correct(page.number("stay", 1), "merge")
    assert len(page.rows) == before
    assert "the office" not in page.rows[page.number("stay")][5]
    correct(page.number("stay"), "at", value="the office")
    assert "the office" in page.rows[page.number("stay")][5]
    correct(page.number("riding"), "not-me")
    assert any(row[3] == "no data" and "corrected" in row[5] for row in page.rows)

    correct(page.number("walking"), "forget", sure="yes")
    stay = page.number("stay")
    page.open_day()
    page.browser.find_elements(By.LINK_TEXT, "correct")[stay].click()
    actions = {one.get_attribute("value") for one in page.browser.find_elements(By.NAME, "do")}
    assert actions == done, "each form of the page was submitted"
    page.browser.find_element(By.LINK_TEXT, "corrections").click()
    while forms := page.browser.find_elements(By.TAG_NAME, "form"):
        assert "undone" in page.press(forms[0])
        page.browser.find_element(By.LINK_TEXT, "corrections").click()
    assert "no corrections" in page.browser.find_element(By.TAG_NAME, "body").text
    assert "the office" not in {row[5] for row in page.rows}


@pytest.mark.thorough
@pytest.mark.timeout(180)
def test_a_place_is_named_and_forgotten_on_its_page_in_a_browser(diary_browser):
    page, store = diary_browser
    find = page.browser.find_element

    def open_place(text):
        find(By.LINK_TEXT, "places").click()
        find(By.LINK_TEXT, text).click()
        return page.browser.find_elements(By.TAG_NAME, "form")

    name, _ = open_place("place 2")
    name.find_element(By.NAME, "value").send_keys("the office")
    assert page.press(name).splitlines()[1] == "saved"
    _, forget = open_place("the office")
    assert "found no yes" in page.press(forget)
    _, forget = open_place("the office")
    forget.find_element(By.NAME, "sure").send_keys("yes")
    assert "deleted of Ada" in page.press(forget)
    find(By.LINK_TEXT, "back to the places").click()
    assert "the office" not in find(By.TAG_NAME, "body").text
    find(By.LINK_TEXT, "calendar").click()
    page.browser.find_elements(By.CSS_SELECTOR, "table.days a")[0].click()
    assert "the office" not in find(By.TAG_NAME, "body").text
    assert page.browser.find_elements(By.LINK_TEXT, "correct")
    with Store(store) as log:
        assert {fact.kind for fact in log.corrections()} == {"forgotten"}


@pytest.mark.thorough
@pytest.mark.timeout(180)
def test_a_stay_on_the_map_is_named_and_moved_by_keyboard_and_finger_on_a_phone(diary_browser):
    page, store = diary_browser
    browser = page.browser
    size = {"width": 390, "height": 844, "deviceScaleFactor": 1, "mobile": True}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)

    def opened(number):
        """The forms of a place, opened by the keyboard."""
        page.open_day()
        browser.find_elements(By.CSS_SELECTOR, "a.dot")[number].send_keys(Keys.ENTER)
        page.until("return document.querySelectorAll('#forms form').length > 5")
        return {form.find_element(By.NAME, "do").get_attribute("value"): form for form in forms()}

    def forms():
        return browser.find_elements(By.CSS_SELECTOR, "#forms form")

    own = opened(1)
    assert browser.switch_to.active_element.tag_name == "h2"
    names = [one.get_attribute("aria-label") for one in browser.find_elements(By.CSS_SELECTOR, "a.dot")]
    assert len(names) == len(set(names)) > 2, "a button for each place"
    assert set(own) == {"at", "name", "merge", "mode", "split", "not-me", "forget"}
    own["name"].find_element(By.NAME, "value").send_keys("the office", Keys.TAB)
    assert browser.switch_to.active_element.text == "Save"
    assert page.press(own["name"]).splitlines()[1] == "saved"

    own = opened(1)
    stay = browser.find_elements(By.CSS_SELECTOR, "a.dot")[1]
    assert stay.get_attribute("aria-label").startswith("the office")
    page.run("arguments[0].scrollIntoView({ block: 'center' })", stay)
    ActionChains(browser).drag_and_drop_by_offset(stay, 30, -20).perform()
    value = own["at"].find_element(By.NAME, "value").get_attribute("value")
    assert re.fullmatch(r"52\.\d{6},13\.\d{6}", value)
    assert page.press(own["at"]).splitlines()[1] == "saved"
    with Store(store) as log:
        named, moved = log.corrections()
    assert moved.place == pytest.approx(tuple(map(float, value.split(","))))
    metre = 1 / 111_195  # [deg] of latitude
    assert 5 * metre < moved.place[0] - named.place[0] < 1000 * metre, "upwards is north"
    assert moved.place[1] > named.place[1], "to the right is east"
    page.open_day()
    assert browser.execute_script("return document.documentElement.scrollWidth <= innerWidth")
    asked = browser.execute_script("return performance.getEntriesByType('resource').map((one) => one.name)")
    assert all(address.startswith(page.url) for address in asked)


@pytest.mark.thorough
@pytest.mark.timeout(120)
def test_the_form_of_another_page_is_refused_in_a_browser(diary_browser):
    page, store = diary_browser
    page.open_day()
    page.browser.find_element(By.LINK_TEXT, "correct").click()
    [own] = page.browser.find_elements(By.XPATH, "//form[input[@name='do'][@value='not-me']]")
    fields = {i.get_attribute("name"): i.get_attribute("value") for i in own.find_elements(By.TAG_NAME, "input")}
    inputs = "".join(f'<input name="{name}" value="{escape(value)}">' for name, value in fields.items())
    form = f'<form method="post" action="{page.url}/correct">{inputs}<button>win</button></form>'
    policies = ("", '<meta name="referrer" content="no-referrer">')

    class OtherSite(QuietHandler):
        def do_GET(self):
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write((policies[int(self.path[1:])] + form).encode())

    with served(OtherSite) as site:
        for n in range(len(policies)):  # the same machine, so that the browser sends the cookie
            page.browser.get(f"http://127.0.0.1:{site.server_port}/{n}")
            answer = page.press(page.browser.find_element(By.TAG_NAME, "form"))
            assert "another site" in answer
    with Store(store) as log:
        assert log.corrections() == ()
