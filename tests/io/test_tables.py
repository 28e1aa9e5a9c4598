"""Tables of fixes, ranges, truth and trajectories: readers and writers."""

import json

import gpxpy
import numpy as np
import pytest
from refusals import refused
from walks import dead_reckon, fixes_on, wandering_walk

from pdr_graph import smooth
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.frames import enu
from pdr_graph.io import gpx, writers
from pdr_graph.io.tables import RANGE_SIGMA, is_tum, read_fixes, read_ranges, read_trajectory
from pdr_graph.types import LONLAT, Beacons, Recording, Signal, Trajectory

ORIGIN = 1_700_000_000.0
WALK = Recording("walk", ORIGIN, ORIGIN, accelerometer=Signal(np.arange(0.0, 60.0, 0.02), np.zeros((3000, 3))))
ANCHORS = Beacons(("A", "B"), np.array([[0.0, 0.0], [5.0, 5.0]]), np.array([0.05, 1.0]), ("", ""), ("A", "B"))
RANGES = f"time,anchor,range,sigma\n{ORIGIN + 2.5},b,7.5,\n{ORIGIN + 1},A,3.25,0.1\n"


def table(tmp_path, text):
    path = tmp_path / "table.csv"
    path.write_text(text)
    return path


def test_fixes_are_sorted_and_count_from_the_start_of_the_recording(tmp_path):
    path = table(tmp_path, f"time,x,y,sigma,floor\n{ORIGIN + 20},3,4,2,F2\n{ORIGIN + 10.5},1,2,0.5,F1\n")
    fixes = read_fixes(path, WALK)
    assert fixes.time == pytest.approx([10.5, 20.0])
    assert fixes.position == pytest.approx(np.array([[1, 2], [3, 4]]))
    assert fixes.sigma == pytest.approx([0.5, 2.0])
    assert fixes.floor == ("F1", "F2")


def test_fixes_may_have_a_speed_and_a_course_clockwise_from_north(tmp_path):
    rows = f"{ORIGIN},1,2,3,1.4,90\n{ORIGIN + 1},1,2,3,,\n"
    fixes = read_fixes(table(tmp_path, f"time,x,y,sigma,speed,course\n{rows}"), WALK)
    assert fixes.speed == pytest.approx([1.4, np.nan], nan_ok=True)
    assert fixes.course == pytest.approx([0.0, np.nan], nan_ok=True)
    assert fixes.source == ("GNSS", "GNSS")


def test_fixes_in_degrees_are_transformed_into_the_frame(tmp_path):
    frame = enu(35.0, 135.0)
    lon, lat = frame.to_lonlat(np.array([[30.0, -12.0]]))[0]
    path = table(tmp_path, f"\ufefftime,lat,lon,sigma\n{ORIGIN},{lat:.9f},{lon:.9f},3\n")
    assert read_fixes(path, WALK, frame).position == pytest.approx(np.array([[30.0, -12.0]]), abs=1e-3)
    assert read_fixes(path, WALK).epsg == LONLAT


def test_ranges_are_sorted_and_anchor_names_match_in_any_case(tmp_path):
    ranges = read_ranges(table(tmp_path, RANGES), WALK, ANCHORS)
    assert ranges.time == pytest.approx([1.0, 2.5])
    assert ranges.anchor.tolist() == [0, 1]
    assert ranges.range.tolist() == [3.25, 7.5]
    assert ranges.sigma.tolist() == [0.1, RANGE_SIGMA]
    assert ranges.position_sigma.tolist() == [0.05, 1.0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "an empty file"),
        ("time,x,y,sigma\n", "line 2"),
        ("time,x,y\n1,2,3\n", "time,x,y,sigma or time,lat,lon,sigma"),
        (f"time,x,y,sigma\n{ORIGIN},1,2,1\n{ORIGIN},1,nan,1\n", "line 3, y.*nan"),
        (f"time,x,y,sigma\n{ORIGIN},1,2,0\n", "sigma"),
        (f"time,x,y,sigma\n{ORIGIN},1,2\n", "line 2.*3 fields.*4"),
        (f"time,lat,lon,sigma\n{ORIGIN},100,2,1\n", "latitude"),
        (f"time,x,y,sigma\n{ORIGIN},1e15,2,1\n", "data row 1, x: .* a place within"),
        ("time,x,y,sigma\n5,1,2,1\n", "times within the recording"),
        (f"time,x,y,sigma,speed,course\n{ORIGIN},1,2,3,1.4,-1\n", "course: .*0 to 360"),
        ("\x00\x01\x02", "header"),
    ],
)
def test_fixes_that_cannot_be_are_refused_with_their_line(tmp_path, text, message):
    refused(read_fixes, table(tmp_path, text), message, WALK)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("7.5", "-7.5", "data row 1, range"),
        ("7.5", "7500", "metres"),
        ("7.5", "nan", "range"),
        ("0.1", "0", "sigma"),
        ("A,", "C,", "'C'"),
        (RANGES, RANGES.replace("17000", "17000000"), "milliseconds"),
        (RANGES, "time,range\n", "line 2"),
    ],
)
def test_ranges_that_cannot_be_are_refused(tmp_path, old, new, message):
    refused(read_ranges, table(tmp_path, RANGES.replace(old, new)), message, WALK, ANCHORS)


