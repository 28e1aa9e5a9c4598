"""What commands find out about a simulated walk, on the way from its files to the files of its result."""

import csv
import json

import numpy as np
import pytest
import simulated
from commands import run
from plans import ARCADE, MAPS, TWO_FLOORS
from simulated import ROUTE
from tiers import thorough

from pdr_graph import read_trajectory, walk
from pdr_graph.apps.report import evaluation
from pdr_graph.apps.report.output_files import smooth_recording
from pdr_graph.floor.plan_files import Building
from pdr_graph.lab.simulation.recorders import write
from pdr_graph.lab.simulation.simulate import simulate


@pytest.fixture(scope="module")
def result(long_walk, tmp_path_factory):
    out = tmp_path_factory.mktemp("result") / "out"
    given = ("--map", ARCADE, "--fixes", long_walk / "fixes.csv", "--out", out)
    code, _, errors = run("smooth", long_walk / "walk.txt", *given)
    assert (code, errors) == (0, [])
    return out


def summary_of(out):
    return json.loads((out / "summary.json").read_text())


def rows(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def smoothed(recording, out, *options):
    """Exit code, error lines and summary of a walk."""
    code, _, errors = run("smooth", recording, *options, "--no-report", "--out", out)
    return code, errors, summary_of(out)


def test_smooth_writes_all_documented_files(result):
    names = {path.name for path in result.iterdir()}
    tracks = {f"trajectory.{kind}" for kind in ("csv", "geojson", "gpx", "tum")}
    assert names == tracks | {"truth.tum", "figure.png", "report.html", "summary.json", "walker.toml"}
    table = rows(result / "trajectory.csv")
    columns = "time,x,y,heading,floor,sigma_x,sigma_y,cov_xy,sigma_heading"
    assert list(table[0]) == columns.split(",")
    assert len(table) == summary_of(result)["steps"] + 2
    assert {row["floor"] for row in table} == {"1"}
    times = np.array([float(row["time"]) for row in table])
    assert times[0] == pytest.approx(1.7e9, abs=0.03), "times on the recorder's clock, not from the start"
    assert np.all(np.diff(times) >= 0)


def test_the_tum_files_have_the_trajectory_within_evos_tolerance_of_any_time(result):
    """tests/test_other_programs.py runs evo."""
    dense, steps = read_trajectory(result / "trajectory.tum"), read_trajectory(result / "trajectory.csv")
    assert np.diff(dense.time).max() <= 2 * 0.01
    for axis in range(2):
        at_steps = np.interp(steps.time, dense.time, dense.position[:, axis])
        assert at_steps == pytest.approx(steps.position[:, axis], abs=0.02)
    assert len(read_trajectory(result / "truth.tum")) > 0


def test_tum_is_read_with_comments_and_headings(tmp_path):
    """Without any turn the file has no headings."""
    rotated = "# time x y z qx qy qz qw\n1.0 2.0 3.0 0 0 0 0.7071068 0.7071068\n2 2 4 0 0 0 0 1\n"
    for text, heading in ((rotated, [np.pi / 2, 0]), ("1 2 3 0 0 0 0 1\n2 2 4 0 0 0 0 1\n", [np.nan, np.nan])):
        (tmp_path / "a.tum").write_text(text)
        assert read_trajectory(tmp_path / "a.tum").heading == pytest.approx(heading, nan_ok=True)


def test_the_summary_has_frame_calibration_and_reasons(result):
    summary = summary_of(result)
    assert summary["frame"] == {"kind": "enu", "origin_lat": 35.0, "origin_lon": 135.0, "epsg": None}
    assert set(summary["calibration"][0]) == {"start", "R_s", "R_d", "b"}
    outlier = min(summary["fixes"], key=lambda fix: fix["weight"])
    assert outlier["weight"] < 0.1, "the simulated outlier"
    assert "outlier" in outlier["reason"]
    assert summary["missing"] == []
    assert set(summary["seconds"]) == {"reading", "steps", "estimate", "write", "report"}
    assert summary["wall_crossings"] <= 2
    assert {"pdr_graph", "gtsam", "numpy", "vqf", "python"} <= set(summary["versions"])


def score(out, folder):
    truth = (folder / "truth.csv", "--map", ARCADE, "--json", "--pairing", "nearest")
    code, printed, errors = run("evaluate", out / "trajectory.csv", *truth)
    assert (code, errors) == (0, [])
    values = json.loads(printed)
    assert list(values) == ["ce", "he", "eag", "ve", "ca", "oe", "fe", "n"]
    assert list(values["ce"]) == ["p50", "p75", "p95", "mean", "max"]
    return values


def test_the_graph_is_better_than_filter_and_dead_reckoning(long_walk, result, tmp_path):
    """Doubtful: the direction of dead reckoning is by one fix, and the filter takes some fixes as wrong at first."""
    scores = {}
    for method, code in {"pdr": 3, "filter": 3, "rts": 0}.items():
        out = tmp_path / method
        given = ("--fixes", long_walk / "fixes.csv", "--method", method)
        assert smoothed(long_walk / "walk.txt", out, *given)[0] == code
        scores[method] = score(out, long_walk)
        assert not (out / "trajectory.gpx").exists(), "metric fixes alone have no latitude"
    scores["graph"] = score(result, long_walk)
    assert scores["graph"]["ce"]["p95"] < 3.0
    assert scores["graph"]["oe"] < 0.02
    assert scores["graph"]["ce"]["p50"] < min(scores["pdr"]["ce"]["p50"], scores["filter"]["ce"]["p50"])


def test_rate_resamples_the_trajectory(long_walk, tmp_path):
    given = ("--fixes", long_walk / "fixes.csv", "--rate", 10)
    assert smoothed(long_walk / "walk.txt", tmp_path, *given)[0] == 0
    for name in ("trajectory.csv", "trajectory.tum"):
        times = read_trajectory(tmp_path / name).time
        assert np.diff(times)[:-1] == pytest.approx(0.1, abs=1e-3)


def test_without_any_position_the_walk_starts_at_the_origin(long_walk, tmp_path):
    code, _, summary = smoothed(long_walk / "walk.txt", tmp_path, "--no-recorded-fixes")
    first = rows(tmp_path / "trajectory.csv")[0]
    assert [float(first[k]) for k in ("x", "y", "heading")] == pytest.approx([0, 0, 0], abs=1e-3)
    assert (code, summary["frame"]["kind"]) == (0, "local")
    assert summary["scores"] is summary["sigma"] is None
    assert any("no position fix" in warning for warning in summary["warnings"])


def test_truth_far_from_the_walk_is_reported_as_missing(long_walk, result, tmp_path):
    table = np.genfromtxt(result / "trajectory.csv", delimiter=",", skip_header=1, usecols=(0, 1, 2))
    table[:, 2] += 135  # farther than the walk is wide, and within reach
    np.savetxt(tmp_path / "far.csv", table, delimiter=",", header="time,x,y", comments="", fmt="%.3f")
    given = ("--map", ARCADE, "--fixes", long_walk / "fixes.csv", "--truth", tmp_path / "far.csv")
    code, _, summary = smoothed(long_walk / "walk.txt", tmp_path / "out", *given)
    assert code == 3
    assert "far.csv" in summary["missing"][0]


def test_if_the_graph_cannot_be_solved_the_filter_is_written(long_walk, tmp_path, monkeypatch):
    """Everything else is written, and the summary lists what is missing."""

    def indeterminate(graph):
        raise RuntimeError("Indeterminant linear system detected\nmore lines of it")

    monkeypatch.setattr(walk, "smooth", indeterminate)
    missing = smooth_recording(long_walk / "walk.txt", tmp_path, walk.Options(fixes=long_walk / "fixes.csv"))
    assert "Indeterminant linear system" in missing[0]
    assert summary_of(tmp_path)["missing"] == list(missing)
    assert (tmp_path / "figure.png").exists()


# The walker


def length_of_steps(recording, out, *options):
    """The sum over the table that ``steps`` writes. [m]"""
    assert run("steps", recording, *options, "--out", out).code == 0
    table = rows(out)
    assert list(table[0]) == ["time", "length", "turn", "sigma_length", "sigma_turn", "confidence"]
    assert all(0.2 <= float(row["length"]) <= 1.3 for row in table[1:])
    return sum(float(row["length"]) for row in table)


def test_a_profile_of_calibrate_corrects_the_length_of_a_walk(tmp_path):
    """Calibrated on a known route, a figure of eight."""
    eight, profile = tmp_path / "eight", tmp_path / "walker.toml"
    assert run("simulate", "figure_eight", "--out", eight).code == 0
    code, printed, errors = run("calibrate", eight, "--route", MAPS / "figure_eight.geojson", "--out", profile)
    assert (code, errors) == (0, [])
    assert printed.startswith("2 x the route")
    assert "E_length" in profile.read_text()
    assert (tmp_path / "walker.png").stat().st_size > 10_000
    unknown = length_of_steps(eight, tmp_path / "unknown.csv")
    known = length_of_steps(eight, tmp_path / "known.csv", "--walker", profile)
    true = np.hypot(*np.diff(read_trajectory(eight / "truth.csv").position, axis=0).T).sum()
    assert abs(known - true) < 0.04 * true < abs(unknown - true)


def test_the_profile_of_smooth_is_an_input_of_the_next_walk(result, long_walk, tmp_path):
    given = ("--map", ARCADE, "--fixes", long_walk / "fixes.csv", "--walker", result / "walker.toml")
    code, _, summary = smoothed(long_walk / "walk.txt", tmp_path, *given)
    assert code == 0
    assert summary["settings"]["walker"]["profile"]["E_length"] != 0
    assert summary["calibration"][-1]["R_s"]["value"] == pytest.approx(1.0, abs=0.05)


def test_a_taller_walker_takes_longer_steps(arcade_walk, tmp_path):
    """The option comes before the height in the walker's file."""
    lengths = {h: length_of_steps(arcade_walk, tmp_path / "s.csv", "--height", h) for h in (1.5, 1.9)}
    assert lengths[1.9] / lengths[1.5] == pytest.approx(1.9 / 1.5, rel=0.02)
    (tmp_path / "walker.toml").write_text("height = 1.50\n")
    given = ("--walker", tmp_path / "walker.toml", "--height", 1.9, "--no-recorded-fixes")
    _, _, summary = smoothed(arcade_walk, tmp_path / "out", *given)
    assert summary["settings"]["walker"]["height"] == 1.9
    assert summary["distance"] == pytest.approx(lengths[1.9], rel=0.02)


# Fixes


def fixes(folder, lines, columns="time,x,y,sigma"):
    (folder / "given.csv").write_text("\n".join([columns, *(",".join(map(str, line)) for line in lines)]) + "\n")
    return "--fixes", folder / "given.csv"


@pytest.fixture(scope="module")
def truth(long_walk):
    return read_trajectory(long_walk / "truth.csv")


def test_fixes_that_are_all_wrong_end_degraded(long_walk, truth, tmp_path):
    scattered = np.random.default_rng(0).uniform(-500, 500, (12, 2)).tolist()
    times = np.linspace(truth.time[0] + 1, truth.time[-1] - 1, 12).tolist()
    given = fixes(tmp_path, [(t, x, y, 1.0) for t, (x, y) in zip(times, scattered, strict=True)])
    code, errors, summary = smoothed(long_walk / "walk.txt", tmp_path / "out", *given)
    assert (code, len(errors), len(summary["fixes"])) == (3, 1, 12)
    missing = "a place: the fixes contradict the steps and one another"
    assert missing in errors[0]
    assert summary["missing"] == [missing]
    assert any("is a guess" in warning for warning in summary["warnings"])
    walked = summary["steps"] * 0.7
    assert summary["distance"] == pytest.approx(walked, rel=0.3), "the walk is the steps', not the fixes'"


def test_fixes_a_thousand_times_a_second_cost_no_more_than_those_of_the_fastest_receiver(long_walk, truth, tmp_path):
    """Each costs the solver milliseconds; of 20 000 in twenty seconds some hundred are used, and a note says so."""
    given = fixes(tmp_path, [(round(truth.time[0] + 1 + n / 1000, 3), 0, 0, 1.0) for n in range(20_000)])
    code, _, summary = smoothed(long_walk / "walk.txt", tmp_path / "out", *given)
    assert code in (0, 3)
    assert any("20000 fixes: more than 25 per second" in warning for warning in summary["warnings"])
    assert 100 < len(summary["fixes"]) < 5000


def test_a_csv_says_which_fixes_one_receiver_made(long_walk, truth, tmp_path):
    """Those of a source share its error: the region of the walk is wider than of independent ones."""
    sigma, times = {}, np.arange(truth.time[0] + 1, truth.time[-1] - 1, 1.0).tolist()
    for source in ("", "ublox"):
        given = fixes(tmp_path, [(t, 0, 0, 4.0, source) for t in times], "time,x,y,sigma,source")
        sigma[source] = smoothed(long_walk / "walk.txt", tmp_path / f"out{source}", *given)[2]["sigma"]
    assert sigma["ublox"] > 2 * sigma[""]


# A start heading by the user


@pytest.fixture(scope="module")
def start_heading(truth, long_walk, tmp_path_factory):
    """A function of a verb, a number of true fixes and a wrong angle [deg]: exit code, summary, mean error [m]."""
    (x, y), (to_x, to_y) = ROUTE[:2]
    first = np.degrees(np.arctan2(to_x - x, to_y - y))  # of the first leg, in compass degrees from +y

    def run_with(verb, number, off):
        out = tmp_path_factory.mktemp("start")
        at = np.linspace(0, len(truth) - 1, number).astype(int)
        given = fixes(out, [(truth.time[n], *truth.position[n], 1.0) for n in at])
        heading = ("--start-heading", (first + off + 180) % 360 - 180)
        code, _, errors = run(verb, long_walk / "walk.txt", *given, *heading, "--no-report", "--out", out / "out")
        assert code in (0, 3), errors
        track = read_trajectory(out / "out" / "trajectory.csv")
        pairs = evaluation.pair(track, truth)
        return code, summary_of(out / "out"), np.hypot(*(pairs.estimate - pairs.truth).T).mean()

    return run_with


LIVE = thorough("replay")


@pytest.mark.parametrize("verb", ["smooth", LIVE])
def test_a_start_heading_decides_the_direction_from_one_fix(verb, start_heading):
    """The control: a quarter turn off, nothing contradicts it, and the walk goes there."""
    assert start_heading(verb, 1, 0)[2] < 5
    assert start_heading(verb, 1, 90)[2] > 5


@pytest.mark.parametrize(
    ("verb", "off"),
    [("smooth", 0), ("smooth", 90), ("replay", 90)]
    + [thorough(*case) for case in (("smooth", 180), ("replay", 0), ("replay", 180))],
)
def test_fixes_overrule_a_wrong_start_heading_and_the_verdict_says_so(verb, off, start_heading):
    code, summary, error = start_heading(verb, 6, off)
    assert error < 2
    wrong = any("the start heading is wrong" in reason["text"] for reason in summary["verdict"]["reasons"])
    assert (wrong, code) == ((off > 0), 3 if off else 0)


# Plans and floors


def test_a_plan_beyond_the_walk_is_not_used(long_walk, tmp_path):
    """With fixes 100 m from the plan, in reach of the walk, the walls are not used, and the summary has a warning."""
    moved = [(row["time"], float(row["x"]) + 165, row["y"], row["sigma"]) for row in rows(long_walk / "fixes.csv")]
    given = ("--map", ARCADE, *fixes(tmp_path, moved))
    code, _, summary = smoothed(long_walk / "walk.txt", tmp_path / "out", *given)
    assert any("near the floor plan" in warning for warning in summary["warnings"])
    assert (code, summary["probability"], summary["verdict"]["state"]) == (3, 0, "doubtful")


def test_a_plan_without_a_floor_label_is_used(long_walk, tmp_path):
    """The label of a plan with one floor is optional (docs/formats.md)."""
    plan = json.loads(ARCADE.read_text())
    del plan["pdr_graph"]["floor"]
    (tmp_path / "plan.geojson").write_text(json.dumps(plan))
    unlabelled = [(row["time"], row["x"], row["y"], row["sigma"]) for row in rows(long_walk / "fixes.csv")]
    given = ("--map", tmp_path / "plan.geojson", *fixes(tmp_path, unlabelled))
    code, _, summary = smoothed(long_walk / "walk.txt", tmp_path / "out", *given)
    assert (code, summary["floor"]) == (0, None)
    assert summary["wall_crossings"] <= 2


@pytest.fixture(scope="module")
def two_floors(tmp_path_factory):
    """A walk up the stairs and down in the lift."""
    folder = tmp_path_factory.mktemp("floors")
    assert run("simulate", "two_floors", "--out", folder).code == 0
    return folder


def test_up_the_stairs_and_down_in_the_lift(two_floors, tmp_path):
    """98 % of the time on the right floor, changes where stairs and lift are; one step of 172 may touch a wall."""
    given = ("--map", TWO_FLOORS, "--floor", "1", "--fixes", two_floors / "fixes.csv")
    code, errors, summary = smoothed(two_floors, tmp_path, *given)
    assert code == 0, errors
    assert summary["floors"] == ["1", "2", "1"]
    assert [climb["kind"] for climb in summary["climbs"]] == ["stairs", "lift"]
    track, building = read_trajectory(tmp_path / "trajectory.csv"), Building.load(TWO_FLOORS)
    scores = evaluation.evaluate(track, read_trajectory(two_floors / "truth.csv"), building)
    assert scores["fe"] > 0.98
    assert scores["ce"]["p50"] < 1.0
    assert scores["oe"] < 0.01
    for row, (before, after) in enumerate(zip(track.floor, track.floor[1:], strict=False), start=1):
        if before != after:
            leading = [c for c in building.connections if building.index(after) in c.floors]
            assert min(connection.distance(track.position[[row]])[0] for connection in leading) < 1.0


@pytest.mark.thorough
def test_without_fixes_the_floor_is_sought_with_the_place(two_floors, tmp_path):
    """The barometer climbs one floor: the walk begins on the lower one."""
    code, _, summary = smoothed(two_floors, tmp_path, "--map", TWO_FLOORS)
    assert code in (0, 3)
    assert summary["floors"] == ["1", "2", "1"]
    assert summary["routes"]


def test_a_radio_map_of_one_walk_gives_fixes_to_the_next(tmp_path):
    """Made from recordings and results of smooth; in another frame it is an error of one line."""
    more = {"recorder": "sensor_logger", "wifi": {"access_points": 15}, "fixes": {"period": 5.0}}
    for seed in (1, 2):
        write(simulate(simulated.scenario(ROUTE[:4], seed, **more)), tmp_path / f"walk{seed}")
    first, result, radio_map = tmp_path / "walk1", tmp_path / "result", tmp_path / "arcade.npz"
    assert smoothed(first, result, "--map", ARCADE, "--fixes", first / "fixes.csv")[0] == 0
    code, printed, errors = run("radio-map", first, result, "--out", radio_map)
    assert (code, errors) == (0, [])
    assert "scans of" in printed
    more = run("radio-map", "add", radio_map, first, result, "--out", tmp_path / "more.npz")
    assert "2 recordings" in more.output
    second = (tmp_path / "walk2", tmp_path / "second", "--no-recorded-fixes", "--radio-map", radio_map)
    for plan in (("--map", ARCADE), ()):  # or in the map's own frame
        _, _, summary = smoothed(*second, *plan)
        assert {reason["source"] for reason in summary["verdict"]["reasons"]} <= {"place", "route"}, (
            "how sure, not what is wrong"
        )
        assert len(summary["fixes"]) > 5
    elsewhere = tmp_path / "elsewhere.geojson"
    elsewhere.write_text(ARCADE.read_text().replace('"origin": [135.0, 35.0]', '"origin": [135.0, 34.9999]'))
    code, errors, _ = smoothed(*second, "--map", elsewhere)
    assert (code, len(errors)) == (2, 1)
    assert "frame" in errors[0]
    assert run("radio-map", first, "--out", radio_map).code == 2
