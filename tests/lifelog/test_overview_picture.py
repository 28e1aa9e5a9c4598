"""Pictures and pages of overviews: every period can be drawn, nothing is fetched unasked, files are private."""

import http.server
import io
import re
import stat
import threading
import warnings
from dataclasses import replace

import numpy as np
import pytest
from made_days import HERE, NOWHERE, outing, stay
from made_days import day as made_day
from made_month import made_store
from matplotlib.image import imsave
from typer.testing import CliRunner

from pdr_graph.apps.cli import app
from pdr_graph.apps.lifelog import maps
from pdr_graph.apps.lifelog.day import STANDING, VEHICLE, WALKING, rows_of
from pdr_graph.apps.lifelog.local_time import period_of
from pdr_graph.apps.lifelog.maps import MercatorFrame, check_template, panels, tiles
from pdr_graph.apps.lifelog.picture import offset_text, picture
from pdr_graph.apps.lifelog.report import page
from pdr_graph.apps.lifelog.show import Choice, show
from pdr_graph.apps.lifelog.store import Store
from pdr_graph.apps.report.plotting import picture_bytes
from pdr_graph.errors import InputError
from pdr_graph.geometry import length_along

FILES = {"overview.html", "overview.png", "days.csv", "places.csv", "visits.csv", "hours.csv"}
REPORT = {"report.html", "timeline.csv", "day.geojson", "day.png"}


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """A lifelog of Ada and Ben: May 2024 in Berlin, from the 21st on in Tokyo."""
    return made_store(tmp_path_factory.mktemp("month") / "days.db", "Ada", "Ben", days=24)


