"""Files, texts and exit codes of the command line, on a simulated walk through maps/arcade."""

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import recorders
import simulated
from commands import run
from typer.testing import CliRunner

import pdr_graph
from pdr_graph.apps import cli
from pdr_graph.io.loading import READERS
from pdr_graph.lab.simulation import scenario

ROOT = Path(__file__).parent.parent
MAPS = ROOT / "maps"
ARCADE, EIGHT = MAPS / "arcade.geojson", MAPS / "figure_eight.geojson"
ROUTE = np.array([(2.5, 18.0), (6.8, 18.2), (6.8, 27.8), (27.6, 27.6), (27.9, 8.0), (40.0, 7.7)])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("walk")
    simulated.indoor_location(folder, ROUTE, seed=4)
    return folder


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """A walk of 27 s, for what does not depend on the way."""
    return simulated.arcade(tmp_path_factory.mktemp("short"), recorder="indoor_location")


@pytest.fixture(scope="module")
def result(folder):
    out = folder / "result"
    code, _, errors = run("smooth", folder / "walk.txt", "--map", ARCADE, "--fixes", folder / "fixes.csv", "--out", out)
    assert (code, errors) == (0, [])
    return out


def rows(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_truth_is_scored_and_not_used_by_the_estimate(tmp_path):
    walk, scored = simulated.arcade(tmp_path / "walk"), "Accuracy against ground truth"
    for verb in ("smooth", "replay"):
        command = [verb, walk, "--map", walk / "plan.geojson", "--fixes", walk / "fixes.csv", "--out"]
        with_truth, without = tmp_path / verb, tmp_path / f"{verb} without"
        assert run(*command, with_truth, "--truth", walk / "truth.csv")[0] == run(*command, without)[0]
        assert (with_truth / "trajectory.csv").read_bytes() == (without / "trajectory.csv").read_bytes()
        reports = [(out / "report.html").read_text(encoding="utf-8") for out in (with_truth, without)]
        assert [scored in report for report in reports] == [True, False]


def test_truth_far_from_the_walk_is_reported_as_missing(folder, result, tmp_path):
    table = np.genfromtxt(result / "trajectory.csv", delimiter=",", skip_header=1, usecols=(0, 1, 2))
    elsewhere = tmp_path / "elsewhere.csv"
    table[:, 2] += 135  # farther than the walk is wide, and within reach
    np.savetxt(elsewhere, table, delimiter=",", header="time,x,y", comments="", fmt="%.3f")
    walk = [folder / "walk.txt", "--map", ARCADE, "--fixes", folder / "fixes.csv", "--out", tmp_path / "out"]
    code, _, _ = run("smooth", *walk, "--truth", elsewhere)
    assert code == 3
    assert "elsewhere.csv" in json.loads((tmp_path / "out" / "summary.json").read_text())["missing"][0]


def test_smooth_writes_all_documented_files(result):
    assert {p.name for p in result.iterdir()} == {
        "trajectory.csv",
        "trajectory.geojson",
        "trajectory.gpx",
        "trajectory.tum",
        "truth.tum",
        "figure.png",
        "report.html",
        "summary.json",
        "walker.toml",
    }
    table = rows(result / "trajectory.csv")
    assert list(table[0]) == [
        "time",
        "x",
        "y",
        "heading",
        "floor",
        "sigma_x",
        "sigma_y",
        "cov_xy",
        "sigma_heading",
    ]
    summary = json.loads((result / "summary.json").read_text())
    assert len(table) == summary["steps"] + 2
    assert {row["floor"] for row in table} == {"1"}
    times = np.array([float(row["time"]) for row in table])
    assert times[0] == pytest.approx(1.7e9, abs=0.03), "times on the recorder's clock, not from the start"
    assert np.all(np.diff(times) >= 0)


def test_the_summary_has_frame_calibration_and_reasons(result):
    summary = json.loads((result / "summary.json").read_text())
    assert summary["frame"] == {"kind": "enu", "origin_lat": 35.0, "origin_lon": 135.0, "epsg": None}
    assert set(summary["calibration"][0]) == {"start", "R_s", "R_d", "b"}
    outlier = min(summary["fixes"], key=lambda fix: fix["weight"])
    assert outlier["weight"] < 0.1, "the simulated outlier"
    assert "outlier" in outlier["reason"]
    assert summary["missing"] == []
    assert set(summary["seconds"]) == {"reading", "steps", "estimate", "write", "report"}
    assert summary["wall_crossings"] <= 2
    assert {"pdr_graph", "gtsam", "numpy", "vqf", "python"} <= set(summary["versions"])


def test_evaluate_scores_the_graph_better_than_filter_and_dead_reckoning(folder, result):
    scores = {}
    for method in ("pdr", "filter", "rts"):
        out = folder / method
        options = ("--fixes", folder / "fixes.csv", "--method", method, "--no-report", "--out", out)
        code, _, _ = run("smooth", folder / "walk.txt", *options)
        assert code == 3, (
            "the direction by one fix, and the stride by the filter, which rejects good fixes, are doubtful"
        )
        scores[method] = score(out, folder)
        assert not (out / "trajectory.gpx").exists(), "metric fixes alone have no latitude"
    scores["graph"] = score(result, folder)
    assert scores["graph"]["ce"]["p95"] < 3.0
    assert scores["graph"]["oe"] < 0.02
    assert scores["graph"]["ce"]["p50"] < min(scores["pdr"]["ce"]["p50"], scores["filter"]["ce"]["p50"])


def score(out, folder):
    code, printed, errors = run(
        "evaluate", out / "trajectory.csv", folder / "truth.csv", "--map", ARCADE, "--json", "--pairing", "nearest"
    )
    assert (code, errors) == (0, [])
    values = json.loads(printed)
    assert list(values) == ["ce", "he", "eag", "ve", "ca", "oe", "fe", "n"]
    assert list(values["ce"]) == ["p50", "p75", "p95", "mean", "max"]
    return values


def test_rate_resamples_the_trajectory(folder):
    out = folder / "ten"
    arguments = ("--fixes", folder / "fixes.csv", "--rate", "10", "--out", out)
    assert run("smooth", folder / "walk.txt", *arguments)[0] == 0
    times = np.array([float(row["time"]) for row in rows(out / "trajectory.csv")])
    assert np.diff(times)[:-1] == pytest.approx(0.1, abs=1e-3)


def test_without_any_position_the_walk_starts_at_the_origin(folder):
    out = folder / "nowhere"
    assert run("smooth", folder / "walk.txt", "--no-recorded-fixes", "--out", out)[0] == 0
    first = rows(out / "trajectory.csv")[0]
    assert [float(first[k]) for k in ("x", "y", "heading")] == pytest.approx([0, 0, 0], abs=1e-3)
    summary = json.loads((out / "summary.json").read_text())
    assert summary["frame"]["kind"] == "local"
    assert any("no position fix" in w for w in summary["warnings"])


def test_steps_writes_a_table_of_steps(folder):
    assert run("steps", folder / "walk.txt", "--out", folder / "steps.csv")[0] == 0
    table = rows(folder / "steps.csv")
    assert list(table[0]) == ["time", "length", "turn", "sigma_length", "sigma_turn"]
    assert all(0.2 <= float(row["length"]) <= 1.2 for row in table[1:])


def test_a_profile_of_calibrate_corrects_the_length_of_a_walk(tmp_path):
    """Calibrated on a known route, a figure of eight."""
    assert run("simulate", "figure_eight", "--out", tmp_path / "eight")[0] == 0
    profile = tmp_path / "walker.toml"
    arguments = ("--route", MAPS / "figure_eight.geojson", "--out", profile)
    code, printed, errors = run("calibrate", tmp_path / "eight", *arguments)
    assert (code, errors) == (0, [])
    assert printed.startswith("2 x the route")
    assert "E_length" in profile.read_text()
    assert (tmp_path / "walker.png").stat().st_size > 10_000
    walked = {}
    for name, known in (("unknown", ()), ("known", ("--walker", profile))):
        assert run("steps", tmp_path / "eight", *known, "--out", tmp_path / f"{name}.csv")[0] == 0
        walked[name] = sum(float(row["length"]) for row in rows(tmp_path / f"{name}.csv"))
    true = sum(np.hypot(*np.diff(truth_of(tmp_path / "eight"), axis=0).T))
    assert abs(walked["known"] - true) < 0.04 * true < abs(walked["unknown"] - true)


def truth_of(folder):
    return np.array([(float(row["x"]), float(row["y"])) for row in rows(folder / "truth.csv")])


def test_the_profile_of_smooth_is_an_input_of_the_next_walk(result, folder):
    out = folder / "again"
    arguments = ("--map", ARCADE, "--fixes", folder / "fixes.csv", "--walker", result / "walker.toml", "--out", out)
    assert run("smooth", folder / "walk.txt", *arguments)[0] == 0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["settings"]["walker"]["profile"]["E_length"] != 0
    assert summary["calibration"][-1]["R_s"]["value"] == pytest.approx(1.0, abs=0.05)


def test_map_show_draws_a_plan(tmp_path):
    code, printed, _ = run("map", "show", ARCADE, "--out", tmp_path / "plan.png")
    assert code == 0
    assert "m² walkable" in printed
    assert (tmp_path / "plan.png").stat().st_size > 10_000


COMMANDS = [
    ("smooth",),
    ("replay",),
    ("steps",),
    ("calibrate",),
    ("radio-map",),
    ("evaal",),
    ("evaluate",),
    ("compare",),
    ("simulate",),
]
COMMANDS += [("map", command) for command in ("show", "check")]
COMMANDS += [("lifelog", command) for command in ("add", "build", "show", "export")]
CORRECTIONS = ("was-at", "merge", "split", "was", "not-me", "name", "forget", "list", "undo")
COMMANDS += [("lifelog", "correct", command) for command in CORRECTIONS]


def inside(*arguments):
    """Run the command in this process, which is quicker; return its exit code and output."""
    done = CliRunner().invoke(cli.app, [str(argument) for argument in arguments])
    return done.exit_code, done.output


@pytest.mark.parametrize("group", [("map",), ("lifelog",), ("lifelog", "correct")], ids=" ".join)
def test_no_line_of_a_list_of_commands_is_cut_off(group):
    assert "..." not in inside(*group, "--help")[1].split("Commands:")[1]


def test_help_lists_the_commands():
    code, printed = inside("--help")
    assert code == 0
    assert all(f"\n  {command[0]} " in printed for command in COMMANDS)
    assert "..." not in printed.split("Commands:")[1], "no line is cut off"


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_the_help_of_each_command_has_an_example(command):
    """On a line of its own, with existing options only."""
    code, printed = inside(*command, "--help")
    assert code == 0
    about, options = printed.split("\nOptions:\n")
    examples = [line.split() for line in about.splitlines() if line.startswith(f"  pdr-graph {' '.join(command)} ")]
    assert examples
    assert all(f"  {word} " in options for example in examples for word in example if word.startswith("--"))


def test_version_prints_the_version():
    assert run("--version") == (0, f"pdr-graph {pdr_graph.__version__}\n", [])


def test_a_path_without_a_command_suggests_one(folder):
    code, _, errors = run("walk.txt", cwd=folder)
    assert (code, len(errors)) == (2, 1)
    assert errors[0].endswith("pdr-graph smooth walk.txt")


def test_a_misspelt_command_suggests_the_right_one():
    code, _, errors = run("smoth", "walk.txt")
    assert code == 2
    assert "'smooth'" in errors[-1]


def exported(recorder, folder):
    """A walk in the files of one recorder, with a space in the name."""
    name, write = recorders.EXPORTS[recorder]
    path, content = folder / name.replace("walk", "walk 1"), write(recorders.sample())
    if isinstance(content, dict):
        return (recorders.in_zip if path.suffix == ".zip" else recorders.in_folder)(path, content)
    path.write_text(content)
    return path


@pytest.mark.parametrize("command", ["smooth", "replay"])
@pytest.mark.parametrize("recorder", [reader.__name__.rsplit(".", 1)[1] for reader in READERS])
def test_one_command_makes_a_report_of_every_recorders_file(tmp_path, monkeypatch, recorder, command):
    """Without options: the last line of the output is the report, in the current folder."""
    monkeypatch.chdir(tmp_path)
    code, printed = inside(command, exported(recorder, tmp_path))
    out = Path("walk 1-smoothed" if command == "smooth" else "walk 1-replayed")
    assert code == (3 if recorder == "oxford_steps" else 0), printed
    assert f"-> {out / 'report.html'}\n" in printed
    assert all((out / page).stat().st_size > 10_000 for page in ("report.html", "figure.png"))
    assert code == 0 or "pdr-graph: finished without " in printed


def test_a_lifelog_is_shown_without_options(tmp_path, monkeypatch):
    """The timeline on the terminal, and a folder named after the store with the report."""
    monkeypatch.chdir(tmp_path)
    assert inside("lifelog", "add", "days.db", exported("phyphox", tmp_path), "--begins", "2024-05-01T09:00")[0] == 0
    assert inside("lifelog", "build", "days.db")[0] == 0
    code, printed = inside("lifelog", "show", "days.db")
    assert code == 0
    assert "walking" in printed
    assert printed.endswith("-> days-shown/overview.html\n")
    files = {file.name for file in Path("days-shown").iterdir()}
    assert {"overview.html", "overview.png", "report.html", "day.png", "timeline.csv"} <= files


def test_ready_scenarios_are_simulated_by_name(tmp_path, monkeypatch):
    """``simulate --help`` lists exactly those that exist."""
    monkeypatch.chdir(tmp_path)
    named = inside("simulate", "--help")[1].split("Ready scenarios:")[1].split(".")[0].split()
    assert tuple(named) == scenario.names()
    assert inside("simulate", "office")[0] == 0
    assert (tmp_path / "office" / "plan.geojson").read_bytes() == (MAPS / "office.geojson").read_bytes()
    code, _, errors = run("simulate", "atlantis", cwd=tmp_path)
    assert (code, len(errors)) == (2, 1)
    assert "arcade, campus" in errors[0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("smooth", "nowhere.txt", "--out", "o"), "nowhere.txt: found no such file"),
        (("smooth", "walk.txt", "--fixes", "nowhere.csv", "--out", "o"), "nowhere.csv"),
        (("smooth", "walk.txt", "--map", "nowhere", "--out", "o"), "nowhere"),
        (("smooth", "walk.txt", "--map", "fixes.csv", "--out", "o"), "fixes.csv"),
        (("smooth", "walk.txt", "--walker", "fixes.csv", "--out", "o"), "fixes.csv"),
        (("smooth", "fixes.csv", "--out", "o"), "are these fixes?"),
        (("smooth", "walk.txt", "--rate", "-1", "--out", "o"), "--rate"),
        (("smooth", "walk.txt", "--out", "walk.txt"), "walk.txt"),
        (("replay", "nowhere.txt", "--out", "o"), "nowhere.txt: found no such file"),
        (("replay", "walk.txt", "--lag", "soon", "--out", "o"), "--lag: found soon, expected seconds"),
        (("steps", "truth.csv", "--out", "o.csv"), "is this a trajectory?"),
        (("steps", "walk.txt", "--out", "no/such/folder/o.csv"), "no/such/folder"),
        (("evaluate", "walk.txt", "truth.csv"), "header"),
        (("evaluate", "truth.csv", "nowhere.csv"), "nowhere.csv"),
        (("map", "show", "truth.csv"), "truth.csv"),
        (("calibrate", "walk.txt", "--route", "nowhere.geojson", "--out", "o.toml"), "nowhere.geojson"),
        (("calibrate", "walk.txt", "--route", str(ARCADE), "--out", "o.toml"), "'link'"),
        (("calibrate", "walk.txt", "--route", str(EIGHT), "--out", "o.toml"), "leave the route"),
    ],
)
def test_bad_input_ends_with_one_line_and_exit_code_2(folder, arguments, message):
    code, _, errors = run(*arguments, cwd=folder)
    assert code == 2
    assert len(errors) == 1, errors
    assert message in errors[0]


