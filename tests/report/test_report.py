"""The content of a report, without a browser."""

import base64
import hashlib
import json
import re
import zlib
from dataclasses import dataclass, replace
from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest
import shapely
import simulated
from colours import DEUTERANOPIA, lab, lightness, rgb
from hypothesis import given
from hypothesis import strategies as st
from made_walks import SENSORS, estimated, laps, shown
from plans import plan
from scipy.stats import chi2

from pdr_graph import geometry
from pdr_graph.apps.report import page as page_module
from pdr_graph.apps.report.charts_and_tables import health, measurement_table, sensor_rows
from pdr_graph.apps.report.content import CAUSAL, DASHES, content
from pdr_graph.apps.report.evaluation import evaluate
from pdr_graph.apps.report.output_files import smooth_recording
from pdr_graph.apps.report.page import MAXIMUM_ROWS, OTHER, TRUTH, column, page, runs, thinned
from pdr_graph.estimation.factors.heading_prior import HeadingReport
from pdr_graph.io.validation import clipped
from pdr_graph.notebook_html import BLUE, GREY
from pdr_graph.types import Estimate, FixReport, Recording, Signal, Trajectory
from pdr_graph.walk import Options, estimate, observe, read

HOUR = 70  # laps of 55 s
DRAWN = {"result": BLUE, "causal": CAUSAL, "another route": OTHER, "dead reckoning": GREY, "truth": TRUTH}


def decoded(said):
    """Decode a column, independently of the script of the page."""
    total, values = 0, []
    for step in said["steps"]:
        total += step or 0
        values.append(np.nan if step is None else total * said["unit"])
    return np.array(values)


@given(st.lists(st.one_of(st.floats(-1e9, 1e9), st.just(np.nan)), max_size=40), st.sampled_from([0.01, 1e-4, 1.0]))
def test_a_column_keeps_numbers_to_half_a_unit(values, unit):
    back = decoded(json.loads(json.dumps(column(np.array(values), unit))))
    # half a unit, and the rounding of doubles of 1e9
    np.testing.assert_allclose(back, values, rtol=1e-12, atol=0.5 * unit * (1 + 1e-6))


def test_runs_decode_to_their_values():
    values = [0, 0, -1, 2, 2, 2, 0]
    assert [value for value, count in runs(values) for _ in range(count)] == values


def test_long_tracks_are_thinned_and_keep_both_ends():
    assert list(thinned(5)) == [0, 1, 2, 3, 4]
    rows = thinned(10 * MAXIMUM_ROWS)
    assert (len(rows), rows[0], rows[-1]) == (MAXIMUM_ROWS, 0, 10 * MAXIMUM_ROWS - 1)


def test_the_band_contains_95_percent_of_positions():
    """For a walk at one place the band is one ellipse: the share of 20 000 draws, within 4 sigma."""
    covariance = np.array([[4.0, 1.5, 0], [1.5, 1.0, 0], [0, 0, 0.1]])
    still = Trajectory(np.arange(2.0), np.ones((2, 2)), np.zeros(2), ("", ""), np.stack([covariance, covariance]))
    (region,) = geometry.confidence_band(still, np.ones(2, dtype=bool))
    draws = np.random.default_rng(0).multivariate_normal([1.0, 1.0], covariance[:2, :2], 20_000)
    inside = shapely.contains_xy(region, *draws.T).mean()
    inscribed = np.pi / geometry.ELLIPSE_CORNERS
    least = chi2.cdf(geometry.REGION_95 * np.cos(inscribed) ** 2, 2)  # of a polygon within the ellipse
    noise = 4 * np.sqrt(0.95 * 0.05 / 20_000)
    assert least - noise < inside < 0.95 + noise


def along_a_corridor(y):
    """A walk along y, with sigmas of 3 m across; and on either side of its corridor a hall, 3 m beyond a wall."""
    x = np.linspace(1.0, 39.0, 39)
    covariance = np.tile(np.diag([0.5, 3.0, 0.1]) ** 2, (39, 1, 1))
    track = Trajectory(np.arange(39.0), np.column_stack([x, np.full(39, y)]), np.zeros(39), ("1",) * 39, covariance)
    return track, plan(*(("corridor", shapely.box(0, low, 40, low + 2)) for low in (-7, -1, 5)))


