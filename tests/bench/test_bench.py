"""``pdr-graph bench``: data sets by methods, ours and one's own, with resumption; and numbers set by ``--set``."""

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import run
from numpy.testing import assert_allclose, assert_array_equal
from tiers import thorough

from pdr_graph.apps.bench.data_sets import BenchWalk, given, recorded
from pdr_graph.apps.bench.matrix import RESULTS, calibration, error_percentiles, low_walks, with_intervals
from pdr_graph.apps.bench.methods import live
from pdr_graph.apps.replay import events_within
from pdr_graph.frames import Frame
from pdr_graph.gait.walker import Walker
from pdr_graph.priors import WALKER
from pdr_graph.types import Beacons, Fixes, Recording, Signal, Trajectory
from pdr_graph.walk import Evidence, Options, observe, read

MATRIX = """data_sets = ["walks"]
methods = ["graph", "pdr", "own:straight", "copied", "own:broken"]
given = ["recorded", "first and last", "every second"]
[commands]
copied = "python3 copies.py {folder} {out}"
"""
OWN = """import numpy as np
def straight(evidence):
    return np.column_stack([evidence.fixes.time, evidence.fixes.position])
def broken(evidence):
    raise RuntimeError("no weights")
"""
COPIES = """import csv, sys
folder, out = sys.argv[1:]
rows = list(csv.DictReader(open(folder + "/fixes.csv")))
assert next(open(folder + "/accelerometer.csv")) == "time,x,y,z\\n"
open(out, "w").write("".join(f"{r['time']} {r['x']} {r['y']} 0 0 0 0 1\\n" for r in rows))
"""


HERE = "--workers", 1  # in this process: workers take seconds to start
OWN_DATA = """from functools import partial
from pdr_graph.apps.bench.data_sets import recorded
from pdr_graph.walk import Options
def walks(data):
    for path in sorted(data.glob("walks/*")):
        files = {"plan": path / "plan.geojson", "fixes": path / "fixes.csv", "truth": path / "truth.csv"}
        yield path.name, partial(recorded, path, Options(**files))
"""


@pytest.fixture(scope="module")
def bench(arcade_walk, tmp_path_factory):
    """A folder with a matrix, the results of it, and two walks of one's own."""
    folder = tmp_path_factory.mktemp("bench")
    for name in ("one", "two"):
        shutil.copytree(arcade_walk, folder / "walks" / name)
    (folder / "matrix.toml").write_text(MATRIX)
    (folder / "own.py").write_text(OWN)
    (folder / "copies.py").write_text(COPIES)
    assert run("bench", "run", "matrix.toml", cwd=folder).code == 3, "a method failed"
    return folder


def rows_of(folder):
    return [json.loads(line) for line in (folder / "bench" / RESULTS).read_text().split("\n") if line]


def test_ones_own_methods_stand_beside_ours(bench):
    code, printed, errors = run("bench", "stats", "matrix.toml", "--csv", "t.csv", "--out", "e.png", cwd=bench)
    assert (code, errors) == (0, [])
    with (bench / "t.csv").open(encoding="utf-8") as file:
        table = {(row["given"], row["method"]): row for row in csv.DictReader(file)}
    assert set(table) == {
        (given, method)
        for given in ("recorded", "first and last")  # a dense truth has no second place
        for method in ("graph", "pdr", "own:straight", "copied", "own:broken")
    }
    assert {row["walks"] for row in table.values()} == {"2"}
    straight, copied = (
        next(row["errors"] for row in rows_of(bench) if (row["given"], row["method"]) == ("recorded", name))
        for name in ("own:straight", "copied")
    )
    # TUM has microseconds, so that a place at the very end may be too late
    assert_allclose(*np.array([(a, b) for a, b in zip(straight, copied, strict=True) if b is not None]).T, atol=0.001)
    assert table["recorded", "own:broken"]["failed"] == "2"
    assert "failed: walks | one | recorded | own:broken: RuntimeError: no weights" in printed
    assert (bench / "e.png").stat().st_size > 10_000