@pytest.mark.parametrize("command", ["smooth", "replay"])
def test_an_unknown_file_ends_with_a_list_of_recorders_and_writes_nothing(tmp_path, command):
    (tmp_path / "notes.csv").write_text("8342,1,1\n")
    code, _, errors = run(command, "notes.csv", cwd=tmp_path)
    assert (code, len(errors)) == (2, 1)
    assert [name for name in (reader.NAME for reader in READERS) if name not in errors[0]] == []
    assert [path.name for path in tmp_path.iterdir()] == ["notes.csv"]


def test_evaluating_with_another_clock_is_an_error(folder, result, tmp_path):
    (tmp_path / "truth.csv").write_text("time,x,y\n1,2,3\n2,3,4\n")
    code, _, errors = run("evaluate", result / "trajectory.csv", tmp_path / "truth.csv")
    assert code == 2
    assert "same clock" in errors[0]


def test_if_the_graph_cannot_be_solved_the_filter_is_written(folder, tmp_path, monkeypatch):
    """Everything else is written, and the summary lists what is missing."""
    from pdr_graph import walk
    from pdr_graph.apps.report.output_files import smooth_recording

    def indeterminate(graph):
        raise RuntimeError("Indeterminant linear system detected\nmore lines of it")

    monkeypatch.setattr(walk, "smooth", indeterminate)
    missing = smooth_recording(folder / "walk.txt", tmp_path, walk.Options(fixes=folder / "fixes.csv"))
    assert "Indeterminant linear system" in missing[0]
    assert json.loads((tmp_path / "summary.json").read_text())["missing"] == list(missing)
    assert (tmp_path / "figure.png").exists()