def test_on_a_plan_the_region_is_its_walkable_part():
    track, floor = along_a_corridor(y=0.0)
    here = np.ones(39, dtype=bool)
    everywhere = geometry.confidence_band(track, here)
    on_plan = shapely.union_all(page_module.region(track, here, floor))
    assert shapely.area(shapely.difference(on_plan, floor.walkable)) < 1e-9, "nothing of it is in a shop"
    lost = shapely.difference(shapely.intersection(shapely.union_all(everywhere), floor.walkable), on_plan)
    assert shapely.area(lost) < 1e-9, "all of it that is walkable remains, beyond walls too"
    assert len(shapely.get_parts(on_plan)) == 3


def test_a_walk_that_left_the_plan_keeps_its_whole_region():
    track, floor = along_a_corridor(y=-20.0)
    here = np.ones(39, dtype=bool)
    whole = shapely.union_all(geometry.confidence_band(track, here))
    assert shapely.equals_exact(
        *(shapely.normalize(s) for s in (whole, shapely.union_all(page_module.region(track, here, floor)))), 1e-9
    )


def test_a_block_within_the_region_is_a_hole_in_its_rings():
    """Exteriors and holes have opposite directions, so that a page fills the one and not the other."""
    track, _ = along_a_corridor(y=0.0)
    shop = shapely.box(15, 1, 25, 3)
    floor = plan(("corridor", shapely.difference(shapely.box(0, -30, 40, 30), shop)))
    rings = page_module.rings(page_module.region(track, np.ones(39, dtype=bool), floor))
    x, y = decoded(rings["x"]), decoded(rings["y"])
    ends = np.flatnonzero(np.isnan(x))
    areas = [
        np.sum(x[a:b] * np.roll(y[a:b], -1) - y[a:b] * np.roll(x[a:b], -1)) / 2
        for a, b in zip([0, *(ends[:-1] + 1)], ends, strict=True)
    ]
    assert sorted(np.sign(areas) * np.sign(areas[0])) == [-1, 1]
    assert min(areas, key=abs) * -np.sign(areas[0]) == pytest.approx(20.0, abs=0.2)


def signal(values, rate=100.0):
    values = np.asarray(values, dtype=float)
    return Signal(np.arange(len(values)) / rate, values.reshape(len(values), -1))


def noise(n=1000, size=10.0):
    return np.random.default_rng(1).normal(0, size, (n, 3))


def test_gaps_are_counted_and_reduce_the_recorded_share():
    whole = signal(noise())
    good = health("accelerometer", whole)
    assert (good.issues, good.samples, good.recorded, round(good.rate)) == ((), 1000, 1.0, 100)
    late = replace(whole, time=whole.time + 5.0 * (np.arange(1000) >= 400))
    found = health("gyroscope", late)
    assert (found.gaps, round(found.longest_gap, 2)) == (1, 5.01)
    assert found.recorded == pytest.approx(9.98 / 14.99)
    assert found.issues == ("1 gap, longest 5.0 s",)


def test_a_sensor_at_a_constant_value_is_stuck():
    values = noise()
    values[300:500] = values[300]
    assert health("gyroscope", signal(values)).stuck == pytest.approx(1.99)
    assert health("barometer", signal(values[:, :1])).stuck == 0.0, "a barometer says the same for seconds"


def test_samples_at_the_end_of_a_range_are_clipped():
    values = noise(size=30.0)
    values[400:440] = np.abs(values[400:440]) + 40.0  # a shock, all of it beyond the range
    cut = np.clip(values, -39.2, 39.2)
    assert health("accelerometer", signal(values)).clipped == 0
    assert health("accelerometer", signal(cut)).clipped >= 3 * 40
    assert health("magnetometer", signal(cut)).clipped == 0
    assert [clipped(np.array([0.0, 5.0, *[9.0] * n, 5.0])) for n in (2, 3, 4)] == [0, 3, 4]