def test_a_row_has_the_errors_of_evaluate(bench, arcade_walk, tmp_path):
    run("smooth", arcade_walk, "--fixes", arcade_walk / "fixes.csv", "--no-report", "--out", tmp_path / "out")
    scores = run("evaluate", tmp_path / "out" / "trajectory.csv", arcade_walk / "truth.csv", "--json").output
    [row] = [r for r in rows_of(bench) if (r["walk"], r["given"], r["method"]) == ("one", "recorded", "graph")]
    assert_allclose(
        np.percentile(row["errors"], [50, 95]), [json.loads(scores)["ce"][p] for p in ("p50", "p95")], atol=0.02
    )
    assert len(row["squared_distances"]) == len(row["log_scores"]) == len(row["energy_scores"]) == len(row["errors"])
    assert row["verdict"] == "ok"


def test_an_interrupted_run_goes_on(bench):
    results = bench / "bench" / RESULTS
    whole = results.read_text()
    cut = whole.splitlines(keepends=True)[:4]
    results.write_text("".join(cut) + '{"data_set": "walks", "wal')
    code, printed, _ = run("bench", "run", "matrix.toml", *HERE, "--only", "| graph", cwd=bench)
    made = len([row for row in map(json.loads, whole.splitlines()[4:]) if row["method"] == "graph"])
    assert (code, printed.split()[0]) == (0, str(made))
    assert run("bench", "run", "matrix.toml", *HERE, "--only", "| graph", cwd=bench).output.startswith("0 rows")
    command = ["bench", "run", "matrix.toml", *HERE, "--again", "--only"]
    assert run(*command, "walks |", "--only", "| recorded | pdr", cwd=bench).output.startswith("2 rows made")
    results.write_text(whole)


def test_a_data_set_of_ones_own_is_a_function(bench):
    """Of the same recordings as a folder: the same errors."""
    (bench / "own_data.py").write_text(OWN_DATA)
    settings = 'data_sets = ["walks", "own_data:walks"]', 'given = ["first and last"]', 'methods = ["pdr"]'
    (bench / "other.toml").write_text("\n".join([*settings, 'out = "other"', 'data = "."']))
    assert run("bench", "run", "other.toml", *HERE, cwd=bench).output.startswith("4 rows made")
    rows = [json.loads(line) for line in (bench / "other" / RESULTS).read_text().split("\n") if line]
    errors = {(row["data_set"], row["walk"]): row["errors"] for row in rows}
    for walk in ("one", "two"):
        assert len(errors["walks", walk]) > 50
        assert errors["own_data:walks", walk] == errors["walks", walk]


def test_live_is_pushed_what_replay_pushes(arcade_walk):
    """A fix an hour after the recording is not, nor the steps that its samples show."""
    evidence = observe(read(arcade_walk, Options(fixes=arcade_walk / "fixes.csv")))
    late = replace(evidence, fixes=Fixes.concatenate([evidence.fixes, evidence.fixes[-1:].shifted(3600.0)]))
    events, outside = events_within(late)
    assert len(outside) == 1
    assert {type(event).__name__ for event in events} == {"Samples", "Fixes"}
    assert max(event.time[-1] for event in events if isinstance(event, Fixes)) < 3600
    assert_array_equal(live(late).time, live(evidence).time)


def test_a_track_is_scored_by_the_walls_of_a_plan_that_it_was_not_given(arcade_walk):
    options = Options(plan=arcade_walk / "plan.geojson", truth=arcade_walk / "truth.csv")
    walk = given(recorded(arcade_walk, options), "first and last")
    assert walk.evidence.building is None
    assert not walk.plan.crosses_wall(walk.truth.position, walk.truth.floor).any()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ('data_sets = ["nowhere"]', "found 'nowhere', expected one of malls"),
        ('data_sets = ["walks"]\nmethods = ["grapf"]', "found 'grapf', expected one of graph"),
        ('data_sets = ["walks"]\nmethods = ["own:none"]', "module:function, importable here"),
        ('data_sets = ["walks"]\ngiven = ["third"]', "found 'third', expected one of recorded"),
        ('data_sets = "walks"', "found 'walks', expected data_sets"),
        ("methods = []", "methods: found []"),
        ('data_sets = ["own:none"]', "module:function, importable here"),
        ("data_sets = [", "expected TOML"),
        (None, "expected a matrix (docs/bench.md)"),
    ],
)
def test_a_wrong_matrix_is_one_line(bench, content, said):
    (bench / "wrong.toml").unlink(missing_ok=True)
    if content is not None:
        (bench / "wrong.toml").write_text(content)
    code, _, errors = run("bench", "run", "wrong.toml", *HERE, cwd=bench)
    assert (code, len(errors)) == (2, 1)
    assert said in errors[0]