def test_a_plan_elsewhere_is_not_used(folder, tmp_path):
    """With fixes 100 m from the plan, in reach of the walk, the walls are not used, and the summary has a warning."""
    elsewhere = tmp_path / "fixes.csv"
    lines = (folder / "fixes.csv").read_text().splitlines()
    moved = [f"{t},{float(x) + 165},{y},{s}" for t, x, y, s, _ in (line.split(",") for line in lines[1:])]
    elsewhere.write_text("\n".join(["time,x,y,sigma", *moved]) + "\n")
    out = tmp_path / "out"
    assert run("smooth", folder / "walk.txt", "--map", ARCADE, "--fixes", elsewhere, "--out", out)[0] == 3
    summary = json.loads((out / "summary.json").read_text())
    assert any("near the floor plan" in warning for warning in summary["warnings"])
    assert summary["probability"] == 0
    assert summary["verdict"]["state"] == "doubtful"


def test_a_plan_without_a_floor_label_is_used(folder, tmp_path):
    """The label of a plan with one floor is optional (docs/formats.md)."""
    plan, fixes, out = json.loads(ARCADE.read_text()), tmp_path / "fixes.csv", tmp_path / "out"
    del plan["pdr_graph"]["floor"]
    (tmp_path / "plan.geojson").write_text(json.dumps(plan))
    lines = (folder / "fixes.csv").read_text().splitlines()
    fixes.write_text("\n".join(line.rpartition(",")[0] for line in lines) + "\n")
    assert (
        run("smooth", folder / "walk.txt", "--map", tmp_path / "plan.geojson", "--fixes", fixes, "--out", out)[0] == 0
    )
    summary = json.loads((out / "summary.json").read_text())
    assert summary["wall_crossings"] <= 2
    assert summary["floor"] is None