def test_the_table_has_each_sensor_and_the_purpose_of_a_missing_one():
    walk = Recording("w", 0.0, None, accelerometer=signal(noise()), notes=("accelerometer: it was shaken",))
    rows = {row[0]: row for row in sensor_rows(walk)[1]}
    assert list(rows) == [*SENSORS, "barometer"]
    assert rows["gyroscope"][1:] == ["no data", "", "", "required for turns"]
    assert rows["accelerometer"][-1] == "it was shaken"


@pytest.fixture(scope="module")
def lap():
    return estimated(*laps(1))


def an_hour():
    hour = estimated(*laps(HOUR))
    assert len(hour.estimate.trajectory) > 7000
    return hour


def twelve_hours():
    """80 000 steps and a fix per second; all tracks have a covariance."""
    time, random = np.linspace(0.0, 43_200.0, 80_000), np.random.default_rng(6)
    position = np.cumsum(random.normal(0, 0.7, (len(time), 2)), axis=0)
    covariance = np.tile(np.eye(3), (len(time), 1, 1)) * random.uniform(1, 5, (len(time), 1, 1))
    path = Trajectory(time, position, random.uniform(-3, 3, len(time)), ("",) * len(time), covariance)
    fixes = tuple(FixReport(float(t), 1.0, 2.0, 3.0, 4.0, 0.5, "4.1 sigma from the walk: full") for t in range(43_200))
    estimate = Estimate(path, path, None, {"fixes": fixes}, 1, 0.0, True)
    return shown(Recording("march", 0.0, None), estimate, causal={"live": path})


@pytest.mark.thorough
@pytest.mark.parametrize(("walk", "most"), [(an_hour, 3_000_000), (twelve_hours, 8_000_000)])
def test_the_report_of_a_long_walk_is_small(walk, most):
    assert len(page(content(walk()))) < most


def drawn(path):
    """The lines of an SVG path of absolute starts and relative moves."""
    for part in path.split("M")[1:]:
        start, _, moves = part.rstrip("Z").partition("l")
        pairs = np.array([pair.split(",") for pair in f"{start} {moves}".split()], dtype=float)
        yield np.cumsum(pairs, axis=0)


def test_a_plan_of_ten_kilometres_is_drawn_to_a_centimetre():
    """Moves are short to write; they are of rounded corners, so that errors do not add up."""
    angle = np.linspace(0, 40, 4000)
    line = np.column_stack([5000 + 300 * angle * np.cos(angle), -120 * angle])
    shape = shapely.LineString(line)
    floor = SimpleNamespace(corners=np.array([[0.0, 0.0], [10_000.0, 0.0]]))
    (path,) = drawn(re.search(r' d="([^"]*)"', page_module._path(floor, shapely.multilinestrings([shape])))[1])
    assert path[[0, -1]] == pytest.approx(line[[0, -1]] * (1, -1), abs=0.006)
    assert shapely.hausdorff_distance(shapely.LineString(path * (1, -1)), shape) < 0.011


def test_a_page_has_no_placeholder_left_and_no_url_to_load(lap):
    text = page(content(lap)).decode()
    head = text[: text.index("<style>")]
    assert "{{" not in head
    assert "default-src 'none'" in head
    markup = re.sub(r"<script>.*?</script>", "", text, flags=re.DOTALL)
    assert not re.search(r"<(link|img|iframe|object|embed)\b|<script[^>]* src=|url\(", markup)


def test_the_policy_has_the_hash_of_each_script(lap):
    """The hashes of the texts between the tags, as a browser computes them."""
    text = page(content(lap)).decode()
    (packed,) = re.findall(r'<script id="library" type="text/plain">(.*?)</script>', text)
    scripts = [zlib.decompress(base64.b64decode(packed)).decode()]
    scripts += re.findall(r"<script>(.*?)</script>", text, flags=re.DOTALL)
    hashes = [base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts]
    assert re.findall(r"'sha256-([^']*)'", text[: text.index("<style>")]) == hashes
    assert len(hashes) == 2