def test_a_text_that_no_row_has_and_missing_data_are_one_line(bench, tmp_path):
    (bench / "malls.toml").write_text('data_sets = ["malls"]')
    for command, said in (
        (("matrix.toml", "--only", "thre"), "--only: found 'thre', expected texts of one row's name"),
        (("malls.toml", "--data", tmp_path), "malls: found no walk, expected its recordings"),
    ):
        code, _, errors = run("bench", "run", *command, cwd=bench)
        assert (code, len(errors)) == (2, 1)
        assert said in errors[0]


def walk_with(fixes, truth):
    evidence = Evidence(Recording("made", 0.0, None), Walker(), None, Frame(), fixes)
    return BenchWalk(evidence, truth)


def test_what_is_given_is_not_scored():
    """Places that are given leave the truth; of a receiver alone, what is withheld is the truth."""
    place = np.column_stack([np.arange(9.0), np.zeros(9)])
    fixes, truth = Fixes(np.arange(9.0), place + 0.5, np.ones(9)), Trajectory(10 * np.arange(9.0), place, np.zeros(9))
    ends = given(walk_with(fixes, truth), "first and last")
    assert_allclose(ends.evidence.fixes.position[:, 0], [0, 8])
    assert_allclose(ends.truth.time, 10 * np.arange(1.0, 8.0))
    thinned = given(walk_with(fixes, truth[:0]), "one in 4 s")
    assert_allclose(thinned.evidence.fixes.time, [0, 4, 8])
    assert_allclose(thinned.truth.time, [1, 2, 3, 5, 6, 7])
    assert_allclose(given(walk_with(fixes, truth[:0]), "first 3 s").truth.time, [3, 4, 5, 6, 7, 8])
    receiver = given(walk_with(fixes, truth[:0]), "first and last").evidence.fixes
    assert_allclose([*receiver.time, *receiver.sigma], [0, 8, 1, 1])
    beacons = Beacons(("a",), np.zeros((1, 2)), np.ones(1), ("",), ("a",))
    heard = BenchWalk(replace(walk_with(fixes, truth).evidence, beacons=beacons), truth)
    assert given(heard, "recorded").evidence.beacons is beacons
    assert given(heard, "recorded, no beacons").evidence.beacons is None
    field = replace(heard.evidence.walk, magnetometer=Signal(np.arange(9.0), np.ones((9, 3))))
    measured = replace(heard, evidence=replace(heard.evidence, walk=field))
    assert given(measured, "first").evidence.walk.magnetometer is field.magnetometer
    assert given(measured, "first, no compass").evidence.walk.magnetometer is None
    assert given(walk_with(fixes, truth), "recorded, plan") is None
    places = given(measured, "2 places, no times")
    [untimed] = places.evidence.walk.measurements
    assert not len(places.evidence.fixes)
    known = given(measured, "2 places")
    assert {*map(tuple, untimed.position)} == {*map(tuple, known.evidence.fixes.position)}
    assert len(known.truth) == len(places.truth) == len(truth) - 2
    assert not len(given(walk_with(fixes, truth), "nothing").evidence.fixes)


def test_the_interval_is_of_whole_walks():
    """Ten walks of equal errors each: the interval is theirs, not that of a thousand places."""
    walks = [np.full(100, error) for error in np.arange(1.0, 11.0)]
    cells = with_intervals(walks, error_percentiles, ["{:.2f}"] * 3)
    low, high = cells[0].split("(")[1].rstrip(")").split("–")
    assert float(low) <= 3.5
    assert float(high) >= 7.5


def test_coverage_is_that_of_each_level():
    """Of the squared distances of Gaussian errors, and of errors of twice the stated size."""
    squared = np.sum(np.random.default_rng(5).normal(size=(20_000, 2)) ** 2, axis=1)
    for size, shares in ((1, [50, 90, 99]), (2, [100 * (1 - (1 - p) ** 0.25) for p in (0.5, 0.9, 0.99)])):
        found = calibration(np.column_stack([size**2 * squared, squared, squared]))
        assert_allclose(found[:3], shares, atol=1)


def test_low_walks_are_counted_beside_their_number_by_chance():
    """Of walks of two places that are each inside with 90 %, independently, 0.19 have at most one."""
    squared = np.random.default_rng(3).exponential(2.0, (1000, 2))
    found, chance = low_walks([np.column_stack([each, each, each]) for each in squared]).split(" (by chance ")
    assert chance == "190.0)"
    assert abs(int(found) - 190) < 4 * np.sqrt(1000 * 0.19 * 0.81)