def test_a_radio_map_of_one_walk_gives_fixes_to_the_next(tmp_path):
    """Made from recordings and results of smooth; in another frame it is an error of one line."""
    from pdr_graph.lab.simulation.recorders import write
    from pdr_graph.lab.simulation.simulate import simulate

    more = {"recorder": "sensor_logger", "wifi": {"access_points": 15}, "fixes": {"period": 5.0}}
    for seed in (1, 2):
        write(simulate(simulated.scenario(ROUTE[:4], seed, **more)), tmp_path / f"walk{seed}")
    first, result, radio_map = tmp_path / "walk1", tmp_path / "result", tmp_path / "arcade.npz"
    fixes = first / "fixes.csv"
    assert run("smooth", first, "--map", ARCADE, "--fixes", fixes, "--no-report", "--out", result)[0] == 0
    code, printed, errors = run("radio-map", first, result, "--out", radio_map)
    assert (code, errors) == (0, [])
    assert "scans of" in printed
    second = (tmp_path / "walk2", "--no-recorded-fixes", "--radio-map", radio_map, "--out", tmp_path / "second")
    second += ("--no-report",)
    assert run("smooth", *second, "--map", ARCADE)[0] == 0
    summary = json.loads((tmp_path / "second" / "summary.json").read_text())
    assert len(summary["fixes"]) > 5
    assert run("smooth", *second)[0] == 0, "without a plan, in the map's own frame"
    elsewhere = tmp_path / "elsewhere.geojson"
    elsewhere.write_text(ARCADE.read_text().replace('"origin": [135.0, 35.0]', '"origin": [135.0, 34.9999]'))
    code, _, errors = run("smooth", *second, "--map", elsewhere)
    assert (code, len(errors)) == (2, 1)
    assert "frame" in errors[0]
    assert run("radio-map", first, "--out", radio_map)[0] == 2