def test_truth_with_times_that_go_back_is_refused(tmp_path):
    refused(read_trajectory, table(tmp_path, "time,x,y\n1,0,0\n3,0,0\n2,0,0\n"), "increase")


@pytest.fixture(scope="module")
def estimate():
    steps = wandering_walk(30)
    return smooth(WalkGraph(steps, fixes_on(dead_reckon(steps), every=10)))


def test_a_trajectory_reads_back_as_written(tmp_path, estimate):
    writers.write_trajectory(tmp_path / "t.csv", estimate.trajectory, ORIGIN)
    again = read_trajectory(tmp_path / "t.csv")
    assert (tmp_path / "t.csv").read_text().splitlines()[0] == writers.TRAJECTORY_HEADER
    assert len(again) == 30 + 2
    assert again.time - ORIGIN == pytest.approx(estimate.trajectory.time, abs=1e-4)
    assert again.position == pytest.approx(estimate.trajectory.position, abs=1e-4)
    assert again.covariance[:, :2, :2] == pytest.approx(estimate.trajectory.covariance[:, :2, :2], abs=1e-3)


def test_geojson_and_gpx_hold_the_same_track(tmp_path, estimate):
    """As many points as rows, in longitude and latitude, and the fixes after them."""
    frame = enu(35.0, 135.0)
    writers.write_geojson(tmp_path / "t.geojson", estimate, frame, ORIGIN)
    gpx.write(tmp_path / "t.gpx", estimate.trajectory, frame, WALK.epoch, WALK.source)
    line, *points = json.loads((tmp_path / "t.geojson").read_text())["features"]
    assert line["geometry"]["type"] == "LineString"
    drawn = frame.from_lonlat(np.array(line["geometry"]["coordinates"]))
    assert drawn == pytest.approx(estimate.trajectory.position, abs=0.01)
    assert [p["properties"]["kind"] for p in points] == ["fix"] * len(estimate.fixes)
    track = gpxpy.parse((tmp_path / "t.gpx").read_text()).tracks[0].segments[0].points
    assert len(track) == len(estimate.trajectory)
    assert track[0].time.timestamp() == pytest.approx(ORIGIN)
    assert track[-1].time.timestamp() == pytest.approx(ORIGIN + estimate.trajectory.time[-1], abs=1e-3)
    times = [p["properties"]["time"] for p in points]
    assert times == pytest.approx([ORIGIN + fix.time for fix in estimate.fixes], abs=1e-3)


def test_tum_rows_are_those_of_a_format_string(tmp_path):
    """Unix times and positions of both signs; a heading that is not known is 0."""
    random, n = np.random.default_rng(1), 3000
    time, position = np.cumsum(random.uniform(0, 0.1, n)), random.normal(0, 300, (n, 2))
    heading = np.where(random.uniform(size=n) < 0.1, np.nan, random.uniform(-np.pi, np.pi, n))
    writers.write_tum(tmp_path / "track.tum", Trajectory(time, position, heading, ("",) * n), 1.7e9)
    half = np.nan_to_num(heading) / 2
    expected = "".join(
        f"{t + 1.7e9:.6f} {x:.4f} {y:.4f} 0 0 0 {s:.8f} {c:.8f}\n"
        for t, (x, y), s, c in zip(time, position, np.sin(half), np.cos(half), strict=True)
    )
    assert (tmp_path / "track.tum").read_bytes() == expected.encode()


@pytest.mark.timeout(20)
@pytest.mark.parametrize("text", ["\n" * 300_000 + "x", "# a\n" * 100_000 + "x", " \r\n\t" * 100_000, "1 " * 200_000])
def test_a_hostile_text_is_no_tum_file_at_once(text):
    """Blank lines in two ways of a pattern took time with the power of two of their number."""
    assert not is_tum(text)


@pytest.mark.parametrize("unit", [1e3, 1e6, 1e9])
def test_unix_times_of_a_trajectory_may_have_any_unit(tmp_path, unit):
    """Alone, without a recording whose clock they are on: a larger number of seconds is no time."""
    rows = [(1_777_629_600 + n, n, 2 * n) for n in range(3)]
    read = []
    for name, form in (("t.csv", "{:.0f},{},{}"), ("t.tum", "{:.0f} {} {} 0 nan nan nan nan")):
        text = "\n".join(form.format(t * unit, x, y) for t, x, y in rows)
        read.append(read_trajectory(table(tmp_path, "time,x,y\n" * name.endswith("csv") + text + "\n")))
    for track in read:
        assert track.time == pytest.approx([t for t, _, _ in rows], abs=1e-5)
        assert track.position.tolist() == [[x, y] for _, x, y in rows]
        assert np.isnan(track.heading).all()


def test_a_lost_pose_in_tum_is_refused_by_its_line(tmp_path):
    row = "1777629600 1 2 0 0 0 0 1\n"
    for n, text in enumerate(("1777629600 nan nan 0 0 0 0 1\n" + row, row + "1777629601 nan 2 0 0 0 0 1\n"), start=1):
        refused(read_trajectory, table(tmp_path, text), f"line {n}: found '17776296.. nan .*leave out rows of nan")