@pytest.fixture(autouse=True)
def no_network(monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("a request")

    monkeypatch.setattr(maps, "ask", refuse)


def drawn(chosen, template=""):
    """The picture of an overview, drawn, and its failures."""
    figure, failures = picture(chosen, template)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph")
        figure.canvas.draw()
    return figure, failures


def chosen_from(log, *persons, place="", **period):
    return show(log, Choice(persons, period_of(**period), place), write=False).overview


@pytest.mark.parametrize(
    ("persons", "choice"),
    [
        (("Ada",), {"day": "2024-05-16"}),
        (("Ada",), {"week": "2024-W20"}),
        (("Ada",), {"year": "2024"}),
        (("Ada",), {"place": "1"}),
        (("Ada", "Ben"), {"day": "2024-05-16"}),
        (("Ada", "Ben"), {"month": "2024-05"}),
        (("Ada", "Ben"), {}),
        (("Ada", "Ben"), {"place": "1", "year": "2024"}),
    ],
    ids=str,
)
def test_every_period_can_be_drawn(log, choice, persons):
    figure, failures = drawn(chosen_from(log, *persons, **choice))
    assert not failures
    assert np.ptp(np.asarray(figure.canvas.buffer_rgba())[:, :, :3]) > 100  # something is on it
    assert figure.get_figheight() < 30


def test_places_far_apart_have_maps_of_their_own(log):
    berlin, tokyo = panels(chosen_from(log, "Ada", month="2024-05"))
    assert berlin.frame.latitude == pytest.approx(52.5, abs=0.1)
    assert tokyo.frame.latitude == pytest.approx(35.7, abs=0.1)
    for region in (berlin, tokyo):
        assert np.ptp(region.corners, axis=0).max() < 30_000


def test_all_places_are_on_their_map(log):
    for region in panels(chosen_from(log, "Ada", month="2024-05")):
        at = np.array([dot.position for dot in region.dots])
        assert ((at > region.corners[0]) & (at < region.corners[1])).all()


def test_the_tracks_of_a_month_are_as_long_as_its_rides_and_walks(log):
    """Simplified to 10 m, by kind."""
    month = chosen_from(log, "Ada", month="2024-05")
    drawn = [part for panel in panels(month) for part in panel.drawn]
    for kind, far in (
        (VEHICLE, sum(day.totals.ridden for day in month.days)),
        (WALKING, sum(day.totals.walked for day in month.days)),
    ):
        lengths = [length_along(part.track.position)[-1] for part in drawn if part.kind == kind]
        assert sum(lengths) == pytest.approx(far, rel=0.02)


def test_a_map_has_a_scale_bar_of_its_label_and_an_arrow_to_the_north(log):
    figure, _ = drawn(chosen_from(log, "Ada", day="2024-05-16"))
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


def test_files_of_an_overview_are_for_their_owner_alone(log, tmp_path):
    for choice, names in (
        (Choice(("Ada",), period_of(day="2024-05-16")), FILES | REPORT),
        (Choice((), period_of(week="2024-W20")), FILES),
    ):
        out = tmp_path / choice.period.name
        show(log, choice, out)
        assert {file.name for file in out.iterdir()} == names
        assert stat.S_IMODE(out.stat().st_mode) == 0o700
        assert all(stat.S_IMODE(file.stat().st_mode) == 0o600 for file in out.iterdir())


def test_the_page_needs_nothing_else_and_runs_nothing(log, tmp_path):
    show(log, Choice(("Ada",), period_of(month="2024-05")), tmp_path)
    html = (tmp_path / "overview.html").read_text()
    assert "default-src 'none'" in html
    assert "<script" not in html
    assert not re.search(r'(?:src|href)="(?!#|data:)', html.replace('xlink:href="#', 'href="#'))
    assert "/home/ada" not in html, "paths of recordings"


def test_names_are_text_in_the_page(tmp_path):
    evil = "<script>alert(1)</script>"
    own = stay(320.0, 4000.0, (375.0, 0.0), [(evil, 0.9)])
    legs = [(WALKING, 300.0, 0.0), (STANDING, 3700.0, 0.0), (WALKING, 300.0, 0.0)]
    made = replace(made_day(outing(legs, stays=[own])), person=evil)
    with Store(tmp_path / "days.db", new=True) as store:
        store.put_day(rows_of(made, "key", ["5f3b" * 16]))
    shown = show(tmp_path / "days.db", Choice(), write=False)
    figure, _ = drawn(shown.overview)
    html = page(shown.overview, picture_bytes(figure, file_format="svg"), [evil]).decode()
    assert "<script" not in html
    assert "&lt;script&gt;" in html


def test_a_name_with_dollar_signs_is_drawn_as_it_is(tmp_path):
    """A day without an absolute position has a map in its own frame."""
    legs = [(WALKING, 300.0, 0.0), (STANDING, 3700.0, 0.0)]
    made = made_day(outing(legs, frame=NOWHERE, stays=[stay(320.0, 4000.0, (375.0, 0.0), [(r"$\frac{$", 0.9)])]))
    with Store(tmp_path / "days.db", new=True) as store:
        store.put_day(rows_of(replace(made, person=r"A$\frac{$B"), "key", ["5f3b" * 16]))
    chosen = show(tmp_path / "days.db", Choice(), tmp_path / "out").overview
    [panel] = panels(chosen)
    assert not panel.frame.georeferenced


def test_offsets_are_written_as_people_do():
    assert [offset_text(h * 3600) for h in (0, 2, -4, 5.5, -3.5)] == ["UTC+0", "UTC+2", "UTC-4", "UTC+5:30", "UTC-3:30"]


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


def test_tiles_are_fetched_from_the_given_address_alone(log, server):
    chosen = chosen_from(log, "Ada", day="2024-05-16")
    figure, failures = drawn(chosen, server.template)
    assert not failures
    assert 0 < len(server.asked) <= maps.MAX_TILES
    assert all(agent.startswith("pdr_graph/") for _, agent in server.asked)
    axes = figure.axes[0]
    region = panels(chosen)[0]
    corners = np.stack([axes.get_xlim(), axes.get_ylim()], axis=1)
    covered = np.array([image.get_extent() for image in axes.images])
    assert covered[:, 0].min() <= corners[0, 0] <= corners[1, 0] <= covered[:, 1].max()
    assert covered[:, 2].min() <= corners[0, 1] <= corners[1, 1] <= covered[:, 3].max()
    assert region.frame.latitude == pytest.approx(52.5, abs=0.1)


def test_a_tile_is_where_its_number_says(server):
    """The tile 1/1/0 is the north-eastern quarter of the world."""
    frame = MercatorFrame(0.0, 0.0)
    [tile] = [
        tile
        for tile in tiles(server.template, frame, np.array([[1e5, 1e5], [1.9e7, 1.9e7]]), 256)
        if np.allclose(tile.corners[0], 0.0, atol=1.0)
    ]
    assert tile.corners[1] == pytest.approx(np.pi * maps.MERCATOR_RADIUS * np.ones(2))


@pytest.mark.parametrize(("status", "content"), [(404, b""), (200, b"no picture"), (200, b"x" * 3_000_000)])
def test_a_server_without_tiles_is_one_line_and_asked_three_times(log, server, status, content):
    server.status, server.content = status, content
    figure, [line] = drawn(chosen_from(log, "Ada", day="2024-05-16"), server.template)
    assert line.startswith("no tiles: http://127.0.0.1")
    assert len(server.asked) == maps.MAX_FAILURES
    assert figure.axes[0].get_xlim()[1] > figure.axes[0].get_xlim()[0]


@pytest.mark.parametrize("template", ["file:///etc/{z}/{x}/{y}", "https://tile.example.org/", "ftp://a/{z}/{x}/{y}"])
def test_another_address_is_refused(template):
    with pytest.raises(InputError, match="expected a web address such as"):
        check_template(template)


def test_the_command_prints_text_and_writes_a_folder_named_after_the_period(log):
    result = CliRunner().invoke(app, ["lifelog", "show", str(log), "--week", "2024-W20", "--person", "Ada"])
    assert result.exit_code == 0, result.output
    assert result.output.splitlines()[-1] == f"-> {log.parent / 'days-2024-W20' / 'overview.html'}"
    assert result.output.startswith("Ada  2024-W20 (2024-05-13 to 2024-05-19)")
