"""The lifelog in its owner's browser: days, forms that correct them, and nothing for anybody else."""

import re
import sys
from pathlib import Path

import pytest
from starlette.testclient import TestClient

sys.path.append(str(Path(__file__).parents[1] / "lifelog"))
from gps_days import gps_day

from pdr_graph.apps.lifelog.build import build
from pdr_graph.apps.lifelog.ingest import add
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
    return dict(re.findall(r'<input type="hidden" name="([\w-]+)" value="([^"]*)"', own))


def rows(page):
    """The cells of the rows of the day."""
    text = page.get("/", params={"person": "Ada", "date": DATE}).text
    return [re.findall(r"<td>(.*?)</td>", row)[:-1] for row in re.findall(r"<tr>.*?</tr>", text)]


def test_a_day_has_its_rows_and_its_picture(page):
    assert {"walking", "riding", "stay"} <= {row[3] for row in rows(page)}
    picture = page.get("/picture.svg", params={"person": "Ada", "date": DATE})
    assert picture.headers["content-type"] == "image/svg+xml"
    assert b"<svg" in picture.content
    last = page.get("/")
    assert last.text.count("<tr>") == len(rows(page)), "the last day is the default"
    policy = last.headers["content-security-policy"]
    assert ("default-src 'none'" in policy, "script-src" in policy) == (True, False)


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
    for number in numbers:
        assert "undone" in page.post("/correct", data={"do": "undo", "value": number}).text
    assert "the office" not in page.get("/").text


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
        ("/picture.svg", {"person": "Eve", "date": DATE}),
    ],
)
def test_a_wrong_address_is_one_line(page, path, params):
    answer = page.get(path, params=params)
    assert (answer.status_code, answer.text.count("expected")) == (400, 1)
    assert "<script" not in answer.text


@pytest.mark.parametrize(
    ("fields", "status", "text"),
    [
        ({}, 400, "expected"),
        ({"do": "at"}, 400, "expected"),
        ({"do": "undo", "value": "x"}, 400, "expected"),
        ({"do": "undo", "value": "1" * 5000}, 400, "expected"),
        ({"do": "split", "value": "noon"}, 400, "expected"),
        ({"do": "forget", "sure": ""}, 400, "found no yes"),
        ({"value": "x" * 20_000}, 413, ""),
    ],
)
def test_a_wrong_form_is_one_line_and_changes_nothing(page, made, fields, status, text):
    walk = next(n for n, row in enumerate(rows(page)) if row[3] == "walking")
    hidden = form(page, walk, "forget") if "sure" in fields else {}
    answer = page.post("/correct", data=hidden | fields)
    assert (answer.status_code, text in answer.text) == (status, True)
    with Store(made) as log:
        assert log.corrections() == ()


def test_nobody_else_sees_or_changes_anything(made):
    with TestClient(application(made, TOKEN)) as stranger:
        for path in ("/", "/entry", "/picture.svg", "/corrections"):
            assert stranger.get(path, follow_redirects=False).status_code == 401
        assert stranger.post("/correct", data={"do": "undo", "value": "1"}).status_code == 401
        assert stranger.get(f"/?token={TOKEN}", follow_redirects=False).status_code == 303
    with TestClient(application(made, TOKEN), cookies={"pdr_graph_token": TOKEN}) as page:
        foreign = page.post("/correct", data={"do": "undo", "value": "1"}, headers={"origin": "https://evil.example"})
        assert foreign.status_code == 403