HOSTILE = ("walk-\udcff", "walk\x1b[31mred\a", "$\\frac", "two\nlines")  # not UTF-8; what terminals, TeX, lines obey


@pytest.mark.parametrize("command", ["smooth", "replay"])
@pytest.mark.parametrize("name", HOSTILE)
def test_a_name_of_any_bytes_is_data_and_no_command(short, tmp_path, command, name):
    """Every result is written, the summary has the exact name, and the terminal gets one printable line for each."""
    shutil.copy(short / "walk.txt", tmp_path / name)
    code, out, err = run(command, name, "--out", "result", cwd=tmp_path)
    assert (code, err) == (0, [])
    assert all(line.isprintable() for line in out.splitlines())
    assert {"figure.png", "report.html", "trajectory.csv"} <= {path.name for path in (tmp_path / "result").iterdir()}
    assert json.loads((tmp_path / "result" / "summary.json").read_text())["recording"].startswith(name)


def test_a_result_of_a_hostile_name_is_one_line(short, tmp_path):
    shutil.copy(short / "walk.txt", tmp_path / "two\nlines")
    _, out, _ = run("smooth", "two\nlines", cwd=tmp_path)
    assert out.splitlines()[-1] == "-> two\ufffdlines-smoothed/report.html"


def test_scores_are_in_metres_so_that_a_table_in_degrees_is_refused(tmp_path):
    """As a trajectory, as a truth, and to compare; ``smooth --truth`` takes it, since it knows the frame."""
    degrees, metres = tmp_path / "degrees.csv", tmp_path / "metres.csv"
    degrees.write_text("time,lat,lon\n1,49.1,11.1\n2,49.1,11.2\n")
    metres.write_text("time,x,y\n1,0,0\n2,1,0\n")
    other = tmp_path / "other.csv"
    other.write_text("time,x,y\n1,0,1\n2,1,1\n")
    for arguments in (
        ("evaluate", degrees, degrees),
        ("evaluate", metres, degrees),
        ("compare", metres, other, "--truth", degrees, "--out", tmp_path / "compared.png"),
    ):
        code, _, errors = run(*arguments)
        assert code == 2
        assert len(errors) == 1
        assert "degrees.csv, line 1" in errors[0]
        assert "time,x,y" in errors[0]
