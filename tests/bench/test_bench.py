"""``pdr-graph bench``: data sets by methods, ours and one's own, with resumption; and numbers set by ``--set``."""

import csv
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from commands import run
from numpy.testing import assert_allclose, assert_array_equal

from pdr_graph.apps.bench.data_sets import BenchWalk, given, recorded
from pdr_graph.apps.bench.matrix import RESULTS, percentiles_with_interval
from pdr_graph.apps.bench.methods import live
from pdr_graph.apps.replay import events_within
from pdr_graph.frames import Frame
from pdr_graph.gait.walker import Walker
from pdr_graph.priors import WALKER
from pdr_graph.types import Beacons, Fixes, Recording, Trajectory
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
    assert len(row["inside"]) == len(row["errors"])


def test_an_interrupted_run_goes_on(bench):
    results = bench / "bench" / RESULTS
    whole = results.read_text()
    cut = whole.splitlines(keepends=True)[:4]
    results.write_text("".join(cut) + '{"data_set": "walks", "wal')
    code, printed, _ = run("bench", "run", "matrix.toml", "--only", "| graph", cwd=bench)
    made = len([row for row in map(json.loads, whole.splitlines()[4:]) if row["method"] == "graph"])
    assert (code, printed.split()[0]) == (0, str(made))
    assert run("bench", "run", "matrix.toml", "--only", "| graph", cwd=bench).output.startswith("0 rows")
    command = ["bench", "run", "matrix.toml", "--again", "--only"]
    assert run(*command, "walks |", "--only", "| recorded | pdr", cwd=bench).output.startswith("2 rows made")


def test_a_data_set_of_ones_own_is_a_function(bench):
    """Of the same recordings as a folder: the same errors."""
    (bench / "own_data.py").write_text(OWN_DATA)
    settings = 'data_sets = ["walks", "own_data:walks"]', 'given = ["first and last"]', 'methods = ["pdr"]'
    (bench / "other.toml").write_text("\n".join([*settings, 'out = "other"', 'data = "."']))
    assert run("bench", "run", "other.toml", cwd=bench).output.startswith("4 rows made")
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
        ('data_sets = ["nowhere"]', "found 'nowhere', expected one of microsoft"),
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
    code, _, errors = run("bench", "run", "wrong.toml", cwd=bench)
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
    assert given(walk_with(fixes, truth), "recorded, plan") is None
    assert not len(given(walk_with(fixes, truth), "nothing").evidence.fixes)


def test_the_interval_is_of_whole_walks():
    """Ten walks of equal errors each: the interval is theirs, not that of a thousand places."""
    walks = [np.full(100, error) for error in np.arange(1.0, 11.0)]
    low, high = percentiles_with_interval(walks)[0].split("(")[1].rstrip(")").split("–")
    assert float(low) <= 3.5
    assert float(high) >= 7.5


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