UNRELIABLE = """import os, signal, time
import numpy as np
def some(evidence):
    if evidence.options.fixes.parent.name == "one":
        ACTION
    return np.column_stack([evidence.fixes.time, evidence.fixes.position])
def data(folder):
    from own_data import walks
    yield from walks(folder)
    yield "three", lambda: open("no such file")
"""
FAULTS = {
    "killed": "os.kill(os.getpid(), signal.SIGKILL)",
    "hangs": "time.sleep(600)",
    "memory": "raise MemoryError",
}


@pytest.mark.parametrize("fault", ["killed", thorough("hangs"), thorough("memory")])
def test_a_walk_that_crashes_or_hangs_has_a_row_that_says_so_and_the_others_go_on(arcade_walk, tmp_path, fault):
    for name in ("one", "two"):
        shutil.copytree(arcade_walk, tmp_path / "walks" / name)
    (tmp_path / "own_data.py").write_text(OWN_DATA)
    (tmp_path / f"bad_{fault}.py").write_text(UNRELIABLE.replace("ACTION", FAULTS[fault]))
    methods = f'methods = ["bad_{fault}:some", "pdr"]'
    (tmp_path / "m.toml").write_text(f'data_sets = ["bad_{fault}:data"]\ndata = "."\n{methods}')
    code, _, errors = run("bench", "run", "m.toml", "--workers", 2, "--time-limit", 8, cwd=tmp_path, new=True)
    assert (code, len(errors)) == (3, 1), errors
    failed = {(row["walk"], row["method"]): row.get("failed") for row in rows_of(tmp_path)}
    reason = "MemoryError" if fault == "memory" else "its worker process was killed, crashed or took too long"
    assert reason in failed.pop(("one", f"bad_{fault}:some"))
    assert {failed.pop(("three", method)) for method in (f"bad_{fault}:some", "pdr")} == {
        "FileNotFoundError: [Errno 2] No such file or directory: 'no such file'"
    }
    assert failed == {("one", "pdr"): None, ("two", f"bad_{fault}:some"): None, ("two", "pdr"): None}
    again = run("bench", "run", "m.toml", "--workers", 2, "--only", "| pdr", cwd=tmp_path, new=True)
    assert again.output.startswith("1 row made"), "what failed is tried again, the rest is not"


SLOW = """import time
import numpy as np
def slow(evidence):
    time.sleep(0.5)
    return np.column_stack([evidence.fixes.time, evidence.fixes.position])
"""


def is_running(pid):
    """True if a process of this number runs, and is no zombie."""
    try:
        return " Z " not in Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return False


@pytest.mark.parametrize("number", [thorough(signal.SIGKILL), signal.SIGINT, thorough(signal.SIGTERM)])
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="lists the processes of a process by /proc")
def test_a_run_that_is_ended_leaves_no_process_and_goes_on_without_loss(arcade_walk, tmp_path, number):
    """Ctrl-C goes to all processes of a terminal, as here; the others to the command alone."""
    walks = {f"w{n}" for n in range(8)}
    for name in walks:
        shutil.copytree(arcade_walk, tmp_path / "walks" / name)
    (tmp_path / "slowly.py").write_text(SLOW)
    (tmp_path / "m.toml").write_text('data_sets = ["walks"]\nmethods = ["slowly:slow"]')
    command = [sys.executable, "-m", "pdr_graph", "bench", "run", "m.toml", "--workers", "2"]
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True, start_new_session=True) as process:
        until(lambda: (tmp_path / "bench" / RESULTS).exists() and len(rows_of(tmp_path)) >= 2)
        begun = [int(pid) for pid in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()]
        assert begun
        (os.killpg if number == signal.SIGINT else os.kill)(process.pid, number)
        _, errors = process.communicate(timeout=60)
    text = {signal.SIGINT: "pdr-graph: interrupted", signal.SIGTERM: "pdr-graph: told to end"}
    assert errors.strip() == text.get(number, errors.strip())
    before = rows_of(tmp_path)
    assert 2 <= len(before) < 8
    until(lambda: not any(map(is_running, begun)))
    code, printed, _ = run("bench", "run", "m.toml", "--workers", 2, cwd=tmp_path, new=True)
    assert (code, int(printed.split()[0])) == (0, 8 - len(before))
    assert sorted(row["walk"] for row in rows_of(tmp_path)) == sorted(walks), "each once"