@pytest.mark.parametrize(
    "name",
    ["</script><script>alert(1)</script>", "{{library}}{{style}}", "\udcff\x00\u2028", "\\", "<!--<script>", "]]>"],
)
def test_hostile_names_stay_in_the_content(lap, name):
    said = content(replace(lap, summary=lap.summary | {"warnings": [name]}))
    made = page(said | {"title": name}).decode("utf-8")
    inside = re.search(r'<script id="content" type="application/json">(.*?)</script>', made, flags=re.DOTALL)
    assert json.loads(inside[1]) == json.loads(json.dumps(said | {"title": name}))
    assert made.count("<script") - page(said).decode().count("<script") == 0


def test_truth_is_scored_as_by_evaluate_and_changes_no_estimate():
    steps, fixes = laps(2)
    truth = estimated(steps, fixes).estimate.trajectory
    truth = replace(truth, position=truth.position + 1.0, covariance=None)
    with_truth, without = content(estimated(steps, fixes, truth=truth)), content(estimated(steps, fixes))
    table = with_truth["tables"][0]
    assert table["head"] == ["metric", "unit", "graph", "filter", "dead reckoning, rigidly aligned"]
    ce50 = next(row for row in table["rows"] if row[0].startswith("CE50"))
    assert ce50[2] == "1.41", "a metre aside each way"
    mine = evaluate(estimated(steps, fixes).causal["filter"], truth)
    assert ce50[3] == f"{mine['ce']['p50']:.2f}"
    named = {track["name"]: track for track in with_truth["tracks"]}
    for track in without["tracks"]:
        assert named.pop(track["name"]) == track
    assert list(named) == ["truth"]


def test_estimated_and_prior_values_are_separate_lines():
    charts = {chart["title"]: chart for chart in content(estimated(*laps(4)))["charts"]}
    assert [line["name"] for line in charts["stride scale R_s"]["lines"]] == ["estimated"]
    assert "prior kept" in [line["name"] for line in charts["gyro drift b"]["lines"]]


def reporting(walk, **reports):
    """The walk with these reports of measurements."""
    return replace(walk, estimate=replace(walk.estimate, reports=reports))


@dataclass(frozen=True)
class EchoReport:
    """A report of a kind of measurement from outside the package."""

    anchor: str
    time: float
    residual: float
    weight: float
    blocked: bool


def test_a_new_kind_of_measurement_gets_a_table(lap):
    echoes = tuple(
        EchoReport(f"A{n}", float(n), (-1) ** n * 0.5, 0.1 if n % 4 == 0 else 1.0, n == 1) for n in range(300)
    )
    tables = content(reporting(lap, **lap.estimate.reports, sonar_echoes=echoes, silent=()))["tables"]
    titles = [table["title"] for table in tables]
    assert titles.count("Fixes") == 1
    assert "Silent" not in titles
    table = tables[titles.index("Sonar echoes")]
    assert table["head"] == ["time", "anchor", "residual", "weight", "blocked"]
    assert table["rows"][1] == ["0:01", "A1", "-0.5", "1", "yes"]
    assert len(table["rows"]) == len(table["moments"]) == 200
    assert table["moments"][:3] == [0.0, 1.0, 2.0]
    assert table["note"] == "300 measurements, the first 200 shown; mean |residual| 0.5; weight < 0.5: 25%"


def test_a_report_without_time_residual_and_weight_is_a_plain_table():
    @dataclass(frozen=True)
    class Link:
        name: str
        distance: float

    table = measurement_table("links", (Link("a", float("nan")), Link("b", 2.5)))
    assert (table["head"], table["rows"], table["moments"]) == (["name", "distance"], [["a", ""], ["b", "2.5"]], [])
    assert table["note"] == "2 measurements"


def positions_alone(time, fixes=()):
    """The content of a track that is no walk."""
    n, position = len(time), np.stack([time, time], axis=1)
    path = Trajectory(time, position, np.full(n, np.nan), ("",) * n, np.tile(np.eye(3), (n, 1, 1)))
    estimate = Estimate(path, path, None, {"fixes": tuple(fixes)}, 0, 0.0, True)
    return content(shown(Recording("track.gpx", 0.0, None), estimate))