def until(true, longest=90.0):
    """Wait until a condition holds."""
    end = time.monotonic() + longest
    while not true():
        assert time.monotonic() < end
        time.sleep(0.05)


def test_neither_workers_nor_the_order_of_rows_change_the_table(bench):
    """All but the seconds that a method took."""
    tables = []
    for workers in (1, 2):
        (bench / f"{workers}.toml").write_text(MATRIX.replace("data_sets", f'out = "with{workers}"\ndata_sets'))
        assert run("bench", "run", f"{workers}.toml", "--workers", workers, cwd=bench).code == 3
        results = bench / f"with{workers}" / RESULTS
        for order in (1, -1):
            results.write_text("\n".join(results.read_text().splitlines()[::order]))
            printed = run("bench", "stats", f"{workers}.toml", "--json", "--worst", 2, cwd=bench).output
            table = json.loads(printed.splitlines()[0])
            tables.append(
                [{key: cell for key, cell in row.items() if key not in ("seconds", "command")} for row in table]
            )
    assert tables[0] == tables[1] == tables[2] == tables[3]


def test_the_worst_walks_are_named(bench):
    """By the 95 % of their errors, in the text, as CSV and as JSON; a method without a verdict has none."""
    code, printed, _ = run("bench", "stats", "matrix.toml", "--worst", 1, "--csv", "w.csv", "--json", cwd=bench)
    assert code == 0
    groups = {(row["given"], row["method"]): row for row in json.loads(printed.splitlines()[0])}
    with (bench / "w-worst.csv").open(encoding="utf-8") as file:
        lines = {(row["given"], row["method"]): row for row in csv.DictReader(file)}
    rows = [row for row in rows_of(bench) if (row["given"], row["method"]) == ("first and last", "graph")]
    largest = max(rows, key=lambda row: np.percentile(row["errors"], 95))
    line = lines["first and last", "graph"]
    assert groups["first and last", "graph"]["worst"] == [line]
    assert line["CE95 [m]"] == f"{np.percentile(largest['errors'], 95):.2f}"
    assert line["verdict"] == largest["verdict"]
    assert lines["recorded", "copied"]["verdict"] == "—"
    assert groups["recorded", "own:broken"]["worst"] == []
    named = run("bench", "stats", "matrix.toml", "--worst", 1, cwd=bench).output.splitlines()
    assert any(each.startswith("worst:") and line["walk"] in each.split() for each in named)


def test_rows_of_an_earlier_version_are_unknown_and_made_again(bench):
    results = bench / "bench" / RESULTS
    whole = results.read_text()
    rows = [row for row in rows_of(bench) if row["method"] == "pdr"]
    old = [{key: value for key, value in row.items() if "scores" not in key} for row in rows]
    results.write_text("".join(json.dumps(row) + "\n" for row in old))
    [line, *_] = json.loads(run("bench", "stats", "matrix.toml", "--json", cwd=bench).output.splitlines()[0])
    assert (line["in 90 %"], line["energy score [m]"]) == ("—", "—")
    assert line["CE50 [m]"] != "—"
    made = run("bench", "run", "matrix.toml", *HERE, "--only", "| pdr", cwd=bench).output
    assert made.startswith(f"{len(old)} rows made")
    results.write_text(whole)


def test_numbers_are_set_for_one_command(arcade_walk, tmp_path):
    before = WALKER.sigma
    lengths = []
    for options in ((), ("--set", "walker.sigma=[0.001, 0.03, 0.003]")):
        arguments = ("--fixes", arcade_walk / "fixes.csv", "--no-report", "--out", tmp_path / f"{len(options)}")
        run("smooth", arcade_walk, *arguments, *options)
        summary = json.loads((tmp_path / f"{len(options)}" / "summary.json").read_text())
        lengths.append(summary["distance"])
    assert summary["settings"]["settings"] == ["WALKER.sigma=[0.001, 0.03, 0.003]"]
    assert lengths[0] != lengths[1]
    assert before == WALKER.sigma


@pytest.mark.parametrize(
    "text", ["WALKER.strides=1", "WALKER.sigma=0.1", "WALKER.pace=nan", "WALKER.pace=a", "none.toml"]
)
def test_a_wrong_number_is_one_line(arcade_walk, tmp_path, text):
    code, _, errors = run("smooth", arcade_walk, "--set", text, cwd=tmp_path)
    assert (code, len(errors)) == (2, 1)
    assert errors[0].startswith("pdr-graph: --set")