def test_positions_alone_have_no_steps_and_no_probability():
    said = positions_alone(np.arange(20.0))
    assert [track["name"] for track in said["tracks"]] == ["smoothed positions"]
    assert [what for what, _ in said["headline"]] == ["distance", "duration", "fixes"]
    assert said["tables"][0]["rows"][0][:2] == ["accelerometer", "no data"]
    page(said)


def test_times_without_positions_are_dashed_where_there_are_positions_alone():
    time = np.append(np.arange(20.0), 300 + np.arange(20.0))
    said = positions_alone(time, (FixReport(t, t, t, 5.0, 0.0, 1.0, "") for t in time.tolist()))
    assert said["tracks"][0]["gaps"] == [[19.0, 300.0]]


def test_a_report_that_fails_leaves_all_other_files(tmp_path, monkeypatch):
    folder = simulated.indoor_location(tmp_path / "walk", np.array([(0.0, 0.0), (12.0, 0.0)]))

    def broken(_):
        raise RuntimeError("no more paper")

    monkeypatch.setattr(page_module, "page", broken)
    missing = smooth_recording(folder / "walk.txt", tmp_path / "out", Options(fixes=folder / "fixes.csv"))
    assert missing == ("report.html (RuntimeError: no more paper)",)
    assert {"trajectory.csv", "figure.png", "summary.json"} <= {path.name for path in (tmp_path / "out").iterdir()}
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["missing"] == list(missing)


def test_tracks_are_told_apart_in_grey_and_without_green_cones():
    """By a dash, or by 15 of lightness and 20 in all."""
    looks = {name: (DASHES.get(colour, "solid"), rgb(colour)) for name, colour in DRAWN.items()}
    for (one, (dash, first)), (other, (dashed, second)) in combinations(looks.items(), 2):
        if dash == dashed:
            assert abs(lightness(first) - lightness(second)) > 15, f"{one} and {other} in grey"
            apart = lab(first, DEUTERANOPIA) - lab(second, DEUTERANOPIA)
            assert np.hypot.reduce(apart) > 20, f"{one} and {other} by deuteranopia"


def test_headings_are_in_degrees_clockwise(lap):
    north_west = HeadingReport(3.0, np.radians(135), np.radians(10), np.radians(5), 1.0, "used")
    made = content(reporting(lap, headings=(north_west,)))
    [table] = [table for table in made["tables"] if table["title"] == "Headings"]
    zero = "north" if made["north"] else "+y"
    assert table["head"][1:4] == [f"heading [° from {zero}]", "sigma [°]", "residual [°]"]
    assert table["rows"] == [["0:03", "315", "10", "-5", "1.00", "used"]]


def test_notes_are_apart_from_warnings_and_those_of_the_estimate_come_first(lap):
    """What most walks leave open, and what the reader noted, are notes."""
    usual = "turn scale R_d not observable from this walk: prior kept"
    made = replace(
        lap,
        walk=replace(lap.walk, notes=("of the reader",)),
        estimate=replace(lap.estimate, warnings=("of the estimate",)),
        summary=lap.summary | {"warnings": ["of a file", usual, "of the reader", "of the estimate"]},
    )
    said = content(made)
    assert said["warnings"] == ["of the estimate", "of a file"]
    assert sorted(said["notes"]) == ["of the reader", usual]


def test_the_filter_is_drawn_from_its_first_fix_on(arcade_walk, tmp_path):
    """Before it, its place is (0, 0) with a sigma of a kilometre, which made the map shrink."""
    head, *rows = (arcade_walk / "fixes.csv").read_text().splitlines()
    (tmp_path / "late.csv").write_text("\n".join([head, *rows[3:]]))
    result = estimate(observe(read(arcade_walk, Options(fixes=tmp_path / "late.csv"))))
    track = result.causal()["filter"]
    assert track.time[0] >= result.evidence.fixes.time[0] > result.estimate.trajectory.time[0] + 5
    assert np.sqrt(track.covariance[:, 0, 0].max()) < 50
